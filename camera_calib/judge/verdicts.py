"""Verdicts on a calibration: one line each, with the numbers and what to do.

What the views do not constrain is in the calibration's own warnings.
"""

from collections.abc import Iterator

import numpy as np

from alice_survey.kit.document import Level, Verdict, worst_first
from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.housing import likely_port
from camera_calib.judge.judgement import CameraJudgement, Judgement
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
    """Six kinds of verdicts, the worst first: fit, port, held-out views, scale, target, pixels."""
    return tuple(worst_first(list(_lines(judged))))


def _lines(judged: Judgement) -> Iterator[Verdict]:
    yield from _fit_verdicts(judged)
    yield from _port_verdicts(judged)
    yield from _hold_out_verdicts(judged)
    yield from _length_verdicts(judged)
    yield from _target_verdicts(judged)
    yield from _uncertainty_verdicts(judged)


def _graded(ratio: float, look: float, bad: float) -> Level:
    return "good" if ratio <= look else "look" if ratio <= bad else "bad"


def _fit_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Pictures that fit badly, outliers, and what homographies leave at the edges."""
    median = float(np.median([p.rms_px for p in judged.pictures]))
    bad = [p for p in judged.pictures if p.rms_px > _ODD_PICTURE * median]
    outliers = sum(p.outliers for p in judged.pictures)
    points = sum(p.points for p in judged.pictures)
    if bad:
        listed = ", ".join(f"view {p.view} of {p.camera} ({p.rms_px:.3f} px)" for p in bad[:5])
        more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
        held = judged.hold_out
        harmless = held is not None and held.rms_px <= _HELD_LOOK * held.expected_px
        advice = "held-out views fit as expected nonetheless"
        if not harmless:
            advice = "look at them for blur, motion or a bent target"
        yield Verdict(
            level="good" if harmless else "look",
            text=f"pictures over {_ODD_PICTURE:g} times the median of {median:.3f} px rms: "
            f"{listed}{more}; {advice}",
        )
    else:
        yield Verdict(level="good", text=f"all pictures fit alike (median {median:.3f} px rms)")
    if outliers > _MAX_OUTLIERS * points:
        yield Verdict(level="look", text=f"{outliers} of {points} points are outliers")
    for name, camera in judged.cameras.items():
        yield from _homography_verdicts(judged, name, camera)


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
            cause = "the target departs from its drawing"
        elif frame.returning_px > _RETURNING * judged.calibration.noise_px:
            cause = f"the target is uneven, or {cause}"
    yield Verdict(
        level=_graded(ratio, _TREND_LOOK, _TREND_BAD),
        text=f"{name}: homographies leave {test.inner_px:.3f} px within and {test.outer_px:.3f}"
        f" px beyond {test.outer_from_px:.0f} px from the centre"
        + ("" if ratio <= _TREND_LOOK else f"; {cause}"),
    )


def _port_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Whether the rig can be the one that the views were taken with, and its port theirs."""
    calibration = judged.calibration
    rig = calibration.rig
    if set(rig.cameras) == {"left", "right"}:
        x, y, z = (1e3 * rig.cam_from_rig["right"].inv().translation).tolist()
        if x < -max(abs(y), abs(z)):
            yield Verdict(
                level="bad",
                text=f"the right camera is {-x:.0f} mm to the left of the left one: swap --left "
                "and --right, unless the cameras hang upside down",
            )
    for name, camera in rig.cameras.items():
        ratio = calibration.housing.focal_ratios.get(name)
        if ratio is not None:
            n_water = max(camera.n_water, _FRESH_WATER)
            fits = abs(ratio / camera.port.magnification - 1.0) < _RATIO_OFF
            advice = f"; calibrate with --port {likely_port(ratio)}, or --port auto"
            yield Verdict(
                level="good" if fits else "bad",
                text=f"focal lengths of {name} under water are {ratio:.3f} times those in air: "
                f"{n_water:.3g} behind a flat port, near 1 behind a dome or without a port"
                + ("" if fits else advice),
            )
        sigma_m = rig.sigmas.get(f"{name}.port_distance_m")
        if sigma_m is None:
            continue
        distance_m = camera.parameter("port_distance_m")
        near = not distance_m + _SIGMAS * sigma_m > _NEAREST_GLASS_M
        if near or distance_m - _SIGMAS * sigma_m > _MAX_GLASS_M:
            yield Verdict(
                level="bad",
                text=f"the flat port of {name} ended {distance_m * 1e3:.2g} mm before the pupil, "
                "where no housing has glass: the pictures are through a dome, without a port, or "
                "in air; try --port auto",
            )
    yield from _prior_verdicts(judged)


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
            text=f"{text}: port, lens or water differ from the prior; try --port auto, or "
            "--intrinsics free if the focus changed",
        )


