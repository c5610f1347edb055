/* Areas, zones and corridors on the map: draw them by clicks, choose one, edit it by its handles. */

import {button, el, say} from "./core.js";
import {WHITE} from "./palette.js";
import {handles} from "./plan_handles.js";
import {
  KINDS, addRing, isClosed, leastPoints, nameOf, noShapes, pathAt, paths, pointsOf, removeRing, samePath, sizeOf,
} from "./plan_shapes.js";

const REACH_PX = 9;
const fixed = {interactive: false};

/* `changed(shapes, tag)` takes an edit and `moving(shapes)` one that goes on. */
export function drawing(studio, {changed, moving}) {
  const map = studio.map.leaflet;
  const pane = map.createPane("plan-shapes");
  pane.style.pointerEvents = "none";
  const renderer = leaflet.canvas({pane: "plan-shapes", padding: 0.3});
  const drawn = leaflet.featureGroup();
  const sketch = leaflet.featureGroup();
  let [shapes, chosen, active, session] = [noShapes(), null, false, null];
  const edges = handles(map, {
    changed: (next, tag) => changed(next, tag),
    moving,
    left: () => { choose(null); document.getElementById("map-canvas").focus(); },
  });

  /* ---- What is drawn ---- */

  function outline(points, path) {
    const {colour} = KINDS[path.kind];
    const bold = samePath(path, chosen);
    const many = isClosed(path) ? leaflet.polygon : leaflet.polyline;
    const style = {...fixed, renderer, fill: false};
    drawn.addLayer(many(points, {...style, color: WHITE, weight: bold ? 6 : 5, opacity: 0.75}));
    drawn.addLayer(many(points, {
      ...style, color: colour, weight: bold ? 3.4 : 2.2,
      dashArray: path.kind === "allowed" ? "7 5" : null,
    }));
  }

  function render() {
    drawn.clearLayers();
    if (active) {
      shapes.no_go.forEach(({outer, holes}) => drawn.addLayer(leaflet.polygon([outer, ...holes], {
        ...fixed, renderer, stroke: false, fillColor: KINDS.no_go.colour, fillOpacity: 0.22,
      })));
      paths(shapes).forEach((path) => outline(pointsOf(shapes, path), path));
    }
    edges.show(active && !session ? shapes : null, chosen);
  }

  function update(next) {
    shapes = {...noShapes(), ...next};
    if (chosen && !pointsOf(shapes, chosen).length) chosen = null;
    render();
    list();
  }

  function choose(path) {
    chosen = path;
    render();
    list();
  }

  /* A click that no tool takes chooses what is there. */
  function pick({latlng: {lat, lng}}) {
    if (document.getElementById("map-canvas").dataset.tool !== undefined) return;
    choose(pathAt(shapes, [lat, lng], REACH_PX / 2 ** map.getZoom()));
  }

  /* ---- Drawing ---- */

  const tools = el("div", {class: "buttons", role: "group", "aria-label": "Draw on the map"});
  const hint = el("p", {class: "note", hidden: true});
  const steps = el("div", {class: "buttons", hidden: true});
  const finish = button("Finish", () => complete(), {class: "primary"});
  const back = button("Remove the last", () => {
    session.points.pop();
    sketched();
  });
  steps.append(finish, back, button("Cancel", () => studio.map.release()));

  function begin(kind, inside = null) {
    studio.map.release();
    session = {kind, inside, points: [], path: {kind, index: 0, ring: inside ? 1 : 0}};
    const own = session;
    render();
    map.doubleClickZoom?.disable();
    studio.map.take({
      name: "plan",
      click: ({lat, lng}) => add([lat, lng]),
      move: ({lat, lng}) => sketched([lat, lng]),
      text: () => "; " + session.points.length + " drawn",
      keys: {Backspace: () => back.click(), f: () => complete()},
      end: () => { if (session === own) finished(); },
    });
    document.getElementById("map-canvas").focus();
    sketched();
  }

  function add(point) {
    const {points, path} = session;
    const px = (place) => map.latLngToContainerPoint(place);
    const near = (place) => place && px(place).distanceTo(px(point)) < REACH_PX;
    const enough = points.length >= leastPoints(path);
    if (enough && ((isClosed(path) && near(points[0])) || near(points[points.length - 1]))) complete();
    else if (!near(points[points.length - 1])) {
      points.push(point);
      sketched();
    }
  }

  function sketched(pointer = null) {
    const {points, path, kind} = session;
    const colour = KINDS[kind].colour;
    const all = pointer ? [...points, pointer] : points;
    const many = isClosed(path) && all.length > 2 ? leaflet.polygon : leaflet.polyline;
    sketch.clearLayers();
    const style = {...fixed, renderer, color: colour, weight: 2.4, dashArray: "6 4", fillOpacity: 0.08};
    sketch.addLayer(many(all, style));
    points.forEach((point) => sketch.addLayer(leaflet.circleMarker(point, {
      ...fixed, renderer, radius: 4, color: WHITE, weight: 1.5, fillColor: colour, fillOpacity: 1,
    })));
    if (pointer) return;
    const missing = leastPoints(path) - points.length;
    hint.textContent = missing > 0
      ? "Click on the map, or press Enter to take its middle: " + missing + " more at least."
      : "Go on, or finish: click " + (isClosed(path) ? "the first corner" : "the last point") + " again, or press F.";
    finish.disabled = missing > 0;
    back.disabled = !points.length;
    toolsShown();
  }

  function complete() {
    const {kind, points, inside, path} = session;
    if (points.length < leastPoints(path)) {
      say("Draw " + (leastPoints(path) - points.length) + " more at least");
      return;
    }
    const added = addRing(shapes, kind, points, inside);
    studio.map.release();
    chosen = added.path;
    changed(added.shapes);
  }

  function finished() {
    session = null;
    sketch.clearLayers();
    map.doubleClickZoom?.enable();
    toolsShown();
    render();
  }

  const choices = Object.entries(KINDS).map(([kind, {title}]) => button(title, () => begin(kind)));
  const holes = button("Hole", () => begin(chosen.kind, chosen), {title: "A no-go zone within the chosen area"});
  choices.splice(1, 0, holes);
  tools.append(...choices);

  function toolsShown() {
    [hint.hidden, steps.hidden, tools.hidden] = [!session, !session, Boolean(session)];
    holes.disabled = !chosen || chosen.kind !== "survey" || chosen.ring > 0;
  }

  /* ---- The list of shapes ---- */

  const items = el("ul", {class: "plan-list"});
  let listed = "";

  function list() {
    toolsShown();
    const rows = paths(shapes).map((path) => [path, nameOf(shapes, path), sizeOf(shapes, path), samePath(path, chosen)]);
    const now = JSON.stringify(rows);
    if (now === listed) return;
    listed = now;
    const focused = items.contains(document.activeElement) ? document.activeElement.dataset.at : null;
    items.replaceChildren(...rows.map(([path, name, size, on]) => el(
      "li", {},
      button([name, el("small", {}, size)], () => {
        choose(on ? null : path);
        if (!on) edges.focus();
      }, {"aria-pressed": String(on), "data-at": name, class: "choose"}),
      button("Delete", () => changed(removeRing(shapes, path)), {"aria-label": "Delete " + name.toLowerCase(), "data-at": "x" + name}),
    )));
    if (focused) (items.querySelector(`[data-at="${CSS.escape(focused)}"]`) || choices[0]).focus();
  }

  function enter() {
    active = true;
    drawn.addTo(map);
    sketch.addTo(map);
    map.on("click", pick);
    render();
  }

  function leave() {
    active = false;
    map.off("click", pick);
    render();
    [drawn, sketch].forEach((group) => group.remove());
  }

  const panel = el("div", {}, tools, hint, steps, items);
  toolsShown();
  return {panel, update, enter, leave, choose, begin, isDrawing: () => Boolean(session)};
}
