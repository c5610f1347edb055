"""How the pixels of a picture as taken and those of the ideal pinhole belong together.

`sparse/` models see ideal pinholes. For a calibrated rig a pinhole stands in for the camera behind
its flat port (exact at one working range); for a camera without calibration the model found by
self-calibration is taken out.
"""

from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.base.contents import one_line
from alice_survey.base.errors import CalibrationError, WorkspaceError
from alice_survey.base.frames import Array
from camera_calib.approximation.virtual_pinhole import VirtualPinhole, best_pinhole
from camera_calib.camera import Camera, camera_from_json

_LARGEST_GROWTH = 1.5
"""An undistorted picture has at most this many times the width and height of the one taken."""


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """An ideal pinhole camera; pixels count from the outer corner of the first pixel."""

    width_px: int
    height_px: int
    focal_px: float
    cx_px: float
    cy_px: float

    @property
    def colmap(self) -> pycolmap.Camera:
        """The pinhole as COLMAP's camera."""
        return pycolmap.Camera(
            model="PINHOLE",
            width=self.width_px,
            height=self.height_px,
            params=[self.focal_px, self.focal_px, self.cx_px, self.cy_px],
            has_prior_focal_length=True,
        )


class Lens(Protocol):
    """What turns pixels as taken into those of a pinhole, and back."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture as taken."""

    @property
    def pinhole(self) -> Pinhole:
        """The ideal camera."""

    @property
    def pinhole_from_cam(self) -> RigidTransform:
        """Transform from the camera's frame (origin at its entrance pupil) to the pinhole's."""

    def to_pinhole(self, pixels: Array) -> Array:
        """Pixels (N, 2) of the picture as taken to the pinhole's; NaN where there are none."""

    def from_pinhole(self, pixels: Array) -> Array:
        """The inverse of `to_pinhole`."""

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""


@dataclass(frozen=True, kw_only=True)
class FlatPortLens:
    """A calibrated camera behind a flat port, and the axial pinhole that stands in for it."""

    camera: Camera
    virtual: VirtualPinhole

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture as taken."""
        return self.camera.width_px, self.camera.height_px

    @property
    def pinhole(self) -> Pinhole:
        """The ideal camera."""
        v = self.virtual
        return Pinhole(
            width_px=v.width_px,
            height_px=v.height_px,
            focal_px=v.focal_px,
            cx_px=v.cx_px,
            cy_px=v.cy_px,
        )

    @property
    def pinhole_from_cam(self) -> RigidTransform:
        """Transform from the entrance pupil to the pinhole's centre on the axis."""
        return self.virtual.virtual_from_cam

    def to_pinhole(self, pixels: Array) -> Array:
        """Where the pinhole sees what the camera sees at the working range."""
        return self.virtual.project(self.camera.at_depth(pixels, self.virtual.working_range_m))

    def from_pinhole(self, pixels: Array) -> Array:
        """The inverse of `to_pinhole`."""
        return self.camera.project(self.virtual.at_depth(pixels, self.virtual.working_range_m))

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return {
            "kind": "flat_port",
            "camera": self.camera.to_json(),
            "pinhole": asdict(self.virtual),
        }


@dataclass(frozen=True, kw_only=True)
class ColmapLens:
    """A camera that COLMAP calibrated from the pictures themselves."""

    model: str
    width_px: int
    height_px: int
    params: tuple[float, ...]
    pinhole: Pinhole

    @property
    def _colmap(self) -> pycolmap.Camera:
        return pycolmap.Camera(
            model=self.model, width=self.width_px, height=self.height_px, params=self.params
        )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture as taken."""
        return self.width_px, self.height_px

    @property
    def pinhole_from_cam(self) -> RigidTransform:
        """The identity: both share one centre."""
        return RigidTransform.identity()

    def to_pinhole(self, pixels: Array) -> Array:
        """Pixels without distortion."""
        slopes = _slopes(self._colmap, pixels)
        return slopes * self.pinhole.focal_px + [self.pinhole.cx_px, self.pinhole.cy_px]

    def from_pinhole(self, pixels: Array) -> Array:
        """The inverse of `to_pinhole`."""
        slopes = (pixels - [self.pinhole.cx_px, self.pinhole.cy_px]) / self.pinhole.focal_px
        rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
        return np.asarray(self._colmap.img_from_cam(rays), dtype=np.float64).reshape(-1, 2)

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return {
            "kind": "colmap",
            "model": self.model,
            "width_px": self.width_px,
            "height_px": self.height_px,
            "params": list(self.params),
            "pinhole": asdict(self.pinhole),
        }


def flat_port_lens(camera: Camera, near_m: float, far_m: float) -> FlatPortLens:
    """The best pinhole for distances between near and far from the entrance pupil."""
    return FlatPortLens(camera=camera, virtual=best_pinhole(camera, near_m, far_m))


def self_calibrated_lens(camera: pycolmap.Camera) -> ColmapLens:
    """The lens of a camera that COLMAP calibrated.

    The pinhole keeps the focal length, so that no detail is lost in the middle, and is as large as
    the undistorted ends of the picture's axes need.
    """
    width, height = camera.width, camera.height
    focal = float(camera.mean_focal_length())
    cx, cy = float(camera.principal_point_x), float(camera.principal_point_y)
    ends = np.array([[0.0, cy], [width, cy], [cx, 0.0], [cx, height]])
    reach = np.abs(_slopes(camera, ends)[[0, 1, 2, 3], [0, 0, 1, 1]]) * focal
    plain = np.array([cx, width - cx, cy, height - cy])
    usable = np.isfinite(reach) & (reach > 0)
    left, right, top, bottom = np.clip(
        np.where(usable, reach, plain), plain / _LARGEST_GROWTH, plain * _LARGEST_GROWTH
    )
    pinhole = Pinhole(
        width_px=round(left + right),
        height_px=round(top + bottom),
        focal_px=focal,
        cx_px=float(left),
        cy_px=float(top),
    )
    return ColmapLens(
        model=str(camera.model_name),
        width_px=width,
        height_px=height,
        params=tuple(float(p) for p in camera.params),
        pinhole=pinhole,
    )


def lens_from_json(data: dict[str, Any]) -> Lens:
    """The inverse of `Lens.to_json`.

    Raises:
        WorkspaceError: a value is missing or wrong.
    """
    try:
        if data["kind"] == "flat_port":
            return FlatPortLens(
                camera=camera_from_json(data["camera"]), virtual=VirtualPinhole(**data["pinhole"])
            )
        return ColmapLens(
            model=data["model"],
            width_px=data["width_px"],
            height_px=data["height_px"],
            params=tuple(data["params"]),
            pinhole=Pinhole(**data["pinhole"]),
        )
    except (KeyError, TypeError, ValueError, CalibrationError) as error:
        raise WorkspaceError(f"a camera of cameras.json is wrong: {one_line(error)}") from None


def _slopes(camera: pycolmap.Camera, pixels: Array) -> Array:
    """Ray slopes x/z and y/z, (N, 2); NaN where the distortion has no inverse."""
    if not len(pixels):
        return np.zeros((0, 2))
    rays = np.asarray(camera.cam_from_img(np.asarray(pixels, dtype=np.float64)), dtype=np.float64)
    return rays.reshape(len(pixels), -1)[:, :2]
