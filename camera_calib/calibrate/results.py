"""What a calibration leaves: rig, numbers, corners and report as files, and a few lines of text."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import warn
from alice_survey.core.records import CalibrationRecord
from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.solve import recalibrate
from camera_calib.calibrate.start import locate
from camera_calib.calibration import (
    Calibration,
    HousingJudgement,
    TargetView,
    residuals_px,
    stack_views,
)
from camera_calib.judge.report import write_report
from camera_calib.judge.uncertainty import baseline_sigma_m
from camera_calib.judge.validation import hold_out
from camera_calib.ports.dome import DomePort
from camera_calib.ports.none import NoPort
from camera_calib.rig import Rig, write_rig
from camera_calib.target_shape import (
    BOW_X,
    BOW_Y,
    SHEAR,
    STRETCH,
    TWIST,
    marker_lines,
)
from camera_calib.targets.target import Target

_CORNERS = (
    "view", "camera", "point", "x_px", "y_px", "residual_x_px", "residual_y_px", "weight",
)  # fmt: skip
_LEVELS = ("bad", "look", "good")
_ALIKE = 1.01
"""Noise over the least one, below which a housing explains the views as well."""


def warn_of_unseen(found: Detections) -> None:
    """Warn of each picture in which the target was not found."""
    for rejection in found.rejections:
        if rejection.points == 0:
            warn(f"view {rejection.view}, {rejection.camera}: {rejection.reason}; left out")


def write_results(folder: Path, calibration: Calibration, found: Detections) -> None:
    """Write `rig.json`, `calibration.json`, `corners.csv` and the report (docs/formats.md).

    What was left out, or is not determined, is a warning each.

    Args:
        folder: an existing folder.
        calibration: what was found.
        found: all views in which the target was seen, also those that took no part.
    """
    lost = [r for r in calibration.rejections if r.points]
    if lost:
        views = ", ".join(dict.fromkeys(r.view for r in lost))
        warn(f"{sum(r.points for r in lost)} points left out as outliers, of views {views}")
    for rejection in calibration.rejections:
        if not rejection.points:
            warn(f"view {rejection.view}, {rejection.camera} left out: {rejection.reason}")
    for line in calibration.warnings:
        warn(line)
    whole = replace(calibration, rejections=(*found.rejections, *calibration.rejections))
    write_rig(folder / "rig.json", whole.rig)
    CalibrationRecord.save(folder / "calibration.json", summary(whole))
    write_csv(folder / "corners.csv", _CORNERS, _corner_rows(whole, found.views))
    held = hold_out(whole.views, lambda views: recalibrate(whole, views), locate)
    write_report(folder, whole, held)


def summary(calibration: Calibration) -> dict[str, Any]:
    """A calibration's numbers as JSON values; lengths of residuals in pixels."""
    square = (calibration.residuals_px**2).sum(axis=-1)
    rig = calibration.rig
    covariance = rig.covariance
    names = list(rig.cameras)
    return {
        "source": rig.source,
        "rms_px": round(calibration.rms_px, 6),
        "noise_px": round(calibration.noise_px, 6),
        "worst_px": round(float(np.sqrt(np.nanmax(square))), 6),
        "views": len(calibration.views),
        "points": int(np.isfinite(square).sum()),
        "rms_px_by_camera": {c: _rms(square[:, i]) for i, c in enumerate(names)},
        "pictures": [
            {
                "view": view.name,
                "camera": camera,
                "points": int(np.isfinite(square[v, c]).sum()),
                "rms_px": _rms(square[v, c]),
            }
            for v, view in enumerate(calibration.views)
            for c, camera in enumerate(names)
            if camera in view.pixels
        ],
        "target_shape": {
            name: {"value": value, "sigma": sigma, "prior_sigma": prior}
            for (name, sigma), value, prior in zip(
                calibration.shape.sigmas.items(),
                calibration.shape.values.tolist(),
                calibration.shape.prior_sigmas.tolist(),
                strict=True,
            )
        },
        "corner_noise": _noise(calibration),
        "baseline_m": round(rig.baseline_m, 9) if len(names) > 1 else None,
        "held": "all parameters of the rig that are not listed",
        "with_prior": list(calibration.freedom.prior.parameters),
        "parameters": list(covariance.parameters) if covariance else [],
        "correlation": np.round(covariance.correlation, 6).tolist() if covariance else [],
        "rejections": [
            {"view": r.view, "camera": r.camera, "points": r.points, "reason": r.reason}
            for r in calibration.rejections
        ],
        "warnings": list(calibration.warnings),
    }


