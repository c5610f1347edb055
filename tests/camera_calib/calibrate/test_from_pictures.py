"""Calibration from pictures: a real set, a simulated pool, and what users get wrong."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from alice_survey.core.errors import AliceError, CalibrationError
from alice_survey.core.executor import SERIAL
from alice_survey.sim.seafloor.board import PoolBoard, board_records, pool_poses, render_board
from camera_calib.calibrate import from_pictures
from camera_calib.calibrate.detect_views import detect_views
from camera_calib.calibrate.from_pictures import calibrate_pictures, calibrate_task
from camera_calib.calibrate.options import CalibrateOptions
from camera_calib.calibrate.picture_sets import find_pictures, pair_pictures
from camera_calib.formats.rigs import only, rename_cameras
from camera_calib.rig import Rig, read_rig, write_rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import built_rig, in_air

BOARD = "chessboard 9x6 1m"


def small(rig: Rig) -> Rig:
    """The same rig at a sixth of the resolution."""
    return replace(rig, cameras={name: c.downscale(6) for name, c in rig.cameras.items()})


def shoot(folder: Path, rig: Rig, views: int, seed: int) -> None:
    """Pictures of the pool's board, without noise, as `left/00.png`, `right/00.png`, ..."""
    board = PoolBoard()
    poses = pool_poses(board, rig, views, np.random.default_rng(seed))
    for view, by_camera in enumerate(board_records(rig, poses)):
        for name, pose in by_camera.items():
            light = render_board(board, rig.cameras[name], pose, 3)
            picture = np.clip(255.0 * light.mean(axis=2) ** (1 / 2.2), 0, 255).astype(np.uint8)
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{view:02d}.png"), picture)


@pytest.fixture(scope="module")
def truth() -> Rig:
    return small(built_rig())


@pytest.fixture(scope="module")
def dry(truth: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dry")
    shoot(folder, in_air(truth), 12, 1)
    return folder


@pytest.fixture(scope="module")
def wet(truth: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wet")
    shoot(folder, truth, 12, 2)
    return folder


def both(folder: Path) -> dict[str, Any]:
    return {"cameras": tuple(f"{side}={folder / side}" for side in ("left", "right"))}


def one(place: Path) -> dict[str, Any]:
    return {"cameras": (f"camera={place}",)}


POOL_BOARD = "chessboard 11x8 40mm"


@pytest.fixture(scope="module")
def real(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, Any]:
    """13 pairs of OpenCV's samples, calibrated: the folder, the text and the numbers."""
    folder, out = shared_data / "opencv_stereo", tmp_path_factory.mktemp("real") / "out"
    cameras = tuple(f"{side}={folder / side}*.jpg" for side in ("left", "right"))
    settings = CalibrateOptions(cameras=cameras, target=BOARD)
    return out, *calibrate_pictures(replace(settings, output=out), executor=SERIAL)


def corner_rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "corners.csv").read_text().splitlines()))


@pytest.mark.slow
def test_a_real_stereo_set(real: tuple[Path, str, Any]) -> None:
    """OpenCV's own calibration of the set has 0.215 px and 3.327 squares."""
    folder, _, found = real
    assert 0.10 < found["rms_px"] <= 0.22
    assert found["points"] > 0.98 * 2 * 13 * 54
    assert found["baseline_m"] == pytest.approx(3.33, abs=0.01)
    rig = read_rig(folder / "rig.json")
    assert rig.cameras["left"].fx_px == pytest.approx(533.4, abs=2.0)
    assert rig.cameras["right"].fx_px == pytest.approx(537.0, abs=2.0)
    assert 0.4 < rig.sigmas["left.fx_px"] < 1.5
    assert 1e-4 < rig.sigmas["right.x_m"] < 5e-3

    # OpenCV's own definition of the rms, from the file of corners.
    used = [row for row in corner_rows(folder) if float(row["weight"]) > 0]
    square = [float(r["residual_x_px"]) ** 2 + float(r["residual_y_px"]) ** 2 for r in used]
    assert np.sqrt(np.mean(square)) == pytest.approx(found["rms_px"], abs=1e-5)
    assert len(used) == found["points"]
    assert found.pop("shortfall") == "", "no bad verdict"
    assert json.loads((folder / "calibration.json").read_text()) == found


