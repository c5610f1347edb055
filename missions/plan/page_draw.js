/* A plan's map, part 2 of 4: what is on the canvas. */

/* What paints the map from its state: shown layers and dives, where the pointer is, what it is over,
   what is being measured, and the counts once they are decoded. */
function drawing(ctx, data, view, state) {
  const {layers, dives} = state;
  const x = (e) => view.width / 2 + (e - view.e) * view.scale;
  const y = (n) => view.height / 2 - (n - view.n) * view.scale;
  const place = (px, py) => [
    view.n - (py - view.height / 2) / view.scale, view.e + (px - view.width / 2) / view.scale,
  ];
  const shown = (line) => layers[line.kind] && dives.has(line.dive);

  function paint() {
    ctx.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
    ctx.fillStyle = "#fbfcfc";
    ctx.fillRect(0, 0, view.width, view.height);
    const grid = gridValues();
    if (layers.grid) paintGrid(grid);
    if (state.counts && (layers.counts || layers.missed)) paintCounts();
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
    const {grid} = state.counts;
    const c = Math.cos(grid.heading) * grid.cell * view.scale * view.ratio;
    const s = Math.sin(grid.heading) * grid.cell * view.scale * view.ratio;
    /* Image columns go to the right of the grid's heading, image rows along it. */
    ctx.setTransform(
      c, s, s, -c, x(grid.origin[1]) * view.ratio, y(grid.origin[0]) * view.ratio,
    );
    ctx.imageSmoothingEnabled = false;
    if (layers.counts) ctx.drawImage(state.counts.image, 0, 0);
    if (layers.missed) ctx.drawImage(state.counts.missed, 0, 0);
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
    if (!state.hovered) return;
    const {line, station} = state.hovered;
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
    const moving = state.measuring && state.pointer && state.measured.length;
    const points = moving ? [...state.measured, state.pointer] : state.measured;
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
      const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
      if (length * view.scale < 2) continue;
      const text = metres(length) + "  " + bearing(a, b).toFixed(0) + "°";
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

  return {paint, place, shown};
}
