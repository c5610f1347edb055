"""The judgement of a survey: verdicts, a summary in three sentences, and the first row of facts.

A verdict says what is good, what to look at or what is bad, with its number and what to do about
it. Every limit is one of measurement: a share of what the survey itself can resolve (its pixel,
its sigmas), or what the plan requires.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

from alice_survey.app.report.figures import Figures
from alice_survey.core.records import CalibrationReportRecord, FlightRecord
from alice_survey.kit.document import Level, Verdict, worst_first
from alice_survey.kit.words import (
    count,
    digits,
    duration,
    length,
    length_with_sigma,
    millimetres,
    parts,
    parts_with_sigma,
    share,
)

_SURE_SIGMAS = 3.0
"""Sigmas from which a difference is significant."""
_HONEST = (0.7, 1.4)
"""Errors over stated sigmas, root mean square, that are neither too large nor too small."""
_MIN_COVERED, _WELL_COVERED = 0.9, 0.99
_MIN_REGISTERED = 0.9
_MIN_STATIONS = 3.0
"""Stations that must see a spot, so that more than one pair checks its height."""
_NAMED = 4


def verdicts(figures: Figures) -> list[Verdict]:
    """All verdicts, the worst first."""
    return worst_first([
        *_flight(figures),
        *_calibration(figures),
        *_pictures(figures),
        *_registration(figures),
        *_scale(figures),
        *_shape(figures),
        *_surface(figures),
        *_truth(figures),
        *_reference(figures),
        *_control(figures),
    ])  # fmt: skip


def _judged(text: str, action: str, *, good: bool, bad: bool = False) -> Verdict:
    """Good, or else bad or something to look at, with what to do."""
    level: Level = "good" if good else "bad" if bad else "look"
    return Verdict(level=level, text=text, action="" if good else action)


def _flight(figures: Figures) -> Iterator[Verdict]:
    flight = figures.held.read(FlightRecord)
    if flight is None:
        return
    text = (
        f"flight: {flight.stations} of {flight.stations_planned} stations, "
        f"{share(flight.coverage.share_at_overlap)} of the area pictured as often as required"
    )
    if flight.ending != "complete":
        yield Verdict(
            level="bad",
            text=f"{text}; it ended early: {flight.ending}",
            action="Fly what is left: 'alice-survey plan check' writes a plan for it.",
        )
    else:
        yield _judged(
            text,
            "Fly the holes again: 'alice-survey plan check' writes a plan for them.",
            good=flight.coverage.share_at_overlap >= _WELL_COVERED,
        )


def _calibration(figures: Figures) -> Iterator[Verdict]:
    calibrated = figures.held.read(CalibrationReportRecord)
    checks = () if calibrated is None else calibrated.verdicts
    worse = [verdict for verdict in checks if verdict.level != "good"]
    for verdict in worse:
        yield Verdict(
            level=verdict.level,
            text=f"calibration: {verdict.text}",
            action="Read the calibration's own report, and take more views where it says so.",
        )
    if checks and not worse:
        yield Verdict(level="good", text=f"calibration: all {len(checks)} checks passed")


def _pictures(figures: Figures) -> Iterator[Verdict]:
    rows = figures.held.rows("quality/quality.csv")
    flagged = [row for row in rows if row["reasons"]]
    if flagged:
        names = "; ".join(f"{row['image']} ({row['reasons']})" for row in flagged[:_NAMED])
        more = f" and {len(flagged) - _NAMED} more" if len(flagged) > _NAMED else ""
        yield Verdict(
            level="look",
            text=f"pictures: {len(flagged)} of {len(rows)} stand out: {names}{more}",
            action="Look at these pictures; quality/quality.csv lists them all.",
        )
    elif rows:
        yield Verdict(level="good", text=f"pictures: none of {len(rows)} stands out")


def _registration(figures: Figures) -> Iterator[Verdict]:
    if not figures.held.has("sparse"):
        return
    registered, total = figures.registered, figures.total
    whole = registered == total
    yield _judged(
        f"pictures in the model: {registered} of {total}"
        + ("" if whole else "; the others share too little with their neighbours"),
        "Fly with more overlap where pictures were lost (see the map), or with more light if they "
        "are dark.",
        good=whole,
        bad=registered < _MIN_REGISTERED * total,
    )
    mapping, found = figures.mapping, figures.registration
    for joint in () if found is None else found.joints:
        away = math.hypot(joint.sigma_north_m, joint.sigma_east_m, joint.sigma_depth_m)
        yield Verdict(
            level="look",
            text=f"{count(joint.stations, 'station')} show nothing that the others show: "
            f"navigation alone places them relative to these, with a sigma of {length(away)}",
            action="Fly a line across the gap to join the parts as well as their pictures can.",
        )
    for note in () if found is None or found.acceptance is None else found.acceptance.notes:
        yield Verdict(
            level="look", text=note, action="Look at the stations that the first lines name."
        )
    if mapping.refraction is not None and not mapping.refraction.settled:
        yield Verdict(
            level="bad",
            text="the refraction of the port did not settle",
            action="Check the port's distance in rig.json and the working range.",
        )


def _scale(figures: Figures) -> Iterator[Verdict]:
    found = figures.registration
    if found is None:
        return
    source = found.scale_source or "unknown"
    if figures.held.unit != "m":
        yield Verdict(
            level="bad",
            text=f"no scale: {source}; all lengths are in arbitrary units",
            action="Give a rig, a scale bar or positions: 'alice-survey control' takes a length.",
        )
        return
    place = found.georeference
    navigation = None if place is None else place.scale_of_navigation
    sigma = None if place is None else place.scale_of_navigation_sigma
    if navigation is None or not sigma or "rig" not in source:
        yield Verdict(level="good" if "rig" in source else "look", text=source)
        return
    off = 1.0 / navigation - 1.0
    yield _judged(
        f"{source}; navigation's differs by {parts_with_sigma(-off, sigma)}",
        "Measure a known length in the water: either the rig has moved since its calibration, or "
        "navigation's scale is off.",
        good=abs(off) <= _SURE_SIGMAS * sigma,
    )


def _shape(figures: Figures) -> Iterator[Verdict]:
    doming = None if figures.registration is None else figures.registration.doming
    if doming is None:
        return
    for note in doming.notes:
        yield Verdict(
            level="look",
            text=note,
            action="Add lines across the others, or refine the rig (refine_rig, refine_port).",
        )
    bends = list(doming.bends.values())
    if bends and not doming.notes:
        worst = max(bends, key=lambda bend: abs(bend.sag_m))
        yield Verdict(
            level="good",
            text="bend of the model against navigation: "
            f"{length_with_sigma(worst.sag_m, worst.sag_sigma_m)} over "
            f"{length(worst.length_m)}, so none is seen",
        )


def _surface(figures: Figures) -> Iterator[Verdict]:
    surface = figures.surface
    if surface is None:
        return
    unit = figures.held.unit
    if math.isfinite(surface.covered):
        yield _judged(
            f"the surface covers {share(surface.covered)} of the planned area",
            "Fly the holes again: the map shows them, and 'alice-survey plan check' writes a plan "
            "for them.",
            good=surface.covered >= _WELL_COVERED,
            bad=surface.covered < _MIN_COVERED,
        )
    if math.isfinite(surface.sigma_median):
        text = (
            f"heights are good to {length(surface.sigma_median, unit)} (one sigma, median; 95 % of "
            f"the cells to {length(surface.sigma_95, unit)}), within the survey"
        )
        fine = not surface.sigma_median > figures.pixel_m
        yield _judged(
            text if fine else f"{text}; the mosaic's pixel is {length(figures.pixel_m, unit)}",
            "Fly lower or with more overlap for better heights.",
            good=fine,
        )
    if surface.stations_median < _MIN_STATIONS:
        yield Verdict(
            level="look",
            text=f"most spots are seen from {surface.stations_median:.0f} stations only, so that "
            "nothing checks their heights",
            action="Plan more forward overlap.",
        )


def _truth(figures: Figures) -> Iterator[Verdict]:
    score = figures.truth
    if score is None:
        return
    surface, cameras = score.surface, score.cameras
    miss = surface.distance_rms_mm
    yield _judged(
        f"against the truth: surface {millimetres(miss)} rms, cameras "
        f"{millimetres(cameras.rms_mm)} rms, scale {parts(1e-6 * cameras.scale_error_ppm)}, "
        f"domed by {millimetres(surface.doming.dome_mm)}",
        "Look where on the map of errors.",
        good=miss <= surface.ground_pixel_mm,
        bad=True,
    )
    ratio = None if surface.error_over_sigma is None else surface.error_over_sigma.rms
    if ratio is not None:
        yield _judged(
            f"errors of heights over their stated sigmas: {ratio:.2f} rms (1 is expected)",
            "Multiply the stated sigmas by this factor where it matters.",
            good=_HONEST[0] <= ratio <= _HONEST[1],
        )


def _reference(figures: Figures) -> Iterator[Verdict]:
    found = figures.reference
    if found is None:
        return
    miss = found.survey_to_reference
    yield _judged(
        f"against {found.reference.rsplit('/', 1)[-1]}: {length(miss.median_m)} median "
        f"({miss.median_px:.1f} ground pixels), after a {found.registration.transform} "
        "registration",
        "See where in reference/reference.png.",
        good=miss.median_px <= 2.0,
    )


def _control(figures: Figures) -> Iterator[Verdict]:
    score = figures.control
    if score is None:
        return
    for use, rms in score.rms.items():
        if rms.points and rms.north_m is not None and rms.east_m is not None:
            level = math.hypot(rms.north_m, rms.east_m)
            yield Verdict(
                level="good",
                text=f"{count(rms.points, 'point')} ({use}): off by {length(level)} level and "
                f"{length(rms.down_m)} in depth, rms",
            )
        if rms.bars:
            yield Verdict(
                level="good",
                text=f"{count(rms.bars, 'scale bar')} ({use}): off by {length(rms.length_m)} rms",
            )
    far = [row for row in (*score.points, *score.bars) if row.misfit_sigmas > 5.0]
    for row in far[:_NAMED]:
        yield Verdict(
            level="look",
            text=f"{row.name} misses by {row.misfit_sigmas:.1f} of its sigmas",
            action=f"Check how {row.name} was picked and measured.",
        )
    if score.not_found:
        names = ", ".join(list(score.not_found)[:_NAMED])
        yield Verdict(
            level="look",
            text=f"not found in the pictures: {names}",
            action="Pick these by hand in picks.csv.",
        )


_MAX_ACTIONS = 2


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
        return " ".join(actions[:_MAX_ACTIONS])
    if figures.surface is None:
        return "Make the model: 'alice-survey reconstruct'." if figures.total else "Take pictures."
    return "Nothing has to be done again: use the files below."
