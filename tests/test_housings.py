"""Surveys through other housings than a flat port, from the plan to the mesh."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.app.pipeline import run
from alice_survey.core.artefacts import read_json
from benchmarks import draws
from benchmarks.reconstruct_surveys import demo_like
from camera_calib.calibrate import from_pictures
from camera_calib.calibrate.detect_views import Detections, detect_views
from camera_calib.calibrate.options import CalibrateOptions
from camera_calib.rig import read_rig
from tests.small_survey import settings_in

pytestmark = pytest.mark.slow

DOME = """
focal_mm = 16.75
port = "dome"
dome_radius_m = 0.08
dome_centre_m = [0.0, 0.0, 0.005]
glass_thickness_m = 0.006
n_glass = 1.49
"""
BOARD = "chessboard 11x8 40mm"


def pool_as(workspace: Path, output: Path, port: str | None, **more: Any) -> list[str]:
    """What is bad in a calibration from the pool's pictures."""
    pool = workspace / "pool" if port else workspace / "pool" / "air"
    glass: dict[str, Any] = (
        {"glass_mm": "6", "n_glass": "1.49"} if port in ("flat", "dome", "auto") else {}
    )
    from_pictures.calibrate_pictures(
        CalibrateOptions(
            cameras=(f"left={pool / 'left'}", f"right={pool / 'right'}"), target=BOARD,
            output=output,
            water=port is not None, port=port, **glass, **more,
        )
    )  # fmt: skip
    verdicts = read_json(output / "report.json")["verdicts"]
    return [verdict["text"] for verdict in verdicts if verdict["level"] == "bad"]


def test_no_other_port_passes_for_a_dome_off_its_centre(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The board is looked for once in each picture; the finer the picture, the surer the port."""
    found: dict[str, Detections] = {}

    def detect(pictures: Any, *rest: Any) -> Detections:
        found[str(pictures)] = found.get(str(pictures)) or detect_views(pictures, *rest)
        return found[str(pictures)]

    monkeypatch.setattr(from_pictures, "detect_views", detect)
    settings = f"{demo_like(1.3, 1.3)}\n[camera]\n{DOME}"
    workspace = settings_in(tmp_path / "fine", settings)
    run(["pool"], workspace, None)
    assert not pool_as(workspace, tmp_path / "air", None)
    start = {"start": tmp_path / "air" / "rig.json"}
    dome = {"dome_radius_mm": "80", **start}
    assert any("flat port of" in text for text in pool_as(workspace, tmp_path / "flat", "flat"))
    bare = pool_as(workspace, tmp_path / "bare", "none", **start)
    assert any("from its prior" in text for text in bare)
    assert not pool_as(workspace, tmp_path / "auto", "auto", **dome)
    rig = read_rig(tmp_path / "auto" / "rig.json")
    assert {camera.port.shape for camera in rig.cameras.values()} == {"dome"}


@pytest.mark.parametrize(
    ("kind", "side_m", "scale"), [("dome", (1.3, 1.3), 8), ("fisheye", (3.6, 3.2), 12)]
)
def test_a_survey_with_a_drawn_calibration_errs_by_what_it_states(
    kind: str, side_m: tuple[float, float], scale: int, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """From the plan to the mesh; most of an error is the calibration's, of which this is a draw."""
    monkeypatch.setitem(draws.KINDS, kind, (*side_m, draws.KINDS[kind][2]))
    monkeypatch.setattr(draws, "_SCALE", scale)
    workspace = tmp_path / kind
    row = draws.survey(workspace, kind, 3)
    assert row["pictures"] == row["of"] >= 20
    for name in (draws.HEIGHT, draws.MEAN, draws.SCALE):
        assert abs(row[name]) < 4.0
    assert 0.2 < row[draws.SURFACE] < 4.0
    for name in (draws.BEFORE, draws.RIG):
        over = np.abs([*row[name].values()])
        assert len(over) >= 28
        assert 0.3 < np.sqrt(np.mean(over**2)) < 2.2
        assert over.max() < 5.0
    run(["mosaic", "mesh", "evaluate"], workspace, None)
    score = read_json(workspace / "evaluation" / "score.json")
    pixel_mm, surface_mm = (score["surface"][n] for n in ("ground_pixel_mm", "distance_rms_mm"))
    assert 0.01 < score["cameras"]["rms_mm"] / pixel_mm < 0.5
    assert 0.05 < surface_mm / pixel_mm < 1.0
    north_m, east_m, _ = score["cameras"]["georeference_north_east_down_m"]
    missed = abs(north_m) / side_m[0] + abs(east_m) / side_m[1]  # strips at edges, by navigation
    assert score["surface"]["completeness"] > 0.99 - missed
    assert 0.02 < score["mosaic"]["position_rms_px"] < 0.3
    assert 0.7 < score["mesh"]["distance_rms_mm"] / surface_mm < 2.0
