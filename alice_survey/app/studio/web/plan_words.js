/* What a plan comes to, as words and as colours. */

import {COUNTS, PLAN} from "./palette.js";
import {counted, duration, number, share} from "./words.js";

/* [name, text] of the figures that say most. */
export function keyFigures(t) {
  return [
    ["Time", duration(t.duration_s)], ["Dives", String(t.dives)],
    ["Energy", Math.round(t.energy_wh) + " Wh"], ["Pictures", t.pictures.toLocaleString("en")],
    ["Data", number(t.data_gb, "GB")], ["At the overlap", share(t.at_overlap)],
  ];
}

/* One sentence for those who hear the page. */
export function summaryOf(preview) {
  if (!preview.ok) return "No plan: " + preview.error;
  const {totals: t, warnings, holes} = preview;
  return [
    counted(t.lines, "line") + ", " + duration(t.duration_s) + ", " + counted(t.dives, "dive"),
    counted(t.pictures, "picture"), share(t.at_overlap) + " of the area at the requested overlap",
    ...(holes.length ? [counted(holes.length, "hole")] : []),
    ...(warnings.length ? [counted(warnings.length, "warning")] : []),
  ].join(", ");
}

const OUTSIDE = 255;

/* Pixels of the picture of counts as they are shown: red pictures, green lines, blue 1 at the
   requested overlap. Returns the greatest count; writes the colours into `data`, four bytes a
   pixel. */
export function paintCounts(data) {
  const counts = [];
  for (let i = 0; i < data.length; i += 4) if (data[i] !== OUTSIDE) counts.push(data[i]);
  counts.sort((a, b) => a - b);
  const most = Math.max(1, counts[Math.round(0.99 * (counts.length - 1))] || 1);
  const channels = (colour) => [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  const [ramp, missed] = [COUNTS.map(channels), channels(PLAN.missed)];
  for (let i = 0; i < data.length; i += 4) {
    const outside = data[i] === OUTSIDE;
    const step = Math.min(COUNTS.length - 1, Math.floor(data[i] / most * (COUNTS.length - 1)));
    const colour = data[i + 2] ? ramp[step] : missed;
    data.set([...colour, outside ? 0 : data[i + 2] ? 215 : 190], i);
  }
  return most;
}