def _hold_out_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """Views that took no part, and calibrations from halves of the views."""
    score, halves = judged.hold_out, judged.halves
    if score is None:
        yield Verdict(level="look", text="no views were held out: the fit is not tested")
        return
    ratio, points = score.rms_px / score.expected_px, score.points + score.outliers
    yield Verdict(
        level=_graded(ratio, _HELD_LOOK, _HELD_BAD),
        text=f"{score.views} held-out views fit to {score.rms_px:.3f} px rms, {ratio:.2f} times "
        f"what noise and covariance predict ({score.expected_px:.3f} px); used views to "
        f"{score.used_rms_px:.3f} px",
    )
    if score.outliers > _MAX_OUTLIERS * points:
        yield Verdict(
            level="look", text=f"{score.outliers} of {points} held-out points are outliers"
        )
    for name, camera in judged.cameras.items():
        if camera.halves is not None:
            found, expected = camera.halves.rms_px, camera.halves.expected_rms_px
            yield Verdict(
                level=_graded(found / expected, _HALVES_LOOK, _HALVES_BAD),
                text=f"{name}: calibrations from either half of the views differ by {found:.3f} px "
                f"rms, {found / expected:.2f} times what their covariances predict",
            )
    if halves is not None:
        level: Level = "good" if halves.p_value >= _P_LOOK else "look"
        yield Verdict(
            level=level if halves.p_value >= _P_BAD else "bad",
            text=f"parameters from either half of the views differ by chi2 {halves.chi2:.1f} for "
            f"{halves.parameters} (p = {halves.p_value:.2g})"
            + ("" if level == "good" else ": the sigmas are too small; did lens, port or target "
               "change between views?"),
        )  # fmt: skip


def _target_verdicts(judged: Judgement) -> Iterator[Verdict]:
    """The target's bend, and what returns in its frame in view after view."""
    shape, frame = judged.calibration.shape, judged.target_frame
    for name, along in ((BOW_X, "width"), (BOW_Y, "height")):
        if name not in shape.parameters:
            continue
        bow_m, sigma_m = shape.known(name)
        prior_m = float(shape.prior_sigmas[shape.parameters.index(name)])
        known = f"{with_sigma(1e3 * bow_m, 1e3 * sigma_m)} mm over its {along}"
        if sigma_m > _OPEN * prior_m:
            text = f"the views hardly show how the target bends: {known}; tilt it more"
            yield Verdict(level="look", text=text)
        elif abs(bow_m) > _VERY_BENT * prior_m:
            text = f"the target is bent by {known}: it is taken into account; use a stiffer one"
            yield Verdict(level="look", text=text)
    if frame is None:
        return
    if not frame.returns:
        yield Verdict(level="good", text="residuals average to nothing in the target's frame")
        return
    small = frame.returning_px <= _RETURNING * judged.calibration.noise_px
    cause = {
        "shape": "the target is bent or stretched, and its shape was not adjusted",
        "corners": "a few of its corners are displaced or damaged",
        "uneven": "its print or paper is uneven",
    }[frame.cause]
    yield Verdict(
        level="good" if small and frame.cause != "shape" else "look",
        text=f"in the target's frame {frame.returning_px:.3f} px of the residuals return in every "
        f"view (p = {frame.p_value:.1g}), {1e3 * frame.in_plane_m:.2f} mm rms in its plane: "
        f"likely {cause}" + ("; the sigmas include it" if small else "; use a better target"),
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
            text=f"long lengths on {which} views: scale error {scale:+.0f} +/- {sigma:.0f} ppm, "
            f"{1e3 * found:.2f} mm rms ({1e3 * expected:.2f} mm by the noise alone)",
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
