"""Verdicts on a calibration: one line each, with the numbers and what to do.

What the views do not constrain is in the calibration's own warnings.
"""

from collections.abc import Iterator

import numpy as np

from alice_survey.kit.document import Level, Verdict, worst_first
from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.housing import likely_port
from camera_calib.judge.judgement import CameraJudgement, Judgement
from camera_calib.rig import Rig
from camera_calib.target_shape import BOW_X, BOW_Y

_ODD_PICTURE = 2.0
_MAX_OUTLIERS = 0.01
"""Share of the points."""
_HELD_LOOK, _HELD_BAD = 1.2, 2.0
_HALVES_LOOK, _HALVES_BAD = 2.0, 3.5
"""One difference is a single draw from what is expected."""
_P_LOOK, _P_BAD = 1e-2, 1e-6
"""Probabilities of the difference of two halves."""
_FRESH_WATER = 1.33
_RATIO_OFF = 0.12
"""Share by which a ratio of focal lengths may miss what the port makes of it; domes are centred by
hand, and a flat port's distance lengthens them a little."""
_NEAREST_GLASS_M, _MAX_GLASS_M = 0.002, 0.25
"""Distances from the pupil that a flat port of a housing may have."""
_OPEN = 0.5
"""Share of its prior's sigma above which the views do not show a bow."""
_VERY_BENT = 2.0
"""Bow over its prior's sigma."""
_RETURNING = 0.5
"""Residuals that return in the target's frame, over the noise of a coordinate."""
_SIGMAS = 3.0
_MOVED_LOOK, _MOVED_BAD = 3.5, 6.0
"""Sigmas by which views may move a parameter from its prior."""
_LEARNT = 0.99
"""Share of a prior's variance below which the views determine a parameter as well."""
_TREND_LOOK, _TREND_BAD = 0.35, 1.0
_SIGMA_LOOK, _SIGMA_BAD = 3.0, 10.0
"""Projection sigma that nine tenths of the frame keep below, over the noise."""


def verdicts(judged: Judgement) -> tuple[Verdict, ...]:
    """All verdicts as lines, the worst first."""
    return tuple(worst_first(list(_lines(judged))))


def _lines(judged: Judgement) -> Iterator[Verdict]:
    yield from _side_verdicts(judged.calibration.rig)
    yield from _fit_verdicts(judged)
    yield from _housing_verdicts(judged)
    yield from _prior_verdicts(judged)
    yield from _hold_out_verdicts(judged)
    yield from _length_verdicts(judged)
    yield from _target_verdicts(judged)
    for name, camera in judged.cameras.items():
        yield from _homography_verdicts(judged, name, camera)
    yield from _uncertainty_verdicts(judged)


def _side_verdicts(rig: Rig) -> Iterator[Verdict]:
    """A verdict where the pictures of the left and the right camera seem to be swapped."""
    if set(rig.cameras) != {"left", "right"}:
        return
    x, y, z = (1e3 * rig.cam_from_rig["right"].inv().translation).tolist()
    if x < -max(abs(y), abs(z)):
        yield Verdict(
            level="bad",
            text=f"the right camera stands {-x:.0f} mm to the left of the left one: swap --left "
            "and --right, unless the cameras hang upside down",
        )


def _graded(ratio: float, look: float, bad: float) -> Level:
    return "good" if ratio <= look else "look" if ratio <= bad else "bad"


def _fit_verdicts(judged: Judgement) -> Iterator[Verdict]:
    usual = float(np.median([p.rms_px for p in judged.pictures]))
    odd = [p for p in judged.pictures if p.rms_px > _ODD_PICTURE * usual]
    outliers = sum(p.outliers for p in judged.pictures)
    points = sum(p.points for p in judged.pictures)
    if odd:
        listed = ", ".join(
            f"view {p.view} of the {p.camera} camera at {p.rms_px:.3f} px" for p in odd[:5]
        )
        rest = f" and {len(odd) - 5} more" if len(odd) > 5 else ""
        held = judged.hold_out
        harmless = held is not None and held.rms_px <= _HELD_LOOK * held.expected_px
        yield Verdict(
            level="good" if harmless else "look",
            text=f"pictures that fit {_ODD_PICTURE:g} times worse than the median of {usual:.3f} "
            f"px: {listed}{rest}; "
            + (
                "views that were held out fit as well as noise and covariance promise, so that "
                "these do no harm"
                if harmless
                else "look at them for blur, motion or a bent target"
            ),
        )
    else:
        yield Verdict(level="good", text=f"all pictures fit alike (median {usual:.3f} px rms)")
    if outliers > _MAX_OUTLIERS * points:
        yield Verdict(
            level="look",
            text=f"{outliers} of {points} points are outliers; look where they lie in the pictures",
        )


