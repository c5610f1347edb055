"""The ROS 2 nodes: messages and frames, a dive of two processes, and a lost navigation."""

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.config import SurveyConfig, load_config
from alice_survey.core.frames import Array, attitude_from_rotation, interpolate_poses
from alice_survey.core.trajectory import read_track
from alice_survey.sim.vehicle.sea import floor_depth
from camera_calib.rig import design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import Stations, plan_pattern, stations_of_flight
from missions.fly.simulation import flight_noise, flight_settings, simulate_plan, true_floor
from missions.live import ros as ros_messages
from missions.live.mission import Odometry
from missions.live.ros import START_S, VehicleNode
from missions.logs.ros_builder import JOINTS, ODOMETRY, WRENCH
from tests.missions.live.flights import (
    FLOOR_M,
    pictures_of,
    small_plan,
    vehicle_afloat,
    workspace_in,
)

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install '.[ros]'")

pytestmark = pytest.mark.xdist_group("ros")
DOMAIN = {
    **os.environ,
    "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "FASTDDS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_name("loopback.xml")),
    "ROS_LOG_DIR": f"{tempfile.gettempdir()}/alice-survey-ros-{os.getpid()}",
}
"""One domain a test process, on the loopback alone."""


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    return workspace_in(tmp_path)


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "alice_survey", *words]


# ------------------------------------------------------------------ messages


def test_odometry_is_in_the_frames_of_rep_103() -> None:
    """2 m north, 3 m east, 5 m deep, heading east, bow up by 0.1 rad, going ahead."""
    build = ros_messages.load_ros().build
    turn = Rotation.from_euler("ZYX", [math.pi / 2, 0.1, 0.0])
    odometry = Odometry(
        stamp_s=12.25,
        position_ned=np.array([2.0, 3.0, 5.0]),
        quaternion_xyzw=turn.as_quat(),
        velocity_body=np.array([0.4, 0.1, 0.2]),
        rates_body=np.array([0.01, 0.02, 0.3]),
    )
    message = ros_messages.odometry_message(build, odometry, "alice/base_link", np.arange(6.0))

    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 250_000_000)
    assert (message.header.frame_id, message.child_frame_id) == ("map", "alice/base_link")
    place, twist = message.pose.pose.position, message.twist.twist
    assert (place.x, place.y, place.z) == (3.0, 2.0, -5.0)
    assert (twist.linear.x, twist.linear.y, twist.linear.z) == (0.4, -0.1, -0.2)
    assert (twist.angular.x, twist.angular.y, twist.angular.z) == (0.01, -0.02, -0.3)
    q = message.pose.pose.orientation
    forward = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(forward, [math.cos(0.1), 0.0, math.sin(0.1)], atol=1e-12)
    np.testing.assert_array_equal(np.diag(np.reshape(message.pose.covariance, (6, 6))), range(6))

    back = ros_messages.odometry_from(message)
    for name in ("position_ned", "velocity_body", "rates_body"):
        np.testing.assert_allclose(getattr(back, name), getattr(odometry, name), atol=1e-15)
    same = Rotation.from_quat(back.quaternion_xyzw) * turn.inv()
    assert same.magnitude() < 1e-12
    assert back.stamp_s == 12.25


def test_wrench_and_speeds_come_back() -> None:
    build = ros_messages.load_ros().build
    wrench = np.array([1.0, 2.0, -3.0, 0.1, -0.2, 0.3])
    message = build.wrench(10**9, "alice/base_link", ros_messages.flipped_pair(wrench))
    force, torque = message.wrench.force, message.wrench.torque
    # To starboard is to -y, and up is +z.
    assert (force.x, force.y, force.z) == (1.0, -2.0, 3.0)
    assert (torque.x, torque.y, torque.z) == (0.1, 0.2, -0.3)
    np.testing.assert_array_equal(ros_messages.wrench_from(message), wrench)

    names = ("port", "stern")
    speeds, thrusts = np.array([2.0, -3.0]), np.array([5.0, -6.0])
    message = ros_messages.speeds_message(build, 1.0, names, speeds, thrusts)
    np.testing.assert_allclose(message.velocity, [4 * math.pi, -6 * math.pi])
    assert list(message.effort) == [5.0, -6.0]
    # By name, in whatever order.
    message.name, message.velocity = ["stern", "bow", "port"], [1.0, 2.0, 3.0]
    speeds = ros_messages.speeds_from(message, ("port", "stern", "vertical"))
    np.testing.assert_allclose(speeds * 2 * math.pi, [3.0, 1.0, math.nan])


