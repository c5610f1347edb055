"""Tracks say how surely each picture's pose is known, in every format."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array, Datum, attitude_from_rotation, rotation_from_attitude
from alice_survey.core.records import GeoreferenceRecord
from reconstruct.adjustment.uncertainty import SoftModes, Uncertainty, no_modes
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.fit import PlacementFit
from reconstruct.placing.navigation import attitude_axes
from reconstruct.placing.track import (
    SIGMAS,
    TrackRow,
    attitude_sigmas_deg,
    pose_covariances,
    read_track_poses,
    track_sigmas,
    write_track_csv,
    write_track_geojson,
)
from reconstruct.views.model import WorldFrame

DATUM = Datum(32.8236, 34.9553)
FRAME = WorldFrame(name="ned", datum=DATUM, scaled=True, vertical_datum="sea surface")


def random_poses(count: int, seed: int = 0) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(
        rng.uniform(-5, 5, (count, 3)), Rotation.random(count, rng=rng)
    )


def random_covariance(size: int, seed: int, scale: float) -> Array:
    factor = np.random.default_rng(seed).normal(0, scale, (size, size))
    return np.asarray(factor @ factor.T)


def scatter(true: RigidTransform, moved: list[RigidTransform]) -> Array:
    """(N, 6, 6) covariances of poses drawn many times: position, turn about the world's axes."""
    shifts = np.stack([m.translation - true.translation for m in moved])
    turns = np.stack([(m.rotation * true.rotation.inv()).as_rotvec() for m in moved])
    both = np.concatenate([shifts, turns], axis=2)
    return np.asarray(np.einsum("dni,dnj->nij", both, both) / len(moved))


def assert_close(found: Array, drawn: Array) -> None:
    """Within what some thousand draws determine."""
    size = np.sqrt(np.einsum("nii->ni", drawn))
    np.testing.assert_allclose(
        (found - drawn) / (size[:, :, None] * size[:, None, :]), 0.0, atol=0.12
    )


HERE = Similarity(scale=1.0, rotation=Rotation.identity(), translation=np.zeros(3))


def rows_of(poses: RigidTransform, station: int = 0) -> list[TrackRow]:
    """Pictures of one station, the first being that of the reference camera."""
    return [
        TrackRow(
            image="ab"[k] if k < 2 else str(k), station=station, camera="left", time_s=0.0,
            world_from_cam=pose, points=1, reprojection_px=0.1, world_from_body=pose.rotation,
        )
        for k, pose in enumerate(poses)
    ]  # fmt: skip


def placed(middle: Array, covariance: Array) -> PlacementFit:
    """A place of this covariance."""
    return PlacementFit(
        ned_from_model=HERE, middle_ned=middle, correlation={}, modes=np.zeros(0),
        joint=covariance, bends=(), stated=GeoreferenceRecord(),
    )  # fmt: skip


def shape_of(pictures: dict[int, str], frame_cov: Array, modes: SoftModes) -> Uncertainty:
    """Of stations with these reference pictures, without points."""
    none = np.zeros((0, 3, 3))
    return Uncertainty(
        frames=np.arange(len(pictures)), stations=np.array([*pictures]),
        images=tuple(pictures.values()), frame_cov=frame_cov, point_ids=np.zeros(0, np.int64),
        point_cov=none, point_noise=none, sigma_px=0.3, modes=modes,
    )  # fmt: skip


def test_errors_of_the_place_move_every_picture_as_the_covariance_says() -> None:
    poses, middle = random_poses(4), np.array([1.0, -2.0, 0.5])
    covariance = random_covariance(7, 1, 1e-3)
    drawn = np.random.default_rng(2).multivariate_normal(np.zeros(7), covariance, 3000)
    moved = []
    for turn, shift, grow in zip(drawn[:, :3], drawn[:, 3:6], drawn[:, 6], strict=True):
        rotation = Rotation.from_rotvec(turn)
        places = middle + np.exp(grow) * rotation.apply(poses.translation - middle) + shift
        moved.append(RigidTransform.from_components(places, rotation * poses.rotation))
    found = pose_covariances(rows_of(poses), placed(middle, covariance), None, HERE)
    assert_close(found, scatter(poses, moved))


@pytest.mark.slow
def test_errors_of_a_station_move_its_other_camera_on_its_arm() -> None:
    """The rig's origin is off in the model; both its pictures follow, in the world."""
    rng = np.random.default_rng(3)
    place = Similarity(
        scale=2.0, rotation=Rotation.random(rng=rng), translation=np.array([4.0, 5.0, 6.0])
    )
    in_model = random_poses(1, 4)[0]
    arm = RigidTransform.from_translation([0.6, 0.0, 0.0])  # of the second camera
    covariance = random_covariance(6, 5, 1e-3)

    def world(pose: RigidTransform) -> RigidTransform:
        at = place.apply(pose.translation[None])[0]
        return RigidTransform.from_components(at, place.rotation * pose.rotation)

    both = [in_model, in_model * arm]
    moved = []
    for draw in rng.multivariate_normal(np.zeros(6), covariance, 3000):
        turned = RigidTransform.from_components(
            in_model.translation + draw[3:], Rotation.from_rotvec(draw[:3]) * in_model.rotation
        )
        moved.append(RigidTransform.concatenate([world(turned), world(turned * arm)]))
    true = RigidTransform.concatenate([world(pose) for pose in both])
    known = shape_of({7: "a"}, covariance[None], no_modes(1, 0))
    assert_close(pose_covariances(rows_of(true, 7), None, known, place), scatter(true, moved))
    assert np.isnan(pose_covariances(rows_of(true, 8), None, known, place)).all()


