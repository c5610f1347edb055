/* Places and values along a way and in time, and the lines of a profile. */

/* The place at a length along points; the ends where the length is beyond them. */
export function placeAlong(points, length) {
  let left = length;
  for (let i = 1; i < points.length; i += 1) {
    const [[n0, e0], [n1, e1]] = [points[i - 1], points[i]];
    const step = Math.hypot(n1 - n0, e1 - e0);
    if (left <= step && step > 0) {
      const t = Math.max(0, left / step);
      return [n0 + t * (n1 - n0), e0 + t * (e1 - e0)];
    }
    left -= step;
  }
  return points[points.length - 1] || null;
}

/* Lengths that grow over all dives, whether or not those of each begin at zero. */
export function growing(lengths) {
  let offset = 0;
  return lengths.map((length, i) => {
    if (i && length < lengths[i - 1]) offset += lengths[i - 1];
    return length + offset;
  });
}

/* What a profile has at a length along all dives: the dive, depths between those of two samples,
   and the place on the route of the dive; dives count from 1. */
export function profileAt(profile, routes, along, length) {
  let i = Math.min(Math.max(0, countUpTo(along, length) - 1), along.length - 1);
  if (i === along.length - 1 && i > 0) i -= 1;
  const span = along[i + 1] - along[i];
  const t = span > 0 ? Math.min(1, Math.max(0, (length - along[i]) / span)) : 0;
  const dive = profile.dive[t < 1 ? i : i + 1];
  return {
    dive,
    floor: between(profile.floor_depth_m, i, t),
    vehicle: between(profile.vehicle_depth_m, i, t),
    place: placeAlong(routes[dive - 1] || [], length - along[profile.dive.indexOf(dive)]),
  };
}

/* A value between that at i and the next; NaN where one of both is not known. */
function between(values, i, t) {
  const [start, end] = [values[i], values[Math.min(i + 1, values.length - 1)]];
  return start === null || end === null ? NaN : start + t * (end - start);
}

/* State of a dive at a time: values between those of two samples, heading the shorter way round. */
export function stateAt(dive, time) {
  const times = dive.t_s;
  const i = Math.max(0, countUpTo(times, time) - 1);
  const next = Math.min(i + 1, times.length - 1);
  const span = times[next] - times[i];
  const t = span > 0 ? Math.min(1, Math.max(0, (time - times[i]) / span)) : 0;
  const now = (values) => between(values, i, t);
  const turn = ((dive.heading_deg[next] - dive.heading_deg[i] + 540) % 360) - 180;
  return {
    n: now(dive.n), e: now(dive.e), depth: now(dive.depth_m), altitude: now(dive.altitude_m),
    heading: (dive.heading_deg[i] + t * turn + 360) % 360, index: i,
  };
}

/* How many of ascending values are not above one. */
export function countUpTo(values, value) {
  let [low, high] = [0, values.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low;
}

/* The data of an SVG path through places; a value that is not known interrupts it. */
export function pathData(xs, ys) {
  let pen = "M";
  return xs.map((x, i) => {
    if (ys[i] === null || !Number.isFinite(ys[i])) {
      pen = "M";
      return "";
    }
    const text = pen + x.toFixed(1) + " " + ys[i].toFixed(1);
    pen = "L";
    return text;
  }).join("");
}

/** Round values within limits, at most about so many, and the decimals that they need.
 * @type {(low: number, high: number, most: number) => [number[], number]} */
export const ticks = (low, high, most) => {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough * (1 - 1e-9));
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9) * step; at <= high + 1e-9 * step;
    at += step) found.push(at);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
};
