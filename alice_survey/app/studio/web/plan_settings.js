/* The settings of a plan as controls that are made of their limits: those that are changed often
   with sliders, the others below. */

import {el, field} from "./core.js";
import {valueOf} from "./plan_changes.js";

const SIDE = "plan.side_overlap";
const MAIN = {"plan.altitude_m": "Altitude", "plan.forward_overlap": "Forward overlap",
  [SIDE]: "Side overlap", "plan.speed_mps": "Speed"};
const HEADING = "plan.line_heading_deg";
/* Those that are drawn, or stand apart. */
const APART = new Set([HEADING, "camera.focal_mm", "area.latitude_deg", "area.longitude_deg",
  "area.length_m", "area.width_m", "area.heading_deg"]);
const titleOf = (key) => {
  const words = key.replace(/_(m|mps|deg|deg_s|s|px)$/, "").replaceAll("_", " ");
  return words[0].toUpperCase() + words.slice(1);
};
const known = (value) => value !== null && value !== undefined;

/* A number, or none where it is left empty; of shares in per cent. `changed(value)` is called while
   a slider moves, too. */
function numberControl(title, {low, high, step, unit, about}, changed, slides, unset) {
  const scale = slides && !unit ? 100 : 1;
  const scaled = (value) => (known(value) ? String(Number((value * scale).toPrecision(9))) : "");
  const bounds = {min: scaled(low) || null, max: scaled(high) || null, step: scaled(step)};
  const exact = el("input", {type: "number", ...bounds, placeholder: unset});
  const range = slides ? el("input", {type: "range", ...bounds, "aria-label": title}) : null;
  function taken(text) {
    if (text === "" && slides) return;
    const value = Math.min(high ?? Infinity, Math.max(low ?? -Infinity, Number(text) / scale));
    changed(text === "" ? null : Number(value.toPrecision(9)));
  }
  exact.addEventListener("change", () => taken(exact.value));
  range?.addEventListener("input", () => {
    exact.value = range.value;
    taken(range.value);
  });
  /* What is being typed is left alone. */
  function set(value) {
    if (document.activeElement !== exact) exact.value = scaled(value);
    if (range) range.value = scaled(value);
  }
  const element = field(title + ", " + (scale > 1 ? "%" : unit || "number"), exact, about);
  exact.before(range || "");
  return {element, set};
}

function choiceControl(title, options, changed) {
  const select = el("select", {}, options.map(([value, text]) =>
    el("option", {value: String(value)}, text)));
  select.addEventListener("change", () => changed(options[select.selectedIndex][0]));
  return {element: field(title, select), set: (value) => { select.value = String(value); }};
}

/* `file` is the answer of GET /api/plan; `changed([[section, key, value], ...], tag)`. */
export function settingsPanel(file, changed) {
  const controls = [];
  const now = (changes, path) => valueOf(changes, file, ...path.split("."));

  function shown(path, make, value = (changes, name, _) => now(changes, name)) {
    const [section, key] = path.split(".");
    const made = make((next) => changed([[section, key, next],
      ...(path === SIDE ? [["plan", "line_spacing_m", null]] : [])], path));
    controls.push((changes, preview) => made.set(value(changes, path, preview)));
    return made.element;
  }
  /* The overlap to the side follows from the distance of lines where that is set. */
  const sideOf = (changes, path, preview) =>
    (now(changes, "plan.line_spacing_m") !== null && preview?.ok
      ? preview.totals.side_overlap : now(changes, path));
  const number = (path, title, slides = false, unset = "not set") => shown(path,
    (set) => numberControl(title, file.limits[path], set, slides, unset),
    path === SIDE ? sideOf : undefined);
  const choice = (path, title, options) => shown(path, (set) => choiceControl(title, options, set));

  const others = Object.keys(file.limits).filter((path) => !APART.has(path) && !(path in MAIN));
  const sections = [...new Set(others.map((path) => path.split(".")[0]))];
  const element = el("div", {},
    Object.entries(MAIN).map(([path, title]) => number(path, title, true)),
    number(HEADING, "Heading of the lines", false, "the one that costs least energy"),
    el("div", {class: "row"},
      choice("camera.focal_mm", "Lens", file.lenses_mm.map((mm) => [mm, mm + " mm"])),
      choice("vehicle.name", "Vehicle", file.vehicles.map((name) => [name, name]))),
    el("details", {}, el("summary", {}, "More settings"), sections.map((section) =>
      el("details", {}, el("summary", {}, titleOf(section)),
        others.filter((path) => path.startsWith(section + "."))
          .map((path) => number(path, titleOf(path.split(".")[1])))))));

  /* Show what is set, and where it follows from the plan, what the plan has. */
  const set = (changes, preview) => controls.forEach((control) => control(changes, preview));
  return {element, set};
}
