import csv
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from alice_survey.base.errors import CalibrationError
from alice_survey.base.executor import SERIAL
from alice_survey.cli.main import app
from camera_calib.rig import read_rig
from camera_calib.tank.run import TankSettings, misses, run_tank
from camera_calib.triangulate import triangulate

Array = NDArray[np.float64]
PUBLISHED_MEDIAN_PX = 4.65
"""Of the sum of both cameras' errors: 2.13 + 2.49 px."""
BOARD = "chessboard 9x6 9.35mm"


@dataclass(frozen=True, eq=False)
class Zebrafish:
    """The real tank, made once."""

    settings: TankSettings
    out: Path
    text: str
    summary: dict[str, Any]
    points: dict[str, Array]
    published: dict[str, Array]


def columns(path: Path) -> dict[str, Array]:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    cells = [[float(cell or "nan") for cell in row] for row in rows[1:]]
    return dict(zip(rows[0], np.array(cells).T, strict=True))


@pytest.fixture(scope="module")
def zebrafish(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Zebrafish:
    folder = shared_data / "aau_flat_interface"
    settings = TankSettings(
        boards=(folder / "checkerboards",),
        board=BOARD,
        references=(folder / "cam1_references.json", folder / "cam2_references.json"),
        detections=folder / "detections.csv",
    )
    out = tmp_path_factory.mktemp("aau") / "tank"
    text, summary = run_tank(settings, out, executor=SERIAL)
    return Zebrafish(
        settings=settings,
        out=out,
        text=text,
        summary=summary,
        points=columns(out / "points.csv"),
        published=columns(folder / "detections_triangulated.csv"),
    )


def test_every_published_detection_is_triangulated(zebrafish: Zebrafish) -> None:
    told = zebrafish.summary["detections"]
    assert told["points"] == len(zebrafish.published["err"]) == 8408
    assert 8390 <= told["in_water"] < 8408  # some rays meet in the air: wrong partners
    assert 80 < told["without_partner"] < 100 and told["repeated"] == 33
    ours = np.column_stack([zebrafish.points[f"cam{c}_{a}_px"] - 0.5 for c in (1, 2) for a in "xy"])
    theirs = np.column_stack([zebrafish.published[f"cam{c}_{a}"] for c in (1, 2) for a in "xy"])
    assert sorted(map(tuple, ours.tolist())) == sorted(map(tuple, theirs.tolist()))


def test_lens_is_wide_and_does_not_fold(zebrafish: Zebrafish) -> None:
    lens = zebrafish.summary["lenses"]["checkerboards"]
    by_name = {model["name"]: model for model in lens["models"]}
    assert lens["model"] == "rational" and lens["views"] >= 14
    assert 0.2 < by_name["rational"]["held_out_px"] < 0.5
    assert by_name["k2"]["held_out_px"] > 1.5 * by_name["rational"]["held_out_px"]
    assert by_name["opencv5"]["folds"]
    rig = read_rig(zebrafish.out / "rig.json")
    assert rig.cameras["cam1"].fx_px == pytest.approx(1228.0, abs=8.0)
    assert 0.5 < rig.sigmas["cam1.fx_px"] < 5.0


def test_cameras_stand_above_and_before_the_tank(zebrafish: Zebrafish) -> None:
    top, front = (zebrafish.summary["cameras"][name] for name in ("cam1", "cam2"))
    np.testing.assert_allclose(top["position_world_m"], [0.18, 0.075, -0.198], atol=0.012)
    np.testing.assert_allclose(front["position_world_m"], [0.17, 0.371, 0.073], atol=0.012)
    for camera in (top, front):
        assert 3.0 < camera["reference_rms_px"] < 30.0
        assert 0.15 < camera["port_distance_m"] < 0.21
    rig = read_rig(zebrafish.out / "rig.json")
    world = rig.body_from_rig * rig.cam_from_rig["cam2"].inv()
    np.testing.assert_allclose(world.translation, front["position_world_m"], atol=1e-12)


def test_reprojection_error_is_below_the_published(zebrafish: Zebrafish) -> None:
    errors = zebrafish.summary["error_px"]
    for kind in ("least_squares", "midpoint"):
        refined = errors["poses_refined"][kind]
        held_out = errors["poses_refined_on_other_half"][kind]
        assert 1.5 < refined["sum_median"] < 3.0 < PUBLISHED_MEDIAN_PX
        assert 1.5 < held_out["sum_median"] < 3.2 < PUBLISHED_MEDIAN_PX
        assert 4.0 < refined["sum_mean"] < 10.1  # of the published mean
        assert max(refined["median"].values()) < 1.5
    best, middle = (errors["poses_refined"][k] for k in ("least_squares", "midpoint"))
    assert 0.95 < best["sum_median"] / middle["sum_median"] < 1.0
    # Corners clicked to 8 px decide little by themselves: about as good as published.
    alone = errors["poses_from_reference_points"]["midpoint"]
    assert 3.5 < alone["sum_median"] < 6.5


def test_points_are_near_the_authors(zebrafish: Zebrafish) -> None:
    def keys(table: dict[str, Array], shift: float, end: str) -> list[tuple[float, ...]]:
        names = ["frame", "id", *(f"cam{c}_{a}{end}" for c in (1, 2) for a in "xy")]
        shifts = [0.0, 0.0, *[shift] * 4]
        stacked = np.column_stack([table[n] - s for n, s in zip(names, shifts, strict=True)])
        return [tuple(row) for row in stacked.tolist()]

    at = {key: i for i, key in enumerate(keys(zebrafish.points, 0.5, "_px"))}
    order = [at[key] for key in keys(zebrafish.published, 0.0, "")]
    ours = np.column_stack([zebrafish.points[f"{a}_m"] for a in "xyz"])[order]
    theirs = np.column_stack([zebrafish.published[f"3d_{a}"] for a in "xyz"]) / 100.0
    apart = np.linalg.norm(ours - theirs, axis=1)

    assert 0.0002 < np.nanmedian(apart) < 0.005
    assert np.nanpercentile(apart, 90) < 0.01


def test_the_files_say_the_same(zebrafish: Zebrafish) -> None:
    rig = read_rig(zebrafish.out / "rig.json")
    pixels = np.stack(
        [np.column_stack([zebrafish.points[f"{c}_{a}_px"] for a in "xy"]) for c in ("cam1", "cam2")]
    )
    world_from_rig = rig.body_from_rig
    found = triangulate(
        list(rig.cameras.values()),
        [pose * world_from_rig.inv() for pose in rig.cam_from_rig.values()],
        pixels,
    )
    written = np.column_stack([zebrafish.points[f"{a}_m"] for a in "xyz"])
    np.testing.assert_allclose(written, found.points_world, atol=1e-6)
    lengths = np.linalg.norm(found.residuals_px, axis=-1)
    np.testing.assert_allclose(zebrafish.points["cam1_error_px"], lengths[0], atol=1e-3)
    sums = misses(["cam1", "cam2"], found.residuals_px).sum_median
    told = zebrafish.summary["error_px"]["poses_refined"]["least_squares"]["sum_median"]
    assert sums == pytest.approx(told, abs=1e-6)
    sigmas = np.column_stack([zebrafish.points[f"sigma_{a}_m"] for a in "xyz"])
    assert np.all(np.nanmedian(sigmas, axis=0) > 3e-4) and np.nanmedian(sigmas) < 3e-3


def test_clocks_are_told_apart(zebrafish: Zebrafish) -> None:
    (lag,) = zebrafish.summary["lags"]
    assert lag["camera"] == "cam2" and lag["points"] > 7000
    assert 0.8 < lag["frames"] < 2.0
    assert "cam2 is +1." in zebrafish.text


def test_again_is_skipped_and_the_same(zebrafish: Zebrafish) -> None:
    before = (zebrafish.out / "points.csv").stat().st_mtime_ns

    text, summary = run_tank(zebrafish.settings, zebrafish.out, executor=SERIAL)

    assert (zebrafish.out / "points.csv").stat().st_mtime_ns == before
    assert (text, summary) == (zebrafish.text, zebrafish.summary)


def test_a_folder_of_something_else_is_not_replaced(zebrafish: Zebrafish, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(CalibrationError, match="was not written by this command"):
        run_tank(zebrafish.settings, tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.fixture
def copied(shared_data: Path, tmp_path: Path) -> TankSettings:
    """The text files of the real tank, to spoil; and no pictures."""
    for name in ("cam1_references.json", "cam2_references.json", "detections.csv"):
        shutil.copyfile(shared_data / "aau_flat_interface" / name, tmp_path / name)
    (tmp_path / "boards").mkdir()
    return TankSettings(
        boards=(tmp_path / "boards",),
        board=BOARD,
        references=(tmp_path / "cam1_references.json", tmp_path / "cam2_references.json"),
        detections=tmp_path / "detections.csv",
    )


def test_bad_input_is_one_clear_line(copied: TankSettings, tmp_path: Path) -> None:
    def fails(settings: TankSettings) -> str:
        with pytest.raises(CalibrationError) as error:
            run_tank(settings, tmp_path / "out", executor=SERIAL)
        assert "\n" not in str(error.value)
        assert not (tmp_path / "out").exists()
        return str(error.value)

    assert "boards: no pictures" in fails(copied)
    assert "--frame-offset cam1:2: write CAMERA=FRAMES" in fails(
        replace(copied, frame_offsets=("cam1:2",))
    )
    (copied.boards[0] / "a.png").write_bytes(b"no picture")
    assert "a.png: cannot be decoded" in fails(copied)
    copied.references[1].write_text("[]")
    assert "0 reference points; at least 4" in fails(copied)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"references": (Path("cam1_a.json"),)}, "1 reference file"),
        ({"references": (Path("cam1_a.json"), Path("cam1_b.json"))}, "name of its own"),
        ({"boards": (Path("a"), Path("b"), Path("c"))}, "3 x --boards for 2 cameras"),
        ({"glass_mm": (1.0, 2.0, 3.0)}, "3 x --glass for 2 cameras"),
        ({"glass_mm": (-1.0,)}, "0 to 500 mm"),
        ({"n_water": 0.9}, "of no tank"),
        ({"lens": "fisheye"}, "no lens model is called 'fisheye'"),
    ],
)
def test_settings_that_do_not_fit_are_refused(change: dict[str, Any], says: str) -> None:
    good: dict[str, Any] = {
        "boards": (Path("boards"),),
        "board": BOARD,
        "references": (Path("cam1_a.json"), Path("cam2_a.json")),
        "detections": Path("detections.csv"),
    }
    with pytest.raises(CalibrationError, match=says):
        TankSettings(**(good | change))


def test_misses_count_points_without_a_solution_as_infinite() -> None:
    residuals = np.array(
        [[[3.0, 4.0], [0.0, 1.0], [np.nan] * 2], [[0.0, 1.0], [0.0, 2.0], [np.nan] * 2]]
    )

    found = misses(["a", "b"], residuals)

    assert found.sum_median == 6.0 and found.sum_mean == 4.5 and found.points == 2
    assert found.median == {"a": 5.0, "b": 2.0} and found.mean == {"a": 3.0, "b": 1.5}


def test_the_command_prints_what_was_found(zebrafish: Zebrafish) -> None:
    settings = zebrafish.settings
    arguments = ["camera", "tank", "--boards", str(settings.boards[0]), "--board", BOARD]
    for path in settings.references:
        arguments += ["--reference", str(path)]
    arguments += ["--detections", str(settings.detections), "-o", str(zebrafish.out)]

    shown = CliRunner().invoke(app, arguments)

    assert shown.exit_code == 0 and shown.output.strip() == zebrafish.text
