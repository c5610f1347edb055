/* Tiles of a web map that the user names, under the survey: XYZ tiles in Web Mercator, laid by
   their corners' places on WGS 84 into the survey's metres east and north. */

const AXIS_M = 6378137;
const FLATTENING = 1 / 298.257223563;
const E2 = FLATTENING * (2 - FLATTENING);
const RAD = Math.PI / 180;
const FINEST = 19;
const TILE_PX = 256;
const MAX_TILES = 120;

function ecef(lat, lon) {
  const [s, c] = [Math.sin(lat * RAD), Math.cos(lat * RAD)];
  const radius = AXIS_M / Math.sqrt(1 - E2 * s * s);
  return [radius * c * Math.cos(lon * RAD), radius * c * Math.sin(lon * RAD),
    radius * (1 - E2) * s];
}

/* Metres north and east of a datum, in its horizontal plane. */
export function northEast([lat0, lon0], lat, lon) {
  const [from, to] = [ecef(lat0, lon0), ecef(lat, lon)];
  const [dx, dy, dz] = to.map((value, i) => value - from[i]);
  const [sp, cp, sl, cl] = [Math.sin(lat0 * RAD), Math.cos(lat0 * RAD), Math.sin(lon0 * RAD),
    Math.cos(lon0 * RAD)];
  return [-sp * cl * dx - sp * sl * dy + cp * dz, -sl * dx + cl * dy];
}

/* Degrees of a place near the datum, by the radii of curvature there: to choose tiles by. */
function latLonNear([lat0, lon0], north, east) {
  const s = Math.sin(lat0 * RAD);
  const root = Math.sqrt(1 - E2 * s * s);
  const meridian = AXIS_M * (1 - E2) / root ** 3;
  return [lat0 + north / meridian / RAD,
    lon0 + east / (AXIS_M / root * Math.cos(lat0 * RAD)) / RAD];
}

const columnOf = (lon, z) => (lon + 180) / 360 * 2 ** z;
const rowOf = (lat, z) => (1 - Math.asinh(Math.tan(lat * RAD)) / Math.PI) / 2 * 2 ** z;
const lonOf = (column, z) => column / 2 ** z * 360 - 180;
const latOf = (row, z) => Math.atan(Math.sinh(Math.PI * (1 - 2 * row / 2 ** z))) / RAD;

/* South-west and north-east corner of a tile on the map, as Leaflet takes them. */
export function boundsOf(datum, z, x, y) {
  const corner = (column, row) => northEast(datum, latOf(row, z), lonOf(column, z));
  return [corner(x, y + 1), corner(x + 1, y)];
}

/* The layer of tiles from an address with {z}, {x} and {y}. */
export function background(datum, address) {
  const Tiles = leaflet.Layer.extend({
    onAdd(map) {
      this._tiles = new Map();
      map.on("moveend zoomend resize", this._update, this);
      this._update();
    },
    onRemove(map) {
      map.off("moveend zoomend resize", this._update, this);
      this._tiles.forEach((tile) => tile.remove());
    },
    _update() {
      const map = this._map;
      const view = map.getBounds();
      const [south, west] = latLonNear(datum, view.getSouth(), view.getWest());
      const [north, east] = latLonNear(datum, view.getNorth(), view.getEast());
      const perTile = 2 * Math.PI * AXIS_M * Math.cos(datum[0] * RAD) / TILE_PX;
      let z = Math.max(0, Math.min(FINEST, Math.round(Math.log2(perTile * 2 ** map.getZoom()))));
      let range = null;
      do {
        range = [columnOf(west, z), columnOf(east, z), rowOf(north, z), rowOf(south, z)].map(
          Math.floor);
        z -= 1;
      } while (z >= 0 && (range[1] - range[0] + 1) * (range[3] - range[2] + 1) > MAX_TILES);
      z += 1;
      const wanted = new Set();
      for (let x = range[0]; x <= range[1]; x += 1) {
        for (let y = Math.max(0, range[2]); y <= Math.min(2 ** z - 1, range[3]); y += 1) wanted.add(
          [z, x, y].join("/"));
      }
      this._tiles.forEach((tile, name) => {
        if (wanted.has(name)) return;
        tile.remove();
        this._tiles.delete(name);
      });
      wanted.forEach((name) => {
        if (this._tiles.has(name)) return;
        const [tz, tx, ty] = name.split("/").map(Number);
        const url = address.replace("{z}", tz).replace("{x}", (tx + 2 ** tz) % 2 ** tz)
          .replace("{y}", ty);
        const tile = leaflet.imageOverlay(url, boundsOf(datum, tz, tx, ty), {pane: "under"});
        this._tiles.set(name, tile);
        tile.addTo(map);
      });
    },
  });
  return new Tiles();
}
