/* A plan on the map: its lines by kind, way, stations, footprints, counts, holes, homes. */

import {COUNTS, PLAN, WHITE} from "./palette.js";
import {boundsOf} from "./plan_shapes.js";
import {paintCounts} from "./plan_words.js";
import {counted} from "./words.js";

const LINES = ["survey", "cross", "closing", "fill", "tie"];
const GROUP = "The plan";
const MADE = ["area", "plan"];  /* layers of the shell */
const eastNorth = ([n, e]) => [e, n];
const MAX_POINTS = 500;

/* A way in pieces that join: Leaflet simplifies by recursion, as deep as a zigzag has points. */
function pieces(way) {
  const count = Math.ceil((way.length - 1) / MAX_POINTS);
  return Array.from({length: count}, (_, i) => way.slice(i * MAX_POINTS, (i + 1) * MAX_POINTS + 1));
}

export function shown(studio) {
  const {map} = studio;
  const off = new Set(["plan-footprints"]);
  const away = new Set();
  const marks = leaflet.featureGroup();
  let [names, stations, number, active, last, sigmaLayer, whole, fitted] =
    [new Set(), null, 0, false, null, null, null, ""];
  map.moreAt((place) => (active && stations ? stations.textAt(place) : ""));

  function put(about) {
    names.add(about.name);
    const layer = map.put({
      group: GROUP, texts: [], fill: 0, dashed: false, about: "", shown: !off.has(about.name),
        ...about,
    });
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
    putCounts(preview.counts, number);
    putLayers(preview);
    if (before.has("plan-counts") && preview.counts) names.add("plan-counts");
    if (sigmaLayer) putSigma(sigmaLayer);
    before.forEach((name) => { if (!names.has(name)) map.remove(name); });
  }

  function putLayers(preview) {
    const {totals, holes, homes, routes, outline, area} = preview;
    put({
      kind: "polygon", name: "plan-allowed", title: "The vehicle may be within",
        colour: PLAN.allowed, dashed: true, width: 1.2,
      shapes: area.allowed.flat().map((ring) => [...ring, ring[0]].map(eastNorth)),
    });
    if (holes.length) {
      put({
        kind: "polygon", name: "plan-holes", title: counted(holes.length, "hole"),
          colour: PLAN.missed, fill: 0.25,
        shapes: holes.map((hole) => hole.outer.map(eastNorth)),
        texts: holes.map((hole) => "Not seen: " + hole.area_m2.toFixed(2) + " m²"),
      });
    }
    const footprints =
      put({kind: "polygon", name: "plan-footprints", title: "Footprints", colour: PLAN.footprint,
      shapes: []});
    putLines("plan-way", "Way between lines", PLAN.way, routes.flatMap(pieces), 1.1);
    const drawn = lineLayers(preview.lines);
    const points = put(
      {kind: "point", name: "plan-stations", title: "Stations", colour: PLAN.survey, shapes: []});
    put({
      kind: "point", name: "plan-home", title: homes.length > 1 ? "Homes" : "Home",
        colour: PLAN.home, shapes: homes.map((home) => [eastNorth(home)]),
    });
    const rights = outline.map(([, right]) => right);
    stations = drawStations(map.leaflet, {
      lines: () => drawn.lines.filter((line) => map.leaflet.hasLayer(line.group)),
      groups: drawn.groups, stations: points, footprints, outline, spacing: totals.line_spacing_m,
      across: Math.max(...rights) - Math.min(...rights), counts: preview.counts,
    });
    stations.refresh();
  }

  /* Lines of one colour with a light rim: two shapes, however many lines there are. */
  function putLines(name, title, colour, lines, weight) {
    const group = put({kind: "line", name, title, colour, shapes: []});
    const rim = leaflet.polyline(
      lines, {color: WHITE, weight: 5, opacity: 0.75, interactive: false});
    const drawn = leaflet.polyline(lines, {color: colour, weight, interactive: false});
    drawn.survey = {title, text: ""};
    group.addLayer(rim).addLayer(drawn);
    return group;
  }

  function lineLayers(lines) {
    let first = 0;
    const numbered = lines.map((line, index) => {
      const entry = {...line, index, first};
      first += line.stations;
      return entry;
    });
    const kinds = LINES.filter((kind) => lines.some((line) => line.kind === kind));
    const groups = [];
    const drawn = kinds.flatMap((kind) => {
      const own = numbered.filter((line) => line.kind === kind);
      const ends = own.map(({from, to}) => [from, to]);
      const group = putLines("plan-" + kind, counted(own.length, kind + " line"), PLAN[kind], ends,
        1.7);
      groups.push(group);
      return own.map((line) => {
        const made = stationLine(line.from, line.to, {
          group, index: line.index, first: line.first, stations: line.stations, colour: PLAN[kind],
        });
        const heading = ((made.heading * 180 / Math.PI) + 360) % 360;
        made.text = "Line " + line.index + ", dive " + line.dive + ": " + made.length.toFixed(2)
          + " m, heading "
          + heading.toFixed(1) + "°, " + counted(line.stations, "station");
        return made;
      });
    });
    return {lines: drawn, groups};
  }

  async function putCounts(counts, own) {
    if (!counts) return;
    const pixels = await readPixels(counts.png);
    if (own !== number || !active) return;
    const most = paintCounts(pixels.data);
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [pixels.width, pixels.height];
    canvas.getContext("2d").putImageData(pixels, 0, 0);
    putPicture("plan-counts", "Pictures that see a place", canvas.toDataURL(),
      {...counts, ...size(pixels)}, {
      about: "Orange: below the requested overlap.",
      scale: {label: "pictures that see a place", low: 0, high: most, colours: COUNTS},
    });
  }

  const size = ({width, height}) => ({width, height});
  function putPicture(name, title, address, {north, west, pixel, width, height}, more) {
    put({
      kind: "picture", name, title, address, north, west, pixel, width, height,
        tile: Math.max(width, height), levels: 1, base: false, ...more,
    });
  }

  async function putSigma(layer) {
    names.add("plan-sigma");
    const own = number;
    const pixels = await readPixels(layer.png);
    if (own !== number || !active) return;
    putPicture("plan-sigma", layer.title || "Expected sigma of the model", layer.png,
      {...layer, ...size(pixels)}, {scale: layer.scale});
  }

  /* The expected sigma as a layer, until the plan is another one. */
  function sigma(layer) {
    sigmaLayer = layer;
    if (layer) putSigma(layer);
    else {
      names.delete("plan-sigma");
      map.remove("plan-sigma");
    }
  }

  /* One place on the way, or none; with a heading as an arrow, and the way up to there. */
  function mark(place, heading = null, way = []) {
    marks.clearLayers();
    if (!place) return;
    const style = {color: WHITE, weight: 2, fillColor: PLAN.mark, fillOpacity: 1,
      interactive: false};
    if (way.length > 1) marks.addLayer(
      leaflet.polyline(way, {color: PLAN.mark, weight: 3, opacity: 0.8, interactive: false}));
    if (heading === null) marks.addLayer(leaflet.circleMarker(place, {...style, radius: 6}));
    else {
      const px = 1 / 2 ** map.leaflet.getZoom();
      const line = {heading: heading * Math.PI / 180};
      const arrow = [[14, 0], [-9, 8], [-4, 0], [-9, -8]].map(([a, b]) => [a * px, b * px]);
      marks.addLayer(leaflet.polygon(aroundStation(line, place, arrow), style));
    }
  }

  /* Show all of a plan, and let "Show all" mean it. */
  function fit(shapes) {
    const ways = last?.ok ? [...last.routes, ...last.area.allowed.flat()] : [];
    const bounds = boundsOf({...shapes, corridors: [...shapes.corridors, ...ways]});
    if (!bounds) return;
    const [south, west, north, east] = bounds;
    const margin = 0.04 * Math.max(north - south, east - west, 1);
    whole = [west - margin, south - margin, east + margin, north + margin];
    map.extend(whole);
    map.fit(false);
    fitted = viewOf();
  }
  const viewOf = () => [map.leaflet.getZoom(), ...Object.values(map.leaflet.getCenter())].join();

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
    if (whole) map.extend(whole);
    marks.addTo(map.leaflet);
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
    const isMoved = viewOf() !== fitted;
    map.extend(map.data.extent);
    if (!isMoved) map.fit(false);
    marks.remove();
    away.forEach((name) => map.show(name, true));
    away.clear();
  }

  const dim = (on) => { map.leaflet.getContainer().closest("main").toggleAttribute(
    "data-planning", on); };
  return {show, sigma, mark, fit, alone, enter, leave, dim};
}
