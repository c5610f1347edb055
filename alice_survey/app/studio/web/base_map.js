/* A web map under the survey: XYZ tiles of Web Mercator, laid straight about the datum, which is
   off by at most 0.2 m at 1 km from it at 60 degrees, and by the square of that farther away. */

import {el, field, say} from "./core.js";

const [AXIS_M, E2, RAD, FINEST] = [6378137, 0.00669437999014, Math.PI / 180, 19];
const KEPT = "alice-survey base map";

/* Tiles of a level, so many in a row: `boundsOf` one as Leaflet takes them, `tileAt` a place. */
export function gridAt([lat, lon], count) {
  const root = Math.sqrt(1 - E2 * Math.sin(lat * RAD) ** 2);
  const side = 2 * Math.PI * AXIS_M * Math.cos(lat * RAD) / root / count;
  const high = side * (1 - E2) / root ** 2;
  const column = (lon + 180) / 360 * count;
  const row = (1 - Math.asinh(Math.tan(lat * RAD)) / Math.PI) / 2 * count;
  return {
    boundsOf: (x, y) => [[(row - y - 1) * high, (x - column) * side],
      [(row - y) * high, (x + 1 - column) * side]],
    tileAt: (n, e) => [column + e / side, row - n / high].map(
      (at) => Math.min(count - 1, Math.max(0, Math.floor(at)))),
  };
}

const layerOf = (datum, address) => new (Pyramid.extend({
  _inView() {
    const view = this._map.getBounds();
    const {tileAt, boundsOf} = gridAt(datum, 2 ** this.level);
    const [left, top] = tileAt(view.getNorth(), view.getWest());
    const [right, bottom] = tileAt(view.getSouth(), view.getEast());
    const found = new Map();
    for (let x = left; x <= right; x += 1) {
      for (let y = top; y <= bottom; y += 1) found.set(`${this.level}/${x}/${y}`, boundsOf(x, y));
    }
    return found;
  },
  _uri: (name) => ["{z}", "{x}", "{y}"].reduce(
    (text, part, i) => text.replace(part, name.split("/")[i]), address),
}))({levels: FINEST + 1,
  pixel: 2 * Math.PI * AXIS_M * Math.cos(datum[0] * RAD) / 256 / 2 ** FINEST}, "under");

/* Its control in the list of layers, and `at`, which lays it about a datum. */
export function baseMap(map) {
  let [datum, layer] = [null, null];
  const address = el("input", {type: "url", value: localStorage.getItem(KEPT) || "",
    placeholder: "https://.../{z}/{x}/{y}.png", onchange: lay});
  const control = el("fieldset", {hidden: true}, el("legend", {}, "Base map"), field(
    "Address of its tiles", address, "Loaded from the network; empty for none."));

  function lay() {
    const text = address.value.trim();
    const isOne = /(?=.*\{z\})(?=.*\{x\})(?=.*\{y\})/.test(text);
    if (text && !isOne) say("An address of tiles contains {z}, {x} and {y}", "error");
    else localStorage.setItem(KEPT, text);
    layer?.remove();
    layer = isOne ? layerOf(datum, text).addTo(map) : null;
  }

  function at(place) {
    if (!place || String(place) === String(datum)) return;
    [datum, control.hidden] = [place, false];
    lay();
  }
  return {control, at};
}
