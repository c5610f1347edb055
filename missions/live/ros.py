"""ROS 2: the pilot as a node, the simulated vehicle as a node, and their messages.

ROS has ENU worlds and FLU bodies (REP-103); `missions.logs.ros_builder` swaps the axes.

The pilot takes odometry and altitude and gives wrench and thruster speeds. At sea it ticks by a
steady timer, and stamps are compared with the node's clock. With `sim_time` it ticks by `/clock`,
as fast as that runs.

The simulated vehicle takes thruster speeds or a wrench and gives sensors and truth. Stamps are of
the simulation's own clock, which `/clock` publishes: nodes that listen use simulated time. With a
rate the simulation keeps pace with the wall; without, it waits at each tick for the command of that
tick, so that it is as fast as what commands it, on any machine.
"""

import importlib
import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import VehicleError, extra, note, warn
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.core.trajectory import Trajectory, write_track
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.allocation import (
    AXIS_WEIGHTS,
    LEVEL_WEIGHTS,
    allocate,
    new_allocation,
)
from alice_survey.sim.vehicle.dynamics import STATE
from alice_survey.sim.vehicle.navigation.filter import BEAM, PUSH, RATES
from alice_survey.sim.vehicle.navigation.sensors import DVL, beam_velocity
from alice_survey.sim.vehicle.navigation.tick import LOG_ROW, LOG_SIGMA, log_row
from alice_survey.sim.vehicle.sea import floor_range
from alice_survey.sim.vehicle.simulator import TICK_S, SimulatedVehicle
from missions.fly.simulation import (
    FlightSettings,
    flight_noise,
    max_mission_s,
    mission_setup,
    true_floor,
)
from missions.live.mission import (
    FIRST_S,
    SILENCE_S,
    Command,
    LinkState,
    LiveMission,
    Odometry,
    need_thrusters_alone,
    plan_to_fly,
)
from missions.logs.ros_builder import (
    CLOCK,
    IMU,
    JOINTS,
    MAP,
    NS_PER_S,
    ODOMETRY,
    RANGE,
    STRING,
    TWIST,
    WRENCH,
    MessageBuilder,
    flipped_body,
    flipped_quaternion,
    flipped_world,
)

_TURN_RAD = 2.0 * math.pi


@dataclass(frozen=True, kw_only=True)
class RosLibrary:
    """What is used of ROS 2, once it is known to be installed."""

    rclpy: Any
    build: MessageBuilder
    qos: Any
    """Reliable, the last 10 messages."""


def load_ros() -> RosLibrary:
    """Import ROS 2.

    Raises:
        VehicleError: it is not installed.
    """
    try:
        import rclpy
        from rclpy.qos import QoSProfile
    except ImportError as error:
        raise VehicleError(
            f"ROS 2 is not installed ({error}): source the setup file of an installation, or "
            f"{extra('ros')}"
        ) from None
    return RosLibrary(rclpy=rclpy, build=MessageBuilder(message_class), qos=QoSProfile(depth=10))


@contextmanager
def _session() -> Iterator[RosLibrary]:
    """ROS 2 from its start to its end; signals are left to the program."""
    ros = load_ros()
    from rclpy.signals import SignalHandlerOptions

    ros.rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield ros
    finally:
        ros.rclpy.try_shutdown()


@cache
def message_class(kind: str) -> Any:
    """Class of a message by its name, such as `nav_msgs/msg/Odometry`.

    Raises:
        VehicleError: its package is not installed.
    """
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        raise VehicleError(f"{package} of ROS 2 is not installed: {extra('ros')}") from None


def seconds(stamp: Any) -> float:
    """A stamp of a message as seconds."""
    return float(stamp.sec) + float(stamp.nanosec) / NS_PER_S


def nanoseconds(time_s: float) -> int:
    """Seconds as whole nanoseconds."""
    return round(time_s * NS_PER_S)


def _xyz(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z])


def flipped_pair(vectors: Array) -> Array:
    """Two vectors in a row, (6,), from FRD to FLU or back."""
    return flipped_body(vectors.reshape(2, 3)).ravel()


