/* A model in parts, each finer than the one above it, loaded as the view needs them: 3D Tiles and COPC. */

const AT_ONCE = 4;
const MAX_MIB = 384;
const COARSER = 1.5;
const COARSEST = 1000;

/* A box about a middle (east, north, up from the model's offset); glTF has y up. */
export function boxAbout([e, n, u], [de, dn, du]) {
  const middle = new three.Vector3(e, u, -n);
  const half = new three.Vector3(de, du, dn);
  return new three.Box3(middle.clone().sub(half), middle.clone().add(half));
}

/* A part as its tree describes it: its `error` is how far apart what it shows is from the truth, `isEmpty` says that it
   has nothing to draw, `isLink` that it stands for a tree that has yet to come, `bytes` what it takes, where that is known. */
export const partOf = (about) => ({
  depth: 0, children: [], isEmpty: false, isLink: false, bytes: 0, model: null, isBusy: false, isBad: false, ...about,
});

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

/* Draws the parts below `root` whose error is at most `mostPx` on the screen, children on top of their parent (`adds`)
   or in place of it. `load` gives the model and the bytes of a part, or what a link stands for; `drop` gives the memory of
   a model back. `progress` gets the parts drawn, the number of those on the way and the bytes held; `failed` the fault of one
   that did not come, which is not asked for again: its parent stands for it. Above MAX_MIB, or the canvas' attribute
   data-most-mib, parts out of view go, longest unseen first, and what is left is drawn coarser until it fits. */
export function startDetail({camera, canvas, draw}, root, {adds, mostPx, load, drop, progress, failed}) {
  const group = new three.Scene();
  const held = new Set();
  let wanted = new Set();
  let loading = 0;
  let coarser = 1;

  const mostBytes = () => (canvas.dataset.mostMib || MAX_MIB) * 2 ** 20;
  const sumOf = (parts) => [...parts].reduce((sum, part) => sum + part.bytes, 0);
  const shown = () => [...held].filter((part) => part.model.visible);
  const pixelsAtOne = () => canvas.height / (2 * Math.tan(camera.fov * Math.PI / 360));

  /* Parts that stand for one and are there; null where none can. */
  function cover(part, view) {
    if (!isSeen(part.box, view.clip)) return [];
    const away = Math.max(part.box.distanceToPoint(camera.position), camera.near);
    if (!part.isEmpty) wanted.add(part);
    if (part.isLink) return null;
    const isCoarse = part.isEmpty || part.error * view.pixels / away > mostPx * coarser;
    const own = part.model ? [part] : null;
    if (adds) {
      const isReady = part.isEmpty || own || part.isBad;
      return [...own || [], ...(isCoarse && isReady ? part.children.flatMap((child) => cover(child, view)) : [])];
    }
    const finer = isCoarse && part.children.length ? part.children.map((child) => cover(child, view)) : [null];
    if (finer.every(Boolean)) return finer.flat();
    const rest = finer.filter(Boolean).flat();
    return own || (part.isBad && rest.length ? rest : null);
  }

  function chosen() {
    camera.updateMatrixWorld();
    const view = {clip: camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).elements, pixels: pixelsAtOne()};
    for (;;) {
      wanted = new Set();
      const found = cover(root, view);
      if (sumOf(wanted) <= mostBytes() || coarser > COARSEST) return found;
      coarser *= COARSER;
    }
  }

  function update() {
    const found = chosen();
    if (found) group.children.forEach((model) => { model.visible = false; });
    (found || []).forEach((part) => {
      part.model.visible = true;
      held.delete(part);
      held.add(part);
    });
    for (const part of held) {
      if (sumOf(held) <= mostBytes()) break;
      if (!wanted.has(part) && !part.model.visible) forget(part);
    }
    const next = [...wanted].filter((part) => !part.model && !part.isBusy && !part.isBad).sort((a, b) => a.depth - b.depth);
    next.slice(0, AT_ONCE - loading).forEach(fetched);
    progress({parts: shown(), coming: next.filter((part) => !part.isBusy).length + loading, bytes: sumOf(held)});
  }

  function forget(part) {
    group.remove(part.model);
    drop(part.model);
    part.model = null;
    held.delete(part);
  }

  async function fetched(part) {
    part.isBusy = true;
    loading += 1;
    try {
      Object.assign(part, await load(part));
      if (part.model) {
        part.model.visible = false;
        group.add(part.model);
        held.add(part);
      }
    } catch (fault) {
      part.isBad = true;
      failed(fault);
    }
    part.isBusy = false;
    loading -= 1;
    draw();
  }

  return {
    group, update, shown, pixelsAtOne,
    coarser: () => coarser,
    moved() { coarser = 1; },
    clear() { held.forEach(forget); },
  };
}
