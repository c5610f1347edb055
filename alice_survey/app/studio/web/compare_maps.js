/* Another survey over or next to this one: a swipe on the one map, or a second map in step. */

import {el} from "./core.js";

const PANE = "compare";

/* What a raster covers. */
export const boundsOf = (about) => leaflet.latLngBounds(
  [about.north - about.height * about.pixel, about.west], [about.north, about.west + about.width * about.pixel],
);

export function comparedMaps(studio, swiped) {
  const map = studio.map.leaflet;
  const view = map.getContainer().parentElement;
  const frame = view.parentElement;
  const pane = map.createPane(PANE);
  pane.style.zIndex = 250;
  const line = el("div", {"aria-hidden": "true", class: "swipe"}, el("span", {}, "↔"));
  let mode = "off";
  let share = 0.5;
  let layer = null;
  let second = null;
  let box = null;

  function clip() {
    const size = map.getSize();
    const low = map.containerPointToLayerPoint([size.x * share, 0]);
    const high = map.containerPointToLayerPoint(size);
    pane.style.clip = `rect(${low.y}px, ${high.x}px, ${high.y}px, ${low.x}px)`;
    line.style.left = 100 * share + "%";
  }

  line.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    line.setPointerCapture(event.pointerId);
    const follow = (one) => {
      const edges = view.getBoundingClientRect();
      setShare(Math.min(1, Math.max(0, (one.clientX - edges.left) / edges.width)));
      swiped(share);
    };
    line.addEventListener("pointermove", follow);
    line.addEventListener("pointerup", () => line.removeEventListener("pointermove", follow), {once: true});
  });

  function setShare(value) {
    share = value;
    if (mode === "swipe") clip();
  }

  /* Two maps in step: each follows the other, and none itself. */
  let following = false;
  const follow = (from, to) => () => {
    if (following) return;
    following = true;
    to.setView(from.getCenter(), from.getZoom(), {animate: false});
    following = false;
  };

  /* The map's frame takes another width; its middle stays. */
  function resize(right) {
    const [middle, zoom] = [map.getCenter(), map.getZoom()];
    frame.style.right = right;
    map.invalidateSize({pan: false});
    map.setView(middle, zoom, {animate: false});
  }

  function beside(about, name) {
    resize("50%");
    if (!map.getBounds().intersects(boundsOf(about))) map.fitBounds(boundsOf(about), {animate: false});
    box = el("div", {tabindex: "0", role: "application", "aria-label": "Map of " + name + ": it moves with the other", class: "second-map"});
    document.querySelector(".map-side").append(box);
    second = new leaflet.Map(box, {
      crs: leaflet.CRS.Simple, attributionControl: false, zoomControl: false, zoomSnap: 0.25,
      fadeAnimation: false, zoomAnimation: false, minZoom: map.getMinZoom(), maxZoom: map.getMaxZoom(),
    });
    second.createPane("pictures").style.zIndex = 200;
    second.setView(map.getCenter(), map.getZoom(), {animate: false});
    second.there = follow(map, second);
    map.on("move zoom", second.there);
    second.on("move zoom", follow(second, map));
    layer = new Pyramid(about, "pictures").addTo(second);
  }

  function put() {
    layer?.remove();
    layer = null;
    if (second) {
      map.off("move zoom", second.there);
      second.remove();
      box.remove();
      second = null;
      resize("");
    }
    line.remove();
    map.off("move zoomend resize viewreset", clip);
    pane.style.clip = "";
    mode = "off";
  }

  /* Show a raster of the other survey: mode is "swipe", "beside" or "off". */
  function show(about, wanted, name) {
    put();
    if (!about || wanted === "off") return;
    mode = wanted;
    if (mode === "beside") {
      beside(about, name);
      return;
    }
    layer = new Pyramid(about, PANE).addTo(map);
    view.append(line);
    map.on("move zoomend resize viewreset", clip);
    clip();
  }

  return {show, setShare};
}
