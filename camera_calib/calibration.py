"""Input and result of a calibration, as values and as arrays over all views."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.freedom import HELD, Freedom
from camera_calib.rig import Covariance, Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape
from camera_calib.targets.target import Rejection


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetView:
    """Where the cameras saw the points of a target at one moment."""

    name: str
    pixels: Mapping[str, Array]
    """By camera: (N, 2) pixels of the target's N points; NaN rows were not found. A camera that
    found nothing is absent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CornerNoise:
    """What the errors of corners are made of."""

    alone: float
    """Variance of independent errors, over that of all without correlation."""
    together: Array
    """(R,) variances of errors that go together in a picture, by their reach, then, for several
    cameras, in all pictures of a view; in the same unit."""
    place_sigmas_m: tuple[float, float]
    """Sigmas of the places of corners on the target, along each axis of its plane and across."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorBudget:
    """Covariance of a calibration under the noise that its residuals show."""

    noise: CornerNoise
    covariance: Covariance
    """Of rig and shape together."""
    shared: Array
    """(P, M) factor of the part of it that other views of the same target have in common: errors of
    the priors' means and of the places of corners. The product with its transpose is that part."""
    excess: float
    """Variance of what the views determine over that by independent errors, mean of all."""


@dataclass(frozen=True, kw_only=True)
class HousingTrial:
    """How well the views fit one kind of port and lens."""

    port: str
    lens: str
    noise_px: float = math.nan
    criterion: float = math.inf
    """Schwarz's: the lower, the likelier."""
    why: str = ""
    """Why it could not be calibrated; empty if it could."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A calibrated rig, with all that is needed to assess it."""

    rig: Rig
    """The rig with its covariance."""
    target_points: Array
    """(N, 3) in the target's frame, metres, in the shape that was found."""
    views: tuple[TargetView, ...]
    """(V) the adjusted views."""
    rig_from_target: RigidTransform
    """(V,) poses of the target; the rig's frame is the reference camera's."""
    residuals_px: Array
    """(V, cameras, N, 2) projected minus measured, cameras in the rig's order; NaN where unseen."""
    weights: Array
    """(V, cameras, N) robust weights, 1 for a point that fits; NaN where unseen."""
    noise_px: float
    """Standard deviation of one coordinate of a measured point in all pictures, from the
    residuals."""
    rejections: tuple[Rejection, ...] = ()
    warnings: tuple[str, ...] = ()
    """What the views do not constrain, one line each."""
    freedom: Freedom = HELD
    """Adjusted parameters of the rig, and the prior."""
    rejected: Array | None = None
    """(V, cameras, N, 2) measured pixels that took no part; NaN elsewhere."""
    blur: Array | None = None
    """(V, cameras) noise of each picture over `noise_px`; None if all are equal."""
    shape: TargetShape = AS_DRAWN
    """How the target differs from its drawing: part of `target_points`."""
    housing_trials: tuple[HousingTrial, ...] = ()
    """All kinds of ports and lenses that were compared, if they were."""
    spread: ErrorBudget | None = None
    """Noise of the corners and what follows of it; None if it was taken as independent."""

    def __post_init__(self) -> None:
        shape = (len(self.views), len(self.rig.cameras), len(self.target_points), 2)
        if self.residuals_px.shape != shape or self.weights.shape != shape[:3]:
            raise CalibrationError(
                f"calibration: residuals {self.residuals_px.shape}, weights {self.weights.shape}; "
                f"{shape} expected"
            )

    @property
    def drawn_points(self) -> Array:
        """(N, 3) points of the target as drawn, metres."""
        return self.target_points - self.shape.offsets_m

    @property
    def shared(self) -> Array:
        """(P, M) factor of what the rig's covariance has in common with other views of the target.

        That is by errors of the priors' means and of the places of the target's corners.
        """
        covariance = self.rig.covariance
        if covariance is None:
            return np.zeros((0, 0))
        if self.spread is not None:
            return self.spread.shared[: len(covariance.parameters)]
        prior = self.freedom.prior
        at = [covariance.parameters.index(name) for name in prior.parameters]
        return covariance.matrix[:, at] @ np.linalg.cholesky(prior.information)

    @property
    def sigma_px(self) -> Array:
        """(V, cameras) standard deviation of one coordinate in each picture."""
        alike: Array = np.full(self.residuals_px.shape[:2], self.noise_px)
        return alike if self.blur is None else alike * self.blur

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals over all pictures."""
        return float(np.sqrt(np.nanmean((self.residuals_px**2).sum(axis=-1))))


def stack_views(views: Sequence[TargetView], rig: Rig, count: int) -> Array:
    """Measured pixels of all views, (V, cameras, count, 2); NaN where unseen.

    Raises:
        CalibrationError: a view has another number of points, or a camera the rig lacks.
    """
    pixels = np.full((len(views), len(rig.cameras), count, 2), np.nan)
    order = {name: i for i, name in enumerate(rig.cameras)}
    for v, view in enumerate(views):
        for camera, seen in view.pixels.items():
            if camera not in order:
                raise CalibrationError(f"view {view.name}: the rig has no camera {camera!r}")
            if seen.shape != (count, 2):
                raise CalibrationError(
                    f"view {view.name}, {camera}: {seen.shape} pixels for {count} target points"
                )
            pixels[v, order[camera]] = seen
    pixels[~np.isfinite(pixels).all(axis=-1)] = np.nan
    return pixels


def residuals_px(rig: Rig, rig_from_target: RigidTransform, points: Array, pixels: Array) -> Array:
    """Projected minus measured pixels of all views; NaN where unseen or nothing is projected.

    Args:
        rig: its cameras took the views.
        rig_from_target: (V,) poses of the target.
        points: (N, 3) in its frame, metres.
        pixels: (V, cameras, N, 2) measured.
    """
    residuals = np.full(pixels.shape, np.nan)
    for c, (name, camera) in enumerate(rig.cameras.items()):
        for v in range(len(pixels)):
            pose = rig.cam_from_rig[name] * rig_from_target[v]
            residuals[v, c] = camera.project(pose.apply(points)) - pixels[v, c]
    return residuals
