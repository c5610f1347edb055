"""All measures of a calibration that its report shows, and the verdicts on them.

A verdict is one line with its numbers and what to do. What the views do not constrain is in the
calibration's own warnings.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtr

from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from alice_survey.kit.document import Level, Verdict, worst_first
from alice_survey.kit.words import count, with_sigma
from camera_calib.calibration import Calibration
from camera_calib.judge import residuals, uncertainty, validation
from camera_calib.target_shape import BOW_X, BOW_Y

DESIGN_RANGE_M = 2.0
"""Usual working range; used if the views are close to it."""
_MAP_COLUMNS, _MAP_ROWS = 25, 21

_MAX_OUTLIERS = 0.01
"""Share of the points."""
_P_LOOK, _P_BAD = 1e-3, 1e-6
"""Levels of all tests: of an exact calibration, one verdict in a thousand is `look`."""
_NEAREST_GLASS_M, _MAX_GLASS_M = 0.002, 0.25
"""Distance at which a port touches the lens, and the largest one of a housing."""
_OPEN = 0.5
"""Share of its prior's sigma above which the views do not show a bow."""
_VERY_BENT = 2.0
"""Bow over its prior's sigma."""
_UNEVEN = 0.5
"""Systematic errors in the pictures over the noise of a corner: of the places of corners on the
target, above which it should be better, and of the model, below which none is `bad`."""
_SIGMAS = 3.0
_SHOWN = 1e-4
"""Least variance of a parameter's change by the views, over its prior's; less is rounding."""
_MAX_SIGMA = 10.0
"""Projection sigma over the noise, in nine tenths of where the target was seen: never `bad`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraJudgement:
    """Measures of one camera."""

    seen: residuals.CameraResiduals
    by_incidence: residuals.Profile
    """Residuals against the angle to the port's normal in water, deg."""
    coverage: NDArray[np.intp]
    """(rows, columns) points by cell of the frame."""
    homography: residuals.HomographyTest | None
    sigma: uncertainty.ProjectionSigma
    """(R, C) at the working range."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Contents of a calibration report."""

    calibration: Calibration
    working_range_m: float
    parameters: tuple[uncertainty.Parameter, ...]
    baselines_m: dict[str, tuple[float, float]]
    """Distance from the reference camera and its sigma, by camera."""
    pictures: tuple[residuals.PictureFit, ...]
    cameras: dict[str, CameraJudgement]
    stereo: uncertainty.StereoSigma | None
    """At the working range; None for one camera."""
    lengths: validation.LengthErrors | None
    """Errors on the views used; None for one camera."""
    held_lengths: validation.LengthErrors | None
    """Errors on held-out views, in the rig calibrated without them."""
    hold_out: validation.HoldOutScore | None
    halves: validation.HalvesAgreement | None
    """All parameters of two calibrations, from either half of the views."""


@progress.step("judge the calibration")
def judge(calibration: Calibration, held: validation.HeldOut | None) -> Judgement:
    """Compute everything that the report shows.

    Args:
        calibration: with its rig's covariance.
        held: held-out views, if there were any.

    Raises:
        CalibrationError: the rig has no covariance.
    """
    rig, found = calibration.rig, calibration
    of_rig = uncertainty.rig_parameters(rig, calibration.freedom.prior.parameters)
    range_m = _working_range_m(calibration)
    stereo = len(rig.cameras) > 1
    lengths = held_lengths = halves = None
    if held is not None and held.halves is not None:
        halves = validation.halves_agreement(held.halves)
    if stereo:
        lengths = validation.length_errors(
            rig, found.views, found.rig_from_target, found.residuals_px, found.target_points,
            found.sigma_px,
        )  # fmt: skip
    if stereo and held is not None:
        held_lengths = validation.length_errors(
            held.used.rig, held.views, held.rig_from_target, held.residuals_px,
            held.used.target_points, held.used.noise_px,
        )  # fmt: skip
    return Judgement(
        calibration=calibration,
        working_range_m=range_m,
        parameters=(*of_rig, *uncertainty.shape_parameters(calibration.shape)),
        baselines_m=uncertainty.baselines_m(rig),
        pictures=tuple(residuals.picture_fits(calibration)),
        cameras={name: _camera(calibration, name, range_m) for name in rig.cameras},
        stereo=(uncertainty.stereo_sigma(rig, range_m, calibration.noise_px) if stereo else None),
        lengths=lengths,
        held_lengths=held_lengths,
        hold_out=None if held is None else validation.score_hold_out(held),
        halves=halves,
    )


