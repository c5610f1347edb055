"""All measures of a calibration that its report shows, as numbers."""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from camera_calib.calibration import Calibration
from camera_calib.freedom import POSE, value
from camera_calib.judge.fit_quality import (
    CameraResiduals,
    Coverage,
    PictureFit,
    Profile,
    camera_residuals,
    coverage,
    picture_fits,
    residual_profiles,
)
from camera_calib.judge.homography import HomographyTest, homography_test
from camera_calib.judge.target_frame import TargetFrame, target_frame
from camera_calib.judge.uncertainty import (
    ProjectionSigma,
    StereoSigma,
    baseline_sigma_m,
    compensation,
    covariance_of,
    projection_sigma,
    stereo_sigma,
)
from camera_calib.judge.validation import (
    HalvesAgreement,
    HalvesDifference,
    HeldOut,
    HoldOutScore,
    LengthErrors,
    halves_agreement,
    halves_difference,
    length_errors,
    score_hold_out,
)
from camera_calib.rig import Rig

DESIGN_RANGE_M = 2.0
"""Usual working range; used if the views are close to it."""
_RANGE_STEPS = np.array([0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.0])
"""Distances evaluated, in working ranges: 0.5 to 10 m for 2 m."""
_MAP_COLUMNS, _MAP_ROWS = 25, 21
_DEG = math.degrees(1.0)


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One calibrated or held number, in units for readers."""

    name: str
    value: float
    sigma: float | None
    """Standard deviation; None: it was held."""
    unit: str
    most_alike: str
    """The parameter it correlates with most; empty when held or alone."""
    correlation: float
    prior: bool
    """Whether it had a prior."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeSigma:
    """Projection uncertainty over the frame of one camera at one distance, px."""

    range_m: float
    plain_median_px: float
    plain_worst_px: float
    compensated_median_px: float
    compensated_worst_px: float


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraJudgement:
    """Measures of one camera."""

    seen: CameraResiduals
    by_radius: Profile
    by_incidence: Profile
    """Residuals against the radius and against the angle to the port's normal in water, deg."""
    coverage: Coverage
    homography: HomographyTest | None
    sigma: ProjectionSigma
    """(R, C) at the working range."""
    by_range: tuple[RangeSigma, ...]
    halves: HalvesDifference | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Contents of a calibration report."""

    calibration: Calibration
    held: HeldOut | None
    working_range_m: float
    parameters: tuple[Parameter, ...]
    baselines_m: dict[str, tuple[float, float]]
    """Distance from the reference camera and its sigma, by camera."""
    pictures: tuple[PictureFit, ...]
    cameras: dict[str, CameraJudgement]
    stereo: tuple[StereoSigma, ...]
    """By distance; empty for one camera."""
    lengths: LengthErrors | None
    """Errors on the views used; None for one camera."""
    held_lengths: LengthErrors | None
    """Errors on held-out views, in the rig calibrated without them."""
    hold_out: HoldOutScore | None
    halves: HalvesAgreement | None
    """All parameters of two calibrations, from either half of the views."""
    target_frame: TargetFrame | None

    @property
    def stereo_at_work(self) -> StereoSigma | None:
        """Stereo at the working range."""
        at = [s for s in self.stereo if s.range_m == self.working_range_m]
        return at[0] if at else None


@progress.step("judge the calibration")
def judge(
    calibration: Calibration, held: HeldOut | None, working_range_m: float | None = None
) -> Judgement:
    """Compute everything that the report shows.

    Args:
        calibration: with its rig's covariance.
        held: held-out views, if there were any.
        working_range_m: distance at which the rig will work; 2 m if not given, or, where the views
            were taken at very different distances, the views' median.

    Raises:
        CalibrationError: the rig has no covariance.
    """
    rig = calibration.rig
    covariance_of(rig)
    range_m = working_range_m or _working_range_m(calibration)
    ranges = tuple(float(r) for r in range_m * _RANGE_STEPS)
    stereo = len(rig.cameras) > 1
    lengths = held_lengths = None
    if stereo:
        lengths = length_errors(
            rig,
            calibration.views,
            calibration.rig_from_target,
            calibration.residuals_px,
            calibration.target_points,
            calibration.sigma_px,
        )
    if stereo and held is not None:
        held_lengths = length_errors(
            held.used.rig,
            held.views,
            held.rig_from_target,
            held.residuals_px,
            held.used.target_points,
            held.used.noise_px,
        )
    return Judgement(
        calibration=calibration,
        held=held,
        working_range_m=range_m,
        parameters=rig_parameters(rig, calibration.freedom.prior.parameters),
        baselines_m={
            name: (float(np.linalg.norm(pose.translation)), baseline_sigma_m(rig, name))
            for name, pose in rig.cam_from_rig.items()
            if name != rig.reference
        },
        pictures=tuple(picture_fits(calibration)),
        cameras={name: _camera(calibration, held, name, range_m, ranges) for name in rig.cameras},
        stereo=tuple(stereo_sigma(rig, r, calibration.noise_px) for r in ranges) if stereo else (),
        lengths=lengths,
        held_lengths=held_lengths,
        hold_out=None if held is None else score_hold_out(held),
        halves=None if held is None or held.halves is None else halves_agreement(held.halves),
        target_frame=target_frame(calibration),
    )


def _working_range_m(calibration: Calibration) -> float:
    middle = calibration.target_points.mean(axis=0)
    ranges = calibration.rig_from_target.apply(middle)[:, 2]
    if ranges.min() / 2 <= DESIGN_RANGE_M <= ranges.max() * 2:
        return DESIGN_RANGE_M
    return float(np.median(ranges))


def anchors_cam(calibration: Calibration, camera: str) -> Array:
    """All points of the target that one camera saw, (A, 3) in its frame."""
    index = list(calibration.rig.cameras).index(camera)
    seen = np.isfinite(calibration.residuals_px[:, index, :, 0])
    pose = calibration.rig.cam_from_rig[camera]
    points = [
        (pose * calibration.rig_from_target[v]).apply(calibration.target_points[seen[v]])
        for v in range(len(calibration.views))
    ]
    return np.concatenate(points)


def _camera(
    calibration: Calibration,
    held: HeldOut | None,
    name: str,
    range_m: float,
    ranges: tuple[float, ...],
) -> CameraJudgement:
    rig, model = calibration.rig, calibration.rig.cameras[name]
    seen = camera_residuals(calibration, name)
    by_radius, by_incidence = residual_profiles(model, seen)
    anchors = anchors_cam(calibration, name)
    pixels = model.frame_grid(_MAP_COLUMNS, _MAP_ROWS)
    halves = None
    if held is not None and held.halves is not None:
        halves = halves_difference(held.halves, name, pixels, range_m, anchors)
    coarse, compensating = pixels[::2, ::2], compensation(rig, name, anchors)
    return CameraJudgement(
        seen=seen,
        by_radius=by_radius,
        by_incidence=by_incidence,
        coverage=coverage(model, seen.pixels),
        homography=homography_test(calibration, name),
        sigma=projection_sigma(rig, name, pixels, range_m, compensating),
        by_range=tuple(
            over_frame(r, projection_sigma(rig, name, coarse, r, compensating)) for r in ranges
        ),
        halves=halves,
    )


def over_frame(range_m: float, sigma: ProjectionSigma) -> RangeSigma:
    """Median and largest of a map; NaN where nothing is known."""

    def known(values: Array) -> tuple[float, float]:
        kept = values[np.isfinite(values)]
        return (float(np.median(kept)), float(kept.max())) if len(kept) else (np.nan, np.nan)

    plain, compensated = known(sigma.plain_px), known(sigma.compensated_px)
    return RangeSigma(
        range_m=range_m,
        plain_median_px=plain[0],
        plain_worst_px=plain[1],
        compensated_median_px=compensated[0],
        compensated_worst_px=compensated[1],
    )


def rig_parameters(rig: Rig, with_prior: Collection[str] = ()) -> tuple[Parameter, ...]:
    """All parameters of a rig's cameras and poses, calibrated or held.

    Args:
        rig: with its covariance.
        with_prior: names of those that had a prior.
    """
    covariance = covariance_of(rig)
    names = [f"{c}.{p}" for c, camera in rig.cameras.items() for p in camera.parameters]
    names += [f"{c}.{p}" for c in rig.cameras if c != rig.reference for p in POSE]
    off_diagonal = covariance.correlation - np.eye(len(covariance.parameters))
    rows = []
    for name in names:
        sigma, maximum, correlation = None, "", 0.0
        if name in covariance.parameters:
            at = covariance.parameters.index(name)
            sigma = covariance.sigmas[name]
            other = int(np.abs(off_diagonal[at]).argmax())
            if other != at:
                maximum, correlation = covariance.parameters[other], float(off_diagonal[at, other])
        shown, shown_sigma, unit = _for_readers(name, value(rig, name), sigma)
        rows.append(
            Parameter(
                name=name,
                value=shown,
                sigma=shown_sigma,
                unit=unit,
                most_alike=maximum,
                correlation=correlation,
                prior=name in with_prior,
            )
        )
    return tuple(rows)


def _for_readers(name: str, number: float, sigma: float | None) -> tuple[float, float | None, str]:
    """Value, sigma and unit: mm and degrees instead of m, radians and sines of tilts."""
    if name.endswith(("normal_x", "normal_y")):
        steep = math.sqrt(1.0 - number * number)
        spread = None if sigma is None else math.degrees(sigma / steep)
        return math.degrees(math.asin(number)), spread, "deg"
    for ending, factor, unit in (("_px", 1.0, "px"), ("_m", 1e3, "mm"), ("_rad", _DEG, "deg")):
        if name.endswith(ending):
            return number * factor, None if sigma is None else sigma * factor, unit
    return number, sigma, ""


def short_label(field: str) -> str:
    """A parameter's name without its unit: `fx_px` as `fx`."""
    for ending in ("_px", "_rad", "_m"):
        field = field.removesuffix(ending)
    return field.replace("_", " ")
