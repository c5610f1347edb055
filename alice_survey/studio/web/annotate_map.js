/* Annotations on the map: drawn with colour, letters and dashes; tools that draw and edit them. */

import {el} from "./core.js";
import {INK, WHITE} from "./palette.js";

const DASHES = [null, "8 4", "2 5", "12 4 2 4", "4 4", "16 6", "1 4 6 4", "10 3 3 3"];
const LETTERED = 400;
const CIRCLE_SIDES = 64;

const latLng = ([east, north]) => leaflet.latLng(north, east);
const placeOf = (at) => [at.lng, at.lat];
const rounded = (shape) => JSON.parse(JSON.stringify(shape));

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

/* A handle at a vertex: dragged, or moved by its keys. */
function handle(at, name, dropped, keyed) {
  const body = el("button", {type: "button", "aria-label": name, onkeydown: keyed, style: {
    transform: "translate(-50%, -50%)", width: "18px", height: "18px", padding: "0", borderRadius: "50%",
    background: WHITE, border: "4px solid #16232b", cursor: "move", touchAction: "none", zIndex: "500",
  }});
  const sign = new Sign(body, at);
  ["mousedown", "click", "dblclick"].forEach((kind) => body.addEventListener(kind, (event) => event.stopPropagation()));
  body.addEventListener("pointerdown", (event) => {
    event.stopPropagation();
    body.setPointerCapture(event.pointerId);
    const map = sign._map;
    let moved = false;
    const follow = (one) => {
      moved = true;
      sign.moveTo(map.mouseEventToLatLng(one));
    };
    body.addEventListener("pointermove", follow);
    body.addEventListener("pointerup", () => {
      body.removeEventListener("pointermove", follow);
      if (moved) dropped(placeOf(sign.at));
    }, {once: true});
  });
  return sign;
}

export function annotationsOn(studio, choose) {
  const map = studio.map.leaflet;
  const group = leaflet.featureGroup();
  const handles = leaflet.featureGroup();
  let shown = false;

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

  /* Handles at the vertices of a shape; `changed(shape)` after each change of one. */
  function edit(shape, step, changed) {
    handles.clearLayers();
    if (!shape || shape.kind === "circle") return;
    const rings = [shape.points, ...(shape.holes || [])];
    const least = {point: 1, polyline: 2, polygon: 3, rectangle: 4}[shape.kind];
    const fixed = ["point", "rectangle"].includes(shape.kind);
    rings.forEach((ring, r) => ring.forEach((place, n) => {
      const put = (at) => {
        const next = rounded(shape);
        const target = r ? next.holes[r - 1] : next.points;
        if (shape.kind === "rectangle") moveCorner(target, n, at);
        else target[n] = at;
        changed(next, [r, n]);
      };
      const keyed = (event) => {
        const far = step * (event.shiftKey ? 10 : 1);
        const way = {ArrowLeft: [-far, 0], ArrowRight: [far, 0], ArrowUp: [0, far], ArrowDown: [0, -far]}[event.key];
        const next = rounded(shape);
        const target = r ? next.holes[r - 1] : next.points;
        if (way) put([place[0] + way[0], place[1] + way[1]]);
        else if (event.key === "Delete" && !fixed && target.length > (r ? 3 : least)) {
          target.splice(n, 1);
          changed(next, [r, Math.max(0, n - 1)]);
        } else if (event.key.toLowerCase() === "i" && !fixed) {
          const after = ring[(n + 1) % ring.length];
          target.splice(n + 1, 0, [(place[0] + after[0]) / 2, (place[1] + after[1]) / 2]);
          changed(next, [r, n + 1]);
        } else return;
        event.preventDefault();
        event.stopPropagation();
      };
      const name = "Vertex " + (n + 1) + " of " + ring.length + (r ? ", hole " + r : "")
        + ": arrow keys move it, Shift ten times as far, Delete removes it, I inserts one after it";
      const sign = handle(latLng(place), name, put, keyed);
      sign.body.dataset.vertex = r + "," + n;
      handles.addLayer(sign);
      if (shown && !map.hasLayer(handles)) handles.addTo(map);
    }));
  }

  function focus([ring, number]) {
    map.getContainer().querySelector(`[data-vertex="${ring},${number}"]`)?.focus();
  }

  function show(on) {
    shown = on;
    [group, handles].forEach((layer) => (on ? layer.addTo(map) : layer.remove()));
  }

  return {draw, edit, focus, show};
}

/* Move a corner of a rectangle along its sides: the opposite one stays. */
function moveCorner(corners, n, at) {
  const [opposite, one, other] = [corners[(n + 2) % 4], (n + 1) % 4, (n + 3) % 4];
  const along = [corners[one][0] - opposite[0], corners[one][1] - opposite[1]];
  const length = Math.hypot(...along) || 1;
  const unit = along.map((v) => v / length);
  const away = [at[0] - opposite[0], at[1] - opposite[1]];
  const share = away[0] * unit[0] + away[1] * unit[1];
  corners[one] = [opposite[0] + share * unit[0], opposite[1] + share * unit[1]];
  corners[other] = [at[0] - share * unit[0], at[1] - share * unit[1]];
  corners[n] = at;
}

/* A tool that draws a shape of a kind; `done(shape)` when it is whole, `ended()` when it is put down. */
export function drawing(studio, kind, done, ended) {
  const map = studio.map.leaflet;
  const places = [];
  const line = leaflet.polyline([], {color: WHITE, weight: 3, dashArray: "5 4", interactive: false}).addTo(map);
  const rim = leaflet.polyline([], {color: INK, weight: 6, opacity: 0.6, interactive: false}).addTo(map);
  const least = {polyline: 2, polygon: 3}[kind];
  const box = ([a, b]) => [a, [b[0], a[1]], b, [a[0], b[1]]];

  function redraw(more) {
    const all = [...places, ...(more ? [more] : [])];
    const corners = kind === "rectangle" && all.length === 2 ? [...box(all), all[0]] : all;
    [rim, line].forEach((one) => one.setLatLngs(corners.map(latLng)));
    line.bringToFront();
  }

  function finish() {
    if (places.length < least) return;
    done({kind, points: places.slice(), holes: [], radius: null});
    places.length = 0;
    redraw();
  }

  const tool = {
    name: "annotate",
    click(at) {
      const place = placeOf(at);
      if (kind === "point") {
        done({kind, points: [place], holes: [], radius: null});
        return;
      }
      const near = (other) => map.latLngToContainerPoint(latLng(other)).distanceTo(map.latLngToContainerPoint(at)) < 8;
      if (least && places.length >= least && (near(places[0]) || near(places[places.length - 1]))) {
        finish();
        return;
      }
      if (places.length && near(places[places.length - 1])) return;
      places.push(place);
      redraw();
      if (kind === "rectangle" && places.length === 2) {
        const points = box(places);
        places.length = 0;
        redraw();
        done({kind, points, holes: [], radius: null});
      }
    },
    move: (at) => places.length && redraw(placeOf(at)),
    text() {
      if (kind === "point") return "; click or Enter sets a point";
      if (kind === "rectangle") return places.length ? "; click the opposite corner" : "; click a corner";
      return places.length < least ? "; click the vertices" : "; F or a click on the first vertex ends it";
    },
    keys: {
      f: finish,
      Backspace() {
        places.pop();
        redraw();
      },
    },
    end() {
      line.remove();
      rim.remove();
      ended();
    },
    finish,
  };
  return tool;
}