def _working_range_m(calibration: Calibration) -> float:
    """The usual one or, where the views were taken at very different distances, their median."""
    centre = calibration.target_points.mean(axis=0)
    ranges = calibration.rig_from_target.apply(centre)[:, 2]
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


def _camera(calibration: Calibration, name: str, range_m: float) -> CameraJudgement:
    rig, model = calibration.rig, calibration.rig.cameras[name]
    seen = residuals.camera_residuals(calibration, name)
    pixels = model.frame_grid(_MAP_COLUMNS, _MAP_ROWS)
    compensating = uncertainty.compensation(rig, name, anchors_cam(calibration, name))
    return CameraJudgement(
        seen=seen,
        by_incidence=residuals.incidence_profile(model, seen),
        coverage=residuals.points_by_cell(model, seen.pixels),
        homography=residuals.homography_test(calibration, name),
        sigma=uncertainty.projection_sigma(rig, name, pixels, range_m, compensating),
    )


def verdicts(judged: Judgement) -> tuple[Verdict, ...]:
    """Six kinds of verdicts, the worst first: fit, port, held-out views, scale, target, pixels."""
    kinds = (
        _fit_verdicts, _port_verdicts, _hold_out_verdicts, _length_verdicts, _target_verdicts,
        _uncertainty_verdicts,
    )  # fmt: skip
    found = [verdict for kind in kinds for verdict in kind(judged)]
    return tuple(worst_first(found))


def _grade(ratio: float, limits: tuple[float, float], text: str, advice: str = "") -> Verdict:
    """A verdict on a ratio; advice is added where it is not good."""
    level: Level = "good" if ratio <= limits[0] else "look" if ratio <= limits[1] else "bad"
    return Verdict(level=level, text=text if level == "good" else text + advice)


def _test(p_value: float, text: str, advice: str) -> Verdict:
    """A verdict on what chance makes as large only with some probability."""
    limits = -np.log(_P_LOOK), -np.log(_P_BAD)
    return _grade(-np.log(max(p_value, 1e-300)), limits, f"{text} (p = {p_value:.2g})", advice)


def _look(text: str) -> Verdict:
    return Verdict(level="look", text=text)


def _bad(text: str) -> Verdict:
    return Verdict(level="bad", text=text)


def _outlier_verdicts(outliers: int, points: int, which: str) -> Iterator[Verdict]:
    if outliers > _MAX_OUTLIERS * points:
        yield _look(f"{outliers} of {points} {which} are outliers")


