/* Lines and ticks of charts. */

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
