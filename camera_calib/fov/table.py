"""Field of view, resolution, focus, stereo and blur of a lens behind the flat port.

Everything follows from the exact flat-port camera. Near the axis a port of distance d and glass g,
seen from the entrance pupil, brings the sea floor at altitude a to the apparent distance
D = d + g / n_glass + a / n_water (paraxial Snell's law); the tests hold the rows below against
the closed forms that follow from it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform
from shapely import Polygon

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.fov.focus import FocusedLens, apparent_depths
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig, design_rig

MATCH_SIGMA_PX = 0.3
"""Disparity noise for which the depth precision is stated."""

FISHEYE_FOV_DEG = 100.0
"""Full angle in air beyond which lenses are made as fisheyes: a straight picture of it is drawn
out at its edges, 1 / cos^2 of the half angle in the corner's radius, 2.4 times at 100 degrees."""

_POINTS_PER_SIDE = 16
"""Points of a frame's border on each side."""

TRUSTED_FOV_DEG = FlatPort.trusted_deg
"""Full angle in air up to which the paper trusts a flat port (its section III.B)."""


@dataclass(frozen=True, kw_only=True)
class FovRow:
    """View of one lens from one altitude. Altitude is that of the port's outer glass.

    The sea floor is level and square to the axis of the left (or only, or reference) camera. What
    does not exist (the stereo of one camera, a frame that is nowhere sharp) is NaN.
    """

    lens_mm: float
    altitude_m: float
    n_water: float
    port: str
    """What it is, in words."""
    horizontal_m: float
    """Width of the footprint along the middle row."""
    vertical_m: float
    """Height of the footprint along the middle column."""
    sure_horizontal_m: float
    """Width of the upright rectangle that is surely seen: between the footprint's corners, where
    its sides bulge, as they do through a flat port."""
    sure_vertical_m: float
    """Its height."""
    pixel_centre_mm: float
    """Root of the area on the sea floor of the central pixel."""
    pixel_mean_mm: float
    """Width of the footprint over the number of columns."""
    pixel_corner_mm: float
    """Root of the area on the sea floor of a corner pixel, the largest of the four."""
    diagonal_air_deg: float
    """Full angle of the frame's diagonal in air."""
    diagonal_water_deg: float
    """The same beam after the port."""
    baseline_m: float
    """Distance between the two pupils."""
    stereo_overlap: float
    """Share of the area of the left camera's footprint that the right one sees too."""
    depth_sigma_mm: float
    """Depth precision of the pair below its middle, for `match_sigma_px` of disparity noise."""
    match_sigma_px: float
    focus_air_m: float
    """Distance from the entrance pupil to set in air for a sharp sea floor at the centre."""
    f_number: float
    coc_px: float
    """Largest blur circle that counts as sharp."""
    hyperfocal_air_m: float
    """Least focus distance in air for which everything beyond is sharp."""
    hyperfocal_altitude_m: float
    """Altitude of the sea floor that this distance focuses on."""
    near_altitude_m: float
    """Nearest sharp altitude at the centre of the frame; 0 when all from the glass on is sharp."""
    far_altitude_m: float
    """Farthest sharp altitude at the centre; may be inf."""
    depth_of_field_m: float
    """Far minus near, in water."""
    frame_near_altitude_m: float
    """As near, but sharp in the whole frame (the port bends the field); NaN when none is."""
    frame_far_altitude_m: float
    floor_blur_px: float
    """Blur circle of the sea floor at the centre, from defocus."""
    corner_blur_px: float
    """Longer axis of its blur in the worst corner: the port's field curvature and astigmatism."""
    within_trusted_fov: bool
    """The diagonal is within what the port is trusted for: 70 degrees for a flat one."""


@dataclass(frozen=True)
class BlurRow:
    """Motion blur of the central pixel. Exposure is the shorter of shutter and strobe."""

    lens_mm: float
    altitude_m: float
    speed_mps: float
    exposure_s: float
    blur_px: float
    allowed_px: float
    longest_exposure_s: float
    """Longest exposure for which the blur is `allowed_px`."""


