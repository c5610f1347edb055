"""What the residuals of a calibration show: pictures, trends, coverage, homographies.

- By picture, over the frame and against the angle at the port.
- Homographies: through a perfect model a flat target is seen as a plane by a pinhole, so its
  points map to the pinhole's pixels by a homography, whatever its pose. The flat port has no single
  centre: a pixel's ray is followed exactly to the target's own distance there, and a virtual
  pinhole looks at that point. Of the pose only these distances are used, and they hardly matter: an
  error of 1 cm moves such a pixel by about 0.001 px (20 mm port, 12.5 mm lens). No truth is needed;
  residuals that grow outwards are an error of the model. What the found shape of a bent target
  moves is taken off first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform
from scipy.special import stdtr

from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.calibration import Calibration, stack_views
from camera_calib.camera import Camera

GATE_SIGMAS = 5.0
"""Residuals longer than this many times the noise are outliers: counted, and kept out of the
statistics. Of 2D normal errors, 4 in a million are longer."""
PROFILE_BINS = 12
_MIN_IN_BIN = 8
_CELLS = (10, 8)
"""Columns and rows of a frame in which points are counted."""
_MIN_POINTS = 12
"""Fewest points of a view: 8 unknowns of a homography against 24 coordinates."""
_FLAT_SHARE = 1e-6
"""A target is flat if its points leave a plane by less than this share of its size."""
_OUTLYING = 6.0
"""Outlier limit of length over median length: 7 sigmas of normal noise."""
_HALF_STEP_PX = 0.5
_RINGS = 6
"""Radial fields that differ from the four terms of the usual lenses, and from one another."""


def within_gate(residuals_px: Array, noise_px: Array | float) -> NDArray[np.bool_]:
    """Which residuals (..., 2) are known and not outliers, by the noise (...) of a coordinate."""
    squared = (residuals_px**2).sum(axis=-1)
    return np.asarray(squared <= (GATE_SIGMAS * noise_px) ** 2)


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


def picture_fits(calibration: Calibration) -> list[PictureFit]:
    """All pictures, view by view, cameras in the rig's order."""
    rows, noise_px = [], calibration.sigma_px
    for v, view in enumerate(calibration.views):
        for c, camera in enumerate(calibration.rig.cameras):
            lengths = np.linalg.norm(calibration.residuals_px[v, c], axis=-1)
            seen = np.isfinite(lengths)
            if not seen.any():
                continue
            pose = calibration.rig.cam_from_rig[camera] * calibration.rig_from_target[v]
            rows.append(
                PictureFit(
                    view=view.name,
                    camera=camera,
                    points=int(seen.sum()),
                    rms_px=float(np.sqrt((lengths[seen] ** 2).mean())),
                    worst_px=float(lengths[seen].max()),
                    outliers=int((lengths[seen] > GATE_SIGMAS * noise_px[v, c]).sum()),
                    range_m=float(pose.apply(calibration.target_points[seen])[:, 2].mean()),
                )
            )
    return rows


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraResiduals:
    """All points that one camera saw, in one list, without outliers."""

    pixels: Array
    """(N, 2) as measured."""
    residuals_px: Array
    """(N, 2) projected minus measured."""
    sigma_px: Array
    """(N,) expected standard deviation of a coordinate: the noise of the point's picture."""


def camera_residuals(calibration: Calibration, camera: str) -> CameraResiduals:
    """The points of one camera, without outliers."""
    index = list(calibration.rig.cameras).index(camera)
    residuals = calibration.residuals_px[:, index]
    sigma_px = np.repeat(calibration.sigma_px[:, index, None], residuals.shape[1], axis=1)
    kept = within_gate(residuals, sigma_px)
    pixels = stack_views(calibration.views, calibration.rig, residuals.shape[1])[:, index]
    return CameraResiduals(
        pixels=pixels[kept], residuals_px=residuals[kept], sigma_px=sigma_px[kept]
    )


def outward(camera: Camera, pixels: Array) -> Array:
    """Unit vectors (..., 2) from the principal point to pixels (..., 2); 0 at that point."""
    away = pixels - np.array([camera.cx_px, camera.cy_px])
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    return np.asarray(np.divide(away, length, out=np.zeros_like(away), where=length > 0))


