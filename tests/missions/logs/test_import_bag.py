import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Datum, attitude_from_rotation, rotation_from_attitude
from alice_survey.sim.vehicle.log import read_vehicle_log
from missions.logs.navigation_csv import read_navigation
from missions.logs.ros_builder import flipped_quaternion, flipped_world, write_bag
from tests.missions.logs.log_files import Bag, imported, numbers
from tests.missions.logs.test_bag import flight
from tests.refusals import refused

START = 1_650_000_000_000_000_000
TOPIC = "/sparus2/navigator/navigation"


def cola2_bag(version: int, count: int = 30) -> Bag:
    """A vehicle that dives northwards; row i is at i * 0.1 s."""
    bag = Bag(version)
    for i in range(count):
        bag.add_nav_sts(
            START + i * 100_000_000,
            (41.7 + 1e-6 * i, 3.03 - 2e-6 * i, 5.0 + 0.01 * i),
            (0.01 * i, -0.02, 3.1 + 0.01 * i),
            2.5 + 0.25 * (i % 2),
        )
    return bag


@pytest.mark.parametrize(
    ("version", "name", "storage"),
    [
        (1, "dive.bag", StoragePlugin.MCAP),
        (2, "dive", StoragePlugin.MCAP),
        (2, "dive", StoragePlugin.SQLITE3),
    ],
)
def test_cola2_navigation_becomes_the_navigation_csv(
    tmp_path: Path, version: int, name: str, storage: StoragePlugin
) -> None:
    data = imported(cola2_bag(version).write(tmp_path / name, storage))

    read = read_navigation(tmp_path / "n.csv", UTC)
    i = np.arange(30)
    assert read.start_utc == datetime.fromtimestamp(START / 1e9, UTC)
    np.testing.assert_allclose(read.time_s, 0.1 * i, atol=2e-6)
    columns = read.columns
    np.testing.assert_allclose(columns["latitude_deg"], 41.7 + 1e-6 * i, atol=1e-10)
    np.testing.assert_allclose(columns["longitude_deg"], 3.03 - 2e-6 * i, atol=1e-10)
    np.testing.assert_allclose(columns["depth_m"], 5.0 + 0.01 * i, atol=1e-5)
    # Attitudes are float32 radians in NavSts.
    np.testing.assert_allclose(columns["roll_deg"], np.rad2deg(0.01 * i), atol=2e-5)
    np.testing.assert_allclose(columns["pitch_deg"], np.rad2deg(-0.02), atol=2e-5)
    np.testing.assert_allclose(columns["heading_deg"], np.rad2deg(3.1 + 0.01 * i), atol=2e-5)
    np.testing.assert_allclose(columns["altitude_m"], 2.5 + 0.25 * (i % 2))
    # Variances 0.04 and 0.09 m^2 of north and east: their mean, 0.065.
    np.testing.assert_allclose(columns["sigma_horizontal_m"], np.sqrt(0.065), atol=1e-6)
    np.testing.assert_allclose(columns["sigma_depth_m"], 0.05, atol=1e-6)
    np.testing.assert_allclose(
        columns["sigma_attitude_deg"], np.rad2deg(np.sqrt(2.5e-4)), atol=1e-5
    )
    np.testing.assert_allclose(columns["sigma_heading_deg"], np.rad2deg(0.03), atol=1e-5)
    assert np.isnan(columns["sigma_altitude_m"]).all()
    assert data["rows"] == 30
    assert data["left_out"] == {}
    assert data["sources"]["position"] == TOPIC


