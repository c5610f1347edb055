"""Which registered pictures see a place, exactly through their ports: of thousands, at once."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import need_stage
from alice_survey.core.contents import taken_from
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.records import CamerasRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.mapping.arrays import Indices
from reconstruct.placing.control_points import RegisteredPicture
from reconstruct.views.model import WorldFrame, read_frame, read_warps
from reconstruct.views.model_files import ImagesFile

_EDGE = 0.3
"""Light and sharpness fall off: a pixel at a corner counts as this share less than the middle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """A picture that sees a place."""

    image: str
    pixel: Array
    """(2,) of the picture as taken, from the outer corner of the first."""
    off_nadir_rad: float
    """Angle at the place between the normal of the surface and the way to the camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredPictures:
    """Poses and cameras of all registered pictures; 150 bytes a picture, whatever these hold."""

    names: tuple[str, ...]
    """Sorted."""
    camera: Indices
    """(N,) which of `warps` took each."""
    station: Indices
    """(N,) station of each."""
    turns: Array
    """(N, 3, 3) `world_from_cam`, and (N, 3) where the cameras' entrance pupils are."""
    centres: Array
    warps: Mapping[str, PinholeWarp]
    frame: WorldFrame

    @classmethod
    def read(cls, workspace: Path) -> "RegisteredPictures":
        """The pictures of a finished `sparse/`.

        Raises:
            WorkspaceError: it is missing or damaged.
            ReconstructionError: the model is damaged.
        """
        sparse = need_stage(workspace, "sparse", "reconstruct")
        path = sparse / "cameras.json"
        stored, warps = CamerasRecord.read(path).images, read_warps(path)
        found = sorted(ImagesFile(sparse / "model").pictures, key=lambda one: one.name)
        numbers = {name: n for n, name in enumerate(warps)}
        with taken_from(path):
            camera = np.array([numbers[stored[p.name].camera] for p in found], np.int64)
            station = np.array([stored[p.name].station for p in found], np.int64)
        poses = np.array([p.cam_from_world for p in found]).reshape(-1, 7)
        pinholes = RigidTransform.from_components(
            poses[:, 4:], Rotation.from_quat(poses[:, [1, 2, 3, 0]])
        ).inv()
        pupils = np.array([warp.pinhole_from_cam.translation for warp in warps.values()])
        return cls(
            names=tuple(p.name for p in found),
            camera=camera,
            station=station,
            turns=pinholes.rotation.as_matrix(),
            centres=pinholes.apply(pupils[camera]),
            warps=warps,
            frame=read_frame(sparse / "frame.json"),
        )

    def __contains__(self, image: object) -> bool:
        return image in self._rows

    def row(self, image: str) -> int:
        """Which one of the pictures it is.

        Raises:
            ReconstructionError: it is not registered.
        """
        if image not in self._rows:
            raise ReconstructionError(
                f"{image!r} is no registered picture: there are {len(self.names)}, such as "
                f"{self.names[0] if self.names else 'none'}"
            )
        return self._rows[image]

    @cached_property
    def _rows(self) -> Mapping[str, int]:
        return {name: n for n, name in enumerate(self.names)}

    def warp(self, image: str) -> PinholeWarp:
        """The camera that took a picture."""
        warps: list[PinholeWarp] = list(self.warps.values())
        return warps[int(self.camera[self.row(image)])]

    def picture(self, image: str) -> RegisteredPicture:
        """A picture by its name; see `row`."""
        row, warp = self.row(image), self.warp(image)
        cam = RigidTransform.from_components(
            self.centres[row], Rotation.from_matrix(self.turns[row])
        )
        return RegisteredPicture(warp=warp, model_from_pinhole=cam * warp.pinhole_from_cam.inv())

    def pixels(self, place: Array) -> Array:
        """(N, 2) where every picture as taken shows a place (3,); NaN where it does not."""
        arms = np.einsum("nij,ni->nj", self.turns, place - self.centres)
        found = np.full((len(arms), 2), np.nan)
        for number, warp in enumerate(self.warps.values()):
            rows = np.flatnonzero((self.camera == number) & (arms[:, 2] > 0))
            near = rows[_in_cone(arms[rows], warp)]
            pixels = warp.camera.project(arms[near])
            with np.errstate(invalid="ignore"):
                inside = ((pixels >= 0) & (pixels <= np.array(warp.size_px))).all(axis=1)
            found[near[inside]] = pixels[inside]
        return found

    def seeing(self, place: Array, normal: Array) -> list[Sight]:
        """Pictures that show a place of a surface from its front, the best first.

        Best is the finest resolution on the surface, less towards the corners of the frame. What
        stands between is not looked at.

        Args:
            place: (3,) in the world.
            normal: (3,) unit vector out of the surface.
        """
        pixels = self.pixels(place)
        rows = np.flatnonzero(np.isfinite(pixels[:, 0]))
        ways = self.centres[rows] - place
        facing = ways @ normal / np.linalg.norm(ways, axis=1)
        rows, facing = rows[facing > 0], facing[facing > 0]
        along = tangents(normal)
        rank = np.zeros(len(rows))
        for number, warp in enumerate(self.warps.values()):
            mine = np.flatnonzero(self.camera[rows] == number)
            turns = self.turns[rows[mine]]
            arms = np.einsum("nij,ni->nj", turns, place - self.centres[rows[mine]])
            slopes = warp.camera.project_jacobian(arms)[1] @ turns.swapaxes(1, 2) @ along
            fine = np.sqrt(np.abs(np.linalg.det(slopes)))
            half = np.array(warp.size_px) / 2
            away = np.linalg.norm(pixels[rows[mine]] - half, axis=1) / np.linalg.norm(half)
            rank[mine] = fine * (1.0 - _EDGE * away**2)
        return [
            Sight(
                image=self.names[rows[n]],
                pixel=pixels[rows[n]],
                off_nadir_rad=float(np.arccos(min(1.0, facing[n]))),
            )
            for n in np.argsort(-rank, kind="stable").tolist()
        ]


def tangents(normal: Array) -> Array:
    """(3, 2) unit vectors square to a normal and to each other."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)


def _in_cone(points_cam: Array, warp: PinholeWarp) -> NDArray[np.bool_]:
    """(N,) whether points are in a cone about the axis that holds all that the frame shows."""
    _, ways = warp.camera.unproject(warp.camera.border())
    slopes = np.linalg.norm(ways[:, :2], axis=1) / ways[:, 2]
    if not np.isfinite(slopes).all():  # a corner is beyond the reach of the lens
        return np.ones(len(points_cam), np.bool_)
    start = float(np.linalg.norm(warp.camera.unproject(warp.camera.border())[0], axis=1).max())
    away = np.linalg.norm(points_cam[:, :2], axis=1)
    return np.asarray(away <= 1.05 * slopes.max() * points_cam[:, 2] + start)
