"""The paper's mission in currents, swell and with failures: how well lines are held, and the end.

Each case is flown over a level floor with several seeds. Where a mission can be flown it must come
to its end, with lines held so closely that neighbours leave no gap; elsewhere the vehicle says why
it gave up.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import VehicleError, collected_by
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.sea import level_floor
from benchmarks.figures import Figure, Goal
from camera_calib.rig import design_rig
from missions.fly.simulation import flight_settings, simulate_plan
from missions.plan.planner import plan_survey
from missions.values.flight import Flight, rms
from missions.values.plan_file import Plan


@dataclass(frozen=True, kw_only=True)
class Sea:
    """A case: what differs from the settings of a new survey."""

    name: str
    along_mps: float = 0.0
    """Current along the first line."""
    across_mps: float = 0.0
    swell: tuple[float, float] | None = None
    """Height in metres and period in seconds, across the lines."""
    vehicle: Mapping[str, Any] = field(default_factory=dict)
    navigation: Mapping[str, Any] = field(default_factory=dict)
    must_fly: bool = True
    """Whether it must be flown to its end; else the flight may be broken off in words."""


def _dropouts(every_s: float, for_s: float) -> tuple[tuple[float, float], ...]:
    return tuple((at, at + for_s) for at in np.arange(600.0, 2400.0, every_s).tolist())


SEAS = (
    Sea(name="still"),
    *(Sea(name=f"{v:g} m/s across", across_mps=v) for v in (0.1, 0.2, 0.3, 0.4)),
    *(Sea(name=f"{v:g} m/s along", along_mps=v) for v in (0.1, 0.2, 0.3, 0.4)),
    Sea(name="0.5 m/s across", across_mps=0.5, must_fly=False),
    *(
        Sea(name=f"swell {height:g} m, {period:g} s", swell=(height, period))
        for height, period in ((0.5, 6.0), (1.0, 6.0), (0.85, 8.0), (0.7, 10.0), (1.0, 8.0),
                               (1.2, 8.0))
    ),
    Sea(name="swell 0.5 m, 6 s, 0.3 m/s across", swell=(0.5, 6.0), across_mps=0.3),
    *(
        Sea(
            name=f"{thruster} {'known to have' if known else 'has'} failed, 0.1 m/s across",
            across_mps=0.1,
            vehicle={"failures": [thruster if known else f"{thruster}@0"]},
            must_fly=thruster in ("starboard", "port"),
        )
        for thruster in ("starboard", "port", "bow", "stern", "vertical")
        for known in (True, False)
    ),
    *(
        Sea(
            name=f"{thruster} fails after 600 s, 0.1 m/s across",
            across_mps=0.1,
            vehicle={"failures": [f"{thruster}@600"]},
            must_fly=thruster in ("starboard", "port"),
        )
        for thruster in ("starboard", "bow", "stern", "vertical")
    ),
    Sea(name="DVL gone for 10 s", navigation={"dvl_dropouts_s": _dropouts(5000.0, 10.0)}),
    Sea(name="DVL gone for 5 s each minute", navigation={"dvl_dropouts_s": _dropouts(60.0, 5.0)}),
    Sea(
        name="DVL gone for 60 s",
        navigation={"dvl_dropouts_s": _dropouts(5000.0, 60.0)},
        must_fly=False,
    ),
    Sea(name="RPI allocation, 0.1 m/s across", across_mps=0.1, vehicle={"allocation": "rpi"}),
    *(
        Sea(name=f"{kind} coefficients, 0.2 m/s across", across_mps=0.2,
            vehicle={"coefficients": kind})
        for kind in ("estimated", "cfd", "computed")
    ),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SeaResult:
    """What flights of a case came to; root mean squares and worst over all seeds."""

    sea: str
    flights: int
    complete: int
    true_m: float
    """Cross-track error of the left port on lines; NaN where no line was reached."""
    worst_m: float
    believed_m: float
    heading_deg: float
    energy_wh: float
    endings: tuple[str, ...]
    allowed_m: float
    """Cross-track error at which pictures of neighbouring lines just meet."""

    def figures(self, must_fly: bool) -> list[Figure]:
        """Cross-track error, and the share that was complete."""
        share = self.complete / self.flights
        goal = Goal(minimum=1.0) if must_fly else None
        return [
            Figure(
                name=f"{self.sea}: cross-track error", value=self.true_m, unit="m",
                goal=Goal(maximum=self.allowed_m) if must_fly else None,
            ),
            Figure(name=f"{self.sea}: complete", value=share, unit="", goal=goal),
        ]  # fmt: skip


def measure(seeds: int) -> list[SeaResult]:
    """Fly all cases."""
    calm = change_section(SurveyConfig(), "sea", current_mps=0.0)
    plan = plan_survey(calm, design_rig(calm.camera, calm.water)).plan
    return [_measured(sea, calm, plan, seeds) for sea in SEAS]


def settings_of(sea: Sea, calm: SurveyConfig, heading_deg: float) -> SurveyConfig:
    """A survey whose lines lie along a heading, in a sea."""
    flow = np.hypot(sea.along_mps, sea.across_mps)
    towards = heading_deg + np.rad2deg(np.arctan2(sea.across_mps, sea.along_mps))
    water: dict[str, Any] = {"current_mps": flow, "current_towards_deg": towards % 360.0}
    if sea.swell is not None:
        height, period = sea.swell
        water |= {"swell_m": height, "swell_period_s": period,
                  "swell_towards_deg": (heading_deg + 90.0) % 360.0}  # fmt: skip
    found = change_section(calm, "sea", **water)
    found = change_section(found, "vehicle", **sea.vehicle)
    return change_section(found, "navigation", **sea.navigation)


def _measured(sea: Sea, calm: SurveyConfig, plan: Plan, seeds: int) -> SeaResult:
    heading_deg = float(np.rad2deg(plan.lines[0].heading_rad))
    settings = flight_settings(settings_of(sea, calm, heading_deg))
    floor = level_floor(plan.seafloor_depth_m)
    flights, endings = list[Flight](), list[str]()
    for seed in range(1, seeds + 1):
        try:
            with collected_by(lambda level, text: None):  # what is warned of, case after case
                flight = simulate_plan(plan, settings, floor, np.random.default_rng(seed), label="")
        except VehicleError as error:
            endings.append(f"refused: {error}")
            continue
        endings.append(flight.ending)
        flights.append(flight)
    errors = [_finite(flight.line_errors[0]) for flight in flights]
    cross = np.concatenate([*errors, np.empty(0)])
    believed = np.concatenate([*(_finite(f.believed_cross_track) for f in flights), np.empty(0)])
    heading = np.concatenate([*(_finite(f.line_errors[1]) for f in flights), np.empty(0)])
    energy = [float(flight.flown.energy_j.sum()) / 3600.0 for flight in flights]
    return SeaResult(
        sea=sea.name,
        flights=seeds,
        complete=endings.count("complete"),
        true_m=rms(cross),
        worst_m=float(np.abs(cross).max()) if len(cross) else np.nan,
        believed_m=rms(believed),
        heading_deg=float(np.rad2deg(rms(heading))),
        energy_wh=float(np.mean(energy)) if energy else np.nan,
        endings=tuple(sorted(set(endings))),
        allowed_m=0.5 * (plan.footprint_m[0] - plan.line_spacing_m),
    )


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]


def figures(rows: list[SeaResult]) -> list[Figure]:
    """The figures of all cases."""
    return [
        figure for sea, row in zip(SEAS, rows, strict=True) for figure in row.figures(sea.must_fly)
    ]