# ------------------------------------------------------------------ the simulated vehicle


@pytest.fixture
def afloat(monkeypatch: pytest.MonkeyPatch) -> Iterator[VehicleNode]:
    """The vehicle's node, in this process, that follows wrenches."""
    for name, value in DOMAIN.items():
        monkeypatch.setenv(name, value)
    ros = ros_messages.load_ros()
    still = {"current_mps": 0.0, "current_sigma_mps": 0.0, "gust_n": (0.0, 0.0, 0.0)}
    calm = SurveyConfig.model_validate({"sea": still})
    vehicle = vehicle_afloat(small_plan(), calm)
    ros.rclpy.init(args=[])
    node = VehicleNode(ros, vehicle, "wrench", np.random.default_rng(3))
    yield node
    node.node.destroy_node()
    ros.rclpy.try_shutdown()


def test_wrench_moves_the_vehicle_the_way_it_points(afloat: VehicleNode) -> None:
    """20 N ahead and 30 N down, in FLU, for 4 s; then nothing comes, and the thrusters stop."""
    vehicle, build = afloat.vehicle, ros_messages.load_ros().build
    began = vehicle.world.now[:3].copy()
    pushed = np.array([20.0, 0.0, -30.0, 0.0, 0.0, 0.0])
    for _ in range(80):
        vehicle.sense()
        stamp_ns = ros_messages.nanoseconds(afloat.now_s)
        afloat.on_wrench(build.wrench(stamp_ns, "alice/base_link", pushed))
        vehicle.move(afloat.speeds())
    allocation = afloat.allocation
    made = allocation.matrix @ allocation.thrust
    np.testing.assert_allclose(made[[0, 1, 2, 5]], [20.0, 0.0, 30.0, 0.0], atol=1e-6)
    turn = Rotation.from_quat(vehicle.world.now[3:7])
    ahead, starboard, down = turn.inv().apply(vehicle.world.now[:3] - began)
    assert ahead > 0.3
    assert down > 0.3
    assert abs(starboard) < 0.1 * ahead
    for ticks in range(1, 12):
        vehicle.move(afloat.speeds())
        assert ticks == 10 or np.any(afloat.speeds()) == (ticks < 10)


def test_sensors_measure_what_is_true(afloat: VehicleNode) -> None:
    """At rest, turned: gravity, no velocity, the way straight down, and the true pose."""
    vehicle = afloat.vehicle
    for _ in range(40):
        vehicle.sense()
        vehicle.move(np.zeros(5))
    heard: dict[str, Any] = {}
    for _ in range(4):
        for publisher, message in afloat.readings(vehicle.sense()):
            heard[publisher.topic_name] = message
        vehicle.move(np.zeros(5))
    truth, imu = heard["/alice/truth/odometry"], heard["/alice/imu"]
    up = imu.linear_acceleration
    assert math.hypot(up.x, up.y, up.z) == pytest.approx(9.81, abs=0.1)
    assert up.z == pytest.approx(9.81, abs=0.1)
    moving = heard["/alice/dvl"].twist.twist.linear
    assert 0.0 < math.hypot(moving.x, moving.y) < 0.05
    # From the DVL, 0.11 m below the origin, which floats near the surface.
    depth = -truth.pose.pose.position.z
    assert heard["/alice/altimeter"].range == pytest.approx(FLOOR_M - 0.11 - depth, abs=0.15)
    true, believed = (
        ros_messages.odometry_from(heard[f"/alice/{who}/odometry"])
        for who in ("truth", "navigation")
    )
    np.testing.assert_allclose(true.position_ned, vehicle.world.now[:3], atol=0.02)
    assert 0.0 < np.linalg.norm(true.position_ned - believed.position_ned) < 0.5
    sigma = np.sqrt(np.diag(heard["/alice/navigation/odometry"].pose.covariance.reshape(6, 6)))
    assert np.all((sigma > 0.0) & (sigma < 0.5))
    clock = ros_messages.seconds(heard["/clock"].clock)
    assert clock == pytest.approx(START_S + 0.05 * (vehicle.tick - 1), abs=1e-9)