def test_a_flight_comes_back_from_its_bag(tmp_path: Path) -> None:
    record = flight()
    write_bag(tmp_path / "dive", record)

    data = imported(tmp_path / "dive", vehicle_log=tmp_path / "vehicle.csv")

    assert not data["dated"]  # a simulation's clock
    # Not the truth, which the bag also holds.
    assert data["sources"]["position"] == "/alice/navigation/odometry"
    times = numbers(tmp_path, "time_s")
    np.testing.assert_allclose(times, record.time_s, atol=1e-6)
    read = read_navigation(tmp_path / "n.csv", UTC)
    np.testing.assert_allclose(read.time_s, record.time_s, atol=2e-6)
    place = np.stack([read.columns[n] for n in ("latitude_deg", "longitude_deg", "depth_m")], 1)
    ned = record.datum.ned_from_geodetic(place)
    np.testing.assert_allclose(ned, record.believed.translation, atol=1e-5)
    angles = np.stack([read.columns[n] for n in ("roll_deg", "pitch_deg", "heading_deg")], 1)
    expected = np.rad2deg(attitude_from_rotation(record.believed.rotation))
    np.testing.assert_allclose((angles - expected + 180) % 360 - 180, 0, atol=1e-6)
    # Ranges are float32 in ROS; row 7 has no bottom.
    np.testing.assert_allclose(read.columns["altitude_m"][8:], record.altitude_m[8:], atol=1e-5)
    for name, sigma in (
        ("sigma_horizontal_m", record.sigma_horizontal_m),
        ("sigma_depth_m", record.sigma_depth_m),
        ("sigma_attitude_deg", np.rad2deg(record.sigma_attitude_rad)),
        ("sigma_heading_deg", np.rad2deg(record.sigma_heading_rad)),
    ):
        np.testing.assert_allclose(read.columns[name], sigma, atol=1e-6)
    vehicle = read_vehicle_log(tmp_path / "vehicle.csv")
    np.testing.assert_allclose(vehicle.velocity_body, record.believed_velocity[:, :3], atol=1e-8)
    np.testing.assert_allclose(vehicle.rates_body, record.believed_velocity[:, 3:], atol=1e-8)
    np.testing.assert_allclose(vehicle.rpm["starboard"], record.rpm[:, 1], atol=1e-6)
    moved = record.believed.translation - record.believed.translation[0]
    np.testing.assert_allclose(vehicle.position_ned[:, :2], moved[:, :2], atol=1e-4)


@pytest.mark.parametrize("frame", ["world_ned", "odom"])
def test_odometry_in_either_convention(tmp_path: Path, frame: str) -> None:
    ned = np.array([12.0, -7.0, 4.0])
    rotation = rotation_from_attitude(0.1, -0.2, 2.0)
    bag = Bag(2)
    for i in range(5):
        xyzw = rotation.as_quat()
        place, turn, v = ned, xyzw, [0.4, 0.1, -0.05, 0.01, 0.02, 0.03]
        if frame == "odom":
            place, turn = flipped_world(ned), flipped_quaternion(xyzw)
            v = [0.4, -0.1, 0.05, 0.01, -0.02, -0.03]
        bag.add_odometry(START + i * 10**8, "/vehicle/odom", frame, place, turn, v)

    imported(bag.write(tmp_path / "dive"), datum_deg=(41.0, 3.0), vehicle_log=tmp_path / "v.csv")

    place = numbers(tmp_path, "latitude_deg", "longitude_deg", "depth_m")
    np.testing.assert_allclose(Datum(41.0, 3.0).ned_from_geodetic(place)[0], ned, atol=1e-5)
    angles = numbers(tmp_path, "roll_deg", "pitch_deg", "heading_deg")[0]
    np.testing.assert_allclose(angles, np.rad2deg([0.1, -0.2, 2.0]), atol=1e-6)
    vehicle = read_vehicle_log(tmp_path / "v.csv")
    np.testing.assert_allclose(vehicle.velocity_body[0], [0.4, 0.1, -0.05], atol=1e-9)
    np.testing.assert_allclose(vehicle.rates_body[0], [0.01, 0.02, 0.03], atol=1e-9)


def plain_bag() -> Bag:
    """GPS, pressure, attitude and a range at rates of their own."""
    bag = Bag(2)
    for i in range(21):
        bag.add_fix(START + i * 10**9, "/gps/fix", (41.0 + 1e-6 * i, 3.0, 48.0), -(i == 20))
    # 2 m of water of 1025 kg/m^3 at standard gravity, deeper by 1 m in 10 s.
    for i in range(201):
        depth = 2.0 + 0.01 * i
        pressure = 101325.0 + 1025.0 * 9.80665 * depth
        bag.add_pressure(START + i * 10**8, "/pressure", pressure)
    turn = flipped_quaternion(
        rotation_from_attitude(np.deg2rad(30), np.deg2rad(-10), 0.5).as_quat()
    )
    for i in range(401):
        bag.add_imu(START + i * 5 * 10**7, "/imu/data", "imu_link", turn)
        bag.add_range(START + i * 5 * 10**7, "/sonar/ping", 4.0)
    return bag


