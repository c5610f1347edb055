import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from reconstruct.matching.features import Features, save_features
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
from tests.reconstruct.rig_survey import four_cameras
from tests.reconstruct.scenes import ALTITUDE_M, DATUM, make_scene


def mono(count: int) -> list[ImageRecord]:
    return [ImageRecord(image=f"{i}.png", camera="camera", station=i) for i in range(count)]


def stereo(count: int) -> list[ImageRecord]:
    return [
        ImageRecord(image=f"{side}/{i}.png", camera=side, station=i)
        for side in ("left", "right")
        for i in range(count)
    ]


def test_neighbours_of_stereo_stations_cross_the_cameras() -> None:
    records = stereo(3)
    names = {tuple(sorted((records[i].image, records[j].image))) for i, j in neighbours(records, 1)}
    assert ("left/0.png", "right/0.png") in names
    assert ("left/0.png", "right/1.png") in names
    assert ("left/1.png", "right/0.png") in names
    assert not any({"left/0.png", "right/2.png"} == set(pair) for pair in names)
    assert len(names) == 3 + 2 * 4


def test_many_pictures_with_positions_get_their_nearest() -> None:
    side = 10
    records = []
    for i in range(side * side):
        row, column = divmod(i, side)
        column = column if row % 2 == 0 else side - 1 - column
        latitude, longitude, depth = DATUM.geodetic_from_ned(
            np.array([[row * 10.0, column * 10.0, -80]])
        )[0]
        records.append(
            replace(mono(i + 1)[i], latitude_deg=latitude, longitude_deg=longitude, depth_m=depth)
        )
    sure, maybe = choose_pairs(records, None, DATUM)
    pairs = set(sure) | set(maybe)
    across = [(i, 2 * side - 1 - i) for i in range(side)]  # the next line, side by side
    assert all(pair in pairs for pair in across)
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
    assert north - south == pytest.approx(along, abs=2e-3)
    assert east - west == pytest.approx(across, abs=2e-3)
    assert right.centroid.y - left.centroid.y == pytest.approx(scene.rig.baseline_m, abs=1e-3)
    assert right.centroid.x - left.centroid.x == pytest.approx(0.0, abs=1e-3)


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
    rig = Rig(
        cameras=dict.fromkeys(turns, one),
        cam_from_rig={
            name: RigidTransform.from_rotation(Rotation.from_euler("x", turn, degrees=True)).inv()
            for name, turn in turns.items()
        },
        body_from_rig=four_cameras().body_from_rig,
        source="test",
    )
    scene = make_scene(lines=1, stations=9, points=9000, rig=rig)
    sure, maybe = choose_pairs(scene.records, rig, DATUM)
    shared = {(i, j): len(np.intersect1d(scene.ids[i], scene.ids[j])) for i, j in (*sure, *maybe)}
    cameras: dict[frozenset[str], list[int]] = {}
    for i, j in sure:
        here, there = scene.records[i], scene.records[j]
        if here.station != there.station:
            cameras.setdefault(frozenset((here.camera, there.camera)), []).append(shared[i, j])
    assert set(cameras) >= {frozenset(("fore", "aft")), frozenset(("fore", "beside"))}
    assert frozenset(("aft", "beside")) not in cameras
    assert len(cameras[frozenset(("fore", "aft"))]) >= 5
    assert min(cameras[frozenset(("fore", "aft"))]) > 100
    assert max(np.bincount(np.ravel(sure))) <= 30


def test_pictures_without_navigation_are_tied_to_their_neighbours() -> None:
    scene = make_scene(points=50)
    lost = 6
    records = [replace(r, latitude_deg=np.nan) if r.station == lost else r for r in scene.records]
    sure, _ = choose_pairs(records, scene.rig, DATUM)
    partners = {
        records[k].station
        for pair in sure
        for k in pair
        if lost in {records[i].station for i in pair}
    }
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
    assert choose_pairs(scene.records, scene.rig, DATUM, [(0, 39)]) == choose_pairs(
        scene.records, scene.rig, DATUM
    )


def strip(folder: Path, pictures: int = 40, shared: int = 60) -> list[Path]:
    """A line of pictures, each of 100 features, of which it shares most with its neighbours."""
    rng = np.random.default_rng(1)
    floor = rng.gamma(0.6, 25.0, (100 + (pictures - 1) * (100 - shared), 128)).clip(0, 255)
    files = []
    for k in range(pictures):
        seen = floor[k * (100 - shared) :][:100]
        noisy = np.clip(seen + rng.normal(0, 5, seen.shape), 0, 255)
        files.append(folder / f"{k}.npz")
        save_features(
            files[k],
            Features(
                pixels=np.zeros((100, 2)),
                scale_px=np.ones(100, np.float32),
                descriptors=noisy[rng.permutation(100)].astype(np.uint8),
            ),
        )
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
    upright = scene.rig.body_from_rig
    assert upright is not None
    rig = replace(scene.rig, body_from_rig=upright * tilt)
    assert not placed_pictures(scene.records, rig, DATUM)
    sure, maybe = choose_pairs(scene.records, rig, DATUM, alike=[(0, 60)])
    assert set(sure) == neighbours(scene.records, NEIGHBOURS)
    assert maybe == [(0, 60)]
    assert len(placed_pictures(scene.records, scene.rig, DATUM)) == len(scene.records)


def partners_each(records: list[ImageRecord]) -> tuple[float, int]:
    """Mean and largest number of partners of a picture, coarse looks included."""
    scene = make_scene(points=1)
    sure, maybe = choose_pairs(records, scene.rig, DATUM)
    count = np.bincount(np.ravel([*sure, *maybe]), minlength=len(records))
    return float(count.mean()), int(count.max())


def test_partners_of_a_picture_do_not_grow_with_the_survey() -> None:
    mean = {
        lines: partners_each(make_scene(lines=lines, stations=10, points=1).records)[0]
        for lines in (5, 20)
    }
    assert 4 < mean[5] < 20
    assert mean[20] < 1.1 * mean[5]


def test_partners_of_a_picture_do_not_grow_with_visits_to_the_place() -> None:
    scene = make_scene(points=1)
    visits = [
        replace(r, station=r.station + 1000 * visit, image=f"{visit}/{r.image}")
        for visit in range(6)
        for r in scene.records
    ]
    once, _ = partners_each(scene.records)
    often, maximum = partners_each(visits)
    # six directions on lines along and across, two in each, chosen by either of the two
    assert once < often < 2 * (2 * 6 * 2 + 12)
    assert maximum < len(visits) / 4
