"""The pilot as a ROS 2 node: odometry and altitude in, wrench and thruster speeds out.

At sea it ticks by a steady timer, and stamps are compared with the node's clock. With `sim_time`
it ticks by `/clock`, as fast as that runs.
"""

import json
import time
from dataclasses import dataclass
from typing import Any

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.simulator import TICK_S
from missions.live.loop import FIRST_S, SILENCE_S, Command, LinkState
from missions.live.mission import LiveMission
from missions.live.ros_messages import (
    RosLibrary,
    flipped_pair,
    load_ros,
    message_class,
    nanoseconds,
    odometry_from,
    range_from,
    seconds,
    speeds_from,
    speeds_message,
)
from missions.logs.ros_builder import CLOCK, JOINTS, ODOMETRY, RANGE, STRING, WRENCH

_WAIT_S = 0.1
_FAREWELLS = 3
"""Commands of no thrust when the node ends."""
_STATE_TICKS = 20
"""The state is published every so many ticks, and whenever it changes."""


@dataclass(frozen=True, kw_only=True)
class Topics:
    """Names of the topics, below the vehicle's where they do not begin with a slash."""

    odometry: str = "navigation/odometry"
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
    ros = load_ros()
    from rclpy.signals import SignalHandlerOptions

    ros.rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = _PilotNode(ros, mission, topics, sim_time)
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
    finally:
        ros.rclpy.try_shutdown()


class _PilotNode:
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
        self._sim_time = sim_time
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
        if self._has_begun:
            self.mission.loop.hear_odometry(odometry_from(message), self.now_s)

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
