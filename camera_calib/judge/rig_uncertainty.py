"""Effects of a calibrated rig's covariance, as a table for the command line."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.errors import CalibrationError
from alice_survey.core.text_table import text_table
from alice_survey.kit.words import with_sigma
from camera_calib.judge.judgement import over_frame, rig_parameters
from camera_calib.judge.uncertainty import (
    baseline_sigma_m,
    compensation,
    frame_points,
    projection_sigma,
    stereo_sigma,
)
from camera_calib.rig import read_rig

RANGES_M = (0.5, 1.0, 2.0, 4.0, 8.0)
_GRID = 11


def uncertainty_report(
    path: Path, ranges_m: list[float] | None, near_m: float, far_m: float, noise_px: float
) -> tuple[str, dict[str, Any]]:
    """Sigmas of parameters, projections and stereo of a rig, as text and as JSON values.

    Args:
        path: `rig.json` with a covariance.
        ranges_m: distances to evaluate; `RANGES_M` if none.
        near_m: nearest distance of the points that poses are estimated from.
        far_m: farthest.
        noise_px: noise of one measured coordinate, for comparison.

    Raises:
        CalibrationError: the rig has no covariance, or the distances are not in order.
    """
    wrong = [r for r in ranges_m or [] if not 0 < r < math.inf]
    if wrong:
        raise CalibrationError(f"--range {wrong[0]:g} m: distances are positive and finite")
    if not 0 < near_m <= far_m < math.inf:
        raise CalibrationError(
            f"poses are found from {near_m:g} to {far_m:g} m: near must be positive and not beyond "
            "far, which is finite"
        )
    rig, ranges = read_rig(path), ranges_m or list(RANGES_M)
    parameters = [p for p in rig_parameters(rig) if p.sigma is not None]
    rows = [
        (p.name, with_sigma(p.value, p.sigma), p.unit, f"{p.most_alike} {p.correlation:+.2f}")
        for p in parameters
        if p.sigma is not None
    ]
    parts = [text_table(("parameter", "value", "unit", "goes most with"), rows)]
    baselines = {}
    for name, pose in rig.cam_from_rig.items():
        if name != rig.reference:
            length_m = float(np.linalg.norm(pose.translation))
            baselines[name] = [length_m, baseline_sigma_m(rig, name)]
            millimetres = with_sigma(1e3 * length_m, 1e3 * baselines[name][1])
            parts.append(f"{rig.reference} to {name}: {millimetres} mm")
    maps = {}
    lines = []
    middle = tuple(np.geomspace(near_m, far_m, 4).tolist())
    for name, camera in rig.cameras.items():
        compensating = compensation(rig, name, frame_points(camera, middle))
        pixels = camera.frame_grid(_GRID, _GRID)
        found = [
            over_frame(r, projection_sigma(rig, name, pixels, r, compensating)) for r in ranges
        ]
        maps[name] = found
        lines += [
            (
                name,
                f"{sigma.range_m:g}",
                f"{sigma.compensated_median_px:.3f}",
                f"{sigma.compensated_worst_px:.3f}",
                f"{sigma.plain_median_px:.3f}",
                f"{sigma.plain_worst_px:.3f}",
            )
            for sigma in found
        ]
    header = ("camera", "at m", "best pose px", "worst", "held still px", "worst")
    parts.append("one sigma of a projection over the frame\n" + text_table(header, lines))
    data: dict[str, Any] = {
        "parameters": parameters,
        "baselines_m": baselines,
        "projection_sigma": maps,
    }
    if len(rig.cameras) > 1:
        stereo = [stereo_sigma(rig, r, noise_px) for r in ranges]
        data["stereo"] = stereo
        lines = [
            (
                f"{s.range_m:g}",
                _mm(s.point_m[2]),
                _mm(s.worst_shape_m),
                _mm(s.noise_m[2]),
                f"{s.length_m:.2f}",
                _mm(s.length_sigma_m),
            )
            for s in stereo
        ]
        header = (
            "at m",
            "depth mm",
            "shape mm",
            f"{noise_px:g} px noise mm",
            "length m",
            "sigma mm",
        )
        parts.append("one sigma of stereo by calibration alone\n" + text_table(header, lines))
    return "\n\n".join(parts), json_values(data)


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.3g}"
