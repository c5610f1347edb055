"""Pictures of several dives in one workspace, so that they become one model."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import Stage, need_stage, read_stage, run_stage, write_json
from alice_survey.core.errors import CalibrationError, ImageError, PlanError, WorkspaceError
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.core.records import PicturesRecord
from camera_calib.rig import read_rig, write_rig
from missions.values.legs import Route
from missions.values.plan_file import Plan, read_plan
from reconstruct.stages import rig_file

_APART_S = 86_400.0
"""Between the end of a dive and the start of the next: their clocks are their own, and errors of
navigation do not last from one to the other."""


def join_dives(workspace: Path, dives: Sequence[Path]) -> str:
    """Write `images/` with the pictures of several dives, and `plan/` with the lines of all.

    Settings are those of the first dive, and so are datum and area. Pictures of a dive lie in a
    folder of its own; stations count on from dive to dive.

    Args:
        workspace: to write; none of the dives.
        dives: workspaces with pictures, in the order of diving.

    Returns:
        What there is now, in words.

    Raises:
        WorkspaceError: there are fewer than two dives, one lacks pictures, or is the workspace.
        ImageError: depths of the dives count from different levels.
        CalibrationError: rigs of the dives differ.
        PlanError: plans of the dives have different datums.
    """
    places = [dive.resolve() for dive in dives]
    if len(set(places)) < 2 or len(set(places)) < len(places):
        raise WorkspaceError("give two dives or more, each once")
    if workspace.resolve() in places:
        raise WorkspaceError(f"{workspace} is one of the dives: choose another with -w")
    if (workspace / "images" / "truth").exists():
        raise WorkspaceError(f"{workspace} holds a simulated survey: choose another with -w")
    folders = [need_stage(dive, "images", "import-images") for dive in dives]
    rig = _same_rig(dives)
    surveys = [PicturesRecord.read(folder / "survey.json") for folder in folders]
    rows = [read_manifest(folder / "manifest.csv") for folder in folders]
    levels = {
        survey.vertical_datum
        for survey, records in zip(surveys, rows, strict=True)
        if any(record.readings["depth"] for record in records)
    }
    if len(levels) > 1:
        raise ImageError(
            f"depths of the dives count from different levels ({', '.join(map(repr, levels))}): "
            "import them with one --vertical-datum"
        )
    inputs = [
        folder / name
        for folder, records in zip(folders, rows, strict=True)
        for name in ("manifest.csv", "survey.json", *(r.image for r in records))
    ]
    stage = Stage(
        name="images",
        version=2,
        settings={"joined": len(dives)},
        inputs=[*inputs, *([rig] if rig else [])],
    )

    def work(partial: Path) -> None:
        records: list[ImageRecord] = []
        for number, (folder, own) in enumerate(zip(folders, rows, strict=True), 1):
            for name in [name for r in own for name in (r.image, r.mask) if name]:
                target = partial / f"dive{number}" / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / name, target)
            records += _append_dive(own, f"dive{number}", records)
        write_manifest(partial / "manifest.csv", records)
        if rig is not None:
            write_rig(partial / "rig.json", read_rig(rig))
        first = next((s for s in surveys if s.datum is not None), surveys[0])
        notes = tuple(dict.fromkeys(note for s in surveys for note in s.notes))
        level = next(iter(levels), first.vertical_datum)
        first.model_copy(
            update={"source": "imported", "notes": notes, "vertical_datum": level}
        ).write(partial / "survey.json")

    _join_plans(workspace, dives)
    run_stage(workspace, stage, work)
    if (dives[0] / "survey.toml").is_file() and not (workspace / "survey.toml").exists():
        shutil.copyfile(dives[0] / "survey.toml", workspace / "survey.toml")
    counts = [len(records) for records in rows]
    return f"{' and '.join(map(str, counts))} pictures of {len(dives)} dives"


def _same_rig(dives: Sequence[Path]) -> Path | None:
    """The rig of the dives that have one."""
    files = [path for path in map(rig_file, dives) if path is not None]
    for path in files[1:]:
        if path.read_bytes() != files[0].read_bytes():
            raise CalibrationError(
                f"{files[0]} and {path} are not one rig: import the pictures of both dives with "
                "the same --rig"
            )
    return files[0] if files else None


def _append_dive(
    records: Sequence[ImageRecord], folder: str, before: Sequence[ImageRecord]
) -> list[ImageRecord]:
    """A dive's pictures in a folder, after those of earlier dives in stations and in time."""
    after = 1 + max((r.station for r in before), default=-1)
    late_s = np.nan_to_num(np.array([r.time_s for r in before]))
    start_s = np.nan_to_num(np.array([r.time_s for r in records]))
    shift_s = float(late_s.max() - start_s.min()) + _APART_S if before else 0.0
    return [
        replace(
            r,
            image=f"{folder}/{r.image}",
            mask=f"{folder}/{r.mask}" if r.mask else "",
            station=r.station + after,
            time_s=r.time_s + shift_s,
        )
        for r in records
    ]


def _join_plans(workspace: Path, dives: Sequence[Path]) -> None:
    """Write the plan of all lines over the first plan's area, where the dives were planned."""
    folders = [dive / "plan" for dive in dives if read_stage(dive / "plan") is not None]
    if not folders or folders[0] != dives[0] / "plan":
        return
    plans = [read_plan(folder / "plan.json") for folder in folders]
    whole = plans[0]
    for plan in plans[1:]:
        if plan.datum != whole.datum:
            raise PlanError(
                f"plans {whole.name!r} and {plan.name!r} have different datums: join dives of one "
                "survey"
            )
        whole = _with_lines(whole, plan)
    stage = Stage(
        name="plan",
        version=1,
        settings={"refly_of": whole.name},
        inputs=[folder / "plan.json" for folder in folders],
    )
    run_stage(workspace, stage, lambda part: write_json(part / "plan.json", whole.to_json()))


def _with_lines(first: Plan, second: Plan) -> Plan:
    count = len(first.lines)
    dives = tuple(
        replace(
            dive,
            first_line=dive.first_line + count,
            last_line=dive.last_line + count,
            route=Route(
                legs=tuple(
                    replace(leg, line=leg.line + count if leg.line >= 0 else -1)
                    for leg in dive.route.legs
                )
            ),
        )
        for dive in second.dives
    )
    return replace(
        first,
        lines=first.lines + second.lines,
        dives=first.dives + dives,
        line_depths_m=(),
        length_m=first.length_m + second.length_m,
        duration_s=first.duration_s + second.duration_s,
        energy_wh=first.energy_wh + second.energy_wh,
    )
