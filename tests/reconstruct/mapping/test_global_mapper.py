from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL, local_executor
from reconstruct.mapping import global_mapper
from reconstruct.mapping.arrays import model_groups
from tests.reconstruct.mapping import test_mapper
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import pupils, rigid_rms


def station_poses(scene: Scene) -> dict[int, RigidTransform]:
    """ned_from_rig by station."""
    return {
        r.station: pose * scene.rig.cam_from_rig[r.camera]
        for r, pose in zip(scene.records, scene.ned_from_cam, strict=True)
    }


def ring(
    rng: np.random.Generator, noise: float = 0.0
) -> tuple[list[global_mapper.StationLink], list[RigidTransform]]:
    """Twelve stations, each linked to the next three, with exact or noisy relative poses."""

    def drawn(count: int, metres: float, turn_rad: float) -> RigidTransform:
        turns = Rotation.from_rotvec(rng.normal(0, turn_rad, (count, 3)))
        return RigidTransform.from_components(rng.normal(0, metres, (count, 3)), turns)

    poses = [*drawn(12, 3.0, 1.0)]
    ends = [(a, (a + step) % 12) for a in range(12) for step in (1, 2, 3)]
    relative = [
        error * poses[b] * poses[a].inv()
        for (a, b), error in zip(ends, drawn(36, noise, noise), strict=True)
    ]
    return [linked(*pair, pose) for pair, pose in zip(ends, relative, strict=True)], poses


def linked(a: int, b: int, pose: RigidTransform) -> global_mapper.StationLink:
    return global_mapper.StationLink(
        first=a, second=b, quaternion=pose.rotation.as_quat(), shift=pose.translation,
        turn_variance=1e-6, shift_variance=4e-6,
    )  # fmt: skip


def misses(links: list[global_mapper.StationLink], poses: list[RigidTransform]) -> np.ndarray:
    """Errors (rotation in rad, position) after moving both to the first station's frame."""
    found = global_mapper.average_poses(links)
    errors = [found[k] * found[0].inv() * poses[0] * pose.inv() for k, pose in enumerate(poses)]
    return np.array([[e.rotation.magnitude(), np.linalg.norm(e.translation)] for e in errors[1:]])


def test_exact_links_give_back_exact_poses() -> None:
    links, poses = ring(np.random.default_rng(1))
    assert misses(links, poses).max() < 1e-9


def test_averaging_beats_the_links_and_ignores_a_wrong_one() -> None:
    noise = 2e-3
    links, poses = ring(np.random.default_rng(2), noise)
    clean = misses(links, poses)[:, 0]
    assert 0.1 * noise < np.sqrt((clean**2).mean()) < 2.0 * noise
    turned = Rotation.from_rotvec([0.0, 0.0, 1.0])
    wrong = links[4].second_from_first
    wrong = RigidTransform.from_components(wrong.translation + 1.0, turned * wrong.rotation)
    links[4] = linked(links[4].first, links[4].second, wrong)
    spoiled = misses(links, poses)[:, 0]
    assert np.abs(spoiled - clean).max() < 2.0 * noise


def test_groups_without_a_link_stay_apart() -> None:
    links, _ = ring(np.random.default_rng(3))
    far = linked(40, 41, RigidTransform.identity())
    assert global_mapper.station_groups([*links, far]) == [list(range(12)), [40, 41]]
    with pytest.raises(ValueError):
        global_mapper.average_poses([*links, far])


def test_stereo_points_lie_where_the_floor_is() -> None:
    scene = make_scene(lines=1, stations=2, points=2500)
    seen = test_mapper.seen_by_pinholes(scene)
    found = global_mapper.stereo_points(seen, test_mapper.pinhole_rig(scene, seen))
    poses = station_poses(scene)
    for record, points, ids in zip(scene.records, found, scene.ids, strict=True):
        known = np.isfinite(points[:, 0])
        assert known.mean() > 0.7
        true = poses[record.station].inv().apply(scene.points_ned[ids[known]])
        # The warp is exact at one range only: up to 3 mm of range are left by the relief.
        assert np.abs(points[known] - true).max() < 4e-3


def test_links_are_the_true_relative_poses() -> None:
    scene = make_scene(lines=2, stations=4, points=5000, noise_px=0.1)
    seen = test_mapper.seen_by_pinholes(scene)
    links = global_mapper.link_stations(seen, test_mapper.pinhole_rig(scene, seen), 1, SERIAL)
    poses = station_poses(scene)
    assert {(k.first, k.second) for k in links} | {(k.second, k.first) for k in links} >= {
        (k, k + 1) for k in range(3)
    }
    assert len(links) >= 6
    for link in sorted(links, key=lambda link: link.turn_variance)[: max(6, len(links) // 2)]:
        true = poses[link.second].inv() * poses[link.first]
        error = link.second_from_first * true.inv()
        assert error.rotation.magnitude() < 0.02
        assert np.linalg.norm(error.translation) < 0.04


def test_global_mapping_is_as_good_as_incremental(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(lines=3, stations=5, points=7000, noise_px=0.3)
    at_once = test_mapper.mapped_scene(scene)
    monkeypatch.setattr("reconstruct.mapping.mapper.map_globally", lambda *_: [])
    one_by_one = test_mapper.mapped_scene(scene)
    assert at_once.models == one_by_one.models == (30,)
    assert "global" in at_once.notes[0] and "incremental" in one_by_one.notes[0]
    assert (
        0.2e-3
        < test_mapper.camera_rms(at_once, scene)
        < 1.2 * test_mapper.camera_rms(one_by_one, scene)
    )
    errors = [m.model.compute_mean_reprojection_error() for m in (at_once, one_by_one)]
    assert errors[0] == pytest.approx(errors[1], rel=0.02)


def test_threads_do_not_change_a_byte(tmp_path: Path) -> None:
    scene = make_scene(lines=2, stations=4, points=3500, noise_px=0.3)
    for threads in (1, 2):
        (tmp_path / str(threads)).mkdir()
        test_mapper.mapped_scene(scene, local_executor(threads)).model.write_binary(
            tmp_path / str(threads)
        )
    for file in sorted((tmp_path / "1").iterdir()):
        assert file.read_bytes() == (tmp_path / "2" / file.name).read_bytes()


def test_models_that_no_match_links_are_kept_apart() -> None:
    scene = make_scene(lines=1, stations=10, points=6000, noise_px=0.2)
    halves = [record.station < 6 for record in scene.records]
    kept = [pair for pair in scene.pairs if halves[pair[0]] == halves[pair[1]]]
    mapped = test_mapper.mapped_scene(replace(scene, pairs=kept))
    assert mapped.models == (12, 8)
    assert not [note for note in mapped.notes if "separate model" in note]
    groups = model_groups(mapped.model)
    np.testing.assert_array_equal(groups, [0] * 6 + [1] * 4)
    found, true = pupils(mapped, scene)
    own = [np.repeat(groups == group, 2) for group in (0, 1)]
    for rows in own:
        assert 0.05e-3 < rigid_rms(found[rows], true[rows]) < 5e-3
    ends = [found[rows, 0] for rows in own]
    assert ends[1].min() - ends[0].max() > np.ptp(found[own[0]], axis=0).max()
    assert mapped.model.compute_mean_reprojection_error() < 0.5
