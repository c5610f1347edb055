"""The paper's sets, and the report that compares them."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from alice_survey.base.errors import AliceError
from alice_survey.cli.main import app
from alice_survey.vehicle.fleet import vehicle
from alice_survey.vehicle.hydrodynamics.comparison import CoefficientRow, coefficient_rows
from alice_survey.vehicle.hydrodynamics.geometry import ALICE, SPARUS2
from alice_survey.vehicle.hydrodynamics.paper_tables import (
    CALIBRATED,
    CFD,
    ESTIMATED,
    TABLE_III,
    TABLE_IV,
    TABLE_V,
    TABLES,
)
from alice_survey.vehicle.hydrodynamics.parts import estimate
from alice_survey.vehicle.hydrodynamics.report import coefficients_report

ROWS = coefficient_rows()


def row(table: str, coefficient: str, part: str = "vehicle") -> CoefficientRow:
    return next(r for r in ROWS if (r.table, r.coefficient, r.part) == (table, coefficient, part))


@pytest.mark.parametrize(
    ("table", "coefficient", "part", "percent"),
    [
        ("IV", "Y_uv", "vehicle", 1.0),
        ("IV", "Z_uw", "vehicle", 1.0),
        ("IV", "M_uw", "vehicle", 1.0),
        ("IV", "X_uu", "hull", 1.0),
        ("IV", "Y_vv", "hull", 1.0),
        ("III", "Y_vdot", "vehicle", 5.0),
        ("III", "N_rdot", "vehicle", 5.0),
        ("III", "Y_vv", "vehicle", 5.0),
        ("III", "Z_ww", "vehicle", 5.0),
        ("III", "N_vdot", "vehicle", 5.0),
    ],
)
def test_these_follow_from_shape(table: str, coefficient: str, part: str, percent: float) -> None:
    assert abs(row(table, coefficient, part).difference_percent) <= percent


def test_every_row_of_the_paper_is_there() -> None:
    assert [len(t) for t in (TABLE_III, TABLE_IV, TABLE_V)] == [24, 20, 14]
    assert len(ROWS) == len(TABLES) == 58


def test_every_row_is_marked_by_its_difference() -> None:
    for each in ROWS:
        off = abs(each.difference_percent)
        assert off == pytest.approx(100 * abs(each.computed / each.paper - 1))
        assert each.mark == ("reproduced" if off <= 1 else "near" if off <= 5 else "no")
        assert abs(each.paper) == abs(each.printed)
        assert each.equation


def test_signs_of_the_paper_are_those_of_the_computed_set() -> None:
    """Once corrected: the same axes, and the same mast above and behind the origin."""
    computed = estimate(ALICE).values
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


def test_tables_agree_where_they_repeat_each_other() -> None:
    third = {r.coefficient: r.printed for r in TABLE_III}
    for each in (*TABLE_IV, *TABLE_V):
        cfd = [r.printed_other for r in TABLE_IV if r.coefficient == each.coefficient]
        known = [third.get(each.coefficient, each.printed), *cfd]
        if each.part == "vehicle":
            assert any(abs(each.printed) == pytest.approx(abs(k), rel=3e-3) for k in known if k)


def test_no_set_gains_energy_by_moving() -> None:
    """Damping and lift take power in any motion: |nu| = 1, m/s and rad/s, axes big and small."""
    rng = np.random.default_rng(1)
    motions = rng.standard_normal((50_000, 6)) * rng.choice([0.01, 0.1, 1.0], (50_000, 6))
    motions /= np.linalg.norm(motions, axis=1)[:, None]
    u, v, w, _, q, r = motions.T
    for each in (ESTIMATED, CFD, CALIBRATED, estimate(ALICE), estimate(SPARUS2)):
        force = motions * np.abs(motions) @ each.quadratic.T
        y_uv, z_uw, m_uw, n_uv = each.lift
        lift = y_uv * abs(u) * v * v + z_uw * abs(u) * w * w + m_uw * u * w * q + n_uv * u * v * r
        power = np.sum(motions * force, axis=1) + lift
        assert power.min() > -400.0 and power.max() < -0.15, each.name


def test_the_surge_fit_is_about_the_water_inside() -> None:
    fit = row("V", "X_udot")
    assert fit.paper_other is not None
    inside_kg = vehicle("alice").rigid_body.entrained_kg
    assert fit.paper_other - fit.paper == pytest.approx(-inside_kg, rel=0.05)


def test_the_command_prints_and_writes_every_row(tmp_path: Path) -> None:
    file, picture = tmp_path / "rows.csv", tmp_path / "picture.svg"
    done = CliRunner().invoke(
        app, ["vehicle", "coefficients", "--csv", str(file), "--plot", str(picture), "--json"]
    )
    assert done.exit_code == 0, done.output
    data = json.loads(done.output)
    assert len(data["rows"]) == 58
    with file.open(encoding="utf-8") as lines:
        written = list(csv.DictReader(lines))
    for each, line, shown in zip(ROWS, written, data["rows"], strict=True):
        assert line["coefficient"] == each.coefficient == shown["coefficient"]
        assert float(line["computed"]) == each.computed == shown["computed"]
    first = picture.read_bytes()
    assert b"N_rr" in first and b"stern" in first
    coefficients_report(plot=picture)
    assert picture.read_bytes() == first


def test_the_text_holds_each_coefficient() -> None:
    text, data = coefficients_report()
    for each in ROWS:
        assert f"\n{each.coefficient} " in text
    assert data["counts"] == {"reproduced": 7, "near": 12, "no": 39}


@pytest.mark.parametrize(
    ("option", "name", "words"),
    [("plot", "picture.bmp", "change the suffix"), ("csv", "folder", "is a folder")],
)
def test_files_that_cannot_be_written_are_refused(
    tmp_path: Path, option: str, name: str, words: str
) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(AliceError, match=words):
        coefficients_report(**{option: tmp_path / name})
