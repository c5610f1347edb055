"""An adjustment that leaves out gross outliers, and reports them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib.calibrate.adjust import Adjustment, adjust
from camera_calib.calibrate.normal_equations import Flags
from camera_calib.calibration import Rejection, TargetView
from camera_calib.freedom import Freedom
from camera_calib.rig import Rig

FEWEST_VIEWS = 4
OUTLIER = 6.0
"""Length of a residual, in sigmas of a coordinate, beyond which a point takes no part: of normal
noise one in 65 million is longer."""
_DULLEST = 3.0
"""Largest noise of one picture, over that of all, that is still noise."""
_BY_CHANCE = 2.0
"""Mean square difference of the pictures' noise, relative to chance for equal noise."""
_DRAWN = 16.0
"""Coordinates by which a picture's noise is drawn towards that of all."""
_SAME_BLUR = 0.1
_LEAST_LIMIT_PX = 1e-4
_ROUNDS = 6
STEPS = 40
"""Step limit of an adjustment that may still include views which do not fit at all."""
_FEWEST_FITTING = 0.5
"""Share of a picture's points; with fewer the whole picture is left out."""


def adjust_without_outliers(
    views: Sequence[TargetView],
    pixels: Array,
    points: Array,
    rig: Rig,
    poses: RigidTransform,
    freedom: Freedom,
) -> tuple[Adjustment, Flags, Flags]:
    """Adjust and leave out gross outliers, until that set stays the same.

    Returns:
        The adjustment; which points (V, cameras, N) took part; which views (V,) did.
    """
    measured = np.asarray(np.isfinite(pixels).all(axis=-1))
    kept, alive = measured, np.ones(len(views), dtype=bool)
    blur = np.ones(measured.shape[:2])
    for _ in range(_ROUNDS):
        trimmed = [_trimmed(view, kept[v], rig) for v, view in enumerate(views) if alive[v]]
        adjusted = adjust(trimmed, points, rig, poses, freedom, at_most=STEPS, blur=blur[alive])
        lengths = np.full(measured.shape, np.inf)
        lengths[alive] = _lengths(adjusted, pixels[alive], points)
        found = np.ones_like(blur)
        found[alive] = _blur(adjusted)
        limits = np.maximum(OUTLIER * adjusted.noise_px * found, _LEAST_LIMIT_PX)
        fitting = _fitting(measured, kept, measured & (lengths <= limits[..., None]))
        same = np.array_equal(fitting, kept) and np.allclose(found, blur, rtol=_SAME_BLUR)
        if same and adjusted.is_settled:
            return adjusted, kept, alive
        still = alive & fitting.any(axis=(1, 2))
        check_enough(int(still.sum()), len(views))
        poses = adjusted.rig_from_target[np.flatnonzero(still[alive])]
        rig, kept, alive, blur = adjusted.rig, fitting, still, found
    trimmed = [_trimmed(view, kept[v], rig) for v, view in enumerate(views) if alive[v]]
    return adjust(trimmed, points, rig, poses, freedom, blur=blur[alive]), kept, alive


def _fitting(measured: Flags, kept: Flags, fits: Flags) -> Flags:
    """Which points take part next, (V, cameras, N).

    Where a picture does not fit, the pose of its view is not a measure for the others yet: of the
    pictures of one view only the worst is left out at a time.
    """
    share = fits.sum(axis=2) / np.maximum(measured.sum(axis=2), 1)
    fitting = np.asarray(fits & (share >= _FEWEST_FITTING)[..., None])
    served = np.asarray(kept.any(axis=2))
    for v in np.flatnonzero((served & (share < _FEWEST_FITTING)).any(axis=1)):
        worst = int(np.argmin(np.where(served[v], share[v], np.inf)))
        others = served[v] & (np.arange(len(share[v])) != worst)
        fitting[v] = kept[v] & others[:, None]
    return fitting


def _blur(adjusted: Adjustment) -> Array:
    """Noise of each picture over that of all, (V, cameras); 1 where all are alike by chance.

    Distant targets and moving water blur some pictures more than others; weighted by their noise
    they count more. Noise is the mean square of residuals after Huber's weights, drawn a little
    towards that of all, so that a picture of few points gets no weight by luck.
    """
    pull = (adjusted.weights[..., None] * adjusted.residuals_px) ** 2
    count = 2.0 * np.isfinite(adjusted.weights).sum(axis=2)
    square = np.nansum(pull, axis=(2, 3))
    # Each view's pose takes up six of its coordinates.
    free = count * (1.0 - np.minimum(6.0 / count.sum(axis=1, keepdims=True), 0.9))
    share = np.divide(square, free, out=np.ones_like(square), where=count > 0)
    share[count > 0] /= square.sum() / free.sum()
    seen = count > 0
    chance = np.mean((share[seen] - 1.0) ** 2 * count[seen] / 2.0)
    if chance < _BY_CHANCE:
        return np.ones_like(share)
    drawn = (count * share + _DRAWN) / (count + _DRAWN)
    blur: Array = np.clip(np.sqrt(drawn), 1.0 / _DULLEST, _DULLEST)
    return blur


def _trimmed(view: TargetView, kept: Flags, rig: Rig) -> TargetView:
    pixels = {
        name: np.where(kept[c, :, None], view.pixels[name], np.nan)
        for c, name in enumerate(rig.cameras)
        if name in view.pixels and kept[c].any()
    }
    return replace(view, pixels=pixels)


def _lengths(adjusted: Adjustment, pixels: Array, points: Array) -> Array:
    """(V, cameras, N) residual lengths of all measured points, also of those left out; px."""
    misses = np.full(pixels.shape[:-1], np.inf)
    for c, (name, camera) in enumerate(adjusted.rig.cameras.items()):
        for v in range(len(pixels)):
            pose = adjusted.rig.cam_from_rig[name] * adjusted.rig_from_target[v]
            misses[v, c] = np.linalg.norm(camera.project(pose.apply(points)) - pixels[v, c], axis=1)
    return np.where(np.isfinite(misses), misses, np.inf)


def rejected(
    views: Sequence[TargetView], pixels: Array, kept: Flags, rig: Rig, adjusted: Adjustment
) -> list[Rejection]:
    """Pictures and points that the adjustment left out."""
    limit = f"{OUTLIER:.0f} sigmas (of {adjusted.noise_px:.2g} px, or of the picture's own noise)"
    rejections = []
    for v, view in enumerate(views):
        for c, name in enumerate(rig.cameras):
            measured = int(np.isfinite(pixels[v, c, :, 0]).sum())
            lost = measured - int(kept[v, c].sum())
            if lost and lost == measured:
                reason = f"fits badly: most of its points miss by more than {limit}"
                rejections.append(whole_picture(view.name, name, reason))
            elif lost:
                reason = f"missed by more than {limit}"
                rejections.append(
                    Rejection(view=view.name, camera=name, points=lost, reason=reason)
                )
    return rejections


def whole_picture(view: str, camera: str, reason: str) -> Rejection:
    """A picture that takes no part."""
    return Rejection(view=view, camera=camera, points=0, reason=reason)


def check_enough(usable: int, given: int) -> None:
    """Refuse too few views.

    Raises:
        CalibrationError: they are fewer than `FEWEST_VIEWS`.
    """
    if usable < FEWEST_VIEWS:
        of = f" of {given}" if given > usable else ""
        raise CalibrationError(
            f"{usable}{of} views of the target can be used; at least {FEWEST_VIEWS} are needed: "
            "take more, nearer and at more angles"
        )