def _fit_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Pictures that fit badly, outliers, and what homographies leave at the edges."""
    rms_px = np.array([p.rms_px for p in judged.pictures]) + 1e-12
    median = float(np.median(rms_px))
    over = 2.0 * np.log(rms_px / median)
    chance = [(2.0 / max(2 * p.points - 6, 2)) ** 0.5 for p in judged.pictures]
    scatter = np.maximum(chance, np.quantile(np.abs(over), 0.683))
    tails = len(over) * ndtr(-over / scatter)
    odd = [judged.pictures[i] for i in np.flatnonzero(tails < _P_LOOK)]
    harmless = judged.hold_out is not None and judged.hold_out.p_value >= _P_LOOK
    listed = ", ".join(f"view {p.view} of {p.camera} ({p.rms_px:.3f} px)" for p in odd[:5])
    text = (
        f"{count(len(odd), 'picture')} above the median of {median:.3f} px rms at p < {_P_LOOK:g}"
    )
    if odd and not harmless:
        yield _look(f"{text}, such as {listed}; look at them for blur, motion or a bent target")
    else:
        yield Verdict(level="good", text=f"{text}{', such as ' if odd else ''}{listed}")
    outliers, points = (sum(getattr(p, n) for p in judged.pictures) for n in ("outliers", "points"))
    yield from _outlier_verdicts(outliers, points, "points")
    for name, camera in judged.cameras.items():
        test = camera.homography
        if test is not None:
            size = 1.0 if test.share <= _UNEVEN else 2.0  # a small misfit is not `bad`
            yield _grade(
                size if test.p_value < _P_LOOK else 0.0, (0.0, 1.0),
                f"{name}: homographies leave {test.noise_px:.3f} px, of which {test.share:.2f} is "
                f"the same at one place of the frame in all views (p = {test.p_value:.2g})",
                f"; the model of lens or port does not fit{_port_advice(judged.calibration)}",
            )  # fmt: skip


def _port_advice(calibration: Calibration) -> str:
    """The comparison of ports, for views under water that were not compared yet."""
    compared = len({trial.port for trial in calibration.housing_trials}) > 1
    return "" if compared or not calibration.freedom.prior.parameters else ": try --port auto"


def _port_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Whether the rig can be the one that the views were taken with, and its port theirs."""
    calibration = judged.calibration
    rig = calibration.rig
    if set(rig.cameras) == {"left", "right"}:
        x, y, z = (1e3 * rig.cam_from_rig["right"].inv().translation).tolist()
        if x < -max(abs(y), abs(z)):
            yield _bad(
                f"the right camera is {-x:.0f} mm to the left of the left one: swap --left and "
                "--right, unless the cameras hang upside down"
            )
    # Where housings were compared, what each leaves has decided already.
    compared = len({trial.port for trial in calibration.housing_trials}) > 1
    for name, camera in rig.cameras.items() if not compared else ():
        spread_m = _SIGMAS * rig.sigmas.get(f"{name}.port_distance_m", np.inf)
        if np.isfinite(spread_m):
            distance_m = camera.parameter("port_distance_m")
            if not _NEAREST_GLASS_M - spread_m < distance_m <= _MAX_GLASS_M + spread_m:
                yield _bad(
                    f"the flat port of {name} ended {distance_m * 1e3:.2g} mm before the pupil, "
                    "where no housing has glass: the pictures are through a dome, without a port, "
                    "or in air; try --port auto"
                )
    yield from _prior_verdicts(calibration)


def _prior_verdicts(calibration: Calibration) -> Iterator[Verdict]:
    """Whether the views contradict what was known before, as a wrong kind of port makes them do.

    Of the prior's error d the result has a part K d. Its change by the views, whose own errors are
    independent of d, thus has the variance of both less twice that of K d with d.
    """
    prior, result = calibration.freedom.prior, calibration.rig.covariance
    if result is None or not prior.parameters:
        return
    count = len(prior.parameters)
    first = calibration.shared.shape[1] - count - len(calibration.shape.parameters)
    at = [result.parameters.index(name) for name in prior.parameters]
    kept = calibration.shared[at, first : first + count]
    of_prior = kept @ np.linalg.inv(np.linalg.cholesky(prior.information))
    before = np.diag(prior.covariance)
    change = before + np.diag(result.matrix)[at] - 2.0 * np.diag(of_prior)
    moved = np.abs(prior.misfit(calibration.rig)) / np.sqrt(np.maximum(change, _SHOWN * before))
    largest = int(moved.argmax())
    yield _test(
        min(2.0 * count * float(ndtr(-moved[largest])), 1.0),
        f"the views move {prior.parameters[largest]} by {moved[largest]:.1f} sigmas from its prior,"
        " more than any other parameter",
        f"; port, lens or water differ from the prior{_port_advice(calibration)}, or --intrinsics "
        "free if the focus changed",
    )


