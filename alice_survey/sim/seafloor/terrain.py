"""The simulated sea floor as triangles: a height field with rocks, and objects lying on it.

Coordinates are NED. They are kept as float32 about `offset_ned` (float32 far from zero would lose
the millimetre), and so they are written: what is read is what was written, to the bit.

All shapes of sand and rocks are sums of few separable terms, so that each is band-limited and a
large grid is cheap. The man-made object is a wine amphora that lies half buried: a surface of
revolution about x from the foot (x = 0) to the rim, closed by the inside of the neck; two handles
in the plane of x and y join neck and shoulder.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import atomic_path, read_json, write_json
from alice_survey.core.compiled import compiled
from alice_survey.core.config import SeafloorConfig
from alice_survey.core.errors import ConfigError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress

Floats = NDArray[np.float32]
Triangles = NDArray[np.int32]

DETRITUS, SAND, ROCK, CERAMIC = -1.0, 0.0, 1.0, 2.0
"""Values of `material`; in between it is the share (of dark matter that gathers in the troughs of
ripples, or of rock)."""

_FORMAT = {"format": "alice-survey terrain", "version": 1}
_STEEPNESS_CELLS = 80
"""Along the longer side of a patch."""
_MAX_VERTICES = 60_000_000
_SEED_STREAM = 3100
_PLY_VERTEX = np.dtype([("xyz", "<f4", 3), ("material", "<f4")])
_PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


@dataclass(frozen=True, kw_only=True, eq=False)
class TerrainObject:
    """A closed mesh on the sea floor that no height field can show."""

    name: str
    vertices: Floats
    """(V, 3) metres about the terrain's `offset_ned`."""
    triangles: Triangles
    """(T, 3) counter-clockwise seen from outside."""
    material: float
    at_rest: Floats | None = None
    """(V, 3) where the texture of each vertex is: the shape at rest of what swims or sways; None
    for what stays."""

    @cached_property
    def normals(self) -> Floats:
        """(V, 3) unit normals that point out, weighted by the area of the faces around."""
        corners = self.vertices[self.triangles].astype(np.float64)
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sums = np.zeros(self.vertices.shape)
        for corner in range(3):
            np.add.at(sums, self.triangles[:, corner], faces)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.asarray((sums / np.maximum(length, 1e-30)).astype(np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """A part of a terrain as one mesh, about an origin of its own."""

    origin_ned: Array
    vertices: Floats
    """(V, 3) metres about `origin_ned`."""
    triangles: Triangles
    """(T, 3) counter-clockwise seen from the water."""
    normals: Floats
    """(V, 3) unit normals that point into the water."""
    material: Floats
    """(V,) see `DETRITUS`, `SAND`, `ROCK`, `CERAMIC`."""
    ground: int
    """Triangles of the height field; those of objects follow."""
    to_rest: Floats | None = None
    """(V, 3) from each vertex to where its texture is, metres; None where nothing moves."""

    @cached_property
    def scene(self) -> Any:
        """The patch as an Open3D `RaycastingScene`; its coordinates are about `origin_ned`."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(self.vertices)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(self.triangles.astype(np.uint32))),
        )
        return scene

    @cached_property
    def steepest(self) -> tuple[Floats, float]:
        """Greatest slope in cells that count from the least north and east; inf near objects."""
        size = np.ptp(self.vertices[:, :2], axis=0)
        cell_m = max(float(size.max()) / _STEEPNESS_CELLS, 1e-6)
        steepest = np.zeros((size / cell_m).astype(int) + 1, np.float32)
        _fill_steepest(self.vertices, self.triangles, self.ground, cell_m, steepest)
        return steepest, cell_m


@compiled
def _fill_steepest(
    vertices: Floats, triangles: Triangles, ground: int, cell_m: float, out: Floats
) -> None:
    south, west = vertices[:, 0].min(), vertices[:, 1].min()
    for t in range(len(triangles)):
        a, b, c = vertices[triangles[t, 0]], vertices[triangles[t, 1]], vertices[triangles[t, 2]]
        p, q = b - a, c - a
        north, east = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2]
        down = abs(p[0] * q[1] - p[1] * q[0])
        slope = math.hypot(north, east) / down if t < ground and down > 0.0 else np.inf
        for i in range(
            int((min(a[0], b[0], c[0]) - south) / cell_m),
            int((max(a[0], b[0], c[0]) - south) / cell_m) + 1,
        ):
            for j in range(
                int((min(a[1], b[1], c[1]) - west) / cell_m),
                int((max(a[1], b[1], c[1]) - west) / cell_m) + 1,
            ):
                out[i, j] = max(out[i, j], slope)


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """A height field on a square grid, and objects."""

    offset_ned: Array
    """(3,) metres, NED; all other coordinates count from here."""
    grid_m: float
    corner_ne: Array
    """(2,) north and east of `depths[0, 0]` about the offset."""
    depths: Floats
    """(R, C) depth about the offset's, positive down; rows go north, columns east."""
    material: Floats
    """(R, C) -1 to 1, see `DETRITUS`, `SAND`, `ROCK`."""
    objects: tuple[TerrainObject, ...] = ()

    @property
    def bounds_ne_m(self) -> tuple[float, float, float, float]:
        """Least and greatest north, least and greatest east."""
        south, west = self.corner_ne + self.offset_ned[:2]
        rows, columns = self.depths.shape
        north, east = south + (rows - 1) * self.grid_m, west + (columns - 1) * self.grid_m
        return float(south), float(north), float(west), float(east)

    @cached_property
    def vertices(self) -> Array:
        """(V, 3) NED metres: the height field row by row, then the objects."""
        return np.asarray(self.patch().vertices, dtype=np.float64) + self.offset_ned

    @cached_property
    def triangles(self) -> Triangles:
        """(T, 3) corners of each triangle, counter-clockwise seen from the water."""
        return self.patch().triangles

    def depth_at(self, points_ne: Array) -> Array:
        """Depth of the height field (without objects), exactly on its triangles.

        Args:
            points_ne: (..., 2) north and east, metres.

        Returns:
            (...) metres, positive down; NaN outside of the bounds.
        """
        points = np.asarray(points_ne, dtype=np.float64)
        row, column, north, east = self._cell(points)
        a, b = self.depths[row, column], self.depths[row + 1, column]
        c, d = self.depths[row, column + 1], self.depths[row + 1, column + 1]
        local = np.where(
            east >= north,
            a + east * (c - a) + north * (d - c),
            a + north * (b - a) + east * (d - b),
        )
        inside = (north >= 0) & (north <= 1) & (east >= 0) & (east <= 1)
        return np.where(inside, local + self.offset_ned[2], np.nan)

    def _cell(self, points_ne: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Row and column of the nearest cell, and where the point is in it (0 to 1 if inside)."""
        place = (points_ne - self.offset_ned[:2] - self.corner_ne) / self.grid_m
        last = np.array(self.depths.shape) - 2
        cell = np.clip(np.nan_to_num(np.floor(place)), 0, last).astype(np.intp)
        fraction = place - cell
        return cell[..., 0], cell[..., 1], fraction[..., 0], fraction[..., 1]

    def raycasting_scene(self) -> Any:
        """The whole terrain as an Open3D `RaycastingScene`, in coordinates about `offset_ned`."""
        return self.patch().scene

    def patch(self, window_ne_m: tuple[float, float, float, float] | None = None) -> Patch:
        """Contents of a window, as one mesh; objects are whole or left out.

        Args:
            window_ne_m: least and greatest north, least and greatest east; everything when None.
        """
        return self._whole if window_ne_m is None else self._cut(window_ne_m)

    @cached_property
    def _whole(self) -> Patch:
        return self._cut(self.bounds_ne_m)

    def _cut(self, window_ne_m: tuple[float, float, float, float]) -> Patch:
        corners = np.array([window_ne_m[::2], window_ne_m[1::2]])
        row, column, _, _ = self._cell(corners)
        rows, columns = slice(row[0], row[1] + 2), slice(column[0], column[1] + 2)
        depths = self.depths[rows, columns]
        index = np.indices(depths.shape)
        place = self.corner_ne + self.grid_m * np.array([row[0], column[0]])
        ne = place + self.grid_m * np.moveaxis(index, 0, -1)
        whole = window_ne_m == self.bounds_ne_m
        centre = np.zeros(2) if whole else np.round(ne.reshape(-1, 2).mean(axis=0), 1)
        shift = np.array([*centre, 0.0])
        vertices = [np.dstack([ne - centre, depths]).reshape(-1, 3).astype(np.float32)]
        triangles = [_grid_triangles(*depths.shape)]
        normals = [self._normals(rows, columns).reshape(-1, 3)]
        material = [self.material[rows, columns].ravel()]
        first, moving = depths.size, False
        to_rest = [np.zeros((first, 3), dtype=np.float32)]
        window = corners - self.offset_ned[:2]
        for item in self.objects:
            low, high = item.vertices[:, :2].min(axis=0), item.vertices[:, :2].max(axis=0)
            if np.any(high < window[0]) or np.any(low > window[1]):
                continue
            vertices.append((item.vertices - shift).astype(np.float32))
            triangles.append(item.triangles + np.int32(first))
            normals.append(item.normals)
            material.append(np.full(len(item.vertices), item.material, dtype=np.float32))
            rest = item.vertices if item.at_rest is None else item.at_rest
            to_rest.append(rest - item.vertices)
            moving = moving or item.at_rest is not None
            first += len(item.vertices)
        return Patch(
            origin_ned=self.offset_ned + shift,
            vertices=np.concatenate(vertices),
            triangles=np.concatenate(triangles),
            normals=np.concatenate(normals),
            material=np.concatenate(material),
            ground=len(triangles[0]),
            to_rest=np.concatenate(to_rest) if moving else None,
        )

    def _normals(self, rows: slice, columns: slice) -> Floats:
        """Unit normals into the water at grid points, from central differences."""
        wide = [slice(max(s.start - 1, 0), s.stop + 1) for s in (rows, columns)]
        depths = self.depths[wide[0], wide[1]].astype(np.float64)
        slope_north, slope_east = np.gradient(depths, self.grid_m)
        normals = np.dstack([slope_north, slope_east, np.full(depths.shape, -1.0)])
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        top, left = rows.start - wide[0].start, columns.start - wide[1].start
        height, width = self.depths[rows, columns].shape
        return normals[top : top + height, left : left + width].astype(np.float32)

    def write(self, path: Path) -> None:
        """Write the mesh as binary PLY, and next to it, with suffix `.json`, what else is known.

        Raises:
            WorkspaceError: an object moves: the file has no place for its shape at rest.
        """
        whole = self.patch()
        if whole.to_rest is not None:
            raise WorkspaceError(f"{path}: an object moves; write the terrain without it")
        header = (
            "ply\nformat binary_little_endian 1.0\n"
            f"comment add {self.offset_ned.tolist()} for north, east, down in metres\n"
            f"element vertex {len(whole.vertices)}\n"
            "property float x\nproperty float y\nproperty float z\nproperty float material\n"
            f"element face {len(whole.triangles)}\n"
            "property list uchar int vertex_indices\nend_header\n"
        )
        vertices = np.empty(len(whole.vertices), _PLY_VERTEX)
        vertices["xyz"], vertices["material"] = whole.vertices, whole.material
        faces = np.empty(len(whole.triangles), _PLY_FACE)
        faces["count"], faces["corners"] = 3, whole.triangles
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.write(header.encode("ascii"))
            vertices.tofile(file)
            faces.tofile(file)
        objects = [
            {"name": o.name, "vertices": len(o.vertices), "triangles": len(o.triangles)}
            for o in self.objects
        ]
        record = {
            **_FORMAT,
            "offset_ned_m": self.offset_ned.tolist(),
            "grid_m": self.grid_m,
            "rows": self.depths.shape[0],
            "columns": self.depths.shape[1],
            "corner_ne_m": self.corner_ne.tolist(),
            "materials": {"detritus": DETRITUS, "sand": SAND, "rock": ROCK, "ceramic": CERAMIC},
            "objects": objects,
        }
        write_json(path.with_suffix(".json"), record)


def read_terrain(path: Path) -> Terrain:
    """Read what `Terrain.write` wrote.

    Raises:
        WorkspaceError: a file is missing, or the two do not fit together.
    """
    record = read_json(path.with_suffix(".json"))
    try:
        if {key: record[key] for key in _FORMAT} != _FORMAT:
            raise WorkspaceError(f"is not a terrain of version {_FORMAT['version']}")
        with path.open("rb") as file:
            counts = {}
            while (line := file.readline()).strip() != b"end_header":
                words = line.decode("ascii").split()
                if not words:
                    raise WorkspaceError("has no PLY header")
                if words[0] == "element":
                    counts[words[1]] = int(words[2])
            vertices = np.fromfile(file, _PLY_VERTEX, counts["vertex"])
            shape = (int(record["rows"]), int(record["columns"]))
            field_faces = 2 * (shape[0] - 1) * (shape[1] - 1)
            file.seek(field_faces * _PLY_FACE.itemsize, 1)
            faces = np.fromfile(file, _PLY_FACE, counts["face"] - field_faces)
        size, first_face, objects = shape[0] * shape[1], 0, []
        first = size
        for item in record["objects"]:
            last, last_face = first + item["vertices"], first_face + item["triangles"]
            objects.append(
                TerrainObject(
                    name=item["name"],
                    vertices=np.ascontiguousarray(vertices["xyz"][first:last]),
                    triangles=faces["corners"][first_face:last_face] - np.int32(first),
                    material=float(vertices["material"][first]),
                )
            )
            first, first_face = last, last_face
        return Terrain(
            offset_ned=np.array(record["offset_ned_m"], dtype=np.float64),
            grid_m=float(record["grid_m"]),
            corner_ne=np.array(record["corner_ne_m"], dtype=np.float64),
            depths=np.ascontiguousarray(vertices["xyz"][:size, 2]).reshape(shape),
            material=np.ascontiguousarray(vertices["material"][:size]).reshape(shape),
            objects=tuple(objects),
        )
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {error.strerror}") from None
    except (KeyError, ValueError, IndexError, TypeError, WorkspaceError) as error:
        raise WorkspaceError(f"{path}: {error}") from None


LENGTH_M = 0.6
BELLY_X_M = 0.34
"""Position along the axis of the greatest width."""

_PROFILE_M = np.array([
    [0.000, 0.000], [0.000, 0.017], [0.012, 0.025], [0.035, 0.028], [0.060, 0.026], [0.085, 0.034],
    [0.130, 0.064], [0.200, 0.101], [0.280, 0.125], [0.340, 0.130], [0.395, 0.124], [0.430, 0.108],
    [0.455, 0.084], [0.474, 0.060], [0.495, 0.047], [0.530, 0.043], [0.565, 0.043], [0.574, 0.052],
    [0.583, 0.057], [0.594, 0.057], [0.600, 0.052], [0.598, 0.043], [0.580, 0.036], [0.530, 0.034],
    [0.480, 0.034], [0.455, 0.022], [0.450, 0.000],
])  # fmt: skip
"""Outline as (distance along the axis, radius), from the foot over the rim into the neck."""

_HANDLE_M = np.array([
    [0.553, 0.036], [0.566, 0.062], [0.566, 0.086], [0.548, 0.106], [0.515, 0.113], [0.478, 0.110],
    [0.445, 0.100], [0.425, 0.088],
])  # fmt: skip
"""Centre line of a handle as (distance along the axis, distance from the axis)."""
_AROUND, _RINGS = 128, 160
"""Corners of a ring of the body, and rings."""
_HANDLE_HALF_WIDTH_M = 0.016
_HANDLE_HALF_DEPTH_M = 0.010


def amphora_mesh() -> tuple[Array, NDArray[np.int32]]:
    """The amphora in its own frame, metres.

    Returns:
        (V, 3) vertices and (T, 3) triangles, counter-clockwise seen from outside.
    """
    parts = [_revolve(_resample(_PROFILE_M, _RINGS), _AROUND)]
    line = _resample(_HANDLE_M, 48)
    parts += [_tube(np.column_stack([line[:, 0], side * line[:, 1]]), 24) for side in (1.0, -1.0)]
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    triangles = np.concatenate([t + f for (_, t), f in zip(parts, first, strict=False)])
    return vertices, triangles.astype(np.int32)


def _resample(points: Array, count: int) -> Array:
    """Smooth (N, 2) points along their length into `count` points of even spacing."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return PchipInterpolator(length, points)(np.linspace(0.0, length[-1], count))


def _revolve(profile: Array, around: int) -> tuple[Array, NDArray[np.int64]]:
    angle = 2.0 * np.pi * np.arange(around) / around
    x, radius = profile[:, :1], profile[:, 1:]
    rings = np.stack(
        [np.broadcast_to(x, (len(x), around)), radius * np.cos(angle), radius * np.sin(angle)], -1
    )
    return rings.reshape(-1, 3), _ring_triangles(len(profile), around)


def _tube(line: Array, around: int) -> tuple[Array, NDArray[np.int64]]:
    """An elliptic tube about a line in the plane of x and y; its ends lie inside the body."""
    forward = np.gradient(line, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    zero = np.zeros(len(line))
    across = np.stack([-forward[:, 1], forward[:, 0], zero], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    angle = 2.0 * np.pi * np.arange(around) / around
    centre = np.stack([line[:, 0], line[:, 1], zero], axis=1)
    rings = (
        _HANDLE_HALF_DEPTH_M * np.cos(angle)[:, None] * across[:, None]
        + _HANDLE_HALF_WIDTH_M * np.sin(angle)[:, None] * up
    )
    rings[[0, -1]] = 0.0  # closed ends
    rings += centre[:, None]
    return rings.reshape(-1, 3), _ring_triangles(len(line), around)


def _ring_triangles(rings: int, around: int) -> NDArray[np.int64]:
    """Triangles between neighbouring rings of vertices that turn the same way about the line."""
    ring, corner = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    after = (corner + 1) % around
    a, b = ring * around + corner, ring * around + after
    c, d = a + around, b + around
    return np.stack([a, d, c, a, b, d], axis=-1).reshape(-1, 3)


_RIPPLE_LENGTH_M = 0.16
_RIPPLE_HEIGHT_M = 0.012
_MIN_ROCK_M = 0.07
_FILLET_M = 0.006
"""Approximate radius with which sand rounds the foot of a rock."""
_EDGE = 0.05
"""Radius, about, of a stone's edges in shares of its height."""


@dataclass(frozen=True, kw_only=True)
class Rock:
    """A rounded boulder that sticks out of the sand."""

    north_m: float
    east_m: float
    radius_m: float
    """Half its longest horizontal axis."""
    flattening: float
    """Second horizontal axis over the first."""
    height_m: float
    """Height from its widest level to its top."""
    buried: float
    """Share of the height that is under the sand."""
    heading_rad: float
    lumps: Array
    """(K, 4): wave numbers along both axes (rad per radius), phase, share of the radius."""
    faces: Array
    """(F, 3): planes that cut the stone: slopes along both axes, level in shares of the height."""


def ground_relief(
    north_m: Array, east_m: Array, relief_m: float, rng: np.random.Generator
) -> Array:
    """Heights of the sand, positive up, that span `relief_m` from lowest to highest.

    Args:
        north_m: (R,) grid lines.
        east_m: (C,) grid lines.
        relief_m: from the lowest to the highest point of the grid.
        rng: source of the shapes.

    Returns:
        (R, C) metres about a mean of zero.
    """
    wind_rad = rng.uniform(0.0, 2.0 * np.pi)
    waves = _cosines(north_m, east_m, 7, (3.0, 8.0), wind_rad, 0.45, rng)
    hummocks = _cosines(north_m, east_m, 24, (0.9, 2.5), wind_rad, math.pi, rng)
    mounds = _mounds(north_m, east_m, rng)
    shape = waves / waves.std() + 0.35 * hummocks / hummocks.std() + 1.1 * mounds
    ripples = _ripples(north_m, east_m, wind_rad, rng)
    ripple_height_m = min(_RIPPLE_HEIGHT_M, 0.1 * relief_m)
    grid_m = float(north_m[1] - north_m[0])
    if grid_m * 8.0 > _RIPPLE_LENGTH_M:  # a coarse grid cannot carry them
        ripple_height_m = 0.0
    heights = shape / np.ptp(shape) * relief_m + ripple_height_m * ripples
    heights *= relief_m / max(float(np.ptp(heights)), 1e-12)
    return np.asarray(heights - heights.mean())


def trough_share(sand: Array, grid_m: float) -> Array:
    """How much of a trough each point of the sand is, 0 to 1: where light, dark matter gathers.

    Args:
        sand: (R, C) heights, positive up.
        grid_m: spacing of the grid.
    """
    wide = _RIPPLE_LENGTH_M / 2.0 / grid_m
    hollow = gaussian_filter(sand, wide) - gaussian_filter(sand, wide / 4.0)
    return np.clip(hollow / (0.3 * _RIPPLE_HEIGHT_M), 0.0, 1.0)


def scatter_rocks(
    bounds_ne_m: tuple[float, float, float, float],
    rocks_per_m2: float,
    largest_m: float,
    keep_clear: Array,
    rng: np.random.Generator,
) -> list[Rock]:
    """Rocks at random places, many small ones for each large one.

    Args:
        bounds_ne_m: least and greatest north, least and greatest east.
        rocks_per_m2: mean number.
        largest_m: longest horizontal axis of the largest.
        keep_clear: (K, 3) north, east and radius of circles without rocks.
        rng: source of places and shapes.
    """
    south, north, west, east = bounds_ne_m
    count = rng.poisson(rocks_per_m2 * (north - south) * (east - west))
    smallest_m = min(_MIN_ROCK_M, 0.5 * largest_m)
    rocks = []
    for _ in range(count):
        place = rng.uniform((south, west), (north, east))
        # Inverse transform of a density that falls with the size to the power of -1.5.
        power = -0.5
        u = rng.uniform()
        size_m = (smallest_m**power + u * (largest_m**power - smallest_m**power)) ** (1 / power)
        wave_numbers = rng.normal(0.0, [[2.4, 2.4]] * 4 + [[6.0, 6.0]] * 6)
        phases = rng.uniform(0.0, 2.0 * np.pi, 10)
        sizes = np.r_[rng.uniform(0.03, 0.10, 4), rng.uniform(0.008, 0.03, 6)]
        faces = np.column_stack([rng.normal(0.0, 0.55, (7, 2)), rng.uniform(0.55, 1.05, 7)])
        rock = Rock(
            north_m=float(place[0]),
            east_m=float(place[1]),
            radius_m=size_m / 2,
            flattening=rng.uniform(0.6, 0.95),
            height_m=size_m / 2 * rng.uniform(0.45, 0.85),
            buried=rng.uniform(0.2, 0.55),
            heading_rad=rng.uniform(0.0, 2.0 * np.pi),
            lumps=np.column_stack([wave_numbers, phases, sizes]),
            faces=faces,
        )
        away = np.hypot(keep_clear[:, 0] - place[0], keep_clear[:, 1] - place[1])
        if np.all(away > keep_clear[:, 2] + rock.radius_m):
            rocks.append(rock)
    return rocks


def add_rocks(
    north_m: Array, east_m: Array, heights: Array, rocks: list[Rock]
) -> tuple[Array, Array]:
    """Add rocks to the sand.

    Args:
        north_m: (R,) grid lines.
        east_m: (C,) grid lines.
        heights: (R, C) heights of the sand, positive up.
        rocks: the rocks to add.

    Returns:
        New (R, C) heights, and the share of rock at each point, (R, C) from 0 to 1.
    """
    heights, share = heights.copy(), np.zeros_like(heights)
    for rock in rocks:
        reach = 1.5 * rock.radius_m
        rows = slice(*np.searchsorted(north_m, [rock.north_m - reach, rock.north_m + reach]))
        columns = slice(*np.searchsorted(east_m, [rock.east_m - reach, rock.east_m + reach]))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        sand = heights[rows, columns]
        dome = sand.mean() + _dome(rock, north_m[rows, None], east_m[None, columns])
        # A smooth maximum: sand and stone meet in a fillet, not in a crease.
        above = (dome - sand) / _FILLET_M
        heights[rows, columns] = sand + _FILLET_M * np.logaddexp(0.0, above)
        stone = 1.0 / (1.0 + np.exp(-np.clip(above - 1.0, -30.0, 30.0)))
        share[rows, columns] = np.maximum(share[rows, columns], stone)
    return heights, share


def _dome(rock: Rock, north_m: Array, east_m: Array) -> Array:
    """Height of a rock's surface over the mean sand level around it, metres."""
    dn, de = (north_m - rock.north_m) / rock.radius_m, (east_m - rock.east_m) / rock.radius_m
    c, s = math.cos(rock.heading_rad), math.sin(rock.heading_rad)
    u, v = c * dn + s * de, (c * de - s * dn) / rock.flattening
    bumps = sum(a * np.cos(ku * u + kv * v + phase) for ku, kv, phase, a in rock.lumps)
    # Lumps move the outline too, so that no rock is an ellipse.
    r2 = (u * u + v * v) * (1.0 + 1.5 * bumps)
    inside = np.sqrt(np.maximum(1.0 - r2, 0.0))
    # Past the widest level the surface falls away, out of sight below the sand.
    profile = np.where(r2 < 1.0, inside, -np.minimum(3.0 * (r2 - 1.0), 3.0))
    cuts = [level + slope_u * u + slope_v * v for slope_u, slope_v, level in rock.faces]
    # A smooth minimum of dome and planes: faces with worn edges.
    stone = -_EDGE * np.logaddexp.reduce([-surface / _EDGE for surface in (profile, *cuts)])
    return np.asarray(rock.height_m * (stone - rock.buried) + rock.radius_m * bumps * (r2 < 1.0))


def _cosines(
    north_m: Array,
    east_m: Array,
    count: int,
    length_m: tuple[float, float],
    heading_rad: float,
    spread_rad: float,
    rng: np.random.Generator,
) -> Array:
    """A sum of plane waves of random length, heading and phase, on a grid; rms about 0.7 each."""
    length = np.exp(rng.uniform(math.log(length_m[0]), math.log(length_m[1]), count))
    heading = heading_rad + rng.uniform(-spread_rad, spread_rad, count)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    along_north = np.outer(north_m, 2.0 * np.pi / length * np.cos(heading))
    along_east = np.outer(2.0 * np.pi / length * np.sin(heading), east_m) + phase[:, None]
    weight = (length / length.max())[:, None]
    total: Array = np.cos(along_north) @ (weight * np.cos(along_east))
    total -= np.sin(along_north) @ (weight * np.sin(along_east))
    return total


def _mounds(north_m: Array, east_m: Array, rng: np.random.Generator) -> Array:
    """Heaps and hollows of 0.4 to 0.9 m radius, heights of about one, one in 6 square metres."""
    extent = (float(np.ptp(north_m)), float(np.ptp(east_m)))
    count = 1 + rng.poisson(extent[0] * extent[1] / 6.0)
    centre = rng.uniform((north_m[0], east_m[0]), (north_m[-1], east_m[-1]), (count, 2))
    radius, height = rng.uniform(0.4, 0.9, count), rng.normal(0.35, 0.8, count)
    over_north = np.exp(-0.5 * ((north_m[:, None] - centre[:, 0]) / radius) ** 2)
    over_east = np.exp(-0.5 * ((east_m[:, None] - centre[:, 1]) / radius) ** 2)
    return (over_north * height) @ over_east.T


def _ripples(north_m: Array, east_m: Array, wind_rad: float, rng: np.random.Generator) -> Array:
    """Wave ripples with sharp crests that wander, fork and fade, from 0 to about 1."""
    trains = []
    for length_m, turn_rad in ((_RIPPLE_LENGTH_M, 0.22), (1.3 * _RIPPLE_LENGTH_M, -0.22)):
        heading = wind_rad + turn_rad + rng.uniform(-0.1, 0.1)
        along = np.add.outer(north_m * math.cos(heading), east_m * math.sin(heading))
        wander = _cosines(north_m, east_m, 24, (0.45, 2.0), 0.0, math.pi, rng)
        phase = 2.0 * np.pi * along / length_m + 1.2 * wander / wander.std()
        trains.append((0.5 + 0.5 * np.sin(phase + 0.35 * np.sin(phase))) ** 1.4)
    patches = _cosines(north_m, east_m, 12, (1.2, 4.0), 0.0, math.pi, rng)
    strength = 0.2 + 0.8 / (1.0 + np.exp(-2.5 * patches / patches.std()))
    which = _cosines(north_m, east_m, 16, (0.8, 3.0), 0.0, math.pi, rng)
    first = 1.0 / (1.0 + np.exp(-4.0 * which / which.std()))
    # Crests fork where one train of waves gives way to the other.
    return np.asarray(strength * (first * trains[0] + (1.0 - first) * trains[1]))


def build_terrain(
    config: SeafloorConfig,
    bounds_ne_m: tuple[float, float, float, float],
    seafloor_depth_m: float,
    rng: np.random.Generator,
    base: Callable[[Array], Array] | None = None,
) -> Terrain:
    """Make a sea floor.

    Args:
        config: relief, rocks and objects.
        bounds_ne_m: least and greatest north, least and greatest east.
        seafloor_depth_m: mean depth of the sand.
        rng: source of all shapes.
        base: depths, (...), at places, (..., 2) north and east, on which sand and rocks lie; level
            if not given.

    Raises:
        ConfigError: the grid would be too large or too small.
    """
    south, north, west, east = bounds_ne_m
    grid_m = config.grid_m
    rows, columns = (int(np.ceil(d / grid_m)) + 1 for d in (north - south, east - west))
    if rows * columns > _MAX_VERTICES:
        raise ConfigError(
            f"seafloor.grid_m = {grid_m}: {rows} x {columns} points over {north - south:.0f} x "
            f"{east - west:.0f} m are more than {_MAX_VERTICES / 1e6:.0f} million; "
            "raise it or survey a smaller area"
        )
    if min(rows, columns) < 4:
        raise ConfigError(f"seafloor.grid_m = {grid_m}: larger than the area; lower it")
    offset = np.array([(south + north) / 2, (west + east) / 2, seafloor_depth_m])
    corner = np.array([south, west]) - offset[:2]
    along_north = corner[0] + grid_m * np.arange(rows)
    along_east = corner[1] + grid_m * np.arange(columns)
    ground_rng, rock_rng, object_rng = rng.spawn(3)
    sand = ground_relief(along_north, along_east, config.relief_m, ground_rng)
    place_ne = object_rng.uniform(-0.3, 0.3, 2)
    clear = np.array([[*place_ne, 0.55]]) if config.amphora else np.empty((0, 3))
    local = (along_north[0], along_north[-1], along_east[0], along_east[-1])
    rocks = scatter_rocks(local, config.rocks_per_m2, config.largest_rock_m, clear, rock_rng)
    heights, rock = add_rocks(along_north, along_east, sand, rocks)
    terrain = Terrain(
        offset_ned=offset,
        grid_m=grid_m,
        corner_ne=corner,
        depths=_depths(heights, along_north, along_east, offset, base),
        material=np.where(rock > 0.01, rock, -trough_share(sand, grid_m)).astype(np.float32),
    )
    if not config.amphora:
        return terrain
    return replace(terrain, objects=(_lay_amphora(terrain, place_ne, object_rng),))


def _depths(
    heights: Array,
    along_north: Array,
    along_east: Array,
    offset: Array,
    base: Callable[[Array], Array] | None,
) -> Floats:
    """Depths about the offset's of (R, C) heights on a base, row by row."""
    depths: Floats = (-heights).astype(np.float32)
    if base is None:
        return depths
    east = along_east + offset[1]
    for row, north in zip(depths, along_north + offset[0], strict=True):
        row += base(np.column_stack([np.full(len(east), north), east])) - offset[2]
    return depths


@progress.step("make the sea floor")
def survey_terrain(
    seafloor: SeafloorConfig,
    within_ne_m: Sequence[Sequence[float]] | Array,
    *,
    margin_m: float,
    depth_m: float,
    seed: int,
    base: Callable[[Array], Array] | None = None,
) -> Terrain:
    """The one sea floor of a survey: the same for all stages, from the settings alone.

    Args:
        seafloor: its settings.
        within_ne_m: (N, 2) corners of the area the vehicle may be in, as in `plan.json`.
        margin_m: around that area: the altitude of the pictures.
        depth_m: mean depth.
        seed: seed of the survey.
        base: as of `build_terrain`.
    """
    return build_terrain(
        seafloor,
        terrain_bounds(within_ne_m, margin_m),
        depth_m,
        np.random.default_rng([seed, _SEED_STREAM]),
        base,
    )


def terrain_bounds(
    corners_ne_m: Sequence[Sequence[float]] | Array, margin_m: float
) -> tuple[float, float, float, float]:
    """Least and greatest north, least and greatest east of an area and a margin around it."""
    corners = np.asarray(corners_ne_m, dtype=np.float64).reshape(-1, 2)
    low, high = corners.min(axis=0) - margin_m, corners.max(axis=0) + margin_m
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _lay_amphora(terrain: Terrain, place_ne: Array, rng: np.random.Generator) -> TerrainObject:
    """Lay the amphora on its side, its axis about at the level of the sand, the neck a bit up."""
    vertices, triangles = amphora_mesh()
    heading, pitch, roll = rng.uniform([0.0, 5.0, 25.0], [360.0, 9.0, 40.0])
    turn = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True)
    middle = np.array([BELLY_X_M, 0.0, 0.0])
    along = np.linspace(-0.5, 0.5, 9)[:, None] * LENGTH_M
    heading_rad = np.deg2rad(heading)
    under = place_ne + along * np.array([np.cos(heading_rad), np.sin(heading_rad)])
    level = float(terrain.depth_at(under + terrain.offset_ned[:2]).mean()) - terrain.offset_ned[2]
    laid = turn.apply(vertices - middle) + np.array([*place_ne, level + 0.005])
    return TerrainObject(
        name="amphora", vertices=laid.astype(np.float32), triangles=triangles, material=CERAMIC
    )


def _grid_triangles(rows: int, columns: int) -> Triangles:
    """Two triangles a cell, cut from south-west to north-east."""
    corner = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[:-1, 1:], corner[1:, 1:]
    return np.stack([a, c, d, a, d, b], axis=-1).reshape(-1, 3)
