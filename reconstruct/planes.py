"""Planes that a survey is projected on: the level one, walls, hulls, or the best one.

A plane's frame is as that of the world, north, east, down, for someone who faces the plane: its
first axis points up the plane, the second to the right, the third into it. A model that is turned
into it goes through rasters and mosaic as a level one does.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.config import AUTO, LEVEL, WantedPlane
from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.frames import Array
from alice_survey.core.records import Direction, PlaceRecord, PlaneRecord
from reconstruct.views.model import MEAN_PLANE, SparseModel, View, WorldFrame

PLANES = "planes"
"""Folder, in those of surface and mosaic, of the planes after the first."""
_NEAR_LEVEL_DEG = 30.0
"""A best plane that is no farther from level is the level one."""
_VOXELS = 60
"""Voxels along the longest side of the points: each counts once, however many points it holds."""
_BAND_VOXELS = 2.0
"""Half the thickness of what counts as one plane, in voxels."""
_TRIALS = 600
_REFINEMENTS = 10
_AGREEING = 0.7
"""Length of the mean of the pictures' directions up from which they are upright."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """A plane in space, with its own north (up the plane), east (right) and down (into it)."""

    name: str
    about: str
    """How it lies, in words."""
    plane_from_world: RigidTransform

    @property
    def is_level(self) -> bool:
        """Whether it is the world's own."""
        return self.name == LEVEL

    @property
    def normal_world(self) -> Array:
        """(3,) unit vector out of the plane, towards its viewer."""
        return np.asarray(-self.plane_from_world.rotation.as_matrix()[2])


LEVEL_PLANE = Plane(name=LEVEL, about="level", plane_from_world=RigidTransform.identity())


def facing(facing_deg: float, tilt_deg: float) -> Rotation:
    """`plane_from_world` of a surface that faces a compass direction.

    Args:
        facing_deg: direction of its normal, degrees from north (the world's first axis) to east.
        tilt_deg: of the surface from the vertical; 90 faces straight up, a negative one overhangs.
    """
    azimuth, tilt = np.deg2rad([facing_deg, tilt_deg])
    into = -np.array(
        [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), -np.sin(tilt)]
    )
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return Rotation.from_matrix(np.stack([np.cross(right, into), right, into]))


def chosen_planes(requested: Sequence[WantedPlane], model: SparseModel) -> tuple[Plane, ...]:
    """The planes that settings name, in their order; `auto` is found from the model's points.

    Raises:
        ReconstructionError: the model has too few points for `auto`.
    """
    if model.frame.name == "model" and any(plane.facing_deg is not None for plane in requested):
        warn(
            "the model has no place in the world: the directions that planes face count from its "
            "own first axis"
        )
    found: dict[str, Plane] = {}
    for one in requested:
        plane = LEVEL_PLANE
        if one.name == AUTO:
            plane = best_plane(model)
        elif one.facing_deg is not None:
            rotation = facing(one.facing_deg, one.tilt_deg)
            plane = Plane(
                name=one.name,
                about=f"facing {one.facing_deg:g} deg, tilt {one.tilt_deg:g} deg",
                plane_from_world=RigidTransform.from_rotation(rotation),
            )
        found.setdefault(plane.name, plane)  # auto may be level too
    return tuple(found.values())


def best_plane(model: SparseModel) -> Plane:
    """The plane that most of a model's surface is near to; level where that is nearly so.

    Where gravity is known its second axis is level; else pictures that agree on their own up say
    what is up.

    Raises:
        ReconstructionError: the points span no plane.
    """
    centres = np.array([view.world_from_cam.translation for view in model.views]).reshape(-1, 3)
    middle, normal = fit_plane(model.points_world, centres)
    upright = None if model.frame.vertical_datum != MEAN_PLANE else _pictures_up(model, normal)
    near_level = -normal[2] >= math.cos(math.radians(_NEAR_LEVEL_DEG))
    if near_level and upright is None:
        return LEVEL_PLANE
    azimuth = math.degrees(math.atan2(normal[1], normal[0])) % 360.0
    tilt = math.degrees(math.asin(max(-1.0, min(1.0, -normal[2]))))
    rotation = facing(azimuth, tilt)
    turned, leaning = round(azimuth, 1) + 0.0, round(tilt, 1) + 0.0
    about = f"best plane: facing {turned:g} deg, tilt {leaning:g} deg"
    if upright is not None:
        into = -normal
        rotation = Rotation.from_matrix(np.stack([upright, np.cross(into, upright), into]))
        about = "best plane, upright as most pictures are"
    return Plane(
        name=AUTO,
        about=about,
        plane_from_world=RigidTransform.from_components(-rotation.apply(middle), rotation),
    )


def _pictures_up(model: SparseModel, normal: Array) -> Array | None:
    """(3,) unit vector in a plane that is up in the pictures; None where they disagree."""
    ups = np.array([view.world_from_cam.rotation.apply([0.0, -1.0, 0.0]) for view in model.views])
    mean = ups.mean(axis=0)
    mean -= (mean @ normal) * normal
    length = float(np.linalg.norm(mean))
    return mean / length if length > _AGREEING else None


