/* Annotations on the map, with colour, letters and dashes, and their shapes as handles edit them. */

import {el} from "./core.js";
import {INK, WHITE} from "./palette.js";

const DASHES = [null, "8 4", "2 5", "12 4 2 4", "4 4", "16 6", "1 4 6 4", "10 3 3 3"];
const LETTERED = 400;
const CIRCLE_SIDES = 64;

const latLng = ([east, north]) => leaflet.latLng(north, east);

/* The rings of a shape; a circle's as a polygon. */
function ringsOf(shape) {
  if (shape.kind !== "circle") return [shape.points, ...(shape.holes || [])];
  const [[x, y]] = shape.points;
  return [Array.from({length: CIRCLE_SIDES}, (_, n) => {
    const turn = 2 * Math.PI * n / CIRCLE_SIDES;
    return [x + shape.radius * Math.cos(turn), y + shape.radius * Math.sin(turn)];
  })];
}

export const isArea = (shape) => ["polygon", "rectangle", "circle"].includes(shape.kind);

function middleOf(rings) {
  const box = leaflet.latLngBounds(rings[0].map(latLng));
  return box.getCenter();
}

/* An element at a place of the map. */
class Sign extends leaflet.Layer {
  constructor(body, at) {
    super();
    this.body = body;
    this.at = at;
    Object.assign(body.style, {position: "absolute", left: "0", top: "0"});
    this.place = () => this.moveTo(this.at);
  }

  moveTo(at) {
    this.at = at;
    const spot = this._map.latLngToLayerPoint(at);
    this.body.style.translate = spot.x + "px " + spot.y + "px";
  }

  onAdd(map) {
    map.getPane("markerPane").append(this.body);
    map.on("zoom viewreset", this.place);
    this.place();
  }

  onRemove(map) {
    map.off("zoom viewreset", this.place);
    this.body.remove();
  }
}

/* A small sign with the letters of a label: colour is never alone. */
function letters(label, at, chosen) {
  return new Sign(el("span", {"aria-hidden": "true", style: {
    transform: "translate(-50%, -50%)", padding: "1px 5px", borderRadius: "4px", pointerEvents: "none",
    font: "700 12px/1.3 system-ui, sans-serif", color: WHITE, background: INK,
    border: "2px solid " + (chosen ? WHITE : label.colour), whiteSpace: "nowrap",
  }}, label.code || "?"), at);
}

export function annotationsOn(studio, choose) {
  const map = studio.map.leaflet;
  const group = leaflet.featureGroup();

  /* Show these: [{annotation, label, number, shape}], shapes in east and north. */
  function draw(marks, chosenId) {
    group.clearLayers();
    marks.forEach(({annotation, label, number, shape}) => {
      const chosen = annotation.id === chosenId;
      const rings = ringsOf(shape);
      const places = rings.map((ring) => ring.map(latLng));
      const style = {
        color: label.colour, weight: chosen ? 4 : 2.5, dashArray: DASHES[number % DASHES.length],
        fillColor: label.colour, fillOpacity: chosen ? 0.4 : 0.25,
      };
      const rim = {color: chosen ? WHITE : INK, weight: (chosen ? 4 : 2.5) + 2.5, opacity: 0.8, fill: false, interactive: false};
      let drawn = null;
      if (shape.kind === "point") {
        drawn = leaflet.circleMarker(places[0][0], {
          radius: chosen ? 8 : 6, color: WHITE, weight: 2, fillColor: label.colour, fillOpacity: 1,
        });
      } else if (shape.kind === "polyline") {
        group.addLayer(leaflet.polyline(places[0], rim));
        drawn = leaflet.polyline(places[0], style);
      } else {
        group.addLayer(leaflet.polygon(places, rim));
        drawn = leaflet.polygon(places, style);
      }
      drawn.on("click", () => {
        if (map.getContainer().dataset.tool === undefined) choose(annotation.id);
      });
      group.addLayer(drawn);
      if (marks.length <= LETTERED || chosen) {
        const at = shape.kind === "point" ? leaflet.latLng(places[0][0]) : middleOf(rings);
        group.addLayer(letters(label, at, chosen));
      }
    });
  }

  function show(on) {
    if (on) group.addTo(map);
    else group.remove();
  }

  return {draw, show};
}

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
