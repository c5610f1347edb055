"""The whole loop: which stages run, their results, and the state of a workspace."""

import contextlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from alice_survey.app import stages as survey_stages
from alice_survey.app.stages import finished_stages, names, spec
from alice_survey.core.artefacts import damage, read_json, read_stage, refuse_links, stage_command
from alice_survey.core.config import (
    Config,
    SurveyConfig,
    change_section,
    load_config,
    parse_config,
    settings_in,
)
from alice_survey.core.errors import ConfigError, WorkspaceError, file_faults, offer, warn
from alice_survey.core.executor import Executor, local_executor
from alice_survey.core.run import progress
from alice_survey.core.settings_form import settings_template
from alice_survey.core.stages import StageSpec, is_imported
from alice_survey.kit.words import digits

if TYPE_CHECKING:
    from alice_survey.core.settings_text import Values


def run(
    stages: Sequence[str],
    workspace: Path,
    survey: Path | None,
    executor: Executor | None = None,
    changes: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    edited_mission: bool = False,
    stops: bool = False,
    say: Callable[[str, Path], object] = lambda text, folder: None,
) -> tuple[str, dict[str, Any]]:
    """Run stages one after the other; those that are up to date are skipped.

    Args:
        stages: names in order.
        workspace: folder of the survey.
        survey: settings file; None looks for survey.toml in the workspace, then here.
        executor: where tasks run; None for all cores of this machine.
        changes: settings by section for this run alone; those that are None stay as they are.
        edited_mission: fly a mission that was edited since it was exported.
        stops: end after a stage whose result is not good enough.
        say: takes the text of a result and the unfinished folder, before figures are drawn.

    Returns:
        Results of each stage, as text and as JSON values.
    """
    stages = [spec(stage).name for stage in stages]
    imported = is_imported(workspace)
    config = as_written = settings(workspace, survey, needed=not imported)
    for section, values in (changes or {}).items():
        config = change_section(config, section, **values)
        if getattr(config, section) != getattr(as_written, section):
            given = {key: value for key, value in values.items() if value is not None}
            words = ", ".join(
                f"{k} = {json.dumps(value, default=str)}" for k, value in given.items()
            )
            warn(
                f"{words} holds for this run alone, and the next without it makes what depends on "
                f"it again: to keep it, put it below [{section}] in survey.toml"
            )
    if imported:
        if len(stages) > 1:  # a rig of real pictures comes with them
            stages = [stage for stage in stages if stage != "calibrate"]
        for stage in map(spec, stages):
            if stage.simulated:
                raise WorkspaceError(
                    f"{workspace} holds imported pictures; '{stage.command}' is for simulated "
                    "surveys: choose another workspace with -w"
                )
    from alice_survey.app.computing import task_memory_mib

    if "placing" in stages and (control := workspace / "control.csv").is_file():
        from alice_survey.core.errors import collected_by
        from reconstruct.placing.control_points import read_control

        with collected_by(lambda *_: None):  # the stage warns
            read_control(control)

    def say_result(stage: StageSpec, folder: Path) -> None:
        text = stage.summary(folder)[0].replace(str(folder), str(workspace / stage.folder))
        say(f"{stage.name}: {text}", folder)

    lines, found = [], {}
    executor = executor or local_executor()
    with only_one(workspace):
        if "fly" in stages and "plan" not in stages:
            vehicle = (changes or {}).get("vehicle", {})  # what a plan may have been made with
            alike = [as_written, change_section(as_written, "vehicle", name=vehicle.get("name"))]
            steered = {"controller": vehicle.get("controller")}
            alike.append(change_section(alike[1], "vehicle", **steered))
            states = [spec("plan").state(workspace, one, {}) for one in alike]
            if all(state.startswith("stale") for state in states):
                again = stage_command("plan", workspace)
                warn(f"the plan is {states[0]}; {again!r} renews it")
        for number, stage in enumerate(map(spec, stages), 1):
            with progress.part(stage.folder, number, len(stages)):
                flies = stage.name == "fly" and not edited_mission
                mission = config.vehicle.mission_file if flies else None
                if mission is not None and stage.state(workspace, config, {}) != "up to date":
                    from missions.exports.write import check_exported

                    check_exported(mission)
                for needed in stage.needs:
                    spec(needed).need(workspace)
                task_mib = task_memory_mib(
                    stage.name, workspace, config.camera, config.imaging, config.reconstruct
                )
                executor = replace(executor, task_mib=task_mib)
                done = stage.make(workspace, config, executor, partial(say_result, stage))
            text, data = stage.summary(workspace / stage.folder)
            found[stage.name] = {"done": done, **data}
            lines.append(f"{stage.name}: {text}" if done else f"{stage.name}: (up to date) {text}")
            shortfall = stage.shortfall(workspace / stage.folder)
            if shortfall:
                found[stage.name]["shortfall"] = shortfall
                warn(f"{stage.name}: {shortfall}")
            if shortfall and stops:
                lines.append(f"stopped after {stage.name}; --accept goes on from what it made")
                break
    return "\n".join(lines), found


