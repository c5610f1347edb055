"""Offsets of clocks are found from a target that moves before cameras without a common trigger."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.executor import SERIAL
from camera_calib.calibrate.from_pictures import calibrate_pictures
from camera_calib.calibrate.moments import clock_offset, track_of, views_at_moments
from camera_calib.calibrate.options import CalibrateOptions
from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import TargetView
from camera_calib.rig import Rig, read_rig
from tests.camera_calib.calibrate.test_many_cameras import TARGET, four_cameras
from tests.camera_calib.calibration_scenes import differences
from tests.cameras import changed
from tests.oracles_targets import picture_light, to_srgb

NOISE_PX = 0.1


def pixels_of(rig: Rig, name: str, pose: RigidTransform) -> np.ndarray:
    """Where a camera sees the target's corners."""
    return rig.cameras[name].project((rig.cam_from_rig[name] * pose).apply(TARGET.points))


def is_whole(rig: Rig, name: str, pose: RigidTransform) -> bool:
    pixels = pixels_of(rig, name, pose)
    size = rig.cameras[name].width_px, rig.cameras[name].height_px
    with np.errstate(invalid="ignore"):
        return bool(np.all((pixels > 25) & (pixels < np.array(size) - 25)))


def matrix_of(rig: Rig, name: str, pose: RigidTransform) -> np.ndarray:
    """(3, 3) `pixels_from_board` of a camera without distortion."""
    one, cam_from_target = rig.cameras[name], (rig.cam_from_rig[name] * pose).as_matrix()
    inner = np.array([[one.fx_px, 0, one.cx_px], [0, one.fy_px, one.cy_px], [0, 0, 1.0]])
    return inner @ cam_from_target[:3, [0, 1, 3]]


def pair() -> Rig:
    rig = four_cameras()
    names = ("left", "right")
    return Rig(
        cameras={name: rig.cameras[name] for name in names},
        cam_from_rig={name: rig.cam_from_rig[name] for name in names},
        body_from_rig=rig.body_from_rig,
        source="truth",
    )


def pose_at(time_s: float, still: bool = False) -> RigidTransform:
    """A hand that moves a board: about 0.2 m/s and 20 degrees a second."""
    phase = time_s * np.array([0.83, 1.21, 0.57, 0.71, 1.13, 0.93]) + np.arange(6.0)
    swing = np.zeros(6) if still else np.sin(phase)
    turn = Rotation.from_euler("xyz", 30.0 * swing[:3], degrees=True)
    place = np.array([0.09, 0.0, 1.1]) + swing[3:] * [0.12, 0.08, 0.2]
    return RigidTransform.from_components(place - turn.apply(TARGET.points.mean(axis=0)), turn)


@cache
def seen(offset_s: float, seed: int, still: bool = False) -> tuple[list[TargetView], dict]:
    """Pictures of 10 Hz from the left, of 12 Hz from the right camera, and their own times."""
    rig, rng, views, times_s = pair(), np.random.default_rng(seed), [], {}
    for name, rate_hz, first_s, late_s in (
        ("left", 10.0, 0.0, 0.0),
        ("right", 12.0, 0.31, offset_s),
    ):
        for i in range(int(9.0 * rate_hz)):
            true_s = first_s + i / rate_hz
            pose = pose_at(true_s, still)
            if not is_whole(rig, name, pose):
                continue
            view = f"{name} {i:03d}"
            pixels = pixels_of(rig, name, pose)
            pixels = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
            views.append(TargetView(name=view, pixels={name: pixels}))
            times_s[view] = true_s - late_s
    return views, times_s


def tracks_of(views: list[TargetView], times_s: dict) -> dict:
    rig = pair()
    return {
        name: track_of(name, camera, views, times_s, TARGET.points)
        for name, camera in rig.cameras.items()
    }


@pytest.mark.parametrize("offset_s", [0.0, 0.537, -1234.5678])
def test_an_offset_is_found_to_its_sigma(offset_s: float) -> None:
    rig, over = pair(), []
    for seed in range(3):
        tracks = tracks_of(*seen(offset_s, seed))
        found = clock_offset(
            ("left", "right"), tracks["left"], tracks["right"], rig.cameras["right"], TARGET.points
        )
        assert found.pictures > 60
        assert 2e-5 < found.sigma_s < 1e-4
        over.append((found.seconds - offset_s) / found.sigma_s)
    assert np.abs(over).max() < 4.0
    assert np.sqrt(np.mean(np.square(over))) > 0.1


