from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import WorkspaceError
from alice_survey.base.frames import Datum, rotation_from_attitude
from missions.logs.bag import BagRecord, Samples, write_bag
from missions.logs.ros_frames import flipped_body, flipped_quaternion, flipped_world

ENU_FROM_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
START_NS = 1_700_000_000_123_456_789


def flight(rows: int = 40, *, start_utc_ns: int = START_NS) -> BagRecord:
    """A climb along a circle with everything that a bag can hold."""
    rng = np.random.default_rng(5)
    time_s = np.arange(rows) * 0.1
    place = np.column_stack([5 * np.cos(time_s), 5 * np.sin(time_s), 10.0 - 0.3 * time_s])
    truth = RigidTransform.from_components(
        place, rotation_from_attitude(0.2 * np.sin(time_s), 0.1 * np.cos(time_s), time_s)
    )
    believed = RigidTransform.from_components(place + 0.25, truth.rotation)
    sigma = np.linspace(0.1, 0.4, rows)
    beams = rng.uniform(1.0, 3.0, (rows // 2, 4))
    beams[3, 1] = np.nan
    dvl = rng.normal(size=(rows // 2, 3))
    dvl[5] = np.nan
    return BagRecord(
        name="alice",
        datum=Datum(32.83, 34.95, 17.5),
        time_s=time_s,
        truth=truth,
        truth_velocity=rng.normal(size=(rows, 6)),
        believed=believed,
        believed_velocity=rng.normal(size=(rows, 6)),
        sigma_horizontal_m=sigma,
        sigma_depth_m=sigma / 2,
        sigma_attitude_rad=sigma / 10,
        sigma_heading_rad=sigma / 5,
        sigma_velocity_mps=sigma / 20,
        altitude_m=np.where(np.arange(rows) == 7, np.nan, 2.0 + 0.01 * time_s),
        thrusters=("port", "starboard"),
        rpm=rng.uniform(-3000, 3000, (rows, 2)),
        power_w=rng.uniform(0, 200, (rows, 2)),
        thrust_n=rng.uniform(-30, 60, (rows, 2)),
        imu=Samples(time_s=time_s, values=rng.normal(size=(rows, 6))),
        ahrs_rad=Samples(time_s=time_s, values=rng.normal(size=(rows, 3)) / 4, sigma=0.01),
        dvl_mps=Samples(time_s=time_s[::2], values=dvl, sigma=0.003),
        beam_m=Samples(time_s=time_s[::2], values=beams),
        pressure_pa=Samples(time_s=time_s, values=101325.0 + rng.uniform(0, 1e5, (rows, 1))),
        gps=Samples(time_s=time_s[:3], values=np.array([[32.83, 34.95, 17.0]] * 3), sigma=2.5),
        usbl_ned_m=Samples(time_s=time_s[::10], values=place[::10] + 1.0, sigma=0.5),
        start_utc_ns=start_utc_ns,
        notes={"vehicle": "alice"},
    )  # fmt: skip


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


def test_a_vehicle_that_heads_east_has_no_rotation_in_ros() -> None:
    east = rotation_from_attitude(0.0, 0.0, np.pi / 2).as_quat()
    np.testing.assert_allclose(flipped_quaternion(east), [0, 0, 0, 1], atol=1e-15)
    north = rotation_from_attitude(0.0, 0.0, 0.0).as_quat()
    np.testing.assert_allclose(
        flipped_quaternion(north), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15
    )


def test_a_bag_holds_the_flight_in_enu_and_flu(tmp_path: Path) -> None:
    record = flight()
    count = write_bag(tmp_path / "dive", record)

    found = read(tmp_path / "dive")
    assert sum(len(rows) for rows in found.values()) == count
    truth = found["/alice/truth/odometry"]
    assert [stamp for stamp, _ in truth] == [START_NS + 100_000_000 * i for i in range(40)]
    for i, (stamp, message) in enumerate(truth):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        assert (message.header.frame_id, message.child_frame_id) == (
            "map",
            "alice/base_link_truth",
        )
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


def test_navigation_carries_its_covariance(tmp_path: Path) -> None:
    record = flight()
    write_bag(tmp_path / "dive", record)

    found = read(tmp_path / "dive")
    s = record.sigma_horizontal_m[9]
    message = found["/alice/navigation/odometry"][9][1]
    expected = [s**2, s**2, (s / 2) ** 2, (s / 10) ** 2, (s / 10) ** 2, (s / 5) ** 2]
    np.testing.assert_allclose(np.reshape(message.pose.covariance, (6, 6)), np.diag(expected))
    np.testing.assert_allclose(
        np.diag(np.reshape(message.twist.covariance, (6, 6)))[:3], (s / 20) ** 2
    )
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


def test_sensors_and_thrusters(tmp_path: Path) -> None:
    record = flight()
    write_bag(tmp_path / "dive", record)

    found = read(tmp_path / "dive")
    assert record.rpm is not None and record.imu is not None and record.dvl_mps is not None
    assert record.power_w is not None and record.thrust_n is not None
    joints = found["/alice/thrusters/state"][4][1]
    assert list(joints.name) == ["port", "starboard"]
    np.testing.assert_allclose(np.array(joints.velocity) * 60 / (2 * np.pi), record.rpm[4])
    np.testing.assert_allclose(joints.effort, record.thrust_n[4])
    power = found["/alice/thrusters/power"][4][1]
    assert power.layout.dim[0].label == "port,starboard"
    np.testing.assert_allclose(power.data, record.power_w[4])
    imu = found["/alice/imu"][4][1]
    assert imu.orientation_covariance[0] == -1
    p, q, r, fx, fy, fz = record.imu.values[4]
    np.testing.assert_allclose(xyz(imu.angular_velocity), [p, -q, -r])
    np.testing.assert_allclose(xyz(imu.linear_acceleration), [fx, -fy, -fz])
    # Row 5 of the DVL has no bottom lock and no message; rows go every 0.2 s.
    dvl = found["/alice/dvl/velocity"]
    assert len(dvl) == 19
    assert [stamp - START_NS for stamp, _ in dvl][4:6] == [800_000_000, 1_200_000_000]
    u, v, w = record.dvl_mps.values[6]
    np.testing.assert_allclose(xyz(dvl[5][1].twist.twist.linear), [u, -v, -w])
    assert found["/alice/dvl/beam_2"][3][1].range == np.inf
    assert found["/alice/dvl/beam_1"][3][1].range < 3.0
    assert found["/alice/navigation/altitude"][7][1].range == np.inf
    usbl = found["/alice/usbl/position"][2][1]
    np.testing.assert_allclose(
        xyz(usbl.pose.pose.position),
        flipped_world(record.truth.translation[20] + 1.0),
    )
    datum = found["/alice/datum"]
    assert len(datum) == 1
    assert (datum[0][1].latitude, datum[0][1].longitude, datum[0][1].altitude) == (
        32.83,
        34.95,
        17.5,
    )


def test_ros_tools_open_the_folder(tmp_path: Path) -> None:
    """As `ros2 bag` does: by metadata.yaml, and messages in the order of their times."""
    count = write_bag(tmp_path / "dive", flight())
    with AnyReader([tmp_path / "dive"]) as reader:
        assert reader.message_count == count
        stamps = [stamp for _, stamp, _ in reader.messages()]
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
    assert stamps == sorted(stamps)
    assert stamps[0] == START_NS
    assert kinds["/tf"] == "tf2_msgs/msg/TFMessage"


def test_the_same_flight_gives_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write_bag(tmp_path / folder / "dive", flight())
    for name in ("dive.mcap", "metadata.yaml"):
        first, second = ((tmp_path / f / "dive" / name).read_bytes() for f in ("a", "b"))
        assert first == second
    write_bag(tmp_path / "c" / "dive", replace(flight(), start_utc_ns=START_NS + 1))
    assert (tmp_path / "c" / "dive" / "dive.mcap").read_bytes() != first
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["dive"]


def test_only_what_is_known_is_written(tmp_path: Path) -> None:
    full = flight()
    record = BagRecord(
        name="sparus2", datum=full.datum, time_s=full.time_s, truth=full.truth,
        truth_velocity=full.truth_velocity, believed=full.believed,
        sigma_horizontal_m=full.sigma_horizontal_m, sigma_depth_m=full.sigma_depth_m,
        sigma_attitude_rad=full.sigma_attitude_rad, sigma_heading_rad=full.sigma_heading_rad,
    )  # fmt: skip
    write_bag(tmp_path / "dive", record)
    found = read(tmp_path / "dive")
    assert sorted(found) == [
        "/sparus2/datum", "/sparus2/navigation/fix", "/sparus2/navigation/odometry",
        "/sparus2/truth/odometry", "/tf",
    ]  # fmt: skip
    assert found["/sparus2/navigation/odometry"][0][1].twist.covariance[0] == -1


def test_an_existing_folder_stays(tmp_path: Path) -> None:
    (tmp_path / "dive").mkdir()
    with pytest.raises(WorkspaceError, match="exists already"):
        write_bag(tmp_path / "dive", flight())
    assert not list((tmp_path / "dive").iterdir())


def test_columns_must_fit_the_times() -> None:
    record = flight()
    with pytest.raises(ValueError, match="rpm has the shape"):
        replace(record, rpm=np.zeros((40, 3)))
    with pytest.raises(ValueError, match="increase"):
        replace(record, time_s=record.time_s[::-1])
