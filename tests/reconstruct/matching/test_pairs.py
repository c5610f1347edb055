import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL
from alice_survey.core.manifest import ImageRecord
from reconstruct.matching.features import save_features
from reconstruct.matching.pairs import (
    NEIGHBOURS,
    alike_pairs,
    choose_pairs,
    describe,
    footprints,
    make_codebook,
    neighbours,
    placed_pictures,
)
from tests.oracles_matching import vlad_slowly
from tests.reconstruct.matching.test_matches import plain_features
from tests.reconstruct.rig_survey import four_cameras
from tests.reconstruct.scenes import ALTITUDE_M, DATUM, make_scene, stating


def mono(count: int) -> list[ImageRecord]:
    return [ImageRecord(image=f"{i}.png", camera="camera", station=i) for i in range(count)]


def test_neighbours_of_stereo_stations_cross_the_cameras() -> None:
    records = [replace(one, camera=side) for side in ("left", "right") for one in mono(3)]
    pairs = itertools.combinations(range(6), 2)
    expected = {(i, j) for i, j in pairs if abs(records[i].station - records[j].station) <= 1}
    assert neighbours(records, 1) == expected and len(expected) == 3 + 2 * 4


def test_many_pictures_with_positions_get_their_nearest() -> None:
    side = 10
    row, column = np.divmod(np.arange(side * side), side)
    column = np.where(row % 2 == 0, column, side - 1 - column)
    places = 10.0 * np.column_stack([row, column, np.full(len(row), -8)])
    records = stating(mono(len(row)), places)
    sure, maybe = choose_pairs(records, None, DATUM)
    pairs = set(sure) | set(maybe)
    assert {(i, 2 * side - 1 - i) for i in range(side)} <= pairs  # the next line, side by side
    assert (0, side * side - 1) not in pairs
    assert len(pairs) < 25 * len(records)


def test_footprints_have_the_size_of_the_exact_port_camera() -> None:
    scene = make_scene(points=50)
    level = [replace(r, roll_deg=0.0, pitch_deg=0.0, heading_deg=0.0) for r in scene.records[:2]]
    left, right = footprints(level, scene.rig, DATUM)
    camera = scene.rig.cameras["left"]
    depth = ALTITUDE_M + camera.parameter("port_distance_m") + camera.parameter("glass_thickness_m")
    corners = camera.at_depth(camera.border(8), depth)
    across, along = np.ptp(corners[:, 0]), np.ptp(corners[:, 1])
    south, west, north, east = left.bounds
    assert (north - south, east - west) == pytest.approx((along, across), abs=2e-3)
    apart = (right.centroid.y - left.centroid.y, right.centroid.x - left.centroid.x)
    assert apart == pytest.approx((scene.rig.baseline_m, 0.0), abs=1e-3)


def test_pairs_by_footprint_are_those_that_share_the_sea_floor() -> None:
    scene = make_scene(points=6000)
    certain = [replace(r, sigma_horizontal_m=0.0, sigma_attitude_deg=0.0) for r in scene.records]
    sure, maybe = choose_pairs(certain, scene.rig, DATUM)
    shared = {
        (i, j): len(np.intersect1d(scene.ids[i], scene.ids[j]))
        for i, j in itertools.combinations(range(len(scene.records)), 2)
    }
    chosen = set(sure) | set(maybe)
    records = scene.records
    one_camera = {p for p in shared if records[p[0]].camera == records[p[1]].camera}
    stations = {p for p in shared if records[p[0]].station == records[p[1]].station}
    # a third of a picture's points
    assert {pair for pair, n in shared.items() if n > 250} & one_camera <= chosen
    assert stations <= set(sure)
    assert chosen <= one_camera | stations
    assert all(shared[pair] > 20 for pair in sure)
    nothing = {pair for pair, n in shared.items() if n == 0}
    assert len(chosen & nothing) <= 0.02 * len(nothing)


def test_cameras_that_see_nothing_together_are_paired_across_stations() -> None:
    """One looks ahead and one astern, which sees what the first saw before; two beside overlap."""
    one = four_cameras().cameras["wide"]
    turns = {"fore": 28.0, "aft": -28.0, "beside": -26.0}
    poses = {
        name: RigidTransform.from_rotation(Rotation.from_euler("x", -turn, degrees=True))
        for name, turn in turns.items()
    }
    rig = replace(four_cameras(), cameras=dict.fromkeys(turns, one), cam_from_rig=poses)
    scene = make_scene(lines=1, stations=9, points=9000, rig=rig)
    sure, _ = choose_pairs(scene.records, rig, DATUM)
    cameras: dict[str, list[int]] = {}
    for i, j in sure:
        here, there = scene.records[i], scene.records[j]
        if here.station != there.station:
            names = " ".join(sorted((here.camera, there.camera)))
            shared = len(np.intersect1d(scene.ids[i], scene.ids[j]))
            cameras.setdefault(names, []).append(shared)
    assert set(cameras) >= {"aft fore", "beside fore"} and "aft beside" not in cameras
    assert len(cameras["aft fore"]) >= 5 and min(cameras["aft fore"]) > 100
    assert max(np.bincount(np.ravel(sure))) <= 30


