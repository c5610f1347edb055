/* A plan's map, part 4 of 4: pointer, keys and buttons. */

function start() {
  const $ = (id) => document.getElementById(id);
  const data = unpack(JSON.parse($("data").textContent));
  const canvas = $("map");
  const ctx = canvas.getContext("2d");
  const tip = $("tip");
  const read = $("read");
  const view = {n: 0, e: 0, scale: 1, width: 1, height: 1, ratio: 1};
  const state = {
    layers: {}, dives: new Set(data.routes.map((_, i) => i + 1)), measuring: false, measured: [],
    pointer: null,  /* where it is: [n, e] */
    hovered: null, counts: null,
  };
  const {paint, place, shown} = drawing(ctx, data, view, state);
  let waiting = false;

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

  /* ---- Pointer and keys ---- */

  function readout() {
    const total = state.measured.slice(1).reduce(
      (sum, b, i) => sum + Math.hypot(b[0] - state.measured[i][0], b[1] - state.measured[i][1]), 0,
    );
    const parts = [];
    if (state.pointer) {
      parts.push(latLon(data.geo, state.pointer[0], state.pointer[1]));
      parts.push(state.pointer[0].toFixed(2) + " m N, " + state.pointer[1].toFixed(2) + " m E");
      const seen = countAt(state.pointer);
      if (seen) parts.push("pictures: " + seen.pictures + " (from " + seen.lines
        + (seen.lines === 1 ? " line)" : " lines)"));
    }
    if (state.measuring) {
      parts.push(state.measured.length > 1 ? "measured " + metres(total) : "click to measure");
    }
    read.textContent = parts.join("   ·   ") || "Move the pointer over the map.";
  }

  function countAt([n, e]) {
    const cell = state.counts && cellOf(state.counts.grid, n, e);
    if (!cell) return null;
    const at = 4 * (cell[0] * state.counts.grid.columns + cell[1]);
    const pictures = state.counts.pixels[at];
    return pictures === 255 ? null : {
      pictures: pictures === 254 ? "254 or more" : pictures, lines: state.counts.pixels[at + 1],
    };
  }

  function hover(px, py) {
    state.pointer = place(px, py);
    const [n, e] = state.pointer;
    const within = NEAR_PX / view.scale;
    state.hovered = state.measuring ? null : nearest(data.lines, n, e, within, shown);
    canvas.classList.toggle("measuring", state.measuring);
    if (state.hovered) {
      const {line, index, station} = state.hovered;
      const [north, east] = stationAt(line, station);
      const heading = ((line.heading * 180 / Math.PI + 360) % 360).toFixed(1);
      tip.textContent = [
        "Line " + index + " (" + line.kind + (data.routes.length > 1 ? ", dive " + line.dive : "") + "): "
          + metres(line.length) + ", heading " + heading + "°",
        "Station " + (line.first + station) + ", " + (station + 1) + " of " + line.stations,
        north.toFixed(3) + " m N, " + east.toFixed(3) + " m E", latLon(data.geo, north, east),
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
    if (clicked && state.measuring) {
      state.measured.push(place(...local(event)));
      readout();
      draw();
    } else if (clicked) {
      hover(...local(event));
    }
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointerleave", () => {
    state.pointer = state.hovered = null;
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
    state.measuring = on;
    state.measured = [];
    $("measure").setAttribute("aria-pressed", String(on));
    canvas.classList.toggle("measuring", on);
    state.hovered = null;
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
  $("measure").addEventListener("click", () => measure(!state.measuring));
  canvas.addEventListener("keydown", (event) => {
    const step = 60 / view.scale;
    const acts = {
      "+": () => middle(1.5), "=": () => middle(1.5), "-": () => middle(1 / 1.5), "0": refit,
      m: () => measure(!state.measuring), Escape: () => measure(false),
      ArrowLeft: () => { view.e -= step; }, ArrowRight: () => { view.e += step; },
      ArrowUp: () => { view.n += step; }, ArrowDown: () => { view.n -= step; },
    };
    if (!acts[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    acts[event.key]();
    draw();
  });

  layerList($("layers"), data, state, draw);
  if (data.coverage) {
    const image = new Image();
    image.addEventListener("load", () => {
      state.counts = decodeCounts(image, data.coverage);
      draw();
    });
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
    state.hovered = null;
    resize();
    refit();
    paint();
  });
  resize();
  readout();
}

start();
