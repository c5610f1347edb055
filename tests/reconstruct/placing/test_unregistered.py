"""Pictures that are not in a model: why, and where navigation puts them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord
from reconstruct.mapping.run import reasons
from reconstruct.matching.matches import PairMatches
from reconstruct.placing.run import navigation_places
from reconstruct.placing.track import TrackRow

DATUM = Datum(32.8, 34.9)


def pair(i: int, j: int, count: int) -> tuple[int, int, PairMatches]:
    return i, j, PairMatches(matches=np.zeros((count, 2), np.uint32), geometry={})


def test_each_picture_has_its_reason():
    images = [f"{letter}.png" for letter in "abcdefgh"]
    pairs = [pair(0, 1, 300), pair(1, 2, 200), pair(3, 1, 17), pair(3, 2, 25), pair(5, 6, 90)]
    features = [2000, 2000, 2000, 1500, 12, 900, 900, 800]
    words = reasons(images, {"a.png", "b.png", "c.png"}, features, pairs)
    assert set(words) == {"d.png", "e.png", "f.png", "g.png", "h.png"}
    assert "matches 2 pictures, best c.png (25 matches)" in words["d.png"]
    assert words["e.png"].startswith("12 features: too dark")
    assert "one of 2 pictures that match each other" in words["f.png"]
    assert words["f.png"] == words["g.png"]
    assert words["h.png"].startswith("800 features, but no other picture matches it")
    assert reasons(images[:3], set(images[:3]), features[:3], []) == {}


def survey(
    rng: np.random.Generator, noise_m: float, drift_m: float
) -> tuple[list[ImageRecord], np.ndarray]:
    """Readings every 2 s along a line, whose error drifts, and true places, NED."""
    time_s = 2.0 * np.arange(60)
    true = np.column_stack([0.4 * time_s, 3.0 * np.sin(0.05 * time_s), 10.0 + 0.0 * time_s])
    error = drift_m * np.column_stack([
        np.sin(0.02 * time_s), np.cos(0.03 * time_s), 0.1 * np.sin(0.01 * time_s)
    ])  # fmt: skip
    read = DATUM.geodetic_from_ned(true + error + rng.normal(0, noise_m, true.shape))
    return [
        ImageRecord(
            image=f"{n:03d}.png", camera="left", station=n, time_s=t, latitude_deg=lat,
            longitude_deg=lon, depth_m=depth, sigma_horizontal_m=5.0, sigma_depth_m=0.3,
        )
        for n, (t, (lat, lon, depth)) in enumerate(zip(time_s, read, strict=True))
    ], true  # fmt: skip


def rows_of(records: list[ImageRecord], true: np.ndarray, kept: list[int]) -> list[TrackRow]:
    return [
        TrackRow(
            image=records[n].image, station=n, camera="left", time_s=records[n].time_s,
            world_from_cam=RigidTransform.from_translation(true[n]), points=100,
            reprojection_px=0.3, world_from_body=Rotation.identity(),
        )
        for n in kept
    ]  # fmt: skip


@pytest.mark.parametrize("timed", [True, False])
def test_navigation_is_corrected_by_what_it_misses_before_and_after(timed: bool):
    ratios = []
    for seed in range(20):
        records, true = survey(np.random.default_rng(seed), 0.05, 1.5)
        if not timed:
            records = [replace(record, time_s=math.nan) for record in records]
        gone = [0, 13, 14, 15, 30, 44, 45, 59]
        kept = [n for n in range(60) if n not in gone]
        places, sigma, corrected = navigation_places(
            [records[n] for n in gone],
            {record.image: record for record in records},
            rows_of(records, true, kept),
            None,
            DATUM,
        )
        assert corrected
        off = places - true[gone]
        assert np.abs(off).max() < 0.5  # of 1.5 m that navigation is off
        assert (sigma[:, 0] > 0.03).all()
        assert (sigma[:, 0] < 0.4).all()
        ratios.append(off[:, :2] / sigma[:, :1])
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_without_a_model_around_navigation_stands_as_it_is():
    records, true = survey(np.random.default_rng(1), 0.0, 0.0)
    lost = [records[5], replace(records[6], latitude_deg=math.nan)]
    places, sigma, corrected = navigation_places(
        lost, {r.image: r for r in records}, rows_of(records, true, [0, 1]), None, DATUM
    )
    assert not corrected
    np.testing.assert_allclose(places, [true[5], [math.nan] * 3], atol=1e-6)
    np.testing.assert_array_equal(sigma, [[5.0, 0.3], [math.nan] * 2])
