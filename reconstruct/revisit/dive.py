"""The dive that cures weak places: its lines, and what it is predicted to leave."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import shapely
from scipy.spatial.transform import RigidTransform

from alice_survey.core.block_solver import Flags
from alice_survey.core.config import PlanConfig
from alice_survey.core.frames import Array
from missions.coverage.certificate import certificate
from missions.coverage.stations import Stations, join, stations_of_lines, stations_of_plan
from missions.fly.refly import refly_plan
from missions.plan.strength import survey_costs
from missions.values.area import multipolygon
from missions.values.costs import Costs
from missions.values.line import Line
from missions.values.plan_file import Plan
from reconstruct.precision.candidates import (
    BETWEEN_DIVES_S,
    Candidate,
    ned_from_stations,
    stations_and_times,
)
from reconstruct.precision.instruments import NavigationErrors
from reconstruct.precision.predict import Precision
from reconstruct.precision.predict import predict as predicted
from reconstruct.revisit.links import cut_around, footprints, links, pieces, views_of_floor
from reconstruct.revisit.weak import LOOSE_SHARE, Found, WeakPlace, cells_in

_ENDS = 8
"""Stations of a loose part, and of those near each, between which a tie is tried."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What a dive is predicted to leave of a weak place."""

    left: float
    """Share of the place that stays weak."""
    text: str
    """The same in words."""


def plan_revisit(found: Found, *, costs: Costs, settings: PlanConfig, usable_wh: float) -> Plan:
    """Plan the dive over all weak places of a survey.

    Lines over what pictures or the surface lack are one picture longer at both ends, so that the
    new pictures overlap good ones; each loose part gets a line from it into what it is loose from.

    Args:
        found: the survey.
        costs: what flying takes.
        settings: how the vehicle turns and how long a dive may be.
        usable_wh: what a dive may take of a battery.

    Raises:
        PlanError: there is no weak place, or lines over them leave the allowed area.
    """
    plan = found.plan
    grown_m = found.seen.grid.cell_m / math.sqrt(2.0)
    outlines = [place.outline for place in found.places if not place.stations]
    lacking = shapely.union_all(outlines).buffer(grown_m, join_style="mitre")
    ties = (tie_line(found, place) for place in found.places if place.stations)
    return refly_plan(
        plan, found.rig, multipolygon(lacking.intersection(plan.area.survey)), found.pattern,
        name=f"{plan.name} revisit", costs=costs, settings=settings, usable_wh=usable_wh,
        ties=[tie for tie in ties if tie is not None], overrun_m=plan.station_spacing_m,
    )  # fmt: skip


def tie_line(found: Found, place: WeakPlace) -> Line | None:
    """The shortest line that ties a loose part as firmly as the plan ties its weakest picture.

    Of the lines between a station of the part and one it is loose from, a picture longer at both
    ends; where none is as firm, the firmest; None where all leave the allowed area.

    Args:
        found: the survey.
        place: with its loose stations.
    """
    stations, plan = found.pictured.good, found.plan
    loose = np.zeros(len(stations), bool)
    loose[list(place.stations)] = True
    core = ~loose & (found.piece == 0)
    shapes = footprints(found.rig, stations)
    both = [shapely.union_all(shapes[part]) for part in (loose, core)]
    min_m2 = found.least_tracks / LOOSE_SHARE / found.tracks_per_point * found.step_m**2
    best: tuple[tuple[bool, float], Line] | None = None
    spread = np.linspace(0, loose.sum() - 1, min(_ENDS, int(loose.sum()))).round().astype(int)
    for start in stations.glass_ne[loose][spread]:
        away_m = np.linalg.norm(stations.glass_ne[core] - start, axis=1)
        for end in stations.glass_ne[core][np.argsort(away_m, kind="stable")[:_ENDS]]:
            line = _line(start, end, plan)
            if line is None:
                continue
            shown = shapely.union_all(
                footprints(found.rig, stations_of_lines([line], plan.altitude_m))
            )
            tied_m2 = min(float(shown.intersection(one).area) for one in both)
            firm = tied_m2 >= min_m2
            rank = (firm, -line.length_m if firm else tied_m2)
            if best is None or rank > best[0]:
                best = rank, line
    return None if best is None else best[1]


