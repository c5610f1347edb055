"""The report as a file: complete, alone, safe, the same each time; and its verdicts."""

import base64
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.errors import CalibrationError
from camera_calib.calibration import Calibration, TargetView
from camera_calib.judge.judgement import judge, verdicts
from camera_calib.judge.report import write_report
from camera_calib.judge.uncertainty import uncertainty_report
from camera_calib.rig import Covariance, Rig, write_rig
from camera_calib.targets.target import Rejection
from tests.oracles_report import (
    DESIGN,
    Freedom,
    adjusted,
    intrinsics,
    of_cameras,
    pose_names,
    synthetic_views,
    true_rig,
    usual,
    usual_held_out,
    without_ports,
)

VOID = {"meta", "img", "br", "link"}
NASTY = '<script>alert("x")</script>&$x_1$.png'


class Page(HTMLParser):
    """What a browser would see: open tags must close, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, Mapping[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += " " + data

    def all(self, tag: str) -> list[Mapping[str, str | None]]:
        return [attrs for name, attrs in self.tags if name == tag]


def one_camera(found: Calibration) -> Calibration:
    """Only the left camera of a calibration."""
    rig, covariance = found.rig, found.rig.covariance
    assert covariance is not None
    at = [i for i, name in enumerate(covariance.parameters) if name.startswith("left.")]
    return replace(
        found,
        rig=Rig(
            cameras={"left": rig.cameras["left"]},
            cam_from_rig={"left": rig.cam_from_rig["left"]},
            body_from_rig=rig.body_from_rig,
            source="one camera",
            covariance=Covariance(
                parameters=tuple(covariance.parameters[i] for i in at),
                matrix=covariance.matrix[np.ix_(at, at)],
            ),
        ),
        views=tuple(
            TargetView(name=v.name, pixels={"left": v.pixels["left"]}) for v in found.views
        ),
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
def page(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_the_page_is_whole_and_loads_nothing(page: Page) -> None:
    assert page.open == []
    assert not page.all("script")
    assert all(str(a["href"]) == "data:," for a in page.all("link"))
    assert all(str(a["src"]).startswith("data:image/png;base64,") for a in page.all("img"))
    assert all(str(a["href"]).startswith("#") for a in page.all("a"))
    anchors = {a.get("id") for a in [*page.all("section"), *page.all("nav")]}
    assert all(str(a["href"])[1:] in anchors for a in page.all("a"))


def test_every_figure_is_a_picture_with_words(page: Page) -> None:
    images = page.all("img")
    assert len(images) == len(page.all("figcaption")) == 4
    for attrs in images:
        assert attrs["alt"]
        data = base64.b64decode(str(attrs["src"]).partition(",")[2])
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None


def test_warnings_and_rejections_are_shown(page: Page) -> None:
    assert "port_distance_m" in page.text
    levels = [str(a["class"]) for a in page.all("li") if a.get("class")]
    assert levels == sorted(levels, key=["bad", "look", "good"].index)
    assert {"look", "good"} <= set(levels)


def test_the_json_holds_the_numbers_of_the_page(folder: Path, page: Page) -> None:
    data = json.loads((folder / "report.json").read_text())
    found = usual()
    assert data["views"] == 14
    assert data["noise_px"] == pytest.approx(found.noise_px, rel=1e-6)
    assert f"{data['rms_px']:.3f} px" in page.text
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
    assert [s["range_m"] for s in data["stereo"]] == pytest.approx(
        [0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 10.0]
    )
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
    page = Page(text)
    assert not page.all("script")
    assert page.open == []
    assert page.text.count(NASTY) >= 5
    assert re.search("<script", text) is None


def test_one_camera_has_a_report_without_stereo_and_twice_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_report(tmp_path / name, one_camera(usual()), None)
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert files == ["report.html", "report.json"]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()

    page = Page((tmp_path / "a" / "report.html").read_text(encoding="utf-8"))
    data = json.loads((tmp_path / "a" / "report.json").read_text())
    assert data["stereo"] == []
    assert data["lengths"] is None
    assert data["held_out"] is None
    assert len(page.all("img")) == 4


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
    bad = replace(odd.hold_out, rms_px=2 * odd.hold_out.expected_px)
    for judgement, level in (
        (odd, "good"), (replace(odd, hold_out=bad), "look"), (replace(odd, hold_out=None), "look"),
    ):  # fmt: skip
        about = [v for v in verdicts(judgement) if f"view {first.view} of" in v.text]
        assert [v.level for v in about] == [level]


def test_a_forgotten_port_is_reported() -> None:
    made = synthetic_views(true_rig(), 25, 0.03, 1)
    free = Freedom(free=(*of_cameras(DESIGN, intrinsics("opencv5")), *pose_names(DESIGN)))
    bare = adjusted(made.views, made.points, without_ports(DESIGN), free)
    found = verdicts(judge(bare, None))
    assert any("homograph" in v.text for v in found if v.level != "good")


def test_the_working_range_follows_the_views() -> None:
    """A target measured in squares of its own has no metres: 2 would be inside of the camera."""
    assert judge(usual(), None).working_range_m == 2.0
    assert judge(usual(), None, 1.2).stereo_at_work is not None
    found = usual()
    pose = found.rig_from_target
    huge = replace(
        found,
        rig_from_target=type(pose).from_components(30.0 * pose.translation, pose.rotation),
    )
    assert 20 < judge(huge, None).working_range_m < 60


def test_the_command_reports_the_same_sigmas(tmp_path: Path) -> None:
    rig = usual().rig
    write_rig(tmp_path / "rig.json", rig)
    _, data = uncertainty_report(tmp_path / "rig.json", [2.0], 0.6, 2.2, 0.1)
    json.dumps(data, allow_nan=False)
    judged = judge(usual(), None)
    at_work = judged.stereo_at_work
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
