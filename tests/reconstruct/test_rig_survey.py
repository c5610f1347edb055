"""A rig of four unlike cameras from pictures to a scored mosaic, and three of them alone."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.app.pipeline import run
from alice_survey.core.artefacts import read_json
from alice_survey.core.executor import local_executor
from alice_survey.core.records import PortRecord
from camera_calib.rig import Rig, read_rig
from reconstruct.evaluate.run import CameraScore
from tests.camera_calib.calibration_scenes import errors_over_sigmas
from tests.reconstruct.rig_calibration import calibrated_rig
from tests.reconstruct.rig_survey import (
    MOMENTS,
    RigScore,
    four_cameras,
    import_survey,
    placed,
    render_survey,
    score,
)

LINES = 2
NAMES = ("wide", "tele", "bow", "side")


def check_places(cameras: CameraScore, pixel_m: float, pictures: int) -> None:
    """Errors in ground pixels; a camera mounted 0.1 deg off puts them off by a whole one."""
    assert cameras.registered == cameras.total == pictures
    assert 0.005 < cameras.rms_m / pixel_m < 0.1
    assert abs(cameras.scale_error) < 5e-4
    assert np.rad2deg(cameras.truth_from_world.rotation.magnitude()) < 3.0


def check_surface(found: RigScore) -> None:
    surface = found.surface
    assert surface.completeness > 0.97
    assert 0.03 < np.sqrt(np.mean(surface.distance_m**2)) / found.pixel_m < 0.3
    ratio = surface.height_m[surface.sigma_m > 0] / surface.sigma_m[surface.sigma_m > 0]
    # White noise averages out within a cell too, which the sigmas do not count on.
    assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.8  # a calibration is one draw of what all share
    shifts = np.linalg.norm(found.mosaic.shifts_m, axis=1) / found.mosaic.pixel_m
    assert len(shifts) > 0.8 * found.mosaic.patches > 8
    assert 0.02 < np.sqrt(np.mean(shifts**2)) < 0.3


def check_calibration(folder: Path, rig: Rig) -> None:
    """Errors of what was found in pictures of a board, over its sigmas, and what is reported."""
    over = np.array(list(errors_over_sigmas(rig, four_cameras()).values()))
    assert len(over) == 12 + 12 + 12 + 11 + 3 * 6
    assert 0.6 < np.sqrt(np.mean(over**2)) < 1.4
    assert np.abs(over).max() < 4.0
    sigmas = rig.sigmas
    assert all(1e-6 < sigmas[f"{name}.x_m"] < 1e-4 for name in NAMES[1:])
    for medium in ("air", "water"):
        report = read_json(folder / medium / "report.json")
        assert not [v["text"] for v in report["verdicts"] if v["level"] == "bad"]
        assert set(report["baselines_m"]) == set(NAMES[1:])


@pytest.mark.slow
def test_four_cameras_are_calibrated_and_map_as_well_as_with_the_true_rig(tmp_path: Path) -> None:
    """Flat ports, domes, a fisheye, two look obliquely; then without the first, the reference.

    These have the surface: without the one that looks straight down, all kinds of lens and port.
    The true rig keeps the bounds and is not run: what was found must keep them too.
    """
    pictures = tmp_path / "pictures"
    render_survey(pictures, local_executor(), LINES)
    found = calibrated_rig(tmp_path, local_executor())
    check_calibration(tmp_path, read_rig(found))
    for names in (NAMES, NAMES[1:]):
        workspace = tmp_path / f"of_{len(names)}"
        import_survey(pictures, found, workspace, names)
        (workspace / "survey.toml").write_text("[reconstruct]\nmax_features = 1500\n")
        run(["mapping", "placing"], workspace, None)
        check_places(*placed(workspace, LINES), LINES * MOMENTS * len(names))
        port = PortRecord.read(workspace / "sparse" / "port.json")
        moves = np.subtract(port.after, port.before) / port.prior_sigmas
        assert 0.1 < np.sqrt(np.mean(moves**2)) < 1.2
        assert np.abs(moves).max() < 3.5
    run(["dense", "mosaic"], workspace, None)
    check_surface(score(workspace, LINES))