def incidence_deg(camera: Camera, pixels: Array) -> Array:
    """(...,) angles between the rays in water and the port's normal, degrees."""
    points, directions = camera.unproject(pixels)
    normals = camera.port.clearance(points.reshape(-1, 3))[1].reshape(points.shape)
    return np.asarray(np.degrees(np.arccos(np.clip((directions * normals).sum(axis=-1), -1, 1))))


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
        """(B,) centres of the bins."""
        return (self.edges[1:] + self.edges[:-1]) / 2


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
    count, edges = np.histogram(position, PROFILE_BINS, (0.0, largest))

    def mean(values: Array) -> Array:
        total = np.histogram(position, edges, weights=values)[0]
        return np.where(count >= _MIN_IN_BIN, total / np.maximum(count, 1), np.nan)

    return Profile(
        edges=edges,
        count=count,
        rms_px=np.sqrt(mean((residuals_px**2).mean(axis=1))),
        expected_px=np.sqrt(mean(sigma_px**2)),
        outward_px=mean(outward_px),
    )


def incidence_profile(camera: Camera, seen: CameraResiduals) -> Profile:
    """Residuals against the angle at the port, up to the steepest corner of the frame."""
    angles = incidence_deg(camera, seen.pixels)
    steepest = float(np.nanmax(np.append(incidence_deg(camera, camera.border(1)), angles)))
    away = (seen.residuals_px * outward(camera, seen.pixels)).sum(axis=1)
    return profile(angles, seen.residuals_px, away, seen.sigma_px, steepest)


def points_by_cell(camera: Camera, pixels: Array) -> NDArray[np.intp]:
    """Counts of pixels (N, 2) by cell of the frame, (rows, columns)."""
    size = [(0.0, float(camera.width_px)), (0.0, float(camera.height_px))]
    return np.histogramdd(pixels, _CELLS, size)[0].T.astype(np.intp)


@dataclass(frozen=True, kw_only=True, eq=False)
class HomographyTest:
    """Homography residuals of one camera, over all views."""

    points: int
    noise_px: float
    """Standard deviation of one coordinate, by the degrees of freedom, median of the views."""
    p_value: float
    """Probability that noise alone leaves as much at the same places of the frame."""
    share: float
    """Rms of that over the noise."""


def homography_test(calibration: Calibration, camera: str) -> HomographyTest | None:
    """Fit a homography to every view of one camera.

    Returns:
        None where the target is not flat, or fewer than two views have enough points.
    """
    points = calibration.drawn_points
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    index = list(calibration.rig.cameras).index(camera)
    model = calibration.rig.cameras[camera]
    known = np.isfinite(calibration.residuals_px[:, index, :, 0])
    usable = np.nonzero(known.sum(axis=1) >= _MIN_POINTS)[0]
    if spread[2] >= _FLAT_SHARE * spread[0] or len(usable) < 2:
        return None
    measured = stack_views(calibration.views, calibration.rig, len(points))[:, index]
    poses = [calibration.rig.cam_from_rig[camera] * pose for pose in calibration.rig_from_target]
    if calibration.shape.parameters:
        for v in usable:
            bent = model.project(poses[v].apply(calibration.target_points))
            measured[v] -= bent - model.project(poses[v].apply(points))
    depths = np.concatenate([poses[v].apply(points[known[v]])[:, 2] for v in usable])
    warp = best_warp(model, float(depths.min()), float(depths.max()))
    fits = [_fit_view(warp, points[known[v]], measured[v, known[v]], poses[v]) for v in usable]
    return _field_test(np.array([model.cx_px, model.cy_px]), fits)


def _field_test(centre: Array, views: Sequence[tuple[Array, ...]]) -> HomographyTest:
    """How likely noise leaves as much along one of some fields in view after view, and its share.

    A wrong model pushes points of one place in the frame, and of one distance there, the same way
    in all views; noise does not, however it goes together within a picture or grows outwards.
    Student's test of each field's part in the views' residuals, at a level shared by the fields.

    Args:
        centre: principal point.
        views: as `_fit_view` returns them.
    """
    away = [pixels - centre for pixels, *_ in views]
    largest = max(float(np.linalg.norm(one, axis=1).max()) for one in away)
    nearness = [1.0 / depth for *_, depth in views]
    middle, spread = np.mean(np.concatenate(nearness)), np.std(np.concatenate(nearness))
    parts, squares = np.zeros((2, len(views), _RINGS + 3))
    squares_px = [(one**2).sum() / (one.size - len(taken.T)) for _, one, taken, _ in views]
    noise_px = float(np.sqrt(np.median(squares_px))) + 1e-300
    for v, (_, residuals, taken, _) in enumerate(views):
        place = away[v] / largest
        rings = legendre.legvander(2.0 * (place**2).sum(axis=1) - 1.0, _RINGS - 1)[:, 1:]
        near = (nearness[v] - middle)[:, None] / max(spread, 1e-12)
        sizes = np.concatenate([rings, place * rings[:, :1], near * rings[:, :2]], axis=1)
        fields = (place[:, :, None] * sizes[:, None]).reshape(taken.shape[0], -1)
        fields -= taken @ (taken.T @ fields)
        parts[v] = residuals.ravel() @ fields / noise_px
        squares[v] = (fields**2).sum(axis=0)
    total, points = squares.sum(axis=0), sum(len(one) for one in away)
    size = parts.sum(axis=0) / total  # of each field, over the noise
    off = (parts - size * squares) / np.sqrt(squares)
    students = size * np.sqrt(total * (len(views) - 1) / (off**2).sum(axis=0))
    tails = 2.0 * stdtr(len(views) - 1, -np.abs(students))
    worst = int(np.argmin(tails))
    return HomographyTest(
        points=points,
        noise_px=noise_px,
        p_value=min(float(tails[worst]) * len(tails), 1.0),
        share=float(abs(size[worst]) * np.sqrt(total[worst] / points)),
    )


