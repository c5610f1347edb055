/* A chart of values along a way or over time. With `describe`, the pointer and the arrow keys
   move a mark along it, and its text is shown below and said. */

import {el} from "./core.js";
import {pathData, ticks} from "./way.js";

const [WIDE, LEFT, RIGHT, ABOVE, BELOW] = [340, 46, 8, 8, 30];

/* `describe(x)` returns the text of a place, `pointed(x)` shows it elsewhere, and gets null
   where the pointer has gone. */
export function profileChart(label, {describe = null, pointed = (_) => {}, high = 150} = {}) {
  const svg = el("svg", {viewBox: `0 0 ${WIDE} ${high}`, role: describe ? "slider" : "img",
    tabindex: describe ? "0" : null, "aria-label": label});
  const readout = el("p", {class: "note"});
  const element = el("div", {class: "profile-chart", hidden: true}, svg, describe ? readout : null);
  let [start, end, at] = [0, 1, 0];

  const x = (value) => LEFT + (value - start) / (end - start || 1) * (WIDE - LEFT - RIGHT);

  /* Lines are [{kind, xs, ys, sigmas, ground}]: `kind` is its class in studio.css, sigmas give
     it a band, a ground is filled below it. `range` is of the values; `downwards` lets them grow
     downwards, as depths do; `rules` are places that get an upright line. */
  function show({lines, range = null, downwards = false, caption, rules = []}) {
    element.hidden = false;
    const xs = lines.flatMap((line) => [line.xs[0], line.xs.at(-1)]).filter(Number.isFinite);
    [start, end] = [Math.min(...xs), Math.max(...xs)];
    const [low, most] = range || rangeOf(lines);
    const base = high - BELOW;
    const y = (value) => ABOVE + (base - ABOVE) * (downwards ? value - low : most - value) / (
      most - low);
    const [ups, upDigits] = ticks(low, most, Math.round(high / 34));
    const [rights, rightDigits] = ticks(start, end, 5);
    const text = (value, digits) => value.toFixed(digits).replace("-", "−");
    svg.replaceChildren(
      ...ups.flatMap((value) =>
        [el("line", {class: "grid", x1: LEFT, x2: WIDE - RIGHT, y1: y(value), y2: y(value)}),
        el("text", {x: LEFT - 5, y: y(value) + 4, "text-anchor": "end"}, text(value, upDigits))]),
      ...rights.map((value) =>
        el("text", {x: Math.min(x(value), WIDE - 14), y: base + 14, "text-anchor": "middle"},
        text(value, rightDigits))),
      el("text", {x: WIDE - RIGHT, y: high - 3, "text-anchor": "end"}, caption),
      ...rules.map((value) =>
        el("line", {class: "rule", x1: x(value), x2: x(value), y1: ABOVE, y2: base})),
      ...lines.flatMap((line) => drawn(line, line.xs.map(x), y, base)),
      el("line", {class: "mark", y1: ABOVE, y2: base, visibility: "hidden"}),
    );
    at = Math.min(Math.max(at, start), end);
    if (describe) said();
  }

  function drawn({kind, ys, sigmas, ground}, xs, y, base) {
    const known = ys.map((value) => (Number.isFinite(value) ? y(value) : null));
    const parts = [el("path", {class: "of " + kind, d: pathData(xs, known)})];
    if (sigmas) parts.unshift(...bands(xs, ys, sigmas, y));
    if (ground) parts.unshift(
      el("path", {class: "ground " + kind, d: pathData(xs, known)
      && `${pathData(xs, known)}L${xs.at(-1)} ${base}L${xs[0]} ${base}Z`}));
    return parts;
  }

  /* One for each piece of a line whose values are known. */
  function bands(xs, ys, sigmas, y) {
    const pieces = [];
    ys.forEach((value, i) => {
      if (!Number.isFinite(value)) return;
      if (!pieces.length || pieces.at(-1).at(-1) !== i - 1) pieces.push([]);
      pieces.at(-1).push(i);
    });
    const corner = (i, sign) => xs[i].toFixed(1) + "," + y(ys[i] + sign * (sigmas[i] || 0)).toFixed(
      1);
    return pieces.map((piece) => el("polygon", {
      class: "band", points: [...piece.map((i) => corner(i, 1)), ...[...piece].reverse().map(
        (i) => corner(i, -1))].join(" "),
    }));
  }

  function said() {
    const text = describe(at);
    readout.textContent = text;
    Object.entries({"aria-valuemin": start, "aria-valuemax": end, "aria-valuenow": at,
      "aria-valuetext": text}).forEach(
      ([name, value]) => svg.setAttribute(name,
        typeof value === "number" ? String(Number(value.toFixed(3))) : value),
    );
  }

  function move(to) {
    at = Math.max(start, Math.min(end, to));
    const mark = svg.querySelector(".mark");
    mark.setAttribute("visibility", "visible");
    ["x1", "x2"].forEach((name) => mark.setAttribute(name, x(at)));
    said();
    pointed(at);
  }

  function away() {
    svg.querySelector(".mark")?.setAttribute("visibility", "hidden");
    pointed(null);
  }

  function typed(event) {
    const step = (end - start) / 100;
    const to = {
      ArrowRight: at + step, ArrowUp: at + step, ArrowLeft: at - step, ArrowDown: at - step,
        Home: start, End: end,
      PageUp: at + 10 * step, PageDown: at - 10 * step,
    }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    move(to);
  }

  if (describe) {
    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect();
      const right = (event.clientX - box.left) / box.width * WIDE;
      move(start + (right - LEFT) / (WIDE - LEFT - RIGHT) * (end - start));
    });
    svg.addEventListener("pointerleave", away);
    svg.addEventListener("blur", away);
    svg.addEventListener("keydown", typed);
  }

  function clear() {
    element.hidden = true;
    pointed(null);
  }
  return {element, show, move, clear};
}

function rangeOf(lines) {
  let [low, most] = [Infinity, -Infinity];
  lines.forEach(({ys, sigmas}) => ys.forEach((value, i) => {
    if (!Number.isFinite(value)) return;
    const reach = sigmas?.[i] || 0;
    [low, most] = [Math.min(low, value - reach), Math.max(most, value + reach)];
  }));
  if (low > most) return [0, 1];
  const margin = 0.06 * (most - low) || 0.05;
  return [low - margin, most + margin];
}
