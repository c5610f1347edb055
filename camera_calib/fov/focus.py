"""Focus and depth of field through a flat port, on the axis and towards the corners.

A plane surface forms two line images in air of a point in water, one for the rays in the plane of
incidence (tangential) and one for those across it (sagittal); on the axis they coincide. Along a
ray that meets the port at the angle a in air, and b in the glass and c in the water, of path
lengths A, G and W, the images appear at the distances from the entrance pupil

    sagittal    A + G / n_glass + W / n_water
    tangential  A + G cos^2 a / (n_glass cos^2 b) + W cos^2 a / (n_water cos^2 c)

(Coddington's equations at a plane: n / s is kept, and n cos^2 / t; Born & Wolf, Principles of
Optics, section 4.6). Both are linear in the altitude. The lens itself is thin, perfect and of a
flat field, with its stop at the entrance pupil.
"""

from dataclasses import dataclass, replace

import numpy as np

from alice_survey.base.errors import ConfigError
from alice_survey.base.frames import Array
from camera_calib.flat_port import FlatPortCamera


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
        blur: Array = self.defocus_px * np.abs(1.0 / np.asarray(depth_m) - 1.0 / self.focus_m)
        return blur

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

    Apparent depth in air is `offset_m + slope * altitude_m`; the last axis holds tangential and
    sagittal.
    """

    offset_m: Array
    """(N, 2): contribution of the port."""
    slope: Array
    """(N, 2): 1 / n_water on the axis."""

    def at(self, altitude_m: float) -> Array:
        """Apparent depths, (N, 2), of a sea floor at an altitude of the outer glass."""
        depths: Array = self.offset_m + self.slope * altitude_m
        return depths

    def sharp_altitudes_m(self, lens: FocusedLens, coc_px: float) -> tuple[float, float]:
        """Nearest and farthest altitude that is sharp in all these pixels and both directions.

        Returns:
            NaN twice where no altitude is sharp in all of them; far may be inf.
        """
        near_m, far_m = lens.sharp_depths_m(coc_px)
        near = max(0.0, float(np.max((near_m - self.offset_m) / self.slope)))
        far = float(np.min((far_m - self.offset_m) / self.slope))
        return (near, far) if far >= near else (np.nan, np.nan)


def apparent_distance_m(camera: FlatPortCamera, altitude_m: float) -> float:
    """Apparent depth of the sea floor from the entrance pupil, near the axis of the port."""
    air = camera.port_distance_m + camera.glass_thickness_m / camera.n_glass
    return air + altitude_m / camera.n_water


def glass_z_m(camera: FlatPortCamera) -> float:
    """Depth along the camera's axis of the outer glass, where the normal of the pupil meets it."""
    return (camera.port_distance_m + camera.glass_thickness_m) * camera.normal[2]


def air_rays(camera: FlatPortCamera, pixels: Array) -> Array:
    """Unit directions in air, (..., 3), of pixels: before the port bends them."""
    bare = replace(camera, port_distance_m=0.0, glass_thickness_m=0.0, n_glass=1.0, n_water=1.0)
    return bare.unproject(pixels)[1]


def apparent_depths(camera: FlatPortCamera, pixels: Array) -> ApparentDepths:
    """Apparent depths of sea floors square to the camera's axis, for pixels (N, 2).

    Altitude is that of the outer glass (`glass_z_m`). Rows are NaN where no light comes through.
    """
    in_air = air_rays(camera, pixels)
    outer, in_water = camera.unproject(pixels)
    cos_air = in_air @ np.asarray(camera.normal)
    sin2 = 1.0 - cos_air**2
    cos2_glass = 1.0 - sin2 / camera.n_glass**2
    cos2_water = 1.0 - sin2 / camera.n_water**2
    air = camera.port_distance_m / cos_air
    glass = camera.glass_thickness_m / np.sqrt(cos2_glass) / camera.n_glass
    # From the outer glass to a sea floor at altitude 0: not zero where the port is tilted.
    water = (glass_z_m(camera) - outer[:, 2]) / in_water[:, 2] / camera.n_water
    per_m = 1.0 / in_water[:, 2] / camera.n_water
    squeeze = np.stack([cos_air**2, np.ones_like(cos_air)])
    squeeze_glass = squeeze / np.stack([cos2_glass, np.ones_like(cos_air)])
    squeeze_water = squeeze / np.stack([cos2_water, np.ones_like(cos_air)])
    along_axis = in_air[:, 2]
    offset = (air + glass * squeeze_glass + water * squeeze_water) * along_axis
    return ApparentDepths(offset_m=offset.T, slope=(per_m * squeeze_water * along_axis).T)
