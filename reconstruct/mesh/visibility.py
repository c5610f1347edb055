"""Which views see which faces, and which one textures each: good views, and large patches.

The energy of a choice is that of Lempitsky & Ivanov 2007 ("Seamless mosaicing of image-based
texture maps"): a cost of every face's view and a Potts cost of every edge between faces of
different views. It is lowered face by face (iterated conditional modes, Besag 1986) from the best
views; patches that stay small are then given to a neighbour that sees all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from alice_survey.core.compiled import compiled
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.mesh.topology import Triangles, edges_of, face_areas, face_normals, twin_sides
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View

CANDIDATES = 8
"""Views kept for a face."""
_RIM_PX = 3.0
"""Pixels at the edges of a picture that are not used."""
_MIN_COSINE = 0.15
"""Least cosine between the normal of a face and the line of sight."""
_BLOCK = 512
"""Vertices that are tested against a view's frame at once."""
_MARGIN = 0.1
"""Margin of the frame, for what a port bends."""
_SHRINK = 0.8
"""Rays to the corners of a face start so far from its middle to the corner."""
_ENU_TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """The best views of every face, best first."""

    views: NDArray[np.int32]
    """(T, CANDIDATES); -1 where there are no more."""
    quality: NDArray[np.float32]
    """(T, CANDIDATES); 0 where there are no more."""


class _Shape(NamedTuple):
    """A mesh to look at."""

    vertices: Array
    triangles: Triangles
    offset: Array
    """(3,) of its coordinates."""
    scene: Any
    """To cast rays at."""
    spheres: tuple[Array, Array]
    """Around blocks of vertices."""
    by_block: NDArray[np.int32]
    """(T,) faces by the block of their first vertex."""
    starts: NDArray[np.int64]
    """(B + 1,) start of each block in these."""

    def faces_of(self, block: int) -> NDArray[np.int32]:
        """The faces whose first vertex is in a block."""
        return self.by_block[self.starts[block] : self.starts[block + 1]]


def to_world(points_enu: Array, offset_enu: Array) -> Array:
    """Points (N, 3) of a mesh, east, north, up from an offset, in the world frame of views."""
    return np.asarray((points_enu + offset_enu) @ _ENU_TO_NED.T)


def find_candidates(
    mesh: Path, faces: int, workspace: Path, views: Sequence[View], lift: float, executor: Executor
) -> Candidates:
    """The best views of every face.

    Args:
        mesh: file of its vertices and triangles, of the offset of its coordinates, and of vertices
            and triangles that only hide others (`occluder_vertices`, `occluder_triangles`).
        faces: how many it has.
        workspace: with the pictures.
        views: to choose from.
        lift: how far over the surface lines of sight start, in the unit of the vertices.
        executor: where tasks run.
    """
    numbers = np.full((faces, CANDIDATES), -1, np.int32)
    quality = np.zeros((faces, CANDIDATES), np.float32)
    find = partial(see_faces, mesh, workspace, lift)
    for number, (rows, mine) in enumerate(executor.map(find, views, label="lines of sight")):
        worst = quality[rows, -1] < mine
        rows, mine = rows[worst], mine[worst]
        quality[rows, -1], numbers[rows, -1] = mine, number
        order = np.argsort(-quality[rows], axis=1, kind="stable")
        quality[rows] = np.take_along_axis(quality[rows], order, axis=1)
        numbers[rows] = np.take_along_axis(numbers[rows], order, axis=1)
    return Candidates(views=numbers, quality=quality)


