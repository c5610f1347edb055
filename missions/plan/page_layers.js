/* A plan's map, part 3 of 4: the list of layers, and the counts of pictures. */

/* Fills the list; `draw` is called when a layer or a dive is switched. */
function layerList(list, data, state, draw) {
  const {layers, dives} = state;

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
    list.append(row);
  }

  function heading(text) {
    const title = document.createElement("h3");
    title.textContent = text;
    list.append(title);
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
    list.append(ramp, ends);
    box("missed", "less than the overlap asked for", "fill", COLOURS.missed, true);
  }
  heading("Sea");
  layers.contours = layers.current = false;
  if (data.contours.length) box("contours", "depth", "line", COLOURS.contour, true);
  if (data.current) box("current", "current", "line", COLOURS.current, true);
  box("grid", "grid", "line", "#c9d3d9", true);
}

/* Counts from a picture whose red is pictures, green lines, and blue 1 where as asked. */
function decodeCounts(image, grid) {
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
  return {
    grid, pixels,
    image: make((i) => {
      const step = Math.min(RAMP.length - 1, Math.floor(pixels[i] / grid.most * (RAMP.length - 1)));
      return [...rgb[step], 215];
    }),
    missed: make((i) => (pixels[i + 2] ? [0, 0, 0, 0] : [211, 84, 0, 190])),
  };
}
