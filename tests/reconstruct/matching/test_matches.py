from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from reconstruct.matching import matches
from reconstruct.matching import matches as matching
from reconstruct.matching.features import Features, load_features, save_features
from tests.oracles_matching import match_slowly


@settings(deadline=None, max_examples=40)
@given(
    n=st.integers(1, 25),
    m=st.integers(2, 25),
    ratio=st.floats(0.5, 0.99),
    block=st.sampled_from([1, 7, 1000]),
    seed=st.integers(0, 1000),
)
def test_matches_equal_those_of_the_slow_twin(
    n: int, m: int, ratio: float, block: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (n, 8)).astype(np.uint8)
    b = rng.integers(0, 256, (m, 8)).astype(np.uint8)
    b[: min(n, m) // 2] = a[: min(n, m) // 2]  # some true matches
    found = matches.match_descriptors(a, b, ratio, block)
    np.testing.assert_array_equal(found, match_slowly(a, b, ratio))


def plain_features(pixels: Array, descriptors: NDArray[Any]) -> Features:
    sizes, rounded = np.ones(len(pixels), np.float32), np.clip(descriptors, 0, 255).astype(np.uint8)
    return Features(pixels=pixels, scale_px=sizes, descriptors=rounded)


def pair_task(
    folder: Path, camera: pycolmap.Camera, *sides: tuple[Array, Array]
) -> matches.PairTask:
    """Two pictures of one camera with features (pixels and descriptors) saved in a folder."""
    first, second = folder / "a.npz", folder / "b.npz"
    for path, side in zip((first, second), sides, strict=True):
        save_features(path, plain_features(*side))
    cameras = (camera.todict(), camera.todict())
    return matches.PairTask(first=first, second=second, ratio=0.8, cameras=cameras, seed=3)


def pinhole(width: int, height: int, focal_px: float) -> pycolmap.Camera:
    return pycolmap.Camera(
        model="PINHOLE", width=width, height=height, has_prior_focal_length=True,
        params=[focal_px, focal_px, width / 2, height / 2],
    )  # fmt: skip


def test_geometry_keeps_true_matches_and_drops_false_ones(tmp_path: Path) -> None:
    """Features of 120 points seen by two cameras, and 60 wrong ones with equal descriptors."""
    true, outliers = 120, 60
    rng = np.random.default_rng(2)
    camera = pinhole(800, 600, 900)
    points = np.column_stack([rng.uniform(-0.7, 0.7, (120, 2)), rng.uniform(2.2, 2.8, 120)])
    seen = [camera.img_from_cam(points - shift) for shift in ([0, 0, 0], [0.3, 0.05, 0.1])]
    sides = np.concatenate([seen, rng.uniform(0, 600, (2, outliers, 2))], axis=1)
    descriptors: Any = rng.integers(0, 90, (120 + outliers, 128))
    task = pair_task(tmp_path, camera, (sides[0], descriptors), (sides[1], descriptors))
    found = matches.match_pair(task)
    assert found.geometry is not None
    right = int((found.matches[:, 0] < true).sum())
    assert right >= 0.97 * true
    assert len(found.matches) - right <= 4
    np.testing.assert_array_equal(found.matches, matches.match_pair(task).matches)


@settings(deadline=None, max_examples=40)
@given(n=st.integers(1, 25), m=st.integers(2, 25), radius=st.floats(5, 60), seed=st.integers(0, 99))
def test_narrowed_matches_equal_those_of_the_slow_twin(
    n: int, m: int, radius: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    a, b = (
        plain_features(rng.uniform(0, 100, (count, 2)), rng.integers(0, 256, (count, 8)))
        for count in (n, m)
    )
    b.descriptors[: min(n, m) // 2] = a.descriptors[: min(n, m) // 2]
    predicted, cell = a.pixels + np.array([3.0, -2.0]), 30.0
    searched = np.zeros((n, m), bool)
    for i in range(n):
        mates = predicted[np.all(a.pixels // cell == a.pixels[i] // cell, axis=1)]
        low, high = mates.min(axis=0) - radius, mates.max(axis=0) + radius
        searched[i] = ((b.pixels >= low) & (b.pixels <= high)).all(axis=1)
    found = matches.match_near(a, b, 0.9, predicted, radius, cell)
    slow = match_slowly(a.descriptors, b.descriptors, 0.9, searched)
    np.testing.assert_array_equal(found, slow)


def test_homographies_come_back_from_exact_matches() -> None:
    rng = np.random.default_rng(9)
    truth = np.array([[1.05, 0.1, 30.0], [-0.08, 0.96, -12.0], [2e-5, -3e-5, 1.0]])
    first = rng.uniform(0, 3000, (40, 2))
    second = matches.apply_homography(truth, first)
    np.testing.assert_allclose(
        matches.apply_homography(matches.fit_homography(first, second), first), second, atol=1e-6
    )
    horizon = np.array([[1, 0, 0], [0, 1, 0], [-1e-3, 0, 1]])
    places = np.column_stack([[100.0, 200.0, 300.0, 1500.0], np.zeros(4)])
    moved = matches.apply_homography(horizon, places)
    np.testing.assert_array_equal(np.isnan(moved[:, 0]), [False, False, False, True])


def repeated_texture(tmp_path: Path, alike: int) -> matches.PairTask:
    """3000 true points, of which `alike` have a double elsewhere that looks the same to a few."""
    rng = np.random.default_rng(11)
    camera = pinhole(3000, 2400, 3000)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (3000, 2)), rng.uniform(1.9, 2.1, 3000)])
    first, second = camera.img_from_cam(points), camera.img_from_cam(points - [0.3, 0.05, 0.0])
    descriptors = rng.integers(0, 90, (3000, 128)).astype(np.int64)
    doubles = rng.permutation(np.arange(1500, 3000))[:alike]
    descriptors[doubles[: alike // 2]] = descriptors[doubles[alike // 2 :]]
    noise = rng.integers(-4, 5, (2, *descriptors.shape))
    sides = [(p, descriptors + n) for p, n in zip((first, second), noise, strict=True)]
    return pair_task(tmp_path, camera, *sides)


def test_prediction_finds_what_looks_alike_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = repeated_texture(tmp_path, alike=800)
    guided = matches.match_pair(task)
    monkeypatch.setattr(matching, "_WORTH_PROBING", np.inf)
    full = matches.match_pair(task)
    assert np.all(guided.matches[:, 0] == guided.matches[:, 1])
    assert len(full.matches) >= 2000
    assert len(guided.matches) >= len(full.matches) + 200


def test_where_the_largest_features_agree_on_nothing_all_are_compared(tmp_path: Path) -> None:
    """Only the smaller half of the features is common to both pictures."""
    task = repeated_texture(tmp_path, alike=0)
    b = load_features(task.second)
    b.descriptors[:1500] = np.random.default_rng(12).integers(0, 90, (1500, 128))
    save_features(task.second, b)
    found = matches.match_pair(task).matches
    assert len(found) >= 1300 and found.min() >= 1500


def test_what_colmap_logs_is_not_shown(capfd: pytest.CaptureFixture[str]) -> None:
    """Also in processes that only match; a fault of its own comes as an exception."""
    pycolmap.logging.error("a step did not work out")
    assert capfd.readouterr().err == ""
