"""Faults in time at the three doors of the pilot: how a dive ends, and what its exit code says.

    .venv/bin/python -m benchmarks.faults [--quick] [--json FILE]

Forty dives over 5 x 2 m in 6 m of water, in this process and in simulated time. Kind by kind the
moment, the current (0 to 0.2 m/s, any direction), what fails by how much, and all noise are drawn
from one seed. Thrusters, propellers, DVL and USBL fail in the stage `fly`; odometry goes wrong on
its way from the simulated navigation to the pilot: between the two nodes of ROS 2, which a bus of
this process joins instead of DDS, and in MAVLink's packets from a submarine whose own loops follow
the set-points. Every dive must end within the limits of time that the pilot states; none may be
"complete" with more than 5 % of its pictures missed or off their lines; and the exit code is 0 for
a dive that was completed and 3 for any other.
"""

import math
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation
from shapely import distance, points
from shapely.geometry import LineString

from alice_survey.app.commands.missions import PilotCommand
from alice_survey.core.artefacts import write_json
from alice_survey.core.config import SurveyConfig, change_section, parse_config
from alice_survey.core.errors import collected_by
from alice_survey.core.executor import SERIAL
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import STATE
from alice_survey.sim.vehicle.propulsion import electrical_power
from alice_survey.sim.vehicle.simulator import TICK_S, SimulatedVehicle
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over, markdown
from camera_calib.rig import design_rig
from missions.fly.run import run_fly
from missions.fly.simulation import (
    flight_noise,
    flight_settings,
    max_ascent_s,
    max_mission_s,
    mission_setup,
    stations_of_dives,
    true_floor,
    whole_route,
)
from missions.live import ros
from missions.live.mission import RECORD_COLUMNS, LinkLimits, LinkState, Odometry, mission_of
from missions.logs.ros_builder import MAP
from missions.plan.planner import plan_survey
from missions.stages import FLY
from missions.values.flight import Flight, trigger_times
from missions.values.plan_file import Plan
from tests.missions.live.doors import Nodes, Submarine

_SEED = 45
_THRUSTERS = ("bow", "stern", "port", "starboard", "vertical")
_NO_USBL = "no USBL, DVL silent for 15 s"
_FLOWN = {
    "thruster dead": 4, "thruster weak": 3, "propeller lost": 3, "DVL lost": 3, _NO_USBL: 3,
}  # fmt: skip
_ODOMETRY = ("frozen", "jumped", "late", "wrong frame", "NaN", "wrong velocity")
_AREA = {"length_m": 5.0, "width_m": 2.0, "heading_deg": 0.0, "seafloor_depth_m": 6.0}
_OFF_SHARE = 0.05
"""Of pictures, missed or off their lines, that a dive may have that is complete."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A dive and its fault, as drawn."""

    door: str
    fault: str
    at_s: float
    """After which it is there, for good."""
    thruster: str
    amount: float
    """From 0 to 1: how large it is."""
    towards_deg: float
    """Where odometry jumps to."""
    current_mps: float
    current_towards_deg: float
    seed: int


@dataclass(frozen=True, kw_only=True)
class Result:
    """What became of a dive."""

    case: Case
    ending: str
    exit_code: int
    lasted_s: float
    is_bounded: bool
    energy_wh: float
    away_m: float
    """Farthest, level, that the left port was from the plan's route, until the end."""
    off_share: float
    """Of the planned pictures: missed, or farther off their line than is allowed."""

    @property
    def is_right(self) -> bool:
        """Whether it has an end, and the exit code that it deserves."""
        is_good = self.ending == "complete" and self.off_share <= _OFF_SHARE
        return self.is_bounded and self.exit_code == (0 if is_good else 3)


def cases() -> list[Case]:
    """All dives, as drawn from the seed."""
    rng = np.random.default_rng(_SEED)
    kinds = [("fly", fault) for fault, count in _FLOWN.items() for _ in range(count)]
    kinds += [(door, fault) for door in ("ROS 2", "MAVLink") for fault in _ODOMETRY for _ in "12"]
    return [
        Case(
            door=door, fault=fault, at_s=rng.uniform(10.0, 180.0),
            thruster=str(rng.choice(_THRUSTERS)), amount=rng.uniform(),
            towards_deg=rng.uniform(0.0, 360.0), current_mps=rng.uniform(0.0, 0.2),
            current_towards_deg=rng.uniform(0.0, 360.0), seed=int(rng.integers(1, 10_000)),
        )
        for door, fault in kinds
    ]  # fmt: skip


