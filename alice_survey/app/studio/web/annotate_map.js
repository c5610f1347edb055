/* Annotations on the map, with colour, letters and dashes. */

import {ringsOf} from "./annotate_shapes.js";
import {el} from "./core.js";
import {INK, WHITE} from "./palette.js";

const DASHES = [null, "8 4", "2 5", "12 4 2 4", "4 4", "16 6", "1 4 6 4", "10 3 3 3"];
const LETTERED = 400;

const latLng = ([east, north]) => leaflet.latLng(north, east);

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
function letters(label, at) {
  return new Sign(el("span", {"aria-hidden": "true", style: {
    transform: "translate(-50%, -50%)", padding: "1px 5px", borderRadius: "4px", pointerEvents: "none",
    font: "700 12px/1.3 system-ui, sans-serif", color: WHITE, background: INK,
    border: "2px solid " + label.colour, whiteSpace: "nowrap",
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
      if (marks.length <= LETTERED && !chosen) {  /* which has its handles there */
        const at = shape.kind === "point" ? leaflet.latLng(places[0][0]) : middleOf(rings);
        group.addLayer(letters(label, at));
      }
    });
  }

  function show(on) {
    if (on) group.addTo(map);
    else group.remove();
  }

  return {draw, show};
}
