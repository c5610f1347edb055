"""The simulated sea floor as triangles: a height field with rocks, and objects lying on it.

Coordinates are NED. They are kept as float32 about `offset_ned` (float32 far from zero would lose
the millimetre), and so they are written: what is read is what was written, to the bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import atomic_path, read_json, write_json
from alice_survey.core.config import SeafloorConfig
from alice_survey.core.errors import ConfigError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from alice_survey.sim.seafloor.relief import (
    BELLY_X_M,
    LENGTH_M,
    add_rocks,
    amphora_mesh,
    ground_relief,
    scatter_rocks,
    trough_share,
)

Floats = NDArray[np.float32]
Triangles = NDArray[np.int32]

DETRITUS, SAND, ROCK, CERAMIC = -1.0, 0.0, 1.0, 2.0
"""Values of `material`; in between it is the share (of dark matter that gathers in the troughs of
ripples, or of rock)."""

_FORMAT = {"format": "alice-survey terrain", "version": 1}
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
        normals: Floats = (sums / np.maximum(length, 1e-30)).astype(np.float32)
        return normals


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
        depth: Array = np.where(inside, local + self.offset_ned[2], np.nan)
        return depth

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
        inner: Floats = normals[top : top + height, left : left + width].astype(np.float32)
        return inner

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


def build_terrain(
    config: SeafloorConfig,
    bounds_ne_m: tuple[float, float, float, float],
    seafloor_depth_m: float,
    rng: np.random.Generator,
) -> Terrain:
    """Make a sea floor.

    Args:
        config: relief, rocks and objects.
        bounds_ne_m: least and greatest north, least and greatest east.
        seafloor_depth_m: mean depth of the sand.
        rng: source of all shapes.

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
        depths=(-heights).astype(np.float32),
        material=np.where(rock > 0.01, rock, -trough_share(sand, grid_m)).astype(np.float32),
    )
    if not config.amphora:
        return terrain
    return replace(terrain, objects=(_lay_amphora(terrain, place_ne, object_rng),))


@progress.step("make the sea floor")
def survey_terrain(
    seafloor: SeafloorConfig,
    within_ne_m: Sequence[Sequence[float]] | Array,
    *,
    margin_m: float,
    depth_m: float,
    seed: int,
) -> Terrain:
    """The one sea floor of a survey: the same for all stages, from the settings alone.

    Args:
        seafloor: its settings.
        within_ne_m: (N, 2) corners of the area the vehicle may be in, as in `plan.json`.
        margin_m: around that area: the altitude of the pictures.
        depth_m: mean depth.
        seed: seed of the survey.
    """
    return build_terrain(
        seafloor,
        terrain_bounds(within_ne_m, margin_m),
        depth_m,
        np.random.default_rng([seed, _SEED_STREAM]),
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
        name="amphora",
        vertices=laid.astype(np.float32),
        triangles=triangles,
        material=CERAMIC,
    )


def _grid_triangles(rows: int, columns: int) -> Triangles:
    """Two triangles a cell, cut from south-west to north-east."""
    corner = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[:-1, 1:], corner[1:, 1:]
    return np.stack([a, c, d, a, d, b], axis=-1).reshape(-1, 3)
