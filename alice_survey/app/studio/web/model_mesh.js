/* The mesh in 3D in the tab Model: it turns, a click picks a place on it, two picks give a
   length. */

import {attempt, button, bytes, el, get, say} from "./core.js";
import {startTiles} from "./model_tiles.js";
import {WHITE} from "./palette.js";
import {counted, number} from "./words.js";

const STILL_PX = 4;
const ACTS = [["left", "Turn left", "←"], ["right", "Turn right", "→"],
  ["up", "Look from higher", "↑"], ["down", "Look from lower", "↓"],
  ["nearer", "Nearer", "+"], ["farther", "Farther", "−"], ["reset", "Reset the view", "⟲"]];

function loaded(address) {
  return new Promise((resolve, reject) => {
    if (document.querySelector(`script[src="${address}"]`)) {
      resolve();
      return;
    }
    const script = el(
      "script", {src: address, onload: resolve,
      onerror: () => reject(new Error(address + " did not come: load the page again"))});
    document.head.append(script);
  });
}

/* From glTF (x east, y up, z south, about an offset) to the axes of the map: right, up, out. */
export function onMap(point, {offset, plane}) {
  const enu = [point.x + offset[0], offset[1] - point.z, point.y + offset[2]];
  if (!plane) return enu;
  const arm = enu.map((value, i) => value - plane.origin[i]);
  return [plane.right, plane.up, plane.out].map(
    (axis) => axis.reduce((sum, part, i) => sum + part * arm[i], 0));
}

export function meshPart(studio, {colour, measured}) {
  const {map, state} = studio;
  const canvas = el("canvas", {
    id: "mesh-canvas", tabindex: "0", role: "application",
    "aria-label": "The sea floor in 3D: arrow keys turn it, + and - move nearer and farther, 0 "
      + "resets the view, Enter picks what is in the middle, Escape drops the picks",
  });
  const told = el("p", {class: "readout"});
  const relief = el(
    "button", {type: "button", class: "word", "data-act": "relief", "aria-pressed": "false",
    title: "Grey under a lamp from the side: shape without colours"}, "Relief");
  const tools = el("div", {class: "tools", role: "group", "aria-label": "Turn the model"},
    ACTS.map(([act, label, sign]) =>
      el("button", {type: "button", "data-act": act, title: label, "aria-label": label}, sign)),
      relief);
  const view = el("div", {class: "view"}, canvas, tools, told);
  const root = el("div", {class: "mesh live", hidden: true}, view);
  const home = el("div", {});
  const picked = el("p", {class: "note", role: "status"},
    "Click a place on the model, then another: their distance is measured.");
  const large = button("Larger, over the map", () => enlarge(
    large.getAttribute("aria-pressed") !== "true"), {"aria-pressed": "false"});
  const about = el("p", {class: "note"});
  const streamed = el("p", {class: "note"});
  const body = el("div", {}, el("div", {class: "buttons"}, large), home, streamed, picked, about);
  home.append(root);
  const element = el("details", {hidden: true}, el("summary", {}, "In 3D"), body);
  const spots = leaflet.featureGroup();
  let scene = null;
  let lies = null;
  let begun = false;
  let picks = [];

  /* Tiles in full detail in place of the light copy. */
  const refine = async () => scene.show(await startTiles(scene, lies.tiles, {
    progress({parts, coming, bytes: held}) {
      Object.assign(canvas.dataset, {parts: parts.length, coming,
        mib: (held / 2 ** 20).toFixed(3)});
      streamed.textContent = counted(parts.length, "tile") + " drawn, " + coming
        + " on the way, " + number(held / 2 ** 20, "MB", 2) + " held";
    },
    failed: (fault) => say("A part is not drawn: " + fault.message, "error"),
  }));

  function enlarge(on) {
    large.setAttribute("aria-pressed", String(on));
    root.classList.toggle("over-map", on);
    (on ? document.querySelector(".map-side") : home).append(root);
  }

  function drop() {
    picks = [];
    shown();
  }

  function shown() {
    scene.mark(picks.map(({point}) => point), colour);
    spots.clearLayers().addTo(map.leaflet);
    const places = picks.map(({point}) => onMap(point, lies));
    places.forEach(([east, north]) => spots.addLayer(leaflet.circleMarker([north, east], {
      radius: 6, color: WHITE, weight: 2, fillColor: colour, fillOpacity: 1, interactive: false,
    })));
    return places;
  }

  function take(x, y) {
    const hit = scene.pick(x, y);
    if (!hit) {
      say("Nothing of the model is there.", "warn");
      return;
    }
    picks = picks.length === 2 ? [hit] : [...picks, hit];
    const places = shown();
    const last = places[places.length - 1].map((value) => number(value, "", 6)).join(", ");
    picked.textContent = "Picked " + last + " " + state.unit + (picks.length === 1
      ? ": click another place." : "");
    if (picks.length === 2) measured(places);
  }

  async function begin() {
    begun = true;
    lies = await get("/api/model/mesh");
    about.textContent = lies.about + (lies.tiles
      ? " Other viewers of 3D Tiles: " + window.location.origin + lies.tiles
      : "");
    const context = document.createElement("canvas").getContext("webgl2");
    if (!context) {
      still("This browser has no WebGL, which turning the model needs");
      return;
    }
    context.getExtension("WEBGL_lose_context")?.loseContext();
    await loaded("/app/vendor_mesh.js");
    await loaded("/app/mesh.js");
    const model = await bytes(lies.address);
    root.hidden = false;
    scene = await startMesh(root, canvas, model, {
      told: (text) => { told.textContent = text; },
      lost: () => still("The browser took its graphics memory back"),
    });
    root.dataset.ready = "";
    if (lies.tiles) await refine();
  }

  function still(why) {
    root.hidden = true;
    large.hidden = true;
    picked.textContent = why + (lies.still ? ": this is a still picture." : ".");
    if (lies.still) home.append(
      el("img", {src: lies.still, alt: "The mesh seen from above and from the side"}));
  }

  let down = null;
  canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointerup", (event) => {
    const stayed = down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < STILL_PX;
    if (scene && stayed && event.button === 0) take(event.offsetX, event.offsetY);
  });
  canvas.addEventListener("keydown", (event) => {
    if (!scene || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Enter") take(canvas.clientWidth / 2, canvas.clientHeight / 2);
    else if (event.key === "Escape") drop();
    else return;
    event.preventDefault();
  });
  element.addEventListener("toggle", () => {
    if (element.open && !begun) attempt(begin);
    if (!element.open) enlarge(false);
  });

  return {
    element,
    enter() { element.hidden = !state.has.mesh; },
    leave() {
      enlarge(false);
      spots.remove();
    },
  };
}
