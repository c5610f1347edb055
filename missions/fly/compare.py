"""The command `vehicle compare`: one survey, flown before and after the paper's modification.

The original SPARUS II steers by line of sight with two horizontal thrusters; ALICE has two lateral
thrusters more and holds its lines by sway (section VIII). All fly the same plan in the same sea:
the current and the gusts are drawn from a separate generator, so that vehicles which behave
differently still meet the same water. The followed point is the body's origin, as in the paper
("the coordinates of the vehicle", eq. los_heading), not the left port's glass as in `fly`.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import json_values, write_csv, write_json
from alice_survey.core.config import SurveyConfig, change_section, parse_current
from alice_survey.core.errors import ConfigError, VehicleError
from alice_survey.core.executor import Executor, local_executor
from alice_survey.core.frames import Array
from alice_survey.kit.words import text_table
from alice_survey.sim.vehicle.pilot.gains import gains_for
from alice_survey.sim.vehicle.pilot.memory import FOLLOW, PHASE
from alice_survey.sim.vehicle.pilot.settings import pilot_guidance
from alice_survey.sim.vehicle.sea import level_floor
from alice_survey.sim.vehicle.simulator import Flown, Setup, simulate
from alice_survey.sim.vehicle.vehicle import Vehicle, vehicle_to_fly
from camera_calib.rig import design_rig
from missions.fly.run import line_runs, true_velocity
from missions.fly.simulation import (
    FlightSettings,
    flight_of,
    flight_settings,
    max_mission_s,
    mission_setup,
    with_values,
)
from missions.plan.planner import plan_survey
from missions.route.energy import has_sway
from missions.values.flight import Flight, rms
from missions.values.plan_file import Plan

_CHANCE, _SEA = 40, 41
"""Streams of a seed: instruments, and the water."""
_PAPER_SPACING_M = 1.0
_COLUMNS = {
    "lines, m": ("lines_true_m", 3), "believed": ("lines_believed_m", 3),
    "route, m": ("route_true_m", 3), "heading, deg": ("heading_rms_deg", 1),
    "roll, deg": ("turn_roll_peak_deg", 1), "surge, m/s": ("turn_surge_peak_mps", 2),
    "yaw, deg/s": ("turn_yaw_peak_deg_s", 0), "Wh": ("survey_energy_wh", 1), "s": ("survey_s", 0),
    "complete": ("complete", 2),
}  # fmt: skip
"""Of the printed table: figure and digits; `flights.csv` and `compare.json` hold all."""
_PAPER_COLUMNS = {
    "lines, m": "cross_track_rms_m", "roll, deg": "roll_in_turns_deg",
    "surge, m/s": "surge_in_turns_mps", "yaw, deg/s": "yaw_in_turns_deg_s",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A vehicle and how it is steered."""

    name: str
    vehicle: str
    controller: Literal["sway", "los"]
    look_ahead_m: float | None = None
    """Look-ahead distance of `los`; derived from the vehicle when left out."""
    failed: tuple[str, ...] = ()
    """Thrusters that are left out."""
    equal_speeds: bool = False
    """The allocation takes propellers to push astern as well as ahead, so that a turn is made by
    equal and opposite speeds, as the paper says of the original (section V)."""


ORIGINAL, EQUAL, IMPROVED = "original", "original, equal speeds", "improved"
COLA2_LOOK_AHEAD_M = 5.5
"""The default of SPARUS II's own software."""
VARIANTS = (
    Variant(name=ORIGINAL, vehicle="sparus2", controller="los"),
    Variant(name=EQUAL, vehicle="sparus2", controller="los", equal_speeds=True),
    Variant(
        name="original, 5.5 m ahead", vehicle="sparus2", controller="los",
        look_ahead_m=COLA2_LOOK_AHEAD_M,
    ),
    Variant(
        name="equal speeds, 5.5 m ahead", vehicle="sparus2", controller="los", equal_speeds=True,
        look_ahead_m=COLA2_LOOK_AHEAD_M,
    ),
    Variant(
        name="ALICE, laterals off", vehicle="alice", controller="los", failed=("bow", "stern")
    ),
    Variant(name="ALICE by line of sight", vehicle="alice", controller="los"),
    Variant(name=IMPROVED, vehicle="alice", controller="sway"),
)  # fmt: skip
"""What is compared: the two configurations, and what separates them."""


