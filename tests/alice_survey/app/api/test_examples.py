"""The public names are few, quick to import, and each has an example that runs."""

import ast
import doctest
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

import alice_survey as alice
from alice_survey.app.commands.pictures import MeasureCommand
from alice_survey.app.commands.survey import ReportPageCommand
from alice_survey.core.errors import keep_warnings
from reconstruct.views.model import WorldFrame
from tests.alice_survey.app.report.tiny import tiny_workspace, write_raster

NEEDS_A_MODEL = '"small'


def examples_of(name: str) -> list[doctest.DocTest]:
    finder = doctest.DocTestFinder(exclude_empty=True)
    found = finder.find(getattr(alice, name), name, globs={"np": np})
    return [test for test in found if test.examples]


def run(test: doctest.DocTest) -> str:
    shown: list[str] = []
    doctest.DocTestRunner().run(test, out=shown.append)
    return "".join(shown)


def needs_a_model(name: str) -> bool:
    return any(NEEDS_A_MODEL in str(test.docstring) for test in examples_of(name))


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if needs_a_model(n) else ()) for n in alice.__all__],
)
def test_examples_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.chdir(tmp_path)
    tests = examples_of(name)
    assert any(test.name == name for test in tests)
    if needs_a_model(name):
        Path("small").symlink_to(request.getfixturevalue("small_survey"))
    assert [run(test) for test in tests] == [""] * len(tests)


