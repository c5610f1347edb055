import json
from dataclasses import replace

import pytest

from alice_survey.base.config import CameraConfig
from camera_calib.fov.paper import (
    Validation,
    coc_for_depth_of_field_px,
    last_digit,
    validate_paper,
    validate_paper_table,
)
from camera_calib.fov.table import FovChoices, fov_table

NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)


@pytest.fixture(scope="module")
def validation() -> Validation:
    return validate_paper()


def test_all_six_values_of_the_papers_table_pass() -> None:
    checks = validate_paper_table()

    computed = {(c.lens_mm, c.quantity): c.computed for c in checks}
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
    assert [c.paper for c in checks] == ["1.4", "1.16", "0.45", "0.75", "0.6", "0.22"]
    assert all(c.passed for c in checks)
    for check in checks:
        assert check.difference == pytest.approx(check.computed - float(check.paper))


def test_the_paper_s_roundings_are_told() -> None:
    notes = {(c.lens_mm, c.quantity): c.note for c in validate_paper_table()}

    assert "rounds to 0.44; the paper prints 0.45" in notes[(12.5, "pixel")]
    assert "rounds to 0.74; the paper prints 0.75" in notes[(25.0, "horizontal")]
    assert "prints" not in notes[(12.5, "vertical")]


def test_the_check_can_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "camera_calib.fov.paper.PAPER_TABLE",
        ((12.5, "vertical", "m", "1.18"), (12.5, "vertical", "m", "1.2")),
    )

    assert [c.passed for c in validate_paper_table()] == [False, True]
    assert not validate_paper().passed


@pytest.mark.parametrize(("printed", "unit"), [("1.4", 0.1), ("1.16", 0.01), ("3", 1.0)])
def test_the_last_digit_printed(printed: str, unit: float) -> None:
    assert last_digit(printed) == pytest.approx(unit)


def test_a_claim_with_a_rule_can_fail(validation: Validation) -> None:
    ruled = next(c for c in validation.claims if c.rule)
    broken = replace(validation, claims=(replace(ruled, holds=False),))
    assert validation.passed
    assert not broken.passed
    assert replace(validation, claims=(replace(ruled, holds=False, rule=""),)).passed


def test_claims_fail_when_the_numbers_do_not_bear_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A depth of field of 3 m, a limit of 60 degrees and a focus behind thick water do not hold."""
    monkeypatch.setattr("camera_calib.fov.paper._DEPTH_OF_FIELD_M", 3.0)
    monkeypatch.setattr("camera_calib.fov.table.TRUSTED_FOV_DEG", 60.0)
    monkeypatch.setattr("camera_calib.fov.paper._N_PAPER", 1.10)
    monkeypatch.setattr("camera_calib.fov.paper.MATCH_SIGMA_PX", 0.01)
    failed = {c.claim for c in validate_paper().claims if not c.passed}
    assert failed == {
        "lenses of up to 70 deg: the 12.5 mm lens",
        "a flat port up to 70 deg avoids distortion",
        "focused at 2 m in water, 1.5 m in air",
        "F/4 gives a depth of field of 2 m at 2 m",
    }


def test_what_holds_and_what_does_not_is_told_with_its_assumption(validation: Validation) -> None:
    verdicts = [(c.claim, c.holds) for c in validation.claims]
    assert all(c.assumption and c.computed for c in validation.claims)

    def holds(start: str) -> list[bool]:
        return [truth for claim, truth in verdicts if claim.startswith(start)]

    assert holds("lenses of up to 70") == [True, True]
    assert holds("a flat port up to 70") == [False, True]  # bare; warped
    assert holds("70 deg is a limit") == [False]
    assert holds("focused at 2 m in water") == [True, True]
    assert holds("focused at 2 m: the whole frame") == [False]
    # Customary twice, solved for twice, 1 px, whole frame, 25 mm.
    assert holds("F/4") == [True, True, True, True, False, False, False]
    assert holds("3 ms") == [False, False]


def test_the_circle_of_confusion_that_gives_2_m() -> None:
    """10.9 um, by the classical formula of the depth of field too."""
    coc_px = coc_for_depth_of_field_px(2.0, 12.5, 1.33, NO_PORT)
    assert coc_px * 3.69 == pytest.approx(10.86, abs=0.02)
    row = fov_table([12.5], [2.0], 1.33, NO_PORT, FovChoices(coc_px=coc_px))[0]
    assert row.depth_of_field_m == pytest.approx(2.0, abs=1e-6)

    f, s, c = 12.5e-3, 2.0 / 1.33, coc_px * 3.69e-6
    hyperfocal = f * f / (4.0 * c) + f
    near = s * (hyperfocal - f) / (hyperfocal + s - 2 * f)
    far = s * (hyperfocal - f) / (hyperfocal - s)
    assert 1.33 * (far - near) == pytest.approx(2.0, abs=1e-6)


def test_one_pixel_gives_a_quarter_of_the_claimed_depth() -> None:
    row = fov_table([12.5], [2.0], 1.33, NO_PORT)[0]
    assert row.depth_of_field_m == pytest.approx(0.57, abs=0.005)


def test_json_holds_every_part(validation: Validation) -> None:
    data = json.loads(json.dumps(validation.to_json(), allow_nan=False))
    assert data["passed"] is True
    assert len(data["table"]) == 6
    assert len(data["claims"]) == len(validation.claims)
    assert [row["fov_air_deg"] for row in data["angles"]] == [40, 50, 60, 70, 80, 90, 100, 110]
