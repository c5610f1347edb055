"""All exports of a plan: missions that vehicles load, and files that people look at."""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import EXPORTS, atomic_path, read_stage, renew_outputs
from alice_survey.core.config import SurveyConfig, parse_config
from alice_survey.core.errors import PlanError, note, warn
from alice_survey.core.run import progress
from alice_survey.kit.words import count
from alice_survey.sim.vehicle.pilot.mission import MIN_RADIUS_M, MIN_SPEED_MPS, Cola2Settings
from camera_calib.rig import Rig, design_rig
from missions.exports.follower import cola2_settings, expected_m, off_lines_m
from missions.exports.format import Export, ExportFormat, Options, line_tolerance_m, options_of
from missions.exports.registry import format_named, format_names, read_mission
from missions.values.plan_file import Plan, read_plan

SUMS = "SHA256SUMS"
"""File with the digests of the others, as `sha256sum --check` reads it."""


@progress.step("write missions for vehicles")
def write_exports(
    folder: Path,
    plan: Plan,
    rig: Rig,
    *,
    formats: Sequence[str] | None = None,
    options: Options | None = None,
) -> dict[Path, str]:
    """Write a plan in the formats of vehicles, planners and maps.

    What a vehicle flies is one file a dive (`mission_dive1.xml`), what is looked at is one file.

    Args:
        folder: where to; made when missing.
        plan: the plan.
        rig: its cameras on the vehicle.
        formats: names of formats; None for all.
        options: what vehicles need besides the plan.

    Returns:
        The files, in order, and what each is in words.

    Raises:
        PlanError: a format is not known, the plan's depths do not fit its lines, or a chosen format
            is flown and comes too near the sea floor. Where all formats are written, such ones are
            left out with a warning.
    """
    names = format_names() if formats is None else list(formats)
    chosen = {name: format_named(name) for name in names}
    flown = [name for name, each in chosen.items() if each.is_flown]
    refusals = {name: why for name in flown if (why := depth_refusal(plan, name))}
    if refusals and formats is not None:
        raise PlanError(next(iter(refusals.values())))
    export = Export(plan=plan, rig=rig, options=options or Options())
    folder.mkdir(parents=True, exist_ok=True)
    files: dict[Path, str] = {}
    for name, each in chosen.items():
        if name in refusals:
            _remove(folder, each)
        else:
            files |= each.write(folder, export)
    about = folder / "about.txt"
    files[about] = "what the files hold, and how"
    files[folder / SUMS] = "digests of the others, for sha256sum --check"
    written = set(names) - refusals.keys()
    notes = _cola2(export, files, chosen=formats is not None) if "cola2" in written else []
    notes += _ardusub(export) if {"wpl", "qgc"} & written else []
    for refusal in dict.fromkeys(refusals.values()):
        warn(f"missions are left out: {refusal}")
        notes.append(f"Missions are left out: {refusal}.")
    if plan.is_flown_by_depth and len(refusals) < len(flown):
        notes.append(
            "Missions keep depths, not an altitude: their least clearance over the bathymetry is "
            f"{plan.clearance_by_depth_m[0]:.2f} m. Check the tide, and the datum of the depths."
        )
    _write_about(about, export, files, notes)
    _write_sums(folder, files)
    return files


def _write_sums(folder: Path, files: Iterable[Path]) -> None:
    """Write the digests of files, and keep those of others that are still there."""
    sums = {name: old for name, old in _sums(folder).items() if (folder / name).is_file()}
    sums |= {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in files if f.name != SUMS}
    with atomic_path(folder / SUMS) as path:
        path.write_text("".join(f"{sums[name]}  {name}\n" for name in sorted(sums)))


def _sums(folder: Path) -> dict[str, str]:
    try:
        lines = (folder / SUMS).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    pairs = (line.partition("  ") for line in lines)
    return {name: digest for digest, _, name in pairs if name}


def check_exported(mission: Path) -> None:
    """Check that a mission is as it was exported, where digests lie beside it.

    Raises:
        PlanError: it was edited or damaged.
    """
    digest = _sums(mission.parent).get(mission.name)
    if digest and mission.is_file():
        with mission.open("rb") as file:
            same = hashlib.file_digest(file, "sha256").hexdigest() == digest
        if not same:
            raise PlanError(
                f"{mission}: is not as it was exported: it was edited or is damaged. Export it "
                "again with 'alice-survey plan export', or fly it as it is with --edited"
            )


