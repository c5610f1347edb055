from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Datum, rotation_from_attitude
from missions.logs.ros_builder import (
    BagRecord,
    flipped_body,
    flipped_quaternion,
    flipped_world,
    write_bag,
)

ENU_FROM_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def flight(rows: int = 40) -> BagRecord:
    """A climb along a circle."""
    rng = np.random.default_rng(5)
    time_s = np.arange(rows, dtype=float) * 0.1
    place = np.column_stack([5 * np.cos(time_s), 5 * np.sin(time_s), 10.0 - 0.3 * time_s])
    truth = RigidTransform.from_components(
        place, rotation_from_attitude(0.2 * np.sin(time_s), 0.1 * np.cos(time_s), time_s)
    )
    sigma = np.linspace(0.1, 0.4, rows)
    beams = rng.uniform(1.0, 3.0, (rows // 2, 4))
    beams[3, 1] = np.nan
    return BagRecord(
        name="alice",
        datum=Datum(32.83, 34.95, 17.5),
        time_s=time_s,
        truth=truth,
        truth_velocity=rng.normal(size=(rows, 6)),
        believed=RigidTransform.from_components(place + 0.25, truth.rotation),
        believed_velocity=rng.normal(size=(rows, 6)),
        sigma_horizontal_m=sigma,
        sigma_depth_m=sigma / 2,
        sigma_attitude_rad=sigma / 10,
        sigma_heading_rad=sigma / 5,
        altitude_m=np.where(np.arange(rows) == 7, np.nan, 2.0 + 0.01 * time_s),
        thrusters=("port", "starboard"),
        rpm=rng.uniform(-3000, 3000, (rows, 2)),
        power_w=rng.uniform(0, 200, (rows, 2)),
        beam_time_s=time_s[::2],
        beam_m=beams,
        notes={"vehicle": "alice"},
    )


def read(path: Path) -> dict[str, list[Any]]:
    """Messages by topic, by a reader of other makers."""
    found: dict[str, list[Any]] = {}
    with (path / f"{path.name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            assert message.log_time == message.publish_time
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


def xyzw(q: Any) -> np.ndarray:
    return np.array([q.x, q.y, q.z, q.w])


def test_frames_are_those_of_ros_and_come_back() -> None:
    ned_from_frd = Rotation.random(200, rng=1)
    points = np.random.default_rng(2).normal(size=(200, 3))

    turned = Rotation.from_quat(flipped_quaternion(ned_from_frd.as_quat()))

    expected = ENU_FROM_NED * ned_from_frd * FRD_FROM_FLU
    assert (turned * expected.inv()).magnitude().max() < 1e-14
    back = Rotation.from_quat(flipped_quaternion(turned.as_quat()))
    assert (back * ned_from_frd.inv()).magnitude().max() < 1e-14
    np.testing.assert_array_equal(flipped_world(points), points[:, [1, 0, 2]] * [1, 1, -1])
    np.testing.assert_array_equal(flipped_world(flipped_world(points)), points)
    np.testing.assert_array_equal(flipped_body(flipped_body(points)), points)


def test_a_bag_holds_the_flight_in_enu_and_flu(tmp_path: Path) -> None:
    record = flight()
    write_bag(tmp_path / "dive", record)
    found = read(tmp_path / "dive")
    truth = found["/alice/truth/odometry"]
    assert [stamp for stamp, _ in truth] == [100_000_000 * i for i in range(40)]
    for i, (stamp, message) in enumerate(truth):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        frames = (message.header.frame_id, message.child_frame_id)
        assert frames == ("map", "alice/base_link_truth")
        north, east, down = record.truth.translation[i]
        np.testing.assert_allclose(
            xyz(message.pose.pose.position), [east, north, -down], atol=1e-12
        )
        turned = Rotation.from_quat(xyzw(message.pose.pose.orientation))
        expected = ENU_FROM_NED * record.truth.rotation[i] * FRD_FROM_FLU
        assert (turned * expected.inv()).magnitude() < 1e-12
        u, v, w, p, q, r = record.truth_velocity[i]
        np.testing.assert_allclose(xyz(message.twist.twist.linear), [u, -v, -w])
        np.testing.assert_allclose(xyz(message.twist.twist.angular), [p, -q, -r])

    # Navigation carries its covariance.
    s = record.sigma_horizontal_m[9]
    message = found["/alice/navigation/odometry"][9][1]
    variances = [s**2, s**2, (s / 2) ** 2, (s / 10) ** 2, (s / 10) ** 2, (s / 5) ** 2]
    np.testing.assert_allclose(np.reshape(message.pose.covariance, (6, 6)), np.diag(variances))
    fix = found["/alice/navigation/fix"][9][1]
    back = record.datum.ned_from_geodetic(
        np.array([[fix.latitude, fix.longitude, 17.5 - fix.altitude]])
    )
    np.testing.assert_allclose(back[0], record.believed.translation[9], atol=1e-8)
    transforms = found["/tf"][9][1].transforms
    assert [t.child_frame_id for t in transforms] == ["alice/base_link", "alice/base_link_truth"]
    np.testing.assert_allclose(
        xyz(transforms[0].transform.translation), xyz(message.pose.pose.position)
    )

    joints = found["/alice/thrusters/state"][4][1]
    assert list(joints.name) == ["port", "starboard"]
    np.testing.assert_allclose(np.array(joints.velocity) * 60 / (2 * np.pi), record.rpm[4])
    power = found["/alice/thrusters/power"][4][1]
    assert power.layout.dim[0].label == "port,starboard"
    np.testing.assert_allclose(power.data, record.power_w[4])
    assert [stamp for stamp, _ in found["/alice/dvl/beam_4"]][:3] == [0, 200_000_000, 400_000_000]
    assert found["/alice/dvl/beam_2"][3][1].range == np.inf
    assert found["/alice/dvl/beam_1"][3][1].range < 3.0
    assert found["/alice/navigation/altitude"][7][1].range == np.inf
    ((_, datum),) = found["/alice/datum"]
    assert (datum.latitude, datum.longitude, datum.altitude) == (32.83, 34.95, 17.5)


def test_the_same_flight_gives_the_same_bytes(tmp_path: Path) -> None:
    later = replace(flight(), time_s=flight().time_s + 1e-9)
    for folder, record in (("a", flight()), ("b", flight()), ("c", later)):
        write_bag(tmp_path / folder / "dive", record)
    for name in ("dive.mcap", "metadata.yaml"):
        first, second, third = (
            (tmp_path / folder / "dive" / name).read_bytes() for folder in ("a", "b", "c")
        )
        assert first == second != third
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["dive"]