def dive(case: Case) -> Result:
    """Fly a case to its end."""
    calm = parse_config({"area": _AREA, "seed": case.seed}, "faults")
    plan = plan_survey(calm, design_rig(calm.camera, calm.water)).plan
    current = {"current_mps": case.current_mps, "current_towards_deg": case.current_towards_deg}
    config = change_section(calm, "sea", **current)
    with collected_by(lambda level, text: None):
        return _through_fly(case, config, plan) if case.door == "fly" else _live(case, config, plan)


def _through_fly(case: Case, config: SurveyConfig, plan: Plan) -> Result:
    lasts_s = 15.0 if case.fault == _NO_USBL else 1e4
    silent: dict[str, Any] = {"dvl_dropouts_s": ((case.at_s, case.at_s + lasts_s),)}
    changes: dict[str, tuple[str, dict[str, Any]]] = {
        "thruster dead": ("vehicle", {"failures": [f"{case.thruster}@{case.at_s}"]}),
        "thruster weak": (
            "vehicle", {"failures": [f"{case.thruster}={0.3 + 0.4 * case.amount}@{case.at_s}"]}
        ),
        "propeller lost": ("vehicle", {"failures": [f"{case.thruster}:propeller@{case.at_s}"]}),
        "DVL lost": ("navigation", silent),
        _NO_USBL: ("navigation", silent | {"usbl_noise_m": 0.0}),
    }  # fmt: skip
    section, values = changes[case.fault]
    settings = flight_settings(change_section(config, section, **values))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_json(folder / "plan" / "plan.json", plan.to_json())
        write = run_fly(folder, folder, SERIAL, water=config.water, **vars(settings))
        flight = cast("Flight", cast("partial[None]", write).args[1])
        return _result(
            case, plan, flight.ending, 3 if FLY.shortfall(folder) else 0,
            float(flight.flown.energy_j.sum()), flight.flown.time_s, flight.glass_ned,
            (flight.trigger_s, flight.trigger_line),
            is_bounded=not flight.ending.startswith("broken off"),
        )  # fmt: skip


def _live(case: Case, config: SurveyConfig, plan: Plan) -> Result:
    settings, rng = flight_settings(config), flight_noise(case.seed)
    mission = mission_of(plan, settings, LinkLimits())
    max_s = max_mission_s(plan) + 2.0 * max_ascent_s(plan)
    setup = mission_setup(plan, settings, true_floor(plan, settings), max_s, rng)
    vehicle, door_of = SimulatedVehicle(setup, rng), Nodes if case.door == "ROS 2" else Submarine
    door = door_of(mission, vehicle, Link(case).pass_on)
    truth, energy_j, power_w = list[Array](), 0.0, np.zeros(len(mission.thrusters))
    while vehicle.tick * TICK_S < max_s:
        vehicle.sense()
        speeds, state = door.tick(), vehicle.world.state
        truth.append(vehicle.world.now[:7].copy())
        propulsion = vehicle.parts.plant.propulsion
        electrical_power(propulsion, state[STATE:], state[7:STATE], power_w)
        energy_j += float(power_w.sum()) * TICK_S
        is_over = door.is_safe and mission.loop.state == LinkState.OVER
        if is_over or vehicle.touches_floor:
            break
        vehicle.move(speeds)
    poses, time_s = np.array(truth), TICK_S * np.arange(len(truth), dtype=np.float64)
    arm = np.array(config.camera.position_body_m)
    glass_ned: Array = poses[:, :3] + Rotation.from_quat(poses[:, 3:]).apply(arm)
    columns = [RECORD_COLUMNS.index(n) for n in ("time_s", "line", "glass_north_m", "glass_east_m")]
    rows = np.array([[float(row[i]) for i in columns] for row in mission.rows])
    rows = rows[np.isfinite(rows[:, 2])]
    taken = trigger_times(plan, rows[:, 0] - ros.START_S, rows[:, 1], rows[:, 2:])
    touched = vehicle.touches_floor
    ending = "the hull touched the sea floor" if touched else mission.loop.ending
    code = 0 if PilotCommand().is_passed(mission.summary()[1]) else 3
    end: dict[str, Any] = {"taken": taken, "is_bounded": is_over or touched}
    return _result(case, plan, ending, code, energy_j, time_s, glass_ned, **end)


