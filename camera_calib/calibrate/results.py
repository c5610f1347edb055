"""What a calibration leaves: rig, numbers, corners and report as files, and a few lines of text."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values, write_csv
from alice_survey.core.errors import warn
from alice_survey.core.records import CalibrationRecord
from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.solve import recalibrate
from camera_calib.calibrate.start import locate
from camera_calib.calibration import Calibration, TargetView, residuals_px, stack_views
from camera_calib.judge.report import write_report
from camera_calib.judge.uncertainty import (
    baselines_m,
    parameter_table,
    rig_parameters,
    shape_parameters,
)
from camera_calib.judge.validation import halves_agreement, hold_out
from camera_calib.ports.dome import DomePort
from camera_calib.ports.none import NoPort
from camera_calib.rig import Rig, write_rig
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


def write_results(folder: Path, calibration: Calibration, found: Detections) -> Calibration:
    """Write `rig.json`, `calibration.json`, `corners.csv` and the report (docs/formats.md).

    What was left out, or is not determined, is a warning each. Sigmas are widened where either half
    of the views gives another calibration than the sigmas allow.

    Args:
        folder: an existing folder.
        calibration: what was found.
        found: all views in which the target was seen, also those that took no part.

    Returns:
        The calibration as written.
    """
    held = hold_out(calibration.views, lambda views: recalibrate(calibration, views), locate)
    if held is not None and held.halves is not None:
        calibration = _widen(calibration, halves_agreement(held.halves).widening)
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
    write_report(folder, whole, held)
    return whole


def _widen(calibration: Calibration, factor: float) -> Calibration:
    """Sigmas times a factor, except for what both halves of the views have in common."""
    covariance = calibration.rig.covariance
    if factor == 1.0 or covariance is None:
        return calibration
    common = calibration.shared @ calibration.shared.T
    matrix = common + factor**2 * (covariance.matrix - common)
    rig = replace(calibration.rig, covariance=replace(covariance, matrix=matrix))
    line = f"halves of the views disagree: the rig's sigmas are {factor:.2f} times as large"
    return replace(calibration, rig=rig, warnings=(*calibration.warnings, line))


def summary(calibration: Calibration) -> dict[str, Any]:
    """A calibration's numbers as JSON values; lengths of residuals in pixels."""
    square = (calibration.residuals_px**2).sum(axis=-1)
    rig = calibration.rig
    covariance = rig.covariance
    return {
        "source": rig.source,
        "rms_px": round(calibration.rms_px, 6),
        "noise_px": round(calibration.noise_px, 6),
        "worst_px": round(float(np.sqrt(np.nanmax(square))), 6),
        "views": len(calibration.views),
        "points": int(np.isfinite(square).sum()),
        "rms_px_by_camera": {c: _rms(square[:, i]) for i, c in enumerate(rig.cameras)},
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
        "baseline_m": round(rig.baseline_m, 9) if len(rig.cameras) > 1 else None,
        "with_prior": list(calibration.freedom.prior.parameters),
        "parameters": list(covariance.parameters) if covariance else [],
        "correlation": np.round(covariance.correlation, 6).tolist() if covariance else [],
        "rejections": json_values(calibration.rejections),
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
    """What is bad, fit, baselines, housing, focal lengths, ports and verdicts.

    Args:
        calibration: with its rig's covariance.
        target: its squares or tags set the scale of the baseline.
        verdicts: `level` and `text` of each, the worst first, as in `report.json`.
    """
    rig, square = calibration.rig, (calibration.residuals_px**2).sum(axis=-1)
    ports = {
        f"{name}.{one}" for name, camera in rig.cameras.items() for one in camera.port.parameters
    }
    shown = [
        one for one in rig_parameters(rig)
        if one.name in ports or one.name.rpartition(".")[2] in ("fx_px", "fy_px")
    ]  # fmt: skip
    bends = [one for one in shape_parameters(calibration.shape) if ".bend_" not in one.name]
    return "\n".join(
        [
            *(f"bad: {verdict['text']}" for verdict in verdicts if verdict["level"] == "bad"),
            f"{len(calibration.views)} views, {int(np.isfinite(square).sum())} points, "
            f"{calibration.rms_px:.3f} px rms (noise {calibration.noise_px:.3f} px)",
            *_baseline_lines(rig, target),
            *_trial_lines(calibration),
            parameter_table([*shown, *bends]),
            *_verdict_lines(verdicts, len(calibration.warnings)),
        ]
    )


def _baseline_lines(rig: Rig, target: Target) -> Iterator[str]:
    for name, (length_m, sigma_m) in baselines_m(rig).items():
        unit = "tags" if target.kind == "apriltag" else "squares"
        to = f" from {rig.reference} to {name}" if len(rig.cameras) > 2 else ""
        yield (
            f"baseline{to} {with_sigma(1e3 * length_m, 1e3 * sigma_m)} mm = "
            f"{with_sigma(length_m / target.size_m, sigma_m / target.size_m)} {unit} of "
            f"{1e3 * target.size_m:g} mm"
        )


def _trial_lines(calibration: Calibration) -> Iterator[str]:
    """Housings and lenses that were compared, and which fit alike."""
    trials = calibration.housing_trials
    if not trials:
        return
    chosen = min(trials, key=lambda one: one.criterion)
    names = {one: f"{one.port} with {one.lens}" for one in trials}
    shown = [f"{names[one]}: {one.why or f'{one.noise_px:.4g} px'}" for one in trials]
    yield f"likeliest is {names[chosen]}; noise: {', '.join(shown)}"
    minimum = min(one.noise_px for one in trials if not one.why)
    alike = [one.port for one in trials if one.noise_px < _ALIKE * minimum]
    if set(alike) == {NoPort.shape, DomePort.shape}:
        yield "a dome about the pupil and no port are the same camera: both fit alike"
    elif len(set(alike)) > 1:
        yield f"{', '.join(alike)} fit alike: --start with a calibration in air tells them apart"


def _verdict_lines(verdicts: Sequence[Mapping[str, str]], warnings: int) -> Iterator[str]:
    counts = Counter(verdict["level"] for verdict in verdicts)
    words = [f"{counts[level]} {level}" for level in _LEVELS if counts[level]]
    yield f"verdicts: {', '.join(words)}; {warnings} warnings"
    for verdict in verdicts:
        if verdict["level"] == "look":
            yield f"  look: {verdict['text']}"
