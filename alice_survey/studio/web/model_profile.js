/* A profile: heights along a line with the band of one sigma, linked to the map. */

import {el} from "./core.js";
import {number, withSigma} from "./words.js";

const WIDTH = 340;
const HEIGHT = 170;
const LEFT = 56;
const TOP = 10;
const BOTTOM = 30;

function steps(low, high, most) {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough * (1 - 1e-9));
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9) * step; at <= high + 1e-9 * step; at += step) found.push(at);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

export function profileView(map, unit) {
  const drawn = el("svg", {viewBox: "0 0 " + WIDTH + " " + HEIGHT, "aria-hidden": "true"});
  const said = el("p", {class: "note"});
  const slider = el("div", {
    class: "profile", role: "slider", tabindex: "0", "aria-label": "Place along the profile: arrow keys move it",
    "aria-valuemin": "0", "aria-valuemax": "0", "aria-valuenow": "0",
  }, drawn);
  const element = el("div", {hidden: true}, slider, said);
  const spot = leaflet.circleMarker([0, 0], {
    radius: 6, color: "#fff", weight: 2, fillColor: "#0072b2", fillOpacity: 1, interactive: false,
  });
  let found = null;
  let at = 0;
  let x = null;
  let cursor = null;

  function move(index) {
    at = Math.min(found.along.length - 1, Math.max(0, index));
    const text = number(found.along[at], unit, 4) + " along: " + (found.height[at] === null
      ? "no height is known" : withSigma(found.height[at], found.sigma[at], unit));
    said.textContent = text;
    slider.setAttribute("aria-valuenow", String(at));
    slider.setAttribute("aria-valuetext", text);
    ["x1", "x2"].forEach((name) => cursor.setAttribute(name, x(found.along[at])));
    const [east, north] = found.places[at];
    spot.setLatLng([north, east]).addTo(map.leaflet);
  }

  function nearest(distance) {
    let best = 0;
    found.along.forEach((one, i) => {
      if (Math.abs(one - distance) < Math.abs(found.along[best] - distance)) best = i;
    });
    return best;
  }

  slider.addEventListener("pointermove", (event) => {
    if (!found) return;
    const box = drawn.getBoundingClientRect();
    const share = ((event.clientX - box.left) / box.width * WIDTH - LEFT) / (WIDTH - LEFT - 8);
    move(nearest(share * found.along[found.along.length - 1]));
  });
  slider.addEventListener("keydown", (event) => {
    const far = Math.max(1, Math.round((found?.along.length || 0) / 20));
    const step = {ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: far, PageDown: -far, Home: -Infinity, End: Infinity}[event.key];
    if (!found || step === undefined) return;
    event.preventDefault();
    move(at + step);
  });
  /* The other way round: what of the line is nearest to the pointer on the map. */
  map.leaflet.on("mousemove", (event) => {
    if (!found) return;
    const pointer = map.leaflet.latLngToContainerPoint(event.latlng);
    let best = null;
    let least = 25;
    found.places.forEach(([east, north], i) => {
      const away = map.leaflet.latLngToContainerPoint([north, east]).distanceTo(pointer);
      if (away < least) [least, best] = [away, i];
    });
    if (best !== null) move(best);
  });

  function clear() {
    found = null;
    element.hidden = true;
    spot.remove();
  }

  function show(profile) {
    found = profile;
    element.hidden = false;
    const known = found.height.map((height, i) => i).filter((i) => found.height[i] !== null);
    const length = found.along[found.along.length - 1];
    const sigma = (i) => found.sigma[i] || 0;
    let low = Math.min(...known.map((i) => found.height[i] - sigma(i)));
    let high = Math.max(...known.map((i) => found.height[i] + sigma(i)));
    if (!known.length) [low, high] = [0, 1];
    const margin = 0.06 * (high - low || 1);
    [low, high] = [low - margin, high + margin];
    x = (distance) => LEFT + (WIDTH - LEFT - 8) * distance / length;
    const y = (height) => TOP + (HEIGHT - TOP - BOTTOM) * (high - height) / (high - low);
    const parts = [];
    known.forEach((i) => {
      if (!parts.length || parts[parts.length - 1].at(-1) !== i - 1) parts.push([]);
      parts[parts.length - 1].push(i);
    });
    const point = (i, height) => x(found.along[i]).toFixed(1) + "," + y(height).toFixed(1);
    const [ups, upDigits] = steps(low, high, 5);
    const [rights, rightDigits] = steps(0, length, 5);
    const minus = (text) => text.replace("-", "−");
    cursor = el("line", {y1: TOP, y2: HEIGHT - BOTTOM, stroke: "var(--ink)", "stroke-width": 1});
    drawn.replaceChildren(
      ...ups.map((height) => el("g", {}, el("line", {x1: LEFT, x2: WIDTH - 8, y1: y(height), y2: y(height), stroke: "var(--line)"}),
        el("text", {x: LEFT - 5, y: y(height) + 4, "text-anchor": "end", "font-size": 11, fill: "var(--soft)"}, minus(height.toFixed(upDigits))))),
      ...rights.map((distance) => el("text", {
        x: x(distance), y: HEIGHT - BOTTOM + 14, "text-anchor": "middle", "font-size": 11, fill: "var(--soft)",
      }, distance.toFixed(rightDigits))),
      el("text", {x: WIDTH - 8, y: HEIGHT - 3, "text-anchor": "end", "font-size": 11, fill: "var(--soft)"}, "along the line, " + unit + "; height ± sigma"),
      ...found.corners.slice(1, -1).map((distance) => el("line", {
        x1: x(distance), x2: x(distance), y1: TOP, y2: HEIGHT - BOTTOM, stroke: "var(--soft)", "stroke-dasharray": "2 3",
      })),
      ...parts.map((part) => el("polygon", {
        points: [...part.map((i) => point(i, found.height[i] + sigma(i))), ...[...part].reverse().map((i) => point(i, found.height[i] - sigma(i)))].join(" "),
        fill: "var(--blue)", "fill-opacity": 0.3,
      })),
      ...parts.map((part) => el("polyline", {
        points: part.map((i) => point(i, found.height[i])).join(" "), fill: "none", stroke: "var(--blue)", "stroke-width": 1.6,
      })),
      cursor,
    );
    slider.setAttribute("aria-valuemax", String(found.along.length - 1));
    move(0);
  }

  return {element, show, clear};
}
