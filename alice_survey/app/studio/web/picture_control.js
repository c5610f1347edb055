/* Control of the pictures tab: what is known of points and lengths, and how it fits at once. */

import {button, el, field, table} from "./core.js";
import {number} from "./words.js";

const BAD_SIGMAS = 4;
export const mm = (value) => number(1000 * value, "", 3);

function fitOf(row, preview) {
  if (!preview) return "";
  const rows = (score) => (row.kind === "point" ? score?.points : score?.bars) || [];
  const of = (score) => rows(score).find((one) => one.name === row.name);
  const [now, fitted] = [of(preview.now), of(preview.fitted)];
  const why = preview.not_found[row.name];
  if (!now && !fitted) return el("span", {class: why ? "warn" : null}, why || "");
  const words = (one) => (row.kind === "point"
    ? [one.north_m, one.east_m, one.down_m].map(mm).join(", ") : mm(one.error_m));
  const judged = fitted || (row.kind === "bar"
    ? now : null);  /* a model lies as far off as its navigation */
  const bad = judged && judged.misfit_sigmas > BAD_SIGMAS;
  return el("span", {class: bad ? "error" : null}, [
    now ? "now " + words(now) : "", now && fitted ? "; " : "",
      fitted && row.kind === "point" ? "fitted " + words(fitted) : "",
    bad ? " BAD: " + number(judged.misfit_sigmas, "sigmas", 2) : "",
  ].join(""));
}

/* The rows of control.csv with their residuals. */
export function controlRows(rows, preview, remove) {
  if (!rows.length) return el("p", {class: "note"},
    "Nothing is known of the site yet: no control.csv.");
  const what = (row) => (row.kind === "point"
    ? ["north_m", "east_m", "depth_m", "latitude_deg", "longitude_deg", "easting_m", "northing_m",
      "height_m"]
      .filter((key) => row[key]).map((key) => row[key]).join(", ")
    : row.kind === "bar" ? row.from + " to " + row.to + ": " + row.length_m + " m" : row.length_m
      + " m");
  return table("What is known; residuals in mm (points: north, east, down)",
    ["Name", "Known", "Residual", "Change"],
    rows.map((row) => [row.name, row.kind + ", " + row.use + ": " + what(row), fitOf(row, preview),
      button("Delete", () => remove(row), {"aria-label": "Delete " + row.kind + " " + row.name})]));
}

/* A form for one more. */
export function controlForm(names, save) {
  const select = (options) =>
    el("select", {}, options.map((text) => el("option", {value: text}, text)));
  const figure = (value = "") => el("input", {type: "number", step: "any", value});
  const kind = select(["point", "bar"]);
  const use = select(["control", "check"]);
  const point = select(names);
  const [north, east, depth] = [figure(), figure(), figure()];
  const [from, to, length] = [select(names), select(names), figure()];
  const sigma = figure("0.01");
  const title = el("input", {type: "text", value: "bar 1", maxlength: "100"});
  const ofPoint = el("div", {}, field("Point", point),
    el("div", {class: "row"}, field("North, m", north), field("East, m", east),
      field("Depth, m", depth)));
  const ofBar = el("div", {hidden: true}, field("Name of the length", title),
    el("div", {class: "row"}, field("From", from), field("To", to), field("Length, m", length)));
  kind.addEventListener("change", () => {
    ofPoint.hidden = kind.value !== "point";
    ofBar.hidden = kind.value === "point";
  });
  const rowOf = () => (kind.value === "point" ? {
    kind: "point", name: point.value, use: use.value, north_m: north.value, east_m: east.value,
      depth_m: depth.value, sigma_m: sigma.value,
  } : {
    kind: "bar", name: title.value.trim(), use: use.value, from: from.value, to: to.value,
      length_m: length.value, sigma_m: sigma.value,
  });
  return el("details", {}, el("summary", {}, "Add a known point or length"),
    names.length ? [
      el("div", {class: "row"}, field("Known is a", kind), field("Use as", use)), ofPoint, ofBar,
      field("Sigma, m", sigma), el("div", {class: "buttons"},
        button("Save to control.csv", () => save(rowOf()), {class: "primary"})),
    ] : el("p", {class: "note"}, "Pick a point in the pictures first."));
}