@pytest.mark.slow
def test_opencv_agrees_on_the_real_set(real: tuple[Path, str, Any]) -> None:
    """The same corners in cv2.stereoCalibrate give the same rig, within two sigmas."""
    folder, _, found = real
    rig = read_rig(folder / "rig.json")
    seen: dict[tuple[str, str], np.ndarray] = {}
    for row in corner_rows(folder):
        pixels = seen.setdefault((row["view"], row["camera"]), np.full((54, 2), np.nan))
        pixels[int(row["point"])] = float(row["x_px"]) - 0.5, float(row["y_px"]) - 0.5
    points = parse_target(BOARD).points.astype(np.float32)
    names = sorted({view for view, _ in seen})
    whole = [n for n in names if all(np.isfinite(seen[n, c]).all() for c in ("left", "right"))]
    left, right = (
        [seen[n, c].astype(np.float32)[:, None] for n in whole] for c in ("left", "right")
    )
    objects = [points] * len(whole)
    alone = [cv2.calibrateCamera(objects, p, (640, 480), None, None) for p in (left, right)]
    rms, k1, _, k2, _, _, shift, *_ = cv2.stereoCalibrate(
        objects, left, right, alone[0][1], alone[0][2], alone[1][1], alone[1][2], (640, 480),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    # OpenCV takes the board as flat and even, which costs it a tenth.
    assert 0.85 * rms < found["rms_px"] < rms
    sigmas = rig.sigmas
    for name, matrix in (("left", k1), ("right", k2)):
        camera = rig.cameras[name]
        assert abs(camera.fx_px - matrix[0, 0]) < 2 * sigmas[f"{name}.fx_px"]
        assert abs(camera.cx_px - 0.5 - matrix[0, 2]) < 2 * sigmas[f"{name}.cx_px"]
    assert abs(rig.baseline_m - np.linalg.norm(shift)) < 2 * sigmas["right.x_m"]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report without plots, which take seconds."""

    def without_plots(folder: Path, *_: object) -> None:
        (folder / "report.json").write_text('{"verdicts": []}')

    monkeypatch.setattr("camera_calib.calibrate.results.write_report", without_plots)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_from_dry_pictures_through_the_ports(
    dry: Path, wet: Path, truth: Rig, tmp_path: Path
) -> None:
    """In air, then through the ports with the air's knowledge."""
    air = CalibrateOptions(**both(dry), target=POOL_BOARD, lens="opencv5")
    calibrate_pictures(replace(air, output=tmp_path / "air"), executor=SERIAL)
    pool = CalibrateOptions(
        **both(wet), target=POOL_BOARD, water=True, start=tmp_path / "air" / "rig.json",
        glass_mm="10",
    )  # fmt: skip
    _, found = calibrate_pictures(replace(pool, output=tmp_path / "pool"), executor=SERIAL)

    assert found["with_prior"][0] == "left.fx_px"
    rig = read_rig(tmp_path / "pool" / "rig.json")
    for name, camera in rig.cameras.items():
        true = truth.cameras[name]
        assert camera.n_water == 1.34
        assert camera.parameter("port_distance_m") == pytest.approx(
            true.parameter("port_distance_m"), abs=2e-3
        )
        assert np.arccos(np.dot(camera.port.axis_cam, true.port.axis_cam)) < np.deg2rad(0.2)
        assert camera.fx_px == pytest.approx(true.fx_px, abs=0.3)
    assert rig.baseline_m == pytest.approx(truth.baseline_m, abs=5e-5)


@pytest.mark.usefixtures("quick")
def test_one_camera(dry: Path, truth: Rig, tmp_path: Path) -> None:
    options = CalibrateOptions(
        **one(dry / "left"), target=POOL_BOARD, output=tmp_path / "one", lens="k2"
    )
    _, found = calibrate_pictures(options, executor=SERIAL)
    rig = read_rig(tmp_path / "one" / "rig.json")
    assert list(rig.cameras) == ["camera"]
    assert rig.cameras["camera"].fx_px == pytest.approx(truth.cameras["left"].fx_px, abs=0.5)
    assert found["baseline_m"] is None
    assert not any(name.endswith("_rad") for name in rig.sigmas)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_corrupt_pictures_and_pictures_without_the_board_are_left_out(
    dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(dry, tmp_path / "in")
    (tmp_path / "in" / "left" / "03.png").write_bytes(b"no picture")
    empty = np.full((451, 564), 128, dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "in" / "right" / "05.png"), empty)
    settings = CalibrateOptions(**both(tmp_path / "in"), target=POOL_BOARD)

    _, found = calibrate_pictures(replace(settings, output=tmp_path / "out"), executor=SERIAL)

    shown = capsys.readouterr().err.splitlines()
    assert sum("03.png" in line for line in shown) == 1
    assert sum("view 05, right" in line for line in shown) == 1
    whole = {(r["view"], r["camera"]) for r in found["rejections"] if r["points"] == 0}
    assert whole == {("03", "left"), ("05", "right")}
    assert found["views"] == 12


def test_pictures_that_are_cut_short_or_of_another_kind_are_named(
    dry: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for view in range(3):
        picture = cv2.imread(str(dry / "left" / f"{view:02d}.png"))
        cv2.imwrite(str(folder / f"{view}.jpg"), picture)
    whole = (folder / "1.jpg").read_bytes()
    (folder / "1.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    cv2.imwrite(str(folder / "3.tif"), np.zeros((451, 564), dtype=np.float32))
    sets = pair_pictures({"camera": find_pictures(str(folder))})

    found = detect_views(sets, parse_target(POOL_BOARD), executor=SERIAL)

    assert [view.name for view in found.views] == ["0", "2"]
    reasons = {r.view: r.reason for r in found.rejections if not r.points}
    assert reasons.keys() == {"1", "3"}
    assert "float32" in reasons["3"]


def refuses(settings: CalibrateOptions, tmp_path: Path) -> str:
    with pytest.raises(AliceError) as caught:
        calibrate_pictures(replace(settings, output=tmp_path / "out"), executor=SERIAL)
    assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.partial").exists()
    return str(caught.value)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"target": "chessboard 12x8 40mm"}, "11x8"),
        ({"target": "chessboard 6x5 40mm"}, "11x8"),
        ({"cameras": ("camera=MIXED",)}, "534 x 431 px (such as 04.png)"),
        ({"water": True, "start": Path("built.json")}, "start's camera 3384 x 2710"),
        ({"glass_mm": "10"}, "--glass"),
        ({"water": True}, "--glass"),
        ({"water": True, "known": "prior", "glass_mm": "10"}, "--start"),
        ({"lens": "mirror"}, "mirror"),
        ({"target": "chessboard"}, "chessboard"),
        ({"start": Path("nowhere.json")}, "nowhere.json"),
        ({"cameras": ("left=none*.png",)}, "none"),
        ({"cameras": ("left=DRY/left", "right=DRY/left")}, "left and right have the same picture"),
        ({"cameras": ("bow",)}, "NAME=FOLDER"),
        ({"cameras": ("b.c=x",)}, "b.c=x"),
        ({"cameras": ("a=x", "a=y")}, "two cameras are called a"),
        ({"cameras": tuple(f"c{i}=x" for i in range(9))}, "9 cameras"),
        ({"cameras": ()}, "--pictures"),
        ({"target": None}, "--target"),
    ],
)
def test_what_gives_no_calibration_is_one_clear_line(
    options: dict[str, Any], named: str, dry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boards, sizes, starts, lists and options; a folder of three pictures unless they say."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DRY").symlink_to(dry)
    (tmp_path / "few").mkdir()
    for view in range(3):
        shutil.copy(dry / "left" / f"{view:02d}.png", tmp_path / "few")
    shutil.copytree(dry / "left", tmp_path / "MIXED")
    odd = cv2.imread("MIXED/04.png")
    cv2.imwrite("MIXED/04.png", odd[:-20, :-30])
    write_rig(tmp_path / "built.json", rename_cameras(only(built_rig(), "left"), ["camera"]))
    usual = {"cameras": ("camera=few",), "target": POOL_BOARD}
    assert named in refuses(CalibrateOptions(**usual | options), tmp_path)


