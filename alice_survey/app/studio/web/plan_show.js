/* A plan on the map: its lines by kind, way, stations, footprints, counts, holes, homes. */

import {COUNTS, PLAN, WHITE} from "./palette.js";
import {paths, pointsOf} from "./plan_shapes.js";
import {drawStations} from "./plan_stations.js";
import {paintCounts} from "./plan_words.js";
import {counted} from "./words.js";

const LINES = ["survey", "cross", "closing", "fill", "tie"];
const MADE = ["area", "plan"];  /* layers of the shell */
const eastNorth = ([n, e]) => [e, n];
const MAX_POINTS = 500;

/* A way in pieces that join: Leaflet simplifies by recursion, as deep as a zigzag has points. */
function pieces(way) {
  const count = Math.ceil((way.length - 1) / MAX_POINTS);
  return Array.from({length: count}, (_, i) => way.slice(i * MAX_POINTS, (i + 1) * MAX_POINTS + 1));
}

/* The pixels of a picture: `data` of four bytes each, and a canvas that holds them. */
async function readPixels(address) {
  const image = new Image();
  image.src = address;
  await image.decode();
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [image.width, image.height];
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.drawImage(image, 0, 0);
  return {canvas, context, pixels: context.getImageData(0, 0, image.width, image.height)};
}

