"""What a calibration has found, in the lines that the command line prints."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from alice_survey.kit.words import with_sigma
from camera_calib.calibration import Calibration
from camera_calib.judge.uncertainty import baseline_sigma_m
from camera_calib.rig import Rig
from camera_calib.targets.target import Target

_LEVELS = ("bad", "look", "good")


def calibration_text(
    calibration: Calibration, target: Target, verdicts: Sequence[Mapping[str, str]]
) -> str:
    """Fit, baseline, lenses, ports and verdicts of a calibration; lengths in millimetres.

    Args:
        calibration: with its rig's covariance.
        target: whose squares or tags are a measure for the baseline.
        verdicts: `level` and `text` of each, the worst first, as in `report.json`.
    """
    rig, square = calibration.rig, (calibration.residuals_px**2).sum(axis=-1)
    lines = [
        f"{len(calibration.views)} views, {int(np.isfinite(square).sum())} points, "
        f"{calibration.rms_px:.3f} px rms (noise {calibration.noise_px:.3f} px)",
        *_baseline_lines(rig, target),
    ]
    for name in rig.cameras:
        lines += _camera_lines(rig, name)
    lines += _verdict_lines(verdicts, len(calibration.warnings))
    return "\n".join(lines)


def _baseline_lines(rig: Rig, target: Target) -> Iterator[str]:
    for name in list(rig.cameras)[1:]:
        length_m = float(np.linalg.norm(rig.cam_from_rig[name].translation))
        sigma_m = baseline_sigma_m(rig, name)
        unit = "tags" if target.kind == "apriltag" else "squares"
        yield (
            f"baseline {with_sigma(1e3 * length_m, 1e3 * sigma_m)} mm = "
            f"{with_sigma(length_m / target.size_m, sigma_m / target.size_m)} {unit} of "
            f"{1e3 * target.size_m:g} mm"
        )


def _camera_lines(rig: Rig, name: str) -> Iterator[str]:
    camera, sigmas = rig.cameras[name], rig.sigmas

    def told(field: str, unit: str, scale: float = 1.0) -> str:
        number, sigma = scale * camera.parameter(field), sigmas.get(f"{name}.{field}")
        if sigma is None:
            return f"{number:.6g}{unit} (held)"
        return f"{with_sigma(number, scale * sigma)}{unit}"

    yield f"{name}: focal lengths {told('fx_px', ' px')}, {told('fy_px', ' px')}"
    if camera.n_water == 1.0 and camera.port_distance_m == camera.glass_thickness_m == 0.0:
        return
    tilt_deg, sigma_deg = port_tilt_deg(rig, name)
    tilt = f"{tilt_deg:.3g} deg (held)" if sigma_deg is None else with_sigma(tilt_deg, sigma_deg)
    yield (
        f"{name} port: {told('port_distance_m', ' mm', 1e3)} from the pupil, tilt "
        f"{tilt}{'' if sigma_deg is None else ' deg'}, glass "
        f"{told('glass_thickness_m', ' mm', 1e3)}, index {told('n_glass', '')}, water "
        f"{told('n_water', '')}"
    )


def port_tilt_deg(rig: Rig, name: str) -> tuple[float, float | None]:
    """Angle between a port's normal and the camera's axis, and its sigma; None where held.

    Of a port without tilt the direction of an error is open; its sigma is the larger of the two.
    """
    x, y, z = rig.cameras[name].normal
    sine = math.hypot(x, y)
    fields = [f"{name}.normal_x", f"{name}.normal_y"]
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
        if verdict["level"] != "good":
            yield f"  {verdict['level']}: {verdict['text']}"