def _result(
    case: Case, plan: Plan, ending: str, exit_code: int, energy_j: float, time_s: Array,
    glass_ned: Array, taken: tuple[Array, tuple[int, ...]], *, is_bounded: bool,
) -> Result:  # fmt: skip
    places = np.transpose([np.interp(taken[0], time_s, axis) for axis in glass_ned.T[:2]])
    off = [
        abs(plan.lines[line].offsets_m(place)[1]) > plan.allowed_offset_m
        for place, line in zip(places, taken[1], strict=True)
    ]
    planned, route = stations_of_dives(plan), whole_route(plan)
    way = LineString(route.places(np.linspace(0.0, route.length_m, 2000))[:, :2])
    return Result(
        case=case, ending=ending, exit_code=exit_code, lasted_s=float(time_s[-1]),
        is_bounded=is_bounded, energy_wh=energy_j / 3600.0,
        away_m=float(distance(way, points(glass_ned[:, :2])).max()),
        off_share=(max(planned - len(off), 0) + sum(off)) / planned,
    )  # fmt: skip


class Link:
    """What becomes of odometry on its way to the pilot."""

    def __init__(self, case: Case) -> None:
        """A link that is sound until the case's fault."""
        self.case, self.sent = case, list[Odometry]()
        self.first: Odometry | None = None

    def pass_on(self, now: Odometry) -> tuple[Odometry, str]:
        """What arrives of odometry, and the name of its frame."""
        case = self.case
        self.sent.append(now)
        if now.stamp_s < ros.START_S + case.at_s:
            return now, MAP
        self.first = first = self.first or now
        angle, (north, east, down) = math.radians(case.towards_deg), now.position_ned
        ahead = np.array([0.3 + 1.7 * case.amount, 0.0, 0.0])
        away_m = (1.5 + 28.5 * case.amount) * np.array([math.cos(angle), math.sin(angle), 0.0])
        late = round((0.6 + 4.4 * case.amount) / TICK_S)
        spoilt: dict[str, Odometry] = {
            "frozen": replace(first, stamp_s=now.stamp_s),
            "jumped": replace(now, position_ned=now.position_ned + away_m),
            "late": self.sent[-1 - min(late, len(self.sent) - 1)],
            "wrong frame": replace(now, position_ned=np.array([east, north, -down])),
            "NaN": replace(now, position_ned=np.full(3, np.nan)),
            "wrong velocity": replace(now, velocity_body=now.velocity_body + ahead),
        }
        return spoilt[case.fault], "odom" if case.fault == "wrong frame" else MAP


def findings(results: Sequence[Result]) -> Findings:
    """What must hold, and the largest figures."""
    wrong = [str(result) for result in results if not result.is_right]
    largest = {
        "most energy": ("Wh", max(r.energy_wh for r in results)),
        "farthest from the plan": ("m", max(r.away_m for r in results)),
        "longest": ("s", max(r.lasted_s for r in results)),
    }
    figures = [Figure(name=name, value=value, unit=unit) for name, (unit, value) in largest.items()]
    name, none = f"wrong ends or exit codes of {len(results)}", Goal(maximum=0.0)
    figures.append(Figure(name=name, value=len(wrong), unit="", goal=none))
    return Findings(figures=tuple(figures), failed=tuple(wrong))


def table(results: Sequence[Result]) -> list[dict[str, str]]:
    """A row for each door and fault."""
    rows = []
    for door, fault in dict.fromkeys((r.case.door, r.case.fault) for r in results):
        own = [r for r in results if (r.case.door, r.case.fault) == (door, fault)]
        rows.append({
            "door": door, "fault": fault,
            "exit code 0": f"{sum(r.exit_code == 0 for r in own)} of {len(own)}",
            "the others": "; ".join(dict.fromkeys(r.ending for r in own if r.exit_code)),
            "pictures off, %": ", ".join(f"{100 * r.off_share:.0f}" for r in own),
            "Wh": ", ".join(f"{r.energy_wh:.1f}" for r in own),
            "from the plan, m": ", ".join(f"{r.away_m:.1f}" for r in own),
            "ended after, s": ", ".join(f"{r.lasted_s:.0f}" for r in own),
        })  # fmt: skip
    return rows


def main() -> None:
    """Fly all dives, and print what became of them."""
    parser = Parser(__doc__, quick="every fifth dive")
    options, about = parser.begin("numpy", "numba", "scipy", "pymavlink")
    results = [dive(case) for case in cases()[:: 5 if options.quick else 1]]
    print(*markdown(table(results)), sep="\n")
    sys.exit(hand_over(options, about, findings(results), {"rows": [*map(asdict, results)]}))


if __name__ == "__main__":
    main()
