from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.manifest import ImageRecord
from reconstruct.mapping.database import Observations, write_database
from reconstruct.mapping.mapper import (
    Mapped,
    _options,
    collapsed_frames,
    map_calibrated,
    merge_models,
    model_baseline,
    report_left_out,
    second_from_first,
)
from reconstruct.mapping.self_calibration import map_self_calibrated
from reconstruct.placing.alignment import align_similarity
from reconstruct.placing.run import measure_doming
from reconstruct.views.model_files import as_transform, rigid3d
from tests.reconstruct.rig_survey import four_cameras
from tests.reconstruct.scenes import Scene, make_scene, match_pictures
from tests.reconstruct.true_models import pupils, rigid_rms, warped_scene

NAMES = ("wide", "tele", "bow", "side")


def seen_by_pinholes(scene: Scene) -> Observations:
    return replace(warped_scene(scene)[0], pairs=scene.pairs)


def pinhole_rig(scene: Scene, seen: Observations) -> dict[str, RigidTransform]:
    return {n: seen.warps[n].pinhole_from_cam * p for n, p in scene.rig.cam_from_rig.items()}


def mapped_scene(scene: Scene, executor: Executor = SERIAL) -> Mapped:
    seen, poses = seen_by_pinholes(scene), scene.rig.cam_from_rig
    with TemporaryDirectory() as folder:
        return map_calibrated(seen, poses, Path(folder), 1, executor=executor)


def camera_rms(mapped: Mapped, scene: Scene) -> float:
    return rigid_rms(*pupils(mapped, scene))


@cache
def block() -> Scene:
    return make_scene(points=8000, noise_px=0.3)


@cache
def block_mapped() -> Mapped:
    return mapped_scene(block())


def test_without_noise_only_the_warp_is_left() -> None:
    """The warp is exact at one range; relief of 0.16 m leaves a fraction of a millimetre."""
    scene = make_scene(lines=2, stations=5, points=6000)
    mapped = mapped_scene(scene)
    assert mapped.models[0] == len(scene.records)
    assert camera_rms(mapped, scene) < 0.4e-3
    assert align_similarity(*pupils(mapped, scene)).scale == pytest.approx(1.0, abs=4e-4)
    assert mapped.model.compute_mean_reprojection_error() < 0.01


def test_noise_of_a_third_of_a_pixel_costs_millimetres() -> None:
    scene, mapped = block(), block_mapped()
    assert mapped.models[0] == len(scene.records)
    assert 0.2e-3 < camera_rms(mapped, scene) < 4e-3
    assert 0.2 < mapped.model.compute_mean_reprojection_error() < 0.4
    assert abs(align_similarity(*pupils(mapped, scene)).scale - 1.0) < 2e-3


