"""The report as a file: complete, alone, safe, the same each time; and its verdicts."""

import base64
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.errors import CalibrationError
from camera_calib.calibration import Calibration
from camera_calib.formats.rigs import only
from camera_calib.judge.judgement import judge, verdicts
from camera_calib.judge.report import write_report
from camera_calib.judge.uncertainty import uncertainty_report
from camera_calib.rig import write_rig
from camera_calib.targets.target import Rejection
from tests.oracles_report import DESIGN, usual, usual_held_out

NASTY = '<script>alert("x")</script>&$x_1$.png'
PNG = re.compile(r'src="data:image/png;base64,([^"]+)"')


def one_camera(found: Calibration) -> Calibration:
    """Only the left camera of a calibration."""
    return replace(
        found,
        rig=only(found.rig, "left"),
        views=tuple(replace(v, pixels={"left": v.pixels["left"]}) for v in found.views),
        residuals_px=found.residuals_px[:, :1],
        weights=found.weights[:, :1],
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    calibration = replace(
        usual(),
        warnings=("left.port_distance_m is not constrained",),
        rejections=(Rejection(view="99", camera="right", points=0, reason="no board found"),),
    )
    write_report(folder, calibration, usual_held_out())
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def test_the_page_has_four_pictures_and_all_that_is_said(page: str) -> None:
    pictures = PNG.findall(page)
    assert len(pictures) == page.count("<img") == page.count("<figcaption") == 4
    for data in pictures:
        pixels = np.frombuffer(base64.b64decode(data), np.uint8)
        assert cv2.imdecode(pixels, cv2.IMREAD_COLOR) is not None
    assert "port_distance_m" in page and "no board found" in page
    levels = re.findall('<li class="(bad|look|good)"', page)
    assert levels == sorted(levels, key=["bad", "look", "good"].index)
    assert {"look", "good"} <= set(levels)


def test_the_json_holds_the_numbers_of_the_page(folder: Path, page: str) -> None:
    data = json.loads((folder / "report.json").read_text())
    found = usual()
    assert data["views"] == 14
    assert data["noise_px"] == pytest.approx(found.noise_px, rel=1e-6)
    assert f"{data['rms_px']:.3f} px" in page
    by_name = {p["name"]: p for p in data["parameters"]}
    assert by_name["left.fx_px"]["sigma"] == pytest.approx(found.rig.sigmas["left.fx_px"])
    port = by_name["right.port_distance_m"]
    assert port["unit"] == "mm"
    assert port["sigma"] == pytest.approx(1e3 * found.rig.sigmas["right.port_distance_m"])
    tilt = by_name["right.normal_x"]
    assert tilt["unit"] == "deg"
    sine = found.rig.cameras["right"].port.axis_cam[0]
    assert tilt["value"] == pytest.approx(np.degrees(np.arcsin(sine)), rel=1e-6)
    assert by_name["left.n_water"]["sigma"] is None
    assert data["stereo"]["range_m"] == data["working_range_m"] == 2.0
    assert data["baselines_m"]["right"][0] == pytest.approx(found.rig.baseline_m)
    assert data["held_out"]["views"] == 3
    assert data["lengths"]["long"]["count"] > 100
    assert data["rejections"][0]["reason"] == "no board found"


def test_names_are_text_and_not_markup(tmp_path: Path) -> None:
    """Names of files and cameras come from outside; so do reasons and sources."""
    small = one_camera(usual())
    rig = replace(small.rig, source=NASTY)
    views = (replace(small.views[0], name=NASTY), *small.views[1:])
    rejection = Rejection(view=NASTY, camera=NASTY, points=2, reason=NASTY)
    nasty = replace(small, rig=rig, views=views, rejections=(rejection,), warnings=(NASTY,))

    write_report(tmp_path, nasty, None)

    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script" not in text
    assert html.unescape(text).count(NASTY) >= 5


def test_one_camera_has_a_report_without_stereo_and_twice_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_report(tmp_path / name, one_camera(usual()), None)
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert files == ["report.html", "report.json"]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()

    data = json.loads((tmp_path / "a" / "report.json").read_text())
    assert {data[key] for key in ("stereo", "lengths", "held_out")} == {None}


def test_a_sound_calibration_has_only_good_verdicts_on_its_fit() -> None:
    judged = judge(usual(), usual_held_out())
    found = verdicts(judged)
    assert not any(v.level == "bad" for v in found)
    # About homographies, held-out views, either half of the views.
    tested = [v for v in found if re.search("homograph|held-out|half", v.text)]
    assert len(tested) >= 5
    assert {v.level for v in tested} == {"good"}


def test_a_picture_that_does_no_harm_asks_for_nothing() -> None:
    judged = judge(usual(), usual_held_out())
    first = judged.pictures[0]
    odd = replace(judged, pictures=(replace(first, rms_px=3 * first.rms_px), *judged.pictures[1:]))
    assert odd.hold_out is not None
    bad = replace(odd.hold_out, p_value=1e-9)
    for judgement, level in (
        (odd, "good"), (replace(odd, hold_out=bad), "look"), (replace(odd, hold_out=None), "look"),
    ):  # fmt: skip
        about = [v for v in verdicts(judgement) if f"view {first.view} of" in v.text]
        assert [v.level for v in about] == [level]


def test_held_out_views_that_err_twice_as_much_are_bad() -> None:
    held = usual_held_out()
    judged = judge(usual(), replace(held, residuals_px=2.0 * held.residuals_px))
    assert [v.level for v in verdicts(judged) if "views fit to" in v.text] == ["bad"]


def test_projections_count_where_the_target_was_seen() -> None:
    judged = judge(usual(), None)
    left = judged.cameras["left"]
    half = left.coverage.copy()
    half[:, half.shape[1] // 2 :] = 0
    sigma_px = left.sigma.compensated_px.copy()
    sigma_px[:, sigma_px.shape[1] // 2 + 1 :] *= 1e3
    loose = replace(left, sigma=replace(left.sigma, compensated_px=sigma_px))
    for camera, level in ((loose, "look"), (replace(loose, coverage=half), "good")):
        found = verdicts(replace(judged, cameras={"left": camera}))
        assert [v.level for v in found if "lets a projection" in v.text] == [level]


def test_the_working_range_follows_the_views() -> None:
    """A target measured in squares of its own has no metres: 2 would be inside of the camera."""
    assert judge(usual(), None).working_range_m == 2.0
    pose = usual().rig_from_target
    away = type(pose).from_components(30.0 * pose.translation, pose.rotation)
    huge = replace(usual(), rig_from_target=away)
    assert 20 < judge(huge, None).working_range_m < 60


def test_the_command_reports_the_same_sigmas(tmp_path: Path) -> None:
    rig = usual().rig
    write_rig(tmp_path / "rig.json", rig)
    _, data = uncertainty_report(tmp_path / "rig.json", [2.0], 0.6, 2.2, 0.1)
    json.dumps(data, allow_nan=False)
    judged = judge(usual(), None)
    at_work = judged.stereo
    assert at_work is not None
    (stereo,) = data["stereo"]
    assert stereo["length_sigma_m"] == pytest.approx(at_work.length_sigma_m, rel=1e-6)
    (left,) = data["projection_sigma"]["left"]
    plain = np.nanmax(judged.cameras["left"].sigma.plain_px)
    assert left["plain_worst_px"] == pytest.approx(plain, rel=0.02)
    assert left["compensated_worst_px"] < plain

    write_rig(tmp_path / "design.json", DESIGN)
    for name, near_m, far_m in (("design.json", 1.0, 3.0), ("rig.json", 3.0, 1.0)):
        with pytest.raises(CalibrationError):
            uncertainty_report(tmp_path / name, None, near_m, far_m, 0.1)
