"""Where a vehicle is on its route, and how well what is left is foreseen."""

import math
from dataclasses import replace

import numpy as np
import pytest

from alice_survey.core.frames import Array
from missions.follow.progress import PRIOR_SIGMA, FlightPace, Progress
from missions.values.costs import leg_costs, time_costs
from missions.values.legs import Route
from missions.values.plan_file import Dive, Plan
from tests.missions.follow.dives import PLAN

COSTS = time_costs(PLAN.speed_mps)


def in_two_dives() -> Plan:
    """The plan with its lines in two dives."""
    legs = PLAN.dives[0].route.legs
    cut = next(i for i, leg in enumerate(legs) if leg.line == 2)
    dives = tuple(
        Dive(first_line=first, last_line=last, route=Route(legs=part), duration_s=1.0,
             energy_wh=1.0)
        for first, last, part in (
            (0, 1, legs[: cut - 1]), (2, len(PLAN.lines) - 1, legs[cut:])
        )
    )  # fmt: skip
    return replace(PLAN, dives=dives)


def fly(progress: Progress, route: Route, *, until_m: float = math.inf, speed: float = 1.0,
        off_m: float = 0.0, start_s: float = 0.0) -> float:  # fmt: skip
    """Fixes along a route twice a second; the time of the last."""
    along = np.arange(0.0, min(route.length_m, until_m), 0.5 * PLAN.speed_mps * speed)
    places = route.places(along)
    ahead = route.places(along + 0.01) - places
    for i, (place, way) in enumerate(zip(places, ahead, strict=True)):
        heading = math.atan2(way[1], way[0])
        side = np.array([-math.sin(heading), math.cos(heading)])
        progress.add(start_s + 0.5 * i, place + off_m * side, heading)
    return start_s + 0.5 * len(along)


def planned_s(plan: Plan, dive: int) -> Array:
    seconds: Array = leg_costs(plan.dives[dive].route, COSTS)[1]
    return seconds


def test_the_place_on_the_route_is_that_of_the_time_flown() -> None:
    progress = Progress(PLAN, COSTS)
    route = PLAN.dives[0].route
    fly(progress, route, until_m=9.0, off_m=0.1)
    assert progress.is_on_route
    assert progress.at_s == pytest.approx(9.0 / PLAN.speed_mps, abs=1.5)
    flown = progress.to_finish(0.0).time_s + progress.at_s * progress.pace.fitted()[0]
    assert flown == pytest.approx(planned_s(PLAN, 0).sum() * progress.pace.fitted()[0], rel=1e-9)
    # Pictures to come: none that is behind, all that are ahead.
    to_come = progress.to_come()
    behind = [route.places(np.array([8.0])), route.places(np.array([1.0]))]
    for place in behind:
        assert np.hypot(*(to_come.glass_ne - place).T).min() > 0.3
    assert len(to_come) == pytest.approx(PLAN.stations * (1 - 9.0 / route.length_m), abs=4)


def test_the_dive_is_found_by_its_lines_and_the_others_count_as_flown() -> None:
    plan = in_two_dives()
    progress = Progress(plan, COSTS)
    fly(progress, plan.dives[1].route, until_m=2.0)
    assert progress.dive == 1
    assert progress.line == 2
    assert set(progress.to_come().line.tolist()) == set(range(len(plan.lines)))
    assert progress.left == list(range(2, len(plan.lines)))


def test_turning_over_a_line_on_the_way_down_begins_nothing() -> None:
    progress = Progress(PLAN, COSTS)
    last = PLAN.lines[-1]
    place, way = np.array(last.end_ne_m), np.subtract(last.end_ne_m, last.start_ne_m)
    along = math.atan2(way[1], way[0])
    for i, turned in enumerate(np.linspace(-0.6, 0.6, 40)):
        progress.add(0.5 * i, place + 0.02 * i * way / np.linalg.norm(way) / 40, along + turned)
    assert not progress.has_begun
    assert len(progress.left) == len(PLAN.lines)
    fly(progress, PLAN.dives[0].route, until_m=2.0, start_s=40.0)
    assert progress.line == 0


def test_a_line_that_is_left_out_is_behind_and_one_flown_late_is_found_again() -> None:
    progress = Progress(PLAN, COSTS)
    route = PLAN.dives[0].route
    legs = route.legs
    lines = {leg.line: Route(legs=(leg,)) for leg in legs if leg.line >= 0}
    time_s = fly(progress, lines[0])
    time_s = fly(progress, lines[2], start_s=time_s + 10.0)
    assert progress.left == [2, 3]
    assert not np.any(progress.to_come().line == 1)
    fly(progress, lines[1], start_s=time_s + 60.0)
    assert progress.line in (1, -1)
    assert 2 in progress.left


def test_what_is_left_is_foreseen_as_well_as_its_sigma_says() -> None:
    rng = np.random.default_rng(11)
    scores, relative = [], []
    for _ in range(400):
        pace, spread = rng.normal(1.0, PRIOR_SIGMA), 0.1 * math.sqrt(40.0)
        found = FlightPace()
        lines = int(rng.integers(0, 12))
        for _ in range(lines):
            found.add(40.0, 40.0 * pace + math.sqrt(40.0) * spread * rng.normal())
        left = found.left(800.0, 3600.0)
        true = 800.0 * pace + math.sqrt(800.0) * spread * rng.normal()
        scores.append((true - left.time_s) / left.sigma_s)
        relative.append((lines, left.sigma_s / left.time_s))
    assert 0.8 < float(np.std(scores)) < 1.2
    assert abs(float(np.mean(scores))) < 0.15
    few = np.mean([share for lines, share in relative if lines == 0])
    many = np.mean([share for lines, share in relative if lines > 8])
    assert many < 0.7 * few
    assert found.left(800.0, 3600.0).energy_wh == pytest.approx(found.fitted()[0])
