/* The figures of a plan as words. */

const known = (value) => value !== null && value !== undefined && !Number.isNaN(value);
const plain = (value) => value.toString().replace("-", "−");
const rounded = (value, digits) => plain(Number(value.toPrecision(digits)));

/* "1 dive", "3 dives". */
export const counted = (count, word) => count.toLocaleString("en") + " " + word + (count === 1 ? "" : "s");

/* "48 s", "12 min", "3.4 h". */
export function durationOf(seconds) {
  if (seconds < 99.5) return Math.round(seconds) + " s";
  if (seconds < 180 * 60) return Math.round(seconds / 60) + " min";
  return (seconds / 3600).toFixed(1) + " h";
}

/* "0:48", "12:03", "1:02:03". */
export function clockOf(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  const pair = (value) => String(value).padStart(2, "0");
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  return (hours ? hours + ":" + pair(minutes) : minutes) + ":" + pair(whole % 60);
}

/* All of it is only what is all of it: 0.99996 is 99.99 %. */
export function shareOf(share, decimals = 2) {
  if (share >= 1) return "100 %";
  const scale = 10 ** decimals;
  return (Math.min(Math.round(100 * share * scale), 100 * scale - 1) / scale).toString() + " %";
}

const ROWS = [
  ["Area", (t) => known(t.area_m2) && rounded(t.area_m2, 4) + " m²"],
  ["Covered", (t) => known(t.covered) && shareOf(t.covered)],
  ["At the requested overlap", (t) => known(t.at_overlap) && shareOf(t.at_overlap)],
  ["Time", (t) => known(t.duration_s) && durationOf(t.duration_s)],
  ["Dives", (t) => known(t.dives) && String(t.dives)],
  ["Energy", (t) => known(t.energy_wh) && Math.round(t.energy_wh) + " Wh"
    + (known(t.usable_wh) ? " of " + Math.round(t.usable_wh) + " Wh usable a dive" : "")],
  ["Way", (t) => known(t.length_m) && Math.round(t.length_m).toLocaleString("en") + " m"],
  ["Lines", (t) => known(t.lines) && t.lines.toLocaleString("en")
    + (known(t.line_spacing_m) ? ", " + rounded(t.line_spacing_m, 3) + " m apart" : "")],
  ["Pictures", (t) => known(t.pictures) && t.pictures.toLocaleString("en")
    + (known(t.interval_s) ? ", a pair each " + rounded(t.interval_s, 3) + " s" : "")],
  ["Data", (t) => known(t.data_gb) && rounded(t.data_gb, 3) + " GB"],
  ["Overlap forward, side", (t) => known(t.forward_overlap) && known(t.side_overlap)
    && Math.round(100 * t.forward_overlap) + " %, " + Math.round(100 * t.side_overlap) + " %"],
  ["Pixel on the sea floor", (t) => known(t.gsd_mm) && rounded(t.gsd_mm, 3) + " mm"],
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
    ["Time", durationOf(t.duration_s)], ["Dives", String(t.dives)], ["Energy", Math.round(t.energy_wh) + " Wh"],
    ["Pictures", t.pictures.toLocaleString("en")], ["Data", rounded(t.data_gb, 3) + " GB"], ["Covered", shareOf(t.covered)],
  ];
}

/* One sentence for those who hear the page. */
export function summaryOf(preview) {
  if (!preview.ok) return "No plan: " + preview.error;
  const {totals: t, warnings, holes} = preview;
  return [
    counted(t.lines, "line") + ", " + durationOf(t.duration_s) + ", " + counted(t.dives, "dive"),
    counted(t.pictures, "picture"),
    shareOf(t.covered) + " covered",
    ...(holes.length ? [counted(holes.length, "hole")] : []),
    ...(warnings.length ? [counted(warnings.length, "warning")] : []),
  ].join(", ");
}

/* The colour of a number of pictures, light to dark, and of what lacks overlap. */
const RAMP = ["#f7fcf0", "#ddf1d9", "#bfe6c4", "#93d3c0", "#60bbc8", "#3597c1", "#1474b0", "#084c8d"];
const MISSED = "#d35400";
const OUTSIDE = 255;

/* Pixels of the picture of counts as they are shown: red pictures, green lines, blue 1 at the
   requested overlap. Returns the greatest count; writes the colours into `data`, four bytes a pixel. */
export function paintCounts(data) {
  const counts = [];
  for (let i = 0; i < data.length; i += 4) if (data[i] !== OUTSIDE) counts.push(data[i]);
  counts.sort((a, b) => a - b);
  const most = Math.max(1, counts[Math.round(0.99 * (counts.length - 1))] || 1);
  const channels = (colour) => [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  const [ramp, missed] = [RAMP.map(channels), channels(MISSED)];
  for (let i = 0; i < data.length; i += 4) {
    const outside = data[i] === OUTSIDE;
    const step = Math.min(RAMP.length - 1, Math.floor(data[i] / most * (RAMP.length - 1)));
    const colour = data[i + 2] ? ramp[step] : missed;
    data.set([...colour, outside ? 0 : data[i + 2] ? 215 : 190], i);
  }
  return most;
}

export const COUNT_COLOURS = RAMP;
export const MISSED_COLOUR = MISSED;
