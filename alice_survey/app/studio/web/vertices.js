/* Handles over the map by which a shape is edited: its vertices, the middles of its edges, and one
   that moves all of it. Each is a button, so that all can be done by keyboard. */

import {el} from "./core.js";
import {fixed} from "./words.js";

const MAX_HANDLES = 400;
const APART_PX = 26;  /* between vertices whose middle gets a handle */
const ARROWS = {ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowRight: [0, 1], ArrowLeft: [0, -1]};

/* 1, 2 or 5 times a power of ten, not above a length. */
function roundStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].find((step) => step * power <= length * (1 + 1e-9)) * power;
}

/* What is edited is shown as a target: `value`, its `name`, the `word` for a vertex, and `points`
   [north, east], `closed` or not; `move(i, place)`, `insert(after, place or null)`, `remove(i)`,
   `shift(north, east)` and `drop()` of all of it return a new value. `changed(value, tag)` takes an
   edit, `moving(value)` one that goes on; `left()` is called when Escape gives the focus back. */
export function vertexHandles(map, name, {changed, moving, left}) {
  const pane = map.createPane(name + "-vertices");
  pane.classList.add("vertices", "leaflet-zoom-hide");
  /* Where a handle was replaced meanwhile, the click is the pane's. */
  pane.addEventListener("click", (event) => event.stopPropagation());
  let [target, pressed, handles] = [null, null, []];

  const at = (key) => pane.querySelector(`[data-at="${key}"]`);
  const focus = (made) => made?.focus({preventScroll: true});
  const centre = (points) => [0, 1].map((axis) => points.reduce(
    (sum, point) => sum + point[axis], 0) / points.length);
  const next = (i) => (i + 1) % target.points.length;
  const isEnd = (i) => next(i) === 0 && !target.closed;
  const where = ([n, e]) => fixed(n, 2, "m") + " north, " + fixed(e, 2, "m") + " east";

  function put({made, place}) {
    const {x, y} = map.latLngToLayerPoint(place());
    made.style.transform = `translate(${Math.round(x)}px, ${Math.round(y)}px)`;
  }

  /* Handles of a target, or of none. While one is dragged all stay the same elements: the browser
     holds on to it. */
  function show(newTarget) {
    target = newTarget;
    if (!pressed || !target) draw();
    else if (pressed.handle.after === undefined) handles.forEach(put);
    else put({made: pressed.handle.made, place: () => target.points[pressed.handle.after + 1]});
  }

  function draw() {
    const focused = pane.contains(document.activeElement)
      ? document.activeElement.dataset.at : null;
    handles = target?.points.length ? [...corners(), whole()] : [];
    handles.forEach(put);
    pane.replaceChildren(...handles.map(({made}) => made));
    if (focused) focus(at(focused) || pane.querySelector(".corner") || map.getContainer());
  }

  function corners() {
    const view = map.getBounds().pad(0.2);
    const {points} = target;
    const seen = points.map((_, i) => i).filter((i) => view.contains(points[i]))
      .slice(0, MAX_HANDLES);
    const px = (i) => map.latLngToLayerPoint(points[i]);
    return [...seen.map(corner), ...seen.filter((i) => !isEnd(i)
      && px(i).distanceTo(px(next(i))) >= APART_PX).map(middle)];
  }

  function inserted(value, after) {
    changed(value, "");
    focus(at("c" + (after + 1)));
  }

  /* What each kind of handle does: `drag(from, to, start)`, of the target at the start, and
     keys. */
  const corner = (i) => handle("corner", "c" + i, {
    "aria-label": `${target.word} ${i + 1} of ${target.points.length} of ${target.name}: `
      + where(target.points[i]),
    title: "Drag, or arrow keys, with Shift by less; Delete removes; Enter adds one after it",
  }, {
    place: () => target.points[i],
    drag: (from, to, start) => start.move(i, to),
    shift: (north, east) => target.move(
      i, [target.points[i][0] + north, target.points[i][1] + east]),
    remove: () => target.remove(i),
    enter: () => { if (!isEnd(i)) inserted(target.insert(i, null), i); },
  });
  const middle = (i) => handle("middle", "m" + i, {
    "aria-label": `Add one after ${target.word.toLowerCase()} ${i + 1}`, tabindex: "-1",
  }, {
    after: i,
    place: () => centre([target.points[i], target.points[next(i)]]),
    drag: (from, to, start) => start.insert(i, to),
    enter: () => inserted(target.insert(i, null), i),
  });
  const whole = () => handle("mover", "move", {
    "aria-label": "Move " + target.name,
    title: "Drag, or arrow keys, to move all of it; Delete removes it",
  }, {
    place: () => centre(target.points),
    drag: (from, to, start) => start.shift(to[0] - from[0], to[1] - from[1]),
    shift: (north, east) => target.shift(north, east),
    remove: () => target.drop(),
  });

  function handle(kind, key, attributes, does) {
    const made = el("button", {type: "button", class: "vertex " + kind, "data-at": key,
      ...attributes});
    const one = {made, key, ...does};
    /* Neither the map nor its tool must take what is meant for a handle. */
    ["mousedown", "touchstart", "dblclick", "click"].forEach(
      (event) => made.addEventListener(event, (heard) => heard.stopPropagation()),
    );
    made.addEventListener("pointerdown", (event) => press(event, one));
    made.addEventListener("keydown", (event) => typed(event, one));
    return one;
  }

  const northEast = (event) => {
    const {lat, lng} = map.mouseEventToLatLng(event);
    return [lat, lng];
  };
  const listeners = {pointermove: move, pointerup: drop, pointercancel: cancel};
  const listen = (way) => Object.entries(listeners).forEach(
    ([event, listener]) => window[way + "EventListener"](event, listener));

  function press(event, one) {
    if (event.button !== 0) return;
    event.stopPropagation();
    event.preventDefault();
    focus(one.made);
    pressed = {handle: one, from: northEast(event), at: [event.clientX, event.clientY],
      start: target, now: null};
    map.getContainer().dataset.tool = "handle";
    listen("add");
  }

  function move(event) {
    const away = Math.hypot(event.clientX - pressed.at[0], event.clientY - pressed.at[1]);
    if (!pressed.now && away < 3) return;
    pressed.now = pressed.handle.drag(pressed.from, northEast(event), pressed.start);
    moving(pressed.now);
  }

  function release() {
    pressed = null;
    delete map.getContainer().dataset.tool;
    listen("remove");
  }

  function drop() {
    const {now, handle: {after, enter}} = pressed;
    release();
    if (after === undefined) {
      if (now) changed(now, "");
    } else if (now) inserted(now, after);
    else enter();
  }

  function cancel() {
    const {start} = pressed;
    release();
    moving(start.value);
  }

  function typed(event, {key, shift, remove, enter}) {
    const way = ARROWS[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (way && shift) {
      const metres = Math.max(0.001, roundStep((event.shiftKey ? 1 : 8) / 2 ** map.getZoom()));
      changed(shift(metres * way[0], metres * way[1]), "arrow " + key + target.name);
    } else if (["Delete", "Backspace"].includes(event.key) && remove) changed(remove(), "");
    else if (["Enter", " "].includes(event.key)) enter?.();
    else if (event.key === "Escape") (pressed ? cancel : left)();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  map.on("zoomend moveend viewreset", () => { if (!pressed) draw(); });
  return {show, focus: () => focus(pane.querySelector(".corner"))};
}
