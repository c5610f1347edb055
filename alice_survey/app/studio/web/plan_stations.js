/* Stations, footprints and the way of flight of a plan's lines, as far as the screen has room, and
   the station under the pointer. */

const MAX_SHOWN = 3000;  /* stations in view that are drawn one by one */
const MAX_CHECKED = 60_000;  /* stations of lines in view, of which those in view are looked for */
const MAX_ARROWS = 400;
const NEAR_PX = 14;
const FOOTPRINT = "#2e86c1";
const HOVER = {color: "#b7950b", weight: 1.2, fillColor: "#f1c40f"};
const fixed = {interactive: false};

function stationAt({from, to, stations}, i) {
  const t = stations > 1 ? i / (stations - 1) : 0;
  return [0, 1].map((axis) => from[axis] + t * (to[axis] - from[axis]));
}

/* The line nearest to a place and its station there, or null where none is within a distance. */
export function nearestStation(lines, [n, e], within) {
  let [best, least] = [null, within];
  lines.forEach((line) => {
    const [[n0, e0], [n1, e1]] = [line.from, line.to];
    const square = (n1 - n0) ** 2 + (e1 - e0) ** 2;
    const along = square > 0 ? ((n - n0) * (n1 - n0) + (e - e0) * (e1 - e0)) / square : 0;
    const t = Math.min(1, Math.max(0, along));
    const away = Math.hypot(n0 + t * (n1 - n0) - n, e0 + t * (e1 - e0) - e);
    if (away < least) {
      least = away;
      best = {line, station: Math.round(t * Math.max(0, line.stations - 1))};
    }
  });
  return best;
}

/* Places [north, east] ahead and to starboard of a place on a line. */
export function around({from, to}, place, offsets) {
  const [n, e] = place;
  const heading = Math.atan2(to[1] - from[1], to[0] - from[0]);
  const [c, s] = [Math.cos(heading), Math.sin(heading)];
  return offsets.map(([ahead, right]) => [n + ahead * c - right * s, e + ahead * s + right * c]);
}

/* Lines are {from, to, stations, first, colour, text}. `lines()` are those shown now; `stations`
   and `footprints` are layers to fill; `outline` is a footprint, [ahead, right] of its station. */
export function drawStations(map, {lines, stations, footprints, outline}) {
  const px = () => 2 ** map.getZoom();
  const arrows = leaflet.featureGroup().addTo(map);
  const hovered = leaflet.featureGroup().addTo(map);
  const lengthPx = ({from, to}) => Math.hypot(to[0] - from[0], to[1] - from[1]) * px();
  const apartPx = (line) => lengthPx(line) / Math.max(1, line.stations - 1);

  function refresh() {
    const view = map.getBounds().pad(0.05);
    const inView = lines().filter(({from, to}) =>
      view.intersects(leaflet.latLngBounds([from, to])));
    [stations, footprints, arrows].forEach((group) => group.clearLayers());
    if (inView.length <= MAX_ARROWS) inView.forEach(arrow);
    const far = inView.filter((line) => line.stations === 1 || apartPx(line) >= 6);
    if (far.reduce((sum, line) => sum + line.stations, 0) > MAX_CHECKED) return;
    const places = far.flatMap((line) => Array.from(
      {length: line.stations}, (_, i) => [line, stationAt(line, i)]))
      .filter(([, place]) => view.contains(place));
    if (places.length > MAX_SHOWN) return;
    if (map.hasLayer(stations)) {
      places.forEach(([line, place]) => stations.addLayer(leaflet.circleMarker(place, {
        ...fixed, radius: Math.min(3.4, Math.max(1.3, apartPx(line) / 7)), stroke: false,
        fillColor: line.colour, fillOpacity: 1,
      })));
    }
    if (map.hasLayer(footprints)) {
      places.forEach(([line, place]) => footprints.addLayer(leaflet.polygon(
        around(line, place, outline),
        {...fixed, color: FOOTPRINT, weight: 0.6, opacity: 0.5, fillOpacity: 0.05})));
    }
  }

  /* The way of flight, at a third of a line. */
  function arrow(line) {
    if (lengthPx(line) < 24) return;
    const head = [[7, 0], [-5, 4.6], [-2.5, 0], [-5, -4.6]].map(([a, b]) => [a / px(), b / px()]);
    arrows.addLayer(leaflet.polygon(
      around(line, stationAt({...line, stations: 101}, 36), head),
      {...fixed, stroke: false, fillColor: line.colour, fillOpacity: 1}));
  }

  function hover({latlng: {lat, lng}}) {
    hovered.clearLayers();
    if (map.getContainer().dataset.tool !== undefined) return;
    const found = nearestStation(lines(), [lat, lng], NEAR_PX / px());
    if (!found) return;
    const {line, station} = found;
    const place = stationAt(line, station);
    hovered.addLayer(leaflet.polygon(
      around(line, place, outline), {...fixed, ...HOVER, fillOpacity: 0.18}));
    const content = document.createElement("span");
    content.className = "plan-station";
    content.textContent = [line.text, `Station ${line.first + station}, ${station + 1} of ${
      line.stations}`, `${place[0].toFixed(3)} m N, ${place[1].toFixed(3)} m E`].join("\n");
    leaflet.circleMarker(place, {...fixed, ...HOVER, radius: 5, fillOpacity: 1}).addTo(hovered)
      .bindTooltip(content, {permanent: true, direction: "auto", offset: [8, 0]});
  }

  const leave = () => hovered.clearLayers();
  const listeners = {"moveend layerschanged": refresh, "mousemove click": hover, mouseout: leave};
  map.on(listeners);
  function remove() {
    map.off(listeners);
    [arrows, hovered].forEach((group) => group.clearLayers().remove());
  }
  return {refresh, remove};
}
