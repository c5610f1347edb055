"""`alice-survey plan revisit`: the weak places of a reconstructed survey, and a dive over them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import refuse_links, write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.executor import Executor
from alice_survey.kit.figure import figure_style, save_figure
from alice_survey.kit.words import share
from missions.coverage.drawing import (
    draw_counts,
    draw_polygons,
    finish_map,
    map_sheet,
    number_place,
)
from missions.coverage.geofiles import write_outlines
from missions.exports.write import count_text
from missions.fly.check import rig_of
from missions.fly.refly import write_refly
from missions.plan.strength import survey_costs
from missions.route.energy import planned_vehicle, usable_wh
from missions.route.flyable import without_stops
from missions.values.plan_file import Plan
from reconstruct.precision.candidates import Candidate
from reconstruct.precision.instruments import expected_rig
from reconstruct.precision.run import summary, to_json
from reconstruct.revisit.dive import Prediction, plan_revisit, predict, predict_precision
from reconstruct.revisit.weak import Found, find_weak

_COLOURS = {"overlap": "#c0392b", "surface": "#d68910", "loose": "#7d3c98"}
_LISTED = 20


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
            again = plan_revisit(
                found, costs=survey_costs(config),
                settings=without_stops(config.plan, planned_vehicle(config.vehicle)),
                usable_wh=usable_wh(config.vehicle),
            )  # fmt: skip
        except PlanError as error:
            warn(f"the weak places cannot be planned again: {error}")
        else:
            cures, in_model = predict(found, again)
            joining = int(in_model[len(found.pictured.good) :].sum())
            used = expected_rig(workspace, config.camera, config.water, config.imaging)
            before, after = predict_precision(
                found, Candidate(config=config, rig=used, made=again), in_model
            )
            words, dive = write_refly(
                folder / "dive", again, rig, config.camera, config.water, config.plan
            )
            dive |= {
                "joining_stations": joining,
                "expected_before": to_json(before),
                "expected_after": None if after is None else to_json(after),
            }
            words = _dive_text(workspace, found, dive, words, cures)
            if after is not None:
                words += f"\nexpected sigmas, before: {summary(before)}; after: {summary(after)}"
    elif (folder / "dive").exists():
        warn(f"{folder / 'dive'} is of an earlier revisit: nothing is weak now")
    data = {**_json(found, cures), "dive": dive}
    folder.mkdir(parents=True, exist_ok=True)
    write_outlines(folder / "weak.geojson", found.plan.datum, found.places)
    write_json(folder / "revisit.json", data)
    _draw(folder / "weak.png", found, again)
    text = f"{_text(found, cures)}{words}\n{folder}: weak.geojson, weak.png, revisit.json"
    return text, {**data, "folder": str(folder)}


def _json(found: Found, cures: Sequence[Prediction]) -> dict[str, Any]:
    places = [place.to_json() for place in found.places]
    for place, cure in zip(places, cures, strict=False):
        place |= {"predicted_left": round(cure.left, 4), "predicted": cure.text}
    return {
        "plan": found.plan.name,
        "registered": found.record.registered,
        "pictures": found.record.total,
        "models": list(found.record.models),
        "stations": len(found.pictured.good),
        "stations_spoilt": len(found.pictured.spoilt),
        "share_at_overlap": found.seen.share_at_overlap,
        "covered_share": found.seen.covered_share,
        "asked_for": {
            "lines": found.pattern.passes,
            "pictures_of_each_camera": found.pattern.passes * found.pattern.pictures,
            "sigma_mm": round(1e3 * found.sigma_goal_m, 4),
            "tracks_of_a_part": round(found.least_tracks, 2),
        },
        "weak_m2": round(sum(place.area_m2 for place in found.places), 6),
        "places": places,
    }


def _text(found: Found, cures: Sequence[Prediction]) -> str:
    good, spoilt = len(found.pictured.good), len(found.pictured.spoilt)
    lines = [
        f"{found.plan.name}: {found.record.registered} of {found.record.total} pictures in the "
        f"model; {good} of {count_text(good + spoilt, 'station')} of use, they see "
        f"{share(found.seen.covered_share, 2)} and {share(found.seen.share_at_overlap, 2)} at the "
        "overlap asked for"
    ]
    if len(found.record.models) > 1:
        sizes = " and ".join(map(str, found.record.models))
        lines.append(f"no picture links models of {sizes} pictures to each other")
    if not found.places:
        return "\n".join([*lines, "nothing is weak"])
    lines += [
        f"{count_text(len(found.places), 'weak place')}, worst first:",
        f"  {'':>3}  {'cause':<8} {'area m2':>8}  {'north m':>8}  {'east m':>8}  reason",
    ]
    for number, place in enumerate(found.places[:_LISTED], 1):
        north, east = place.place_ne
        lines.append(
            f"  {number:>3}  {place.cause:<8} {place.area_m2:>8.2f}  {north:>8.2f}  {east:>8.2f}  "
            f"{place.reason}" + (f" -> {cures[number - 1].text}" if cures else "")
        )
    if len(found.places) > _LISTED:
        lines.append(f"  and {len(found.places) - _LISTED} more (revisit.json)")
    return "\n".join(lines)


def _dive_text(
    workspace: Path,
    found: Found,
    dive: dict[str, Any],
    words: str,
    cures: Sequence[Prediction],
) -> str:
    cured = sum(
        place.severity_m2 * (1 - cure.left) for place, cure in zip(found.places, cures, strict=True)
    )
    whole = sum(place.severity_m2 for place in found.places)
    return (
        f"\nthe dive over them: {words}; {dive['joining_stations']} of its stations are predicted "
        f"to join the model, {cured / whole:.0%} of the weakness to be cured: {dive['folder']}\n"
        f"with its pictures: alice-survey join {workspace} {dive['folder']} -w BOTH"
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
    text = f"{count_text(len(found.places), 'weak place')} of {found.plan.name}"
    finish_map(figure, axes, area.datum, "Weak places", text)
    save_figure(figure, path)
