import re
from pathlib import Path
from typing import Any

import pytest

from alice_survey.app.report.held import Held
from alice_survey.app.report.verdicts import facts, summary, verdicts
from alice_survey.app.stages import spec
from alice_survey.core.artefacts import write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.kit.document import Verdict
from camera_calib.rig import design_rig, write_rig
from tests.alice_survey.app.report.tiny import tiny_workspace


def judged(workspace: Path) -> tuple[Held, list[Verdict]]:
    held = Held.of(workspace)
    return held, verdicts(held)


def level_of(found: list[Verdict], word: str) -> str:
    levels = [verdict.level for verdict in found if word in verdict.text]
    assert len(levels) == 1, (word, [verdict.text for verdict in found])
    return levels[0]


def navigation(scale: float) -> dict[str, Any]:
    place = {f"{kind}_{axis}_m": 0.1 for kind in ("rms", "sigma") for axis in
             ("north", "east", "depth")}  # fmt: skip
    place |= {"sigma_heading_deg": 0.1, "sigma_tilt_deg": 0.1}
    return place | {"scale_of_navigation": scale, "scale_of_navigation_sigma": 0.001}


JOINT = {"stations": 7, "sigma_north_m": 0.03, "sigma_east_m": 0.04, "sigma_depth_m": 0.0,
         "sigma_tilt_deg": 0.1, "sigma_heading_deg": 0.2}  # fmt: skip


@pytest.mark.parametrize(
    ("sparse", "words", "level", "next_step"),
    [
        ({}, "95.8 % of the planned area", "look", "plan check"),
        ({"registered": 4}, "4 of 4", "good", ""), ({"registered": 3}, "3 of 4", "bad", ""),
        ({"joints": [JOINT]}, "7 stations show nothing that the others show", "look",
         "across the gap"),
        ({"joints": [JOINT]}, "sigma of 5", "look", ""),
        ({"scale_source": "scaled by one known length"}, "one known length", "look", "second"),
        ({"georeference": navigation(0.99)}, "navigation's differs", "look", ""),
        ({"georeference": navigation(0.999)}, "navigation's differs", "good", ""),
        ({"georeference": navigation(1.01)}, "navigation's differs", "look", ""),
    ],
)  # fmt: skip
def test_a_model_is_judged_and_the_next_step_named(
    tmp_path: Path, sparse: dict[str, Any], words: str, level: str, next_step: str
) -> None:
    held, found = judged(tiny_workspace(tmp_path, sparse=sparse))
    assert level_of(found, words) == level
    assert next_step in summary(held, found)["What to do next"]


def test_a_lens_of_the_survey_itself_needs_a_check_from_outside(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    assert level_of(judged(workspace)[1], "lens: ") == "look"
    point = {"name": "A", "use": "check", "misfit_sigmas": 1.0, "views": 3}
    point |= dict.fromkeys(("north_m", "east_m", "down_m"), 0.01)
    control = {"points": [point], "bars": [], "not_found": {}, "rms": {}}
    write_json(workspace / "sparse" / "control.json", control)
    assert level_of(judged(workspace)[1], "lens: ") == "good"
    config = SurveyConfig()
    write_rig(workspace / "images" / "rig.json", design_rig(config.camera, config.water))
    assert not any("lens: " in verdict.text for verdict in judged(workspace)[1])


def test_a_scale_of_navigation_beyond_reason_has_few_digits(tmp_path: Path) -> None:
    georeference = navigation(1.785e136)
    tiny_workspace(tmp_path, sparse={"scale_source": "the rig", "georeference": georeference})
    text = spec("placing").summary(tmp_path / "sparse")[0]
    assert "e+136" in text and not re.search(r"\d{9}", text)


def test_a_model_without_scale_is_bad_and_says_what_to_do(tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        "frame": {"scaled": False},
        "sparse": {"scale_source": "the model has no scale"},
    }
    held, found = judged(tiny_workspace(tmp_path, **changes))
    assert found[0].level == "bad" and "no scale" in found[0].text
    assert "scale bar" in summary(held, found)["What to do next"]
    assert any("unit" in value for _, value in facts(held))


@pytest.mark.parametrize(
    ("miss_mm", "ratio", "lean", "levels"),
    [(0.5, 1.1, 0.3, ("good", "good")), (5.0, 1.1, -0.3, ("bad", "good")),
     (0.5, 3.4, 0.0, ("good", "look")), (0.5, 0.3, 0.0, ("good", "look")),
     (0.5, 1.0, -0.77, ("good", "look"))],
)  # fmt: skip
def test_errors_are_judged_by_the_pixel_and_by_their_sigmas(
    tmp_path: Path, miss_mm: float, ratio: float, lean: float, levels: tuple[str, str]
) -> None:
    workspace = tiny_workspace(tmp_path)
    write_json(workspace / "evaluation" / "stage.json", {"took_s": 1.0})
    write_json(workspace / "evaluation" / "score.json", {
        "cameras": {
            "registered": 4, "total": 4, "rms_mm": 0.3, "max_mm": 0.5, "scale_error_ppm": 50.0,
        },
        "mosaic": {}, "lengths": {},
        "surface": {
            "distance_rms_mm": miss_mm, "ground_pixel_mm": 1.8, "doming": {"dome_mm": 0.1},
            "error_over_sigma": {"rms": ratio, "median": lean},
            "completeness_within_px": {"3": 0.99},
        },
    })  # fmt: skip
    _, found = judged(workspace)
    assert (level_of(found, "against the truth"), level_of(found, "stated sigmas")) == levels


def test_every_verdict_that_is_not_good_says_what_to_do(tmp_path: Path) -> None:
    workspace = tiny_workspace(
        tmp_path,
        sparse={
            "registered": 1,
            "scale_source": "scale from the calibrated rig",
            "acceptance": {"notes": ["stations lie elsewhere"]},
            "doming": {"along": None, "across": None, "scale": None, "notes": ["it is bent"]},
        },
        mapping={"refraction": {"settled": False}},
    )
    _, found = judged(workspace)
    asked = [verdict for verdict in found if verdict.level != "good"]
    assert len(asked) >= 5
    assert all(verdict.action for verdict in asked)
