/* Areas, zones and corridors on the map: draw them by clicks, choose one, edit it by its
   handles. */

import {button, el} from "./core.js";
import {drawingTool} from "./drawing.js";
import {WHITE} from "./palette.js";
import {
  KINDS, addRing, insertVertex, isClosed, moveRing, moveVertex, nameOf, noShapes, pathAt, paths,
    pointsOf, removeRing,
  removeVertex, samePath, sizeOf,
} from "./plan_shapes.js";
import {vertexHandles} from "./vertices.js";

const REACH_PX = 9;
const fixed = {interactive: false};

/* A ring as what handles edit. */
const targetOf = (shapes, path) => ({
  value: shapes, name: nameOf(shapes, path).toLowerCase(),
    word: isClosed(path) ? "Corner" : "Point",
  rings: [{points: pointsOf(shapes, path), closed: isClosed(path)}],
  move: (_, i, place) => moveVertex(shapes, path, i, place),
  insert: (_, after, place) => insertVertex(shapes, path, after, place),
  remove: (_, i) => removeVertex(shapes, path, i),
  shift: (north, east) => moveRing(shapes, path, north, east),
  drop: () => removeRing(shapes, path),
});

/* `changed(shapes, tag)` takes an edit and `moving(shapes)` one that goes on. */
export function drawing(studio, {changed, moving}) {
  const map = studio.map.leaflet;
  const pane = map.createPane("plan-shapes");
  pane.style.pointerEvents = "none";
  const renderer = leaflet.canvas({pane: "plan-shapes", padding: 0.3});
  const drawn = leaflet.featureGroup();
  const tool = drawingTool(studio, "plan");
  let [shapes, chosen, active] = [noShapes(), null, false];
  const edges = vertexHandles(map, "plan", {
    changed, moving,
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

  /* A click that no tool takes chooses what is there. */
  function pick({latlng: {lat, lng}}) {
    if (document.getElementById("map-canvas").dataset.tool !== undefined) return;
    choose(pathAt(shapes, [lat, lng], REACH_PX / 2 ** map.getZoom()));
  }

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
    map.on("click", pick);
    render();
  }

  function leave() {
    active = false;
    map.off("click", pick);
    render();
    drawn.remove();
  }

  const panel = el("div", {}, tools, tool.element, items);
  toolsShown();
  return {panel, update, enter, leave};
}
