"""A plan made ready for the pilot's loop, and the record of what it commands.

`alice-survey pilot` flies it, or simulates its vehicle for others.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import VehicleError, note
from alice_survey.core.frames import rotation_from_attitude
from alice_survey.core.trajectory import write_track
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.command import Pilot
from alice_survey.sim.vehicle.pilot.memory import FOLLOW
from alice_survey.sim.vehicle.simulator import TICK_S, SimulatedVehicle
from alice_survey.sim.vehicle.vehicle import Vehicle
from missions.fly.flight_route import one_dive
from missions.fly.run import flight_noise, true_floor
from missions.fly.simulation import (
    FlightSettings,
    flight_settings,
    max_mission_s,
    mission_setup,
    piloting_of,
)
from missions.live.loop import Command, LinkLimits, LinkState, PilotLoop
from missions.live.ros_vehicle import vehicle_over_ros
from missions.values.plan_file import Plan, read_plan

PHASES = ("dive", "approach", "follow", "ascend", "done", "abort")
"""Names of the guidance's phases, by number."""
RECORD_COLUMNS = (
    "time_s", "state", "phase", "line", "north_m", "east_m", "depth_m", "roll_rad", "pitch_rad",
    "heading_rad", "altitude_m", "glass_north_m", "glass_east_m", "cross_m", "surge_n", "sway_n",
    "heave_n", "roll_nm", "pitch_nm", "yaw_nm",
)  # fmt: skip
"""Columns of the record, followed by `NAME_rps` of each thruster: time on the loop's clock; state
of the loop and phase of the guidance; line of the plan, -1 between lines; what was flown by, empty
without odometry; place of the left port's glass; offset of the path; wrench."""


def plan_to_fly(workspace: Path, dive: int | None) -> Plan:
    """The plan of a workspace, or one dive of it, from 1 on.

    Raises:
        PlanError: the plan lacks that dive.
        WorkspaceError: there is no plan.
    """
    return one_dive(read_plan(workspace / "plan" / "plan.json"), dive)


def need_thrusters_alone(vehicle: Vehicle) -> None:
    """Refuse a vehicle whose fins no message commands.

    Raises:
        VehicleError: it has fins.
    """
    if vehicle.fins:
        raise VehicleError(
            f"{vehicle.name} is steered by fins, and thrusters alone are commanded over ROS 2 and "
            "MAVLink: fly it with 'alice-survey fly'"
        )


@dataclass(eq=False)
class LiveMission:
    """A plan with the loop that flies it, and a row for each tick."""

    plan: Plan
    loop: PilotLoop
    vehicle: str
    thrusters: tuple[str, ...]
    rows: list[tuple[float | str, ...]] = field(default_factory=list)

    def tick(self, now_s: float) -> Command:
        """The command for now; it is recorded."""
        ticks = self.loop.ticks
        command = self.loop.tick(now_s)
        if self.loop.ticks > ticks:
            self.rows.append(self._row(command))
        return command

    @property
    def line(self) -> int:
        """Line of the plan that is being flown, -1 between lines."""
        report = self.loop.pilot.state.report
        flying = self.loop.state == LinkState.FLYING and report[slot.PHASE] == FOLLOW
        return int(report[slot.LINE]) if flying else -1

    @property
    def phase(self) -> str:
        """Phase of the guidance."""
        return PHASES[int(self.loop.pilot.state.report[slot.PHASE])]

    def write_record(self, path: Path) -> None:
        """Write the record as CSV, `RECORD_COLUMNS`."""
        header = (*RECORD_COLUMNS, *(f"{name}_rps" for name in self.thrusters))
        write_csv(path, header, self.rows)

    def summary(self) -> str:
        """How the mission went, in a line for each thing to know."""
        loop = self.loop
        lines = [loop.ending or f"ended while {loop.state}"]
        if loop.ticks:
            lines[0] += f"; {loop.ticks} ticks, {loop.late_ticks} late, {loop.jumps} clock jumps"
        lines += [f"refused {count} times: {why}" for why, count in sorted(loop.refused.items())]
        lines += [
            f"{one.thruster} did not turn as commanded: {one.left:.0%} of its thrust was counted on"
            for one in loop.failures
        ]
        return "\n".join(lines)

    def _row(self, command: Command) -> tuple[float | str, ...]:
        estimate = self.loop.estimate
        pose = estimate[vector.NORTH : vector.U]
        roll, pitch, heading = pose[3:]
        point = self.loop.pilot.guidance.point_body_m
        glass = pose[:3] + rotation_from_attitude(roll, pitch, heading).apply(point)
        return (
            command.time_s, str(command.state), self.phase, self.line, *pose.tolist(),
            float(estimate[vector.ALTITUDE]), *glass[:2].tolist(),
            float(self.loop.pilot.state.report[slot.CROSS]), *command.wrench.tolist(),
            *command.rps.tolist(),
        )  # fmt: skip


