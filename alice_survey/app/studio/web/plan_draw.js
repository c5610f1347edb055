/* Areas, zones and corridors on the map: draw them by clicks, choose one, edit it by its
   handles. */

import {button, el} from "./core.js";
import {drawingTool} from "./drawing.js";
import {WHITE} from "./palette.js";
import {
  KINDS, addRing, areaOf, insertVertex, isClosed, moveRing, moveVertex, nameOf, noShapes, paths,
  pointsOf, removeRing, removeVertex, samePath, sizeOf,
} from "./plan_shapes.js";
import {vertexHandles} from "./vertices.js";

const fixed = {interactive: false};

/* A ring as what handles edit. */
const targetOf = (shapes, path) => ({
  value: shapes, name: nameOf(shapes, path).toLowerCase(),
  word: isClosed(path) ? "Corner" : "Point",
  points: pointsOf(shapes, path), closed: isClosed(path),
  move: (i, place) => moveVertex(shapes, path, i, place),
  insert: (after, place) => insertVertex(shapes, path, after, place),
  remove: (i) => removeVertex(shapes, path, i),
  shift: (north, east) => moveRing(shapes, path, north, east),
  drop: () => removeRing(shapes, path),
});

/* `changed(shapes, tag)` takes an edit and `moving(shapes)` one that goes on. */
export function drawing(studio, {changed, moving}) {
  const map = studio.map.leaflet;
  const pane = map.createPane("plan-shapes");
  const renderer = leaflet.canvas({pane: "plan-shapes", padding: 0.3, tolerance: 6});
  const drawn = leaflet.featureGroup();
  const tool = drawingTool(studio, "plan");
  let [shapes, chosen, active, hit] = [noShapes(), null, false, null];
  const edges = vertexHandles(map, "plan", {
    changed, moving,
    left: () => { choose(null); document.getElementById("map-canvas").focus(); },
  });

  /* ---- What is drawn ---- */

  function outline(points, path) {
    const {colour} = KINDS[path.kind];
    const bold = samePath(path, chosen);
    const many = isClosed(path) ? leaflet.polygon : leaflet.polyline;
    const style = {renderer, fill: false};
    drawn.addLayer(many(points, {
      ...style, ...fixed, color: WHITE, weight: bold ? 6 : 5, opacity: 0.75}));
    drawn.addLayer(many(points, {
      ...style, color: colour, weight: bold ? 3.4 : 2.2,
      dashArray: path.kind === "allowed" ? "7 5" : null,
    }).on("click", () => { hit = path; }));
  }

  /* The smallest shape lies on top, and takes a click that several could. */
  const areaIn = (path) => (isClosed(path) ? areaOf(pointsOf(shapes, path)) : 0);

  function render() {
    pane.style.pointerEvents = active ? "" : "none";
    drawn.clearLayers();
    if (active) {
      shapes.no_go.forEach(({outer, holes}) => drawn.addLayer(leaflet.polygon([outer, ...holes], {
        ...fixed, renderer, stroke: false, fillColor: KINDS.no_go.colour, fillOpacity: 0.22,
      })));
      paths(shapes).sort((a, b) => areaIn(b) - areaIn(a))
        .forEach((path) => outline(pointsOf(shapes, path), path));
    }
    toolsShown();
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

  /* A click that no tool takes chooses what is there; the map hears it after the shape, and a tool
     may be put down by it. */
  let isFree = true;
  const listeners = {
    preclick() { [hit, isFree] = [null, map.getContainer().dataset.tool === undefined]; },
    click() { if (isFree) choose(hit); },
  };

  /* ---- Drawing ---- */

  function begin(kind, inside = null) {
    tool.begin({
      kind: kind === "corridors" ? "line" : "polygon", colour: KINDS[kind].colour,
        ended: toolsShown,
      done(points) {
        const added = addRing(shapes, kind, points, inside);
        chosen = added.path;
        changed(added.shapes);
      },
    });
    toolsShown();
  }

  const choices = Object.entries(KINDS).map(([kind, {title}]) => button(title, () => begin(kind)));
  const holes = button("Hole", () => begin(chosen.kind, chosen), {
    title: "A no-go zone within the chosen area"});
  choices.splice(1, 0, holes);
  const tools = el("div", {class: "buttons", role: "group", "aria-label": "Draw on the map"},
    choices);

  function toolsShown() {
    tools.hidden = tool.isDrawing();
    holes.disabled = !chosen || chosen.kind !== "survey" || chosen.ring > 0;
    edges.show(active && !tool.isDrawing() && chosen ? targetOf(shapes, chosen) : null);
  }

  /* ---- The list of shapes ---- */

  const items = el("ul", {class: "plan-list"});
  let listed = "";

  function list() {
    const rows = paths(shapes)
      .map((path) => [path, nameOf(shapes, path), sizeOf(shapes, path), samePath(path, chosen)]);
    const now = JSON.stringify(rows);
    if (now === listed) return;
    listed = now;
    const focused = items.contains(document.activeElement)
      ? document.activeElement.dataset.at : null;
    items.replaceChildren(...rows.map(([path, name, size, on]) => el(
      "li", {},
      button([name, el("small", {}, size)], () => {
        choose(on ? null : path);
        if (!on) edges.focus();
      }, {"aria-pressed": String(on), "data-at": name, class: "choose"}),
      button("Delete", () => changed(removeRing(shapes, path)),
        {"aria-label": "Delete " + name.toLowerCase(), "data-at": "x" + name}),
    )));
    if (focused) (items.querySelector(`[data-at="${CSS.escape(focused)}"]`) || choices[0]).focus();
  }

  function enter() {
    active = true;
    drawn.addTo(map);
    map.on(listeners);
    render();
  }

  function leave() {
    active = false;
    map.off(listeners);
    render();
    drawn.remove();
  }

  const panel = el("div", {}, tools, tool.element, items);
  toolsShown();
  return {panel, update, enter, leave};
}