def _line(start: Array, end: Array, plan: Plan) -> Line | None:
    """A line from a place to another, with a step more at both ends, in the allowed area."""
    length_m = math.dist(start, end)
    if length_m == 0.0:
        return None
    ahead = (end - start) / length_m
    steps = math.ceil(length_m / plan.station_spacing_m) + 2
    over = (steps * plan.station_spacing_m - length_m) / 2 * ahead
    begin, finish = (tuple(float(x) for x in end_ne) for end_ne in (start - over, end + over))
    if not plan.area.allowed.covers(shapely.LineString([begin, finish])):
        return None
    return Line(
        kind="fill", start_ne_m=begin, end_ne_m=finish, stations=steps + 1  # type: ignore[arg-type]  # two each
    )  # fmt: skip


def predict(found: Found, again: Plan) -> tuple[tuple[Prediction, ...], Flags]:
    """What a dive, flown exactly, leaves of each weak place, and which stations are in one model.

    Pictures that see each place, and tracks by the overlap of footprints with the tracks that this
    survey's overlaps had.

    Args:
        found: the survey and its weak places.
        again: the dive.

    Returns:
        By weak place; (S + D,) of the survey's good stations and the dive's.
    """
    new = stations_of_plan(again)
    old = found.pictured.good
    both = join(old, new)
    grid = found.seen.grid
    after = certificate(found.plan.area, found.rig, both, found.pattern, cell_m=grid.cell_m)
    alone = certificate(found.plan.area, found.rig, new, found.pattern, cell_m=grid.cell_m)
    linked = _links_after(found, both)
    piece = pieces(linked, found.least_tracks)
    core = np.bincount(piece[: len(old)][found.piece == 0]).argmax()
    found_left = []
    for place in found.places:
        if place.stations:
            group = np.isin(np.arange(len(both)), place.stations)
            held = cut_around(linked, group)
            loose = found.piece[list(place.stations)].any()
            before = cut_around(found.linked, group[: len(old)])
            left = float(np.mean(piece[group] != core)) if loose else before / max(held, 1e-9)
            words = f"held by {held:.0f} tracks instead of {before:.0f}"
        else:
            inside = cells_in(found.seen, place.outline)
            cured = after if place.cause == "overlap" else alone
            left = float(np.mean(~cured.at_overlap[inside])) if inside.any() else 0.0
            words = f"{1 - left:.0%} at the overlap asked for"
        found_left.append(Prediction(left=left, text=words))
    return tuple(found_left), piece == core


def predict_precision(
    found: Found, dive: Candidate, in_model: Flags
) -> tuple[Precision, Precision | None]:
    """Expected sigmas of the stations that now hang together, and of those that will.

    Args:
        found: the survey.
        dive: the dive over it, as its plan.
        in_model: (S + D,) as of `predict`.

    Returns:
        Before and after; None after a dive that does not join.
    """
    good, plan, rig = found.pictured.good, found.plan, dive.rig
    poses = ned_from_stations(good, plan, rig)
    time_s = found.pictured.numbers * (plan.station_spacing_m / plan.speed_mps)
    new, new_s = stations_and_times(
        dive.plan, rig, survey_costs(dive.config), float(time_s.max()) + BETWEEN_DIVES_S
    )
    errors = NavigationErrors.of(dive.config.navigation, dive.config.reconstruct)

    def sigmas(stations: Flags) -> Precision:
        chosen = RigidTransform.concatenate([poses, new])[stations]
        at = np.concatenate([time_s, new_s])[stations]
        order = np.argsort(at, kind="stable")
        return predicted(dive.block_at(chosen[order], at[order]), errors)

    now = np.concatenate([found.piece == 0, np.zeros(len(new), bool)])
    return sigmas(now), sigmas(in_model) if in_model[len(good) :].any() else None


def _links_after(found: Found, both: Stations) -> Any:
    """Tracks between the stations of a survey, as found, and those of a dive, as expected."""
    expected = found.tracks_per_point * links(
        views_of_floor(footprints(found.rig, both), found.step_m)
    )
    old = len(found.pictured.good)
    return sp.csr_array(
        sp.block_array(
            [[found.linked, expected[:old, old:]], [expected[old:, :old], expected[old:, old:]]]
        )
    )
