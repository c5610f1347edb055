/* Lines of a plan on a map, of a page and of the studio: stations and footprints in view, the
   station under the pointer, and counts of pictures. Places are metres north and east of the
   datum; Leaflet has them as latitude and longitude. */

const MAX_SHOWN = 3000;  /* stations and footprints in view that are drawn one by one */
const MAX_CHECKED = 60_000;  /* stations of lines in view, of which those in view are looked for */
const NEAR_PX = 14;
const FOOTPRINT = "#2e86c1";
const HOVER = "#b7950b";

/* The line nearest to a place and its station there, or null where none is within a distance. */
function nearestStation(lines, n, e, within) {
  let best = null;
  let least = within * within;
  lines.forEach((line) => {
    const [dn, de] = [line.n1 - line.n0, line.e1 - line.e0];
    const square = dn * dn + de * de;
    const along = square > 0 ? ((n - line.n0) * dn + (e - line.e0) * de) / square : 0;
    const t = Math.min(1, Math.max(0, along));
    const off = (line.n0 + t * dn - n) ** 2 + (line.e0 + t * de - e) ** 2;
    if (off < least) {
      least = off;
      best = {line, station: line.stations > 1 ? Math.round(t * (line.stations - 1)) : 0};
    }
  });
  return best;
}

function stationAt(line, i) {
  const t = line.stations > 1 ? i / (line.stations - 1) : 0;
  return [line.n0 + t * (line.n1 - line.n0), line.e0 + t * (line.e1 - line.e0)];
}

/** Places ahead and to starboard of a station of a line, on the map.
 * @param {number[]} place */
function aroundStation(line, place, offsets) {
  const [n, e] = place;
  const [c, s] = [Math.cos(line.heading), Math.sin(line.heading)];
  return offsets.map(([ahead, right]) => [n + ahead * c - right * s, e + ahead * s + right * c]);
}

/* A line as the functions of this file take it: of a plan's line, how it is drawn, and its first
   station's number. */
function stationLine([n0, e0], [n1, e1], about) {
  return {
    ...about, n0, e0, n1, e1, length: Math.hypot(n1 - n0, e1 - e0),
    heading: Math.atan2(e1 - e0, n1 - n0),
  };
}

/* Draw stations, footprints and the way of flight, as far as the screen has room for each.

   `lines()` are those shown now, `groups` the layers that they are drawn in, `stations` and
   `footprints` layers to fill; `outline` is a footprint, [ahead, right] of its station, `across`
   its width, `spacing` that of the lines; `counts` a picture: red pictures, green lines, red 255
   outside of the area; `style` is added to what is drawn. Returns `textAt` a place, `refresh`, and
   `remove`. */
