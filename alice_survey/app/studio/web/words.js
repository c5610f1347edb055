/* Numbers, durations, shares and counts as people read them, and lines and ticks of charts. */

const MINUS = "−";
const NONE = "–";
const isKnown = (value) => value !== null && value !== undefined && !Number.isNaN(value);
const signed = (text) => text.replace("-", MINUS);
const withUnit = (text, unit) => text + (unit ? " " + unit : "");

/* A value to some digits: 1,234 m, 0.0123 m. */
export function number(value, unit = "", digits = 3) {
  if (!isKnown(value)) return "unknown";
  const size = Math.abs(value);
  const places = size === 0
    ? 0 : Math.min(9, Math.max(0, digits - 1 - Math.floor(Math.log10(size))));
  const text = value.toLocaleString(
    "en", {maximumFractionDigits: places, minimumFractionDigits: Math.min(places, 6)});
  return withUnit(signed(text), unit);
}

/* A value to the second digit of its sigma: 1.2345 ± 0.0012 m. */
export function withSigma(value, sigma, unit = "") {
  if (!(sigma > 0) || value === null) return number(value, unit, 4);
  const places = Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(sigma))));
  return withUnit(signed(value.toFixed(places)) + " ± " + sigma.toFixed(places), unit);
}

/* A value to some decimals: −0.25 m. */
export const fixed = (value, decimals, unit = "") =>
  (isKnown(value) ? withUnit(signed(value.toFixed(decimals)), unit) : "unknown");

/* "1 dive", "1,224 pictures". */
export const counted = (count, word, words = word + "s") =>
  count.toLocaleString("en") + " " + (count === 1 ? word : words);

/* "48 s", "12 min", "3.4 h". */
export function duration(seconds) {
  if (seconds < 99.5) return Math.max(0, Math.round(seconds)) + " s";
  if (seconds < 180 * 60) return Math.round(seconds / 60) + " min";
  return (seconds / 3600).toFixed(1) + " h";
}

/* "0:48", "12:03", "1:02:03", "−0:20". */
export function clock(seconds) {
  if (!isKnown(seconds)) return NONE;
  const whole = Math.floor(Math.abs(seconds));
  const pair = (value) => String(value).padStart(2, "0");
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  return (seconds <= -1 ? MINUS : "") + (hours ? hours + ":" + pair(minutes) : minutes) + ":"
    + pair(whole % 60);
}

/* How long ago a time of the clock was. */
export function ago(utc) {
  const seconds = (Date.now() - new Date(utc).getTime()) / 1000;
  if (seconds < 60) return "just now";
  if (seconds < 24 * 3600) return duration(seconds) + " ago";
  return new Date(utc).toLocaleDateString("en-GB",
    {day: "numeric", month: "short", year: "numeric"});
}

/* All of it is only what is all of it: 0.99996 is 99.99 %. */
export function share(value, decimals = 2) {
  if (!isKnown(value)) return NONE;
  if (value >= 1) return "100 %";
  const scale = 10 ** decimals;
  return Math.min(Math.round(100 * value * scale), 100 * scale - 1) / scale + " %";
}

export const gigabytes = (megabytes) => (megabytes < 1000
  ? number(megabytes, "MB", 2) : number(megabytes / 1000, "GB", 2));

/* The data of an SVG path through places; a value that is not known interrupts it. */
export function pathData(xs, ys) {
  let pen = "M";
  return xs.map((x, i) => {
    const known = ys[i] !== null;
    const text = known ? pen + x.toFixed(1) + " " + ys[i].toFixed(1) : "";
    pen = known ? "L" : "M";
    return text;
  }).join("");
}

/** Round values within limits, at most about so many, and the decimals that they need.
 * @type {(low: number, high: number, most: number) => [number[], number]} */
export const ticks = (low, high, most) => {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough * (1 - 1e-9));
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  return [Array.from({length: count}, (_, i) => (first + i) * step),
    Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
};
