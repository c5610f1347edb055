"""`alice-survey plan check`: what a dive has seen, which holes are left, and a plan for these."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import need_stage, refuse_links, write_json
from alice_survey.core.config import CameraConfig, SurveyConfig, WaterConfig
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.executor import SERIAL, Executor, local_executor
from alice_survey.kit.words import count, share, text_table
from camera_calib.rig import Rig, design_rig, read_rig, rig_with_mount
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import DiveRecord, read_dive_record
from missions.coverage.holes import Hole, find_holes
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.fly.refly import dive_means, holes_plan, write_refly
from missions.plan.strength import survey_costs
from missions.values.plan_file import Plan, read_plan

_LISTED = 20
_MIN_COVERED = 0.9
"""A survey that lacks more than a tenth of its area is not good enough, as in the report."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Check:
    """A dive next to its plan."""

    plan: Plan
    rig: Rig
    record: DiveRecord
    planned: Certificate
    flown: Certificate
    holes: tuple[Hole, ...]
    """Holes of what was flown, worst first."""

    def to_json(self) -> dict[str, Any]:
        """All figures: `certificate.json`."""
        return {
            "format": "alice-survey certificate",
            "version": 1,
            "plan": self.plan.name,
            "rig": self.rig.source,
            "dive": self.record.to_json(),
            "planned": self.planned.to_json(),
            "flown": self.flown.to_json(),
            "holes_m2": round(sum(hole.area_m2 for hole in self.holes), 6),
            "unseen_m2": round(sum(hole.unseen_m2 for hole in self.holes), 6),
            "holes": [hole.to_json() for hole in self.holes],
        }


def check_log(
    workspace: Path,
    rig: Rig,
    log: Path,
    *,
    triggers: Path | None = None,
    executor: Executor = SERIAL,
) -> Check:
    """Certify a dive by its log.

    Args:
        workspace: with the plan.
        rig: the cameras in the survey's water.
        log: navigation CSV, or the folder of a simulated flight.
        triggers: CSV with the times of the pictures.
        executor: where tasks run, of a large area.

    Raises:
        WorkspaceError: there is no plan.
        NavigationError: the log or the triggers cannot be used.
    """
    plan = read_plan(need_stage(workspace, "plan", "plan") / "plan.json")
    record = read_dive_record(log, plan, rig, triggers=triggers)
    pattern = plan_pattern(plan, rig)
    planned = certificate(plan.area, rig, stations_of_plan(plan), pattern, executor=executor)
    flown = certificate(
        plan.area, rig, record.stations, pattern, cell_m=planned.grid.cell_m, executor=executor
    )
    if flown.blind:
        warn(
            f"{count(flown.blind, 'station')} without the sea floor in view: counted as "
            "seeing nothing"
        )
    return Check(
        plan=plan, rig=rig, record=record, planned=planned, flown=flown, holes=find_holes(flown)
    )


def rig_of(workspace: Path, camera: CameraConfig, water: WaterConfig) -> Rig:
    """The cameras of a workspace in the survey's water: calibrated, or else as designed.

    Where the calibration does not state the mount it is that which a reconstruction found, or else
    the designed one, as `source` says.

    Args:
        workspace: with `calibration/rig.json` or `images/rig.json` where they were calibrated, and
            `sparse/rig.json` where their mount was found.
        camera: the design.
        water: of the survey.
    """
    designed = design_rig(camera, water)
    for folder in ("calibration", "images"):
        path = workspace / folder / "rig.json"
        if path.is_file():
            rig = read_rig(path).in_water(water.n_water)
            if rig_with_mount(rig) is not None:
                return rig
            mount, how = designed.body_from_rig, "as designed"
            refined = workspace / "sparse" / "rig.json"
            found = read_rig(refined) if refined.is_file() else rig
            if found.body_from_rig is not None and list(found.cameras) == list(rig.cameras):
                mount, how = found.body_from_rig, "as the reconstruction found"
            return replace(rig, body_from_rig=mount, source=f"{rig.source}; mounted {how}")
    return designed


