"""The harbour as triangles, for the renderer."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.terrain import CERAMIC, DETRITUS, ROCK, SAND, Terrain, TerrainObject
from benchmarks.harbour_scene import (
    FISH,
    FLOOR_M,
    SOLIDS,
    WALL_EAST_M,
    WALL_TOP_M,
    WEEDS,
    Ellipsoid,
    Fish,
    RoundedBox,
    Solid,
    Upright,
    Weed,
    floor_depth,
    wall_north,
)

BOUNDS_NE_M = (-7.0, 5.0, -6.0, 11.0)
_FLOOR_GRID_M, _WALL_GRID_M = 0.02, 0.006
_SAG_M = 0.00006
"""Largest distance of a chord from the curve it stands for, about."""
_DEEP_M = FLOOR_M + 0.4
_MATERIALS = {"hull": CERAMIC, "pile": ROCK, "ladder": CERAMIC, "boulder": ROCK}
Mesh = tuple[Array, NDArray[np.int32]]


@lru_cache(maxsize=1)
def still_harbour() -> Terrain:
    """All that does not move."""
    south, north, west, east = BOUNDS_NE_M
    along_n = np.arange(south, north, _FLOOR_GRID_M)
    along_e = np.arange(west, east, _FLOOR_GRID_M)
    depths = floor_depth(*np.meshgrid(along_n, along_e, indexing="ij")) - FLOOR_M
    solids = [_object(one.name, solid_mesh(one), _MATERIALS[one.name]) for one in SOLIDS]
    return Terrain(
        offset_ned=np.array([0.0, 0.0, FLOOR_M]),
        grid_m=_FLOOR_GRID_M,
        corner_ne=np.array([south, west]),
        depths=depths.astype(np.float32),
        material=np.full(depths.shape, SAND, dtype=np.float32),
        objects=(_object("wall", _face(), ROCK), _object("wall", _corner(), ROCK), *solids),
    )


def moving_at(time_s: float) -> tuple[TerrainObject, ...]:
    """Fish and weed at a time; their textures stay on them."""
    fish = [
        _object(
            "fish", _fish(one, time_s), CERAMIC,
            at_rest=_ellipsoid(one.semi_axes)[0] + np.array([0.0, 3.0 * number, 0.0]),
        )
        for number, one in enumerate(FISH)
    ]  # fmt: skip
    weed = [
        _object("weed", _blade(one, time_s), DETRITUS, at_rest=_blade(one, None)[0])
        for one in WEEDS
    ]
    return (*fish, *weed)


def solid_mesh(solid: Solid) -> Mesh:
    """A solid's surface, NED; chords of curved parts are off by less than 0.1 mm."""
    match solid:
        case RoundedBox():
            vertices, triangles = _rounded_box(np.asarray(solid.half), solid.radius_m)
            return vertices + np.asarray(solid.centre), triangles
        case Upright():
            return _upright(solid)
        case Ellipsoid():
            vertices, triangles = _ellipsoid(solid.semi_axes)
            turn = Rotation.from_euler("Z", solid.heading_deg, degrees=True)
            return turn.apply(vertices) + np.asarray(solid.centre), triangles


def _object(name: str, mesh: Mesh, material: float, at_rest: Array | None = None) -> TerrainObject:
    """A mesh in NED as an object of the terrain."""
    below = np.array([0.0, 0.0, FLOOR_M])
    return TerrainObject(
        name=name,
        vertices=(mesh[0] - below).astype(np.float32),
        triangles=mesh[1],
        material=material,
        at_rest=None if at_rest is None else (at_rest - below).astype(np.float32),
    )


def _face() -> Mesh:
    """The stones of the wall."""
    east = np.arange(WALL_EAST_M[0], WALL_EAST_M[1] + 1e-9, _WALL_GRID_M)
    east[-1] = WALL_EAST_M[1]
    depth = np.arange(WALL_TOP_M, _DEEP_M, _WALL_GRID_M)
    e, z = np.meshgrid(east, depth)
    vertices = np.stack([wall_north(e, z), e, z], axis=-1)
    return vertices.reshape(-1, 3), _grid(*e.shape)


def _corner() -> Mesh:
    """The end of the wall in the east, which shows the stones' outline."""
    depth = np.arange(WALL_TOP_M, _DEEP_M, _WALL_GRID_M)
    end = np.full(len(depth), WALL_EAST_M[1])
    edge = np.column_stack([wall_north(end, depth), end, depth])
    back = edge * [0.0, 1.0, 1.0] + [3.0, 0.0, 0.0]
    vertices = np.stack([edge, back], axis=1).reshape(-1, 3)
    return vertices, _grid(len(depth), 2)


def _grid(rows: int, columns: int) -> NDArray[np.int32]:
    """Two triangles a cell; rows down and columns to the right as seen from outside."""
    corner = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    return np.stack([a, c, d, a, d, b], axis=-1).reshape(-1, 3)