def plan_report(
    workspace: Path,
    survey: Path | None,
    *,
    every_setting: bool = False,
    vehicle: str | None = None,
    say: Callable[[str], object] = lambda text: None,
) -> tuple[str, dict[str, Any]]:
    """Plan a survey, and show its main settings; or every one with its equation and limit.

    A vehicle by name or file counts for this plan instead of the survey's.

    What imaging and reconstruction will take on this machine follows. `say` takes what comes
    before it as soon as the plan is known.
    """
    from alice_survey.app.computing import GROUPS
    from missions.plan.rows import main_settings

    def with_settings(text: str, folder: Path) -> str:
        if every_setting:
            table = (folder / "settings.txt").read_text(encoding="utf-8")
        else:
            table = main_settings(read_json(folder / "plan.json"))
        return f"{table}\n{text}"

    text, found = run(
        ["plan"], workspace, survey, changes={"vehicle": {"name": vehicle}},
        say=lambda text, folder: say(with_settings(text, folder)),
    )  # fmt: skip
    cost, found["cost"] = _predict_cost(workspace, survey, GROUPS)
    return f"{with_settings(text, workspace / 'plan')}\n{cost}", found


def _predict_cost(
    workspace: Path,
    survey: Path | None,
    groups: Mapping[str, Sequence[str]],
    workers: int | None = None,
    done: Sequence[str] = (),
) -> tuple[str, dict[str, Any]]:
    """What groups of stages of a workspace will take; the stages that are done correct it."""
    from alice_survey.app.computing import summary, workspace_size

    config = settings(workspace, survey, needed=not is_imported(workspace))
    size = workspace_size(workspace, config.camera, config.imaging, config.reconstruct)
    if size is None:
        return "", {}
    records = {name: read_stage(workspace / spec(name).folder) for name in done}
    made = {name: record for name, record in records.items() if record is not None}
    return summary(size, groups, workers=workers, records=made)


def settings(workspace: Path, survey: Path | None, *, needed: bool) -> SurveyConfig:
    """The settings of a workspace.

    Args:
        workspace: folder of the survey.
        survey: the file; None looks for survey.toml in the workspace, then here.
        needed: whether there must be one.

    Raises:
        ConfigError: the file is wrong, or none is there though it is needed.
    """
    for path in (workspace / "survey.toml", Path("survey.toml")) if survey is None else (survey,):
        if path.is_file() or survey is not None:
            return load_config(path)
    if not needed:
        return SurveyConfig()
    begin, real = offer("init", workspace), stage_command("import-images", workspace)
    if (workspace / "images.partial").exists():
        raise ConfigError(f"an import into {workspace} has not finished: do it again, {real!r}")
    from reconstruct.pictures.files import kind_of

    if any(map(kind_of, workspace.glob("*.*"))):
        real = offer("reconstruct", workspace, "-o", "dive")
    raise ConfigError(
        f"no survey.toml in {workspace} or here: {begin!r} writes one, and {real!r} makes a survey "
        "of pictures"
    )


def init_survey(
    folder: Path,
    template: str = "survey.toml",
    area: Path | None = None,
    *,
    name: str | None = None,
    values: "Values | None" = None,
    say: Callable[[str], object] = lambda text: None,
) -> Path:
    """Write a commented settings file, never over one that is there.

    Args:
        folder: where to.
        template: which.
        area: a file with the area to survey instead of the template's.
        name: of the survey.
        values: settings instead of the template's.
        say: takes where the area of a file lies.

    Raises:
        WorkspaceError: the file exists, or the folder cannot be written.
        ConfigError: a value is not one that a survey may have.
        PlanError: the file holds no area that can be surveyed.
    """
    path = folder / "survey.toml"
    refuse_links(folder, path)
    if path.exists():
        raise WorkspaceError(f"{path} exists already; edit it, or remove it first")
    from alice_survey.core.settings_text import with_settings_changed

    text = template_text(template)
    if name is not None:
        line = f"name = {json.dumps(name)}"  # the first, before all sections
        text = re.sub(r'^name = ".*"', lambda _: line, text, count=1, flags=re.M)
    if area is not None:
        rectangle = ("latitude_deg", "longitude_deg", "length_m", "width_m", "heading_deg")
        named = Path(os.path.relpath(area.resolve(), folder.resolve())).as_posix()
        values = dict(values or {})
        values["area"] = dict.fromkeys(rectangle, None) | {"file": named, **values.get("area", {})}
    if values:
        text = with_settings_changed(text, values)
    config = parse_config(settings_in(text, "the new survey"), "the new survey")
    if area is not None:
        from missions.areas.survey import given_shapes, survey_area

        shapes = config.area.model_copy(update={"file": area})
        found = survey_area(shapes, turn_margin_m=3.0)
        strips = f" in strips of {shapes.corridor_width_m:g} m along lines (area.corridor_width_m)"
        along = strips if given_shapes(shapes).survey.lines else ""
        say(f"area: {found.datum.place}, {digits(found.survey.area)} m2{along}")
    with file_faults(path, WorkspaceError, "written"):
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return path


