"""A rig of four unlike cameras from pictures to a scored mosaic, and three of them alone."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.base.executor import local_executor
from alice_survey.survey import run
from tests.reconstruct.rig_survey import (
    MOMENTS,
    RigScore,
    command,
    import_survey,
    render_survey,
    score,
)

LINES = 2
NAMES = ("wide", "tele", "bow", "side")


def check(found: RigScore, pictures: int) -> None:
    """Errors in ground pixels; a camera mounted 0.1 deg off puts them off by a whole one."""
    assert found.cameras.registered == found.cameras.total == pictures
    assert 0.005 < found.cameras.rms_m / found.pixel_m < 0.1
    assert abs(found.cameras.scale_error) < 5e-4
    surface = found.surface
    assert surface.completeness > 0.97
    assert 0.03 < np.sqrt(np.mean(surface.distance_m**2)) / found.pixel_m < 0.3
    ratio = surface.height_m[surface.sigma_m > 0] / surface.sigma_m[surface.sigma_m > 0]
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.5
    shifts = np.linalg.norm(found.mosaic.shifts_m, axis=1) / found.mosaic.pixel_m
    assert len(shifts) > 0.8 * found.mosaic.patches > 8
    assert 0.02 < np.sqrt(np.mean(shifts**2)) < 0.3


@pytest.mark.slow
def test_four_cameras_and_three_of_them_map_to_the_same_truth(tmp_path: Path) -> None:
    """Flat ports, domes, a fisheye, two look obliquely; then without the first, the reference."""
    pictures = tmp_path / "pictures"
    render_survey(pictures, local_executor(), LINES)
    for names in (NAMES, NAMES[1:]):
        workspace = tmp_path / "-".join(names)
        said = import_survey(pictures, workspace, names)
        assert f" of {', '.join(names[:-1])} and {names[-1]}" in said
        (workspace / "survey.toml").write_text("[reconstruct]\nmax_features = 3000\n")
        run(["mapping", "placing", "dense", "mosaic"], workspace, None)
        check(score(workspace, LINES), LINES * MOMENTS * len(names))
    workspace = tmp_path / "-".join(NAMES)
    command("report", "-w", workspace)
    report = (workspace / "report" / "report.html").read_text()
    assert "as imported with the pictures" in report
    assert all(word in report for word in (*NAMES, "fisheye", "dome of 80 mm radius"))