def test_place_and_soft_modes_err_together() -> None:
    """A mode that bends two stations, half known, and correlated with where the whole lies."""
    rng = np.random.default_rng(7)
    poses, middle = random_poses(2, 3), np.array([0.5, -1.0, 2.0])
    modes = SoftModes(
        stations=rng.normal(0, 1e-3, (2, 6, 2)), points=np.zeros((0, 3, 2)),
        calibration=np.zeros((0, 2)),
    )  # fmt: skip
    rest = random_covariance(6, 4, 5e-4)
    spread = modes.stations @ modes.stations.swapaxes(1, 2)
    known = shape_of({0: "0", 1: "1"}, spread + rest, modes)
    size = np.diag([1e-3] * 7 + [0.6] * 2)
    joint = size @ random_covariance(9, 8, 1.0) @ size
    place = Similarity(scale=1.5, rotation=Rotation.random(rng=rng), translation=np.zeros(3))
    turn = place.rotation.as_matrix()
    fit = replace(placed(middle, joint[:7, :7]), modes=np.zeros(2), joint=joint)
    moved = []
    for draw, local in zip(
        rng.multivariate_normal(np.zeros(9), joint, 4000),
        rng.multivariate_normal(np.zeros(6), rest, (4000, 2)),
        strict=True,
    ):
        step = modes.stations @ draw[7:] + local
        rotation = Rotation.from_rotvec(draw[:3])
        places = middle + np.exp(draw[6]) * rotation.apply(poses.translation - middle) + draw[3:6]
        places = places + 1.5 * step[:, 3:] @ turn.T
        turned = Rotation.from_rotvec(step[:, :3] @ turn.T) * rotation * poses.rotation
        moved.append(RigidTransform.from_components(places, turned))
    rows = [replace(row, station=k, image=str(k)) for k, row in enumerate(rows_of(poses))]
    assert_close(pose_covariances(rows, fit, known, place), scatter(poses, moved))


@pytest.mark.parametrize("angles_deg", [(0, 0, 0), (5, -8, 120), (20, 30, -170)])
def test_axes_of_the_attitude_are_its_derivatives(angles_deg: tuple[float, ...]) -> None:
    angles = np.deg2rad(angles_deg)
    axes = attitude_axes(Rotation.concatenate([rotation_from_attitude(*angles)]))[0]
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        turn = rotation_from_attitude(*(angles + step)) * rotation_from_attitude(*angles).inv()
        np.testing.assert_allclose(turn.as_rotvec() / 1e-6, axes[:, k], atol=1e-5)


def test_sigmas_of_the_attitude_are_those_of_the_vehicle_not_of_north() -> None:
    """One degree about north is roll when heading north, pitch when heading east."""
    covariance = np.zeros((1, 6, 6))
    covariance[0, 3, 3] = np.deg2rad(1.0) ** 2
    north = Rotation.concatenate([rotation_from_attitude(0, 0, 0)])
    east = Rotation.concatenate([rotation_from_attitude(0, 0, np.pi / 2)])
    np.testing.assert_allclose(attitude_sigmas_deg(north, covariance), [[1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(attitude_sigmas_deg(east, covariance), [[0, 1, 0]], atol=1e-9)


def rows() -> list[TrackRow]:
    return [
        replace(row, station=k // 2, time_s=np.nan if k == 2 else float(k // 2))
        for k, row in enumerate(rows_of(random_poses(3)))
    ]


def test_a_track_keeps_its_poses_and_says_its_sigmas(tmp_path: Path) -> None:
    track = rows()
    covariances = np.stack([random_covariance(6, k, 0.01) for k in range(3)])
    sigmas = track_sigmas(track, covariances)
    write_track_csv(tmp_path / "track.csv", track, FRAME, sigmas)
    poses = read_track_poses(tmp_path / "track.csv")
    for row in track:
        np.testing.assert_allclose(
            poses[row.image].as_matrix(), row.world_from_cam.as_matrix(), atol=1e-8
        )
    header, first = (tmp_path / "track.csv").read_text().splitlines()[:2]
    assert header.split(",")[-6:] == list(SIGMAS)
    stated = [float(cell) for cell in first.split(",")[-6:]]
    np.testing.assert_allclose(stated[:3], np.sqrt(np.diag(covariances[0])[:3]), rtol=1e-5)
    nothing = track_sigmas(track, None)
    write_track_csv(tmp_path / "none.csv", track, FRAME, nothing)
    assert (tmp_path / "none.csv").read_text().splitlines()[1].endswith(",,,,,,")


def test_geojson_is_where_the_cameras_are(tmp_path: Path) -> None:
    track = rows()
    write_track_geojson(tmp_path / "t.geojson", track, FRAME, track_sigmas(track, None))
    data = json.loads((tmp_path / "t.geojson").read_text())
    line, *points = data["features"]
    assert line["geometry"]["type"] == "LineString"
    assert len(line["geometry"]["coordinates"]) == 2  # stations
    for row, point in zip(track, points, strict=True):
        east, north, height = point["geometry"]["coordinates"]
        back = DATUM.ned_from_geodetic(np.array([[north, east, DATUM.height_m - height]]))[0]
        np.testing.assert_allclose(back, row.world_from_cam.translation, atol=1e-4)
        heading = np.rad2deg(attitude_from_rotation(row.world_from_body))[2] % 360
        assert point["properties"]["heading_deg"] == pytest.approx(heading, abs=1e-5)
        assert point["properties"]["sigma_north_m"] is None
    assert points[2]["properties"]["time_s"] is None
