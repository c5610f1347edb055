"""How coverage varies from sea to sea: a plan flown again and again in simulation.

Each flight draws again the noise of the instruments and their biases, gusts, the slow change of the
current, and where the mean current flows: all directions are alike, since the tide turns and a plan
is made days before. Its speed and the swell stay as in the survey; so does a measured series.
"""

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.floor import FloorGrid
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.stations import plan_pattern, stations_of_flight, stations_of_plan
from missions.fly.simulation import FlightSettings, simulate_plan, with_values
from missions.values.plan_file import Plan

_STREAM = 50
"""Random stream of a survey's seed; `fly` and `compare` have others."""
_PERCENTILES = (5.0, 50.0, 95.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class MonteCarlo:
    """What flights of one plan saw of its area."""

    planned: Certificate
    """Certificate of the plan flown exactly, on the same grid."""
    covered_share: Array
    """(N,) share of the area in at least one picture, for each flight."""
    stereo_share: Array
    """(N,) share of the area seen in stereo."""
    share_at_overlap: Array
    """(N,) share of the area covered at the requested overlap."""
    fewest_pictures: NDArray[np.intp]
    """(N,) fewest pictures of any camera that see any place."""
    hole_probability: Array
    """(rows, columns) share of flights that do not cover the place at the requested overlap; NaN
    outside of the area."""
    endings: dict[str, int]
    """How the flights ended, with counts."""

    @property
    def flights(self) -> int:
        """Number of flights."""
        return len(self.covered_share)

    def to_json(self) -> dict[str, Any]:
        """The figures, without the map."""
        return {
            "flights": self.flights,
            "endings": self.endings,
            "covered_share": _spread(self.covered_share),
            "stereo_share": _spread(self.stereo_share),
            "share_at_overlap": _spread(self.share_at_overlap),
            "fewest_pictures_of_a_camera": _spread(self.fewest_pictures),
            "greatest_hole_probability": float(np.nanmax(self.hole_probability)),
            "ever_a_hole_share": float(
                np.mean(self.hole_probability[self.planned.inside] > 0)
            ),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightCoverage:
    """What one flight saw."""

    covered_share: float
    stereo_share: float
    share_at_overlap: float
    fewest_pictures: int
    short: NDArray[np.uint8]
    """Where the area is not covered at the requested overlap, one bit a cell, row by row."""
    ending: str


def monte_carlo(
    plan: Plan,
    settings: FlightSettings,
    rig: Rig,
    floor: FloorGrid,
    *,
    seed: int,
    flights: int,
    executor: Executor,
) -> MonteCarlo:
    """Fly a plan in many seas.

    Args:
        plan: what to fly, all its dives.
        settings: vehicle, sea and instruments.
        rig: the cameras, in water.
        floor: the true sea floor.
        seed: of the survey.
        flights: how many.
        executor: where tasks run.

    Raises:
        PlanError: no flight is requested.
        VehicleError: the vehicle cannot fly the plan.
    """
    if flights < 1:
        raise PlanError(f"{flights} flights: choose 1 or more")
    planned = certificate(plan.area, rig, stations_of_plan(plan), plan_pattern(plan, rig))
    fly = partial(fly_and_certify, plan, settings, rig, floor, seed, planned.grid.cell_m)
    short = np.zeros(planned.grid.shape)
    results: list[FlightCoverage] = []
    for flown in executor.map(fly, range(flights), label="flights"):
        short += np.unpackbits(flown.short, count=short.size).reshape(short.shape)
        results.append(flown)
    return MonteCarlo(
        planned=planned,
        covered_share=np.array([flown.covered_share for flown in results]),
        stereo_share=np.array([flown.stereo_share for flown in results]),
        share_at_overlap=np.array([flown.share_at_overlap for flown in results]),
        fewest_pictures=np.array([flown.fewest_pictures for flown in results]),
        hole_probability=np.where(planned.inside, short / flights, np.nan),
        endings=dict(sorted(Counter(flown.ending for flown in results).items())),
    )


def fly_and_certify(
    plan: Plan,
    settings: FlightSettings,
    rig: Rig,
    floor: FloorGrid,
    seed: int,
    cell_m: float,
    number: int,
) -> FlightCoverage:
    """Make one flight and certify it on cells of a size; other arguments are of `monte_carlo`."""
    rng = np.random.default_rng([seed, _STREAM, number])
    towards_deg = float(rng.uniform(0.0, 360.0)) % 360.0
    if settings.sea.current_file is None:
        sea = with_values(settings.sea, current_towards_deg=towards_deg)
        settings = replace(settings, sea=sea)
    flight = simulate_plan(plan, settings, floor, rng, label="")
    stations, pattern = stations_of_flight(flight), plan_pattern(plan, rig)
    seen = certificate(plan.area, rig, stations, pattern, cell_m=cell_m)
    return FlightCoverage(
        covered_share=seen.covered_share,
        stereo_share=seen.stereo_share,
        share_at_overlap=seen.share_at_overlap,
        fewest_pictures=seen.fewest_pictures,
        short=np.packbits(seen.inside & ~seen.at_overlap),
        ending=flight.ending,
    )


def _spread(values: Array | NDArray[np.intp]) -> dict[str, float]:
    """Least, mean and percentiles."""
    at = np.percentile(values, _PERCENTILES)
    named = {f"p{p:02.0f}": float(v) for p, v in zip(_PERCENTILES, at, strict=True)}
    return {"least": float(values.min()), **named, "mean": float(values.mean())}