# ------------------------------------------------------------------ a dive


@pytest.mark.slow
def test_dive_of_two_processes_covers_what_the_closed_loop_does(workspace: Path) -> None:
    """Tick by tick on the simulation's clock: `pilot --simulated` and `pilot` over the loopback."""
    track, record = workspace / "track.csv", workspace / "record.csv"
    at_sea = subprocess.Popen(
        command("pilot", "--simulated", "-w", str(workspace), "--rate", "0", "--track", str(track)),
        env=DOMAIN, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        pilot = subprocess.run(
            command(
                "pilot", "-w", str(workspace), "--sim-time", "--record", str(record), "--json"
            ),
            env=DOMAIN, capture_output=True, text=True, timeout=900, check=False,
        )  # fmt: skip
        said, _ = at_sea.communicate(timeout=240)
    finally:
        at_sea.kill()
    assert pilot.returncode == 0, pilot.stderr
    result = json.loads(pilot.stdout)
    assert result["ending"] == "complete"
    assert (result["late_ticks"], result["clock_jumps"]) == (0, 0)
    assert "its commander left" in said

    survey, plan = load_config(workspace / "survey.toml"), small_plan()
    settings = flight_settings(survey)
    floor = true_floor(plan, settings)
    closed = simulate_plan(plan, settings, floor, flight_noise(survey.seed))
    rig = design_rig(survey.camera, survey.water)

    true = read_track(track)
    at_s, lines = pictures_of(record)
    assert lines == closed.trigger_line == (0,) * 6 + (1,) * 6
    poses = interpolate_poses(true.time_s, true.ned_from_body, at_s)
    glass = poses.apply(np.array(survey.camera.position_body_m))
    depths = np.array([floor_depth(floor, float(n), float(e)) for n, e in glass[:, :2]])
    taken = Stations(
        glass_ne=glass[:, :2],
        altitude_m=depths - glass[:, 2],
        attitude_rad=attitude_from_rotation(poses.rotation).reshape(-1, 3),
        line=np.array(lines, dtype=np.intp),
    )

    wanted = plan_pattern(plan, rig)
    seen = certificate(plan.area, rig, taken, wanted)
    expected = certificate(plan.area, rig, stations_of_flight(closed), wanted)
    assert 0.1 < expected.covered_share < 1.0
    assert seen.covered_share == pytest.approx(expected.covered_share, abs=0.02)
    assert seen.every_camera_share == pytest.approx(expected.every_camera_share, abs=0.02)
    # The same navigation errors in the same sea: only the altimeter differs.
    np.testing.assert_allclose(taken.glass_ne, stations_of_flight(closed).glass_ne, atol=0.1)
    assert true.time_s[-1] - START_S == pytest.approx(closed.flown.time_s[-1], rel=0.1)


# ------------------------------------------------------------------ safe states


class Navigator:
    """A node that says where the vehicle is, and keeps what the pilot commands."""

    def __init__(self) -> None:
        self.ros = ros_messages.load_ros()
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor

        self.context = Context()
        rclpy.init(args=[], context=self.context, domain_id=int(DOMAIN["ROS_DOMAIN_ID"]))
        self.node = rclpy.create_node("navigator", namespace="alice", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        kind, qos = ros_messages.message_class, self.ros.qos
        self.odometry = self.node.create_publisher(kind(ODOMETRY), "navigation/odometry", qos)
        self.wrenches: list[Array] = []
        self.speeds: list[Array] = []
        self.node.create_subscription(
            kind(WRENCH), "pilot/wrench",
            lambda m: self.wrenches.append(ros_messages.wrench_from(m)), qos,
        )  # fmt: skip
        self.node.create_subscription(
            kind(JOINTS), "thrusters/command",
            lambda m: self.speeds.append(np.array(m.velocity)), qos,
        )  # fmt: skip

    def publish(self, depth: float) -> None:
        stamp_s = self.node.get_clock().now().nanoseconds * 1e-9
        odometry = Odometry(
            stamp_s=stamp_s,
            position_ned=np.array([1e-4 * math.sin(stamp_s), 0.0, depth]),
            quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
            velocity_body=np.zeros(3),
            rates_body=np.zeros(3),
        )
        self.odometry.publish(
            ros_messages.odometry_message(self.ros.build, odometry, "alice/base_link", np.zeros(6))
        )

    def until(self, holds: Any, *, depth: float | None, max_s: float = 600.0) -> None:
        """Spin, and publish odometry if there is a depth, until something holds."""
        end = time.monotonic() + max_s
        while not holds():
            assert time.monotonic() < end, (len(self.wrenches), self.wrenches[-1:])
            if depth is not None:
                self.publish(depth)
            self.executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def navigator(monkeypatch: pytest.MonkeyPatch) -> Iterator[Navigator]:
    for name, value in DOMAIN.items():
        monkeypatch.setenv(name, value)
    made = Navigator()
    yield made
    made.close()


@pytest.fixture
def diving(workspace: Path, navigator: Navigator) -> Iterator[subprocess.Popen[str]]:
    """A pilot process, in real time, whose vehicle is said to be 1 m deep: it dives."""
    pilot = subprocess.Popen(
        command("pilot", "-w", str(workspace), "--grace", "1"),
        env=DOMAIN, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        navigator.until(
            lambda: (
                navigator.wrenches
                and navigator.wrenches[-1][2] > 1.0
                and navigator.speeds
                and np.any(navigator.speeds[-1])
            ),
            depth=1.0,
        )
        yield pilot
    finally:
        pilot.kill()


def ends_without_thrust(pilot: subprocess.Popen[str], navigator: Navigator, depth: Any) -> None:
    navigator.until(lambda: pilot.poll() is not None, depth=depth)
    navigator.until(
        lambda: not np.any(navigator.wrenches[-1]) and not np.any(navigator.speeds[-1]), depth=None
    )


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["silent", "nan"])
def test_lost_odometry_stops_then_surfaces(
    diving: subprocess.Popen[str], navigator: Navigator, lost: str
) -> None:
    """Odometry stops, or goes on as NaN."""
    begun = len(navigator.wrenches)
    depth = None if lost == "silent" else math.nan
    navigator.until(lambda: navigator.wrenches[-1][2] < -5.0, depth=depth)
    after = np.array(navigator.wrenches[begun:])
    # First off, then up and nothing else.
    assert np.count_nonzero(~np.any(after, axis=1)) > 5
    assert not np.any(after[-1, [0, 1, 3, 4, 5]])
    ends_without_thrust(diving, navigator, 0.1)
    assert diving.returncode == 3
    assert diving.stdout is not None
    assert diving.stdout.read().startswith("given up: ")


@pytest.mark.slow
def test_interrupted_pilot_leaves_the_thrusters_off(
    diving: subprocess.Popen[str], navigator: Navigator
) -> None:
    diving.send_signal(signal.SIGTERM)
    ends_without_thrust(diving, navigator, 1.0)
    assert diving.returncode == 128 + signal.SIGTERM
