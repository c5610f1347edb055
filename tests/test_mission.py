"""The mission that the project is for, whole: plan, fly, image, calibrate, reconstruct, evaluate.

Bounds on both sides around closed forms of the paper's numbers, and around what was measured when
this was written (in brackets). They are not to be loosened: the simulated truth, not the program,
says how far each result may be off.
"""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PIXEL_M, FOCAL_M, N_WATER = 3.69e-6, 12.5e-3, 1.34
ALTITUDE_M, SPEED_MPS = 2.0, 0.2
PICTURE_PX = (3384, 2710)
SCALE = 6
"""The survey's pictures have a sixth of the camera's resolution."""

pytestmark = pytest.mark.slow


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_the_mission(small_survey: Path) -> None:
    the_plan_images_the_area(read(small_survey / "plan" / "plan.json"))
    the_flight_follows_it(read(small_survey / "flight" / "flight.json"))
    the_rig_is_found(read(small_survey / "calibration" / "rig.json"))
    the_survey_is_right(read(small_survey / "evaluation" / "score.json"))
    the_paper_is_confirmed()


def the_plan_images_the_area(plan: dict[str, Any]) -> None:
    along_m = plan["details"]["imaging"]["footprint_along_m"]
    across_m = plan["details"]["imaging"]["footprint_across_m"]
    pixel_m = ALTITUDE_M * PIXEL_M / (FOCAL_M * N_WATER)  # paraxial, of a port without thickness
    assert 0.99 < plan["coverage"] <= 1
    corner_m = corner_on_the_floor_m()
    assert across_m == pytest.approx(2 * corner_m[0], rel=1e-3)
    assert along_m == pytest.approx(2 * corner_m[1], rel=1e-3)
    assert plan["interval_s"] == pytest.approx(along_m * (1 - 0.6) / SPEED_MPS, rel=2e-3)
    assert plan["forward_overlap"] == pytest.approx(0.6, abs=1e-3)
    assert plan["line_spacing_m"] == pytest.approx(across_m * (1 - plan["side_overlap"]), rel=1e-3)
    # One pixel of blur from speed and attitude rates: 0.8 to 0.85 of the time from speed alone.
    max_exposure_s = pixel_m / SPEED_MPS
    assert 0.78 * max_exposure_s < plan["exposure_s"] < 0.88 * max_exposure_s
    assert plan["details"]["imaging"]["blur_px"] == pytest.approx(1, abs=0.01)
    # The strobes burn while the shutter is open, and a lead of 0.2 ms before and after it.
    strobe = plan["strobe"]
    assert strobe["lead_s"] == pytest.approx(2e-4, rel=1e-6)
    assert strobe["pulse_s"] == pytest.approx(plan["exposure_s"] + 2 * strobe["lead_s"], rel=1e-3)
    assert 0.0009 < plan["details"]["imaging"]["strobe_duty"] < 0.0011


def corner_on_the_floor_m() -> tuple[float, float]:
    """Where a picture's corner looks, by Snell's law at both faces of the nominal flat port."""
    x, y = (count * PIXEL_M / 2 for count in PICTURE_PX)
    in_air = math.atan(math.hypot(x, y) / FOCAL_M)
    glass, water = (math.asin(math.sin(in_air) / n) for n in (1.52, N_WATER))
    away_m = 0.02 * math.tan(in_air) + 0.01 * math.tan(glass) + ALTITUDE_M * math.tan(water)
    return away_m * x / math.hypot(x, y), away_m * y / math.hypot(x, y)


def the_flight_follows_it(flight: dict[str, Any]) -> None:
    on_lines = flight["on_lines"]
    assert flight["ending"] == "complete"
    assert flight["stations"] == flight["stations_planned"] == 15
    assert 0.002 < on_lines["believed_cross_track_rms_m"] < 0.02  # [0.008]
    assert on_lines["heading_rms_deg"] < 1  # [0.40]
    assert 0.01 < flight["navigation_error_rms_m"] < 0.2  # [0.063]
    assert flight["coverage"]["every_camera_share"] > 0.99


def the_rig_is_found(rig: dict[str, Any]) -> None:
    """The port's distance is known to 2 mm from twelve small views; sigmas cover the truth."""
    right = rig["cameras"]["right"]
    assert math.hypot(*right["cam_from_rig"]["translation_m"]) == pytest.approx(0.1, abs=2e-4)
    for name, camera in rig["cameras"].items():
        sigmas = rig["sigmas"]
        assert camera["fx_px"] == pytest.approx(FOCAL_M / PIXEL_M / SCALE, rel=5e-3)
        assert 1e-4 < sigmas[f"{name}.port_distance_m"] < 5e-3
        assert abs(camera["port_distance_m"] - 0.02) < 4 * sigmas[f"{name}.port_distance_m"]


def the_survey_is_right(score: dict[str, Any]) -> None:
    cameras, surface, mosaic = score["cameras"], score["surface"], score["mosaic"]
    pixel_mm = surface["ground_pixel_mm"]
    assert 2.5 < pixel_mm < 2.8  # [2.66]
    assert cameras["registered"] == cameras["total"] == 30
    assert 0.05 < cameras["rms_mm"] < 0.8  # [0.47]
    assert abs(cameras["scale_error_ppm"]) < 400  # [118]
    assert cameras["attitude_rms_deg"] < 0.02  # [0.008]
    assert surface["completeness"] > 0.995  # [0.999]
    assert 0.2 < surface["distance_median_mm"] < 0.6 * pixel_mm  # [1.08]
    assert surface["distance_rms_mm"] < 0.75 * pixel_mm  # [1.22]
    # Most of a sigma is shared by all cells (rig and poses), and a survey is one draw of it.
    assert 0.4 < surface["error_over_sigma"]["rms"] < 1.8  # [0.64]
    assert abs(surface["doming"]["dome_mm"]) < 5 * surface["doming"]["sigma_mm"] < 0.5
    assert mosaic["coverage"] > 0.99  # [0.998]
    assert 0.02 < mosaic["position_median_mm"] < 0.2 * pixel_mm  # [0.22]
    assert 0.02 < score["lengths"]["rms_mm"] < 0.6  # [0.26]
    assert score["overlaps"]["forward_mean"] == pytest.approx(0.6, abs=0.04)


def the_paper_is_confirmed() -> None:
    """Table of the field of view: in-air optics scaled by 1.33, and what the command answers."""
    run = subprocess.run(
        [sys.executable, "-m", "alice_survey", "fov", "--validate", "--json"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    answer = json.loads(run.stdout)
    assert answer["passed"]
    rows = {(row["lens_mm"], row["quantity"]): row["computed"] for row in answer["table"]}
    for lens_mm in (12.5, 25.0):
        for quantity, count in (("horizontal", PICTURE_PX[0]), ("vertical", PICTURE_PX[1])):
            in_air = math.atan(count * PIXEL_M / 2 / (lens_mm / 1000))
            in_water = math.asin(math.sin(in_air) / 1.33)
            expected_m = 2 * ALTITUDE_M * math.tan(in_water)
            assert rows[lens_mm, quantity] == pytest.approx(expected_m, rel=1e-4)
    assert 0.40 < rows[12.5, "pixel"] < 0.46
    assert 0.20 < rows[25.0, "pixel"] < 0.23