def _hold_out_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Views that took no part, and calibrations from halves of the views."""
    score, halves = judged.hold_out, judged.halves
    if score is None:
        yield _look("no views were held out: the fit is not tested")
        return
    ratio = score.rms_px / score.expected_px
    yield _test(
        score.p_value,
        f"{score.views} held-out views fit to {score.rms_px:.3f} px rms, {ratio:.2f} times what "
        f"noise and covariance predict ({score.expected_px:.3f} px); used views to "
        f"{score.used_rms_px:.3f} px",
        ": too few views, or the camera changed between them",
    )
    yield from _outlier_verdicts(score.outliers, score.points + score.outliers, "held-out points")
    if halves is not None:
        yield _test(
            halves.p_value,
            f"parameters from either half of the views differ by chi2 {halves.chi2:.1f} for "
            f"{halves.parameters}"
            + (f", sigmas are {halves.widening:.2f} times as large" if halves.widening > 1 else ""),
            ": did lens, port or target change between views?",
        )


def _target_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """The target's bend, and places of its corners that are off in view after view."""
    calibration = judged.calibration
    shape = calibration.shape
    for name, along in ((BOW_X, "width"), (BOW_Y, "height")):
        if name not in shape.parameters:
            continue
        bow_m, sigma_m = shape.value_and_sigma(name)
        prior_m = float(shape.prior_sigmas[shape.parameters.index(name)])
        known = f"{with_sigma(1e3 * bow_m, 1e3 * sigma_m)} mm over its {along}"
        if sigma_m > _OPEN * prior_m:
            yield _look(f"the views hardly show how the target bends: {known}; tilt it more")
        elif abs(bow_m) > _VERY_BENT * prior_m:
            yield _look(
                f"the target is bent by {known}: it is taken into account; use a stiffer one"
            )
    if calibration.spread is None:
        return
    focal_px = np.mean([one.focal_in_water_px for one in calibration.rig.cameras.values()])
    range_m = np.median([picture.range_m for picture in judged.pictures])
    for off_m, where, remedy in zip(
        calibration.spread.noise.place_sigmas_m,
        ("in the target's plane", "across the target's plane"),
        ("use a target of even print", "find its bends with --target-shape sheet, or flatten it"),
        strict=True,
    ):
        yield _grade(
            float(off_m * focal_px / range_m) / calibration.noise_px, (_UNEVEN, np.inf),
            f"corners lie {1e3 * off_m:.3f} mm off their places {where}, which the sigmas include",
            f": {remedy}",
        )  # fmt: skip


def _length_verdicts(judged: Judgement) -> Iterator[Verdict]:
    for lengths, which in ((judged.held_lengths, "held-out"), (judged.lengths, "used")):
        scale, sigma = (np.nan, np.nan) if lengths is None else lengths.scale_ppm()
        if lengths is None or not np.isfinite(scale):
            continue
        found, expected = lengths.rms_m()
        yield _test(  # Student's: the sigma is from the scatter of few views
            2.0 * float(stdtr(len(np.unique(lengths.view)) - 1, -abs(scale) / sigma)),
            f"long lengths on {which} views: scale error {scale:+.0f} +/- {sigma:.0f} ppm, "
            f"{1e3 * found:.2f} mm rms ({1e3 * expected:.2f} mm by the noise alone)",
            "; is the size of the target's squares right?",
        )


def _uncertainty_verdicts(judged: Judgement) -> Iterator[Verdict]:
    noise_px, range_m = judged.calibration.noise_px, judged.working_range_m
    for name, camera in judged.cameras.items():
        sigma_px, count = camera.sigma.compensated_px, camera.coverage
        cells = np.indices(sigma_px.shape).T * count.shape // sigma_px.shape
        seen_px = sigma_px[count[tuple(cells.T)] > 0]  # elsewhere a warning says that none was
        median, high, worst = np.nanquantile(seen_px, [0.5, 0.9, 1.0]).tolist()
        yield _grade(
            high / noise_px, (_MAX_SIGMA, np.inf),
            f"{name}: at {range_m:.3g} m the calibration lets a projection err by {median:.3f} "
            f"px (median of where targets were), {high:.3f} px (nine tenths of it stay below) "
            f"to {worst:.3f} px (worst), best pose taken",
            "; more views at other angles and distances bring it down",
        )  # fmt: skip
    at_work = judged.stereo
    if at_work is not None and np.isfinite(at_work.length_sigma_m):
        yield _grade(
            at_work.length_sigma_m / at_work.length_m, (1e-3, np.inf),
            f"stereo at {range_m:.3g} m: a length of {at_work.length_m:.2f} m errs by "
            f"{1e3 * at_work.length_sigma_m:.3f} mm from the calibration alone",
        )  # fmt: skip
