"""Tables that the command line prints."""

from pathlib import Path
from typing import Any

from alice_survey.config import CameraConfig, load_config


def fov_report(
    lenses_mm: list[float] | None,
    altitudes_m: list[float] | None,
    n_water: float,
    survey: Path | None,
) -> tuple[str, Any, bool]:
    """FOV and resolution as text and JSON values; what is not given is the paper's."""
    from camera_calib.fov import format_fov, fov_table

    camera = CameraConfig() if survey is None else load_config(survey).camera
    rows = fov_table(lenses_mm or [12.5, 25.0], altitudes_m or [2.0], n_water, camera)
    return format_fov(rows), [row.to_json() for row in rows], True


def validation_report() -> tuple[str, Any, bool]:
    """The comparison with the paper's table, and whether every value passed."""
    from camera_calib.fov import format_checks, validate_paper_table

    checks = validate_paper_table()
    return (
        format_checks(checks),
        [check.to_json() for check in checks],
        all(check.passed for check in checks),
    )