def see_faces(
    mesh: Path, workspace: Path, lift: float, view: View
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The faces that a view sees whole, unmasked, from their front.

    Args:
        mesh: as `find_candidates` takes it.
        workspace: with the pictures.
        lift: of lines of sight.
        view: that looks.

    Returns:
        (N,) faces, and (N,) pixels a unit of length, fewer towards the rim of the picture.
    """
    shape = _geometry(mesh, mesh.stat().st_mtime_ns)
    vertices, triangles, offset = shape.vertices, shape.triangles, shape.offset
    near = blocks_near(view, shape.spheres, offset)
    if not len(near):
        return np.empty(0, np.int32), np.empty(0, np.float32)
    valid = Pictures.still(workspace).valid(view.image)
    numbers = (near[:, None] * _BLOCK + np.arange(_BLOCK)).reshape(-1)
    numbers = numbers[numbers < len(vertices)]
    pixels = view.project(to_world(vertices[numbers], offset))
    usable = usable_pixels(pixels, valid)
    place = np.full(len(shape.spheres[0]), -1)
    place[near] = np.arange(len(near))
    faces = np.sort(np.concatenate([shape.faces_of(block) for block in near]))
    block = place[triangles[faces] // _BLOCK]
    faces, block = faces[(block >= 0).all(axis=1)], block[(block >= 0).all(axis=1)]
    corners = block * _BLOCK + triangles[faces] % _BLOCK
    inside = usable[corners].all(axis=1)
    return _quality(shape, faces[inside], pixels[corners[inside]], view, lift)


def blocks_near(view: View, spheres: tuple[Array, Array], offset_enu: Array) -> NDArray[np.intp]:
    """Numbers of the spheres, of `block_spheres`, that may reach into a view's frame."""
    centres, radii = spheres
    points = view.world_from_cam.inv().apply(to_world(centres, offset_enu))
    low, high = view.pinhole.slopes(np.array([(0, 0), view.pinhole.size_px]))
    reach = _MARGIN * (high - low)
    near = points[:, 2] > -radii
    for axis in range(2):
        for slope, sign in ((high[axis] + reach[axis], 1.0), (low[axis] - reach[axis], -1.0)):
            beyond = sign * (points[:, axis] - slope * points[:, 2]) / np.hypot(1.0, slope)
            near &= beyond < radii
    return np.flatnonzero(near)


def block_spheres(vertices: Array) -> tuple[Array, Array]:
    """Centres (B, 3) and radii (B,) of spheres around every `_BLOCK` vertices."""
    starts = np.arange(0, len(vertices), _BLOCK)
    low = np.minimum.reduceat(vertices, starts)
    high = np.maximum.reduceat(vertices, starts)
    return 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)


def usable_pixels(pixels: Array, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether pixels (N, 2) lie inside of a picture, off its rim, where it may be used."""
    height, width = valid.shape
    with np.errstate(invalid="ignore"):
        high = np.array([width, height]) - _RIM_PX
        inside = np.asarray(((pixels >= _RIM_PX) & (pixels <= high)).all(axis=1))
    at = np.floor(pixels[inside]).astype(np.intp)
    inside[inside] = valid[at[:, 1], at[:, 0]]
    return inside


def _quality(
    shape: _Shape, faces: NDArray[np.intp], pixels: Array, view: View, lift: float
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Which of some faces (N,), whose corners a view shows at pixels (N, 3, 2), it sees."""
    import open3d as o3d

    vertices, triangles = shape.vertices, shape.triangles
    camera = view.world_from_cam.translation @ _ENU_TO_NED - shape.offset
    corners = vertices[triangles[faces]]
    middle = corners.mean(axis=1)
    normal = face_normals(vertices, triangles[faces])
    sight = camera - middle
    distance = np.linalg.norm(sight, axis=1)
    cosine = (normal * sight).sum(axis=1) / np.maximum(distance, 1e-30)
    a, b = pixels[:, 1] - pixels[:, 0], pixels[:, 2] - pixels[:, 0]
    area_px = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    area = face_areas(vertices, triangles[faces])
    facing = (cosine > _MIN_COSINE) & (area > 0)
    towards = middle[:, None] * (1 - _SHRINK) + corners * _SHRINK
    ends = np.concatenate([middle[:, None], towards], axis=1)
    ends = ends[facing] + lift * normal[facing][:, None]
    away = camera - ends
    reach = np.linalg.norm(away, axis=2, keepdims=True)
    rays = np.concatenate([ends, away / reach], axis=2).astype(np.float32)
    hidden = np.zeros(rays.shape[:2], np.bool_)
    if len(rays):
        hit = shape.scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        hidden = hit < reach[..., 0]
    seen = np.flatnonzero(facing)[~hidden.any(axis=1)]
    size = np.array(view.pinhole.size_px)
    inset = np.minimum(pixels[seen], size - pixels[seen]).min(axis=(1, 2)) / (0.5 * size.min())
    taper = np.clip(inset, 0.02, 1.0)
    quality = np.sqrt(area_px[seen] / area[seen]) * np.sqrt(taper)
    return faces[seen].astype(np.int32), quality.astype(np.float32)


@lru_cache(maxsize=1)
def _geometry(path: Path, _written_ns: int) -> _Shape:
    with np.load(path) as data:
        vertices, triangles, offset = data["vertices"], data["triangles"], data["offset"]
        meshes = [(vertices, triangles)]
        if "occluder_triangles" in data and len(data["occluder_triangles"]):
            meshes.append((data["occluder_vertices"], data["occluder_triangles"]))
    spheres = block_spheres(vertices)
    block = triangles[:, 0] // _BLOCK
    counts = np.bincount(block, minlength=len(spheres[0]))
    by_block = np.argsort(block, kind="stable").astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(counts)])
    return _Shape(vertices, triangles, offset, ray_scene(*meshes), spheres, by_block, starts)


