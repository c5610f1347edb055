"""The judgement of a survey: verdicts, a summary in three sentences, and the first row of facts.

A verdict says what is good, what to look at or what is bad, with its number and what to do about
it. Every limit is one of measurement: a share of what the survey itself can resolve (its pixel,
its sigmas), or what the plan requires. What the summary says, no verdict repeats.
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
"""Stations that must see a point, so that more than one pair checks its height."""
_NAMED = 4
_FLY_HOLES = "Fly the holes again: 'alice-survey plan check' writes a plan for them."


def verdicts(figures: Figures) -> list[Verdict]:
    """All verdicts, the worst first."""
    makers = (_flight, _pictures, _model, _surface, _checks)
    return worst_first([verdict for maker in makers for verdict in maker(figures)])


def _verdict(text: str, action: str, *, good: bool, bad: bool = False) -> Verdict:
    """Good, or else bad or something to look at, with what to do."""
    level: Level = "good" if good else "bad" if bad else "look"
    return Verdict(level=level, text=text, action="" if good else action)


def _flight(figures: Figures) -> Iterator[Verdict]:
    flight = figures.held.read(FlightRecord)
    if flight is not None:
        whole = flight.ending == "complete"
        yield _verdict(
            f"flight: {flight.stations} of {flight.stations_planned} stations, "
            f"{share(flight.coverage.share_at_overlap)} of the area pictured as often as required"
            + ("" if whole else f"; it ended early: {flight.ending}"),
            _FLY_HOLES,
            good=whole and flight.coverage.share_at_overlap >= _WELL_COVERED,
            bad=not whole,
        )


def _pictures(figures: Figures) -> Iterator[Verdict]:
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
    rows = figures.held.rows("quality/quality.csv")
    flagged = [f"{row['image']} ({row['reasons']})" for row in rows if row["reasons"]]
    if rows:
        yield _verdict(
            f"pictures: {len(flagged)} of {len(rows)} stand out{_name_list(flagged)}",
            "Look at these pictures; quality/quality.csv lists them all.",
            good=not flagged,
        )


def _name_list(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f": {'; '.join(names[:_NAMED])}{more}" if names else ""


def _model(figures: Figures) -> Iterator[Verdict]:
    found, refraction = figures.registration, figures.mapping.refraction
    if found is None:
        return
    lost = found.total - found.registered
    yield _verdict(
        f"pictures in the model: {found.registered} of {found.total}"
        + ("; the others share too little with their neighbours" if lost else ""),
        "Fly with more overlap where pictures were lost (see the map), or with more light if they "
        "are dark.",
        good=not lost,
        bad=found.registered < _MIN_REGISTERED * found.total,
    )
    for joint in found.joints:
        away = math.hypot(joint.sigma_north_m, joint.sigma_east_m, joint.sigma_depth_m)
        yield Verdict(
            level="look",
            text=f"{count(joint.stations, 'station')} show nothing that the others show: "
            f"navigation alone places them relative to these, with a sigma of {length(away)}",
            action="Fly a line across the gap to join the parts as well as their pictures can.",
        )
    doming = found.doming
    asked = [
        (found.acceptance, "Look at the stations that the first lines name."),
        (doming, "Add lines across the others, or refine the rig (refine_rig, refine_port)."),
    ]
    for record, action in asked:
        for note in () if record is None else record.notes:
            yield Verdict(level="look", text=note, action=action)
    if refraction is not None and not refraction.settled:
        yield Verdict(
            level="bad",
            text="the refraction of the port did not settle",
            action="Check the port's distance in rig.json and the working range.",
        )
    bends = [] if doming is None or doming.notes else list(doming.bends.values())
    if bends:
        worst = max(bends, key=lambda bend: abs(bend.sag_m))
        yield Verdict(
            level="good",
            text="bend of the model against navigation: "
            f"{length_with_sigma(worst.sag_m, worst.sag_sigma_m)} over "
            f"{length(worst.length_m)}, so none is seen",
        )
    yield _scale(figures)


def _scale(figures: Figures) -> Verdict:
    found = figures.registration
    source = (None if found is None else found.scale_source) or "unknown"
    if figures.held.unit != "m":
        return Verdict(
            level="bad",
            text=f"no scale: {source}; all lengths are in arbitrary units",
            action="Give a rig, a scale bar or positions: 'alice-survey control' takes a length.",
        )
    place = None if found is None else found.georeference
    navigation = None if place is None else place.scale_of_navigation
    sigma = None if place is None else place.scale_of_navigation_sigma
    if navigation is None or not sigma or "rig" not in source:
        return Verdict(level="good" if "rig" in source else "look", text=source,
                       action="" if "rig" in source else "Measure a known length.")  # fmt: skip
    off = 1.0 / navigation - 1.0
    return _verdict(
        f"{source}; navigation's differs by {parts_with_sigma(-off, sigma)}",
        "Measure a known length in the water: either the rig has moved since its calibration, or "
        "navigation's scale is off.",
        good=abs(off) <= _SURE_SIGMAS * sigma,
    )


def _surface(figures: Figures) -> Iterator[Verdict]:
    surface = figures.surface
    if surface is None:
        return
    if math.isfinite(surface.covered):
        yield _verdict(
            f"the surface covers {share(surface.covered)} of the planned area",
            f"{_FLY_HOLES} The map shows them.",
            good=surface.covered >= _WELL_COVERED,
            bad=surface.covered < _MIN_COVERED,
        )
    if surface.sigma_median > figures.pixel_m:
        yield Verdict(
            level="look",
            text="the sigma of heights is above the mosaic's pixel",
            action="Fly lower or with more overlap for better heights.",
        )
    if surface.stations_median < _MIN_STATIONS:
        yield Verdict(
            level="look",
            text=f"most points are seen from {surface.stations_median:.0f} stations only, so that "
            "nothing checks their heights",
            action="Plan more forward overlap.",
        )


def _checks(figures: Figures) -> Iterator[Verdict]:
    """Verdicts on what else is known of the same sea floor."""
    score, found, control = figures.truth, figures.reference, figures.control
    if score is not None:
        surface, cameras = score.surface, score.cameras
        yield _verdict(
            f"against the truth: surface {millimetres(surface.distance_rms_mm)} rms, cameras "
            f"{millimetres(cameras.rms_mm)} rms, scale {parts(1e-6 * cameras.scale_error_ppm)}, "
            f"domed by {millimetres(surface.doming.dome_mm)}",
            "Look where on the map of errors.",
            good=surface.distance_rms_mm <= surface.ground_pixel_mm,
            bad=True,
        )
        ratio = None if surface.error_over_sigma is None else surface.error_over_sigma.rms
        if ratio is not None:
            yield _verdict(
                f"errors of heights over their stated sigmas: {ratio:.2f} rms (1 is expected)",
                "Multiply the stated sigmas by this factor where it matters.",
                good=_HONEST[0] <= ratio <= _HONEST[1],
            )
    if found is not None:
        off = found.survey_to_reference
        yield _verdict(
            f"against {found.reference.rsplit('/', 1)[-1]}: {length(off.median_m)} median "
            f"({off.median_px:.1f} ground pixels), after a {found.registration.transform} "
            "registration",
            "See where in reference/reference.png.",
            good=off.median_px <= 2.0,
        )
    if control is None:
        return
    for use, rms in control.rms.items():
        if rms.points and rms.north_m is not None and rms.east_m is not None:
            level = math.hypot(rms.north_m, rms.east_m)
            yield Verdict(
                level="good",
                text=f"{count(rms.points, 'point')} ({use}): off by {length(level)} level and "
                f"{length(rms.down_m)} in depth, rms",
            )
        if rms.bars:
            text = f"{count(rms.bars, 'scale bar')} ({use}): off by {length(rms.length_m)} rms"
            yield Verdict(level="good", text=text)
    for row in [row for row in (*control.points, *control.bars) if row.misfit_sigmas > 5.0][
        :_NAMED
    ]:
        yield Verdict(
            level="look",
            text=f"{row.name} is off by {row.misfit_sigmas:.1f} of its sigmas",
            action=f"Check how {row.name} was picked and measured.",
        )
    if control.not_found:
        yield Verdict(
            level="look",
            text=f"not found in the pictures{_name_list(list(control.not_found))}",
            action="Pick these by hand in picks.csv.",
        )


_MAX_ACTIONS = 2


def summary(figures: Figures, found: Sequence[Verdict]) -> Mapping[str, str]:
    """What was mapped, how well, what to do next."""
    return {
        "What was mapped": _result(figures),
        "How well": _quality(figures),
        "What to do next": _next_steps(figures, found),
    }


def facts(figures: Figures) -> list[tuple[str, str]]:
    """Labels and values of the first row: what the summary leaves out."""
    rows: list[tuple[str, str]] = []
    if figures.registration is not None:
        error = figures.registration.mean_reprojection_px
        rows.append(("reprojection error", f"{digits(error, 2)} px"))
    if figures.surface is not None:
        rows.append(("DEM cell", length(figures.surface.cell, figures.held.unit)))
    took = sum(stage.took_s for stage in figures.held.stages.values())
    rows.append(("computing", duration(took)))
    return rows


def _result(figures: Figures) -> str:
    held, surface, plan = figures.held, figures.surface, figures.held.plan
    if surface is not None:
        kind = "a simulated sea floor" if held.simulated else "sea floor"
        pixel = figures.pixel_m
        painted = f", painted at {length(pixel, held.unit)} a pixel" if pixel == pixel else ""
        return (
            f"{digits(surface.area)} {held.unit}² of {kind} with "
            f"{length(surface.high - surface.low, held.unit)} of relief{painted}, from "
            f"{count(figures.registered, 'picture')} taken at {count(figures.stations, 'station')}."
        )
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


def _quality(figures: Figures) -> str:
    surface, unit = figures.surface, figures.held.unit
    if surface is None:
        return "No surface to judge yet."
    clauses = []
    if math.isfinite(surface.sigma_median):
        clauses.append(
            f"Heights within the survey are accurate to {length(surface.sigma_median, unit)} (1 "
            f"sigma; 95 % of the cells to {length(surface.sigma_95, unit)})"
        )
    if math.isfinite(figures.place_sigma_m):
        clauses.append(f"its place on the Earth to {length(figures.place_sigma_m, unit)}")
    return ", ".join(clauses) + "." if clauses else "The model states no sigma."


def _next_steps(figures: Figures, found: Sequence[Verdict]) -> str:
    for level in ("bad", "look"):
        actions = list(dict.fromkeys(v.action for v in found if v.level == level and v.action))
        if actions:
            return " ".join(actions[:_MAX_ACTIONS])
    if figures.surface is None:
        return "Make the model: 'alice-survey reconstruct'." if figures.total else "Take pictures."
    return "Nothing has to be done again: use the files below."
