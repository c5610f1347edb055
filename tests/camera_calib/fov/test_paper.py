import json
from dataclasses import replace

import pytest

from alice_survey.core.config import CameraConfig
from camera_calib.fov.paper import PAPER_TABLE, PaperCheck, PaperValidation, validate_paper
from camera_calib.fov.table import FovChoices, fov_table

NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)


@pytest.fixture(scope="module")
def validation() -> PaperValidation:
    return validate_paper()


def test_all_six_values_of_the_papers_table_pass(validation: PaperValidation) -> None:
    computed = {(c.lens_mm, c.quantity): c.computed for c in validation.table}
    assert computed == pytest.approx(
        {
            (12.5, "horizontal"): 1.4268,
            (12.5, "vertical"): 1.1632,
            (12.5, "pixel"): 0.4439,
            (25.0, "horizontal"): 0.7411,
            (25.0, "vertical"): 0.5963,
            (25.0, "pixel"): 0.2220,
        },
        abs=5e-5,
    )
    assert [c.paper for c in validation.table] == ["1.4", "1.16", "0.45", "0.75", "0.6", "0.22"]
    assert all(c.passed for c in validation.table)


@pytest.mark.parametrize(
    ("printed", "tolerance", "passed"),
    [("1.2", 0.1, True), ("1.16", 0.01, True), ("1.18", 0.01, False), ("3", 1.0, False)],
)
def test_a_value_passes_within_one_unit_of_the_last_digit(
    printed: str, tolerance: float, passed: bool
) -> None:
    check = PaperCheck(lens_mm=12.5, quantity="vertical", unit="m", computed=1.1632, paper=printed)
    assert check.tolerance == pytest.approx(tolerance)
    assert check.difference == pytest.approx(1.1632 - float(printed))
    assert check.passed is passed


def test_the_validation_can_fail(
    monkeypatch: pytest.MonkeyPatch, validation: PaperValidation
) -> None:
    assert validation.passed
    claim = replace(validation.claims[0], maximum=60.0)
    assert not replace(validation, claims=(claim,)).passed
    monkeypatch.setattr(
        "camera_calib.fov.paper.PAPER_TABLE", (*PAPER_TABLE, (12.5, "vertical", "m", "1.18"))
    )
    assert not validate_paper().passed


def test_claims_depend_on_water_and_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit of 60 degrees, a focus behind thick water and exact matching do not hold."""
    monkeypatch.setattr("camera_calib.fov.paper.TRUSTED_FOV_DEG", 60.0)
    monkeypatch.setattr("camera_calib.fov.paper._N_PAPER", 1.10)
    monkeypatch.setattr("camera_calib.fov.paper.MATCH_SIGMA_PX", 0.01)
    failed = {c.claim for c in validate_paper().claims if not c.passed}
    assert failed == {
        "lenses of up to 60 deg: the 12.5 mm lens",
        "a flat port up to 60 deg avoids distortion",
        "focused at 2 m in water, 1.5 m in air",
        "F/4 gives a depth of field of 2 m at 2 m",
    }


def test_numbers_of_the_claims(validation: PaperValidation) -> None:
    computed = [claim.computed for claim in validation.claims]
    wanted = [65.23, 35.48, 0.061, 1.504, 1.519, 1.95, 2.02]
    assert computed == pytest.approx(wanted, abs=0.006)


def test_the_circle_of_confusion_that_gives_2_m() -> None:
    """10.86 um, the diagonal/1474, by the classical formula of the depth of field too."""
    coc_px = 10.86 / 3.69
    row = fov_table([12.5], [2.0], 1.33, NO_PORT, FovChoices(coc_px=coc_px))[0]
    assert row.depth_of_field_m == pytest.approx(2.0, abs=0.003)

    f, s, c = 12.5e-3, 2.0 / 1.33, 10.86e-6
    hyperfocal = f * f / (4.0 * c) + f
    near = s * (hyperfocal - f) / (hyperfocal + s - 2 * f)
    far = s * (hyperfocal - f) / (hyperfocal - s)
    assert row.depth_of_field_m == pytest.approx(1.33 * (far - near), abs=1e-6)


def test_one_pixel_gives_a_quarter_of_the_claimed_depth() -> None:
    row = fov_table([12.5], [2.0], 1.33, NO_PORT)[0]
    assert row.depth_of_field_m == pytest.approx(0.57, abs=0.005)


def test_json_holds_every_part(validation: PaperValidation) -> None:
    data = json.loads(json.dumps(validation.to_json(), allow_nan=False))
    assert data["passed"] is True
    assert [row["tolerance"] for row in data["table"]] == [0.1, 0.01, 0.01, 0.01, 0.1, 0.01]
    assert len(data["claims"]) == len(validation.claims)
    assert [row["fov_air_deg"] for row in data["angles"]] == [40, 50, 60, 70, 80, 90, 100, 110]
