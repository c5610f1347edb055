"""The paper's sets, and the report that compares them."""

import json
import math

import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.sim.vehicle.coefficients import (
    CALIBRATED,
    CFD,
    COMPUTED,
    ESTIMATED,
    ROWS,
    CoefficientRow,
)
from alice_survey.sim.vehicle.vehicle import vehicle_from


def row(table: str, coefficient: str, part: str = "vehicle") -> CoefficientRow:
    return next(r for r in ROWS if (r.table, r.coefficient, r.part) == (table, coefficient, part))


def test_these_follow_from_shape() -> None:
    for coefficient in ("Y_uv", "Z_uw", "M_uw"):
        assert abs(row("IV", coefficient).difference_percent) <= 1.0
    for coefficient in ("X_uu", "Y_vv"):
        assert abs(row("IV", coefficient, "hull").difference_percent) <= 1.0
    for coefficient in ("Y_vdot", "N_rdot", "Y_vv", "Z_ww", "N_vdot"):
        assert abs(row("III", coefficient).difference_percent) <= 5.0


def test_every_row_is_marked_by_its_difference() -> None:
    for each in ROWS:
        off = abs(each.difference_percent)
        assert off == pytest.approx(100 * abs(each.computed / each.paper - 1))
        assert each.mark == ("reproduced" if off <= 1 else "near" if off <= 5 else "no")
        assert abs(each.paper) == abs(each.printed)


def test_signs_of_the_paper_are_those_of_the_computed_set() -> None:
    """Once corrected: the same axes, and the same mast above and behind the origin."""
    computed = COMPUTED["alice"].values
    for each in (ESTIMATED, CFD, CALIBRATED):
        for name, value in each.values.items():
            assert math.copysign(1, value) == math.copysign(1, computed[name]), (each.name, name)


def test_sets_hold_the_papers_numbers() -> None:
    for each, name, value in (
        (ESTIMATED, "K_vdot", -0.216), (ESTIMATED, "N_pdot", 0.102), (ESTIMATED, "X_uu", -7.616),
        (ESTIMATED, "Y_uv", -39.71), (CFD, "X_uu", -8.375), (CFD, "Y_vdot", -78.459),
        (CFD, "K_vv", -6.5), (CFD, "Y_vv", -146.95), (CALIBRATED, "X_udot", -28.06),
        (CALIBRATED, "M_wdot", 5.626), (CALIBRATED, "N_vdot", -2.558), (CALIBRATED, "M_uw", -3.37),
        (CALIBRATED, "K_pp", -0.287), (CALIBRATED, "M_ww", 0.096),
    ):  # fmt: skip
        assert each.values[name] == value
    assert CALIBRATED.added_mass[1, 5] == pytest.approx((2.559 + 2.558) / 2)
    assert len(ESTIMATED.values) == 23 + 4  # K_pdot is printed twice; with the lift


def test_the_surge_fit_is_about_the_water_inside() -> None:
    fit = row("V", "X_udot")
    assert fit.paper_other is not None
    inside_kg = vehicle_from("alice").rigid_body.entrained_kg
    assert fit.paper_other - fit.paper == pytest.approx(-inside_kg, rel=0.05)


def test_the_command_prints_every_row() -> None:
    done = CliRunner().invoke(app, ["vehicle", "coefficients", "--json"])
    assert done.exit_code == 0, done.output
    data = json.loads(done.output)
    assert len(data["rows"]) == 58
    for each, shown in zip(ROWS, data["rows"], strict=True):
        assert (each.coefficient, each.computed) == (shown["coefficient"], shown["computed"])
    assert data["counts"] == {"reproduced": 7, "near": 12, "no": 39}