export function shown(studio) {
  const {map} = studio;
  const off = new Set(["plan-footprints"]);
  const away = new Set();
  let [names, stations, number, active, last, whole] = [new Set(), null, 0, false, null, null];
  let textAt = (_) => "";
  map.moreAt((place) => (active ? textAt(place) : ""));
  const lookAt = (extent) => { map.extend(extent); map.fit(false); };

  function put(about) {
    names.add(about.name);
    const layer = map.put({group: "The plan", texts: [], shapes: [], fill: 0,
      shown: !off.has(about.name), ...about});
    /* A click chooses an area; what a line is appears under the pointer. */
    layer.eachLayer?.((shape) => shape.off("click"));
    return layer;
  }

  function show(preview) {
    last = preview;
    if (!active || !preview?.ok) return;
    const before = names;
    names = new Set();
    stations?.remove();
    number += 1;
    textAt = () => "";
    putCounts(preview.counts, number);
    putLayers(preview);
    if (before.has("plan-counts")) names.add("plan-counts");
    before.forEach((name) => { if (!names.has(name)) map.remove(name); });
  }

  function putLayers({holes, homes, routes, outline, area, lines}) {
    put({
      kind: "polygon", name: "plan-allowed", title: "The vehicle may be within",
      colour: PLAN.allowed, dashed: true, width: 1.2,
      shapes: area.allowed.flat().map((ring) => [...ring, ring[0]].map(eastNorth)),
    });
    if (holes.length) put({
      kind: "polygon", name: "plan-holes", title: counted(holes.length, "hole"),
      colour: PLAN.missed, fill: 0.25, shapes: holes.map((hole) => hole.outer.map(eastNorth)),
    });
    const footprints = put({kind: "polygon", name: "plan-footprints", title: "Footprints",
      colour: PLAN.footprint});
    putLines("plan-way", "Way between lines", PLAN.way, routes.flatMap(pieces), 1.1);
    const drawn = lineLayers(lines);
    const points = put({kind: "point", name: "plan-stations", title: "Stations",
      colour: PLAN.survey});
    put({kind: "point", name: "plan-home", title: homes.length > 1 ? "Homes" : "Home",
      colour: PLAN.home, shapes: homes.map((home) => [eastNorth(home)])});
    stations = drawStations(map.leaflet, {
      lines: () => drawn.filter((line) => map.leaflet.hasLayer(line.group)),
      stations: points, footprints, outline,
    });
    stations.refresh();
  }

  /* Lines of one colour with a light rim: two shapes, however many lines there are. */
  function putLines(name, title, colour, lines, weight) {
    const group = put({kind: "line", name, title, colour});
    [[WHITE, 5], [colour, weight]].forEach(([color, wide]) => group.addLayer(leaflet.polyline(
      lines, {color, weight: wide, opacity: color === WHITE ? 0.75 : 1, interactive: false})));
    return group;
  }

  function lineLayers(lines) {
    let first = 0;
    const numbered = lines.map((line, index) => {
      const length = Math.hypot(line.to[0] - line.from[0], line.to[1] - line.from[1]);
      first += line.stations;
      return {...line, colour: PLAN[line.kind], first: first - line.stations,
        text: `Line ${index}, dive ${line.dive}: ${length.toFixed(2)} m, `
          + counted(line.stations, "station")};
    });
    return LINES.flatMap((kind) => {
      const own = numbered.filter((line) => line.kind === kind);
      if (!own.length) return [];
      const group = putLines("plan-" + kind, counted(own.length, kind + " line"), PLAN[kind],
        own.map(({from, to}) => [from, to]), 1.7);
      return own.map((line) => ({...line, group}));
    });
  }

  async function putCounts(counts, own) {
    const {canvas, context, pixels} = await readPixels(counts.png);
    if (own !== number || !active) return;
    const raw = pixels.data.slice();
    const most = paintCounts(pixels.data);
    context.putImageData(pixels, 0, 0);
    textAt = ({lat, lng}) => {
      const row = Math.floor((counts.north - lat) / counts.pixel);
      const column = Math.floor((lng - counts.west) / counts.pixel);
      if (row < 0 || column < 0 || row >= pixels.height || column >= pixels.width) return "";
      const [pictures, passes] = raw.slice(4 * (row * pixels.width + column));
      if (pictures === 255) return "";
      return `; ${pictures === 254 ? "254 or more" : pictures} pictures of `
        + counted(passes, "line");
    };
    put({...counts, kind: "picture", name: "plan-counts", address: canvas.toDataURL(),
      width: pixels.width, height: pixels.height, tile: Math.max(pixels.width, pixels.height),
      levels: 1, base: false, title: "Pictures that see a place",
      about: "Orange: below the requested overlap.",
      scale: {label: "pictures that see a place", low: 0, high: most, colours: COUNTS}});
  }

  /* Show all of a plan, and let "Show all" mean it. */
  function fit(shapes) {
    const ways = last?.ok ? [...last.routes, ...last.area.allowed.flat()] : [];
    const places = [...paths(shapes).map((path) => pointsOf(shapes, path)), ...ways].flat();
    if (!places.length) return;
    const bounds = leaflet.latLngBounds(places);
    const [south, west, north, east] = [bounds.getSouth(), bounds.getWest(), bounds.getNorth(),
      bounds.getEast()];
    const margin = 0.04 * Math.max(north - south, east - west, 1);
    whole = [west - margin, south - margin, east + margin, north + margin];
    lookAt(whole);
  }

  /* The plan as it was made is put away while the one in work is shown. */
  function alone() {
    MADE.filter((name) => map.layers.has(name) && map.leaflet.hasLayer(map.layers.get(name)))
      .forEach((name) => {
        away.add(name);
        map.show(name, false);
      });
  }

  function enter() {
    active = true;
    if (whole) lookAt(whole);
    alone();
    show(last);
  }

  function leave() {
    names.forEach((name) => {
      const layer = map.layers.get(name);
      if (layer && map.leaflet.hasLayer(layer)) off.delete(name);
      else off.add(name);
      map.remove(name);
    });
    names = new Set();
    stations?.remove();
    stations = null;
    active = false;
    lookAt(map.data.extent);
    away.forEach((name) => map.show(name, true));
    away.clear();
  }

  const dim = (on) => { map.leaflet.getContainer().closest("main").toggleAttribute(
    "data-planning", on); };
  return {show, fit, alone, enter, leave, dim};
}
