/* Handles over the map by which shapes are edited: their vertices, the middles of their edges,
   and one that moves all of it. Each is a button, so that all can be done by keyboard. */

import {el} from "./core.js";
import {fixed} from "./words.js";

const MAX_HANDLES = 400;
const LONG_PRESS_MS = 650;
const APART_PX = 26;  /* between vertices whose middle gets a handle */
const ARROWS = {ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowRight: [0, 1], ArrowLeft: [0, -1]};

/* 1, 2 or 5 times a power of ten, not above a length. */
function roundStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].find((step) => step * power <= length * (1 + 1e-9)) * power;
}

const northEastIn = (unit) => ([n, e]) => fixed(n, 2, unit) + " north, " + fixed(e, 2, unit)
  + " east";

/* What is edited is shown as a target: `name`, `word` of a vertex, and rings [{points, closed}]
   of points [north, east]; `value` is what is edited and `move(ring, i, place)` returns a new
   one; so do, where it can be done, `insert(ring, after, place or null)`, `remove(ring, i)`,
   `shift(north, east)` and `drop()` of all of it. `text(point)` says where a vertex is;
   `changed(value, tag)` takes an edit, `moving(value)` one that goes on, and `left()` is called
   when Escape gives the focus back. */
export function vertexHandles(
  map, name, {unit = "m", text = northEastIn(unit), changed, moving, left}) {
  const pane = map.createPane(name + "-vertices");
  pane.classList.add("vertices", "leaflet-zoom-hide");
  /* Where a handle was replaced meanwhile, the click is the pane's. */
  pane.addEventListener("click", (event) => event.stopPropagation());
  let [target, pressed] = [null, null];

  const place = ([n, e]) => map.latLngToLayerPoint([n, e]);
  const step = (fine) => Math.max(0.001, roundStep((fine ? 1 : 8) / 2 ** map.getZoom()));

  const at = (name) => pane.querySelector(`[data-at="${name}"]`);
  const focus = (made) => made?.focus({preventScroll: true});
  const put = (made, spot) => {
    made.style.transform = `translate(${Math.round(spot.x)}px, ${Math.round(spot.y)}px)`;
  };
  const centre = (spots) => spots.reduce((a, b) => a.add(b)).divideBy(spots.length);
  const of = (made) => made.dataset.at.slice(1).split("-").map(Number);
  const nextOf = (ring, i) => (i + 1) % target.rings[ring].points.length;

  /* Handles of a target, or of none. */
  function show(newTarget) {
    target = newTarget;
    if (pressed && target) follow();
    else draw();
  }

  /* While one is dragged all handles stay the same elements: the browser holds on to it. */
  function follow() {
    const spots = target.rings.map(({points}) => points.map(place));
    if (pressed.does.between) {
      const [ring, i] = pressed.does.between;
      put(pressed.made, spots[ring][i + 1]);
      return;
    }
    pane.querySelectorAll(".corner").forEach((made) => {
      const [ring, i] = of(made);
      put(made, spots[ring][i]);
    });
    pane.querySelectorAll(".middle").forEach((made) => {
      const [ring, i] = of(made);
      put(made, centre([spots[ring][i], spots[ring][nextOf(ring, i)]]));
    });
    if (at("move")) put(at("move"), centre(spots[0]));
  }

  function draw() {
    const focused = pane.contains(document.activeElement)
      ? document.activeElement.dataset.at : null;
    pane.replaceChildren();
    if (target) target.rings.forEach(fill);
    if (target?.shift && target.rings[0].points.length) {
      pane.append(handle("mover", "move", centre(target.rings[0].points.map(place)), {
        "aria-label": "Move " + target.name,
        title: "Drag, or arrow keys, to move all of it"
          + (target.drop ? "; Delete removes it" : ""),
      }, whole()));
    }
    if (focused) focus(at(focused) || pane.querySelector(".corner") || map.getContainer());
  }

  function fill({points, closed}, ring) {
    const view = map.getBounds().pad(0.2);
    const spots = points.map(place);
    const seen = points.map((_, i) => i).filter((i) => view.contains(points[i]))
      .slice(0, MAX_HANDLES);
    const hole = ring ? ", hole " + ring : "";
    seen.forEach((i) => {
      pane.append(handle("corner", "c" + ring + "-" + i, spots[i], {
        "aria-label": target.word + " " + (i + 1) + " of " + points.length + " of " + target.name
          + hole + ": " + text(points[i]),
        title: "Drag, or arrow keys, with Shift by less"
          + (target.insert ? "; Delete removes; Enter adds one after it" : ""),
      }, corner(ring, i, closed)));
    });
    if (!target.insert) return;
    seen.forEach((i) => {
      const next = nextOf(ring, i);
      if ((next === 0 && !closed) || spots[i].distanceTo(spots[next]) < APART_PX) return;
      pane.append(handle("middle", "m" + ring + "-" + i, centre([spots[i], spots[next]]), {
        "aria-label": "Add one after " + target.word.toLowerCase() + " " + (i + 1) + hole,
          tabindex: "-1",
      }, middle(ring, i)));
    });
  }

  /* What each kind of handle does: `drag(from, to, start)`, of the target at the start, and
     keys. */
  function corner(ring, i, closed) {
    return {
      tag: "corner " + ring + "-" + i,
      drag: (from, to, start) => start.move(ring, i, to),
      shift: (north, east) => {
        const [n, e] = target.rings[ring].points[i];
        return target.move(ring, i, [n + north, e + east]);
      },
      remove: target.remove && (() => target.remove(ring, i)),
      enter() {
        if (!target.insert || (!closed && nextOf(ring, i) === 0)) return;
        inserted(target.insert(ring, i, null), ring, i);
      },
    };
  }
  const middle = (ring, i) => ({
    tag: "middle " + ring + "-" + i,
    between: [ring, i],
    drag: (from, to, start) => start.insert(ring, i, to),
    dropped: (next) => inserted(next, ring, i),
    click: () => inserted(target.insert(ring, i, null), ring, i),
  });
  function inserted(next, ring, after) {
    changed(next, "");
    focus(at("c" + ring + "-" + (after + 1)));
  }
  const whole = () => ({
    tag: "all",
    drag: (from, to, start) => start.shift(to[0] - from[0], to[1] - from[1]),
    shift: (north, east) => target.shift(north, east),
    remove: target.drop && (() => target.drop()),
  });

  function handle(name, key, spot, attributes, does) {
    const made = el("button", {type: "button", class: "vertex " + name, "data-at": key,
      ...attributes});
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
    pressed = {does, made, from: northEast(event), at: [event.clientX, event.clientY],
      start: target, now: null};
    const held = pressed;
    pressed.timer = setTimeout(() => {
      if (pressed !== held || held.now || !does.remove || event.pointerType === "mouse") return;
      release();
      changed(does.remove(), "");
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
    else changed(now, "");
  }

  function cancel() {
    const {start} = pressed;
    release();
    moving(start.value);
  }

  function typed(event, does) {
    const way = ARROWS[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (way && does.shift) {
      const metres = step(event.shiftKey);
      changed(does.shift(metres * way[0], metres * way[1]), "arrow " + does.tag + target.name);
    } else if ((event.key === "Delete" || event.key === "Backspace") && does.remove) changed(
      does.remove(), "");
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
