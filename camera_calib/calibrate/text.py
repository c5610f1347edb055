"""A calibration in words: fit, baselines, lenses, ports and verdicts."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.housing import (
    housing_lines,
)
from camera_calib.calibration import Calibration
from camera_calib.judge.uncertainty import baseline_sigma_m
from camera_calib.rig import Rig
from camera_calib.target_shape import (
    BOW_X,
    BOW_Y,
    SHEAR,
    STRETCH,
    TWIST,
    marker_lines,
)
from camera_calib.targets.target import Target

_LEVELS = ("bad", "look", "good")


def calibration_text(
    calibration: Calibration, target: Target, verdicts: Sequence[Mapping[str, str]]
) -> str:
    """What is bad, fit, baselines, lenses, ports and verdicts; lengths in millimetres.

    Args:
        calibration: with its rig's covariance.
        target: its squares or tags set the scale of the baseline.
        verdicts: `level` and `text` of each, the worst first, as in `report.json`.
    """
    rig, square = calibration.rig, (calibration.residuals_px**2).sum(axis=-1)
    bad = [f"bad: {verdict['text']}" for verdict in verdicts if verdict["level"] == "bad"]
    lines = [
        *bad,
        f"{len(calibration.views)} views, {int(np.isfinite(square).sum())} points, "
        f"{calibration.rms_px:.3f} px rms (noise {calibration.noise_px:.3f} px)",
        *_baseline_lines(rig, target),
        *_shape_lines(calibration),
        *housing_lines(calibration.housing),
    ]
    for name in rig.cameras:
        lines += _camera_lines(rig, name)
    lines += _verdict_lines(verdicts, len(calibration.warnings))
    return "\n".join(lines)


def _shape_lines(calibration: Calibration) -> Iterator[str]:
    """How the target differs from its drawing, and how much of the noise goes together."""
    shape = calibration.shape

    def stated(name: str, scale: float) -> str:
        number, sigma = shape.known(name)
        return with_sigma(scale * number, scale * sigma)

    if shape.parameters:
        yield (
            f"target: bow over its width {stated(BOW_X, 1e3)} mm, over its height "
            f"{stated(BOW_Y, 1e3)} mm, twist {stated(TWIST, 1e3)} mm; x over y longer by "
            f"{stated(STRETCH, 1e2)} %, shear {stated(SHEAR, 1e2)} %"
        )
    yield from marker_lines(shape)
    if calibration.spread is not None:
        noise = calibration.spread.noise
        yield (
            f"noise of corners: {noise.together_share:.0%} goes together in a picture; places on "
            f"the target err by {1e3 * noise.place_sigmas_m[0]:.3f} mm in its plane"
        )


def _baseline_lines(rig: Rig, target: Target) -> Iterator[str]:
    for name in list(rig.cameras)[1:]:
        length_m = float(np.linalg.norm(rig.cam_from_rig[name].translation))
        sigma_m = baseline_sigma_m(rig, name)
        unit = "tags" if target.kind == "apriltag" else "squares"
        to = f" from {rig.reference} to {name}" if len(rig.cameras) > 2 else ""
        yield (
            f"baseline{to} {with_sigma(1e3 * length_m, 1e3 * sigma_m)} mm = "
            f"{with_sigma(length_m / target.size_m, sigma_m / target.size_m)} {unit} of "
            f"{1e3 * target.size_m:g} mm"
        )


def _camera_lines(rig: Rig, name: str) -> Iterator[str]:
    camera, sigmas = rig.cameras[name], rig.sigmas

    def stated(field: str, unit: str, scale: float = 1.0) -> str:
        number, sigma = scale * camera.parameter(field), sigmas.get(f"{name}.{field}")
        if sigma is None:
            return f"{number:.6g}{unit} (held)"
        return f"{with_sigma(number, scale * sigma)}{unit}"

    yield f"{name}: focal lengths {stated('fx_px', ' px')}, {stated('fy_px', ' px')}"
    if not camera.port.parameters:
        return
    parts = [
        label.format(stated(field, " mm", 1e3) if field.endswith("_m") else stated(field, ""))
        for field, label in camera.port.labels.items()
    ]
    if camera.port.tilts:
        tilt_deg, sigma_deg = port_tilt_deg(rig, name)
        known = f"{tilt_deg:.3g}" if sigma_deg is None else with_sigma(tilt_deg, sigma_deg)
        held = " (held)" if sigma_deg is None else ""
        parts.insert(len(camera.port.places), f"tilt {known} deg{held}")
    yield f"{name} {camera.port.shape} port: {', '.join(parts)}"


def port_tilt_deg(rig: Rig, name: str) -> tuple[float, float | None]:
    """Angle between a port's normal and the camera's axis, and its sigma; None where held.

    For a port without tilt the direction of an error is open; its sigma is the larger of the two.
    """
    x, y, z = rig.cameras[name].port.axis_cam
    sine = math.hypot(x, y)
    fields = [f"{name}.{tilt}" for tilt in rig.cameras[name].port.tilts]
    tilt_deg = math.degrees(math.atan2(sine, z))
    if rig.covariance is None or not set(fields) <= set(rig.covariance.parameters):
        return tilt_deg, None
    at = [rig.covariance.parameters.index(field) for field in fields]
    block = rig.covariance.matrix[np.ix_(at, at)]
    if sine == 0.0:
        variance = float(np.linalg.eigvalsh(block)[-1])
    else:
        along = np.array([x, y]) / sine
        variance = float(along @ block @ along)
    return tilt_deg, math.degrees(math.sqrt(max(variance, 0.0)) / z)


def _verdict_lines(verdicts: Sequence[Mapping[str, str]], warnings: int) -> Iterator[str]:
    counts = Counter(verdict["level"] for verdict in verdicts)
    words = [f"{counts[level]} {level}" for level in _LEVELS if counts[level]]
    yield f"verdicts: {', '.join(words)}; {warnings} warnings"
    for verdict in verdicts:
        if verdict["level"] == "look":
            yield f"  look: {verdict['text']}"
