"""Whole journeys through the studio, from an empty folder to a result, at 1280 and 400 px.

A dive is followed from an empty folder on in `test_follow_browser.py`.
"""

import csv
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruct.placing.control_points import read_control, read_picks
from tests.alice_survey.app.studio import journey_page
from tests.alice_survey.app.studio.client import ask, looks_at, serving, still
from tests.alice_survey.app.studio.picture_page import PicturePage, said
from tests.alice_survey.app.studio.test_model_browser import click, kept
from tests.alice_survey.app.studio.test_model_browser import named as figures
from tests.alice_survey.app.studio.test_pictures import Truth
from tests.alice_survey.kit.browser import Heard, is_accessible
from tests.docs import given_divers as dive

Point = NDArray[np.float64]
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]


@pytest.fixture
def journey() -> Iterator[tuple[Any, Heard]]:
    """A page, 1280 px wide, and what it complains about."""
    with journey_page.begun_page(journey_page.WIDE) as page_and_heard:
        yield page_and_heard


def report_made(page: Any, address: str, folder: Path) -> None:
    """Make what a survey lacks, at 400 px."""
    page.set_viewport_size(journey_page.NARROW)
    page.goto(address + "#run")
    journey_page.button(page, "Make all that is left").click()
    done = page.get_by_role("heading", name="Make all that is left: done")
    done.wait_for(timeout=journey_page.LONG_MS)
    journey_page.made(page, "report")
    is_accessible(page, folder / "modelled.png", (journey_page.WIDE, journey_page.NARROW))
    page.set_viewport_size(journey_page.WIDE)


def pictures_with(page: Any, truth: Truth, places: list[Point]) -> PicturePage:
    """Pick places in the picture that shows each nearest its middle, and save them as P0, P1..."""
    camera = next(iter(truth.rig.cameras.values()))
    pictures = PicturePage(page=page, size_px=(camera.width_px, camera.height_px))
    page.get_by_label("Sigma of a pick by eye, px").fill("0.05")
    for number, place in enumerate(places):
        found = truth.nearest(place)
        assert found is not None
        image, pixel = found
        view = pictures.opened(image, *(pixel - 0.5))
        marked = pictures.moved_to(view, *(pixel - 0.5))
        np.testing.assert_allclose(marked, pixel - 0.5, atol=0.06)
        assert pictures.found_in_others() > 2
        page.get_by_text("found, sigma").nth(2).wait_for()
        pictures.saved(f"P{number}")
    return pictures


