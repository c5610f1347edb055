"""Colour steps between patches of different pictures, levelled over the whole mesh at once.

Every patch gets a smooth correction, one value a channel at each of its wedges, such that both
sides of a seam show the same and the corrections change as little as they can within a patch
(Lempitsky & Ivanov 2007, eq. 5; Waechter et al. 2014, "Let there be color!", eq. 3).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from alice_survey.base.errors import warn
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.mesh.atlas import Wedges
from reconstruct.mesh.topology import edges_of

_SMOOTHNESS = 0.1
"""Weight of a change along an edge within a patch, over that of a step at a seam."""
_PULL = 1e-4
"""Weight of the correction itself, which keeps the level of the whole."""
_TOLERANCE, _MOST_STEPS = 1e-5, 5000


def seam_pairs(wedges: Wedges) -> NDArray[np.int64]:
    """(S, 2) wedges of one vertex in different patches, each next to the one before."""
    order = np.argsort(wedges.vertex, kind="stable")
    same = wedges.vertex[order][1:] == wedges.vertex[order][:-1]
    return np.stack([order[:-1][same], order[1:][same]], axis=1).astype(np.int64)


@progress.step("level colours")
def level_seams(wedges: Wedges, colours: Array, free: NDArray[np.bool_]) -> Array:
    """Corrections (W, 3) to add to the colours of patches.

    Args:
        wedges: of the mesh.
        colours: (W, 3) what the patch's picture shows around the wedge; used at seams only.
        free: (W,) wedges that may be corrected; others stay at 0.
    """
    pairs = seam_pairs(wedges)
    pairs = pairs[np.isfinite(colours[pairs]).all(axis=(1, 2))]
    edges, _ = edges_of(wedges.triangles)
    count = len(wedges.vertex)
    gain = _laplacian(pairs, 1.0, count) + _laplacian(edges, _SMOOTHNESS, count)
    gain = (gain + diags_array(np.full(count, _PULL))).tocsr()
    kept = np.flatnonzero(free)
    system = csr_array(gain[kept][:, kept])
    inverse = diags_array(1.0 / system.diagonal())
    result = np.zeros((count, 3))
    for channel in range(3):
        step = colours[pairs[:, 1], channel] - colours[pairs[:, 0], channel]
        target = np.bincount(pairs[:, 0], step, count) - np.bincount(pairs[:, 1], step, count)
        if not np.any(target[kept]):
            continue
        solution, failed = cg(system, target[kept], rtol=_TOLERANCE, maxiter=_MOST_STEPS, M=inverse)
        if failed:
            warn(f"colours of the mesh (channel {channel}) are not levelled to {_TOLERANCE:g}")
        result[kept, channel] = solution
    return result


def _laplacian(pairs: NDArray[np.int64], weight: float, count: int) -> csr_array:
    one, other = pairs[:, 0], pairs[:, 1]
    values = np.full(len(pairs), weight)
    rows = np.concatenate([one, other, one, other])
    columns = np.concatenate([one, other, other, one])
    entries = np.concatenate([values, values, -values, -values])
    return coo_array((entries, (rows, columns)), (count, count)).tocsr()