def _housing_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Whether the port that was calibrated can be the one that the views were taken through."""
    calibration = judged.calibration
    for name, camera in calibration.rig.cameras.items():
        flat = camera.port.magnification
        ratio = calibration.housing.focal_ratios.get(name)
        n_water = max(camera.n_water, _FRESH_WATER)
        if ratio is not None:
            text = (
                f"focal lengths of {name} under water are {ratio:.3f} times those in air: "
                f"{n_water:.3g} behind a flat port, near 1 behind a dome or without a port"
            )
            likely = likely_port(ratio)
            fits = abs(ratio / flat - 1.0) < _RATIO_OFF
            more = "" if fits else f"; calibrate with --port {likely}, or --port auto"
            yield Verdict(level="good" if fits else "bad", text=text + more)
        sigma_m = calibration.rig.sigmas.get(f"{name}.port_distance_m")
        if sigma_m is None:
            continue
        distance_m = camera.parameter("port_distance_m")
        if not distance_m + _SIGMAS * sigma_m > _NEAREST_GLASS_M:
            yield Verdict(
                level="bad",
                text=f"the flat port of {name} ended {distance_m * 1e3:.2g} mm before the pupil, "
                "where no glass can be: the pictures are through a dome, without a port, or in "
                "air; try --port auto",
            )
        elif distance_m - _SIGMAS * sigma_m > _MAX_GLASS_M:
            yield Verdict(
                level="bad",
                text=f"the flat port of {name} ended {distance_m * 1e3:.0f} mm before the pupil, "
                "farther than in any housing: the pictures may be through a dome; try --port auto",
            )


def _prior_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Whether the views contradict what was known before, as a wrong kind of port makes them do.

    The change of a parameter by the views has the variance of its prior less that of the result.
    Where correlated noise of the corners makes the result the less certain of the two, it has their
    sum at most.
    """
    calibration = judged.calibration
    prior, result = calibration.freedom.prior, calibration.rig.covariance
    if result is None or not prior.parameters:
        return
    before = np.diag(prior.covariance)
    after = np.diag(result.marginal(prior.parameters).matrix)
    spread = np.sqrt(np.where(after < _LEARNT * before, before - after, before + after))
    moved = prior.misfit(calibration.rig) / spread
    maximum = int(np.abs(moved).argmax())
    level = _graded(abs(float(moved[maximum])), _MOVED_LOOK, _MOVED_BAD)
    text = (
        f"the views move {prior.parameters[maximum]} by {abs(moved[maximum]):.1f} sigmas "
        "from its prior"
    )
    if level == "good":
        yield Verdict(level=level, text=f"{text}, more than any other parameter")
    else:
        yield Verdict(
            level=level,
            text=f"{text}: port, lens or water are not what was taken; try --port auto, or "
            "--intrinsics free if the focus changed",
        )


def _hold_out_verdicts(judged: Judgement) -> Iterator[Verdict]:
    score = judged.hold_out
    if score is None:
        yield Verdict(level="look", text="no views were held out: the fit is not tested")
        return
    ratio = score.rms_px / score.expected_px
    yield Verdict(
        level=_graded(ratio, _HELD_LOOK, _HELD_BAD),
        text=f"{score.views} held-out views fit to {score.rms_px:.3f} px rms, {ratio:.2f} times "
        f"what noise and covariance promise ({score.expected_px:.3f} px); used views to "
        f"{score.used_rms_px:.3f} px",
    )
    if score.outliers > _MAX_OUTLIERS * (score.points + score.outliers):
        yield Verdict(
            level="look",
            text=f"{score.outliers} of {score.points + score.outliers} held-out points are "
            "outliers: they were found badly, or the model does not reach them",
        )
    for name, camera in judged.cameras.items():
        if camera.halves is not None:
            found, expected = camera.halves.rms_px, camera.halves.expected_rms_px
            yield Verdict(
                level=_graded(found / expected, _HALVES_LOOK, _HALVES_BAD),
                text=f"{name}: calibrations from either half of the views differ by {found:.3f} px "
                f"rms over the frame, {found / expected:.2f} times what their covariances promise",
            )

    if judged.halves is not None:
        halves = judged.halves
        level: Level = "good" if halves.p_value >= _P_LOOK else "look"
        level = level if halves.p_value >= _P_BAD else "bad"
        plausible = "plausible" if level == "good" else "not plausible"
        yield Verdict(
            level=level,
            text=f"parameters from either half of the views differ by chi2 {halves.chi2:.1f} for "
            f"{halves.parameters} (p = {halves.p_value:.2g}): {plausible}"
            + ("" if level == "good" else ", the sigmas are too small: is a view wrong, or did "
               "lens, port or target change?"),
        )  # fmt: skip