def test_what_others_need_is_not_replaced(tmp_path: Path) -> None:
    """Other files, a file in the folder's place, and the start itself."""
    settings = CalibrateOptions(**one(Path("nowhere")), target=BOARD)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    (tmp_path / "out" / "calibration.json").write_text("{}")
    (tmp_path / "taken").write_text("mine")
    (tmp_path / "air").mkdir()
    write_rig(tmp_path / "air" / "rig.json", built_rig())
    start = tmp_path / "air" / "rig.json"
    for name, named in (
        (None, "-o"), ("out", "thesis.tex"), ("taken", "taken"), ("..", "-o"), ("air", "--start"),
    ):  # fmt: skip
        output = None if name is None else tmp_path / name
        with pytest.raises(AliceError, match=re.escape(named)):
            calibrate_pictures(replace(settings, output=output, start=start), executor=SERIAL)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "years of work"
    assert (tmp_path / "taken").read_text() == "mine"
    assert start.is_file()


@pytest.mark.slow
def test_swapped_lists_are_reported_first(dry: Path, tmp_path: Path) -> None:
    swapped = {"cameras": (f"left={dry / 'right'}", f"right={dry / 'left'}")}
    for pictures, is_bad in ((both(dry), False), (swapped, True)):
        settings = CalibrateOptions(**pictures, target=POOL_BOARD, lens="k2")
        text, _ = calibrate_pictures(replace(settings, output=tmp_path / "out"), executor=SERIAL)
        first = json.loads((tmp_path / "out" / "report.json").read_text())["verdicts"][0]
        assert (first["level"] == "bad" and " 100 mm " in first["text"]) == is_bad
        assert (text.splitlines()[0] == f"bad: {first['text']}") == is_bad


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_pictures_of_other_moments_are_no_calibration(dry: Path, tmp_path: Path) -> None:
    """No rig explains them: that shows before anything is adjusted."""
    shutil.copytree(dry, tmp_path / "in")
    for view in range(12):
        (tmp_path / "in" / "right" / f"{view:02d}.png").rename(
            tmp_path / "in" / "right" / f"new{(view + 5) % 12:02d}.png"
        )
    settings = CalibrateOptions(**both(tmp_path / "in"), target=POOL_BOARD, lens="k2")
    assert "of the 12 views of both" in refuses(settings, tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_a_camera_of_which_most_pictures_do_not_fit_is_no_calibration(
    dry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files stay for a look, the exit says that they are no use."""

    def with_few(*arguments: Any) -> Any:
        found = calibrate_task(*arguments)
        few = [
            view if v < 5 else replace(view, pixels={"left": view.pixels["left"]})
            for v, view in enumerate(found.views)
        ]
        return replace(found, views=tuple(few))

    monkeypatch.setattr(from_pictures, "calibrate_task", with_few)
    settings = CalibrateOptions(**both(dry), target=POOL_BOARD, lens="k2")
    with pytest.raises(CalibrationError, match="only 5 of 12 pictures of right") as caught:
        calibrate_pictures(replace(settings, output=tmp_path / "out"), executor=SERIAL)
    assert len(str(caught.value).splitlines()) == 1
    assert (tmp_path / "out" / "report.json").is_file()
