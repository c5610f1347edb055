"""The three summary sentences of a report, and the first row of facts."""

import math
from collections.abc import Mapping, Sequence

from alice_survey.kit.document import Verdict
from alice_survey.kit.words import count, digits, duration, length, millimetres, parts, share
from alice_survey.report.figures import Figures

_MOST_ACTIONS = 2


def summary(figures: Figures, found: Sequence[Verdict]) -> Mapping[str, str]:
    """What was mapped, how well, what to do next."""
    return {
        "What was mapped": _mapped(figures),
        "How well": _how_well(figures),
        "What to do next": _next(figures, found),
    }


def facts(figures: Figures) -> list[tuple[str, str]]:
    """Labels and values."""
    unit, surface = figures.held.unit, figures.surface
    rows: list[tuple[str, str]] = []
    if figures.registration is not None:
        rows.append(("pictures in the model", f"{figures.registered} of {figures.total}"))
        error = figures.registration.mean_reprojection_px
        rows.append(("reprojection error", f"{digits(error, 2)} px"))
    if surface is not None:
        rows.append(("area with a height", f"{digits(surface.area)} {unit}²"))
        rows.append(("DEM cell", length(surface.cell, unit)))
        rows.append(("sigma of heights", length(surface.sigma_median, unit)))
    if math.isfinite(figures.pixel_m):
        rows.append(("mosaic pixel", length(figures.pixel_m, unit)))
    score = figures.truth
    if score is not None:
        rows.append(("surface error (truth)", f"{millimetres(score.surface.distance_rms_mm)} rms"))
        rows.append(("camera error (truth)", f"{millimetres(score.cameras.rms_mm)} rms"))
    took = sum(stage.took_s for stage in figures.held.stages.values())
    rows.append(("computing", duration(took)))
    return rows


def _mapped(figures: Figures) -> str:
    held, surface = figures.held, figures.surface
    kind = "a simulated sea floor" if held.simulated else "sea floor"
    if surface is not None:
        mosaic = (
            f", painted at {length(figures.pixel_m, held.unit)} a pixel"
            if math.isfinite(figures.pixel_m)
            else ""
        )
        return (
            f"{digits(surface.area)} {held.unit}² of {kind} with "
            f"{length(surface.high - surface.low, held.unit)} of relief{mosaic}, from "
            f"{count(figures.registered, 'picture')} taken at {count(figures.stations, 'station')}."
        )
    plan = held.plan
    if held.has("sparse"):
        return (
            f"Nothing yet: {count(figures.registered, 'picture')} are placed, no surface is made."
        )
    if plan is not None:
        return (
            f"Nothing yet: a plan of {count(len(plan.lines), 'line')}, "
            f"{count(plan.stations, 'station')} and {duration(plan.duration_s)} is ready."
        )
    return "Nothing yet."


def _how_well(figures: Figures) -> str:
    surface, unit = figures.surface, figures.held.unit
    if surface is None:
        return "No surface to judge yet."
    sentences = []
    if math.isfinite(surface.sigma_median):
        sentences.append(
            f"Heights within the survey are good to {length(surface.sigma_median, unit)} (1 sigma; "
            f"95 % of the cells to {length(surface.sigma_95, unit)})"
        )
    if math.isfinite(figures.place_sigma_m):
        sentences.append(f"its place on the Earth to {length(figures.place_sigma_m, unit)}")
    text = ", ".join(sentences) + "." if sentences else "The model states no sigma."
    score, reference = figures.truth, figures.reference
    if score is not None:
        text += (
            f" Against the truth the surface is off by "
            f"{millimetres(score.surface.distance_rms_mm)} rms and the scale by "
            f"{parts(1e-6 * score.cameras.scale_error_ppm)}; "
            f"{share(score.surface.completeness_within_px.get('3'))} of the area is within 3 "
            "ground pixels."
        )
    if reference is not None:
        miss = reference.survey_to_reference
        text += (
            f" Against the reference: {length(miss.median_m)} median, "
            f"{length(miss.within_95_m)} for 95 % of it."
        )
    return text


def _next(figures: Figures, found: Sequence[Verdict]) -> str:
    actions = list(dict.fromkeys(v.action for v in found if v.level == "bad" and v.action))
    if not actions:
        actions = list(dict.fromkeys(v.action for v in found if v.level == "look" and v.action))
    if actions:
        return " ".join(actions[:_MOST_ACTIONS])
    if figures.surface is None:
        return "Make the model: 'alice-survey reconstruct'." if figures.total else "Take pictures."
    return "Nothing has to be done again: use the files below."