def fov_table(
    lenses_mm: Sequence[float],
    altitudes_m: Sequence[float],
    n_water: float,
    camera_config: CameraConfig,
    coc_px: float = 1.0,
) -> list[FovRow]:
    """Footprint, resolution, focus and stereo of lenses at altitudes, through the port as designed.

    Args:
        lenses_mm: focal lengths in air.
        altitudes_m: altitudes of the left port's outer glass above a level sea floor.
        n_water: index of refraction of the water; 1 is air.
        camera_config: sensor, port, baseline and f-number.
        coc_px: largest blur circle that counts as sharp.

    Returns:
        One row per lens and altitude, lenses outside.

    Raises:
        ConfigError: a lens, an altitude or the index is out of range, a lens cannot be focused, or
            a lens is so short that light of the frame's edge is totally reflected or never reaches
            the sea floor.
    """
    check_range("lens", lenses_mm, 0.5, 500.0, "mm")
    check_range("altitude", altitudes_m, 0.01, 1000.0, "m")
    check_range("n_water", [n_water], 1.0, 1.4, "")
    rows = []
    for lens_mm in map(float, lenses_mm):
        config = camera_config.model_copy(update={"focal_mm": lens_mm})
        rig = design_rig(config, WaterConfig(n_water=n_water))
        rows += rig_fov_table(rig, altitudes_m, config, coc_px, lens_mm * 1e-3)
    return rows


def rig_fov_table(
    rig: Rig,
    altitudes_m: Sequence[float],
    camera_config: CameraConfig,
    coc_px: float = 1.0,
    focal_m: float | None = None,
) -> list[FovRow]:
    """The same of a calibrated rig, with its lens distortion, port tilt and relative pose.

    Args:
        rig: the first camera is the left one, the second its partner.
        altitudes_m: of the first camera's outer glass, where the normal of its pupil meets it.
        camera_config: `pixel_um` and `f_number`, which a rig does not have; the rest is not used.
        coc_px: largest blur circle that counts as sharp.
        focal_m: focal length of the lens; from its image distance when not given.

    Returns:
        One row per altitude.

    Raises:
        ConfigError: as `fov_table`.
    """
    check_range("altitude", altitudes_m, 0.01, 1000.0, "m")
    return [_row(rig, camera_config, float(one), coc_px, focal_m) for one in altitudes_m]


def blur_table(
    rows: Sequence[FovRow],
    speeds_mps: Sequence[float],
    exposures_s: Sequence[float],
    allowed_px: float,
) -> list[BlurRow]:
    """Motion of the central pixel over the sea floor during the exposure.

    Args:
        rows: lenses and altitudes.
        speeds_mps: over ground.
        exposures_s: exposures of the shutter, or of the strobe where that alone lights the scene.
        allowed_px: blur for which the longest exposure is given.

    Raises:
        ConfigError: a value is out of range.
    """
    check_range("speed", speeds_mps, 1e-6, 1e3, "m/s")
    check_range("exposure", exposures_s, 1e-9, 1e3, "s")
    check_range("blur", [allowed_px], 1e-6, 1e6, "px")
    return [
        BlurRow(
            row.lens_mm, row.altitude_m, speed, exposure,
            speed * exposure / (row.pixel_centre_mm * 1e-3), allowed_px,
            allowed_px * row.pixel_centre_mm * 1e-3 / speed,
        )
        for row, speed, exposure in product(rows, speeds_mps, exposures_s)
    ]  # fmt: skip


def check_range(
    what: str, values: Sequence[float], minimum: float, maximum: float, unit: str
) -> None:
    """Reject numbers that are out of range or not finite.

    Raises:
        ConfigError: names the first of them and what is allowed.
    """
    for value in values:
        if not minimum <= value <= maximum:
            given = f"{what} {value} {unit}".rstrip()
            raise ConfigError(f"{given}: allowed {minimum:g} to {maximum:g}")