def variants_of(vehicles: Sequence[str]) -> tuple[Variant, ...]:
    """Vehicles by name or file, each steered by sway if it can sway; `VARIANTS` if there are none.

    Raises:
        VehicleError: one is not known, or two have one name.
    """
    found = [vehicle_to_fly(vehicle) for vehicle in vehicles]
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        raise VehicleError(f"vehicles {', '.join(names)}: two have one name")
    variants = [
        Variant(name=one.name, vehicle=vehicle, controller="sway" if has_sway(one) else "los")
        for vehicle, one in zip(vehicles, found, strict=True)
    ]
    return tuple(variants) or VARIANTS


PAPER = {
    ORIGINAL: {
        "cross_track_rms_m": [0.36, 0.36],
        "roll_in_turns_deg": [20.0, 30.0],
        "surge_in_turns_mps": [0.3, 0.5],
        "yaw_in_turns_deg_s": [17.0, 17.0],
    },
    IMPROVED: {"cross_track_rms_m": [0.12, 0.12], "roll_in_turns_deg": [0.0, 10.0]},
}
"""Least and greatest. Cross-track and roll: section VIII. Surge and yaw rate: section V, of another
lawnmower at 0.2 m/s, turned by the horizontal thrusters."""


@dataclass(frozen=True, kw_only=True)
class FlightFigures:
    """Figures of one flight; NaN where there is none.

    Cross-track errors are rms, of the body's origin: "true" by the true place, "believed" by the
    navigation's. "Route" is all the way from the first line's run-in to the last line's end, turns
    included. A turn is counted from the end of a line to the middle of the next, since a vehicle
    that overshoots still turns on the line; of each turn the peak is taken.
    """

    lines_true_m: float
    lines_believed_m: float
    route_true_m: float
    heading_rms_deg: float
    turn_roll_peak_deg: float
    """Mean over turns."""
    turn_surge_peak_mps: float
    turn_yaw_peak_deg_s: float
    survey_energy_wh: float
    """Energy from the run-in to the end of the last line."""
    survey_s: float
    complete: float
    """1 if the mission came to its end."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A sea: where its current flows, and its swell."""

    current_mps: float
    towards_deg: float
    swell_m: float = 0.0
    """Height of regular waves, trough to crest."""
    swell_s: float = 6.0
    swell_towards_deg: float = 0.0

    @property
    def name(self) -> str:
        """The current as the command line takes it."""
        current = f"{self.current_mps:g}@{self.towards_deg:g}"
        if self.swell_m == 0.0:
            return current
        return f"{current} with swell {self.swell_m:g}@{self.swell_s:g}"


Outcome = dict[str, Any]
"""A row of `flights.csv`: configuration, sea, seed, ending, look-ahead, and `FlightFigures`."""
_FIGURES = tuple(FlightFigures.__dataclass_fields__)


def default_cases(plan: Plan) -> tuple[Case, ...]:
    """A current across the lines, one along them, still water, and that with some swell.

    The paper does not describe its sea. 0.1 m/s is the current in which the improved controller is
    to hold its lines; 0.5 m and 6 s are a calm day on an open coast (inferred).
    """
    along = math.degrees(plan.lines[0].heading_rad)
    across = round((along + 90.0) % 360.0, 6)
    still = Case(current_mps=0.0, towards_deg=0.0)
    return (
        Case(current_mps=0.1, towards_deg=across),
        Case(current_mps=0.1, towards_deg=round(along % 360.0, 6)),
        still,
        replace(still, swell_m=0.5, swell_s=6.0, swell_towards_deg=across),
    )


def _fly_one(settings: FlightSettings, plan: Plan, which: tuple[Case, Variant, int]) -> Outcome:
    case, variant, seed = which
    setup, _, flight = fly_variant(settings, plan, variant, case, seed)
    return {
        "configuration": variant.name, "current_mps": case.current_mps,
        "towards_deg": case.towards_deg, "swell_m": case.swell_m, "swell_s": case.swell_s,
        "seed": seed, "ending": flight.ending,
        "look_ahead_m": float(setup.guidance.look_ahead_m), **asdict(figures_of(flight)),
    }  # fmt: skip


