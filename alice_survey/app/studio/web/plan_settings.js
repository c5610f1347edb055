/* The settings that are changed most, as sliders, choices and arrows; the others as numbers
   below. */

import {el} from "./core.js";
import {choice, compass, numberField, slider} from "./plan_fields.js";
import {valueOf} from "./plan_changes.js";

const MAIN = [
  ["plan.altitude_m", "Altitude"], ["plan.forward_overlap", "Forward overlap"],
    ["plan.side_overlap", "Side overlap"],
  ["plan.speed_mps", "Speed"],
];
const HEADING = "plan.line_heading_deg";
/* Those that are drawn, or set by an arrow or a choice. */
const APART = new Set([
  HEADING, "sea.current_mps", "sea.current_towards_deg", "sea.swell_m", "sea.swell_towards_deg",
    "camera.focal_mm",
  "area.latitude_deg", "area.longitude_deg", "area.length_m", "area.width_m", "area.heading_deg",
]);
const titleOf = (key) => {
  const words = key.replace(/_(m|mps|deg|deg_s|s|px)$/, "").replaceAll("_", " ");
  return words[0].toUpperCase() + words.slice(1);
};

/* `file` is the answer of GET /api/plan; `changed([[section, key, value], ...], tag)`. */
export function settingsPanel(file, changed) {
  const controls = [];
  const one = (path, value) => {
    const [section, key] = path.split(".");
    changed([[section, key, value]], path);
  };
  const now = (changes, path) => valueOf(changes, file, ...path.split("."));

  function number(path, title) {
    const limits = file.limits[path];
    if (!limits) return null;
    const percent = path.endsWith("_overlap");
    const made = slider(title, limits, (value) => {
      if (path !== "plan.side_overlap") one(path, value);
      else changed([["plan", "side_overlap", value], ["plan", "line_spacing_m", null]], path);
    }, {percent});
    const spaced = path === "plan.side_overlap" ? el("small", {hidden: true}) : null;
    if (spaced) made.element.append(spaced);
    controls.push((changes, preview) => {
      const spacing = now(changes, "plan.line_spacing_m");
      if (!spaced || spacing === null) made.set(now(changes, path));
      else made.set(preview?.ok ? Number(preview.totals.side_overlap.toFixed(3)) : now(changes,
        path));
      if (!spaced) return;
      spaced.hidden = spacing === null;
      spaced.textContent = "Follows from the lines, " + spacing
        + " m apart by line_spacing_m; moving it takes that out.";
    });
    return made.element;
  }

  function heading() {
    const limits = file.limits[HEADING];
    if (!limits) return null;
    const best = el("input",
      {type: "checkbox", onchange: () => one(HEADING, best.checked ? null : made.value)});
    const made = {...slider("Heading of the lines", limits, (value) => {
      made.value = value; one(HEADING, value); }), value: 0};
    controls.push((changes, preview) => {
      const value = now(changes, HEADING);
      best.checked = value === null;
      made.value = value ?? (preview?.ok ? Math.round(preview.totals.heading_deg + 360) % 360 : 0);
      made.set(made.value);
      made.enable(!best.checked);
    });
    return el("div", {}, made.element, el("div", {class: "choice"},
      el("label", {}, best, "Best: the one that costs least energy")));
  }

  function select(path, title, options) {
    const made = choice(title, options, (value) => one(path, value));
    controls.push((changes) => made.set(now(changes, path)));
    return made.element;
  }

  function arrow(title, [strength, towards], about) {
    const [section, strong] = strength.split(".");
    const [, way] = towards.split(".");
    const made = compass(title, about, (value, degrees) => changed(
      [[section, strong, value], [section, way, degrees]], strength));
    controls.push((changes) => made.set(now(changes, strength) ?? 0, now(changes, towards) ?? 0));
    return made.element;
  }

  function other(path) {
    const made = numberField(titleOf(path.split(".")[1]), file.limits[path], (value) => one(
      path, value));
    controls.push((changes) => made.set(now(changes, path)));
    return made.element;
  }

  const main = MAIN.map(([path, title]) => number(path, title));
  const others = Object.keys(file.limits).filter((path) => !APART.has(path)
    && !MAIN.some(([known]) => known === path));
  const sections = [...new Set(others.map((path) => path.split(".")[0]))];
  const more = sections.map((section) => el("details", {}, el("summary", {}, titleOf(section)),
    others.filter((path) => path.startsWith(section + ".")).map(other)));
  const element = el("div", {}, main, heading(),
    el("div", {class: "row"},
      select("camera.focal_mm", "Lens", file.lenses_mm.map((mm) => [mm, mm + " mm"])),
      select("vehicle.name", "Vehicle", file.vehicles.map((name) => [name, name]))),
    el("details", {}, el("summary", {}, "Current and swell"),
      arrow("Current", ["sea.current_mps", "sea.current_towards_deg"],
        {unit: "m/s", most: 0.5, step: 0.01, strengthTitle: "Speed"}),
      arrow("Swell", ["sea.swell_m", "sea.swell_towards_deg"],
        {unit: "m", most: 2, step: 0.05, strengthTitle: "Height"})),
    el("details", {}, el("summary", {}, "More settings"), more));

  /* Show what is set, and where it follows from the plan, what the plan has. */
  const set = (changes, preview) => controls.forEach((control) => control(changes, preview));
  return {element, set};
}
