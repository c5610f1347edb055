"""What `alice-survey pilot` does: from a workspace to a pilot or a simulated vehicle."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import note
from alice_survey.core.trajectory import write_track
from alice_survey.sim.vehicle.simulator import SimulatedVehicle
from missions.fly.run import flight_noise, true_floor
from missions.fly.simulation import flight_settings, max_mission_s, mission_setup
from missions.live.loop import LinkLimits
from missions.live.mission import LiveMission, mission_of, need_thrusters_alone, plan_to_fly
from missions.live.ros_vehicle import vehicle_over_ros

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