def template_text(template: str = "survey.toml") -> str:
    """The commented settings that a new survey starts from: of all settings, or of an example."""
    if template == "survey.toml":
        return settings_template()
    return (resources.files("alice_survey") / template).read_text(encoding="utf-8")


def run_demo(workspace: Path, executor: Executor | None) -> tuple[str, dict[str, Any]]:
    """Run the whole loop on the built-in survey, and say where its report is."""
    if not (workspace / "survey.toml").exists():
        init_survey(workspace, "demo.toml")
    text, found = run(names(), workspace, None, executor)
    return f"{text}\n\nAll of it: {workspace / 'report' / 'report.html'}", found


def stage_states(workspace: Path, config: Config, *, verify: bool = False) -> dict[str, str]:
    """State of each stage that the survey of a workspace has, as `StageSpec.state` gives it.

    Args:
        workspace: folder of the survey.
        config: its settings.
        verify: read every file that the stages wrote.
    """
    if verify:
        for folder, record in finished_stages(workspace).items():
            with progress.step(f"read {folder}"):  # what differs has a new time from then on
                damage(workspace / folder, record, entirely=True)
    imported = is_imported(workspace)
    states: dict[str, str] = {}
    for stage in survey_stages.STAGES:
        if not (imported and stage.simulated and stage.name != "image"):
            states[stage.name] = stage.state(workspace, config, states)
    return states


def workspace_status(
    workspace: Path, survey: Path | None, *, verify: bool = False
) -> tuple[str, dict[str, Any]]:
    """State of a workspace, stage by stage, and the next command."""
    if not workspace.is_dir():
        begin = offer("init", workspace)
        raise WorkspaceError(f"{workspace}: no such folder; {begin!r} makes one")
    imported = is_imported(workspace)
    config = settings(workspace, survey, needed=not imported)
    states = stage_states(workspace, config, verify=verify)
    rows = []
    for stage in map(spec, states):
        record = read_stage(workspace / stage.folder)
        took = f"{record.took_s:8.1f} s" if record else " " * 10
        rows.append(f"{stage.name:10} {stage.folder + '/':13} {states[stage.name]:32} {took}")
    pending = [name for name, state in states.items() if state != "up to date"]
    command = stage_command(spec(pending[0]).command, workspace) if pending else None
    after = f"next: {command}" if command else "nothing is left to do"
    return "\n".join([*rows, after]), {"stages": states, "next": command}


def status_report(
    workspace: Path, survey: Path | None, workers: int | None = None, *, verify: bool = False
) -> tuple[str, dict[str, Any]]:
    """State of a workspace, and what the stages that are left will take.

    Args:
        workspace: folder of the survey.
        survey: its settings; None looks for survey.toml in the workspace, then here.
        workers: of a cluster that does them; None for all cores of this machine.
        verify: read every file that the stages wrote.
    """
    from alice_survey.app.computing import PREDICTED

    text, found = workspace_status(workspace, survey, verify=verify)
    states = found["stages"]
    left = [name for name in PREDICTED if states.get(name, "up to date") != "up to date"]
    if not left:
        return text, found
    done = [name for name, state in states.items() if state == "up to date"]
    cost, found["cost"] = _predict_cost(workspace, survey, {"left": left}, workers, done)
    return "\n".join(filter(None, (text, cost))), found


def is_locked(workspace: Path) -> bool:
    """Whether a command is working in a workspace now."""
    lock = workspace / ".lock"
    if not lock.is_file():
        return False
    try:
        with FileLock(lock, timeout=0):
            return False
    except Timeout:
        return True
    except OSError:  # of a workspace that cannot be written, where nothing works either
        return False


@contextlib.contextmanager
def only_one(workspace: Path) -> Iterator[None]:
    """Lock the workspace so that no second run writes into it."""
    refuse_links(workspace, workspace / ".lock")
    lock = FileLock(workspace / ".lock", timeout=0)
    is_new = not workspace.exists()
    with file_faults(workspace, WorkspaceError, "written"):
        workspace.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            raise WorkspaceError(f"another command is working in {workspace}") from None
    try:
        yield
    finally:
        if is_new and list(workspace.iterdir()) == [workspace / ".lock"]:  # nothing came of it
            Path(lock.lock_file).unlink()
            workspace.rmdir()
        lock.release()