def test_control_points_are_picked_and_their_residuals_shown(
    journey: tuple[Any, Heard], small_survey: Path, tmp_path: Path
) -> None:
    page, heard = journey
    left_out = shutil.ignore_patterns("evaluation", "report")
    workspace = Path(shutil.copytree(small_survey, tmp_path / "reef", ignore=left_out))
    truth, rng = Truth(workspace), np.random.default_rng(21)
    places = [place for place in truth.places(rng, 12) if truth.nearest(place) is not None]
    places.sort(key=lambda place: float(np.abs(place[:2] - [0.6, 0.45]).max()))
    places = places[:3]  # many pictures show them
    with serving(workspace) as server:
        report_made(page, server.address, tmp_path)
        page.goto(server.address + "#pictures")
        value, sigma = pictures_with(page, truth, places).length("P0", "P1")
        assert abs(value - float(np.linalg.norm(places[0] - places[1]))) < 4.0 * sigma < 0.004
        stored = read_picks(workspace / "picks.csv")
        for number in range(3):
            mine = [pick for pick in stored if pick.point == f"P{number}"]
            (hand,) = (pick for pick in mine if not pick.matched_to)
            assert hand.sigma_px == 0.05
            assert {pick.matched_to for pick in mine} == {"", hand.image}

        def save_known(number: int, place: Point) -> None:
            page.get_by_text("Add a known point or length").click()
            page.get_by_label("Point", exact=True).select_option(f"P{number}")
            for label, coordinate in zip(("North, m", "East, m", "Depth, m"), place, strict=True):
                page.get_by_label(label, exact=True).fill(f"{coordinate:.4f}")
            journey_page.button(page, "Save to control.csv").click()
            journey_page.button(page, f"Delete point P{number}").wait_for()

        for number, place in enumerate(places):
            save_known(number, place)
        control = read_control(workspace / "control.csv").points
        assert [(one.name, one.use) for one in control] == [(f"P{n}", "control") for n in range(3)]
        rows = page.get_by_role("row").filter(has=page.get_by_label(re.compile("^Delete point")))
        rows.filter(has_text="fitted").nth(2).wait_for()
        spots = json.loads(ask(server, "/api/picks").text)["points"]
        for row, spot, place in zip(rows.all_inner_texts(), spots, places, strict=True):
            now, fitted = (
                np.array([float(text) for text in re.split(", ", one.strip())])
                for one in re.findall(r"(?:now|fitted) ([-\d., ]+)", row.replace("−", "-"))
            )
            off = np.array([spot["position"][axis] for axis in ("n", "e", "down")]) - place
            np.testing.assert_allclose(np.abs(now), 1000 * np.abs(off), rtol=0.01, atol=0.2)
            assert np.abs(fitted).max() < 5.0
            assert "BAD" not in row
        save_known(0, places[0] + [0.5, 0.0, 0.0])
        rows.filter(has_text="BAD").first.wait_for()
        is_accessible(page, tmp_path / "control.png")

        journey_page.button(page, "Open P1").click()
        page.wait_for_selector(".picture-view[data-ready]")
        is_accessible(page, tmp_path / "picks.png")
        journey_page.button(page, "Delete P2").click()
        said(page, "Took P2")
        assert {pick.point for pick in read_picks(workspace / "picks.csv")} == {"P0", "P1"}
        assert heard.complaints == []


def floor(x: float, y: float) -> Point:
    """A point of the floor."""
    return np.array([x, y, -float(dive.relief_m(np.array(x), np.array(y)))])


def seen(frame: int, point: Point) -> Point:
    """Pixel at which a frame shows a point, as viewers count."""
    place, turn = dive.pose(frame)
    ray = turn.inv().apply(point - place)
    middle = np.array([dive.WIDTH / 2, dive.HEIGHT / 2])
    return middle + dive.FOCAL_PX * ray[:2] / ray[2] - 0.5


def card(folder: Path) -> list[int]:
    """A diver's pictures without any calibration; the frames that they are."""
    frames = list(range(0, len(dive.path_m()), 4))
    folder.mkdir()
    for frame, picture in zip(frames, dive.dive_frames(frames), strict=True):
        cv2.imwrite(str(folder / f"P{frame:04d}.png"), picture)
    return frames


def pick(page: Any, name: str, frames: list[int], point: Point, images: list[str]) -> None:
    """Pick a point of the floor in the picture that shows it nearest its middle, and save it."""
    half = np.array([dive.WIDTH, dive.HEIGHT]) / 2
    at = min(frames, key=lambda frame: float(np.abs(seen(frame, point) - half).max()))
    pictures = PicturePage(page=page, size_px=(dive.WIDTH, dive.HEIGHT))
    view = pictures.opened(images[frames.index(at)], *seen(at, point))
    pictures.moved_to(view, *seen(at, point))
    pictures.found_in_others()
    pictures.saved(name)