def fit_plane(points: Array, viewers: Array) -> tuple[Array, Array]:
    """The plane with most surface near to it, by area and not by the number of points.

    Points are thinned to one in each voxel; of planes through three of them that with most others
    near to it is taken (MSAC; Torr and Zisserman, 2000), and fitted to these.

    Args:
        points: (N, 3).
        viewers: (M, 3) places of cameras.

    Returns:
        (3,) the middle of what is near to it, and (3,) its unit normal, towards the viewers.

    Raises:
        ReconstructionError: the points span no plane.
    """
    shown, edge = _thin(points)
    band = _BAND_VOXELS * edge
    rng = np.random.default_rng(0)
    corners = shown[rng.integers(0, max(len(shown), 1), (_TRIALS if len(shown) else 0, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    wide = lengths > edge * edge
    if not wide.any():
        raise ReconstructionError(
            f"{len(points)} points span no plane: name one instead of 'auto', as wall=facing 180"
        )
    normals, starts = normals[wide] / lengths[wide, None], corners[wide, 0]
    costs = [
        float(np.minimum(((shown - start) @ normal) ** 2, band**2).sum())
        for normal, start in zip(normals, starts, strict=True)
    ]
    best = int(np.argmin(costs))
    normal, middle = normals[best], starts[best]
    for _ in range(_REFINEMENTS):
        residuals = np.abs((shown - middle) @ normal)
        scatter = MAD_TO_SIGMA * float(np.median(residuals[residuals <= band]))
        near = shown[residuals <= min(band, max(3.0 * scatter, 1e-3 * band))]
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
    if np.median((viewers - middle) @ normal) < 0:
        normal = -normal
    return middle, normal


def _thin(points: Array) -> tuple[Array, float]:
    """One mean point for every voxel, and the voxels' edge."""
    if len(points) < 3:
        return points[:0], 0.0
    low, high = np.percentile(points, [2, 98], axis=0)
    edge = float((high - low).max()) / _VOXELS
    if not edge > 0.0:
        return points[:0], 0.0
    margin = 0.1 * (high - low) + edge
    inside = points[((points > low - margin) & (points < high + margin)).all(axis=1)]
    _, voxel = np.unique(np.floor(inside / edge), axis=0, return_inverse=True)
    voxel = voxel.ravel()
    count = np.bincount(voxel)
    shown = np.stack([np.bincount(voxel, inside[:, k]) for k in range(3)], axis=1)
    return shown / count[:, None], edge


def turned_view(view: View, plane: Plane) -> View:
    """A view in a plane's frame."""
    if plane.is_level:
        return view
    return replace(view, world_from_cam=plane.plane_from_world * view.world_from_cam)


def turn_model(model: SparseModel, plane: Plane) -> SparseModel:
    """A model in a plane's frame; unchanged in the level one."""
    if plane.is_level:
        return model
    return replace(
        model,
        frame=plane_frame(model.frame, plane),
        views=tuple(turned_view(view, plane) for view in model.views),
        points_world=plane.plane_from_world.apply(model.points_world),
    )


def plane_frame(world: WorldFrame, plane: Plane) -> WorldFrame:
    """The frame of a plane's rasters; the world's own of the level one."""
    if plane.is_level:
        return world
    axes = _axes(plane)
    tags = {"PLANE": plane.name, "PLANE_ABOUT": plane.about} | {
        f"PLANE_{name.upper()}": " ".join(repr(value) for value in axis)
        for name, axis in axes.items()
    }
    return replace(
        world,
        name="plane",
        datum=None,
        vertical_datum=f"the plane {plane.name!r}",
        notes=(*world.notes, f"projected on a plane {plane.about}"),
        tags=tuple(tags.items()),
    )


def _axes(plane: Plane) -> dict[str, Direction]:
    """Origin, and directions right, up and out of a plane: east, north, up."""
    up, right, into = plane.plane_from_world.rotation.as_matrix()
    origin = plane.plane_from_world.inv().translation
    axes = {"origin_enu": origin, "right_enu": right, "up_enu": up, "out_enu": -into}
    return {
        name: (round(y, 15) + 0.0, round(x, 15) + 0.0, round(-z, 15) + 0.0)
        for name, (x, y, z) in ((name, axis.tolist()) for name, axis in axes.items())
    }


def write_plane(folder: Path, plane: Plane, world: WorldFrame) -> None:
    """Write `plane.json` of a folder: how a pixel becomes a point of the model's world."""
    datum = world.datum
    PlaneRecord.save(
        folder / "plane.json",
        {
            "format": "alice-survey plane",
            "version": 1,
            "name": plane.name,
            "about": plane.about,
            **_axes(plane),
            "frame": world.name,
            "unit": world.unit,
            "datum": None if datum is None else PlaceRecord(**asdict(datum)).to_json(),
            "vertical_datum": world.vertical_datum,
        },
    )


def read_plane(folder: Path) -> Plane:
    """The plane of a folder's rasters; level where none is written.

    Raises:
        WorkspaceError: it is damaged.
    """
    found = PlaneRecord.read_existing(folder / "plane.json")
    if found is None or found.name == LEVEL:
        return LEVEL_PLANE
    enu = np.array([found.up_enu, found.right_enu, found.out_enu, found.origin_enu])
    up, right, out, origin = enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    rotation = Rotation.from_matrix(np.stack([up, right, -out]))
    move = RigidTransform.from_components(-rotation.apply(origin), rotation)
    return Plane(name=found.name, about=found.about, plane_from_world=move)


def plane_folders(stage: Path) -> list[Path]:
    """Folders of a stage with a plane's products: its own, then those below it."""
    return [stage, *sorted(path for path in (stage / PLANES).glob("*") if path.is_dir())]
