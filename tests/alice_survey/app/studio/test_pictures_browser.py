"""Lengths between spots that are picked through the Pictures tab, against the rendered truth."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from tests.alice_survey.app.studio.client import serving
from tests.alice_survey.app.studio.journey_page import WIDE, begun_page
from tests.alice_survey.app.studio.picture_page import PicturePage
from tests.alice_survey.app.studio.test_pictures import Truth

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
PAIRS, SPOTS = 40, 14
"""Lengths to measure, between so many spots; 200 lengths had 0.94 (2026-11-27)."""
MARK_PX = 0.3
"""How steady the hand is; the page's own value to begin with."""


def test_lengths_between_picks_err_as_stated(small_survey: Path, tmp_path: Path) -> None:
    """Root mean square of error over sigma.

    Each spot is picked with the mouse and the keys of the page, with noise. Every second one is
    found in the other pictures by the page, the others are picked in four pictures by hand. The
    bounds are those which chi-square leaves one chance in 500 to be outside of (0.29 to 1.86), with
    as many degrees of freedom as spots can be paired without using one twice.
    """
    workspace = Path(shutil.copytree(small_survey, tmp_path / "survey"))
    truth, rng = Truth(workspace), np.random.default_rng(21)
    places = [
        place
        for place in truth.places(rng, 2 * PAIRS)
        if np.abs(place[:2] - [0.6, 0.45]).max() < 0.55 and truth.nearest(place) is not None
    ]  # within the model, whatever the pick's noise
    camera = next(iter(truth.rig.cameras.values()))
    spots: dict[str, np.ndarray] = {}
    with serving(workspace) as server, begun_page(WIDE) as (page, heard):
        page.goto(server.address + "#pictures")
        page.wait_for_selector("body[data-ready]")
        pictures = PicturePage(page=page, size_px=(camera.width_px, camera.height_px))
        for place in places[:SPOTS]:
            found = truth.nearest(place)
            assert found is not None
            image, pixel = found
            view = pictures.opened(image, *(pixel - 0.5))
            pictures.moved_to(view, *(pixel - 0.5 + rng.normal(0, MARK_PX, 2)))
            if len(spots) % 2:
                if pictures.found_in_others() < 2:
                    pictures.closed()
                    continue
            else:
                for other in page.locator(".picture-card").all()[1:4]:
                    seen = truth.pixel(str(other.get_attribute("aria-label")), place) - 0.5
                    view = other.locator(".picture-view")
                    view.scroll_into_view_if_needed()
                    view.click()  # it is zoomed to where the spot is expected
                    pictures.moved_to(view, *(seen + rng.normal(0, MARK_PX, 2)))
            pictures.saved(f"S{len(spots)}")
            spots[f"S{len(spots)}"] = place
        assert len(spots) > 0.8 * SPOTS
        ratios = []
        for _ in range(PAIRS):
            one, two = rng.choice(sorted(spots), 2, replace=False)
            value, sigma = pictures.length(one, two)
            ratios.append((value - np.linalg.norm(spots[one] - spots[two])) / sigma)
        assert heard.complaints == []
    low, high = np.sqrt(chi2.ppf([0.001, 0.999], SPOTS // 2) / (SPOTS // 2))
    assert low < np.sqrt(np.mean(np.square(ratios))) < high
