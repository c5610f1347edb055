/* Drawing in pictures as taken: a shape is clicked in one of those that show a place; and editing one
   that was drawn in a picture, by the same handles as on the map. */

import {isArea, ringsOf, targetOf} from "./annotate_shapes.js";
import {button, el, say} from "./core.js";
import {LEAST, rectangle} from "./drawing.js";
import {WHITE} from "./palette.js";
import {Wall} from "./picture_views.js";
import {vertexHandles} from "./vertices.js";
import {fixed} from "./words.js";

const CLOSEST = 4;  /* zoom to edit at: sixteen of the screen's pixels to one of the picture's */
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

/* With the second coordinate up, as maps have it. */
function upright(one) {
  const ring = (points) => points.map(([x, y]) => [x, -y]);
  const {shape} = one;
  return {...one, shape: {...shape, points: ring(shape.points), holes: (shape.holes || []).map(ring)}};
}

/* `now()` is the annotation as it stands, `changed(one, tag)` takes it as edited, or null where none is left. */
export function pictureEditing({now, changed}) {
  let [image, view, handles] = [null, null, null];
  const wall = new Wall({opened});
  wall.list.classList.add("alone");
  wall.root.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    event.stopPropagation();
    wall.hide();
  });

  function begin(one, colour) {
    [image, view, handles] = [one.image, null, null];
    wall.show("Drag the corners, or use the arrow keys", [{name: image, x: 0, y: 0, colour, closest: CLOSEST, ...outlineOf(one)}]);
  }

  const outlineOf = (one) => ({rings: ringsOf(one.shape), closed: isArea(one.shape)});

  function opened(made) {
    view = made;
    handles = vertexHandles(view.map, "picture", {
      text: ([y, x]) => fixed(x, 1) + " right, " + fixed(-y, 1, "px") + " down",
      changed: take, moving: (next) => show(upright(next)), left: () => view.box.focus(),
    });
    show(now());
    handles.focus();
  }

  function take(next, tag) {
    if (!next) {
      wall.hide();
      changed(null);
      return;
    }
    const one = upright(next);
    const [wide, high] = view.size;
    if (ringsOf(one.shape).flat().some(([x, y]) => x < 0 || y < 0 || x > wide || y > high)) {
      say("It has to stay within the picture", "warn");
      show(now());
    } else changed(one, tag);
  }

  function show(one) {
    view.outline(outlineOf(one), false);
    handles.show(targetOf(upright(one)));
  }

  /* The annotation is another now, or gone. */
  function refresh() {
    if (wall.root.hidden) return;
    const one = now();
    if (!one || one.image !== image) wall.hide();
    else if (handles) show(one);
  }

  return {begin, refresh, hide() { wall.hide(); }};
}