def _target_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Verdicts on the target itself."""
    shape, frame = judged.calibration.shape, judged.target_frame
    for name in (BOW_X, BOW_Y):
        if name in shape.parameters:
            bow_m, sigma_m = shape.known(name)
            at = shape.parameters.index(name)
            usual_m, along = float(shape.prior_sigmas[at]), "width" if name == BOW_X else "height"
            known = f"{with_sigma(1e3 * bow_m, 1e3 * sigma_m)} mm"
            if sigma_m > _OPEN * usual_m:
                yield Verdict(
                    level="look",
                    text=f"the views hardly show how the target bends over its {along}: {known}; "
                    "the sigmas include that; tilt it more",
                )
            elif abs(bow_m) > _VERY_BENT * usual_m:
                yield Verdict(
                    level="look",
                    text=f"the target is bent over its {along} by {known}: more than a board "
                    f"should ({_VERY_BENT * 1e3 * usual_m:.1f} mm); it is taken into account, but "
                    "such a board may bend differently in every view: use a stiff one",
                )
    if frame is None:
        return
    noise_px = judged.calibration.noise_px
    if not frame.returns:
        yield Verdict(
            level="good",
            text="in the target's frame residuals average to nothing"
            + (": it is as drawn, but for the shape that was found" if shape.parameters else ""),
        )
        return
    small = frame.returning_px <= _RETURNING * noise_px
    cause = {
        "shape": "the target is bent or stretched, and its shape was not adjusted",
        "corners": "a few of its corners are out of their places, or damaged",
        "uneven": "its print or paper is uneven, or it bends where no smooth sheet would",
    }[frame.cause]
    yield Verdict(
        level="good" if small and frame.cause != "shape" else "look",
        text=f"in the target's frame {frame.returning_px:.3f} px of the residuals return in view "
        f"after view (p = {frame.p_value:.1g}), {1e3 * frame.in_plane_m:.2f} mm rms in its plane: "
        f"likely {cause}"
        + ("; small against the noise, and in the sigmas" if small else "; use a better target"),
    )


def _length_verdicts(judged: Judgement) -> Iterator[Verdict]:
    for lengths, which in ((judged.held_lengths, "held-out"), (judged.lengths, "used")):
        if lengths is None or not len(lengths.true_m):
            continue
        scale, sigma = lengths.scale_ppm()
        found, expected = lengths.rms_m(long=True)
        if not (np.isfinite(scale) and found == found):
            continue
        off = abs(scale) > _SIGMAS * sigma or found > _HELD_LOOK**2 * expected
        yield Verdict(
            level="look" if off else "good",
            text=f"long lengths on {which} views: scale off by {scale:+.0f} +/- {sigma:.0f} ppm, "
            f"{1e3 * found:.2f} mm rms ({1e3 * expected:.2f} mm by the noise alone)",
        )


def _homography_verdicts(
    judged: Judgement, name: str, camera: CameraJudgement
) -> Iterator[Verdict]:
    test, frame = camera.homography, judged.target_frame
    if test is None or not np.isfinite(test.outer_px):
        return
    ratio = test.excess_px / max(test.inner_px, 1e-12)
    cause = "the model of lens or port does not fit"
    if frame is not None and frame.returns:
        if frame.cause == "shape":
            cause = "the target is not as drawn (above)"
        elif frame.returning_px > _RETURNING * judged.calibration.noise_px:
            cause = f"the target is uneven (above), or {cause}"
    yield Verdict(
        level=_graded(ratio, _TREND_LOOK, _TREND_BAD),
        text=f"{name}: homographies leave {test.inner_px:.3f} px within and {test.outer_px:.3f}"
        f" px beyond {test.outer_from_px:.0f} px from the centre"
        + ("" if ratio <= _TREND_LOOK else f"; {cause}"),
    )


def _uncertainty_verdicts(judged: Judgement) -> Iterator[Verdict]:
    noise_px, range_m = judged.calibration.noise_px, judged.working_range_m
    for name, camera in judged.cameras.items():
        median = float(np.nanmedian(camera.sigma.compensated_px))
        worst = float(np.nanmax(camera.sigma.compensated_px))
        maximum = float(np.nanquantile(camera.sigma.compensated_px, 0.9))
        level = _graded(maximum / noise_px, _SIGMA_LOOK, _SIGMA_BAD)
        advice = "" if level == "good" else "; more views towards the edges bring it down"
        yield Verdict(
            level=level,
            text=f"{name}: at {range_m:.3g} m the calibration lets a projection err by "
            f"{median:.3f} px (median of the frame), {maximum:.3f} px (nine tenths of it stay "
            f"below) to {worst:.3f} px (worst), best pose taken{advice}",
        )
    at_work = judged.stereo_at_work
    if at_work is not None and np.isfinite(at_work.length_sigma_m):
        yield Verdict(
            level="good" if at_work.length_sigma_m < 1e-3 * at_work.length_m else "look",
            text=f"stereo at {range_m:.3g} m: a length of {at_work.length_m:.2f} m errs by "
            f"{1e3 * at_work.length_sigma_m:.3f} mm from the calibration alone",
        )