def test_a_divers_folder_becomes_a_scaled_model_with_a_measured_coral(
    journey: tuple[Any, Heard], tmp_path: Path
) -> None:
    page, heard = journey
    frames = card(tmp_path / "card")
    workspace = tmp_path / "dive"
    bar = [floor(0.5, 0.2), floor(1.7, 0.9)]
    coral = [floor(0.8, 0.9), floor(1.5, 0.3)]
    with serving(workspace) as server:
        page.set_viewport_size(journey_page.NARROW)
        page.goto(server.address)
        journey_page.button(page, "I have pictures").click()
        page.get_by_label("Folder of the pictures").fill(str(tmp_path / "card"))
        journey_page.button(page, "Look into it").click()
        page.get_by_text(f"Found: {len(frames)} pictures").wait_for()
        is_accessible(page, tmp_path / "found.png", (journey_page.WIDE, journey_page.NARROW))
        journey_page.button(page, "Import them").click()
        page.get_by_role("heading", name="Import pictures: done").wait_for(
            timeout=journey_page.LONG_MS
        )
        journey_page.button(page, "Reconstruct the sea floor").click()
        journey_page.made(page, "mesh")
        page.get_by_role("heading", name="Reconstruct the sea floor: done").wait_for()

        with (workspace / "images" / "manifest.csv").open(newline="") as rows:
            images = sorted(row["image"] for row in csv.DictReader(rows))
        journey_page.opened(page, "Pictures")
        page.get_by_label("Sigma of a pick by eye, px").fill("0.05")
        for number, point in enumerate((*bar, *coral)):
            page.set_viewport_size((journey_page.WIDE, journey_page.NARROW)[number % 2])
            pick(page, f"end {number}", frames, point, images)
        for number in range(2):
            page.get_by_label(f"end {number}", exact=True).check()
        true = float(np.linalg.norm(bar[1] - bar[0]))
        page.get_by_label("Its true length, m").fill(f"{true:.6f}")
        journey_page.button(page, "Set the scale").click()
        page.locator("#status", has_text="reconstruct").wait_for()
        assert (workspace / "scale.json").is_file()
        journey_page.opened(page, "Run")
        page.wait_for_selector("[data-stage=placing]:not([data-state='up to date'])")
        journey_page.button(page, "Reconstruct the sea floor").click()
        journey_page.made(page, "mesh")

        page.reload()
        journey_page.opened(page, "Pictures")
        true = float(np.linalg.norm(coral[1] - coral[0]))
        for number in (2, 3):
            page.get_by_label(f"end {number}", exact=True).check()
        page.wait_for_selector("[data-value]")
        is_accessible(page, tmp_path / "coral.png", (journey_page.WIDE, journey_page.NARROW))
        shown = page.locator("[data-value]")
        off = float(shown.get_attribute("data-value")) - true
        assert abs(off) < 4.0 * float(shown.get_attribute("data-sigma"))
        assert abs(off) < 0.01 * true

        journey_page.opened(page, "Model")
        for number, size in enumerate((journey_page.NARROW, journey_page.WIDE), start=1):
            page.set_viewport_size(size)
            measured_coral(page, number)
            is_accessible(page, tmp_path / "area.png")
        assert heard.complaints == []


def measured_coral(page: Any, number: int) -> None:
    """Measure a triangle in the middle of the map, and look at its figures."""
    box = page.locator("#map-canvas")
    box.scroll_into_view_if_needed()
    still(lambda: looks_at(page))
    east, north = (float(box.get_attribute(f"data-{axis}")) for axis in ("east", "north"))
    corners = [(east - 0.2, north - 0.15), (east + 0.2, north - 0.15), (east, north + 0.2)]
    journey_page.button(page, "Area").click()
    click(page, *corners)
    journey_page.button(page, "Finish").click()
    page.wait_for_selector(f"tr[data-measure='{number}']")
    measure = kept(page)[-1]
    places = np.array(measure["places"])
    (a, b), (c, d) = places[1:] - places[0]
    plan = 0.5 * abs(a * d - b * c)
    found = figures(measure)
    assert found["plan_area"]["value"] == pytest.approx(plan, rel=0.01)
    assert found["plan_area"]["value"] < found["surface_area"]["value"] < 2.0 * plan
    assert 0 < found["surface_area"]["sigma"] < 0.1 * plan