def test_pictures_without_navigation_are_tied_to_their_neighbours() -> None:
    scene, lost = make_scene(points=50), 6
    records = [replace(r, latitude_deg=np.nan) if r.station == lost else r for r in scene.records]
    sure, _ = choose_pairs(records, scene.rig, DATUM)
    stations = [{records[i].station for i in pair} for pair in sure]
    partners = set().union(*(one for one in stations if lost in one))
    assert partners >= set(range(lost - NEIGHBOURS, lost + NEIGHBOURS + 1))


def test_uncertain_navigation_widens_the_search() -> None:
    scene = make_scene(points=1)
    found = []
    for sigma in (0.0, 0.5):
        records = [replace(r, sigma_horizontal_m=sigma) for r in scene.records]
        sure, maybe = choose_pairs(records, scene.rig, DATUM)
        found.append((set(sure), set(maybe)))
    assert found[0][0] == found[1][0]
    assert len(found[1][1]) > len(found[0][1])


def test_pictures_that_look_alike_get_a_look_where_navigation_is_silent() -> None:
    sure, maybe = choose_pairs(mono(200), None, None, [(3, 150), (4, 5)])
    assert maybe == [(3, 150)]
    assert (4, 5) in sure
    scene = make_scene(points=1)
    placed = (scene.records, scene.rig, DATUM)
    assert choose_pairs(*placed, [(0, 39)]) == choose_pairs(*placed)


def strip(folder: Path, pictures: int = 40, shared: int = 60) -> list[Path]:
    """A line of pictures, each of 100 features, of which it shares most with its neighbours."""
    rng = np.random.default_rng(1)
    floor = rng.gamma(0.6, 25.0, (100 + (pictures - 1) * (100 - shared), 128)).clip(0, 255)
    files = []
    for k in range(pictures):
        seen = floor[k * (100 - shared) :][:100]
        noisy = np.clip(seen + rng.normal(0, 5, seen.shape), 0, 255)
        files.append(folder / f"{k}.npz")
        descriptors = noisy[rng.permutation(100)].astype(np.uint8)
        save_features(files[k], plain_features(np.zeros((100, 2)), descriptors))
    return files


def test_neighbours_look_most_alike(tmp_path: Path) -> None:
    files = strip(tmp_path)
    found = alike_pairs(files, range(len(files)), 2, seed=3, executor=SERIAL)
    near = {(i, i + 1) for i in range(len(files) - 1)}
    assert len(near & set(found)) >= 0.9 * len(near)
    assert len(found) <= 2 * len(files)
    assert found == alike_pairs(files, range(len(files)), 2, seed=3, executor=SERIAL)


def test_vectors_equal_those_of_the_slow_twin(tmp_path: Path) -> None:
    files = strip(tmp_path, pictures=3)
    words = make_codebook(files, seed=4)
    with np.load(files[1]) as data:
        slow = vlad_slowly(data["descriptors"], words)
    np.testing.assert_allclose(describe(files[1], words), slow, atol=1e-5)


@pytest.mark.parametrize("off_nadir_deg", [75.0, 90.0])
def test_pictures_that_see_the_horizon_are_paired_by_order_and_looks(off_nadir_deg: float) -> None:
    scene = make_scene(lines=1, stations=70, points=50)
    tilt = RigidTransform.from_rotation(Rotation.from_euler("x", off_nadir_deg, degrees=True))
    upright: Any = scene.rig.body_from_rig
    rig = replace(scene.rig, body_from_rig=upright * tilt)
    assert not placed_pictures(scene.records, rig, DATUM)
    sure, maybe = choose_pairs(scene.records, rig, DATUM, alike=[(0, 60)])
    assert set(sure) == neighbours(scene.records, NEIGHBOURS)
    assert maybe == [(0, 60)]
    assert len(placed_pictures(scene.records, scene.rig, DATUM)) == len(scene.records)


@pytest.mark.slow
def test_partners_of_a_picture_grow_neither_with_the_survey_nor_with_visits() -> None:
    scene = make_scene(points=1)

    def partners(records: list[ImageRecord]) -> np.ndarray:
        """How many each picture has, coarse looks included."""
        sure, maybe = choose_pairs(records, scene.rig, DATUM)
        return np.bincount(np.ravel([*sure, *maybe]), minlength=len(records))

    few, many = (
        partners(make_scene(lines=lines, stations=10, points=1).records).mean() for lines in (5, 20)
    )
    assert 4 < few < 20 and many < 1.1 * few
    visits = [
        replace(r, station=r.station + 1000 * visit, image=f"{visit}/{r.image}")
        for visit in range(6)
        for r in scene.records
    ]
    once, often = partners(scene.records), partners(visits)
    # six directions on lines along and across, two in each, chosen by either of the two
    assert once.mean() < often.mean() < 2 * (2 * 6 * 2 + 12)
    assert often.max() < len(visits) / 4
