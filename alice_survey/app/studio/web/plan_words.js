/* The figures of a plan as words. */

import {COUNTS, PLAN} from "./palette.js";
import {counted, duration, share} from "./words.js";

const known = (value) => value !== null && value !== undefined && !Number.isNaN(value);
const rounded = (value, digits) => Number(value.toPrecision(digits)).toString().replace("-", "−");

/** @type {[string, (totals: any) => string | false][]} */
const ROWS = [
  ["Area", (t) => known(t.area_m2) && rounded(t.area_m2, 4) + " m²"],
  ["Covered", (t) => known(t.covered) && share(t.covered)],
  ["In stereo", (t) => known(t.stereo) && share(t.stereo)],
  ["At the requested overlap", (t) => known(t.at_overlap) && share(t.at_overlap)],
  ["Time", (t) => known(t.duration_s) && duration(t.duration_s)],
  ["Dives", (t) => known(t.dives) && String(t.dives)],
  ["Energy", (t) => known(t.energy_wh) && Math.round(t.energy_wh) + " Wh"],
  ["Longest dive", (t) => known(t.longest_dive_wh) && known(t.usable_wh)
    && Math.round(t.longest_dive_wh) + " of " + Math.round(t.usable_wh) + " Wh usable"],
  ["Way", (t) => known(t.length_m) && Math.round(t.length_m).toLocaleString("en") + " m"],
  ["Lines", (t) => known(t.lines) && t.lines.toLocaleString("en")
    + (known(t.line_spacing_m) ? ", " + rounded(t.line_spacing_m, 3) + " m apart" : "")],
  ["Pictures", (t) => known(t.pictures) && t.pictures.toLocaleString("en")
    + (known(t.interval_s) ? ", a pair each " + rounded(t.interval_s, 3) + " s" : "")],
  ["Data", (t) => known(t.data_gb) && rounded(t.data_gb, 3) + " GB"],
  ["Overlap forward, side", (t) => known(t.forward_overlap) && known(t.side_overlap)
    && Math.round(100 * t.forward_overlap) + " %, " + Math.round(100 * t.side_overlap) + " %"],
  ["Pixel on the sea floor", (t) => known(t.gsd_mm) && rounded(t.gsd_mm, 3) + " mm"],
  ["Sharp", (t) => known(t.sharp_from_m) && rounded(t.sharp_from_m, 3) + " m"
    + (known(t.sharp_to_m) ? " to " + rounded(t.sharp_to_m, 3) + " m" : " and beyond")],
  ["Exposure", (t) => known(t.exposure_s) && rounded(1000 * t.exposure_s, 3) + " ms"
    + (known(t.aperture) ? ", f/" + rounded(t.aperture, 2) : "")
    + (known(t.gain_db) ? ", gain " + rounded(t.gain_db, 2) + " dB" : "")],
];

/* [name, text] of each total that the plan has. */
export function totalRows(totals) {
  return ROWS.map(([name, text]) => [name, text(totals)]).filter(([, text]) => text);
}

/* [name, text] of the six that say most. */
export function keyFigures(t) {
  return [
    ["Time", duration(t.duration_s)], ["Dives", String(t.dives)],
      ["Energy", Math.round(t.energy_wh) + " Wh"],
    ["Pictures", t.pictures.toLocaleString("en")], ["Data", rounded(t.data_gb, 3) + " GB"],
      ["Covered", share(t.covered)],
  ];
}

/* One sentence for those who hear the page. */
export function summaryOf(preview) {
  if (!preview.ok) return "No plan: " + preview.error;
  const {totals: t, warnings, holes} = preview;
  return [
    counted(t.lines, "line") + ", " + duration(t.duration_s) + ", " + counted(t.dives, "dive"),
    counted(t.pictures, "picture"),
    share(t.covered) + " covered",
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
