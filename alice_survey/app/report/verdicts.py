"""The judgement of a survey: verdicts, a summary in three sentences, and the first row of facts.

A verdict says what is good, what to look at or what is bad, with its number and what to do about
it. Every limit is one of measurement: a share of what the survey itself can resolve (its pixel,
its sigmas), or what the plan requires. What the summary says, no verdict repeats.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

from alice_survey.app.report.held import Held
from alice_survey.core.records import (
    CalibrationReportRecord,
    ControlRecord,
    FlightRecord,
    MappingRecord,
    ReferenceRecord,
    ScoreRecord,
)
from alice_survey.kit.document import Verdict, worst_first
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
    sigma_length,
)
from reconstruct.stages import rig_file

_SURE_SIGMAS = 3.0
"""Sigmas from which a difference is significant."""
_HONEST = (0.7, 1.4)
"""Errors over stated sigmas, root mean square, that are neither too large nor too small."""
_MIN_COVERED, _WELL_COVERED = 0.9, 0.99
_MIN_REGISTERED = 0.9
_MAX_LEAN = 0.5
"""Median error over sigma that the sigmas, which count errors that cells share, still cover."""
_MAX_UNCHECKED = 0.25
_MAX_MISFIT_SIGMAS = 5.0
_NAMED = 4
_MAX_ACTIONS = 2
_FLY_HOLES = "Fly the holes again: 'alice-survey plan check' writes a plan for them."


def verdicts(held: Held) -> list[Verdict]:
    """All verdicts, the worst first."""
    makers = (_flight, _pictures, _model, _scale, _surface, _truth, _reference, _control)
    return worst_first([verdict for maker in makers for verdict in maker(held)])


def _verdict(text: str, action: str, *, good: bool = False, bad: bool = False) -> Verdict:
    """Good, or else bad or something to look at, with what to do."""
    if good:
        return Verdict(level="good", text=text)
    return Verdict(level="bad" if bad else "look", text=text, action=action)


def _flight(held: Held) -> Iterator[Verdict]:
    flight = held.read(FlightRecord)
    if flight is not None:
        seen, whole = flight.coverage.share_at_overlap, flight.ending == "complete"
        yield _verdict(
            f"flight: {flight.stations} stations ({flight.stations_planned} planned), "
            f"{share(seen)} of the area pictured as often as required"
            + ("" if whole else f"; it ended early: {flight.ending}"),
            _FLY_HOLES,
            good=whole and seen >= _WELL_COVERED,
            bad=not whole,
        )


def _pictures(held: Held) -> Iterator[Verdict]:
    calibrated = held.read(CalibrationReportRecord) or CalibrationReportRecord()
    checks = calibrated.verdicts
    worse = [verdict for verdict in checks if verdict.level != "good"]
    for verdict in worse:
        action = "Read the calibration's own report, and take more views where it says so."
        yield _verdict(f"calibration: {verdict.text}", action, bad=verdict.level == "bad")
    if checks and not worse:
        yield Verdict(level="good", text=f"calibration: all {len(checks)} checks passed")
    rows = held.rows("quality/quality.csv")
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


def _model(held: Held) -> Iterator[Verdict]:
    found = held.registration
    if found is None:
        return
    yield _verdict(
        f"pictures in the model: {found.registered} of {found.total}",
        "Fly with more overlap where pictures were lost (see the map), or with more light if they "
        "are dark.",
        good=found.registered == found.total,
        bad=found.registered < _MIN_REGISTERED * found.total,
    )
    for joint in found.joints:
        away = math.hypot(joint.sigma_north_m, joint.sigma_east_m, joint.sigma_depth_m)
        yield _verdict(
            f"{count(joint.stations, 'station')} show nothing that the others show: navigation "
            f"alone places them relative to these, with a sigma of {sigma_length(away)}",
            "Fly a line across the gap to join the parts as well as their pictures can.",
        )
    doming, acceptance = found.doming, found.acceptance
    for note in () if acceptance is None else acceptance.notes:
        yield _verdict(note, "Look at the stations that the first lines name.")
    for note in () if doming is None else doming.notes:
        yield _verdict(
            note, "Add lines across the others, or refine the rig (refine_rig, refine_port)."
        )
    refraction = (held.read(MappingRecord) or MappingRecord()).refraction
    if refraction is not None and not refraction.settled:
        yield _verdict(
            "the refraction of the port did not settle",
            "Check the port's distance in rig.json and the working range.",
            bad=True,
        )
    bends = [] if doming is None or doming.notes else list(doming.bends.values())
    if bends:
        worst = max(bends, key=lambda bend: abs(bend.sag_m))
        sag = length_with_sigma(worst.sag_m, worst.sag_sigma_m)
        text = f"bend of the model against navigation: {sag} over {length(worst.length_m)}"
        yield Verdict(level="good", text=f"{text}, so none is seen")
    if rig_file(held.workspace) is None:
        checked = bool(bends or held.read(ControlRecord))
        yield _verdict(
            "lens: found from these pictures alone, and no sigma counts its error"
            + "; navigation or control checks the shape" * checked,
            "Calibrate the camera in the water ('alice-survey calibrate'), or add control points.",
            good=checked,
        )


def _scale(held: Held) -> Iterator[Verdict]:
    found = held.registration
    if found is None:
        return
    source, place = found.scale_source or "unknown", found.georeference
    if held.unit != "m":
        yield _verdict(
            f"no scale: {source}; all lengths are in arbitrary units",
            "Give a rig, a scale bar or positions: 'alice-survey control' takes a length.",
            bad=True,
        )
    elif "rig" in source and place is not None and place.scale_of_navigation_sigma:
        off = 1.0 - 1.0 / (place.scale_of_navigation or math.nan)
        sigma = place.scale_of_navigation_sigma
        yield _verdict(
            f"{source}; navigation's differs by {parts_with_sigma(off, sigma)}",
            "Measure a known length in the water: either the rig has moved since its calibration, "
            "or navigation's scale is off.",
            good=abs(off) <= _SURE_SIGMAS * sigma,
        )
    else:
        which = "second known length, as a check" if "length" in source else "known length"
        yield _verdict(source, f"Measure a {which}.", good="rig" in source)


def _surface(held: Held) -> Iterator[Verdict]:
    surface = held.surface
    if surface is None:
        return
    if math.isfinite(surface.covered):
        yield _verdict(
            f"the surface covers {share(surface.covered)} of the planned area",
            f"{_FLY_HOLES} The map shows them.",
            good=surface.covered >= _WELL_COVERED,
            bad=surface.covered < _MIN_COVERED,
        )
    if surface.sigma_median > held.pixel_m:
        yield _verdict(
            "the sigma of heights is above the mosaic's pixel",
            "Fly lower or with more overlap for better heights.",
        )
    if surface.unchecked > _MAX_UNCHECKED:
        which = "planned area" if math.isfinite(surface.covered) else "surface"
        yield _verdict(
            f"{share(surface.unchecked)} of the {which} are seen from fewer than three stations: "
            "nothing checks their heights",
            "Plan more overlap, or a margin beyond the area.",
        )


def _truth(held: Held) -> Iterator[Verdict]:
    score = held.read(ScoreRecord)
    if score is None:
        return
    surface, cameras = score.surface, score.cameras
    yield _verdict(
        f"against the truth: surface {millimetres(surface.distance_rms_mm)} rms, cameras "
        f"{millimetres(cameras.rms_mm)} rms, scale {parts(1e-6 * cameras.scale_error_ppm)}, "
        f"domed by {millimetres(surface.doming.dome_mm)}",
        "Look where on the map of errors.",
        good=surface.distance_rms_mm <= surface.ground_pixel_mm,
        bad=True,
    )
    over = surface.error_over_sigma
    if over is not None and over.rms is not None:
        lean = over.median or 0.0
        yield _verdict(
            f"errors of heights over their stated sigmas: {over.rms:.2f} rms (1 is expected), "
            f"{lean:+.2f} in the median",
            "Measure control points: heights share an error."
            if abs(lean) > _MAX_LEAN
            else f"Multiply the stated sigmas by {over.rms:.1f} where it matters.",
            good=_HONEST[0] <= over.rms <= _HONEST[1] and abs(lean) <= _MAX_LEAN,
        )


def _reference(held: Held) -> Iterator[Verdict]:
    found = held.read(ReferenceRecord)
    if found is not None:
        off = found.survey_to_reference
        yield _verdict(
            f"against {found.name}: {length(off.median_m)} median ({off.median_px:.1f} ground "
            f"pixels), after a {found.registration.transform} registration",
            "See where in reference/reference.png.",
            good=off.median_px <= 2.0,
        )


def _control(held: Held) -> Iterator[Verdict]:
    control = held.read(ControlRecord)
    if control is None:
        return
    for use, rms in control.rms.items():
        off = []
        if rms.points and rms.north_m is not None and rms.east_m is not None:
            level = length(math.hypot(rms.north_m, rms.east_m))
            points = count(rms.points, "point")
            off.append(f"{points} by {level} level and {length(rms.down_m)} in depth")
        if rms.bars:
            off.append(f"{count(rms.bars, 'scale bar')} by {length(rms.length_m)}")
        if off:
            yield Verdict(level="good", text=f"{use}: off, rms, {' and '.join(off)}")
    rows = sorted((*control.points, *control.bars), key=lambda row: -row.misfit_sigmas)
    for row in [row for row in rows if row.misfit_sigmas > _MAX_MISFIT_SIGMAS][:_NAMED]:
        yield _verdict(
            f"{row.name} is off by {row.misfit_sigmas:.1f} of its sigmas",
            f"Check how {row.name} was picked and measured.",
        )
    if control.not_found:
        yield _verdict(
            f"not found in the pictures{_name_list(list(control.not_found))}",
            "Pick these by hand in picks.csv.",
        )


def summary(held: Held, found: Sequence[Verdict]) -> Mapping[str, str]:
    """What was mapped, how well, what to do next."""
    return {
        "What was mapped": _result(held),
        "How well": _quality(held),
        "What to do next": _next_steps(held, found),
    }


def facts(held: Held) -> list[tuple[str, str]]:
    """Labels and values of the first row: what the summary leaves out."""
    rows: list[tuple[str, str]] = []
    if held.registration is not None:
        error = held.registration.mean_reprojection_px
        rows.append(("reprojection error", f"{digits(error, 2)} px"))
    if held.surface is not None:
        rows.append(("DEM cell", length(held.surface.cell, held.unit)))
    rows.append(("computing", duration(sum(stage.took_s for stage in held.stages.values()))))
    return rows


def _result(held: Held) -> str:
    surface, plan, pixel = held.surface, held.plan, held.pixel_m
    if surface is not None:
        known = held.plane is None and held.frame.datum is not None
        kind = ("a simulated sea floor" if held.simulated else "sea floor") if known else "surface"
        painted = f", painted at {length(pixel, held.unit)} a pixel" if pixel == pixel else ""
        return (
            f"{digits(surface.area)} {held.unit}² of {kind} with "
            f"{length(surface.high - surface.low, held.unit)} of relief{painted}, from "
            f"{held.pictures}."
        )
    if held.has("sparse"):
        return f"Nothing yet: {held.pictures} are placed, no surface is made."
    if plan is not None:
        return (
            f"Nothing yet: a plan of {count(len(plan.lines), 'line')}, "
            f"{count(plan.stations, 'station')} and {duration(plan.duration_s)} is ready."
        )
    return "Nothing yet."


def _quality(held: Held) -> str:
    surface, unit = held.surface, held.unit
    if surface is None:
        return "No surface to judge yet."
    clauses = []
    if math.isfinite(surface.sigma_median):
        usual, most = (sigma_length(s, unit) for s in (surface.sigma_median, surface.sigma_95))
        clauses.append(f"Heights are accurate to {usual} (1 sigma; 95 % of the cells to {most})")
    if math.isfinite(held.place_sigma_m):
        clauses.append(f"its place on the Earth to {sigma_length(held.place_sigma_m, unit)}")
    return ", ".join(clauses) + "." if clauses else "The model states no sigma."


def _next_steps(held: Held, found: Sequence[Verdict]) -> str:
    for level in ("bad", "look"):
        actions = list(dict.fromkeys(v.action for v in found if v.level == level and v.action))
        if actions:
            return " ".join(actions[:_MAX_ACTIONS])
    if held.surface is None:
        taken = held.has("images")
        return "Make the model: 'alice-survey reconstruct'." if taken else "Take pictures."
    return "Nothing has to be done again: use the files below."