def fly_variant(
    settings: FlightSettings, plan: Plan, variant: Variant, case: Case, seed: int
) -> tuple[Setup, Flown, Flight]:
    """Fly a plan by a variant, over a level sea floor."""
    settings = replace(
        settings,
        vehicle=with_values(
            settings.vehicle, name=variant.vehicle, controller=variant.controller,
            failures=list(variant.failed),
        ),
        sea=with_values(
            settings.sea, current_mps=case.current_mps, current_towards_deg=case.towards_deg,
            swell_m=case.swell_m, swell_period_s=case.swell_s,
            swell_towards_deg=case.swell_towards_deg % 360.0, current_file=None,
        ),
        camera=with_values(settings.camera, position_body_m=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    max_s = max_mission_s(plan)
    water = np.random.default_rng([seed, _SEA])
    floor = level_floor(plan.seafloor_depth_m)
    setup = with_variant(mission_setup(plan, settings, floor, max_s, water), variant)
    chance = np.random.default_rng([seed, _CHANCE])
    flown = simulate(setup, chance, max_s=max_s, label="", sea_rng=water)
    return setup, flown, flight_of(plan, settings.camera.position_body_m, setup, flown)


def with_variant(setup: Setup, variant: Variant) -> Setup:
    """A mission with the variant's look-ahead and belief."""
    believed = with_equal_thrust(setup.vehicle) if variant.equal_speeds else setup.vehicle
    gains = gains_for(believed.weaken(dict.fromkeys(variant.failed, 0.0)), setup.path.speed_mps)
    guidance = pilot_guidance(
        gains,
        setup.path,
        variant.controller,
        max_depth_m=setup.guidance.limits.max_depth_m,
        point_body_m=(0.0, 0.0, 0.0),
        look_ahead_m=variant.look_ahead_m,
        limits=setup.guidance.limits,
    )
    return replace(setup, gains=gains, guidance=guidance, believed=believed)


def with_equal_thrust(vehicle: Vehicle) -> Vehicle:
    """The vehicle with open propellers that push astern as they push ahead."""
    return replace(
        vehicle,
        thrusters=tuple(
            replace(t, kt_reverse=t.kt_forward, kq_reverse=t.kq_forward) if t.kind == "open" else t
            for t in vehicle.thrusters
        ),
    )


def figures_of(flight: Flight) -> FlightFigures:
    """What came out of a flight."""
    flown, line = flight.flown, flight.line
    tick_s = float(flown.time_s[1] - flown.time_s[0])
    following = flown.report[:, PHASE] == FOLLOW
    reached = np.flatnonzero(following & (line >= 0))
    ticks = np.arange(len(line))
    ends = (reached[0], reached[-1]) if len(reached) else (0, -1)
    route = following & (ticks >= ends[0]) & (ticks <= ends[1])
    true, heading = flight.line_errors
    velocity = true_velocity(flown)
    roll = np.abs(np.rad2deg(flight.attitude_rad[:, 0]))
    turns = turn_rows(line, following)

    def peak(values: Array) -> float:
        return float(np.mean([values[rows].max() for rows in turns])) if turns else math.nan

    return FlightFigures(
        lines_true_m=rms(true),
        lines_believed_m=rms(flight.believed_cross_track),
        route_true_m=rms(flight.route_error[route]),
        heading_rms_deg=rms(np.rad2deg(heading)),
        turn_roll_peak_deg=peak(roll),
        turn_surge_peak_mps=peak(velocity[:, 0]),
        turn_yaw_peak_deg_s=peak(np.abs(np.rad2deg(velocity[:, 5]))),
        survey_energy_wh=float(flown.power_w[route].sum()) * tick_s / 3600.0,
        survey_s=float(route.sum()) * tick_s,
        complete=float(flight.ending == "complete"),
    )


def turn_rows(line: Array, following: NDArray[np.bool_]) -> list[slice]:
    """Ticks of each turn: from the end of a line to the middle of the next."""
    known = np.where(following & (line >= 0), line, -1.0)
    return [
        slice(left, (begun + ended) // 2)
        for (_, left), (begun, ended) in itertools.pairwise(line_runs(known))
        if begun > left and known[left - 1] != known[begun]
    ]


def compare_report(
    config: SurveyConfig,
    out: Path,
    *,
    currents: Sequence[str] = (),
    seed: int | None = None,
    flights: int = 5,
    executor: Executor | None = None,
    vehicles: Sequence[str] = (),
) -> tuple[str, dict[str, Any]]:
    """Fly a survey by both configurations, and write a table and all figures.

    Args:
        config: the survey; lines are 1 m apart, as the paper's, where it does not say.
        out: folder to write.
        currents: `SPEED@DIRECTION`; `default_cases` when left out.
        seed: of the first flight; the survey's when left out.
        flights: of each variant in each current.
        executor: where tasks run; all cores of this machine when left out.
        vehicles: names or files of the vehicles to compare; the paper's two configurations when
            left out.

    Returns:
        Text, and the same as values for JSON.

    Raises:
        ConfigError: a current is not of that form.
    """
    variants = variants_of(vehicles)
    # Turns that all can fly.
    config = change_section(config, "plan", turns="arcs")
    if config.plan.line_spacing_m is None:
        config = change_section(config, "plan", line_spacing_m=_PAPER_SPACING_M)
    plan = plan_survey(config, design_rig(config.camera, config.water)).plan
    cases = [_case(text) for text in currents] or list(default_cases(plan))
    first = config.seed if seed is None else seed
    seeds = list(range(first, first + flights))
    settings = flight_settings(config)
    fly = partial(_fly_one, settings, plan)
    jobs = list(itertools.product(cases, variants, seeds))
    outcomes = list((executor or local_executor()).map(fly, jobs, label="flights"))
    each = len(variants) * flights
    data: dict[str, Any] = {
        "paper": PAPER,
        "plan": {
            "lines": len(plan.lines), "line_spacing_m": plan.line_spacing_m,
            "speed_mps": plan.speed_mps, "altitude_m": plan.altitude_m,
        },
        "seeds": seeds,
        "variants": {
            variant.name: {**asdict(variant), "failed": list(variant.failed)}
            for variant in variants
        },
        "cases": [
            _case_data(plan, case, outcomes[i * each : (i + 1) * each], variants)
            for i, case in enumerate(cases)
        ],
    }  # fmt: skip
    text = (
        f"{len(plan.lines)} lines {plan.line_spacing_m:g} m apart at {plan.speed_mps:g} m/s, "
        f"{len(seeds)} flight(s) of each vehicle in the same water (docs/vehicle-comparison.md): "
        "cross-track rms, mean peak of the turns, mean ± standard deviation over flights\n"
        f"{_table(data['cases'])}"
    )
    write_json(out / "compare.json", data)
    rows = (
        [round(value, 6) if isinstance(value, float) else value for value in outcome.values()]
        for outcome in outcomes
    )
    write_csv(out / "flights.csv", list(outcomes[0]), rows)
    return f"{text}\n\nwrote {out}", data


def _case_data(
    plan: Plan, case: Case, outcomes: Sequence[Outcome], variants: Sequence[Variant]
) -> dict[str, Any]:
    """The flights in one sea, whose current is split across and along the first line."""
    turned = math.radians(case.towards_deg) - plan.lines[0].heading_rad
    of = {v.name: [o for o in outcomes if o["configuration"] == v.name] for v in variants}
    return {
        "current": case.name,
        "across_mps": case.current_mps * math.sin(turned),
        "along_mps": case.current_mps * math.cos(turned),
        "look_ahead_m": {name: rows[-1]["look_ahead_m"] for name, rows in of.items()},
        "variants": {
            name: {figure: _spread([row[figure] for row in rows]) for figure in _FIGURES}
            for name, rows in of.items()
        },
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    """The mean over flights, and the standard deviation of two or more; None is not known."""
    found = {"mean": np.mean(values)}
    if len(values) > 1:
        found["sd"] = np.std(values, ddof=1)
    spread: dict[str, float | None] = json_values(found)
    return spread


def _table(cases: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for case in cases:
        across, along, variants = case["across_mps"], case["along_mps"], case["variants"]
        title = f"{case['current']} ({across:+.2f} across, {along:+.2f} along)"
        rows += [
            (title, f"paper, {name}", *(_paper_cell(name, column) for column in _COLUMNS))
            for name in PAPER
            if name in variants
        ]
        rows += [
            (title, name, *(_cell(summary[key], digits) for key, digits in _COLUMNS.values()))
            for name, summary in variants.items()
        ]
    return text_table(("sea", "vehicle", *_COLUMNS), rows)


def _paper_cell(name: str, column: str) -> str:
    limits = PAPER[name].get(_PAPER_COLUMNS.get(column, ""))
    return "" if limits is None else "-".join(f"{limit:g}" for limit in sorted(set(limits)))


def _cell(values: Mapping[str, float | None], digits: int) -> str:
    mean, sd = values["mean"], values.get("sd")
    shown = "nan" if mean is None else f"{mean:.{digits}f}"
    return shown if sd is None else f"{shown} ±{sd:.{digits}f}"


def _case(text: str) -> Case:
    speed, towards = parse_current(text)
    if speed is None or towards is None or speed < 0.0 or not math.isfinite(speed + towards):
        raise ConfigError(f"current {text!r}: give SPEED@DIRECTION with a speed of 0 or more")
    return Case(current_mps=speed, towards_deg=towards)