def depth_refusal(plan: Plan, name: str) -> str:
    """Why a plan may not be flown over its bathymetry in a format; empty where it may."""
    min_m, allowed_m = plan.clearance_by_depth_m
    what = "between lines, missions for COLA2, WPL and QGroundControl would have"
    if name == "cola2" and min_m >= allowed_m:
        min_m = plan.cola2_clearance_m
        what = "held off its lines by the expected current, a mission for COLA2 would have"
    if not plan.is_flown_by_depth or min_m >= allowed_m:
        return ""
    clearance = "an unknown clearance" if math.isnan(min_m) else f"{min_m:.2f} m of clearance"
    return (
        f"{what} {clearance} over the bathymetry, less than plan.least_clearance_m "
        f"{allowed_m:g}: leave the steep part out of the area, move plan.home_ne_m, or turn the "
        "lines along the slope (plan.line_heading_deg)"
    )


def _remove(folder: Path, left_out: ExportFormat) -> None:
    """Remove files of an earlier plan, which nobody may load for this one."""
    for file in left_out.files:
        for path in folder.glob(file.name.format("*")):
            path.unlink()


def export_report(
    plan_path: Path,
    formats: Sequence[str] | None = None,
    out: Path | None = None,
    *,
    camera_on: str | None = None,
    camera_off: str | None = None,
) -> tuple[str, dict[str, Any]]:
    """`alice-survey plan export`: write a finished plan in the formats of vehicles and maps.

    Args:
        plan_path: `plan.json`, or the folder that holds it.
        formats: names of formats; None for all.
        out: folder to write to; None for `exports` next to the plan.
        camera_on: COLA2's service that starts pictures; None for the default of `Options`.
        camera_off: the one that stops them.

    Returns:
        What to print, and the same as JSON values.

    Raises:
        PlanError: the file is not a plan, or a format is not known.
    """
    path = plan_path / "plan.json" if plan_path.is_dir() else plan_path
    plan = read_plan(path)
    survey = _config_of_plan(path)
    rig = design_rig(survey.camera, survey.water)
    given: dict[str, Any] = {"camera_on": camera_on, "camera_off": camera_off}
    options = replace(
        options_of(survey.camera, survey.plan, survey.vehicle, survey.sea),
        **{name: service for name, service in given.items() if service is not None},
    )
    folder = path.parent / EXPORTS if out is None else out
    files = write_exports(folder, plan, rig, formats=formats, options=options)
    if folder.parent == path.parent:
        renew_outputs(path.parent, files)
    tolerance_m = line_tolerance_m(plan, rig)
    text = "\n".join(
        [
            f"{folder}: {count(len(files), 'file')} of {count(plan.stations, 'station')} "
            f"in {count(len(plan.dives), 'dive')}, tolerance {tolerance_m:.3f} m",
            *(f"  {file.name:<24}{file.stat().st_size / 1000:>9.1f} kB" for file in files),
        ]
    )
    about = {
        "folder": str(folder),
        "tolerance_m": tolerance_m,
        "files": [{"name": file.name, "bytes": file.stat().st_size} for file in files],
    }
    return text, about


def _write_about(
    path: Path, export: Export, files: Mapping[Path, str], advice: Sequence[str]
) -> None:
    """What the files are, of which point of the vehicle, and what to set on it."""
    plan, options = export.plan, export.options
    text = [
        f"{plan.name}: plan of {count(len(plan.lines), 'line')}, "
        f"{count(plan.stations, 'station')}, {count(len(plan.dives), 'dive')}",
        "",
        f"Missions (.xml, .plan, .waypoints): {export.mount.about}",
        "Maps and tables (.kml, .gpx, .geojson, .csv): places are of the left port's glass; "
        "waypoints.csv has both.",
        f"Tolerance at the ends of lines: {export.tolerance_m:.3f} m; for COLA2 "
        f"{export.cola2_tolerance_m:.3f} m.",
        f"COLA2 actions: {options.camera_on} starts pictures, {options.camera_off} stops "
        "them: name them as your vehicle does.",
        *advice,
        "",
        *(f"{file.name}: {about}" for file, about in files.items() if file != path),
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(text) + "\n", encoding="utf-8", newline="\n")


