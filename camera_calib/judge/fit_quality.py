"""Fit of a calibration to its pictures, and coverage of the frames by points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from camera_calib.calibration import Calibration, stack_views
from camera_calib.camera import Camera

GATE_SIGMAS = 5.0
"""Residuals longer than this many times the noise are outliers: counted, and kept out of the
statistics. Of 2D normal errors, 4 in a million are longer."""
PROFILE_BINS = 12
_MIN_IN_BIN = 8
COVERED_REACH = 0.75
"""A corner of the frame is covered when a point lies beyond this share of both half sides."""
CORNERS = ("top left", "top right", "bottom left", "bottom right")


def within_gate(residuals_px: Array, noise_px: Array | float) -> NDArray[np.bool_]:
    """Which residuals (..., 2) are known and not outliers, by the noise (...) of a coordinate."""
    squared = (residuals_px**2).sum(axis=-1)
    known: NDArray[np.bool_] = squared <= (GATE_SIGMAS * noise_px) ** 2
    return known


def rms_length_px(residuals_px: Array, noise_px: Array | float) -> float:
    """Root mean square length of the residuals (..., 2) that are not outliers; NaN for none."""
    kept = residuals_px[within_gate(residuals_px, noise_px)]
    return float(np.sqrt((kept**2).sum(axis=-1).mean())) if len(kept) else float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureFit:
    """One picture of the target."""

    view: str
    camera: str
    points: int
    rms_px: float
    """Length of the residuals, outliers included."""
    worst_px: float
    outliers: int
    range_m: float
    """Mean distance of its points from the entrance pupil along the axis."""
    tilt_deg: float
    """Angle between the target's normal and the camera's axis."""


def picture_fits(calibration: Calibration) -> list[PictureFit]:
    """All pictures, view by view, cameras in the rig's order."""
    rows, noise_px = [], calibration.sigma_px
    for v, view in enumerate(calibration.views):
        for c, camera in enumerate(calibration.rig.cameras):
            residuals = calibration.residuals_px[v, c]
            lengths = np.linalg.norm(residuals, axis=-1)
            seen = np.isfinite(lengths)
            if not seen.any():
                continue
            pose = calibration.rig.cam_from_rig[camera] * calibration.rig_from_target[v]
            along_axis = abs(float(pose.rotation.as_matrix()[2, 2]))
            rows.append(
                PictureFit(
                    view=view.name,
                    camera=camera,
                    points=int(seen.sum()),
                    rms_px=float(np.sqrt((lengths[seen] ** 2).mean())),
                    worst_px=float(lengths[seen].max()),
                    outliers=int((lengths[seen] > GATE_SIGMAS * noise_px[v, c]).sum()),
                    range_m=float(pose.apply(calibration.target_points[seen])[:, 2].mean()),
                    tilt_deg=float(np.degrees(np.arccos(min(along_axis, 1.0)))),
                )
            )
    return rows


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraResiduals:
    """All points that one camera saw, in one list."""

    pixels: Array
    """(N, 2) as measured."""
    residuals_px: Array
    """(N, 2) projected minus measured."""
    sigma_px: Array
    """(N,) expected standard deviation of a coordinate: the noise of the point's picture."""
    view: NDArray[np.intp]
    """(N,) number of the view."""
    radius_px: Array
    """(N,) distance from the principal point."""
    incidence_deg: Array
    """(N,) angle between the ray in water and the port's normal."""
    outward: Array
    """(N, 2) unit vectors away from the principal point."""

    @property
    def outward_px(self) -> Array:
        """(N,) part of the residuals that points away from the principal point."""
        parts: Array = (self.residuals_px * self.outward).sum(axis=1)
        return parts


def camera_residuals(calibration: Calibration, camera: str) -> CameraResiduals:
    """The points of one camera, without outliers."""
    index = list(calibration.rig.cameras).index(camera)
    residuals = calibration.residuals_px[:, index]
    sigma_px = np.repeat(calibration.sigma_px[:, index, None], residuals.shape[1], axis=1)
    kept = within_gate(residuals, sigma_px)
    pixels = stack_views(calibration.views, calibration.rig, residuals.shape[1])
    measured = pixels[:, index][kept]
    model = calibration.rig.cameras[camera]
    return CameraResiduals(
        pixels=measured,
        residuals_px=residuals[kept],
        sigma_px=sigma_px[kept],
        view=np.nonzero(kept)[0],
        radius_px=radius_px(model, measured),
        incidence_deg=incidence_deg(model, measured),
        outward=outward(model, measured),
    )


def radius_px(camera: Camera, pixels: Array) -> Array:
    """(...,) distances of pixels (..., 2) from the principal point."""
    distances: Array = np.linalg.norm(pixels - [camera.cx_px, camera.cy_px], axis=-1)
    return distances


