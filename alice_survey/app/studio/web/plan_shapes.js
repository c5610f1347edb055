/* Areas, zones and corridors as values: every function returns new ones.

   Shapes are {survey, no_go, allowed: [{outer, holes}, ...], corridors: [points, ...]}; points are
   [north, east] in metres, a ring's first not repeated. A path {kind, index, ring} names one ring:
   ring 0 is the outer one, ring 1 the first hole; of a corridor it is 0. */

import {PLAN} from "./palette.js";

export const KINDS = {
  survey: {title: "Survey area", colour: PLAN.area},
  no_go: {title: "No-go zone", colour: PLAN.no_go},
  allowed: {title: "Allowed area", colour: PLAN.allowed},
  corridors: {title: "Corridor", colour: PLAN.corridor},
};

export const noShapes = () => ({survey: [], no_go: [], allowed: [], corridors: []});

export const isClosed = (path) => path.kind !== "corridors";
const leastPoints = (path) => (isClosed(path) ? 3 : 2);
const millimetres = (place) => place.map((value) => Math.round(value * 1000) / 1000);
const replaced = (list, index, value) => list.map((item, i) => (i === index ? value : item));
const without = (list, index) => list.filter((_, i) => i !== index);

/* The paths of all rings, in the order that they are listed in. */
export function paths(shapes) {
  return Object.keys(KINDS).flatMap((kind) => (shapes[kind] || []).flatMap((shape, index) => (
    kind === "corridors" ? [{kind, index, ring: 0}]
      : [shape.outer, ...shape.holes].map((_, ring) => ({kind, index, ring}))
  )));
}

export const samePath = (a, b) => Boolean(a && b) && a.kind === b.kind && a.index === b.index
  && a.ring === b.ring;

/* The points of a ring or a corridor; an empty list where there is none. */
export function pointsOf(shapes, {kind, index, ring}) {
  const shape = (shapes[kind] || [])[index];
  if (!shape) return [];
  if (kind === "corridors") return shape;
  return (ring === 0 ? shape.outer : shape.holes[ring - 1]) || [];
}

function withShape(shapes, {kind, index}, shape) {
  return {...shapes, [kind]: replaced(shapes[kind], index, shape)};
}

function withPoints(shapes, path, points) {
  if (path.kind === "corridors") return withShape(shapes, path, points);
  const {outer, holes} = shapes[path.kind][path.index];
  return withShape(shapes, path, path.ring === 0
    ? {outer: points, holes} : {outer, holes: replaced(holes, path.ring - 1, points)});
}

export function moveVertex(shapes, path, vertex, place) {
  return withPoints(shapes, path, replaced(pointsOf(shapes, path), vertex, millimetres(place)));
}

/* A new vertex after another one, in the middle of its edge unless a place is given. */
export function insertVertex(shapes, path, after, place = null) {
  const points = pointsOf(shapes, path);
  const [start, end] = [points[after], points[(after + 1) % points.length]];
  const middle = place || [(start[0] + end[0]) / 2, (start[1] + end[1]) / 2];
  return withPoints(shapes, path, [
    ...points.slice(0, after + 1), millimetres(middle), ...points.slice(after + 1),
  ]);
}

/* Without a vertex; a ring that has too few left goes with it. */
export function removeVertex(shapes, path, vertex) {
  const points = pointsOf(shapes, path);
  if (points.length <= leastPoints(path)) return removeRing(shapes, path);
  return withPoints(shapes, path, without(points, vertex));
}

/* Without a hole, or without a whole shape where its outer ring is named. */
export function removeRing(shapes, path) {
  const {kind, index, ring} = path;
  if (ring === 0) return {...shapes, [kind]: without(shapes[kind], index)};
  const {outer, holes} = shapes[kind][index];
  return withShape(shapes, path, {outer, holes: without(holes, ring - 1)});
}

/* A hole moves alone, an outer ring takes its holes along. */
export function moveRing(shapes, path, north, east) {
  const moved = (points) => points.map(([n, e]) => millimetres([n + north, e + east]));
  if (path.kind === "corridors" || path.ring > 0) {
    return withPoints(shapes, path, moved(pointsOf(shapes, path)));
  }
  const {outer, holes} = shapes[path.kind][path.index];
  return withShape(shapes, path, {outer: moved(outer), holes: holes.map(moved)});
}

/* With one more shape of a kind, or a hole in the shape `inside` names; and the path of it. */
export function addRing(shapes, kind, points, inside = null) {
  const own = points.map(millimetres);
  if (inside) {
    const {outer, holes} = shapes[kind][inside.index];
    return {
      shapes: withShape(shapes, inside, {outer, holes: [...holes, own]}),
      path: {kind, index: inside.index, ring: holes.length + 1},
    };
  }
  const shape = kind === "corridors" ? own : {outer: own, holes: []};
  const before = shapes[kind] || [];
  return {shapes: {...shapes, [kind]: [...before, shape]},
    path: {kind, index: before.length, ring: 0}};
}

/* With the shapes of a file: survey areas, corridors and each other kind that it has replace
   ours. */
export function withImported(shapes, imported) {
  const some = (kind) => (imported[kind] || []).length > 0;
  const areas = some("survey") || some("corridors");
  return Object.fromEntries(Object.keys(KINDS).map((kind) => {
    const taken = kind === "survey" || kind === "corridors" ? areas : some(kind);
    return [kind, (taken ? imported[kind] : shapes[kind]) || []];
  }));
}

/* Area that a ring encloses, m². */
export function areaOf(points) {
  return Math.abs(points.reduce((sum, [n, e], i) => {
    const [n1, e1] = points[(i + 1) % points.length];
    return sum + n * e1 - n1 * e;
  }, 0)) / 2;
}

/* Length along points, m. */
function lengthOf(points) {
  return points.slice(1).reduce(
    (sum, [n, e], i) => sum + Math.hypot(n - points[i][0], e - points[i][1]), 0,
  );
}

/* "No-go zone 2", "Hole 1 of survey area"; a number only where there are several. */
export function nameOf(shapes, {kind, index, ring}) {
  const several = shapes[kind].length > 1 ? " " + (index + 1) : "";
  const name = KINDS[kind].title + several;
  if (ring === 0) return name;
  const holes = shapes[kind][index].holes.length > 1 ? " " + ring : "";
  return "Hole" + holes + " of " + name[0].toLowerCase() + name.slice(1);
}

/* "4 corners, 255.0 m²" or "3 points, 41.2 m". */
export function sizeOf(shapes, path) {
  const points = pointsOf(shapes, path);
  return isClosed(path)
    ? points.length + " corners, " + areaOf(points).toFixed(1) + " m²"
    : points.length + " points, " + lengthOf(points).toFixed(1) + " m";
}
