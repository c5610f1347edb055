/* The mesh at full detail, as 3D Tiles that `reconstruct.mesh.tiles` writes. */

import {bytes, get} from "./core.js";
import {boxAbout, startDetail, tileOf} from "./model_detail.js";

const TILE_ERROR_PX = 16;
const LENGTH_AT = 8;

/* The tiles below an address, drawn in place of the light copy of `scene`; see `startDetail`. */
export async function startTiles(scene, address, listeners) {
  const folder = address.slice(0, address.lastIndexOf("/") + 1);

  function describe(tile, depth) {
    const [e, n, u, de, , , , dn, , , , du] = tile.boundingVolume.box;
    const uri = tile.content?.uri;
    return tileOf({
      depth, uri, error: tile.geometricError, box: boxAbout([e, n, u], [de, dn, du]),
      isEmpty: !uri, isLink: Boolean(uri?.endsWith(".json")),
      children: (tile.children || []).map((child) => describe(child, depth + 1)),
    });
  }

  async function load(tile) {
    if (tile.isLink) {
      const linked = describe((await get(folder + tile.uri)).root, tile.depth);
      const {uri, isEmpty, isLink, error, children} = linked;
      return {uri, isEmpty, isLink, error, children};
    }
    const data = await bytes(folder + tile.uri);
    const isLong = data.byteLength > LENGTH_AT + 4;
    const stated = isLong ? new DataView(data).getUint32(LENGTH_AT, true) : Infinity;
    if (stated > data.byteLength) {
      throw new Error(`mesh/tiles/${tile.uri} is cut off: delete it and run its stage again`);
    }
    const model = scene.dress((await parse(data)).scene);
    return {model, bytes: sizeOf(model)};
  }

  /* Of its textures with their smaller copies, and of its triangles. */
  function sizeOf(model) {
    let size = 0;
    model.traverse((part) => {
      if (!part.isMesh) return;
      const {image} = part.userData.own.map || {};
      size += image ? image.width * image.height * 4 * 4 / 3 : 0;
      const {attributes, index} = part.geometry;
      Object.values(attributes).forEach((one) => { size += one.array.byteLength; });
      size += index?.array.byteLength || 0;
    });
    return size;
  }

  const root = describe((await get(address)).root, 0);
  return startDetail(scene, root, {errorPx: TILE_ERROR_PX, load, drop: scene.forget, ...listeners});
}