def test_plain_sensors_are_brought_together(tmp_path: Path) -> None:
    data = imported(plain_bag().write(tmp_path / "dive"))

    # The last fix says that it is none; ten depths come after the one before.
    assert data["rows"] == 30
    assert data["left_out"] == {"/gps/fix: the position is not a number": 1}
    assert data["filled"]["latitude_deg"] == 20
    read = read_navigation(tmp_path / "n.csv", UTC, ())
    np.testing.assert_allclose(read.time_s[20:], 19.1 + 0.1 * np.arange(10), atol=1e-6)
    np.testing.assert_allclose(read.columns["depth_m"][20:], 3.91 + 0.01 * np.arange(10), atol=1e-4)
    depth = numbers(tmp_path, "depth_m")[:20]
    np.testing.assert_allclose(depth, 2.0 + 0.1 * np.arange(20), atol=1e-4)
    angles = numbers(tmp_path, "roll_deg", "pitch_deg", "heading_deg")
    np.testing.assert_allclose(angles, [[30, -10, np.rad2deg(0.5)]] * 30, atol=1e-5)
    altitude = numbers(tmp_path, "altitude_m")
    expected = 4.0 * np.cos(np.deg2rad(30)) * np.cos(np.deg2rad(10))
    np.testing.assert_allclose(altitude, expected, atol=1e-5)
    # Variances 4 and 16: their mean is 10.
    sigma = numbers(tmp_path, "sigma_horizontal_m")[:20]
    np.testing.assert_allclose(sigma, np.sqrt(10.0), atol=1e-6)


def test_gaps_wild_times_and_missing_values_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = Bag(2)
    stamps = [0, 1, 2, 3, 900, 4, 5, 5, 30, 31, 32]
    for i, second in enumerate(stamps):
        place = (float("nan"), 3.0, 5.0) if second == 31 else (41.0 + 1e-6 * second, 3.0, 5.0)
        place = (0.0, 0.0, 5.0) if second == 2 else place
        altitude = -1.0 if second == 3 else 2.0 + 0.1 * second
        bag.add_nav_sts(START + second * 10**9, place, (0.0, 0.0, 0.0), altitude)
        bag.rows[-1] = (START + i * 10**9, *bag.rows[-1][1:])
    data = imported(bag.write(tmp_path / "dive"))

    assert data["left_out"] == {
        f"{TOPIC}: altitudes not above 0: no bottom": 1,
        f"{TOPIC}: the position is 0, 0: no fix": 1,
        f"{TOPIC}: the position is not a number": 1,
        f"{TOPIC}: the time repeats or goes back": 2,
    }
    read = read_navigation(tmp_path / "n.csv", UTC)
    np.testing.assert_allclose(read.time_s, [0, 1, 3, 4, 5, 30, 32], atol=1e-6)
    # Interpolated over the short gap, as import-images does, and not the -1 of the log.
    assert read.columns["altitude_m"][2] == pytest.approx(2.3, abs=1e-5)
    assert [round(gap["length_s"]) for gap in data["gaps"]] == [25]
    warned = capsys.readouterr().err
    assert TOPIC in warned
    assert "25.0 s" in warned


def test_several_candidates_need_a_choice(tmp_path: Path) -> None:
    bag = cola2_bag(2)
    for i in range(5):
        bag.add_nav_sts(
            START + i * 10**8, (40.0, 3.0, 1.0), (0.0, 0.0, 0.0), 1.0, topic="/other/navigation"
        )
    log = bag.write(tmp_path / "dive")
    with pytest.raises(NavigationError, match="--topic navigation=NAME"):
        imported(log)
    assert imported(log, topics=("navigation=/other/navigation",))["rows"] == 5
    with pytest.raises(NavigationError, match="/third"):
        imported(log, topics=("navigation=/third",))
    with pytest.raises(NavigationError, match="ROLE=NAME"):
        imported(log, topics=("/third",))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.97, 0.999])
def test_a_truncated_bag_is_one_clear_line(tmp_path: Path, version: int, share: float) -> None:
    log = cola2_bag(version, 300).write(tmp_path / ("dive.bag" if version == 1 else "dive"))
    file = log if version == 1 else log / "dive.mcap"
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with refused(NavigationError):
        imported(log)
    assert not (tmp_path / "n.csv").exists()


def test_old_bags_without_definitions_and_lone_files(tmp_path: Path) -> None:
    """ROS 2 before Iron wrote no definitions; COLA2's own are then taken."""
    log = cola2_bag(2).write(tmp_path / "dive", StoragePlugin.SQLITE3)
    file = next(log.glob("*.db3"))
    with closing(sqlite3.connect(file)) as database, database:
        assert database.execute("delete from message_definitions").rowcount > 0
    for path in (log, file):
        assert imported(path)["rows"] == 30
        depth = numbers(path.parent, "depth_m")
        np.testing.assert_allclose(depth, 5.0 + 0.01 * np.arange(30), atol=1e-5)
