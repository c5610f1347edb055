"""`alice-survey plan revisit`: the weak places of a reconstructed survey, and a dive over them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import shapely

from alice_survey.core.artefacts import refuse_links, write_json
from alice_survey.core.block_solver import Flags
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError, offer, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.kit.figure import figure_style, save_figure
from alice_survey.kit.words import count, share, text_table
from missions.coverage.certificate import certificate
from missions.coverage.drawing import (
    draw_counts,
    draw_polygons,
    finish_map,
    map_sheet,
    number_place,
    write_outlines,
)
from missions.coverage.stations import Stations, join, stations_of_lines, stations_of_plan
from missions.fly.check import rig_of
from missions.fly.refly import DiveMeans, dive_means, refly_plan, write_refly
from missions.plan.strength import survey_costs
from missions.values.line import Line
from missions.values.plan_file import Plan
from reconstruct.revisit.links import cut_around, footprints, links, pieces, views_of_floor
from reconstruct.revisit.weak import LOOSE_SHARE, Found, WeakPlace, cells_in, find_weak

_ENDS = 8
"""Stations of a loose part, and of those near each, between which a tie is tried."""
_COLOURS = {"overlap": "#c0392b", "surface": "#d68910", "loose": "#7d3c98"}
_LISTED = 20


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What a dive is predicted to leave of a weak place."""

    left: float
    """Share of the place that stays weak."""
    text: str
    """The same in words."""