function drawStations(
  map, {lines, groups, stations, footprints, outline, across, spacing, counts, style = {}}) {
  const metrePx = () => 2 ** map.getZoom();
  const arrows = leaflet.featureGroup().addTo(map);
  const hovered = leaflet.featureGroup().addTo(map);
  const fixed = {...style, interactive: false};

  function refresh() {
    const view = map.getBounds().pad(0.05);
    const [south, west, north, east] = [view.getSouth(), view.getWest(), view.getNorth(),
      view.getEast()];
    const inView = lines().filter(({n0, e0, n1, e1}) => (
      Math.max(n0, n1) >= south && Math.min(n0, n1) <= north && Math.max(e0, e1) >= west
        && Math.min(e0, e1) <= east
    ));
    stations.clearLayers();
    footprints.clearLayers();
    arrows.clearLayers();
    const thick = Math.min(1.7, Math.max(0.2, 0.3 * spacing * metrePx()));
    groups.forEach((group) => group.eachLayer((shape) => {
      shape.setStyle(shape.survey ? {weight: thick} : {stroke: thick > 1.6});
    }));
    if (inView.length <= 400) inView.forEach(arrow);
    const apartPx = (line) => line.length / Math.max(1, line.stations - 1) * metrePx();
    const far = inView.filter((line) => line.stations === 1 || apartPx(line) >= 6);
    const checked = far.reduce((sum, line) => sum + line.stations, 0) <= MAX_CHECKED ? far : [];
    const places = checked.flatMap((line) => Array.from(
      {length: line.stations}, (_, i) => [line, stationAt(line, i)]))
      .filter(([, [n, e]]) => n >= south && n <= north && e >= west && e <= east);
    if (map.hasLayer(stations) && places.length <= MAX_SHOWN) {
      places.forEach(([line, place]) => stations.addLayer(leaflet.circleMarker(place, {
        ...fixed, radius: Math.min(3.4, Math.max(1.3, apartPx(line) / 7)), stroke: false,
        fillColor: line.colour, fillOpacity: 1,
      })));
    }
    if (!map.hasLayer(footprints)) return;
    const drawn = {...fixed, color: FOOTPRINT, weight: 0.6, opacity: 0.5, fillOpacity: 0.05};
    if (places.length && places.length <= MAX_SHOWN && across * metrePx() > 6) {
      places.forEach(([line, place]) =>
        footprints.addLayer(leaflet.polygon(aroundStation(line, place, outline), drawn)));
    } else {  /* the bands that they make */
      const band = {...fixed, color: FOOTPRINT, weight: across * metrePx(), opacity: 0.16,
        lineCap: "butt"};
      inView.forEach(({n0, e0, n1, e1}) =>
        footprints.addLayer(leaflet.polyline([[n0, e0], [n1, e1]], band)));
    }
  }

  /* The way of flight, at a third of a line. */
  function arrow(line) {
    if (line.length * metrePx() < 24) return;
    const place = stationAt({...line, stations: 101}, 36);
    const size = 1 / metrePx();
    const head = [[7, 0], [-5, 4.6], [-2.5, 0], [-5, -4.6]].map(([a, b]) => [a * size, b * size]);
    arrows.addLayer(leaflet.polygon(aroundStation(line, place, head), {
      ...fixed, stroke: false, fillColor: line.colour, fillOpacity: 1,
    }));
  }

  function hover({latlng: {lat: n, lng: e}}) {
    hovered.clearLayers();
    if (map.getContainer()
      .dataset.tool !== undefined) return;  /* the pointer means something else */
    const found = nearestStation(lines(), n, e, NEAR_PX / metrePx());
    if (!found) return;
    const {line, station} = found;
    const place = stationAt(line, station);
    const drawn = {...fixed, color: HOVER, weight: 1.2, fillColor: "#f1c40f"};
    hovered.addLayer(
      leaflet.polyline([[line.n0, line.e0], [line.n1, line.e1]], {
      ...fixed, color: "#f1c40f", weight: 4, opacity: 0.75}));
    hovered.addLayer(
      leaflet.polygon(aroundStation(line, place, outline), {...drawn, fillOpacity: 0.18}));
    const content = document.createElement("span");
    Object.assign(content.style, {display: "block", whiteSpace: "pre-line", width: "max-content",
      maxWidth: "230px"});
    content.textContent = [
      line.text,
      "Station " + (line.first + station) + ", " + (station + 1) + " of " + line.stations,
      place[0].toFixed(3) + " m N, " + place[1].toFixed(3) + " m E",
    ].join("\n");
    leaflet.circleMarker(place, {...drawn, radius: 5, fillOpacity: 1}).addTo(hovered)
      .bindTooltip(content, {permanent: true, direction: "auto", offset: [8, 0]});
  }

  let pixels = null;
  if (counts) readPixels(counts.png).then((read) => { pixels = read; });

  function textAt({lat: n, lng: e}) {
    if (!pixels) return "";
    const row = Math.floor((counts.north - n) / counts.pixel);
    const column = Math.floor((e - counts.west) / counts.pixel);
    if (row < 0 || column < 0 || row >= pixels.height || column >= pixels.width) return "";
    const [pictures, passes] = pixels.data.slice(4 * (row * pixels.width + column));
    if (pictures === 255) return "";
    return "; " + (pictures === 254 ? "254 or more" : pictures) + " pictures of " + passes
      + (passes === 1 ? " line" : " lines");
  }

  const leave = () => hovered.clearLayers();
  map.on("moveend layerschanged", refresh);
  map.on("mousemove click", hover);
  map.on("mouseout", leave);
  function remove() {
    map.off("moveend layerschanged", refresh);
    map.off("mousemove click", hover);
    map.off("mouseout", leave);
    [arrows, hovered].forEach((group) => group.clearLayers().remove());
  }
  return {textAt, refresh, remove};
}

/* The pixels of a picture at an address: `data` of four bytes each, `width`, `height`. */
function readPixels(address) {
  const image = new Image();
  image.src = address;
  return image.decode().then(() => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.width, image.height];
    const context = canvas.getContext("2d", {willReadFrequently: true});
    context.drawImage(image, 0, 0);
    return context.getImageData(0, 0, image.width, image.height);
  });
}

if (typeof module !== "undefined") {
  module.exports = {aroundStation, nearestStation, stationAt};
}