def odometry_from(message: Any) -> Odometry:
    """Odometry of a `nav_msgs/Odometry`."""
    pose, twist, turn = message.pose.pose, message.twist.twist, message.pose.pose.orientation
    return Odometry(
        stamp_s=seconds(message.header.stamp),
        position_ned=flipped_world(_xyz(pose.position)),
        quaternion_xyzw=flipped_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])),
        velocity_body=flipped_body(_xyz(twist.linear)),
        rates_body=flipped_body(_xyz(twist.angular)),
        sigma_m=_sigma_m(message.pose.covariance),
    )


def _sigma_m(covariance: Any) -> float:
    """Standard deviation of the position towards north or east; 0 where it is not stated."""
    variance = max(float(covariance[0]), float(covariance[7]))
    return math.sqrt(variance) if variance > 0.0 and math.isfinite(variance) else 0.0


def odometry_message(
    build: MessageBuilder, odometry: Odometry, body: str, pose_variances: Array
) -> Any:
    """A `nav_msgs/Odometry` in the map.

    Args:
        build: of messages.
        odometry: of the body.
        body: the body's frame.
        pose_variances: (6,) of east, north, up, and of small turns about them.
    """
    return build.odometry(
        nanoseconds(odometry.stamp_s),
        body,
        flipped_world(odometry.position_ned),
        flipped_quaternion(odometry.quaternion_xyzw),
        pose_variances,
        flipped_pair(np.concatenate([odometry.velocity_body, odometry.rates_body])),
    )


def range_from(message: Any) -> float:
    """Metres of a `sensor_msgs/Range`; infinite where it is out of its bounds (REP-117)."""
    value = float(message.range)
    return value if message.min_range <= value <= message.max_range else math.inf


def wrench_from(message: Any) -> Array:
    """(6,) N and N m in the body frame, of a `geometry_msgs/WrenchStamped` in the body's."""
    wrench = message.wrench
    return flipped_pair(np.concatenate([_xyz(wrench.force), _xyz(wrench.torque)]))


def speeds_from(message: Any, thrusters: tuple[str, ...]) -> Array:
    """(n,) rev/s of a `sensor_msgs/JointState`; NaN of a thruster that it does not name."""
    named = dict(zip(message.name, message.velocity, strict=False))
    return np.array([named.get(name, math.nan) for name in thrusters]) / _TURN_RAD


def speeds_message(
    build: MessageBuilder,
    time_s: float,
    thrusters: tuple[str, ...],
    rps: Array,
    thrust_n: Array | None = None,
) -> Any:
    """A `sensor_msgs/JointState`: speeds, (n,) rev/s, in rad/s; thrusts as efforts, both signed."""
    return build.joints(nanoseconds(time_s), thrusters, _TURN_RAD * rps, thrust_n)


_WAIT_S = 0.1
_FAREWELLS = 3
"""Commands of no thrust when the node ends."""
_STATE_TICKS = 20
"""The state is published every so many ticks, and whenever it changes."""


@dataclass(frozen=True, kw_only=True)
class Topics:
    """Names of the topics, below the vehicle's where they do not begin with a slash."""

    odometry: str = "navigation/odometry"
    frame: str = MAP
    """Of the odometry's poses: east, north, up from the plan's datum."""
    body_frame: str = "base_link"
    """Of its velocities, without the vehicle's name: forward, left, up."""
    altitude: str = "altimeter"
    thrusters: str = "thrusters/state"
    wrench: str = "pilot/wrench"
    command: str = "thrusters/command"
    state: str = "pilot/state"


def pilot_over_ros(mission: LiveMission, topics: Topics, *, sim_time: bool) -> None:
    """Fly a mission until it is over or interrupted; thrusters are off then.

    Args:
        mission: what to fly.
        topics: names.
        sim_time: tick by `/clock`.

    Raises:
        VehicleError: ROS 2 is not installed, a topic cannot have its name, or `/clock` stood still.
    """
    with _session() as ros:
        node = PilotNode(ros, mission, topics, sim_time)
        note(f"waits for ROS 2 odometry on {node.node.resolve_topic_name(topics.odometry)}")
        try:
            while mission.loop.state != LinkState.OVER:
                ros.rclpy.spin_once(node.node, timeout_sec=_WAIT_S)
                max_s = SILENCE_S if mission.loop.ticks else FIRST_S
                if sim_time and time.monotonic() - node.ticked > max_s:
                    raise VehicleError(
                        f"/clock stood still for {max_s:g} s: start the simulator first, or "
                        "fly without --sim-time"
                    )
        finally:
            node.farewell()
            node.node.destroy_node()