def test_views_of_one_moment_calibrate_as_if_triggered_together() -> None:
    truth = pair()
    views, times_s = seen(0.537, 7)
    tracks = tracks_of(views, times_s)
    offset = clock_offset(
        ("left", "right"), tracks["left"], tracks["right"], truth.cameras["right"], TARGET.points
    )

    together = views_at_moments(tracks, {"right": offset})

    both = [v for v, view in enumerate(together) if "right" in view.pixels]
    assert len(both) > 60
    for v in both:
        true = pixels_of(truth, "right", pose_at(tracks["left"].time_s[v]))
        off = together[v].pixels["right"] - true
        assert np.sqrt((off**2).mean()) < 2.5 * NOISE_PX
    sizes = {name: (c.width_px, c.height_px) for name, c in truth.cameras.items()}
    found = calibrate_in_air(together[::3], TARGET.points, sizes, "k2").rig
    errors = differences(found, truth)
    for axis in "xyz":
        assert abs(errors[f"right.{axis}_m"]) < 2e-3
    assert found.cameras["right"].fx_px == pytest.approx(truth.cameras["right"].fx_px, rel=3e-3)


def test_a_target_at_rest_shows_no_clock() -> None:
    tracks = tracks_of(*seen(0.2, 1, still=True))
    with pytest.raises(CalibrationError, match="left and right cannot be compared"):
        clock_offset(
            ("left", "right"), tracks["left"], tracks["right"], pair().cameras["right"],
            TARGET.points,
        )  # fmt: skip


def test_few_pictures_show_no_clock() -> None:
    views, times_s = seen(0.2, 1)
    with pytest.raises(CalibrationError, match="clocks need 8"):
        track_of("right", pair().cameras["right"], views[:95], times_s, TARGET.points)


@pytest.mark.slow
def test_videos_without_a_common_trigger_calibrate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of two clocks, 0.9 s apart, with their times in a manifest."""

    def without_plots(folder: Path, *_: object) -> None:
        (folder / "report.json").write_text('{"verdicts": []}')

    monkeypatch.setattr("camera_calib.calibrate.files._write_report", without_plots)
    rig, rng = pair(), np.random.default_rng(4)
    truth = replace(rig, cameras={name: changed(c, k1=0.0) for name, c in rig.cameras.items()})
    rows = ["image,time_s"]
    for name, rate_hz, late_s in (("left", 8.0, 0.0), ("right", 9.0, 0.9)):
        (tmp_path / name).mkdir()
        size = truth.cameras[name].width_px, truth.cameras[name].height_px
        for i in range(int(5.0 * rate_hz)):
            time_s = 0.07 + i / rate_hz
            pose = pose_at(time_s)
            if not is_whole(truth, name, pose):
                continue
            light = picture_light(TARGET, matrix_of(truth, name, pose), size, 3)
            light += rng.normal(0, 0.004, light.shape)
            cv2.imwrite(str(tmp_path / name / f"{i:03d}.png"), to_srgb(light))
            rows.append(f"{name}/{i:03d}.png,{time_s - late_s:.6f}")
    (tmp_path / "manifest.csv").write_text("\n".join(rows) + "\n")
    options = CalibrateOptions(
        left=str(tmp_path / "left"), right=str(tmp_path / "right"), own_clocks=True,
        target=TARGET.description, lens="pinhole", output=tmp_path / "out",
    )  # fmt: skip

    text, found = calibrate_pictures(options, executor=SERIAL)

    clock = found["clocks"]["right"]
    assert clock["seconds"] == pytest.approx(0.9, abs=max(4 * clock["sigma_s"], 2e-4))
    assert clock["sigma_s"] < 2e-3
    assert "clock of right: add " in text
    source = read_rig(tmp_path / "out" / "rig.json").source
    assert "clock of right: add 0." in source or "clock of right: add 1." in source
    errors = differences(read_rig(tmp_path / "out" / "rig.json"), truth)
    for axis in "xyz":
        assert abs(errors[f"right.{axis}_m"]) < 3e-3


def test_clocks_need_two_cameras_and_one_numbering(tmp_path: Path) -> None:
    for pictures, target in (({"pictures": "a"}, "9x6"), ({"left": "a", "right": "b"}, "8x6")):
        places: dict[str, Any] = {}
        for option, folder in pictures.items():
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / "1.png").write_bytes(folder.encode())
            places[option] = str(tmp_path / folder)
        options = CalibrateOptions(
            **places, own_clocks=True, target=f"chessboard {target} 25mm", output=tmp_path / "out"
        )
        with pytest.raises(CalibrationError, match="--own-clocks needs two cameras"):
            calibrate_pictures(options, executor=SERIAL)