def mission_of(
    plan: Plan,
    settings: FlightSettings,
    limits: LinkLimits,
    altimeter_body_m: tuple[float, float, float] | None = None,
) -> LiveMission:
    """A mission that flies a plan.

    Args:
        plan: what to fly.
        settings: vehicle, cameras and controller.
        limits: for what is heard.
        altimeter_body_m: place of the altimeter; that of the DVL if not given.

    Raises:
        VehicleError: a setting does not fit the vehicle, it cannot fly the plan, or has fins.
    """
    flies = piloting_of(plan, settings, max_mission_s(plan))
    need_thrusters_alone(flies.vehicle)
    pilot = Pilot(
        flies.vehicle, flies.path, flies.gains, flies.guidance,
        exact_allocation=settings.vehicle.allocation == "exact", known_health=flies.known_health,
        without=flies.without, tick_s=TICK_S,
    )  # fmt: skip
    loop = PilotLoop(
        pilot,
        hull_body_m=flies.vehicle.hull.points_body_m,
        altimeter_body_m=altimeter_body_m or settings.camera.dvl_position_body_m,
        limits=limits,
    )
    thrusters = tuple(thruster.name for thruster in flies.vehicle.thrusters)
    return LiveMission(plan, loop, flies.vehicle.name, thrusters)


_ALTIMETER_STREAM = 21


def pilot_report(
    workspace: Path,
    survey: SurveyConfig,
    limits: LinkLimits,
    fly: Callable[[LiveMission], None],
    *,
    altimeter_body_m: tuple[float, float, float] | None,
    record: Path | None,
) -> tuple[str, dict[str, Any]]:
    """Fly the plan of a workspace with a vehicle outside this program.

    Args:
        workspace: that holds the plan.
        survey: its settings.
        limits: for what is heard.
        fly: flies the mission to its end: a transport.
        altimeter_body_m: place of the altimeter; that of the DVL if not given.
        record: CSV of what was flown by and commanded, if wanted.

    Returns:
        How it went, as text and as JSON values.

    Raises:
        VehicleError: the transport is not installed, or the vehicle cannot fly the plan.
        WorkspaceError: there is no plan.
    """
    plan = plan_to_fly(workspace, survey.vehicle.dive)
    mission = mission_of(plan, flight_settings(survey), limits, altimeter_body_m)
    try:
        fly(mission)
    finally:
        if record is not None:
            mission.write_record(record)
    return _result(mission)


def _result(mission: LiveMission) -> tuple[str, dict[str, Any]]:
    loop = mission.loop
    return mission.summary(), {
        "ending": loop.ending,
        "complete": loop.ending == "complete",
        "ticks": loop.ticks,
        "late_ticks": loop.late_ticks,
        "clock_jumps": loop.jumps,
        "refused": dict(loop.refused),
        "failures_found": [one.thruster for one in loop.failures],
    }


def simulate_report(
    workspace: Path,
    survey: SurveyConfig,
    *,
    takes: Literal["thrusters", "wrench"],
    rate: float,
    track: Path | None,
) -> tuple[str, dict[str, Any]]:
    """Simulate the vehicle of a workspace's plan for others to command over ROS 2.

    Args:
        workspace: that holds the plan: the vehicle is let go at its start, over its sea floor.
        survey: its settings.
        takes: which command is followed.
        rate: simulated over wall time; 0 waits for each command.
        track: CSV of the true track, if wanted.

    Returns:
        How it went, as text and as JSON values.

    Raises:
        VehicleError: ROS 2 is not installed, or no command came in time.
        WorkspaceError: there is no plan.
    """
    plan = plan_to_fly(workspace, survey.vehicle.dive)
    rng = flight_noise(survey.seed)
    setup = mission_setup(
        plan, flight_settings(survey), true_floor(plan, survey), max_mission_s(plan), rng
    )
    need_thrusters_alone(setup.vehicle)
    if setup.failures:
        note("thrusters that fail on the way do so in 'alice-survey fly' alone")
    vehicle = SimulatedVehicle(
        setup.vehicle, setup.sensors, setup.floor, setup.current, setup.disturbance, rng,
        start_ne_m=setup.start_ne_m, start_heading_rad=setup.start_heading_rad,
        health=setup.health,
    )  # fmt: skip
    altimeter = np.random.default_rng([survey.seed, _ALTIMETER_STREAM])
    flown, why = vehicle_over_ros(vehicle, takes, rate, altimeter)
    if track is not None:
        write_track(track, flown)
    return (
        f"simulated {flown.time_s[-1] - flown.time_s[0]:.2f} s; ended: {why}",
        {"ticks": len(flown.time_s), "ending": why},
    )