def distances_from(vertices: Array, triangles: Triangles, points: Array) -> Array:
    """(N,) distances of (N, 3) points from a mesh; in float32 about their middle."""
    import open3d as o3d

    middle = points.mean(axis=0) if len(points) else vertices[0]
    scene = ray_scene((vertices - middle, triangles))
    found = scene.compute_distance(o3d.core.Tensor((points - middle).astype(np.float32)), 1)
    return np.asarray(found.numpy().astype(np.float64))


def ray_scene(*meshes: tuple[Array, Triangles]) -> Any:
    """Vertices and triangles of meshes as an Open3D `RaycastingScene`."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for vertices, triangles in meshes:
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
        )
    return scene


_SEAM_COST = 0.35
"""Cost of an edge of mean length between two views, over the logarithm of a ratio of quality."""
_SWEEPS = 30
_SMALL_FACES = 60
"""Patches of fewer faces are given away if they can be."""
_MERGES = 6
_MIN_AXIS_COSINE = 0.3
"""Least cosine between the normal of a face and the axis along which its texture lies."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Charts:
    """Connected patches of faces that one view textures."""

    label: NDArray[np.int32]
    """(T,) view of every face; -1 to -6 where no view sees it, by the axis it faces."""
    chart: NDArray[np.int32]
    """(T,) number of every face's patch."""
    views: NDArray[np.int32]
    """(C,) label of every patch."""


@progress.step("choose a picture for each face")
def choose_views(
    vertices: Array, triangles: Triangles, candidates: Candidates
) -> NDArray[np.int32]:
    """A view for every face, (T,); -1 to -6 where no view sees it (see `Charts.label`)."""
    neighbours, lengths = face_neighbours(vertices, triangles)
    known = candidates.quality > 0
    best = np.maximum(candidates.quality[:, :1], 1e-30)
    cost = np.where(known, -np.log(np.where(known, candidates.quality, 1.0) / best), np.inf)
    label = candidates.views[:, 0].copy()
    seam = _SEAM_COST * lengths / max(float(lengths.mean()), 1e-30)
    smooth(label, candidates.views, cost, neighbours, seam, _SWEEPS)
    for _ in range(_MERGES):
        chart = connected_charts(neighbours, label)
        if not give_away(label, chart, candidates.views, neighbours, lengths):
            break
    unseen = label < 0
    normal = face_normals(vertices, triangles[unseen])
    axis = np.argmax(np.abs(normal), axis=1)
    ahead = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] >= 0
    label[unseen] = -1 - (2 * axis + ahead)
    return label


def choose_axes(vertices: Array, triangles: Triangles) -> NDArray[np.int32]:
    """The axis along which to see every face, (T,): -1 to -6, in patches as large as they can be.

    Axes are chosen as views are, with the cosine to the face's normal for quality.
    """
    normal = face_normals(vertices, triangles)
    cosine = np.stack([-normal, normal], axis=2).reshape(-1, 6)
    best = np.argsort(-cosine, axis=1, kind="stable")[:, :3]
    quality = np.take_along_axis(cosine, best, axis=1)
    seen = quality > _MIN_AXIS_COSINE
    axes = Candidates(
        views=np.where(seen, best, -1).astype(np.int32),
        quality=np.where(seen, quality, 0.0).astype(np.float32),
    )
    chosen = choose_views(vertices, triangles, axes)
    return np.where(chosen < 0, chosen, -1 - chosen)


@progress.step("cut patches")
def make_charts(
    vertices: Array,
    triangles: Triangles,
    label: NDArray[np.int32],
    tile: NDArray[np.int32] | None = None,
) -> Charts:
    """The connected patches of faces of one label, and of one tile (T,) where these are given."""
    group = label
    if tile is not None:
        both = np.stack([label, tile])
        group = np.unique(both, axis=1, return_inverse=True)[1].reshape(-1).astype(np.int32)
    chart = connected_charts(face_neighbours(vertices, triangles)[0], group)
    views = np.empty(int(chart.max(initial=-1)) + 1, np.int32)
    views[chart] = label
    return Charts(label=label, chart=chart, views=views)


