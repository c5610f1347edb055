"""Focus and depth of field through any port, on the axis and towards the corners.

Seen from a pupil that is moved sideways by e, the ray in air of a point in water turns by J e, with
J from the analytic slopes of the camera. A point at the depth z in air would turn it by -e / z: the
two eigenvalues of -J are one over the depths of the two line images of the point, tangential and
sagittal, which coincide on the axis. By Coddington's equations (Born & Wolf, Principles of Optics,
section 4.6) each is a homographic function of the distance in water, of any number of surfaces.
The lens itself is thin, perfect and of a flat field, with its stop at the entrance pupil.
"""

from dataclasses import dataclass, replace

import numpy as np

from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens

_ROUNDING = 1e-9
_TANGENTS = OpenCVLens(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)


@dataclass(frozen=True, kw_only=True)
class FocusedLens:
    """A thin lens, its stop at the entrance pupil, focused at a distance in air."""

    focal_m: float
    f_number: float
    pixel_m: float
    """Pitch of the sensor."""
    focus_m: float
    """Distance from the entrance pupil to the plane in air that is sharp."""

    def __post_init__(self) -> None:
        if not self.focus_m > self.focal_m:
            raise ConfigError(
                f"a lens of {self.focal_m * 1e3:g} mm cannot focus at {self.focus_m:g} m in air: "
                "raise the altitude or the focus distance, or take a shorter lens"
            )

    @property
    def defocus_px(self) -> float:
        """Blur circle, px, for one dioptre (1/m) of focus error.

        Aperture f / N times image distance f s / (s - f), over the pitch (similar triangles).
        """
        image_m = self.focal_m * self.focus_m / (self.focus_m - self.focal_m)
        return self.focal_m / self.f_number * image_m / self.pixel_m

    def blur_px(self, depth_m: Array | float) -> Array:
        """Diameter of the blur circle of points that appear at a depth in air, px."""
        return self.defocus_px * np.abs(1.0 / np.asarray(depth_m) - 1.0 / self.focus_m)

    def sharp_depths_m(self, coc_px: float) -> tuple[float, float]:
        """Nearest and farthest apparent depth whose blur circle is at most coc_px; far may be inf.

        The classical s (H - f) / (H + s - 2 f) and s (H - f) / (H - s), in dioptres.
        """
        slack = coc_px / self.defocus_px
        far = 1.0 / self.focus_m - slack
        return 1.0 / (1.0 / self.focus_m + slack), (1.0 / far if far > 0 else np.inf)

    def hyperfocal_m(self, coc_px: float) -> float:
        """Focus at which the far limit just reaches infinity: f^2 / (N c) + f."""
        return self.focal_m**2 / (self.f_number * coc_px * self.pixel_m) + self.focal_m


@dataclass(frozen=True, kw_only=True, eq=False)
class ApparentDepths:
    """Apparent depth of a sea floor along the camera's axis, for some pixels.

    One over the apparent depth in air is (1 + far * altitude) / (offset_m + slope * altitude); the
    last axis holds tangential and sagittal.
    """

    offset_m: Array
    """(N, 2): apparent depth of the outer surface."""
    slope: Array
    """(N, 2): 1 / n_water on the axis of a flat port."""
    far: Array
    """(N, 2), 1/m: 0 for a flat port; behind a dome even the farthest seems near."""

    def at(self, altitude_m: float) -> Array:
        """Apparent depths, (N, 2), of a sea floor at an altitude of the outer glass."""
        return (self.offset_m + self.slope * altitude_m) / (1.0 + self.far * altitude_m)

    def altitudes_m(self, depth_m: float) -> Array:
        """The inverse of `at`, (N, 2): altitudes that appear at a depth; inf beyond all."""
        steep = self.slope / depth_m - self.far
        beyond = np.where(steep > 0.0, steep, np.nan)
        found: Array = (1.0 - self.offset_m / depth_m) / beyond
        return np.where(np.isnan(found), np.inf, found)

    def sharp_altitudes_m(self, lens: FocusedLens, coc_px: float) -> tuple[float, float]:
        """Nearest and farthest altitude that is sharp in all these pixels and both directions.

        Returns:
            NaN twice where no altitude is sharp in all of them; far may be inf.
        """
        near_m, far_m = lens.sharp_depths_m(coc_px)
        near = max(0.0, float(np.max(self.altitudes_m(near_m))))
        far = float(np.min(self.altitudes_m(far_m)))
        return (near, far) if far >= near and near < np.inf else (np.nan, np.nan)