def outward(camera: Camera, pixels: Array) -> Array:
    """Unit vectors (..., 2) from the principal point to pixels (..., 2); 0 at that point."""
    away = pixels - np.array([camera.cx_px, camera.cy_px])
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    unit: Array = np.divide(away, length, out=np.zeros_like(away), where=length > 0)
    return unit


def incidence_deg(camera: Camera, pixels: Array) -> Array:
    """(...,) angles between the rays in water and the port's normal, degrees."""
    points, directions = camera.unproject(pixels)
    normals = camera.port.clearance(points.reshape(-1, 3))[1].reshape(points.shape)
    angles: Array = np.degrees(np.arccos(np.clip((directions * normals).sum(axis=-1), -1, 1)))
    return angles


@dataclass(frozen=True, kw_only=True, eq=False)
class Profile:
    """Residuals in bins of one quantity; NaN in bins with too few points."""

    edges: Array
    """(B + 1,) ends of the bins."""
    count: NDArray[np.intp]
    """(B,) number of points."""
    rms_px: Array
    """(B,) rms of one coordinate."""
    expected_px: Array
    """(B,) rms from noise alone; its sigma is expected / (2 sqrt(count))."""
    outward_px: Array
    """(B,) mean of the part away from the principal point: 0 but for noise if the model is right,
    with sigma expected / sqrt(count)."""

    @property
    def centres(self) -> Array:
        """(B,) middles of the bins."""
        middle: Array = (self.edges[1:] + self.edges[:-1]) / 2
        return middle


def profile(
    position: Array, residuals_px: Array, outward_px: Array, sigma_px: Array, largest: float
) -> Profile:
    """Bin residuals by a position between 0 and `largest`.

    Args:
        position: (N,).
        residuals_px: (N, 2).
        outward_px: (N,).
        sigma_px: (N,) expected standard deviation of one coordinate of each.
        largest: end of the last bin.
    """
    edges = np.linspace(0.0, largest, PROFILE_BINS + 1)
    bins = np.clip(np.searchsorted(edges, position, side="right") - 1, 0, PROFILE_BINS - 1)
    count: NDArray[np.intp] = np.bincount(bins, minlength=PROFILE_BINS)

    def mean(values: Array) -> Array:
        total = np.bincount(bins, weights=values, minlength=PROFILE_BINS)
        few = np.full(PROFILE_BINS, np.nan)
        means: Array = np.divide(total, count, out=few, where=count >= _MIN_IN_BIN)
        return means

    return Profile(
        edges=edges,
        count=count,
        rms_px=np.sqrt(mean((residuals_px**2).mean(axis=1))),
        expected_px=np.sqrt(mean(sigma_px**2)),
        outward_px=mean(outward_px),
    )


def largest_radius_px(camera: Camera) -> float:
    """Distance from the principal point to the farthest corner of the frame."""
    return float(radius_px(camera, camera.border(1)).max())


def residual_profiles(camera: Camera, seen: CameraResiduals) -> tuple[Profile, Profile]:
    """Residuals against the radius and against the angle at the port."""
    corner_deg = incidence_deg(camera, camera.border(1))
    steepest = float(np.nanmax(np.append(corner_deg, seen.incidence_deg)))
    by = (seen.residuals_px, seen.outward_px, seen.sigma_px)
    return (
        profile(seen.radius_px, *by, largest_radius_px(camera)),
        profile(seen.incidence_deg, *by, steepest),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Coverage:
    """Distribution of the points over one frame."""

    counts: NDArray[np.intp]
    """(rows, columns) points by cell of the frame."""
    corner_reach: dict[str, float]
    """By corner: how far out, as a share of both half sides, the outermost point lies."""

    @property
    def uncovered(self) -> tuple[str, ...]:
        """Corners that no point comes near."""
        return tuple(name for name, r in self.corner_reach.items() if r < COVERED_REACH)

    @property
    def empty_share(self) -> float:
        """Share of the cells without a point."""
        return float((self.counts == 0).mean())


def coverage(camera: Camera, pixels: Array) -> Coverage:
    """Count pixels (N, 2) by cell of the frame, and measure how near they come to its corners."""
    columns, rows = 10, 8
    size = np.array([camera.width_px, camera.height_px])
    cell = np.floor(pixels / size * [columns, rows]).astype(int)
    inside = ((cell >= 0) & (cell < [columns, rows])).all(axis=1)
    flat = np.bincount(cell[inside] @ [1, columns], minlength=rows * columns)
    off = pixels / (size / 2) - 1.0
    signs = ((-1, -1), (1, -1), (-1, 1), (1, 1))
    return Coverage(
        counts=flat.reshape(rows, columns),
        corner_reach={
            name: float(np.max((off * sign).min(axis=1), initial=0.0))
            for name, sign in zip(CORNERS, signs, strict=True)
        },
    )
