/* The mesh at full detail: 3D Tiles as reconstruct.mesh.tiles writes them. */

import {bytes, get} from "./core.js";
import {boxAbout, partOf, startDetail} from "./model_detail.js";

const MOST_PX = 16;
const LENGTH_AT = 8;

/* The tiles below an address, drawn in place of the light copy of `scene`; see `startDetail`. */
export async function startTiles(scene, address, heard) {
  const folder = address.slice(0, address.lastIndexOf("/") + 1);

  function described(tile, depth) {
    const [e, n, u, de, , , , dn, , , , du] = tile.boundingVolume.box;
    const uri = tile.content?.uri;
    return partOf({
      depth, uri, error: tile.geometricError, box: boxAbout([e, n, u], [de, dn, du]), isEmpty: !uri, isLink: Boolean(uri?.endsWith(".json")),
      children: (tile.children || []).map((child) => described(child, depth + 1)),
    });
  }

  async function load(tile) {
    if (tile.isLink) {
      const {uri, isEmpty, isLink, error, children} = described((await get(folder + tile.uri)).root, tile.depth);
      return {uri, isEmpty, isLink, error, children};
    }
    const data = await bytes(folder + tile.uri);
    const stated = data.byteLength > LENGTH_AT + 4 ? new DataView(data).getUint32(LENGTH_AT, true) : Infinity;
    if (stated > data.byteLength) throw new Error("mesh/tiles/" + tile.uri + " is cut off: delete it and run its stage again");
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
      size += Object.values(part.geometry.attributes).reduce((sum, one) => sum + one.array.byteLength, part.geometry.index?.array.byteLength || 0);
    });
    return size;
  }

  const root = described((await get(address)).root, 0);
  return startDetail(scene, root, {adds: false, mostPx: MOST_PX, load, drop: scene.forget, ...heard});
}
