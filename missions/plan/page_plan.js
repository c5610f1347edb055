"use strict";
/* A plan's map, part 1 of 4: places, lines and cells, without a browser. No library, no network.
   Places are metres north and east of the datum; the data hold millimetres. */

const COLOURS = {
  survey: "#1b4f72", cross: "#6c3483", closing: "#117a65", fill: "#b9770e",
  area: "#c8553d", allowed: "#566573", no_go: "#b03a2e", way: "#7f8c8d", foot: "#2e86c1",
  contour: "#5d6d7e", current: "#2471a3", missed: "#d35400", measure: "#8e44ad", home: "#1e8449",
};
const RAMP = ["#f7fcf0", "#ddf1d9", "#bfe6c4", "#93d3c0", "#60bbc8", "#3597c1", "#1474b0", "#084c8d"];
const MOST_FOOTPRINTS = 6000;  /* drawn one by one; more are drawn as the band they make */
const NEAR_PX = 14;

function geodetic(geo, n, e) {
  const terms = [1, n, e, n * n, n * e, e * e];
  const sum = (c) => terms.reduce((total, term, i) => total + c[i] * term, 0);
  return [sum(geo.lat), sum(geo.lon)];
}

function degrees(value, ahead, astern) {
  return Math.abs(value).toFixed(7) + "° " + (value < 0 ? astern : ahead);
}

function latLon(geo, n, e) {
  const [lat, lon] = geodetic(geo, n, e);
  return degrees(lat, "N", "S") + "  " + degrees((lon + 540) % 360 - 180, "E", "W");
}

/* 1, 2 or 5 times a power of ten, not above a length. */
function roundLength(length) {
  const power = Math.pow(10, Math.floor(Math.log10(length)));
  return [5, 2, 1].map((step) => step * power).find((value) => value <= length * (1 + 1e-9));
}

function metres(length) {
  if (length >= 1000) return (length / 1000).toFixed(length < 1e4 ? 2 : 1) + " km";
  return (length < 10 ? length.toFixed(2) : length.toFixed(1)) + " m";
}

function bearing(a, b) {
  return (Math.atan2(b[1] - a[1], b[0] - a[0]) * 180 / Math.PI + 360) % 360;
}

/* The line nearest to a place and the station of it, or null where none is within a distance. */
function nearest(lines, n, e, within, shown) {
  let best = null;
  let least = within * within;
  lines.forEach((line, index) => {
    if (shown && !shown(line)) return;
    const dn = line.n1 - line.n0;
    const de = line.e1 - line.e0;
    const square = dn * dn + de * de;
    const along = square > 0 ? ((n - line.n0) * dn + (e - line.e0) * de) / square : 0;
    const t = Math.min(1, Math.max(0, along));
    const off = (line.n0 + t * dn - n) ** 2 + (line.e0 + t * de - e) ** 2;
    if (off < least) {
      least = off;
      best = {index, line, station: line.stations > 1 ? Math.round(t * (line.stations - 1)) : 0};
    }
  });
  return best;
}

function stationAt(line, i) {
  const t = line.stations > 1 ? i / (line.stations - 1) : 0;
  return [line.n0 + t * (line.n1 - line.n0), line.e0 + t * (line.e1 - line.e0)];
}

/* Cell of the grid of counts that holds a place: [row, column], or null beyond it. */
function cellOf(grid, n, e) {
  const dn = n - grid.origin[0];
  const de = e - grid.origin[1];
  const c = Math.cos(grid.heading);
  const s = Math.sin(grid.heading);
  const row = Math.floor((dn * c + de * s) / grid.cell);
  const column = Math.floor((de * c - dn * s) / grid.cell);
  return row >= 0 && column >= 0 && row < grid.rows && column < grid.columns ? [row, column] : null;
}

function pairs(flat) {
  const points = [];
  for (let i = 0; i + 1 < flat.length; i += 2) points.push([flat[i] / 1000, flat[i + 1] / 1000]);
  return points;
}

function unpack(data) {
  let first = 0;
  const lines = data.lines.map(([kind, n0, e0, n1, e1, stations, dive]) => {
    const line = {
      kind: data.kinds[kind], n0: n0 / 1000, e0: e0 / 1000, n1: n1 / 1000, e1: e1 / 1000,
      stations, dive, first,
    };
    line.length = Math.hypot(line.n1 - line.n0, line.e1 - line.e0);
    line.heading = Math.atan2(line.e1 - line.e0, line.n1 - line.n0);
    first += stations;
    return line;
  });
  const areas = {};
  Object.keys(data.areas).forEach((name) => {
    areas[name] = data.areas[name].map((polygon) => polygon.map(pairs));
  });
  return {
    ...data, lines, areas, routes: data.routes.map(pairs), outline: pairs(data.outline),
    contours: data.contours.map((c) => ({depth: c.depth, paths: c.paths.map(pairs)})),
  };
}

if (typeof module !== "undefined") {
  module.exports = {geodetic, latLon, roundLength, metres, bearing, nearest, stationAt, cellOf, unpack};
}