def _row(
    rig: Rig, config: CameraConfig, altitude_m: float, coc_px: float, focal_m: float | None
) -> FovRow:
    camera = rig.cameras[rig.reference]
    pixel_m = config.pixel_um * 1e-6
    image_m = math.sqrt(camera.fx_px * camera.fy_px) * pixel_m
    lens_mm = (focal_m or image_m) * 1e3
    w, h = float(camera.width_px), float(camera.height_px)
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    floor_z = float(camera.front_cam[2]) + altitude_m
    edges = camera.at_depth(np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]]), floor_z)
    horizontal = float(np.linalg.norm(edges[1] - edges[0]))
    corner_pixels = np.clip(corners, 0.5, [w - 0.5, h - 0.5])
    centre = np.array([w / 2, h / 2])
    pixel_mm = _pixel_sizes_mm(camera, np.vstack([centre, corner_pixels]), floor_z)
    if not (np.all(np.isfinite(edges)) and np.all(np.isfinite(pixel_mm))):
        raise ConfigError(f"lens {lens_mm:g} mm: no light reaches the edge of the frame")

    seen = apparent_depths(camera, np.vstack([centre, corners]))
    depths = seen.at(altitude_m)
    focus_air_m = float(2.0 / np.sum(1.0 / depths[0]))
    # A calibrated focal length is the image distance, at the focus it was calibrated at.
    lens = FocusedLens(
        focal_m=focal_m or 1.0 / (1.0 / image_m + 1.0 / focus_air_m),
        f_number=config.f_number,
        pixel_m=pixel_m,
        focus_m=focus_air_m,
    )
    at_centre = apparent_depths(camera, centre[None])
    near, far = at_centre.sharp_altitudes_m(lens, coc_px)
    frame_near, frame_far = seen.sharp_altitudes_m(lens, coc_px)
    hyperfocal = lens.hyperfocal_m(coc_px)
    blur = lens.blur_px(depths)
    air_deg = _widest_deg(camera.in_air().unproject(corners)[1])
    sure_m = sure_size_m(camera, floor_z)
    return FovRow(
        lens_mm=lens_mm,
        altitude_m=altitude_m,
        n_water=camera.n_water,
        port=camera.port.words,
        horizontal_m=horizontal,
        vertical_m=float(np.linalg.norm(edges[3] - edges[2])),
        sure_horizontal_m=sure_m[0],
        sure_vertical_m=sure_m[1],
        pixel_centre_mm=float(pixel_mm[0]),
        pixel_mean_mm=horizontal / w * 1e3,
        pixel_corner_mm=float(pixel_mm[1:].max()),
        diagonal_air_deg=air_deg,
        diagonal_water_deg=_widest_deg(camera.unproject(corners)[1]),
        baseline_m=rig.baseline_m,
        stereo_overlap=stereo_overlap(rig, floor_z),
        depth_sigma_mm=MATCH_SIGMA_PX / disparity_per_m(rig, floor_z) * 1e3,
        match_sigma_px=MATCH_SIGMA_PX,
        focus_air_m=focus_air_m,
        f_number=config.f_number,
        coc_px=coc_px,
        hyperfocal_air_m=hyperfocal,
        hyperfocal_altitude_m=float(np.mean(at_centre.altitudes_m(hyperfocal))),
        near_altitude_m=near,
        far_altitude_m=far,
        depth_of_field_m=far - near,
        frame_near_altitude_m=frame_near,
        frame_far_altitude_m=frame_far,
        floor_blur_px=float(blur[0].max()),
        corner_blur_px=float(blur[1:].max()),
        within_trusted_fov=air_deg <= camera.port.trusted_deg,
    )


def sure_size_m(camera: Camera, floor_z_m: float) -> tuple[float, float]:
    """Width and height of the largest upright rectangle about the axis that is seen.

    It lies between the footprint's corners where the sides bulge, as they do through a flat port,
    and between the middles of the sides where a lens makes them hollow.

    Args:
        camera: the camera.
        floor_z_m: where a sea floor square to its axis is, in its frame.

    Returns:
        NaN where rays of the border never reach the sea floor.
    """
    border = camera.at_depth(camera.border(_POINTS_PER_SIDE), floor_z_m)
    top, right, bottom, left = sides_of(border)
    across_m, along_m = right[:, 0].min() - left[:, 0].max(), bottom[:, 1].min() - top[:, 1].max()
    return float(across_m), float(along_m)


