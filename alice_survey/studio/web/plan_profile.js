/* Sea floor and vehicle along the way, as a drawing whose pointer shows the place on the map. */

import {el} from "./core.js";
import {growing, nearestIndex, pathData, profilePlace} from "./plan_way.js";

const [WIDE, HIGH, LEFT, BELOW, ABOVE] = [340, 150, 34, 20, 8];

/* `pointed(place)` is called with the place of the pointer, or with null. */
export function profileView(pointed) {
  const svg = el("svg", {viewBox: `0 0 ${WIDE} ${HIGH}`, tabindex: "0", role: "slider", "aria-label": "Place along the way"});
  const readout = el("p", {class: "note"});
  const element = el("div", {class: "plan-profile"}, svg, readout);
  let [held, routes, along, x, index] = [null, [], [], null, 0];

  function show(profile, newRoutes) {
    [held, routes] = [profile && profile.s_m.length > 1 ? profile : null, newRoutes];
    svg.replaceChildren();
    element.hidden = !held;
    if (!held) return;
    along = growing(held.s_m);
    index = Math.min(index, along.length - 1);
    draw();
    describe();
  }

  function draw() {
    const depths = [...held.floor_depth_m, ...held.vehicle_depth_m].filter(Number.isFinite);
    const [least, most] = depths.reduce(([a, b], d) => [Math.min(a, d), Math.max(b, d)], [Infinity, -Infinity]);
    const pad = Math.max(0.1 * (most - least), 0.05);
    const [top, bottom] = [least - pad, most + pad];
    const [start, end] = [along[0], along[along.length - 1]];
    x = (length) => LEFT + (length - start) / (end - start || 1) * (WIDE - LEFT - 4);
    const y = (depth) => (depth === null ? null : ABOVE + (depth - top) / (bottom - top) * (HIGH - ABOVE - BELOW));
    const xs = along.map(x);
    const floor = pathData(xs, held.floor_depth_m.map(y));
    const base = HIGH - BELOW;
    const label = (at, down, text, anchor) => el("text", {x: at, y: down, "text-anchor": anchor}, text);
    const turns = held.dive.map((dive, i) => (i && dive !== held.dive[i - 1] ? xs[i] : null)).filter((at) => at !== null);
    svg.append(
      ...turns.map((at) => el("line", {class: "grid", x1: at, x2: at, y1: ABOVE, y2: base})),
      el("path", {class: "ground", d: floor ? `${floor}L${xs[xs.length - 1]} ${base}L${xs[0]} ${base}Z` : ""}),
      el("path", {class: "floor", d: floor}),
      el("path", {class: "way", d: pathData(xs, held.vehicle_depth_m.map(y))}),
      label(LEFT - 4, y(least) + 4, least.toFixed(1), "end"), label(LEFT - 4, y(most) + 4, most.toFixed(1), "end"),
      label(LEFT, HIGH - 5, "depth, m, along the way", "start"), label(WIDE - 4, HIGH - 5, Math.round(end) + " m", "end"),
      el("line", {class: "mark", y1: ABOVE, y2: base, visibility: "hidden"}),
    );
  }

  function describe() {
    const [floor, vehicle] = [held.floor_depth_m[index], held.vehicle_depth_m[index]];
    const known = Number.isFinite(floor) && Number.isFinite(vehicle);
    const text = Math.round(along[index]) + " m along, dive " + held.dive[index]
      + (Number.isFinite(vehicle) ? ": vehicle at " + vehicle.toFixed(2) + " m" : "")
      + (known ? ", " + (floor - vehicle).toFixed(2) + " m over the sea floor at " + floor.toFixed(2) + " m" : "");
    readout.textContent = text;
    Object.entries({
      "aria-valuemin": 0, "aria-valuemax": Math.round(along[along.length - 1]), "aria-valuenow": Math.round(along[index]), "aria-valuetext": text,
    }).forEach(([name, value]) => svg.setAttribute(name, String(value)));
  }

  function point(i) {
    index = Math.max(0, Math.min(along.length - 1, i));
    const mark = svg.querySelector(".mark");
    mark.setAttribute("visibility", "visible");
    ["x1", "x2"].forEach((name) => mark.setAttribute(name, x(along[index])));
    describe();
    pointed(profilePlace(held, routes, index));
  }

  function away() {
    svg.querySelector(".mark")?.setAttribute("visibility", "hidden");
    pointed(null);
  }

  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const right = (event.clientX - box.left) / box.width * WIDE;
    const share = (right - LEFT) / (WIDE - LEFT - 4);
    point(nearestIndex(along, along[0] + share * (along[along.length - 1] - along[0])));
  });
  svg.addEventListener("pointerleave", away);
  svg.addEventListener("blur", away);
  svg.addEventListener("keydown", (event) => {
    const step = Math.max(1, Math.round(along.length / 100));
    const to = {
      ArrowRight: index + step, ArrowUp: index + step, ArrowLeft: index - step, ArrowDown: index - step, Home: 0, End: along.length - 1,
      PageUp: index + 10 * step, PageDown: index - 10 * step,
    }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    point(to);
  });
  return {element, show};
}
