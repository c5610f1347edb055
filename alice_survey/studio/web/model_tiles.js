/* The mesh at full detail: 3D Tiles as reconstruct.mesh.tiles writes them, loaded as the view needs them. */

const MOST_PX = 16;
const AT_ONCE = 4;
const MOST_BYTES = 384 * 1024 * 1024;
const COARSER = 1.5;

/* The tiles below an address, drawn in place of the light copy of `scene`. `told` gets the number of tiles drawn, those
   on the way and the bytes held; `failed` the fault of one that did not come. */
export async function startTiles(scene, address, {told, failed}) {
  const folder = address.slice(0, address.lastIndexOf("/") + 1);
  const group = new three.Scene();
  const {camera, canvas} = scene;
  const root = described((await answered(address).then((one) => one.json())).root, 0);
  let wanted = new Map();
  let loading = 0;
  const held = new Set();
  let coarser = 1;

  async function answered(from) {
    const answer = await fetch(from);
    if (!answer.ok) throw new Error((await answer.text()).trim() + " (" + from + ")");
    return answer;
  }

  /* Boxes are east, north and up; glTF has y up. */
  function described(tile, depth) {
    const [e, n, u, de, , , , dn, , , , du] = tile.boundingVolume.box;
    const middle = new three.Vector3(e, u, -n);
    const half = new three.Vector3(de, du, dn);
    return {
      depth, error: tile.geometricError, uri: tile.content?.uri, box: new three.Box3(middle.clone().sub(half), middle.clone().add(half)),
      children: (tile.children || []).map((child) => described(child, depth + 1)), model: null, bytes: 0, busy: false, fault: false,
    };
  }

  function isSeen(box, clip) {
    const outside = [0, 0, 0, 0, 0];
    for (let i = 0; i < 8; i += 1) {
      const x = i & 1 ? box.max.x : box.min.x;
      const y = i & 2 ? box.max.y : box.min.y;
      const z = i & 4 ? box.max.z : box.min.z;
      const [cx, cy, , cw] = [0, 1, 2, 3].map((row) => clip[row] * x + clip[row + 4] * y + clip[row + 8] * z + clip[row + 12]);
      [cx > cw, cx < -cw, cy > cw, cy < -cw, cw < 0].forEach((is, side) => { outside[side] += is ? 1 : 0; });
    }
    return outside.every((count) => count < 8);
  }

  /* Tiles that stand for one and are there; null where some have yet to come. */
  function cover(tile, view) {
    if (!isSeen(tile.box, view.clip)) return [];
    const away = Math.max(tile.box.distanceToPoint(camera.position), camera.near);
    const isLink = tile.uri?.endsWith(".json");
    if (tile.uri) wanted.set(tile, tile.depth);
    if (isLink) return null;
    if (tile.children.length && (!tile.uri || tile.error * view.pixels / away > MOST_PX * coarser)) {
      const parts = tile.children.map((child) => cover(child, view));
      if (parts.every(Boolean)) return parts.flat();
    }
    return tile.model ? [tile] : null;
  }

  function chosen() {
    camera.updateMatrixWorld();
    const view = {
      clip: camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).elements,
      pixels: canvas.height / (2 * Math.tan(camera.fov * Math.PI / 360)),
    };
    for (;;) {
      wanted = new Map();
      const found = cover(root, view);
      const bytes = [...wanted.keys()].reduce((sum, tile) => sum + tile.bytes, 0);
      if (bytes <= MOST_BYTES || coarser > 1000) return found;
      coarser *= COARSER;
    }
  }

  function update() {
    const found = chosen();
    if (found) group.children.forEach((model) => { model.visible = false; });
    (found || []).forEach((tile) => {
      tile.model.visible = true;
      held.delete(tile);
      held.add(tile);
    });
    for (const tile of held) {
      if (bytesHeld() <= MOST_BYTES) break;
      if (!wanted.has(tile) && !tile.model.visible) drop(tile);
    }
    const next = [...wanted.keys()].filter((tile) => !tile.model && !tile.busy && !tile.fault).sort((a, b) => a.depth - b.depth);
    next.slice(0, AT_ONCE - loading).forEach(load);
    const drawn = group.children.filter((model) => model.visible).length;
    told({drawn, coming: next.filter((tile) => !tile.busy).length + loading, bytes: bytesHeld()});
  }

  const bytesHeld = () => [...held].reduce((sum, tile) => sum + tile.bytes, 0);

  function drop(tile) {
    group.remove(tile.model);
    scene.forget(tile.model);
    tile.model = null;
    tile.bytes = 0;
    held.delete(tile);
  }

  async function load(tile) {
    tile.busy = true;
    loading += 1;
    try {
      const answer = await answered(folder + tile.uri);
      if (tile.uri.endsWith(".json")) {
        const {uri, children} = described((await answer.json()).root, tile.depth);
        Object.assign(tile, {uri, children});
      } else {
        const data = await answer.arrayBuffer();
        const model = (await parse(data)).scene;
        model.visible = false;
        tile.model = scene.dress(model);
        tile.bytes = sizeOf(model);
        group.add(model);
        held.add(tile);
      }
    } catch (fault) {
      tile.fault = true;
      failed(fault);
    }
    tile.busy = false;
    loading -= 1;
    scene.draw();
  }

  /* Of its textures with their smaller copies, and of its triangles. */
  function sizeOf(model) {
    let bytes = 0;
    model.traverse((part) => {
      if (!part.isMesh) return;
      const {image} = part.userData.own.map || {};
      bytes += image ? image.width * image.height * 4 * 4 / 3 : 0;
      bytes += Object.values(part.geometry.attributes).reduce((sum, one) => sum + one.array.byteLength, part.geometry.index?.array.byteLength || 0);
    });
    return bytes;
  }

  return {
    group, update,
    moved() { coarser = 1; },
  };
}