def test_pictures_of_blue_water_ask_for_no_second_mapping(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two stations of ten match nothing, nor does one camera of a third."""
    scene = make_scene(lines=2, stations=5, points=6000)
    blank = [i for i, record in enumerate(scene.records) if record.station in (0, 9)]
    blank.append(next(i for i, record in enumerate(scene.records) if record.station == 5))
    pairs = [pair for pair in scene.pairs if not {*pair[:2]} & {*blank}]
    for name in ("run_mapper", "_continue_mapping"):
        monkeypatch.delattr(f"reconstruct.mapping.mapper.{name}")
    mapped = mapped_scene(replace(scene, pairs=pairs))
    assert mapped.notes[0] == "global mapping of stations"
    assert mapped.models == (16,) and len(mapped.model.frames) == 8


def test_the_scale_is_that_of_the_rig() -> None:
    """A rig given twice as large gives a model twice as large: nothing else sets the scale."""
    scene = make_scene(lines=1, stations=6, points=4000, noise_px=0.1)
    twice = {
        name: RigidTransform.from_components(2.0 * pose.translation, pose.rotation)
        for name, pose in scene.rig.cam_from_rig.items()
    }
    mapped = mapped_scene(replace(scene, rig=replace(scene.rig, cam_from_rig=twice)))
    assert align_similarity(*pupils(mapped, scene)).scale == pytest.approx(0.5, rel=5e-3)


@pytest.mark.parametrize("names", [NAMES, pytest.param(NAMES[1:], marks=pytest.mark.slow)])
def test_any_number_of_unlike_cameras_map_to_the_same_truth(names: tuple[str, ...]) -> None:
    """Also without the camera whose frame is the rig's."""
    rig = four_cameras()
    chosen = replace(rig, cameras={name: rig.cameras[name] for name in names},
                     cam_from_rig={name: rig.cam_from_rig[name] for name in names})  # fmt: skip
    scene = make_scene(lines=2, stations=5, points=6000, noise_px=0.1, rig=chosen)
    mapped = mapped_scene(scene)

    assert mapped.models[0] == len(scene.records) == 10 * len(names)
    assert mapped.notes == ("global mapping of stations",)
    assert 0.02e-3 < camera_rms(mapped, scene) < 1e-3
    assert abs(align_similarity(*pupils(mapped, scene)).scale - 1.0) < 5e-4
    trend = measure_doming(mapped.model, ()).scale
    assert trend.mean == pytest.approx(1.0, abs=1e-3)


def test_the_rig_is_held_constant_and_the_cameras_too() -> None:
    scene, mapped = block(), block_mapped()
    model = mapped.model
    assert mapped.baseline == pytest.approx(0.1, rel=1e-12)
    assert model_baseline(model) == pytest.approx(0.1, rel=1e-9)
    poses = {n: as_transform(image.cam_from_world()) for n, image in model.images.items()}
    for number in range(1, len(scene.records), 2):
        shift = (poses[number + 1] * poses[number].inv()).translation
        np.testing.assert_allclose(shift, [-0.1, 0, 0], atol=1e-9)
    for name, number in (("left", 1), ("right", 2)):
        expected = mapped.warps[name].pinhole
        focal, _, cx, cy = model.cameras[number].params
        assert (focal, cx, cy) == (expected.focal_px, expected.cx_px, expected.cy_px)


PAIR, SLOW = ("left", "right"), pytest.mark.slow


@pytest.mark.parametrize(
    ("names", "exif"),
    [
        (PAIR, ()),
        pytest.param(PAIR, PAIR, marks=SLOW),
        pytest.param((*PAIR, "top"), (), marks=SLOW),
    ],
)
def test_self_calibration_finds_focal_length_distortion_and_rig(
    names: tuple[str, ...], exif: tuple[str, ...]
) -> None:
    """In plain air, with tilted views: what comes out must be what went in.

    Also where EXIF states a focal length that is a quarter too long.
    """
    rng = np.random.default_rng(2)
    truth = pycolmap.Camera(
        model="OPENCV", width=800, height=600,
        params=[760.0, 760.0, 400.0, 300.0, -0.08, 0.03, 0.0, 0.0],
    )  # fmt: skip
    scene = oblique_scene(truth, rng, names)
    start = pycolmap.Camera(model="RADIAL", width=800, height=600, params=[960.0, 400, 300, 0, 0])
    seen = Observations(
        images=scene.records,
        cameras={name: pycolmap.Camera(start.todict()) for name in names},
        taken=scene.pixels,
        pairs=scene.pairs,
    )
    with TemporaryDirectory() as folder:
        mapped = map_self_calibrated(seen, exif, Path(folder), 1)
    assert mapped.models[0] == len(scene.records)
    assert not mapped.scaled
    assert mapped.baseline == 1.0
    assert [len(rig.non_ref_sensors) for rig in mapped.model.rigs.values()] == [len(names) - 1]
    assert model_baseline(mapped.model) == pytest.approx(1.0, rel=1e-9)
    for warp in mapped.warps.values():
        assert warp.camera.fx_px == pytest.approx(760, rel=0.01)
        assert warp.camera.parameter("k1") == pytest.approx(-0.08, abs=0.02)
    found, true = pupils(mapped, scene)
    fit = align_similarity(found, true)
    assert np.sqrt(((fit.apply(found) - true) ** 2).sum(axis=1).mean()) < 0.01
    assert fit.scale == pytest.approx(0.2, rel=0.02)  # metres in a baseline
    assert mapped.model.compute_mean_reprojection_error() < 0.4
    assert {camera.model_name for camera in mapped.model.cameras.values()} == {"PINHOLE"}


def oblique_scene(camera: pycolmap.Camera, rng: np.random.Generator, names: Sequence[str]) -> Scene:
    """Eight stations around a bumpy floor, looking at its middle; 0.2 m from left to right."""
    points = np.column_stack([rng.uniform(-1.6, 1.6, (700, 2)), rng.uniform(-0.25, 0.25, 700)])
    records, poses, pixels, ids = [], [], [], []
    shifts = np.array([[0, 0, 0], [-0.2, 0, 0], [-0.1, 0.25, 0.02]])
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0.03, 0.01], [-0.1, 0.05, 0.2]])
    cam_from_left = RigidTransform.from_components(shifts, turns)
    for station, angle in enumerate(0.35 * np.arange(8)):
        place = np.array([1.6 * np.cos(angle), 1.6 * np.sin(angle), -2.0])
        axes, _ = Rotation.align_vectors(
            np.array([-place, [0, 0, 1]]), np.eye(3)[[2, 1]], [np.inf, 1]
        )
        for name, turned in zip(names, cam_from_left, strict=False):  # left, right and top
            pose = RigidTransform.from_components(place, axes) * turned.inv()
            local = pose.inv().apply(points)
            seen = np.asarray(camera.img_from_cam(local))
            inside = np.all((seen > 0) & (seen < [800, 600]), axis=1) & (local[:, 2] > 0.3)
            ids.append(np.flatnonzero(inside))
            pixels.append(seen[inside] + rng.normal(0, 0.2, (int(inside.sum()), 2)))
            poses.append(pose)
            records.append(ImageRecord(image=f"{name}/{station}.png", camera=name, station=station))
    near = [(i, j) for i, j in combinations(range(len(ids)), 2)
            if abs(records[i].station - records[j].station) <= 3]  # fmt: skip
    return replace(
        make_scene(lines=1, stations=1, points=1),
        records=records,
        ned_from_cam=poses,
        points_ned=points,
        pixels=pixels,
        ids=ids,
        pairs=match_pictures(ids, near, 30, 3),
    )


