/* A chart of values along a way or over time. */

import {el} from "./core.js";
import {pathData, ticks} from "./words.js";

const [WIDE, LEFT, RIGHT, ABOVE, BELOW] = [340, 46, 8, 8, 30];

/* Lines are [{kind, xs, ys, sigmas, ground}]: `kind` is its class in studio.css, sigmas give it a
   band, a ground is filled below it. `downwards` lets them grow downwards, as depths do; `rules`
   are places that get an upright line. */
export function profileChart(label, {lines, downwards = false, caption, rules = [], high = 150}) {
  const [start, end] = [lines[0].xs[0], lines[0].xs.at(-1)];
  const [low, most] = rangeOf(lines);
  const base = high - BELOW;
  const x = (value) => LEFT + (value - start) / (end - start || 1) * (WIDE - LEFT - RIGHT);
  const y = (value) => (Number.isFinite(value) ? ABOVE + (base - ABOVE)
    * (downwards ? value - low : most - value) / (most - low) : null);
  const text = (value, digits) => value.toFixed(digits).replace("-", "−");
  const [ups, upDigits] = ticks(low, most, Math.round(high / 34));
  const [rights, rightDigits] = ticks(start, end, 5);
  const rows = ups.flatMap((value) => [
    el("line", {class: "grid", x1: LEFT, x2: WIDE - RIGHT, y1: y(value), y2: y(value)}),
    el("text", {x: LEFT - 5, y: y(value) + 4, "text-anchor": "end"}, text(value, upDigits))]);
  const columns = rights.map((value) =>
    el("text", {x: Math.min(x(value), WIDE - 14), y: base + 14, "text-anchor": "middle"},
      text(value, rightDigits)));
  const drawn = lines.flatMap(({kind, xs, ys, sigmas, ground}) => {
    const at = xs.map(x);
    const line = pathData(at, ys.map(y));
    return [
      ground ? el("path", {class: "ground " + kind, d: `${line}L${at.at(-1)} ${base}L${at[0]} ${
        base}Z`}) : null,
      sigmas ? bands(ys, sigmas).map((band) => el("polygon", {class: "band",
        points: band.map(([i, value]) => at[i].toFixed(1) + "," + y(value).toFixed(1)).join(" ")}))
        : null,
      el("path", {class: "of " + kind, d: line})];
  });
  const svg = el("svg", {viewBox: `0 0 ${WIDE} ${high}`, role: "img", "aria-label": label},
    rows, columns,
    el("text", {x: WIDE - RIGHT, y: high - 3, "text-anchor": "end"}, caption),
    rules.map((value) => el("line", {class: "rule", x1: x(value), x2: x(value), y1: ABOVE,
      y2: base})), drawn);
  return el("div", {class: "profile-chart"}, svg);
}

/* Outlines [index, value] of the band of one sigma, one for each piece that is known. */
function bands(ys, sigmas) {
  const pieces = [];
  ys.forEach((value, i) => {
    if (!Number.isFinite(value)) return;
    if (pieces.at(-1)?.at(-1) === i - 1) pieces.at(-1).push(i);
    else pieces.push([i]);
  });
  const side = (piece, sign) => piece.map((i) => [i, ys[i] + sign * (sigmas[i] || 0)]);
  return pieces.map((piece) => [...side(piece, 1), ...side(piece, -1).reverse()]);
}

function rangeOf(lines) {
  const values = lines.flatMap(({ys, sigmas}) => ys.flatMap((value, i) => (
    Number.isFinite(value) ? [value - (sigmas?.[i] || 0), value + (sigmas?.[i] || 0)] : [])));
  if (!values.length) return [0, 1];
  const [low, most] = [values.reduce((a, b) => Math.min(a, b)),
    values.reduce((a, b) => Math.max(a, b))];
  const margin = 0.05 * (most - low) || 0.1;
  return [low - margin, most + margin];
}