def face_neighbours(vertices: Array, triangles: Triangles) -> tuple[NDArray[np.int32], Array]:
    """The face over each side of every face, (T, 3), -1 at the outline; and the sides' lengths."""
    edges, edge = edges_of(triangles)
    one, other = twin_sides(edge)
    neighbours = np.full(triangles.size, -1, np.int32)
    neighbours[one], neighbours[other] = other // 3, one // 3
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    return neighbours.reshape(-1, 3), length[edge].reshape(-1, 3)


def connected_charts(neighbours: NDArray[np.int32], label: NDArray[np.int32]) -> NDArray[np.int32]:
    """(T,) number of the connected patch of equal label, in the order of their first faces."""
    face = np.repeat(np.arange(len(label)), 3)
    other = neighbours.reshape(-1)
    same = (other >= 0) & (label[face] == label[other])
    graph = coo_array(
        (np.ones(int(same.sum()), np.int8), (face[same], other[same])), (len(label), len(label))
    )
    return connected_components(graph, directed=False)[1].astype(np.int32)


@compiled
def smooth(
    label: NDArray[np.int32],
    views: NDArray[np.int32],
    cost: Array,
    neighbours: NDArray[np.int32],
    seam: Array,
    sweeps: int,
) -> None:
    """Give every face in turn the view of least cost, until nothing changes, in place.

    Args:
        label: (T,) changed.
        views: (T, K) candidates, -1 beyond the last.
        cost: (T, K) of them.
        neighbours: (T, 3) faces, -1 at the outline.
        seam: (T, 3) cost of a different view across a side.
        sweeps: at most.
    """
    for _ in range(sweeps):
        changed = 0
        for face in range(label.size):
            best, minimum = label[face], np.inf
            for k in range(views.shape[1]):
                if views[face, k] < 0:
                    break
                total = cost[face, k]
                for side in range(3):
                    other = neighbours[face, side]
                    if other >= 0 and label[other] != views[face, k]:
                        total += seam[face, side]
                if total < minimum:
                    best, minimum = views[face, k], total
            if best != label[face]:
                label[face] = best
                changed += 1
        if changed == 0:
            return


def give_away(
    label: NDArray[np.int32],
    chart: NDArray[np.int32],
    views: NDArray[np.int32],
    neighbours: NDArray[np.int32],
    lengths: Array,
) -> int:
    """Give small patches the view with which they share most of their outline, in place.

    A view is taken only if it is a candidate of every face of the patch, and one of a neighbour
    that is no smaller. Patches next to one that changed wait for the next call. Returns how many
    faces changed.
    """
    size = np.bincount(chart)
    given = (size[chart] < _SMALL_FACES) & (label >= 0)
    at = (neighbours >= 0) & (label[neighbours] >= 0) & (chart[neighbours] != chart[:, None])
    face, side = np.nonzero(at & given[:, None])
    other, count = neighbours[face, side], int(label.max(initial=0)) + 1
    key, row = np.unique(chart[face].astype(np.int64) * count + label[other], return_inverse=True)
    mine, view = key // count, key % count
    shared = np.bincount(row, lengths[face, side], len(key))
    larger = np.bincount(row, size[chart[other]] >= size[chart[face]], len(key)) > 0
    able = (views >= 0) & (views < count) & given[:, None]
    seen = (chart[:, None].astype(np.int64) * count + views)[able]
    seen, faces = np.unique(seen, return_counts=True)
    place = np.minimum(np.searchsorted(seen, key), len(seen) - 1)
    whole = (seen[place] == key) & (faces[place] == size[mine]) & larger
    best = np.flatnonzero(whole)[np.lexsort((-shared[whole], mine[whole]))]
    best = best[np.unique(mine[best], return_index=True)[1]]
    order = np.argsort(chart, kind="stable")
    starts = np.concatenate([[0], np.cumsum(size)])
    frozen, changed = np.zeros(len(size), np.bool_), 0
    for number, chosen in zip(mine[best].tolist(), view[best].tolist(), strict=True):
        if not frozen[number]:
            patch = order[starts[number] : starts[number + 1]]
            label[patch] = chosen
            around = neighbours[patch]
            frozen[chart[around[around >= 0]]] = True
            changed += len(patch)
    return changed