def test_the_example_of_the_package_runs() -> None:
    tests = doctest.DocTestFinder(recurse=False).find(alice, "alice_survey")
    assert len(tests[0].examples) == 4
    assert run(tests[0]) == ""


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, alice_survey\n"
        "assert 'read_plan' in dir(alice_survey)\n"
        "sys.exit(', '.join({'numpy', 'pydantic', 'scipy'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_names_for_readers_and_for_type_checkers_are_the_same() -> None:
    """The lazy table, `__all__` and the imports under TYPE_CHECKING agree."""
    assert alice.__file__ is not None
    tree = ast.parse(Path(alice.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {a.name: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names}
    lazy = {name: home for home, names in alice._HOMES.items() for name in names}
    assert seen == lazy
    assert sorted(seen) == sorted(alice.__all__)
    assert len(seen) <= 34


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="reed_plan"):
        _ = alice.reed_plan


@pytest.mark.slow
def test_heights_are_looked_up_in_their_cells(small_survey: Path) -> None:
    dem = alice.read_dem(small_survey)
    rows, columns = dem.height.shape
    row, column = np.mgrid[:rows, :columns]
    east, north = dem.west + (column + 0.5) * dem.cell, dem.north - (row + 0.5) * dem.cell
    np.testing.assert_array_equal(dem.height_at(east, north), dem.height)
    assert np.isnan(dem.height_at(np.array(dem.west - dem.cell), np.array(dem.north)))
    west, right, south, top = dem.extent
    assert (right - west, top - south) == pytest.approx((columns * dem.cell, rows * dem.cell))


def test_an_averaged_surface_stays_in_its_place(tmp_path: Path) -> None:
    """A plane of known slope, 301 x 203 cells, has the same heights when it is averaged."""
    rows, columns = np.mgrid[:301, :203]
    plane = (0.5 * rows - 0.25 * columns).astype(np.float32)[None]
    for name in ("dem", "sigma"):
        write_raster(tmp_path / "dense" / f"{name}.tif", plane, 0.1, (7.0, 40.0), nodata=np.nan)
    dem = alice.read_dem(tmp_path, max_cells=100)
    assert dem.height.shape == (75, 50)
    row, column = np.mgrid[:75, :50]
    east, north = dem.west + (column + 0.5) * dem.cell, dem.north - (row + 0.5) * dem.cell
    expected = 0.5 * ((40.0 - north) / 0.1 - 0.5) - 0.25 * ((east - 7.0) / 0.1 - 0.5)
    np.testing.assert_allclose(dem.height, expected, atol=1e-4)


def test_commands_take_the_names_of_their_help_and_readers_a_workspace(tmp_path: Path) -> None:
    reef = alice.Survey.new(tmp_path, example="demo").with_settings(plan={"altitude_m": 1.5})
    assert reef.config.plan.altitude_m == 1.5 and len(repr(reef.config)) < 800
    with pytest.raises(alice.AliceError, match="altitude_m"):
        reef.with_settings(plan={"altitude_m": -1})
    with pytest.raises(alice.AliceError, match="plan="):
        reef.with_settings(altitude_m=2)  # type: ignore[arg-type]
    assert "altitude_m = 1.5" in (tmp_path / "survey.toml").read_text(encoding="utf-8")
    shown = alice.call(
        "fov", survey=tmp_path / "survey.toml", altitude=[1.5], csv=tmp_path / "a.csv"
    )
    assert shown == alice.call("fov", altitude=[1.5], survey=tmp_path / "survey.toml")
    assert shown == alice.call("fov", altitude=1.5, survey=tmp_path / "survey.toml")
    with pytest.raises(alice.AliceError, match="pictures"):  # not that a glass is text
        alice.call("calibrate", glass=10)
    for name, option, near in (
        ("none", "json", ""), ("fov", "lenz", "lens"), ("report", "threads", ""),
        ("fov", "altitud", "altitude"),
    ):  # fmt: skip
        with pytest.raises(alice.AliceError, match=rf"{near}\b"):
            alice.call(name, **{option: "three"})
    plan = reef.plan()
    assert alice.read_plan(tmp_path) == alice.read_plan(tmp_path / "plan" / "plan.json") == plan
    assert len(repr(plan)) < 100


def test_figures_take_a_survey_and_a_surface_out_of_date_is_a_warning(tmp_path: Path) -> None:
    tiny = alice.Survey(tiny_workspace(tmp_path))
    assert alice.call("status", workspace=tiny)["stages"] == tiny.status()
    with keep_warnings() as warnings:
        shown = alice.plot_dem(tiny.dem), alice.plot_mosaic(tiny.mosaic)
    assert "dense is stale" in warnings[0] and "mosaic is stale" in warnings[1]
    again = alice.plot_dem(tiny), alice.plot_mosaic(tmp_path)
    for one, other in zip(shown, again, strict=True):
        np.testing.assert_array_equal(
            one.axes[0].images[0].get_array(), other.axes[0].images[0].get_array()
        )
    config = alice.SurveyConfig()
    bare = alice.design_rig(config.camera, config.water, scale=4)
    alice.write_rig(tmp_path / "images" / "rig.json", bare)
    assert tiny.rig.cameras["left"].width_px == bare.cameras["left"].width_px
    assert alice.plot_plan(tiny).axes[0].get_title(loc="left")


def test_the_calls_of_the_page_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """What needs a model is taken as given; its keys are those that the commands' tests read."""
    page = (Path(__file__).parents[4] / "docs/api/survey.md").read_text(encoding="utf-8")
    length = {"distances": [{"value_m": 1.0, "sigma_m": 0.001}]}
    monkeypatch.setattr(MeasureCommand, "run", lambda command: ("", length))
    report = {"report": {"summary": {}}}
    monkeypatch.setattr(ReportPageCommand, "run", lambda command: ("", report))
    given: dict[str, Any] = {"alice": alice}
    exec(page.split("```python")[1].split("```")[0], given)  # noqa: S102
    assert [row["altitude_m"] for row in given["table"]] == [1.5, 2.0]


def test_a_track_is_a_table() -> None:
    track = alice.Track(
        images=("a.png", "b.png"), covariance=np.array([np.eye(6), 4 * np.eye(6)]),
        world_from_cam=RigidTransform.from_translation([[1, 2, 3], [4, 5, 6]]),
        frame=WorldFrame(name="ned", datum=None, scaled=True, vertical_datum="none"),
    )  # fmt: skip
    assert {name: list(column) for name, column in track.table.items()} == {
        "image": ["a.png", "b.png"], "x": [1, 4], "y": [2, 5], "z": [3, 6],
        "sigma_x": [1, 2], "sigma_y": [1, 2], "sigma_z": [1, 2],
    }  # fmt: skip
