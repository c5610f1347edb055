"""`report.json`: the numbers of a calibration report."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from alice_survey.kit.document import Verdict
from camera_calib.judge.judgement import CameraJudgement, Judgement
from camera_calib.judge.validation import LengthErrors

FORMAT = {"format": "alice-survey calibration report", "version": 1}


def report_json(judged: Judgement, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """All numbers as JSON values; what is not known is null."""
    calibration = judged.calibration
    return {
        **FORMAT,
        "source": calibration.rig.source,
        "views": len(calibration.views),
        "rms_px": _number(calibration.rms_px),
        "noise_px": _number(calibration.noise_px),
        "working_range_m": _number(judged.working_range_m),
        "warnings": list(calibration.warnings),
        "verdicts": [{"level": v.level, "text": v.text} for v in verdicts],
        "rejections": [asdict(rejection) for rejection in calibration.rejections],
        "parameters": [_rounded(asdict(p)) for p in judged.parameters],
        "baselines_m": {k: [_number(v), _number(s)] for k, (v, s) in judged.baselines_m.items()},
        "pictures": [picture.to_json() for picture in judged.pictures],
        "cameras": {name: _camera_json(c) for name, c in judged.cameras.items()},
        "stereo": [_rounded(asdict(s)) for s in judged.stereo],
        "lengths": _lengths_json(judged.lengths),
        "held_out": None if judged.hold_out is None else judged.hold_out.to_json(),
        "held_out_lengths": _lengths_json(judged.held_lengths),
    }


def _camera_json(camera: CameraJudgement) -> dict[str, Any]:
    test, halves = camera.homography, camera.halves
    return {
        "coverage": camera.coverage.to_json(),
        "residuals_by_radius": camera.profiles.radius.to_json(),
        "residuals_by_incidence_deg": camera.profiles.incidence.to_json(),
        "projection_sigma": [_rounded(asdict(r)) for r in camera.by_range],
        "homography": None
        if test is None
        else {
            "views": test.views,
            "inner_px": _number(test.inner_px),
            "outer_px": _number(test.outer_px),
            "outer_from_px": _number(test.outer_from_px),
            "by_radius": test.profile.to_json(),
        },
        "halves": None
        if halves is None
        else {"rms_px": _number(halves.rms_px), "expected_px": _number(halves.expected_rms_px)},
    }


def _lengths_json(lengths: LengthErrors | None) -> dict[str, Any] | None:
    if lengths is None:
        return None
    scale, sigma = lengths.scale_ppm()
    found: dict[str, Any] = {"scale_ppm": _number(scale), "scale_sigma_ppm": _number(sigma)}
    for key, long in (("long", True), ("neighbours", False)):
        rms, expected = lengths.rms_m(long)
        found[key] = {
            "count": int((lengths.long == long).sum()),
            "rms_m": _number(rms),
            "expected_m": _number(expected),
        }
    return found


def _number(number: float) -> float | None:
    return float(f"{number:.8g}") if np.isfinite(number) else None


def _rounded(data: Any) -> Any:
    if isinstance(data, float):
        return _number(data)
    if isinstance(data, dict):
        return {key: _rounded(item) for key, item in data.items()}
    return [_rounded(item) for item in data] if isinstance(data, list | tuple) else data
