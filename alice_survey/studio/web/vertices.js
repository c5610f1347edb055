/* Handles over the map by which a ring is edited: its corners, the middles of its edges, and one
   that moves all of it. Each is a button, so that all can be done by keyboard. */

import {el} from "./core.js";
import {
  insertVertex, isClosed, moveRing, moveVertex, nameOf, pointsOf, removeRing, removeVertex,
} from "./plan_shapes.js";

const MOST_HANDLES = 400;
const LONG_PRESS_MS = 650;
const APART_PX = 26;  /* between corners whose middle gets a handle */
const ARROWS = {ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowRight: [0, 1], ArrowLeft: [0, -1]};

/* 1, 2 or 5 times a power of ten, not above a length. */
export function roundStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].find((step) => step * power <= length * (1 + 1e-9)) * power;
}

/* `map` is Leaflet's; `changed(shapes, tag)` takes an edit, `moving(shapes)` one that goes on, and
   `left()` is called when Escape gives the focus back. */
export function handles(map, {changed, moving, left}) {
  const pane = map.createPane("plan-handles");
  pane.classList.add("leaflet-zoom-hide");
  /* Where a handle was replaced meanwhile, the click is the pane's. */
  pane.addEventListener("click", (event) => event.stopPropagation());
  let [shapes, path, pressed] = [null, null, null];

  const place = ([n, e]) => map.latLngToLayerPoint([n, e]);
  const step = (fine) => Math.max(0.001, roundStep((fine ? 1 : 8) / 2 ** map.getZoom()));
  const text = ([n, e]) => n.toFixed(2) + " m north, " + e.toFixed(2) + " m east";
  const word = () => (isClosed(path) ? "Corner " : "Point ");

  const at = (name) => pane.querySelector(`[data-at="${name}"]`);
  const focus = (made) => made?.focus({preventScroll: true});
  const put = (made, spot) => {
    made.style.transform = `translate(${Math.round(spot.x)}px, ${Math.round(spot.y)}px)`;
  };
  const centre = (spots) => spots.reduce((a, b) => a.add(b)).divideBy(spots.length);

  /* Handles of a ring, or of none where one of both is null. */
  function show(newShapes, newPath) {
    [shapes, path] = [newShapes, newPath];
    if (pressed) follow();
    else draw();
  }

  /* While one is dragged all handles stay the same elements: the browser holds on to it. */
  function follow() {
    const spots = pointsOf(shapes, path).map(place);
    if (pressed.does.tag.startsWith("middle")) {
      put(pressed.made, spots[pressed.does.index + 1]);
      return;
    }
    pane.querySelectorAll(".corner").forEach((made) => put(made, spots[Number(made.dataset.at.slice(1))]));
    pane.querySelectorAll(".middle").forEach((made) => {
      const i = Number(made.dataset.at.slice(1));
      put(made, centre([spots[i], spots[(i + 1) % spots.length]]));
    });
    put(at("move"), centre(spots));
  }

  function draw() {
    const focused = pane.contains(document.activeElement) ? document.activeElement.dataset.at : null;
    pane.replaceChildren();
    fill();
    if (focused) focus(at(focused) || pane.querySelector(".corner") || map.getContainer());
  }

  function fill() {
    const points = path && shapes ? pointsOf(shapes, path) : [];
    if (!points.length) return;
    const view = map.getBounds().pad(0.2);
    const spots = points.map(place);
    const seen = points.map((_, i) => i).filter((i) => view.contains(points[i])).slice(0, MOST_HANDLES);
    seen.forEach((i) => {
      pane.append(handle("corner", "c" + i, spots[i], {
        "aria-label": word() + (i + 1) + " of " + points.length + " of " + nameOf(shapes, path).toLowerCase() + ": " + text(points[i]),
        title: "Drag, or arrow keys; Delete removes; Enter adds one after it",
      }, corner(i)));
    });
    seen.forEach((i) => {
      const next = (i + 1) % points.length;
      if ((next === 0 && !isClosed(path)) || spots[i].distanceTo(spots[next]) < APART_PX) return;
      pane.append(handle("middle", "m" + i, centre([spots[i], spots[next]]), {
        "aria-label": "Add one after " + word().toLowerCase() + (i + 1), tabindex: "-1",
      }, middle(i)));
    });
    pane.append(handle("mover", "move", centre(spots), {
      "aria-label": "Move " + nameOf(shapes, path).toLowerCase(),
      title: "Drag, or arrow keys, to move all of it; Delete removes it",
    }, whole()));
  }

  /* What each kind of handle does: `drag(from, to, shapes)` and `keys`. */
  function corner(i) {
    return {
      tag: "corner " + i,
      drag: (from, to, start) => moveVertex(start, path, i, to),
      shift: (north, east) => {
        const [n, e] = pointsOf(shapes, path)[i];
        return moveVertex(shapes, path, i, [n + north, e + east]);
      },
      remove: () => removeVertex(shapes, path, i),
      enter() {
        const points = pointsOf(shapes, path);
        if (!isClosed(path) && i === points.length - 1) return;
        inserted(insertVertex(shapes, path, i), i);
      },
    };
  }
  const middle = (i) => ({
    tag: "middle " + i,
    index: i,
    drag: (from, to, start) => insertVertex(start, path, i, to),
    dropped: (next) => inserted(next, i),
    click: () => inserted(insertVertex(shapes, path, i), i),
  });
  function inserted(next, after) {
    changed(next);
    focus(at("c" + (after + 1)));
  }
  const whole = () => ({
    tag: "all",
    drag: (from, to, start) => moveRing(start, path, to[0] - from[0], to[1] - from[1]),
    shift: (north, east) => moveRing(shapes, path, north, east),
    remove: () => removeRing(shapes, path),
  });

  function handle(name, key, spot, attributes, does) {
    const made = el("button", {type: "button", class: "plan-handle " + name, "data-at": key, ...attributes});
    put(made, spot);
    /* Neither the map nor its tool must take what is meant for a handle. */
    ["mousedown", "touchstart", "dblclick", "click"].forEach(
      (event) => made.addEventListener(event, (heard) => heard.stopPropagation()),
    );
    made.addEventListener("pointerdown", (event) => press(event, made, does));
    made.addEventListener("keydown", (event) => typed(event, does));
    made.addEventListener("contextmenu", (event) => event.preventDefault());
    return made;
  }

  const northEast = (event) => {
    const {lat, lng} = map.mouseEventToLatLng(event);
    return [lat, lng];
  };

  function press(event, made, does) {
    if (event.button !== 0) return;
    event.stopPropagation();
    event.preventDefault();
    focus(made);
    pressed = {does, made, from: northEast(event), at: [event.clientX, event.clientY], start: shapes, now: null};
    const held = pressed;
    pressed.timer = setTimeout(() => {
      if (pressed !== held || held.now || !does.remove || event.pointerType === "mouse") return;
      release();
      changed(does.remove());
    }, LONG_PRESS_MS);
    map.getContainer().dataset.tool = "handle";
    window.addEventListener("pointermove", move);
    window.addEventListener("pointerup", drop);
    window.addEventListener("pointercancel", cancel);
  }

  function move(event) {
    const away = Math.hypot(event.clientX - pressed.at[0], event.clientY - pressed.at[1]);
    if (!pressed.now && away < 3) return;
    pressed.now = pressed.does.drag(pressed.from, northEast(event), pressed.start);
    moving(pressed.now);
  }

  function release() {
    clearTimeout(pressed?.timer);
    pressed = null;
    delete map.getContainer().dataset.tool;
    window.removeEventListener("pointermove", move);
    window.removeEventListener("pointerup", drop);
    window.removeEventListener("pointercancel", cancel);
  }

  function drop() {
    const {now, does} = pressed;
    release();
    if (!now) does.click?.();
    else if (does.dropped) does.dropped(now);
    else changed(now);
  }

  function cancel() {
    const {start} = pressed;
    release();
    moving(start);
  }

  function typed(event, does) {
    const way = ARROWS[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (way && does.shift) {
      const metres = step(event.shiftKey);
      changed(does.shift(metres * way[0], metres * way[1]), "arrow " + does.tag + path.kind + path.index + path.ring);
    } else if ((event.key === "Delete" || event.key === "Backspace") && does.remove) changed(does.remove());
    else if (event.key === "Enter" || event.key === " ") (does.enter || does.click)?.();
    else if (event.key === "Escape") {
      if (pressed) cancel();
      else left();
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  const redraw = () => { if (!pressed) draw(); };
  map.on("zoomend moveend viewreset", redraw);
  return {show, focus: () => focus(pane.querySelector(".corner"))};
}
