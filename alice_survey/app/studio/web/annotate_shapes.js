/* Shapes of annotations as values, of places [east, north]: their rings, and how handles edit them. */

const CIRCLE_SIDES = 64;

/* The rings of a shape; a circle's as a polygon. */
export function ringsOf(shape) {
  if (shape.kind !== "circle") return [shape.points, ...(shape.holes || [])];
  const [[x, y]] = shape.points;
  return [Array.from({length: CIRCLE_SIDES}, (_, n) => {
    const turn = 2 * Math.PI * n / CIRCLE_SIDES;
    return [x + shape.radius * Math.cos(turn), y + shape.radius * Math.sin(turn)];
  })];
}

export const isArea = (shape) => ["polygon", "rectangle", "circle"].includes(shape.kind);

const turned = ([a, b]) => [b, a];
const replaced = (list, index, value) => list.map((item, i) => (i === index ? value : item));
const between = ([x0, y0], [x1, y1]) => [(x0 + x1) / 2, (y0 + y1) / 2];

/* The shape of an annotation as what handles edit: values are annotations, or null where none is left. */
export function targetOf(one) {
  const {shape} = one;
  const {kind} = shape;
  const closed = isArea(shape) && kind !== "circle";
  const rings = [shape.points, ...(shape.holes || [])];
  const withRings = ([points, ...holes]) => ({...one, shape: {...shape, points, holes}});
  const withRing = (ring, points) => withRings(replaced(rings, ring, points));
  const target = {
    value: one, name: kind === "polyline" ? "line" : kind, word: kind === "circle" ? "Middle" : closed ? "Corner" : "Point",
    rings: rings.map((points) => ({points: points.map(turned), closed})),
    move(ring, i, place) {
      const points = rings[ring];
      return withRing(ring, kind === "rectangle" ? withCorner(points, i, turned(place)) : replaced(points, i, turned(place)));
    },
    drop: () => null,
  };
  if (rings[0].length > 1) {
    target.shift = (north, east) => withRings(rings.map((points) => points.map(([x, y]) => [x + east, y + north])));
  }
  if (kind !== "polygon" && kind !== "polyline") return {...target, remove: () => null};
  const least = closed ? 3 : 2;
  return {
    ...target,
    insert(ring, after, place) {
      const points = rings[ring];
      const made = place ? turned(place) : between(points[after], points[(after + 1) % points.length]);
      return withRing(ring, [...points.slice(0, after + 1), made, ...points.slice(after + 1)]);
    },
    /* A ring that has too few left goes with its vertex. */
    remove(ring, i) {
      if (rings[ring].length > least) return withRing(ring, rings[ring].filter((_, n) => n !== i));
      return ring ? withRings(rings.filter((_, n) => n !== ring)) : null;
    },
  };
}

/* The corners of a rectangle, one of them moved along its sides: the opposite one stays. */
function withCorner(corners, n, at) {
  const [opposite, one, other] = [corners[(n + 2) % 4], (n + 1) % 4, (n + 3) % 4];
  const along = [corners[one][0] - opposite[0], corners[one][1] - opposite[1]];
  const length = Math.hypot(...along) || 1;
  const unit = along.map((v) => v / length);
  const share = (at[0] - opposite[0]) * unit[0] + (at[1] - opposite[1]) * unit[1];
  const moved = corners.slice();
  moved[one] = [opposite[0] + share * unit[0], opposite[1] + share * unit[1]];
  moved[other] = [at[0] - share * unit[0], at[1] - share * unit[1]];
  moved[n] = at;
  return moved;
}
