"use strict";
/* The map of a plan: pan, zoom, layers, what is under the pointer, distances. No library, no network.
   Places are metres north and east of the datum; the data hold millimetres. */

const COLOURS = {
  survey: "#1b4f72", cross: "#6c3483", closing: "#117a65", fill: "#b9770e",
  area: "#c8553d", allowed: "#566573", no_go: "#b03a2e", way: "#7f8c8d", foot: "#2e86c1",
  contour: "#5d6d7e", current: "#2471a3", missed: "#d35400", measure: "#8e44ad", home: "#1e8449",
};
const RAMP = ["#f7fcf0", "#ddf1d9", "#bfe6c4", "#93d3c0", "#60bbc8", "#3597c1", "#1474b0", "#084c8d"];
const MOST_FOOTPRINTS = 6000;  /* drawn one by one; more are drawn as the band they make */
const NEAR_PX = 14;

/* ---- What needs no browser ---------------------------------------------------------------- */

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

/* ---- The page ------------------------------------------------------------------------------ */

function start() {
  const $ = (id) => document.getElementById(id);
  const data = unpack(JSON.parse($("data").textContent));
  const canvas = $("map");
  const ctx = canvas.getContext("2d");
  const tip = $("tip");
  const read = $("read");
  const layers = {};
  const dives = new Set(data.routes.map((_, i) => i + 1));
  const view = {n: 0, e: 0, scale: 1, width: 1, height: 1, ratio: 1};
  let measuring = false;
  let measured = [];
  let pointer = null;  /* where it is: [n, e] */
  let hovered = null;
  let counts = null;   /* {image, pictures, lines, grid} once decoded */
  let waiting = false;

  const x = (e) => view.width / 2 + (e - view.e) * view.scale;
  const y = (n) => view.height / 2 - (n - view.n) * view.scale;
  const place = (px, py) => [
    view.n - (py - view.height / 2) / view.scale, view.e + (px - view.width / 2) / view.scale,
  ];
  const shown = (line) => layers[line.kind] && dives.has(line.dive);

  function fit() {
    const [n0, e0, n1, e1] = data.extent;
    view.n = (n0 + n1) / 2;
    view.e = (e0 + e1) / 2;
    const wide = Math.max(e1 - e0, 0.5);
    const high = Math.max(n1 - n0, 0.5);
    /* Room for the buttons on the left and for scale and readout below. */
    view.scale = Math.min((view.width - 130) / wide, (view.height - 120) / high);
    view.n -= 18 / view.scale;
  }

  function zoom(factor, px, py) {
    const [n, e] = place(px, py);
    view.scale = Math.min(20000, Math.max(view.least, view.scale * factor));
    view.e = e - (px - view.width / 2) / view.scale;
    view.n = n + (py - view.height / 2) / view.scale;
    draw();
  }

  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      paint();
    });
  }

  function paint() {
    ctx.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
    ctx.fillStyle = "#fbfcfc";
    ctx.fillRect(0, 0, view.width, view.height);
    const grid = gridValues();
    if (layers.grid) paintGrid(grid);
    if (counts && (layers.counts || layers.missed)) paintCounts();
    if (layers.contours) paintContours();
    if (layers.foot) paintFootprints();
    if (layers.allowed) paintArea("allowed", {dash: [2, 4], width: 1.2});
    if (layers.no_go) paintArea("no_go", {fill: "rgba(231,76,60,.20)", width: 1.2, hatch: true});
    if (layers.way) data.routes.forEach((way, i) => {
      if (dives.has(i + 1)) stroke(way, COLOURS.way, 1.1);
    });
    paintLines();
    if (layers.area) paintArea("survey", {colour: COLOURS.area, width: 2.2, dash: [8, 4]});
    paintHome();
    paintHover();
    if (layers.grid) paintGridLabels(grid);
    paintMeasure();
    paintFurniture();
  }

  function trace(points, closed) {
    points.forEach(([n, e], i) => (i ? ctx.lineTo(x(e), y(n)) : ctx.moveTo(x(e), y(n))));
    if (closed) ctx.closePath();
  }

  function stroke(points, colour, width, dash) {
    ctx.beginPath();
    trace(points, false);
    ctx.strokeStyle = colour;
    ctx.lineWidth = width;
    ctx.lineJoin = "round";
    ctx.setLineDash(dash || []);
    ctx.stroke();
    ctx.setLineDash([]);
  }

  function paintArea(name, style) {
    data.areas[name].forEach((rings) => {
      ctx.beginPath();
      rings.forEach((ring) => trace(ring, true));
      if (style.fill) {
        ctx.fillStyle = style.fill;
        ctx.fill("evenodd");
      }
      if (style.hatch) {
        ctx.save();
        ctx.clip("evenodd");
        hatch(rings[0]);
        ctx.restore();
      }
      ctx.beginPath();
      rings.forEach((ring) => trace(ring, true));
      ctx.strokeStyle = style.colour || COLOURS[name];
      ctx.lineWidth = style.width;
      ctx.setLineDash(style.dash || []);
      ctx.stroke();
      ctx.setLineDash([]);
    });
  }

  function hatch(ring) {
    const xs = ring.map(([, e]) => x(e));
    const ys = ring.map(([n]) => y(n));
    const left = Math.max(Math.min(...xs), 0);
    const right = Math.min(Math.max(...xs), view.width);
    const top = Math.max(Math.min(...ys), 0);
    const bottom = Math.min(Math.max(...ys), view.height);
    ctx.beginPath();
    for (let at = left - (bottom - top); at < right; at += 8) {
      ctx.moveTo(at, bottom);
      ctx.lineTo(at + bottom - top, top);
    }
    ctx.strokeStyle = "rgba(176,58,46,.45)";
    ctx.lineWidth = 1;
    ctx.stroke();
  }

  /* The grid's values within view, and how to write them. */
  function gridValues() {
    const step = roundLength(110 / view.scale);
    const [high, left] = place(0, 0);
    const [low, right] = place(view.width, view.height);
    const digits = step < 1 ? (step < 0.1 ? 2 : 1) : 0;
    const between = (from, to) => {
      const values = [];
      for (let k = Math.ceil(from / step); k * step < to; k++) values.push(k * step);
      return values;
    };
    return {norths: between(low, high), easts: between(left, right), digits};
  }

  function paintGrid({norths, easts}) {
    ctx.strokeStyle = "#e6ebee";
    ctx.lineWidth = 1;
    ctx.beginPath();
    easts.forEach((e) => {
      ctx.moveTo(Math.round(x(e)) + 0.5, 0);
      ctx.lineTo(Math.round(x(e)) + 0.5, view.height);
    });
    norths.forEach((n) => {
      ctx.moveTo(0, Math.round(y(n)) + 0.5);
      ctx.lineTo(view.width, Math.round(y(n)) + 0.5);
    });
    ctx.stroke();
  }

  function paintGridLabels({norths, easts, digits}) {
    ctx.font = "10.5px sans-serif";
    ctx.lineWidth = 3;
    ctx.lineJoin = "round";
    ctx.strokeStyle = "rgba(255,255,255,.85)";
    ctx.fillStyle = "#71808a";
    const write = (text, px, py) => {
      ctx.strokeText(text, px, py);
      ctx.fillText(text, px, py);
    };
    easts.forEach((e) => {
      if (x(e) > 60 && x(e) < view.width - 60) write(e.toFixed(digits) + " m E", x(e) + 3, 12);
    });
    norths.forEach((n) => {
      const text = n.toFixed(digits) + " m N";
      if (y(n) < 90 || y(n) > view.height - 44) return;
      write(text, view.width - ctx.measureText(text).width - 5, y(n) - 3);
    });
  }

  function paintCounts() {
    const {grid} = counts;
    const c = Math.cos(grid.heading) * grid.cell * view.scale * view.ratio;
    const s = Math.sin(grid.heading) * grid.cell * view.scale * view.ratio;
    /* Image columns go to the right of the grid's heading, image rows along it. */
    ctx.setTransform(
      c, s, s, -c, x(grid.origin[1]) * view.ratio, y(grid.origin[0]) * view.ratio,
    );
    ctx.imageSmoothingEnabled = false;
    if (layers.counts) ctx.drawImage(counts.image, 0, 0);
    if (layers.missed) ctx.drawImage(counts.missed, 0, 0);
    ctx.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
  }

  function paintContours() {
    ctx.font = "10.5px sans-serif";
    data.contours.forEach(({depth, paths}) => paths.forEach((path) => {
      stroke(path, "rgba(93,109,126,.75)", 0.9);
      const middle = path[Math.floor(path.length / 2)];
      const text = depth + " m";
      const wide = ctx.measureText(text).width;
      if (path.length < 6) return;
      ctx.fillStyle = "rgba(251,252,252,.8)";
      ctx.fillRect(x(middle[1]) - wide / 2 - 2, y(middle[0]) - 7, wide + 4, 13);
      ctx.fillStyle = COLOURS.contour;
      ctx.fillText(text, x(middle[1]) - wide / 2, y(middle[0]) + 4);
    }));
  }

  function inView(line, margin) {
    const [n1, e0] = place(-margin, -margin);
    const [n0, e1] = place(view.width + margin, view.height + margin);
    return Math.max(line.n0, line.n1) > n0 && Math.min(line.n0, line.n1) < n1
      && Math.max(line.e0, line.e1) > e0 && Math.min(line.e0, line.e1) < e1;
  }

  function paintFootprints() {
    const margin = 2 * data.across * view.scale;
    const lines = data.lines.filter((line) => shown(line) && inView(line, margin));
    const single = lines.reduce((sum, line) => sum + line.stations, 0) <= MOST_FOOTPRINTS
      && data.across * view.scale > 6;
    if (!single) {
      ctx.strokeStyle = "rgba(46,134,193,.16)";
      ctx.lineWidth = data.across * view.scale;
      lines.forEach((line) => {
        ctx.beginPath();
        ctx.moveTo(x(line.e0), y(line.n0));
        ctx.lineTo(x(line.e1), y(line.n1));
        ctx.stroke();
      });
      return;
    }
    ctx.fillStyle = layers.counts ? "rgba(46,134,193,.03)" : "rgba(46,134,193,.10)";
    ctx.strokeStyle = "rgba(46,134,193,.32)";
    ctx.lineWidth = 0.6;
    lines.forEach((line) => {
      const outline = footprint(line);
      for (let i = 0; i < line.stations; i++) {
        const [n, e] = stationAt(line, i);
        ctx.beginPath();
        trace(outline.map(([dn, de]) => [n + dn, e + de]), true);
        ctx.fill();
        ctx.stroke();
      }
    });
  }

  function footprint(line) {
    const c = Math.cos(line.heading);
    const s = Math.sin(line.heading);
    return data.outline.map(([ahead, right]) => [ahead * c - right * s, ahead * s + right * c]);
  }

  function paintLines() {
    const lines = data.lines.filter((line) => shown(line) && inView(line, 10));
    const arrows = lines.length <= 400;
    data.kinds.forEach((kind) => {
      if (!layers[kind]) return;
      ctx.beginPath();
      lines.forEach((line) => {
        if (line.kind !== kind) return;
        ctx.moveTo(x(line.e0), y(line.n0));
        ctx.lineTo(x(line.e1), y(line.n1));
      });
      ctx.strokeStyle = COLOURS[kind];
      /* Lines too close to be told apart become a light tint. */
      ctx.lineWidth = Math.min(1.7, Math.max(0.2, 0.3 * data.spacing * view.scale));
      ctx.stroke();
    });
    lines.forEach((line) => {
      ctx.fillStyle = COLOURS[line.kind];
      if (arrows && line.length * view.scale > 24) arrow(line);
      if (!layers.stations) return;
      const apart = line.stations > 1 ? line.length / (line.stations - 1) * view.scale : 99;
      if (apart < 6) return;  /* closer, they would hide the line */
      const size = Math.min(3.4, Math.max(1.3, apart / 7));
      for (let i = 0; i < line.stations; i++) {
        const [n, e] = stationAt(line, i);
        const px = x(e);
        const py = y(n);
        if (px < -5 || py < -5 || px > view.width + 5 || py > view.height + 5) continue;
        ctx.beginPath();
        ctx.arc(px, py, size, 0, 2 * Math.PI);
        ctx.fill();
      }
    });
  }

  function arrow(line) {
    const t = 0.36;
    const px = x(line.e0 + t * (line.e1 - line.e0));
    const py = y(line.n0 + t * (line.n1 - line.n0));
    ctx.save();
    ctx.translate(px, py);
    ctx.rotate(line.heading);
    ctx.beginPath();
    ctx.moveTo(0, -7);
    ctx.lineTo(4.6, 5);
    ctx.lineTo(0, 2.5);
    ctx.lineTo(-4.6, 5);
    ctx.closePath();
    ctx.fill();
    ctx.restore();
  }

  function paintHome() {
    const px = x(data.home[1] / 1000);
    const py = y(data.home[0] / 1000);
    ctx.beginPath();
    ctx.moveTo(px, py - 8);
    ctx.lineTo(px + 8, py);
    ctx.lineTo(px, py + 8);
    ctx.lineTo(px - 8, py);
    ctx.closePath();
    ctx.fillStyle = COLOURS.home;
    ctx.fill();
    ctx.strokeStyle = "#fff";
    ctx.lineWidth = 1.5;
    ctx.stroke();
  }

  function paintHover() {
    if (!hovered) return;
    const {line, station} = hovered;
    stroke([[line.n0, line.e0], [line.n1, line.e1]], "rgba(241,196,15,.75)", 4);
    const [n, e] = stationAt(line, station);
    ctx.beginPath();
    trace(footprint(line).map(([dn, de]) => [n + dn, e + de]), true);
    ctx.fillStyle = "rgba(241,196,15,.18)";
    ctx.fill();
    ctx.strokeStyle = "#b7950b";
    ctx.lineWidth = 1.2;
    ctx.stroke();
    ctx.beginPath();
    ctx.arc(x(e), y(n), 5, 0, 2 * Math.PI);
    ctx.fillStyle = "#f1c40f";
    ctx.fill();
    ctx.strokeStyle = "#7d6608";
    ctx.stroke();
  }

  function paintMeasure() {
    const points = measuring && pointer && measured.length ? [...measured, pointer] : measured;
    if (!points.length) return;
    stroke(points, "#fff", 4);
    stroke(points, COLOURS.measure, 2, [6, 3]);
    ctx.fillStyle = COLOURS.measure;
    points.forEach(([n, e]) => {
      ctx.beginPath();
      ctx.arc(x(e), y(n), 3.5, 0, 2 * Math.PI);
      ctx.fill();
    });
    ctx.font = "600 12px sans-serif";
    for (let i = 1; i < points.length; i++) {
      const [a, b] = [points[i - 1], points[i]];
      const text = metres(Math.hypot(b[0] - a[0], b[1] - a[1])) + "  " + bearing(a, b).toFixed(0) + "°";
      label(text, (x(a[1]) + x(b[1])) / 2, (y(a[0]) + y(b[0])) / 2 - 9, COLOURS.measure);
    }
  }

  function label(text, px, py, colour) {
    const wide = ctx.measureText(text).width;
    ctx.fillStyle = "rgba(255,255,255,.88)";
    ctx.fillRect(px - wide / 2 - 4, py - 10, wide + 8, 16);
    ctx.fillStyle = colour;
    ctx.fillText(text, px - wide / 2, py + 2);
  }

  function paintFurniture() {
    const bar = roundLength(view.width / 5 / view.scale);
    const wide = bar * view.scale;
    const left = 18;
    const low = view.height - 44;
    ctx.fillStyle = "rgba(255,255,255,.85)";
    ctx.fillRect(left - 8, low - 20, wide + 16, 32);
    ctx.fillStyle = "#1f2d36";
    ctx.fillRect(left, low, wide / 2, 5);
    ctx.strokeStyle = "#1f2d36";
    ctx.lineWidth = 1;
    ctx.strokeRect(left + 0.5, low + 0.5, wide - 1, 4);
    ctx.font = "600 12px sans-serif";
    const text = bar >= 1000 ? bar / 1000 + " km" : bar >= 1 ? bar + " m" : Math.round(bar * 100) + " cm";
    ctx.fillText(text, left + wide / 2 - ctx.measureText(text).width / 2, low - 5);
    north(view.width - 34, 46);
    if (data.current && layers.current) current(view.width - 92, 46);
  }

  function north(px, py) {
    ctx.fillStyle = "rgba(255,255,255,.85)";
    ctx.beginPath();
    ctx.arc(px, py, 25, 0, 2 * Math.PI);
    ctx.fill();
    ctx.fillStyle = "#1f2d36";
    ctx.beginPath();
    ctx.moveTo(px, py - 7);
    ctx.lineTo(px + 6, py + 17);
    ctx.lineTo(px, py + 12);
    ctx.lineTo(px - 6, py + 17);
    ctx.closePath();
    ctx.fill();
    ctx.font = "700 13px sans-serif";
    ctx.fillText("N", px - ctx.measureText("N").width / 2, py - 10);
  }

  function current(px, py) {
    ctx.fillStyle = "rgba(255,255,255,.85)";
    ctx.fillRect(px - 30, py - 25, 60, 58);
    ctx.save();
    ctx.translate(px, py - 4);
    ctx.rotate(data.current.towards_deg * Math.PI / 180);
    ctx.strokeStyle = ctx.fillStyle = COLOURS.current;
    ctx.lineWidth = 3;
    ctx.beginPath();
    ctx.moveTo(0, 16);
    ctx.lineTo(0, -8);
    ctx.stroke();
    ctx.beginPath();
    ctx.moveTo(0, -18);
    ctx.lineTo(7, -5);
    ctx.lineTo(-7, -5);
    ctx.closePath();
    ctx.fill();
    ctx.restore();
    ctx.font = "11px sans-serif";
    ctx.fillStyle = COLOURS.current;
    const text = data.current.mps + " m/s";
    ctx.fillText(text, px - ctx.measureText(text).width / 2, py + 28);
  }

  /* ---- Pointer and keys ---- */

  function readout() {
    const total = measured.slice(1).reduce(
      (sum, b, i) => sum + Math.hypot(b[0] - measured[i][0], b[1] - measured[i][1]), 0,
    );
    const parts = [];
    if (pointer) {
      parts.push(latLon(data.geo, pointer[0], pointer[1]));
      parts.push(pointer[0].toFixed(2) + " m N, " + pointer[1].toFixed(2) + " m E");
      const seen = countAt(pointer);
      if (seen) parts.push("pictures: " + seen.pictures + " (from " + seen.lines
        + (seen.lines === 1 ? " line)" : " lines)"));
    }
    if (measuring) parts.push(measured.length > 1 ? "measured " + metres(total) : "click to measure");
    read.textContent = parts.join("   ·   ") || "Move the pointer over the map.";
  }

  function countAt([n, e]) {
    const cell = counts && cellOf(counts.grid, n, e);
    if (!cell) return null;
    const at = 4 * (cell[0] * counts.grid.columns + cell[1]);
    const pictures = counts.pixels[at];
    return pictures === 255 ? null : {
      pictures: pictures === 254 ? "254 or more" : pictures, lines: counts.pixels[at + 1],
    };
  }

  function hover(px, py) {
    pointer = place(px, py);
    hovered = measuring ? null : nearest(data.lines, pointer[0], pointer[1], NEAR_PX / view.scale, shown);
    canvas.classList.toggle("measuring", measuring);
    if (hovered) {
      const {line, index, station} = hovered;
      const [n, e] = stationAt(line, station);
      const heading = ((line.heading * 180 / Math.PI + 360) % 360).toFixed(1);
      tip.textContent = [
        "Line " + index + " (" + line.kind + (data.routes.length > 1 ? ", dive " + line.dive : "") + "): "
          + metres(line.length) + ", heading " + heading + "°",
        "Station " + (line.first + station) + ", " + (station + 1) + " of " + line.stations,
        n.toFixed(3) + " m N, " + e.toFixed(3) + " m E", latLon(data.geo, n, e),
      ].join("\n");
      tip.hidden = false;
      tip.style.left = Math.min(px + 16, view.width - tip.offsetWidth - 8) + "px";
      tip.style.top = Math.max(8, Math.min(py + 16, view.height - tip.offsetHeight - 36)) + "px";
    } else {
      tip.hidden = true;
    }
    readout();
    draw();
  }

  const down = new Map();
  let travelled = 0;
  const local = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, local(event));
    travelled = 0;
    canvas.classList.add("moving");
  });
  canvas.addEventListener("pointermove", (event) => {
    const now = local(event);
    if (!down.has(event.pointerId)) {
      hover(...now);
      return;
    }
    const before = down.get(event.pointerId);
    const others = [...down.entries()].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
    down.set(event.pointerId, now);
    if (others.length) {  /* pinch about the other finger */
      const was = Math.hypot(before[0] - others[0][0], before[1] - others[0][1]);
      const is = Math.hypot(now[0] - others[0][0], now[1] - others[0][1]);
      travelled = 99;
      if (was > 0) zoom(is / was, others[0][0], others[0][1]);
      return;
    }
    travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
    view.e -= (now[0] - before[0]) / view.scale;
    view.n += (now[1] - before[1]) / view.scale;
    draw();
  });
  const up = (event) => {
    const clicked = down.has(event.pointerId) && travelled < 4 && event.type === "pointerup";
    down.delete(event.pointerId);
    canvas.classList.toggle("moving", down.size > 0);
    if (clicked && measuring) {
      measured.push(place(...local(event)));
      readout();
      draw();
    } else if (clicked) {
      hover(...local(event));
    }
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointerleave", () => {
    pointer = hovered = null;
    tip.hidden = true;
    readout();
    draw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    zoom(Math.exp(-0.0015 * lines * event.deltaY), ...local(event));
  }, {passive: false});

  function measure(on) {
    measuring = on;
    measured = [];
    $("measure").setAttribute("aria-pressed", String(on));
    canvas.classList.toggle("measuring", on);
    hovered = null;
    tip.hidden = true;
    readout();
    draw();
  }

  const middle = (factor) => zoom(factor, view.width / 2, view.height / 2);
  const refit = () => {
    fit();
    draw();
  };
  $("in").addEventListener("click", () => middle(1.5));
  $("out").addEventListener("click", () => middle(1 / 1.5));
  $("fit").addEventListener("click", refit);
  $("measure").addEventListener("click", () => measure(!measuring));
  canvas.addEventListener("keydown", (event) => {
    const step = 60 / view.scale;
    const acts = {
      "+": () => middle(1.5), "=": () => middle(1.5), "-": () => middle(1 / 1.5), "0": refit,
      m: () => measure(!measuring), Escape: () => measure(false),
      ArrowLeft: () => { view.e -= step; }, ArrowRight: () => { view.e += step; },
      ArrowUp: () => { view.n += step; }, ArrowDown: () => { view.n -= step; },
    };
    if (!acts[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    acts[event.key]();
    draw();
  });

  /* ---- Layers ---- */

  function key(kind, colour) {
    const small = document.createElement("canvas");
    small.className = "key";
    small.width = 44;
    small.height = 28;
    const c = small.getContext("2d");
    c.scale(2, 2);
    c.strokeStyle = c.fillStyle = colour;
    c.lineWidth = 2;
    if (kind === "dash") c.setLineDash([5, 3]);
    if (kind === "dot") c.setLineDash([2, 3]);
    if (kind === "point") {
      [4, 11, 18].forEach((at) => {
        c.beginPath();
        c.arc(at, 7, 2.4, 0, 2 * Math.PI);
        c.fill();
      });
    } else if (kind === "fill") {
      c.globalAlpha = 0.35;
      c.fillRect(1, 1, 20, 12);
      c.globalAlpha = 1;
      c.lineWidth = 1;
      c.strokeRect(1, 1, 20, 12);
    } else {
      c.beginPath();
      c.moveTo(1, 7);
      c.lineTo(21, 7);
      c.stroke();
    }
    return small;
  }

  function box(name, text, kind, colour, on, change) {
    const row = document.createElement("label");
    const input = document.createElement("input");
    input.type = "checkbox";
    input.checked = on;
    if (name) layers[name] = on;
    input.addEventListener("change", () => {
      if (name) layers[name] = input.checked;
      if (change) change(input.checked);
      draw();
    });
    row.append(input);
    if (kind) row.append(key(kind, colour));
    row.append(document.createTextNode(text));
    $("layers").append(row);
  }

  function heading(text) {
    const title = document.createElement("h3");
    title.textContent = text;
    $("layers").append(title);
  }

  heading("Lines");
  data.kinds.forEach((kind) => {
    const number = data.lines.filter((line) => line.kind === kind).length;
    layers[kind] = false;
    if (number) {
      box(kind, number + " " + kind + (number === 1 ? " line" : " lines"), "line", COLOURS[kind], true);
    }
  });
  box("stations", "stations", "point", COLOURS.survey, true);
  box("way", "ways between lines", "line", COLOURS.way, true);
  if (data.routes.length > 1) {
    heading("Dives");
    data.routes.forEach((_, i) => box(null, "dive " + (i + 1), null, null, true, (on) => {
      if (on) dives.add(i + 1);
      else dives.delete(i + 1);
    }));
  }
  heading("Areas");
  box("area", "survey area", "dash", COLOURS.area, true);
  box("allowed", "the vehicle may be within", "dot", COLOURS.allowed, true);
  layers.no_go = false;
  if (data.areas.no_go.length) box("no_go", "no-go zones", "fill", COLOURS.no_go, true);
  heading("Coverage");
  box("foot", "footprints (" + data.camera + " camera)", "fill", COLOURS.foot, !data.coverage);
  if (data.coverage) {
    box("counts", "pictures that see a place", "fill", "#60bbc8", true);
    const ramp = document.createElement("div");
    ramp.className = "ramp";
    const strip = document.createElement("canvas");
    strip.width = RAMP.length;
    strip.height = 1;
    const c = strip.getContext("2d");
    RAMP.forEach((colour, i) => {
      c.fillStyle = colour;
      c.fillRect(i, 0, 1, 1);
    });
    ramp.append(strip);
    const ends = document.createElement("div");
    ends.className = "ends";
    ["0", String(data.coverage.most)].forEach((text, i) => {
      const end = document.createElement("span");
      end.textContent = text + (i ? " pictures or more" : "");
      ends.append(end);
    });
    $("layers").append(ramp, ends);
    box("missed", "less than the overlap asked for", "fill", COLOURS.missed, true);
  }
  heading("Sea");
  layers.contours = layers.current = false;
  if (data.contours.length) box("contours", "depth", "line", COLOURS.contour, true);
  if (data.current) box("current", "current", "line", COLOURS.current, true);
  box("grid", "grid", "line", "#c9d3d9", true);

  /* ---- Counts, from a picture whose red is pictures, green lines, blue 1 where as asked ---- */

  function colourCounts(image) {
    const grid = data.coverage;
    const raw = document.createElement("canvas");
    raw.width = grid.columns;
    raw.height = grid.rows;
    const rawCtx = raw.getContext("2d", {willReadFrequently: true});
    rawCtx.drawImage(image, 0, 0);
    const pixels = rawCtx.getImageData(0, 0, grid.columns, grid.rows).data;
    const rgb = RAMP.map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
    const make = (colourOf) => {
      const sheet = document.createElement("canvas");
      sheet.width = grid.columns;
      sheet.height = grid.rows;
      const sheetCtx = sheet.getContext("2d");
      const out = sheetCtx.createImageData(grid.columns, grid.rows);
      for (let i = 0; i < pixels.length; i += 4) {
        if (pixels[i] === 255) continue;  /* beyond the area */
        out.data.set(colourOf(i), i);
      }
      sheetCtx.putImageData(out, 0, 0);
      return sheet;
    };
    counts = {
      grid, pixels,
      image: make((i) => {
        const step = Math.min(RAMP.length - 1, Math.floor(pixels[i] / grid.most * (RAMP.length - 1)));
        return [...rgb[step], 215];
      }),
      missed: make((i) => (pixels[i + 2] ? [0, 0, 0, 0] : [211, 84, 0, 190])),
    };
    draw();
  }

  if (data.coverage) {
    const image = new Image();
    image.addEventListener("load", () => colourCounts(image));
    image.src = data.coverage.png;
  }

  let sized = false;
  function resize() {
    const bounds = canvas.getBoundingClientRect();
    if (!bounds.width || !bounds.height) return;
    view.width = bounds.width;
    view.height = bounds.height;
    view.ratio = Math.min(3, window.devicePixelRatio || 1);
    canvas.width = Math.round(view.width * view.ratio);
    canvas.height = Math.round(view.height * view.ratio);
    if (!sized) {
      fit();
      view.least = view.scale / 20;
      sized = true;
    }
    paint();
  }
  new ResizeObserver(resize).observe(canvas);
  window.addEventListener("beforeprint", () => {
    tip.hidden = true;
    hovered = null;
    resize();
    refit();
    paint();
  });
  resize();
  readout();
}

if (typeof document === "undefined") {
  module.exports = {geodetic, latLon, roundLength, metres, bearing, nearest, stationAt, cellOf, unpack};
} else {
  start();
}
