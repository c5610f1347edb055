/* Drawing on the map: a line or a polygon by clicks, or by Enter, which takes the map's middle; and
   what the panel says and offers meanwhile. */

import {button, el, say} from "./core.js";
import {WHITE} from "./palette.js";

const REACH_PX = 9;
/* Places that each kind of shape needs. */
const LEAST = {line: 2, polygon: 3};

export function drawingTool(studio, name) {
  const map = studio.map.leaflet;
  /* What is drawn is seen over all layers, and takes no clicks. */
  (map.getPane("drawing") || map.createPane("drawing")).style.pointerEvents = "none";
  const renderer = leaflet.canvas({pane: "drawing", padding: 0.3});
  const sketch = leaflet.featureGroup();
  const hint = el("p", {class: "note"});
  const finishing = button("Finish", () => finish(), {class: "primary", title: "F"});
  const removing = button("Remove the last", () => removeLast(), {title: "Backspace"});
  const several = [finishing, removing];
  const element = el("div", {class: "drawing", hidden: true}, hint,
    el("div", {class: "buttons"}, several, button("Cancel", () => studio.map.release(),
      {title: "Escape"})));
  let session = null;

  /* `done(points)` takes points [north, east]; `most` of them end it; `ended()` is called when the
     tool is put down. */
  function begin({kind, colour, most = Infinity, done, ended}) {
    studio.map.release();
    session = {kind, colour, most, done, points: []};
    const own = session;
    map.doubleClickZoom?.disable();
    sketch.addTo(map);
    studio.map.take({
      name,
      click: ({lat, lng}) => add([lat, lng]),
      move: ({lat, lng}) => drawn([lat, lng]),
      text: () => (session?.points.length ? "; " + session.points.length
        + " drawn" : "; Escape ends"),
      keys: {Backspace: () => removeLast(), f: () => finish()},
      end() {
        if (session === own) putDown();
        ended();
      },
    });
    document.getElementById("map-canvas").focus({preventScroll: true});
    element.hidden = false;
    several.forEach((one) => { one.hidden = most <= 2; });
    drawn();
  }

  function putDown() {
    session = null;
    sketch.clearLayers().remove();
    element.hidden = true;
    map.doubleClickZoom?.enable();
  }

  function add(point) {
    const {kind, points, most} = session;
    const px = (place) => map.latLngToContainerPoint(place);
    const near = (place) => place && px(place).distanceTo(px(point)) < REACH_PX;
    const enough = points.length >= LEAST[kind];
    const onLast = near(points.at(-1));
    if (enough && (onLast || (kind === "polygon" && near(points[0])))) finish();
    else if (onLast) say("That is the last place again: move the map or the pointer first", "warn");
    else {
      points.push(point);
      drawn();
      if (points.length >= most) finish();
    }
  }

  function drawn(pointer = null) {
    if (!session) return;
    const {kind, colour, points} = session;
    const all = pointer && points.length ? [...points, pointer] : points;
    const many = all.length > 2 && kind === "polygon" ? leaflet.polygon : leaflet.polyline;
    const style = {renderer, pane: "drawing", interactive: false};
    sketch.clearLayers();
    sketch.addLayer(many(all, {...style, color: WHITE, weight: 5, opacity: 0.75, fill: false}));
    sketch.addLayer(many(
      all, {...style, color: colour, weight: 2.6, dashArray: "6 4", fillOpacity: 0.08}));
    points.forEach((point) => sketch.addLayer(leaflet.circleMarker(point, {
      ...style, radius: 5, color: WHITE, weight: 1.5, fillColor: colour, fillOpacity: 1,
    })));
    if (!pointer) describe();
  }

  function describe() {
    const {kind, points} = session;
    const missing = LEAST[kind] - points.length;
    hint.textContent = missing > 0
      ? `Click on the map, or press Enter to take its middle: ${missing} more at least.`
      : "Go on, or finish: click the " + (kind === "polygon" ? "first" : "last")
        + " place again, or press F.";
    finishing.disabled = missing > 0;
    removing.disabled = !points.length;
  }

  function removeLast() {
    session?.points.pop();
    drawn();
  }

  function finish() {
    if (!session) return;
    const {kind, points, done} = session;
    if (points.length < LEAST[kind]) {
      say("Draw " + (LEAST[kind] - points.length) + " more at least");
      return;
    }
    studio.map.release();
    done(points);
  }

  return {element, begin, isDrawing: () => Boolean(session)};
}