def apparent_distance_m(camera: Camera, altitude_m: float) -> float:
    """Apparent depth of the sea floor from the entrance pupil, near the axis of the port."""
    return float(_on_axis(camera).at(altitude_m)[0].mean())


def altitude_of_apparent_m(camera: Camera, apparent_m: float) -> float:
    """Altitude of ground at an apparent distance: the inverse of `apparent_distance_m`."""
    return float(_on_axis(camera).altitudes_m(apparent_m)[0].mean())


def axial_pixel_m(camera: Camera) -> tuple[float, float]:
    """Size of a pixel on the sea floor at altitude 0, and its growth for a metre (paraxial)."""
    points = np.array([0.0, 0.0, float(camera.front_cam[2])]) + np.array([[0, 0, 1.0], [0, 0, 2.0]])
    slopes = replace(camera, lens=_TANGENTS).project_jacobian(points)[1]
    first, second = (2.0 / (slopes[:, 0, 0] + slopes[:, 1, 1]) / camera.fx_px).tolist()
    return 2.0 * first - second, second - first


def apparent_depths(camera: Camera, pixels: Array) -> ApparentDepths:
    """Apparent depths of sea floors square to the camera's axis, for pixels (N, 2).

    Altitude is that of `Camera.front_cam`. Rows are NaN where no light comes through.
    """
    return _depths(camera, *camera.unproject(pixels))


def _on_axis(camera: Camera) -> ApparentDepths:
    """Apparent depths where the axis of the port meets the sea floor."""
    axis = np.array([camera.port.axis_cam])
    return _depths(camera, camera.front_cam[None], axis)


def _depths(camera: Camera, starts: Array, directions: Array) -> ApparentDepths:
    """Apparent depths along rays in water: three altitudes give the homographic function."""
    bare = replace(camera, lens=_TANGENTS)
    reach = (camera.front_cam[2] - starts[:, 2]) / directions[:, 2]
    by_motion = camera.port.by_motion[:, :2]
    heights = np.array([1.0, 2.0, 4.0])
    vergences = []
    for height_m in heights:
        along = reach + height_m / directions[:, 2]
        points = starts + along[:, None] * directions
        _, by_point, by_parameter = bare.project_jacobian(points)
        moved = by_point[..., :2] + by_parameter[..., len(_TANGENTS.parameters) :] @ by_motion
        vergences.append(np.linalg.eigvalsh((moved + moved.transpose(0, 2, 1)) / 2)[:, ::-1])
    depths = 1.0 / np.stack(vergences)
    # z (1 + f h) = o + s h: linear in o, s and f.
    rows = np.stack(
        [np.ones_like(depths), np.broadcast_to(heights[:, None, None], depths.shape),
         -depths * heights[:, None, None]], axis=-1,
    )  # fmt: skip
    known = np.isfinite(rows).all(axis=(0, 3))
    found = np.full((*known.shape, 3), np.nan)
    matrices, right = rows.transpose(1, 2, 0, 3)[known], depths.transpose(1, 2, 0)[known]
    found[known] = np.linalg.solve(matrices, right[..., None])[..., 0]
    far = np.where(np.abs(found[..., 2]) < _ROUNDING, 0.0, found[..., 2])
    return ApparentDepths(offset_m=found[..., 0], slope=found[..., 1], far=far)
