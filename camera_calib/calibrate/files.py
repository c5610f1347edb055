"""The files that a calibration leaves: rig, numbers, corners and report."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import warn
from alice_survey.core.records import CalibrationRecord
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.solve import recalibrate
from camera_calib.calibrate.start import locate
from camera_calib.calibration import Calibration, TargetView, residuals_px, stack_views
from camera_calib.judge.report import write_report
from camera_calib.judge.validation import hold_out
from camera_calib.rig import write_rig

_CORNERS = (
    "view", "camera", "point", "x_px", "y_px", "residual_x_px", "residual_y_px", "weight",
)  # fmt: skip


def write_calibration(
    folder: Path, calibration: Calibration, measured: Sequence[TargetView]
) -> None:
    """Write `rig.json`, `calibration.json`, `corners.csv` and the report (docs/formats.md).

    Args:
        folder: an existing folder.
        calibration: what was found.
        measured: all views in which the target was seen, also those that took no part.
    """
    write_rig(folder / "rig.json", calibration.rig)
    CalibrationRecord.save(folder / "calibration.json", summary(calibration))
    write_csv(folder / "corners.csv", _CORNERS, _corner_rows(calibration, measured))
    _write_report(folder, calibration)


def _write_report(folder: Path, calibration: Calibration) -> None:
    held = hold_out(calibration.views, lambda views: recalibrate(calibration, views), locate)
    write_report(folder, calibration, held)


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


def warn_of_unseen(found: Detections) -> None:
    """Warn of each picture in which the target was not found."""
    for rejection in found.rejections:
        if rejection.points == 0:
            warn(f"view {rejection.view}, {rejection.camera}: {rejection.reason}; left out")


def finish(folder: Path, calibration: Calibration, found: Detections) -> Calibration:
    """Warn of what a calibration left out or did not determine, and write its files."""
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
    write_calibration(folder, whole, found.views)
    return whole