def _fit_view(
    warp: PinholeWarp, target_points: Array, pixels: Array, cam_from_target: RigidTransform
) -> tuple[Array, Array, Array, Array]:
    """Pixels, their `homography_residuals` and depths, once outliers are set aside.

    Outliers are found by the homography, not by the calibration's residuals: what its model cannot
    fit must not hide here.
    """
    while True:
        residuals, taken = homography_residuals(warp, target_points, pixels, cam_from_target)
        length = np.linalg.norm(residuals, axis=1)
        stay = length <= _OUTLYING * float(np.median(length))
        if stay.all() or stay.sum() < _MIN_POINTS:
            return pixels, residuals, taken, cam_from_target.apply(target_points)[:, 2]
        target_points, pixels = target_points[stay], pixels[stay]


def homography_residuals(
    warp: PinholeWarp, target_points: Array, pixels: Array, cam_from_target: RigidTransform
) -> tuple[Array, Array]:
    """Fit one view's homography, least squares in the camera's own pixels.

    Args:
        warp: the camera, whose lens and port are undone, and the pinhole that looks instead.
        target_points: (N, 3) on one plane, N > 4.
        pixels: (N, 2) as measured.
        cam_from_target: gives the distances of the points.

    Returns:
        Residuals (N, 2), fitted minus measured, in the camera's pixels; and (2 N, 8) orthonormal
        directions of these that the fit takes up.
    """
    depth = cam_from_target.apply(target_points)[:, 2]
    seen = warp.to_pinhole(pixels, depth)
    # How ideal pixels move with measured ones, whose noise is the same everywhere.
    columns = [
        (warp.to_pinhole(pixels + s, depth) - warp.to_pinhole(pixels - s, depth))
        / (2 * _HALF_STEP_PX)
        for s in _HALF_STEP_PX * np.eye(2)
    ]
    back = np.linalg.inv(np.stack(columns, axis=-1))
    plane = _plane_coordinates(target_points)
    centre, size = seen.mean(axis=0), np.abs(seen - seen.mean(axis=0)).max()

    def misfit(h: Array) -> Array:
        """(2 N,) residuals."""
        off: Array = np.einsum("nab,nb->na", back, size * _map(h, plane)[0] + centre - seen)
        return off.ravel()

    def slopes(h: Array) -> Array:
        """(2 N, 8) of the residuals by h."""
        by_h: Array = back @ (size * _map(h, plane)[1])
        return by_h.reshape(-1, 8)

    start = np.ravel(cv2.findHomography(plane, (seen - centre) / size)[0])[:8]
    found = least_squares(misfit, start, slopes, method="lm", xtol=1e-14, ftol=1e-15, gtol=1e-15)
    return found.fun.reshape(-1, 2), np.linalg.qr(slopes(found.x))[0]


def _plane_coordinates(points: Array) -> Array:
    """(N, 2) in the points' own plane, about their centre, at most about 1 in size."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    return np.asarray(centred @ axes.T / np.abs(centred @ axes.T).max())


def _map(h: Array, plane: Array) -> tuple[Array, Array]:
    """Where a homography takes the plane's points, (N, 2), and its slopes by h, (N, 2, 8)."""
    x, y = plane.T
    bottom = h[6] * x + h[7] * y + 1.0
    row = np.stack([x, y, np.ones_like(x)], axis=1) / bottom[:, None]
    image = row @ np.stack([h[:3], h[3:6]], axis=1)
    slopes = np.zeros((len(plane), 2, 8))
    slopes[:, 0, :3] = slopes[:, 1, 3:6] = row
    slopes[:, :, 6:] = -image[:, :, None] * row[:, None, :2]
    return image, slopes
