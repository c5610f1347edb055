"""Verdicts on a calibration: one line each, with the numbers and what to do.

What the views do not constrain is in the calibration's own warnings.
"""

from collections.abc import Iterator

import numpy as np

from alice_survey.kit.document import Level, Verdict, worst_first
from camera_calib.judge.judgement import CameraJudgement, Judgement
from camera_calib.rig import Rig

_ODD_PICTURE = 2.0
_MOST_OUTLIERS = 0.01
"""Share of the points."""
_HELD_LOOK, _HELD_BAD = 1.2, 2.0
_HALVES_LOOK, _HALVES_BAD = 2.0, 3.5
"""One difference is a single draw from what is expected."""
_SIGMAS = 3.0
_TREND_LOOK, _TREND_BAD = 0.35, 1.0
_SIGMA_LOOK, _SIGMA_BAD = 3.0, 10.0
"""Projection sigma that nine tenths of the frame keep below, over the noise."""


def verdicts(judged: Judgement) -> tuple[Verdict, ...]:
    """All verdicts as lines, the worst first."""
    return tuple(worst_first(list(_lines(judged))))


def _lines(judged: Judgement) -> Iterator[Verdict]:
    yield from _side_verdicts(judged.calibration.rig)
    yield from _fit_verdicts(judged)
    yield from _hold_out_verdicts(judged)
    yield from _length_verdicts(judged)
    for name, camera in judged.cameras.items():
        yield from _homography_verdicts(name, camera)
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
    if outliers > _MOST_OUTLIERS * points:
        yield Verdict(
            level="look",
            text=f"{outliers} of {points} points are outliers; look where they lie in the pictures",
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
    if score.outliers > _MOST_OUTLIERS * (score.points + score.outliers):
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


def _homography_verdicts(name: str, camera: CameraJudgement) -> Iterator[Verdict]:
    test = camera.homography
    if test is not None and np.isfinite(test.outer_px):
        ratio = test.excess_px / max(test.inner_px, 1e-12)
        yield Verdict(
            level=_graded(ratio, _TREND_LOOK, _TREND_BAD),
            text=f"{name}: homographies leave {test.inner_px:.3f} px within and {test.outer_px:.3f}"
            f" px beyond {test.outer_from_px:.0f} px from the centre"
            + ("" if ratio <= _TREND_LOOK else "; the model of lens or port does not fit"),
        )


def _uncertainty_verdicts(judged: Judgement) -> Iterator[Verdict]:
    noise_px, range_m = judged.calibration.noise_px, judged.working_range_m
    for name, camera in judged.cameras.items():
        median = float(np.nanmedian(camera.sigma.compensated_px))
        worst = float(np.nanmax(camera.sigma.compensated_px))
        most = float(np.nanquantile(camera.sigma.compensated_px, 0.9))
        level = _graded(most / noise_px, _SIGMA_LOOK, _SIGMA_BAD)
        advice = "" if level == "good" else "; more views towards the edges bring it down"
        yield Verdict(
            level=level,
            text=f"{name}: at {range_m:.3g} m the calibration lets a projection err by "
            f"{median:.3f} px (median of the frame), {most:.3f} px (nine tenths of it stay below) "
            f"to {worst:.3f} px (worst), best pose taken{advice}",
        )
    at_work = judged.stereo_at_work
    if at_work is not None and np.isfinite(at_work.length_sigma_m):
        yield Verdict(
            level="good" if at_work.length_sigma_m < 1e-3 * at_work.length_m else "look",
            text=f"stereo at {range_m:.3g} m: a length of {at_work.length_m:.2f} m errs by "
            f"{1e3 * at_work.length_sigma_m:.3f} mm from the calibration alone",
        )