def _cube(along: tuple[Array, Array, Array]) -> Mesh:
    """A box's surface as six grids with the coordinates `along` its axes, corners unwelded."""
    vertices, triangles, first = [], [], 0
    for axis in range(3):
        u, v = [along[other] for other in range(3) if other != axis]
        for end in (along[axis][0], along[axis][-1]):
            grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
            points = np.insert(grid, axis, end, axis=-1).reshape(-1, 3)
            vertices.append(points)
            triangles.append(_grid(len(u), len(v)) + np.int32(first))
            first += len(points)
    return _weld(np.concatenate(vertices), np.concatenate(triangles))


def _weld(vertices: Array, triangles: NDArray[np.int32]) -> Mesh:
    unique, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    return unique, index.reshape(-1)[triangles].astype(np.int32)


def _outward(vertices: Array, triangles: NDArray[np.int32]) -> Mesh:
    """A convex surface about the origin with triangles counter-clockwise from outside."""
    corners = vertices[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = np.einsum("ij,ij->i", across, corners.mean(axis=1)) < 0.0
    turned = np.where(inside[:, None], triangles[:, ::-1], triangles)
    return vertices, turned.astype(np.int32)


def _rounded_box(half: Array, radius_m: float) -> Mesh:
    """A cube's grid drawn onto the box: each point goes `radius_m` out of the inner box."""
    inner = half - radius_m
    bend = radius_m * np.tan(np.linspace(0.0, np.pi / 4.0, _steps(radius_m, np.pi / 4.0)))
    along = []
    for side in inner.tolist():
        flat = np.linspace(-side, side, max(int(side / 0.05), 2))
        along.append(np.concatenate([-side - bend[:0:-1], flat, side + bend[1:]]))
    points, triangles = _cube((along[0], along[1], along[2]))
    near = np.clip(points, -inner, inner)
    away = points - near
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return _outward(near + radius_m * away, triangles)


@lru_cache(maxsize=16)
def _ellipsoid(semi_axes: tuple[float, float, float]) -> Mesh:
    even = np.tan(np.linspace(-np.pi / 4.0, np.pi / 4.0, _steps(max(semi_axes), np.pi / 2.0)))
    points, triangles = _cube((even, even, even))
    ball = points / np.linalg.norm(points, axis=1, keepdims=True)
    return _outward(ball * semi_axes, triangles)


def _upright(solid: Upright) -> Mesh:
    count = _steps(solid.radius_m, 2.0 * np.pi)
    around = 2.0 * np.pi * np.arange(count + 1) / count
    ring = solid.radius_m * np.column_stack([np.cos(around), np.sin(around)])
    depth = np.linspace(*solid.depths, 41)
    side = np.dstack([
        np.broadcast_to(ring[:, None], (count + 1, len(depth), 2)),
        np.broadcast_to(depth[:, None], (count + 1, len(depth), 1)),
    ])  # fmt: skip
    middle = np.array([0.0, 0.0, np.mean(solid.depths)])
    walls = _outward(*_weld(side.reshape(-1, 3) - middle, _grid(count + 1, len(depth))))
    vertices, triangles, first = [walls[0]], [walls[1]], len(walls[0])
    for end in solid.depths:
        cap = np.column_stack([ring[:-1], np.full(count, end)]) - middle
        corners = np.column_stack(
            [np.zeros(count - 2), np.arange(1, count - 1), np.arange(2, count)]
        )
        _, fan = _outward(cap, corners.astype(np.int32))
        vertices.append(cap)
        triangles.append(fan + np.int32(first))
        first += len(cap)
    place = np.array([*solid.place_ne, 0.0]) + middle
    return np.concatenate(vertices) + place, np.concatenate(triangles)


def _steps(radius_m: float, angle_rad: float) -> int:
    """Corners of an arc, at even angles."""
    return int(np.ceil(angle_rad / np.sqrt(8.0 * _SAG_M / radius_m))) + 2


def _fish(fish: Fish, time_s: float) -> Mesh:
    vertices, triangles = _ellipsoid(fish.semi_axes)
    return fish.turn(time_s).apply(vertices) + fish.place(time_s), triangles


def _blade(weed: Weed, time_s: float | None) -> Mesh:
    """A blade at a time; upright without one."""
    share = np.linspace(0.0, 1.0, 25)
    sides = weed.half_width_m * np.array([-1.0, 1.0])
    faces = weed.half_thickness_m * np.array([-1.0, 1.0])
    vertices, triangles = _cube((faces, sides, share))
    line = weed.line(vertices[:, 2], 0.0 if time_s is None else time_s)
    if time_s is None:
        line[:, :2] = weed.foot_ne
    line[:, :2] += vertices[:, :2]
    _, turned = _outward(vertices - [0.0, 0.0, 0.5], triangles)
    return line, turned[:, ::-1]  # depth grows as the share falls
