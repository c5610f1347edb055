/* Places and values along a way and in time, and the lines of a profile. */

/* The index of the value nearest to one, in an ascending list. */
export function nearestIndex(values, value) {
  let [low, high] = [0, values.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (values[middle] <= value) low = middle;
    else high = middle;
  }
  return value - values[low] <= values[high] - value ? low : high;
}

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

/* The place of a sample of a profile, on the route of its dive; dives count from 1. */
export function profilePlace(profile, routes, i) {
  const dive = profile.dive[i];
  return placeAlong(routes[dive - 1] || [], profile.s_m[i] - profile.s_m[profile.dive.indexOf(dive)]);
}

/* State of a dive at a time: values between those of two samples, heading the shorter way round. */
export function stateAt(dive, time) {
  const times = dive.t_s;
  let i = nearestIndex(times, time);
  if (times[i] > time && i > 0) i -= 1;
  const next = Math.min(i + 1, times.length - 1);
  const span = times[next] - times[i];
  const t = span > 0 ? Math.min(1, Math.max(0, (time - times[i]) / span)) : 0;
  const between = (values) => values[i] + t * (values[next] - values[i]);
  const turn = ((dive.heading_deg[next] - dive.heading_deg[i] + 540) % 360) - 180;
  return {
    n: between(dive.n), e: between(dive.e), depth: between(dive.depth_m), altitude: between(dive.altitude_m),
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
