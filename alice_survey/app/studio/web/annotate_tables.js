/* Tables of the Annotate tab: annotations one by one, and what labels cover. */

import {button, download, el, table} from "./core.js";
import {counted, csv, number, withSigma} from "./words.js";

const MAX_ROWS = 100;
const MAX_LINES = 5;
const WHOLE = 0.999;  /* share of a known surface from which on it counts as all */

/* Area of the surface and rugosity of a row of the server's tables; empty where there are none. */
export function surfaceCells(row, unit = "") {
  if (!row || row.surface === null) return ["", ""];
  const part = row.surface_known < WHOLE ? " (of " + number(100 * row.surface_known, "%", 2) + ")" : "";
  return [withSigma(row.surface, row.surface_sigma, unit) + part, withSigma(row.rugosity, row.rugosity_sigma)];
}

function scrolled(name, ...children) {
  return el("div", {style: {overflowX: "auto"}, tabindex: "0", role: "region", "aria-label": name}, ...children);
}

function csvOf(name, rows) {
  const keys = Object.keys(rows[0]);
  return () => download(name, csv(keys, rows.map((row) => keys.map((key) => row[key]))), "text/csv");
}

/* `ones` are the annotations to list, `mark(one)` its plan, `surface(one)` its row of surfaces, `name(one)` the
   button that chooses it, and `rows` all rows of surfaces, or null while they are not there. */
export function annotationTable(ones, {unit, mark, surface, name, rows}) {
  const square = unit + "²";
  const lines = ones.slice(0, MAX_ROWS).map((one) => {
    const plan = mark(one);
    const size = plan && plan.area !== null ? withSigma(plan.area, plan.sigma)
      : plan && plan.length !== null ? number(plan.length, unit, 4) : "";
    return [name(one), size, ...surfaceCells(surface(one)), one.image === null ? one.shape.kind : one.shape.kind + ", picture"];
  });
  const more = ones.length > lines.length ? el("p", {class: "note"}, "The first " + MAX_ROWS + " of " + ones.length.toLocaleString("en") + ".") : null;
  const head = ["Label", "Area in plan, " + square, "Surface, " + square, "Rugosity", "Shape"];
  return [
    scrolled("Annotations one by one", table(counted(ones.length, "annotation"), head, lines)), more,
    el("p", {class: "buttons"}, button("Annotations as CSV", rows?.length ? csvOf("annotations.csv", rows) : null, {disabled: !rows?.length})),
  ].filter(Boolean);
}

/* What labels cover: `rows` of the server, `known` ground. */
export function coverTable(rows, known, unit) {
  const square = unit + "²";
  const side = rows[0]?.side;
  const lines = rows.map((row) => [
    ...(side ? [row.quadrat] : []), row.label, String(row.count), withSigma(row.area, row.sigma),
    withSigma(100 * row.cover, 100 * row.cover_sigma, "%"), ...surfaceCells(row),
  ]);
  const head = [...(side ? ["Quadrat"] : []), "Label", "Count", "Area in plan, " + square, "Cover", "Surface, " + square, "Rugosity"];
  return el("div", {}, scrolled("What labels cover", table("Of " + number(known, square) + " known ground", head, lines)),
    el("p", {class: "buttons"}, button("Cover as CSV", rows.length ? csvOf("cover.csv", rows) : null, {disabled: !rows.length})));
}

/* Lines of the server, the first of many. */
export function warnings(title, lines) {
  const shown = lines.slice(0, MAX_LINES).map((line) => el("p", {class: "warn"}, title + ": " + line));
  const left = lines.length - shown.length;
  return left ? [...shown, el("p", {class: "warn"}, title + ": " + left.toLocaleString("en") + " more")] : shown;
}
