/* Controls of the Plan tab: a slider with its number, a choice, an arrow on a compass. */

import {el, field} from "./core.js";

let made = 0;
const nextId = () => { made += 1; return "plan-field-" + made; };

/* A slider and a number that hold one value. `limits` are {low, high, step, unit, about}; shares
   without a unit are shown in per cent. `changed(value)` is called while it moves, too. */
export function slider(title, limits, changed, {percent = false} = {}) {
  const scale = percent ? 100 : 1;
  const {low, high, step} = limits;
  const bounds = {min: low * scale, max: high * scale, step: step * scale};
  const shown = (value) => String(Number((value * scale).toPrecision(6)));
  const id = nextId();
  const range = el("input", {type: "range", ...bounds, "aria-label": title});
  const exact = el("input", {type: "number", id, inputmode: "decimal", ...bounds, step: "any"});
  const about = limits.about ? el("small", {id: id + "-hint"}, limits.about) : null;
  if (about) exact.setAttribute("aria-describedby", about.id);
  const unit = percent ? "%" : limits.unit || "";
  const element = el("div", {class: "field plan-number"}, el("label", {for: id}, title), range,
    exact,
    el("span", {class: "plan-unit"}, unit), about);

  function taken(text) {
    const value = Number(text) / scale;
    if (text === "" || !Number.isFinite(value)) return;
    const within = Math.min(high, Math.max(low, value));
    exact.value = shown(within);
    set(within);
    changed(Number(within.toFixed(6)));
  }
  range.addEventListener("input", () => taken(range.value));
  exact.addEventListener("change", () => taken(exact.value));
  /* The arrows of a number step as the slider does. */
  exact.addEventListener("keydown", (event) => {
    const way = {ArrowUp: 1, ArrowDown: -1}[event.key];
    if (!way) return;
    event.preventDefault();
    taken(Number(exact.value) + way * bounds.step);
  });

  /* What is being typed is left alone. */
  function set(value) {
    const text = value === null || value === undefined ? "" : shown(value);
    range.value = text === "" ? bounds.min : text;
    range.setAttribute("aria-valuetext", text === "" ? "not set" : text + " " + unit);
    if (document.activeElement !== exact) exact.value = text;
  }
  function enable(on) {
    [range.disabled, exact.disabled] = [!on, !on];
  }
  return {element, set, enable};
}

/* A number, or none where it is left empty. */
export function numberField(title, {low, high, step, unit, about}, changed) {
  const input = el(
    "input", {type: "number", min: low, max: high, step: "any", placeholder: "not set"});
  input.addEventListener("change", () => {
    const value = input.value === "" ? null : Number(input.value);
    if (value === null || Number.isFinite(value)) changed(value);
  });
  input.addEventListener("keydown", (event) => {
    const way = {ArrowUp: 1, ArrowDown: -1}[event.key];
    if (!way) return;
    event.preventDefault();
    input.value = String(
      Number(Math.min(high ?? Infinity, Math.max(low ?? -Infinity,
      Number(input.value) + way * step)).toPrecision(9)));
    changed(Number(input.value));
  });
  const element = field(title + (unit ? ", " + unit : ""), input, about);
  const set = (value) => { if (document.activeElement !== input) input.value = value ?? ""; };
  return {element, set};
}

/* One of several values; `options` are [value, text]. */
export function choice(title, options, changed, hint = "") {
  const select = el("select", {}, options.map(
    ([value, text]) => el("option", {value: String(value)}, text)));
  select.addEventListener("change", () => changed(options[select.selectedIndex][0]));
  const element = field(title, select, hint);
  function set(value) {
    if (!options.some(([known]) => known === value)) {  /* one of the file's own */
      options.push([value, String(value)]);
      select.append(el("option", {value: String(value)}, String(value)));
    }
    select.selectedIndex = options.findIndex(([known]) => known === value);
  }
  return {element, set};
}

/* Degrees from north towards a place of the compass, whole, 0 to 359. */
const bearing = (right, up) =>
  ((Math.round(Math.atan2(right, up) * 180 / Math.PI) % 360) + 360) % 360;

/* An arrow that points where something flows to, as long as it is strong: drag its tip, or use the
   arrow keys. `most` is the strength at the rim. `changed(strength, towards)`. */
export function compass(title, {unit, most, step, strengthTitle}, changed) {
  const [size, rim] = [52, 38];
  let [strength, towards] = [0, 0];
  const line = el("line", {class: "way", x1: 0, y1: 0});
  const tip = el("path", {class: "tip", d: "M 0 -9 L 6 5 L -6 5 Z"});
  const north = el("text", {x: 0, y: -rim - 3}, "N");
  const svg = el("svg", {
    viewBox: `${-size} ${-size} ${2 * size} ${2 * size}`, tabindex: "0", role: "slider",
      "aria-label": title + ", direction",
    "aria-valuemin": "0", "aria-valuemax": "359",
  }, el("circle", {class: "rim", r: rim}), north, line, tip);
  const strong = el("input", {type: "number", min: 0, step: "any"});
  const way = el("input", {type: "number", min: 0, max: 359, step: "any"});
  const element = el("div", {class: "plan-compass"}, el("h3", {}, title), svg,
    el("div", {}, field(strengthTitle + ", " + unit, strong),
      field("Towards, degrees from north", way)));

  function draw() {
    const reach = rim * Math.min(1, strength / most);
    const [x, y] = [reach * Math.sin(towards * Math.PI / 180),
      -reach * Math.cos(towards * Math.PI / 180)];
    line.setAttribute("x2", x);
    line.setAttribute("y2", y);
    tip.setAttribute("transform", `translate(${x} ${y}) rotate(${towards})`);
    svg.setAttribute("aria-valuenow", String(Math.round(towards)));
    svg.setAttribute(
      "aria-valuetext", `${strength} ${unit} towards ${Math.round(towards)} degrees`);
    if (document.activeElement !== strong) strong.value = strength;
    if (document.activeElement !== way) way.value = towards;
  }
  function set(newStrength, newTowards) {
    [strength, towards] = [newStrength, newTowards];
    draw();
  }
  function taken(newStrength, newTowards) {
    const whole = Math.round(Math.max(0, newStrength) / step) * step;
    set(Number(whole.toFixed(6)), ((newTowards % 360) + 360) % 360);
    changed(strength, towards);
  }
  function dragged(event) {
    const box = svg.getBoundingClientRect();
    const scale = 2 * size / box.width;
    const right = (event.clientX - box.left - box.width / 2) * scale;
    const up = -(event.clientY - box.top - box.height / 2) * scale;
    taken(most * Math.min(1, Math.hypot(right, up) / rim), bearing(right, up));
  }
  svg.addEventListener("pointerdown", (event) => {
    svg.setPointerCapture(event.pointerId);
    dragged(event);
  });
  svg.addEventListener("pointermove", (event) => {
    if (svg.hasPointerCapture(event.pointerId)) dragged(event); });
  svg.addEventListener("keydown", (event) => {
    const [turn, more] = {
      ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, step], ArrowDown: [0, -step],
    }[event.key] || [];
    if (turn === undefined) return;
    event.preventDefault();
    taken(strength + more, towards + turn);
  });
  strong.addEventListener("change", () => taken(Number(strong.value), towards));
  way.addEventListener("change", () => taken(strength, Number(way.value)));
  return {element, set};
}