def _config_of_plan(path: Path) -> SurveyConfig:
    """Camera, water, limits, vehicle and sea that a plan was made with."""
    stage = read_stage(path.parent)
    settings = {} if stage is None else stage.settings
    names = ("camera", "water", "plan", "vehicle", "sea")
    known = {name: settings[name] for name in names if isinstance(settings.get(name), dict)}
    if stage is None or not {"camera", "water"} <= known.keys():
        raise PlanError(
            f"{path}: is not in a finished plan folder, so that where the camera sits on the "
            "vehicle is not known: give the survey's settings too"
        )
    # Settings name files alone, inputs by their way from the workspace.
    files = {Path(file).name: str(path.parent / ".." / file) for file in stage.inputs}
    vehicle = known.get("vehicle", {}).items()
    known["vehicle"] = {key: files.get(str(value), value) for key, value in vehicle}
    return parse_config(known, str(path.parent))


def _cola2(export: Export, files: Iterable[Path], *, chosen: bool) -> list[str]:
    """Parameters to set, and what is to be expected in the current.

    Warns where COLA2 cannot hold the plan's lines in it, if formats were chosen or the vehicle has
    no sway: others are flown by what holds them better.
    """
    plan, follower = export.plan, export.options.follower
    if follower is None:
        return []
    if not math.isfinite(follower.delta_m):
        return [f"COLA2: no section/delta keeps {follower.name} from weaving: lower the speed."]
    own, default = cola2_settings(follower.delta_m, plan.speed_mps), Cola2Settings()
    lever_m, allowed_m = export.mount.glass_body_m[0], plan.allowed_offset_m
    flown = [
        expected_m(follower, plan, lever_m, read_mission(path))
        for path in files
        if path.suffix == ".xml"
    ]
    start_m = max((off_m.max() for off_m, _ in flown), default=0.0)
    outside_m = max((outside_m for _, outside_m in flown), default=0.0)
    expected = (
        f"in the expected current of {follower.current_mps:g} m/s and its gusts COLA2 brings "
        f"{follower.name} onto lines from up to about {start_m:.2f} m and then keeps within "
        f"{off_lines_m(follower, plan, lever_m).max():.2f} m of them; they are "
        f"{plan.line_spacing_m:.2f} m apart, which allows {allowed_m:.2f} m"
    )
    if outside_m >= 0.005:
        expected += f"; in turns it leaves the allowed area by up to {outside_m:.2f} m"
    steady_m = off_lines_m(replace(follower, gust_mps=0.0), plan, lever_m)
    parallel = [line.kind in ("survey", "fill") for line in plan.lines]
    # Beyond half of its speed, and on wide circles, turns leave more of the area unseen.
    exceeds = (
        steady_m[parallel].max(initial=0.0) > allowed_m
        or follower.current_mps > 0.5 * plan.speed_mps
    )
    exceeds |= follower.circle_m > 0.5 * plan.line_spacing_m
    if exceeds and (chosen or not follower.sways):
        towards_deg = math.degrees(math.atan2(*follower.current_ne_mps[::-1])) % 180.0
        along = f"lay lines along the current (line_heading_deg = {towards_deg:.0f})"
        ways = [along, "wait for less of it"] if follower.current_mps else []
        ways += ["fly another autopilot's mission"] if follower.sways else []
        warn(f"{expected}: {', or '.join(ways)}" if ways else expected)
    elif chosen or not follower.sways:
        note(expected)
    return [
        "COLA2 pilot parameters:",
        f"  section/delta {own.delta_m:.1f} m (default {default.delta_m:g})",
        f"  section/tolerance_z {own.tolerance_z_m:g} m (default {default.tolerance_z_m:g})",
        f"  section/min_surge_velocity {own.min_surge_mps:g} m/s",
        f"  section/max_surge_velocity {own.max_surge_mps:g} m/s",
        f"{expected[0].upper()}{expected[1:]}.",
    ]


def _ardusub(export: Export) -> list[str]:
    plan, follower = export.plan, export.options.follower
    radius_cm = math.ceil(100.0 * max(export.tolerance_m, MIN_RADIUS_M))
    lines = [
        "ArduSub 4.5 parameters:",
        f"  WPNAV_SPEED {100.0 * plan.speed_mps:.0f} cm/s",
        f"  WPNAV_RADIUS {radius_cm} cm (the radii of files are ignored)",
        "  WP_YAW_BEHAVIOR 4 (default) or 1",
        f"  WPNAV_RFND_USE {int(not plan.is_flown_by_depth)}",
    ]
    if plan.speed_mps < MIN_SPEED_MPS:
        lines.append(f"ArduSub flies {MIN_SPEED_MPS:g} m/s or faster: plan at that speed.")
    if follower is not None and not follower.sways:
        lines.append(f"ArduSub needs thrusters sideways, which {follower.name} does not have.")
    return lines
