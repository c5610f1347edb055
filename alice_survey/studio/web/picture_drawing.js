/* Drawing in pictures as taken: a shape is clicked in one of those that show a place. */

import {button, el, say} from "./core.js";
import {LEAST, rectangle} from "./drawing.js";
import {WHITE} from "./palette.js";
import {Wall} from "./picture_views.js";

const MIDDLE = 0.5;  /* of a pixel, from its outer corner */
const onMap = ([x, y]) => [-y, x];

/* `done(image, kind, points)` takes a shape, in pixels from the outer corner of the first. */
export function pictureDrawing({done}) {
  let [kind, colour, view, points] = ["polygon", WHITE, null, []];
  const sketch = leaflet.featureGroup();
  const hint = el("span", {role: "status"});
  const finishing = button("Finish", finish, {title: "F"});
  const removing = button("Remove the last", removeLast, {title: "Backspace"});
  const wall = new Wall({changed: add});
  wall.root.querySelector(".bar-top").append(finishing, removing, hint);
  const keys = {f: finish, F: finish, Backspace: removeLast, Escape: () => wall.hide()};
  wall.root.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    keys[event.key]();
  });

  function begin(title, pictures, drawn) {
    ({kind, colour} = drawn);
    drop();
    wall.show(title, pictures);
  }

  function drop() {
    [view, points] = [null, []];
    show();
  }

  function add(picked) {
    const {x, y} = picked.pick;
    picked.set(null);
    picked.say("");
    if (view && view !== picked) {
      say("Finish what is begun in " + view.name + ", or remove it, before another picture", "warn");
      return;
    }
    view = picked;
    points.push([x + MIDDLE, y + MIDDLE]);
    show();
    if (points.length === {point: 1, rectangle: 2}[kind]) finish();
  }

  function removeLast() {
    points.pop();
    if (!points.length) view = null;
    show();
  }

  function show() {
    sketch.clearLayers().remove();
    const lacks = LEAST[kind] - points.length;
    finishing.disabled = lacks > 0;
    removing.disabled = !points.length;
    hint.textContent = lacks > 0
      ? "Click in a picture, or press Enter to take its middle: " + lacks + " more at least."
      : "Go on, or finish: press F.";
    if (!view) return;
    sketch.addTo(view.map);
    const places = points.map(onMap);
    const many = kind === "polygon" && places.length > 2 ? leaflet.polygon : leaflet.polyline;
    [[WHITE, 5], [colour, 2.6]].forEach(([color, weight]) => sketch.addLayer(many(places, {color, weight, fill: false, interactive: false})));
    places.forEach((one) => sketch.addLayer(leaflet.circleMarker(one, {radius: 5, color: WHITE, weight: 1.5, fillColor: colour, fillOpacity: 1, interactive: false})));
  }

  function finish() {
    if (points.length < LEAST[kind]) return;
    const [image, shape] = [view.name, kind === "rectangle" ? rectangle(points) : points];
    drop();
    done(image, kind, shape);
  }

  return {begin, hide() { wall.hide(); }};
}