def plan_revisit(found: Found, means: DiveMeans) -> Plan:
    """Plan the dive over all weak places of a survey.

    Lines over what pictures or the surface lack are one picture longer at both ends, so that the
    new pictures overlap good ones; each loose part gets a line from it into what it is loose from.

    Args:
        found: the survey.
        means: of the dives.

    Raises:
        PlanError: there is no weak place, or lines over them leave the allowed area.
    """
    plan = found.plan
    outlines = [place.outline for place in found.places if not place.stations]
    ties = (tie_line(found, place) for place in found.places if place.stations)
    return refly_plan(
        plan, found.rig, outlines, found.seen.grid.cell_m, found.pattern, means, "revisit",
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


def revisit_report(
    workspace: Path,
    config: SurveyConfig,
    executor: Executor,
    *,
    sigma_mm: float | None = None,
    out: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """Find what a reconstructed survey lacks, and plan the dive that cures it.

    Writes `weak.geojson`, `weak.png`, `revisit.json`; where places are weak `dive/`, a workspace
    with its own plan.

    Args:
        workspace: reconstructed.
        config: the survey.
        executor: where pictures are measured.
        sigma_mm: largest sigma of heights that is good enough, as of `find_weak`.
        out: folder to write; left out, `revisit` in the workspace.

    Returns:
        A report as text, and as JSON values.

    Raises:
        AliceError: a stage is missing, or the model has no place in the world.
    """
    rig = rig_of(workspace, config.camera, config.water)
    goal_m = None if sigma_mm is None else 1e-3 * sigma_mm
    found = find_weak(workspace, rig, sigma_goal_m=goal_m, executor=executor)
    folder = workspace / "revisit" if out is None else out
    refuse_links(workspace, folder)
    again, dive, words = None, None, ""
    cures: tuple[Prediction, ...] = ()
    if found.places:
        try:
            means = dive_means(config.plan, config.vehicle, survey_costs(config))
            again = plan_revisit(found, means)
        except PlanError as error:
            warn(f"the weak places cannot be planned again: {error}")
        else:
            cures, in_model = predict(found, again)
            words, dive = write_refly(
                folder / "dive", again, rig, config.camera, config.water, config.plan
            )
            dive["joining_stations"] = int(in_model[len(found.pictured.good) :].sum())
            words = _dive_text(workspace, found, dive, words, cures)
    elif (folder / "dive").exists():
        warn(f"{folder / 'dive'} is of an earlier revisit: nothing is weak now")
    data = {**_json(found, cures), "dive": dive}
    folder.mkdir(parents=True, exist_ok=True)
    outlines = [(place.outline, place.to_json()) for place in found.places]
    write_outlines(folder / "weak.geojson", found.plan.datum, outlines)
    write_json(folder / "revisit.json", data)
    _draw(folder / "weak.png", found, again)
    text = f"{_text(found, cures)}{words}\n{folder}: weak.geojson, weak.png, revisit.json"
    return text, {**data, "folder": str(folder)}


def _json(found: Found, cures: Sequence[Prediction]) -> dict[str, Any]:
    places = [place.to_json() for place in found.places]
    for place, cure in zip(places, cures, strict=False):
        place |= {"predicted": cure.text}
    return {
        "plan": found.plan.name,
        "registered": found.record.registered,
        "pictures": found.record.total,
        "models": list(found.record.models),
        "stations": len(found.pictured.good),
        "share_at_overlap": found.seen.share_at_overlap,
        "covered_share": found.seen.covered_share,
        "weak_m2": round(sum(place.area_m2 for place in found.places), 6),
        "places": places,
    }


def _text(found: Found, cures: Sequence[Prediction]) -> str:
    good, spoilt = len(found.pictured.good), len(found.pictured.spoilt)
    lines = [
        f"{found.plan.name}: {found.record.registered} of {found.record.total} pictures in the "
        f"model; {good} of {count(good + spoilt, 'station')} of use, they see "
        f"{share(found.seen.covered_share, 2)} and {share(found.seen.share_at_overlap, 2)} at the "
        "overlap asked for"
    ]
    if len(found.record.models) > 1:
        sizes = " and ".join(map(str, found.record.models))
        lines.append(f"no picture links models of {sizes} pictures to each other")
    if not found.places:
        return "\n".join([*lines, "nothing is weak"])
    rows = []
    for number, place in enumerate(found.places[:_LISTED], 1):
        reason = place.reason + (f" -> {cures[number - 1].text}" if cures else "")
        figures = (f"{value:.2f}" for value in (place.area_m2, *place.place_ne))
        rows.append([str(number), place.cause, *figures, reason])
    lines.append(f"{count(len(found.places), 'weak place')}, worst first:")
    lines.append(text_table(("", "cause", "area m2", "north m", "east m", "reason"), rows))
    if len(found.places) > _LISTED:
        lines.append(f"  and {len(found.places) - _LISTED} more (revisit.json)")
    return "\n".join(lines)


def _dive_text(
    workspace: Path, found: Found, dive: dict[str, Any], words: str, cures: Sequence[Prediction]
) -> str:
    severity = np.array([place.severity_m2 for place in found.places])
    cured, whole = severity @ [1 - cure.left for cure in cures], severity.sum()
    return (
        f"\nthe dive over them: {words}; {dive['joining_stations']} of its stations are predicted "
        f"to join the model, {cured / whole:.0%} of the weakness to be cured: {dive['folder']}\n"
        f"with its pictures: {offer('join', workspace, dive['folder'], '-w', 'BOTH')}"
    )


@figure_style()
def _draw(path: Path, found: Found, again: Plan | None) -> None:
    """Draw the pictures that see each place, the weak places by cause, and the lines over them."""
    area = found.plan.area
    south, west, north, east = area.survey.bounds
    margin = 0.1 * max(north - south, east - west)
    bounds = (south - margin, west - margin, north + margin, east + margin)
    figure, axes = map_sheet(bounds)
    draw_counts(axes, found.seen)
    draw_polygons(axes, area.survey, "survey area", edgecolor="#17202a", lw=1.4)
    known: set[str] = set()
    for number, place in reversed(list(enumerate(found.places, 1))):
        colour = _COLOURS[place.cause]
        label = "" if place.cause in known else f"weak: {place.cause}"
        known.add(place.cause)
        draw_polygons(axes, place.outline, label, edgecolor=colour, lw=1.8)
        number_place(axes, place.place_ne, number, colour)
    for index, line in enumerate(() if again is None else again.lines):
        places = line.stations_ne
        label = "_nolegend_" if index else "dive over them"
        axes.plot(places[:, 1], places[:, 0], "-o", ms=3, lw=1.2, color="#117864", label=label)
    text = f"{count(len(found.places), 'weak place')} of {found.plan.name}"
    finish_map(figure, axes, area.datum, "Weak places", text)
    save_figure(figure, path)
