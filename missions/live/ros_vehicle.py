"""The simulated vehicle as a ROS 2 node: thruster speeds or a wrench in, sensors and truth out.

Stamps are of the simulation's own clock, which `/clock` publishes: nodes that listen use simulated
time. With a rate the simulation keeps pace with the wall; without, it waits at each tick for the
command of that tick, so that it is as fast as what commands it, on any machine.
"""

import math
import time
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import VehicleError, warn
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.core.trajectory import Trajectory
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.allocation import AXIS_WEIGHTS, LEVEL_WEIGHTS
from alice_survey.sim.vehicle.dynamics import STATE
from alice_survey.sim.vehicle.navigation.filter import DVL_TIME, DVL_VELOCITY, PUSH, RATES
from alice_survey.sim.vehicle.navigation.sensors import DVL
from alice_survey.sim.vehicle.navigation.tick import LOG_ROW, LOG_SIGMA, log_row
from alice_survey.sim.vehicle.pilot.command import allocate, new_allocation
from alice_survey.sim.vehicle.sea import floor_range
from alice_survey.sim.vehicle.simulator import TICK_S, SimulatedVehicle
from missions.live.loop import Odometry
from missions.live.ros_messages import (
    RosLibrary,
    load_ros,
    message_class,
    nanoseconds,
    odometry_message,
    seconds,
    speeds_from,
    speeds_message,
    wrench_from,
)
from missions.logs.ros_builder import (
    CLOCK,
    IMU,
    JOINTS,
    ODOMETRY,
    RANGE,
    TWIST,
    WRENCH,
    flipped_body,
    flipped_quaternion,
)

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
    ros = load_ros()
    from rclpy.signals import SignalHandlerOptions

    ros.rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = VehicleNode(ros, vehicle, takes, rng)
        try:
            why = node.run(rate)
        except KeyboardInterrupt:
            why = "interrupted"
        finally:
            node.node.destroy_node()
    finally:
        ros.rclpy.try_shutdown()
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
            allocate(wrench, self.vehicle.world.estimate, self.allocation)
            speeds = self.allocation.command.copy()
            self.command = (seconds(message.header.stamp), speeds)

    def _publish(self, readings: list[tuple[Any, Any]]) -> None:
        for publisher, message in readings:
            publisher.publish(message)

    def readings(self, estimate: Array) -> list[tuple[Any, Any]]:
        """What is published at this tick, the clock last."""
        build, frames, now_s = self.ros.build, self.frames, self.now_s
        stamp_ns = nanoseconds(now_s)
        world, navigation = self.vehicle.world, self.vehicle.navigation
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
        if self.vehicle.tick % self.vehicle.sensors.dvl_every == 0:
            reach = self._altimeter_range(turn)
            sent.append((self.altimeter, build.range(stamp_ns, frames["dvl"], reach)))
            velocity = readings[DVL_VELOCITY : DVL_VELOCITY + 3]
            if np.all(np.isfinite(velocity)) and readings[DVL_TIME] == self.vehicle.tick * TICK_S:
                velocity = flipped_body(velocity)
                sent.append((self.dvl, build.velocity(stamp_ns, frames["dvl"], velocity)))
        return [*sent, (self.clock, build.make(CLOCK, clock=build.stamp(stamp_ns)))]

    def _altimeter_range(self, turn: Rotation) -> float:
        """Range, m, of a beam straight down from the DVL's place; NaN is no echo."""
        dvl, place = self.vehicle.sensors.dvl, self.vehicle.sensors.place[DVL]
        north, east, depth = self.vehicle.world.now[:3] + turn.apply(place)
        beam_n, beam_e, beam_d = turn.apply([0.0, 0.0, 1.0])
        reach = floor_range(
            self.vehicle.floor, north, east, depth, beam_n, beam_e, beam_d, dvl.max_range_m
        )
        noise = math.hypot(dvl.range_noise_m, dvl.range_noise_fraction * reach)
        found = reach + noise * float(self.rng.standard_normal())
        return found if found >= dvl.min_range_m else math.nan