def check_report(
    workspace: Path,
    config: SurveyConfig,
    log: Path | None = None,
    *,
    triggers: Path | None = None,
    out: Path | None = None,
    executor: Executor | None = None,
) -> tuple[str, dict[str, Any]]:
    """Check a dive, write what is found, and plan the holes again.

    Writes `certificate.json`, `coverage.png`, `coverage.tif`, `holes.geojson`; where holes are left
    `refly/`, a workspace with its own plan.

    Args:
        workspace: as of `check_log`.
        config: the survey.
        log: navigation CSV or folder of a simulated flight; left out, the workspace's flight.
        triggers: as of `check_log`.
        out: folder to write; left out, `check` in the workspace.
        executor: where tasks run; all cores of this machine when left out.

    Returns:
        A report as text, and as JSON values.

    Raises:
        AliceError: a file is missing or cannot be used.
    """
    executor = executor or local_executor()
    path = need_stage(workspace, "flight", "fly") if log is None else log
    rig = rig_of(workspace, config.camera, config.water)
    check = check_log(workspace, rig, path, triggers=triggers, executor=executor)
    folder = workspace / "check" if out is None else out
    refuse_links(workspace, folder)
    if not check.holes and (folder / "refly").exists():
        warn(f"{folder / 'refly'} is of an earlier check: there are no holes now")
    data = check.to_json()
    text = _check_text(check)
    if check.holes:
        try:
            means = dive_means(config.plan, config.vehicle, survey_costs(config))
            plan = holes_plan(check.plan, check.rig, check.flown, check.holes, means)
        except PlanError as error:
            warn(f"the holes cannot be planned again: {error}")
        else:
            words, data["refly"] = write_refly(
                folder / "refly", plan, rig, config.camera, config.water, config.plan
            )
            text += (
                f"\nto fly the holes again: {words}; then {share(plan.coverage, 2)} of them are "
                f"at that overlap: {folder / 'refly'}"
            )
    _write(folder, check, data)
    if check.flown.share_at_overlap < _MIN_COVERED:
        data["shortfall"] = (
            f"{share(check.flown.share_at_overlap, 2)} of the area is at the requested overlap, "
            f"less than {_MIN_COVERED:.0%}: fly the holes again"
        )
        warn(data["shortfall"])
    files = "certificate.json, coverage.png, coverage.tif, holes.geojson"
    return f"{text}\n{folder}: {files}", {**data, "folder": str(folder)}


def _write(folder: Path, check: Check, data: dict[str, Any]) -> None:
    from missions.coverage.drawing import draw_certificate, write_coverage_tif, write_outlines

    folder.mkdir(parents=True, exist_ok=True)
    outlines = [(hole.outline, hole.to_json()) for hole in check.holes]
    write_outlines(folder / "holes.geojson", check.plan.datum, outlines)
    write_coverage_tif(folder / "coverage.tif", check.flown)
    draw_certificate(
        folder / "coverage.png", check.flown, check.holes, f"{check.plan.name}: as flown",
        check.record.stations,
    )  # fmt: skip
    write_json(folder / "certificate.json", data)


def _check_text(check: Check) -> str:
    record, planned, flown = check.record, check.planned, check.flown
    pattern, triggered = flown.pattern, record.triggered
    overlap = f"{count(pattern.passes, 'line')}, {pattern.passes * pattern.pictures} pictures"
    altitude = record.stations.altitude_m
    above = f", {altitude.min():.2f} to {altitude.max():.2f} m above it" if len(altitude) else ""
    lines = [
        f"{record.source}: {len(record.stations)} of {triggered} triggers over the sea "
        f"floor{above}; triggers: {record.triggers}"
    ]
    lines += [
        f"  left out: {count} ({count / triggered:.1%}) {reason}"
        for reason, count in record.left_out.items()
    ]
    if record.on_way:
        lines.append(
            f"  on the way down and up: {record.on_way} ({record.on_way / triggered:.1%}), before "
            "the first and after the last picture on a line"
        )
    lines += [f"  {note}" for note in record.notes]
    lines.append(
        f"{check.plan.name}: {flown.area_m2:.1f} m2, cameras {', '.join(flown.cameras)} "
        f"({check.rig.source}), judged every {100 * flown.grid.cell_m:.1f} cm"
    )
    shares = {
        "in at least one picture": "covered_share", "in stereo": "stereo_share",
        f"at the requested overlap ({overlap} of each camera)": "share_at_overlap",
    }  # fmt: skip
    numbers = {"pictures": "taken", "fewest pictures of a camera": "fewest_pictures"}
    rows = [
        (name, *(share(getattr(each, field), 2) for each in (planned, flown)))
        for name, field in shares.items()
    ] + [
        (name, *(str(getattr(each, field)) for each in (planned, flown)))
        for name, field in numbers.items()
    ]
    lines.append(text_table(("", "planned", "flown"), rows))
    return "\n".join([*lines, *_hole_rows(check.holes)])


def _hole_rows(holes: Sequence[Hole]) -> list[str]:
    if not holes:
        return ["no holes"]
    whole = sum(hole.area_m2 for hole in holes)
    unseen = sum(hole.unseen_m2 for hole in holes)
    rows = [
        f"{count(len(holes), 'hole')}, {whole:.2f} m2 short of that overlap, of which "
        f"{unseen:.2f} m2 in no picture; worst first:",
        text_table(
            ("", "area m2", "unseen m2", "size m", "latitude", "longitude", "north m", "east m"),
            [
                (
                    str(number), f"{hole.area_m2:.2f}", f"{hole.unseen_m2:.2f}",
                    f"{hole.length_m:.2f} x {hole.width_m:.2f}", f"{hole.latitude_deg:.7f}",
                    f"{hole.longitude_deg:.7f}", f"{hole.place_ne[0]:.2f}",
                    f"{hole.place_ne[1]:.2f}",
                )
                for number, hole in enumerate(holes[:_LISTED], 1)
            ],
        ),
    ]  # fmt: skip
    if len(holes) > _LISTED:
        rest = sum(hole.area_m2 for hole in holes[_LISTED:])
        rows.append(f"  and {len(holes) - _LISTED} more, {rest:.2f} m2 in all (certificate.json)")
    return rows