def _noise(calibration: Calibration) -> dict[str, Any] | None:
    """Parts of the corners' noise; pixels of the pictures of mean noise."""
    if calibration.spread is None:
        return None
    noise = calibration.spread.noise
    return {
        "alone_px": calibration.noise_px * noise.alone**0.5,
        "together_px": calibration.noise_px * float(noise.together.sum()) ** 0.5,
        "places_in_plane_m": noise.place_sigmas_m[0],
        "places_across_m": noise.place_sigmas_m[1],
    }


def _rms(square: Any) -> float:
    return round(float(np.sqrt(np.nanmean(square))), 6)


def _corner_rows(calibration: Calibration, measured: Sequence[TargetView]) -> Iterator[list[Any]]:
    """Every measured point; weight 0 and, in views without a pose, no residual if left out."""
    rig, points = calibration.rig, calibration.target_points
    pixels = stack_views(measured, rig, len(points))
    residuals, weights = np.full(pixels.shape, np.nan), np.zeros(pixels.shape[:3])
    numbers = {view.name: v for v, view in enumerate(calibration.views)}
    posed = [m for m, view in enumerate(measured) if view.name in numbers]
    at = [numbers[measured[m].name] for m in posed]
    poses = calibration.rig_from_target[at]
    residuals[posed] = residuals_px(rig, poses, points, pixels[posed])
    weights[posed] = np.nan_to_num(calibration.weights[at])
    names = list(rig.cameras)
    for m, c, i in np.argwhere(np.isfinite(pixels[..., 0])).tolist():
        values = [*pixels[m, c, i], *residuals[m, c, i], weights[m, c, i]]
        yield [measured[m].name, names[c], i, *(round(float(value), 5) for value in values)]


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
        *_housing_lines(calibration.housing),
    ]
    for name in rig.cameras:
        lines += _camera_lines(rig, name)
    lines += _verdict_lines(verdicts, len(calibration.warnings))
    return "\n".join(lines)


def _shape_lines(calibration: Calibration) -> Iterator[str]:
    """How the target differs from its drawing, and how much of the noise goes together."""
    shape = calibration.shape

    def in_words(name: str, scale: float) -> str:
        number, sigma = shape.value_and_sigma(name)
        return with_sigma(scale * number, scale * sigma)

    if shape.parameters:
        yield (
            f"target: bow over its width {in_words(BOW_X, 1e3)} mm, over its height "
            f"{in_words(BOW_Y, 1e3)} mm, twist {in_words(TWIST, 1e3)} mm; x over y longer by "
            f"{in_words(STRETCH, 1e2)} %, shear {in_words(SHEAR, 1e2)} %"
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


def _housing_lines(housing: HousingJudgement) -> list[str]:
    """What was compared, one line; nothing where nothing was."""
    if not housing.trials:
        return []
    shown = [
        f"{trial.port} {trial.noise_px:.4g} px" if not trial.why else f"{trial.port}: {trial.why}"
        for trial in housing.trials
    ]
    minimum = min(trial.noise_px for trial in housing.trials if not trial.why)
    alike = [trial.port for trial in housing.trials if trial.noise_px < _ALIKE * minimum]
    lines = [f"housing {housing.chosen}: noise with {', '.join(shown)}"]
    if set(alike) == {NoPort.shape, DomePort.shape}:
        lines.append("a dome about the pupil and no port are the same camera: both fit alike")
    elif len(alike) > 1:
        lines.append(
            f"{', '.join(alike)} fit alike: --start with a calibration in air tells them apart"
        )
    return lines


def _camera_lines(rig: Rig, name: str) -> Iterator[str]:
    camera, sigmas = rig.cameras[name], rig.sigmas

    def in_words(field: str, unit: str, scale: float = 1.0) -> str:
        number, sigma = scale * camera.parameter(field), sigmas.get(f"{name}.{field}")
        if sigma is None:
            return f"{number:.6g}{unit} (held)"
        return f"{with_sigma(number, scale * sigma)}{unit}"

    yield f"{name}: focal lengths {in_words('fx_px', ' px')}, {in_words('fy_px', ' px')}"
    if not camera.port.parameters:
        return
    parts = [
        label.format(in_words(field, " mm", 1e3) if field.endswith("_m") else in_words(field, ""))
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