def sides_of(border: Array) -> list[Array]:
    """The four sides of a frame's border, each with both its corners: top, right, bottom, left."""
    closed, n = np.vstack([border, border[:1]]), len(border) // 4
    return [closed[k * n : (k + 1) * n + 1] for k in range(4)]


def _pixel_sizes_mm(camera: Camera, pixels: Array, floor_z: float) -> Array:
    """Root of the area of unit squares around pixels (N, 2), on the sea floor."""
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    x, y = np.moveaxis(camera.at_depth(pixels[:, None] + square, floor_z)[..., :2], -1, 0)
    doubled = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    return np.asarray(np.sqrt(np.abs(doubled) / 2) * 1e3)


def _widest_deg(corner_rays: Array) -> float:
    """The larger angle between opposite corners; directions (4, 3) in order around the frame."""
    a, b = corner_rays[:2], corner_rays[2:]
    sines = np.linalg.norm(np.cross(a, b), axis=1)
    return float(np.degrees(np.arctan2(sines, (a * b).sum(axis=1))).max())


def _pair(rig: Rig) -> tuple[Camera, Camera, RigidTransform]:
    """Left, right and `right_from_left`."""
    left, right = list(rig.cameras)[:2]
    right_from_left = rig.cam_from_rig[right] * rig.cam_from_rig[left].inv()
    return rig.cameras[left], rig.cameras[right], right_from_left


def stereo_overlap(rig: Rig, floor_z_m: float) -> float:
    """Share of the area of the left footprint that the right camera sees too.

    Args:
        rig: its first two cameras are the pair.
        floor_z_m: where a sea floor square to the left axis is, in the left camera's frame.

    Returns:
        NaN for a single camera, or where rays of a border never reach the sea floor.
    """
    if len(rig.cameras) < 2:
        return math.nan
    left, right, right_from_left = _pair(rig)
    footprint = left.at_depth(left.border(64), floor_z_m)
    # The sea floor in the right camera's frame: its ray's fall along the left camera's axis.
    outer, directions = right.unproject(right.border(64))
    left_from_right = right_from_left.inv()
    starts = left_from_right.apply(outer)
    falls = left_from_right.rotation.apply(directions)
    partner = starts + ((floor_z_m - starts[:, 2]) / falls[:, 2])[:, None] * falls
    if not (np.all(np.isfinite(partner)) and np.all(falls[:, 2] > 0)):
        return math.nan
    ours = Polygon(footprint[:, :2])
    return float(ours.intersection(Polygon(partner[:, :2])).area / ours.area)


def disparity_per_m(rig: Rig, floor_z_m: float) -> float:
    """Shift in the right picture per distance moved along the left ray, px/m.

    The point lies on the sea floor below the middle of the pair; NaN where one camera misses it,
    and for a single camera. The noise of a disparity over this is the depth precision.
    """
    if len(rig.cameras) < 2:
        return math.nan
    left, right, right_from_left = _pair(rig)
    middle = right_from_left.inv().translation / 2
    pixel = left.project(np.array([middle[0], middle[1], floor_z_m]))
    step = 1e-4 * (floor_z_m - float(left.front_cam[2]))
    along_ray = left.at_depth(
        np.stack([pixel, pixel]), np.array([floor_z_m - step, floor_z_m + step])
    )
    pixels = right.project(right_from_left.apply(along_ray))
    for camera, pixel_xy in ((left, pixel), (right, pixels[0])):
        if not np.all((pixel_xy >= 0) & (pixel_xy <= [camera.width_px, camera.height_px])):
            return math.nan
    return float(np.linalg.norm(pixels[1] - pixels[0]) / (2 * step))