class PilotNode:
    """The pilot and its topics."""

    def __init__(
        self, ros: RosLibrary, mission: LiveMission, topics: Topics, sim_time: bool
    ) -> None:
        from rclpy.clock import Clock, ClockType
        from rclpy.exceptions import InvalidTopicNameException
        from rclpy.parameter import Parameter

        self.ros, self.mission, self.body = ros, mission, f"{mission.vehicle}/base_link"
        self.node = ros.rclpy.create_node(
            "pilot",
            namespace=mission.vehicle,
            parameter_overrides=[Parameter("use_sim_time", value=sim_time)],
        )
        kind, node, qos = message_class, self.node, ros.qos
        self._shown: tuple[LinkState, str] | None = None
        self._clock_s = 0.0
        self.ticked = time.monotonic()
        """Wall time of the latest tick."""
        self._sim_time, self._topics = sim_time, topics
        try:
            self.wrench = node.create_publisher(kind(WRENCH), topics.wrench, qos)
            self.command = node.create_publisher(kind(JOINTS), topics.command, qos)
            self.state = node.create_publisher(kind(STRING), topics.state, qos)
            # Measurements before the clock, so that those of one instant come first.
            node.create_subscription(kind(ODOMETRY), topics.odometry, self._on_odometry, qos)
            node.create_subscription(kind(RANGE), topics.altitude, self._on_range, qos)
            node.create_subscription(kind(JOINTS), topics.thrusters, self._on_thrusters, qos)
        except InvalidTopicNameException as error:
            raise VehicleError(" ".join(str(error).split())) from None
        if sim_time:
            node.create_subscription(kind(CLOCK), "/clock", self._on_clock, qos)
        else:
            node.create_timer(TICK_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def now_s(self) -> float:
        """Time on the clock of the stamps."""
        if self._sim_time:
            return self._clock_s
        return float(self.node.get_clock().now().nanoseconds) * 1e-9

    @property
    def _has_begun(self) -> bool:
        """Whether there is a clock to compare stamps with."""
        return not self._sim_time or self._clock_s > 0.0

    def farewell(self) -> None:
        """Command no thrust, for whatever reason the node ends."""
        self.mission.loop.end("interrupted")
        command = self.mission.tick(self.now_s + TICK_S)
        for _ in range(_FAREWELLS):
            self._publish(command)

    def _on_odometry(self, message: Any) -> None:
        if not self._has_begun:
            return
        frames = message.header.frame_id.lstrip("/"), message.child_frame_id.split("/")[-1]
        if frames == (self._topics.frame, self._topics.body_frame):
            self.mission.loop.hear_odometry(odometry_from(message), self.now_s)
        else:
            self.mission.loop.refuse(
                f"odometry is of {frames[1] or 'no frame'} in {frames[0] or 'no frame'}, not of "
                f"{self._topics.body_frame} in {self._topics.frame}"
            )

    def _on_range(self, message: Any) -> None:
        if self._has_begun:
            stamp_s = seconds(message.header.stamp)
            self.mission.loop.hear_range(stamp_s, range_from(message), self.now_s)

    def _on_thrusters(self, message: Any) -> None:
        self.mission.loop.hear_thrusters(
            speeds_from(message, self.mission.thrusters), self.now_s
        )  # fmt: skip

    def _on_clock(self, message: Any) -> None:
        now_s = seconds(message.clock)
        # A clock that runs finer than the tick does not make it shorter.
        if 0.0 < now_s - self._clock_s < TICK_S - 1e-6:
            return
        self._clock_s = now_s
        self._tick()

    def _tick(self) -> None:
        self.ticked = time.monotonic()
        self._publish(self.mission.tick(self.now_s))

    def _publish(self, command: Command) -> None:
        mission = self.mission
        build, time_s = self.ros.build, command.time_s
        wrench = flipped_pair(command.wrench)
        self.wrench.publish(build.wrench(nanoseconds(time_s), self.body, wrench))
        self.command.publish(
            speeds_message(build, time_s, mission.thrusters, command.rps, command.thrust_n)
        )
        shown = (command.state, mission.phase)
        if shown != self._shown or mission.loop.ticks % _STATE_TICKS == 0:
            self._shown = shown
            self.state.publish(build.make(STRING, data=json.dumps(self._state_of(command))))

    def _state_of(self, command: Command) -> dict[str, Any]:
        loop = self.mission.loop
        return {
            "time_s": command.time_s,
            "state": command.state,
            "why": command.why,
            "phase": self.mission.phase,
            "line": self.mission.line,
            "late_ticks": loop.late_ticks,
            "clock_jumps": loop.jumps,
            "refused": dict(loop.refused),
        }


START_S = 1.0
"""The clock at the first tick: 0 would mean that it has not begun."""
_KEPT_S = 0.5
"""A command that is older is not followed: the thrusters stop, as a driver's own watchdog does."""
_REPEAT_S = 0.5
"""Wall time after which a tick without an answer is published again."""
_MANY_LATE = 200
"""After so many late ticks the machine is too slow for the rate."""
_PATIENCE_S = 600.0
"""Wall time for which it waits for a command, at rate 0."""
_EXACT = np.zeros(6)


_ALTIMETER_STREAM = 21


def simulate_report(
    workspace: Path,
    settings: FlightSettings,
    *,
    takes: Literal["thrusters", "wrench"],
    rate: float,
    track: Path | None,
) -> tuple[str, dict[str, Any]]:
    """Simulate the vehicle of a workspace's plan for others to command over ROS 2.

    Args:
        workspace: that holds the plan: the vehicle is let go at its start, over its sea floor.
        settings: of the survey.
        takes: which command is followed.
        rate: simulated over wall time; 0 waits for each command.
        track: CSV of the true track, if wanted.

    Returns:
        How it went, as text and as JSON values.

    Raises:
        VehicleError: ROS 2 is not installed, or no command came in time.
        WorkspaceError: there is no plan.
    """
    plan = plan_to_fly(workspace, settings.vehicle.dive)
    rng, floor = flight_noise(settings.seed), true_floor(plan, settings)
    setup = mission_setup(plan, settings, floor, max_mission_s(plan), rng)
    need_thrusters_alone(setup.vehicle)
    if setup.failures:
        note("thrusters that fail on the way do so in 'alice-survey fly' alone")
    altimeter = np.random.default_rng([settings.seed, _ALTIMETER_STREAM])
    flown, why = vehicle_over_ros(SimulatedVehicle(setup, rng), takes, rate, altimeter)
    if track is not None:
        write_track(track, flown)
    return (
        f"simulated {flown.time_s[-1] - flown.time_s[0]:.2f} s; ended: {why}",
        {"ticks": len(flown.time_s), "ending": why},
    )


def vehicle_over_ros(
    vehicle: SimulatedVehicle,
    takes: Literal["thrusters", "wrench"],
    rate: float,
    rng: np.random.Generator,
) -> tuple[Trajectory, str]:
    """Simulate a vehicle that others command, until they leave or it is interrupted.

    Args:
        vehicle: at rest on the surface.
        takes: which command is followed.
        rate: simulated over wall time; 0 waits for the command of each tick.
        rng: noise of the altimeter.

    Returns:
        The true track on the clock of the stamps, and why it ended.

    Raises:
        VehicleError: ROS 2 is not installed, or no command came in time.
    """
    with _session() as ros:
        node = VehicleNode(ros, vehicle, takes, rng)
        try:
            why = node.run(rate)
        except KeyboardInterrupt:
            why = "interrupted"
        finally:
            node.node.destroy_node()
    rows = np.array(node.track)
    poses = RigidTransform.from_components(rows[:, 1:4], Rotation.from_quat(rows[:, 4:8]))
    return Trajectory(time_s=rows[:, 0], ned_from_body=poses), why


class VehicleNode:
    """A simulated vehicle and its topics."""

    def __init__(
        self,
        ros: RosLibrary,
        vehicle: SimulatedVehicle,
        takes: Literal["thrusters", "wrench"],
        rng: np.random.Generator,
    ) -> None:
        name = vehicle.vehicle.name
        self.ros, self.vehicle, self.rng = ros, vehicle, rng
        self.thrusters = tuple(thruster.name for thruster in vehicle.vehicle.thrusters)
        self.track: list[list[float]] = []
        self.command: tuple[float, Array] | None = None
        self.frames = {part: f"{name}/{part}" for part in ("base_link", "imu", "dvl")}
        count = len(self.thrusters)
        holds_level = np.linalg.matrix_rank(vehicle.vehicle.configuration_matrix) == 6
        axes = LEVEL_WEIGHTS if holds_level else AXIS_WEIGHTS
        self.allocation = new_allocation(vehicle.vehicle, np.ones(count), exact=True, axes=axes)
        self.row = np.zeros(LOG_ROW)
        self.node = ros.rclpy.create_node("vehicle", namespace=name)
        publisher = self.node.create_publisher
        self.clock = publisher(message_class(CLOCK), "/clock", ros.qos)
        self.navigation = publisher(message_class(ODOMETRY), "navigation/odometry", ros.qos)
        self.truth = publisher(message_class(ODOMETRY), "truth/odometry", ros.qos)
        self.altimeter = publisher(message_class(RANGE), "altimeter", ros.qos)
        self.imu = publisher(message_class(IMU), "imu", ros.qos)
        self.dvl = publisher(message_class(TWIST), "dvl", ros.qos)
        self.turning = publisher(message_class(JOINTS), "thrusters/state", ros.qos)
        if takes == "thrusters":
            topic, kind, take = "thrusters/command", message_class(JOINTS), self._on_speeds
        else:
            topic, kind, take = "pilot/wrench", message_class(WRENCH), self.on_wrench
        self.commands = self.node.create_subscription(kind, topic, take, ros.qos)

    @property
    def now_s(self) -> float:
        """Time on the simulation's clock."""
        return START_S + self.vehicle.tick * TICK_S

    def run(self, rate: float) -> str:
        """Simulate tick by tick; why it ended."""
        begun, late = time.monotonic(), 0
        while True:
            estimate = self.vehicle.sense()
            self.track.append([self.now_s, *self.vehicle.world.now[:7].tolist()])
            if self.vehicle.touches_floor:
                return "the hull touched the sea floor"
            readings = self.readings(estimate)
            self._publish(readings)
            if rate == 0.0:
                if not self._answered(readings):
                    return "its commander left"
            else:
                due = begun + (self.vehicle.tick + 1) * TICK_S / rate
                if time.monotonic() > due:
                    late += 1
                    if late == _MANY_LATE:
                        warn(f"{late} ticks were late: the machine does not keep --rate {rate:g}")
                self._spin_until(due)
            self.vehicle.move(self.speeds())

    def _answered(self, readings: list[tuple[Any, Any]]) -> bool:
        """Wait for the command of this tick; whether one came, or false if none will."""
        begun = published = time.monotonic()
        while self.command is None or self.command[0] < self.now_s - 1e-6:
            self.ros.rclpy.spin_once(self.node, timeout_sec=0.05)
            now = time.monotonic()
            if self.command is not None and not self._is_commanded:
                return False
            if now - begun > _PATIENCE_S:
                raise VehicleError(
                    f"no command came on {self.commands.topic_name} for {_PATIENCE_S:g} s: start "
                    "what commands the vehicle with simulated time, or give --rate 1"
                )
            if now - published > _REPEAT_S:
                published = now
                self._publish(readings)
        return True

    @property
    def _is_commanded(self) -> bool:
        """Whether anyone publishes commands."""
        return bool(self.node.count_publishers(self.commands.topic_name))

    def _spin_until(self, due: float) -> None:
        while (left := due - time.monotonic()) > 0.0:
            self.ros.rclpy.spin_once(self.node, timeout_sec=left)

    def speeds(self) -> Array:
        """Thruster speeds to follow, (n,) rev/s."""
        if self.command is None or self.now_s - self.command[0] > _KEPT_S:
            return np.zeros(len(self.thrusters))
        return self.command[1]

    def _on_speeds(self, message: Any) -> None:
        speeds = speeds_from(message, self.thrusters)
        if np.all(np.isfinite(speeds)):
            self.command = (seconds(message.header.stamp), speeds)

    def on_wrench(self, message: Any) -> None:
        """Follow a wrench from its stamp on."""
        wrench = wrench_from(message)
        if np.all(np.isfinite(wrench)):
            allocate(wrench, self.vehicle.world.estimate[vector.U :], self.allocation)
            speeds = self.allocation.command.copy()
            self.command = (seconds(message.header.stamp), speeds)

    def _publish(self, readings: list[tuple[Any, Any]]) -> None:
        for publisher, message in readings:
            publisher.publish(message)

    def readings(self, estimate: Array) -> list[tuple[Any, Any]]:
        """What is published at this tick, the clock last."""
        build, frames, now_s = self.ros.build, self.frames, self.now_s
        stamp_ns = nanoseconds(now_s)
        world, navigation = self.vehicle.world, self.vehicle.parts.navigation
        log_row(navigation, self.row)
        north, east, depth, roll, pitch, heading = self.row[LOG_SIGMA : LOG_SIGMA + 6] ** 2
        believed = rotation_from_attitude(*estimate[vector.ROLL : vector.U]).as_quat()
        navigated = Odometry(
            stamp_s=now_s,
            position_ned=estimate[: vector.ROLL],
            quaternion_xyzw=believed,
            velocity_body=estimate[vector.U : vector.P],
            rates_body=estimate[vector.P : vector.ALTITUDE],
        )
        turn = Rotation.from_quat(world.now[3:7])
        true = Odometry(
            stamp_s=now_s,
            position_ned=world.now[:3],
            quaternion_xyzw=world.now[3:7],
            velocity_body=turn.inv().apply(world.now[7:10]),
            rates_body=world.now[10:13],
        )
        base, readings = frames["base_link"], navigation.readings
        variances = np.array([east, north, depth, roll, pitch, heading])
        sent: list[tuple[Any, Any]] = [
            (self.truth, odometry_message(build, true, f"{base}_truth", _EXACT)),
            (self.navigation, odometry_message(build, navigated, base, variances)),
            (self.turning, speeds_message(build, now_s, self.thrusters, world.state[STATE:])),
        ]
        if self.vehicle.tick > 0:
            force = flipped_body(readings[PUSH : PUSH + 3] / TICK_S)
            rates = flipped_body(readings[RATES : RATES + 3])
            flu = flipped_quaternion(believed)
            sent.append((self.imu, build.imu(stamp_ns, frames["imu"], flu, rates, force)))
        if self.vehicle.tick % self.vehicle.parts.sensors.dvl_every == 0:
            reach = self._altimeter_range(turn)
            sent.append((self.altimeter, build.range(stamp_ns, frames["dvl"], reach)))
            beams = self.vehicle.parts.sensors.beams
            velocity = beam_velocity(beams, readings[BEAM : BEAM + 4])
            if np.all(np.isfinite(velocity)):
                velocity = flipped_body(velocity)
                sent.append((self.dvl, build.velocity(stamp_ns, frames["dvl"], velocity)))
        return [*sent, (self.clock, build.make(CLOCK, clock=build.stamp(stamp_ns)))]

    def _altimeter_range(self, turn: Rotation) -> float:
        """Range, m, of a beam straight down from the DVL's place; NaN is no echo."""
        dvl, place = self.vehicle.parts.sensors.dvl, self.vehicle.parts.sensors.place[DVL]
        north, east, depth = self.vehicle.world.now[:3] + turn.apply(place)
        beam_n, beam_e, beam_d = turn.apply([0.0, 0.0, 1.0])
        reach = floor_range(
            self.vehicle.parts.floor, north, east, depth, beam_n, beam_e, beam_d, dvl.max_range_m
        )
        noise = math.hypot(dvl.range_noise_m, dvl.range_noise_fraction * reach)
        found = reach + noise * float(self.rng.standard_normal())
        return found if found >= dvl.min_range_m else math.nan
