/* A model in tiles, each finer than the one above it, loaded as the view needs them. */

const AT_ONCE = 4;
const MAX_MIB = 384;
const COARSER = 1.5;
const COARSEST = 1000;

/* A box about a centre (east, north, up from the model's offset); glTF has y up. */
export function boxAbout([e, n, u], [de, dn, du]) {
  const centre = new three.Vector3(e, u, -n);
  const half = new three.Vector3(de, du, dn);
  return new three.Box3(centre.clone().sub(half), centre.clone().add(half));
}

/* A tile as its tree describes it: its `error` is how far what it shows is from the truth,
   `isEmpty` says that it has nothing to draw, `isLink` that it stands for a tree that has yet to
   come, `bytes` what it takes, where that is known. */
export const tileOf = (about) => ({
  depth: 0, children: [], isEmpty: false, isLink: false, bytes: 0, model: null, isBusy: false,
  isBad: false, ...about,
});

function isInView(box, clip) {
  const outside = [0, 0, 0, 0, 0];
  for (let i = 0; i < 8; i += 1) {
    const x = i & 1 ? box.max.x : box.min.x;
    const y = i & 2 ? box.max.y : box.min.y;
    const z = i & 4 ? box.max.z : box.min.z;
    const [cx, cy, , cw] = [0, 1, 2, 3].map(
      (row) => clip[row] * x + clip[row + 4] * y + clip[row + 8] * z + clip[row + 12],
    );
    [cx > cw, cx < -cw, cy > cw, cy < -cw, cw < 0].forEach((is, side) => {
      outside[side] += is ? 1 : 0;
    });
  }
  return outside.every((count) => count < 8);
}

/* Draws the tiles below `root` whose error is at most `errorPx` on the screen, children in place
   of their parent. `load` gives the model and the bytes of a tile, or what a link stands for;
   `drop` gives the memory of a model back. `progress` gets the tiles drawn, the number of those
   on the way and the bytes held; `failed` the fault of one that did not come, which is not
   requested again: its parent stands for it. Above MAX_MIB, or the canvas' attribute
   data-max-mib, tiles out of view go, longest unseen first, and what remains is drawn coarser
   until it fits. */
export function startDetail(scene, root, {errorPx, load, drop, progress, failed}) {
  const {camera, canvas, draw} = scene;
  const group = new three.Scene();
  const held = new Set();
  let needed = new Set();
  let loading = 0;
  let coarser = 1;

  const maxBytes = () => (canvas.dataset.maxMib || MAX_MIB) * 2 ** 20;
  const sumOf = (tiles) => [...tiles].reduce((sum, tile) => sum + tile.bytes, 0);
  const shown = () => [...held].filter((tile) => tile.model.visible);

  /* Tiles that stand for one and are there; null where none can. */
  function cover(tile, view) {
    if (!isInView(tile.box, view.clip)) return [];
    const away = Math.max(tile.box.distanceToPoint(camera.position), camera.near);
    if (!tile.isEmpty) needed.add(tile);
    if (tile.isLink) return null;
    const isCoarse = tile.isEmpty || tile.error * view.pixels / away > errorPx * coarser;
    const finer = isCoarse && tile.children.length
      ? tile.children.map((child) => cover(child, view)) : [null];
    if (finer.every(Boolean)) return finer.flat();
    const partly = finer.filter(Boolean).flat();
    if (tile.model) return [tile];
    return tile.isBad && partly.length ? partly : null;
  }

  function chosen() {
    camera.updateMatrixWorld();
    const view = {
      clip: camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).elements,
      pixels: canvas.height / (2 * Math.tan(camera.fov * Math.PI / 360)),
    };
    for (;;) {
      needed = new Set();
      const found = cover(root, view);
      if (sumOf(needed) <= maxBytes() || coarser > COARSEST) return found;
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
      if (sumOf(held) <= maxBytes()) break;
      if (!needed.has(tile) && !tile.model.visible) forget(tile);
    }
    const next = [...needed].filter((tile) => !tile.model && !tile.isBusy && !tile.isBad);
    next.sort((a, b) => a.depth - b.depth).slice(0, AT_ONCE - loading).forEach(fetchTile);
    const coming = next.filter((tile) => !tile.isBusy).length + loading;
    progress({parts: shown(), coming, bytes: sumOf(held)});
  }

  function forget(tile) {
    group.remove(tile.model);
    drop(tile.model);
    tile.model = null;
    held.delete(tile);
  }

  async function fetchTile(tile) {
    tile.isBusy = true;
    loading += 1;
    try {
      Object.assign(tile, await load(tile));
      if (tile.model) {
        tile.model.visible = false;
        group.add(tile.model);
        held.add(tile);
      }
    } catch (fault) {
      tile.isBad = true;
      failed(fault);
    }
    tile.isBusy = false;
    loading -= 1;
    draw();
  }

  return {group, update, moved() { coarser = 1; }};
}