def collapse(model: pycolmap.Reconstruction, frame: int, onto: int) -> None:
    """Put a frame onto another, and what both saw into their common centre."""
    pose = model.frames[onto].rig_from_world
    model.frames[frame].rig_from_world = pose
    centre = pose.inverse().translation
    for point in model.points3D.values():
        frames = {model.images[e.image_id].frame_id for e in point.track.elements}
        if frame in frames:
            point.xyz = centre


def test_a_station_that_collapsed_onto_another_is_registered_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As COLMAP's adjustment of a first pair of arbitrary scale leaves it now and then."""
    mapper, begun_from = pycolmap.incremental_mapping, []

    def collapsing(database, images, output, options, **rest):
        begun_from.append(rest.get("input_path"))
        found = mapper(database, images, output, options, **rest)
        if len(begun_from) == 1:
            for number, model in found.items():
                assert collapsed_frames(model) == []
                collapse(model, 3, onto=4)
                assert 3 in collapsed_frames(model)
                model.write(Path(output) / str(number))
        return found

    monkeypatch.setattr(pycolmap, "incremental_mapping", collapsing)
    monkeypatch.setattr("reconstruct.mapping.mapper.map_globally", lambda *_: [])
    scene = make_scene(lines=1, stations=7, points=5000, noise_px=0.3)
    mapped = mapped_scene(scene)

    assert len(begun_from) == 2
    assert begun_from[1] is not None
    assert mapped.model.num_reg_images() == len(scene.records)
    assert collapsed_frames(mapped.model) == []
    assert 1e-5 < camera_rms(mapped, scene) < 0.01


def part(model: pycolmap.Reconstruction, keep: set[int]) -> pycolmap.Reconstruction:
    """A model of some frames only."""
    found = pycolmap.Reconstruction(model)
    for frame in sorted(set(found.reg_frame_ids()) - keep):
        found.deregister_frame(frame)
    return found


def test_models_that_share_stations_become_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = make_scene(lines=1, stations=9, points=5500, noise_px=0.2)
    mapped = mapped_scene(scene)
    move = RigidTransform.from_components([3.0, -2.0, 1.0], Rotation.from_rotvec([0.3, -1.0, 0.4]))
    first = part(mapped.model, {1, 2, 3, 4, 5, 6})
    second = part(mapped.model, {6, 7, 8, 9})
    second.transform(pycolmap.Sim3d(1.0, rigid3d(move).rotation, move.translation))
    found = second_from_first(first, second)
    np.testing.assert_allclose(found.as_matrix(), move.as_matrix(), atol=1e-9)

    seen = seen_by_pinholes(scene)
    rig = pinhole_rig(scene, seen)
    write_database(tmp_path / "d.db", seen, rig)
    joined = merge_models([first, second], tmp_path / "d.db", _options(rig, 1, "nothing"))
    assert [m.num_reg_images() for m in joined] == [18]
    whole = [
        as_transform(m.frames[9].rig_from_world) * as_transform(m.frames[1].rig_from_world).inv()
        for m in (mapped.model, joined[0])
    ]
    error = whole[0] * whole[1].inv()
    assert error.rotation.magnitude() < 2e-3
    assert np.linalg.norm(error.translation) < 5e-3

    alone = part(mapped.model, {7, 8, 9})
    first = part(mapped.model, {1, 2, 3})
    assert second_from_first(first, alone) is None
    assert len(merge_models([first, alone], tmp_path / "d.db", _options(rig, 1, "nothing"))) == 2
    (note,) = report_left_out([first, alone])
    assert "6 pictures" in note and "left/000006.png" in note
    assert note in capsys.readouterr().err
    assert report_left_out([first]) == report_left_out([]) == []
