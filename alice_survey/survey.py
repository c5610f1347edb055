"""The whole loop: which stages there are, in which order, and what each has found."""

import contextlib
import fcntl
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from alice_survey.base.artefacts import STAGE_FILE, only_checking, read_json, read_stage
from alice_survey.base.config import SurveyConfig, changed, load_config, parse_current, parse_health
from alice_survey.base.contents import taken_from
from alice_survey.base.errors import AliceError, ConfigError, WorkspaceError, warn
from alice_survey.base.executor import SERIAL, Executor, local_executor
from alice_survey.base.run.progress import part
from alice_survey.summaries import SUMMARIES

RECONSTRUCT = ("calibration", "sparse", "dense", "mosaic", "mesh")
LOOP = ("plan", "flight", "pool", "images", *RECONSTRUCT, "evaluation", "report")
_NEEDS = {
    "plan": (),
    "flight": ("plan",),
    "pool": (),
    "images": ("plan", "flight"),
    "calibration": ("pool",),
    "sparse": ("images", "calibration"),
    "dense": ("sparse",),
    "mosaic": ("dense",),
    "mesh": ("dense",),
    "evaluation": ("mosaic", "mesh"),
    "report": ("mosaic", "mesh", "evaluation"),
}
_COMMANDS = {
    "plan": "plan",
    "flight": "fly",
    "pool": "image",
    "images": "image",
    "calibration": "calibrate",
    "sparse": "reconstruct",
    "dense": "reconstruct",
    "mosaic": "reconstruct",
    "mesh": "reconstruct",
    "evaluation": "evaluate",
    "report": "report",
}
_SIMULATED = ("plan", "flight", "pool", "images", "calibration", "evaluation")


@dataclass(frozen=True, kw_only=True)
class FlightChanges:
    """What a command line may change of a flight; None leaves the setting."""

    vehicle: str | None = None
    controller: str | None = None
    current: str | None = None
    """SPEED@DIRECTION."""
    failed: Sequence[str] | None = None
    """NAME of a thruster that has failed, or NAME=SHARE that is left of it."""
    dive: int | None = None
    """The one to fly, from 1 on."""

    def applied(self, config: SurveyConfig) -> SurveyConfig:
        """The survey with these changes.

        Raises:
            ConfigError: a value is not allowed.
        """
        speed, towards = parse_current(self.current)
        if self.current is not None:  # instead of a measured one
            sea = config.sea.model_copy(update={"current_file": None})
            config = config.model_copy(update={"sea": sea})
        config = changed(config, "sea", current_mps=speed, current_towards_deg=towards)
        return changed(
            config, "vehicle",
            name=self.vehicle, controller=self.controller,
            thruster_health=parse_health(self.failed), dive=self.dive,
        )  # fmt: skip


StageWork = Callable[[Path, SurveyConfig, Executor], bool]


def _work_of(stage: str) -> StageWork:
    """The function that does a stage; its packages are loaded only now."""
    match stage:
        case "plan":
            from missions.plan.run import run_plan

            return run_plan
        case "flight":
            from missions.fly.run import run_fly

            return run_fly
        case "pool":
            from missions.acquire.run import run_pool

            return run_pool
        case "images":
            from missions.acquire.run import run_images

            return run_images
        case "calibration":
            from camera_calib.calibrate.run import run_calibrate

            return run_calibrate
        case "sparse":
            from reconstruct.placing.run import run_sparse

            return run_sparse
        case "dense":
            from reconstruct.dense.run import run_dense

            return run_dense
        case "mosaic":
            from reconstruct.mosaic.run import run_mosaic

            return run_mosaic
        case "mesh":
            from reconstruct.mesh.run import run_mesh

            return run_mesh
        case "evaluation":
            from reconstruct.evaluate.run import run_evaluate

            return run_evaluate
        case "report":
            from alice_survey.report.run import run_report

            return run_report
        case _:
            raise ValueError(stage)


def run(
    stages: Sequence[str],
    workspace: Path,
    survey: Path | None,
    scale: int | None = None,
    executor: Executor | None = None,
    flight: FlightChanges | None = None,
) -> tuple[str, dict[str, Any]]:
    """Do stages one after the other; those that are up to date are skipped.

    Args:
        stages: names in order.
        workspace: folder of the survey.
        survey: settings file; None looks for survey.toml in the workspace, then here.
        scale: overrides `imaging.scale`.
        executor: where tasks run; None for all cores of this machine.
        flight: overrides vehicle and sea.

    Returns:
        What each stage has found, as text and as JSON values.
    """
    imported = is_imported(workspace)
    config = settings(workspace, survey, needed=not imported)
    planned = config = changed(config, "imaging", scale=scale)
    if flight is not None and flight != FlightChanges():
        config = flight.applied(config)
        warn("these options hold for this flight alone: to keep them, put them into survey.toml")
    if imported:
        stages = [stage for stage in stages if stage != "calibration"]
        for stage in stages:
            if stage in _SIMULATED:
                raise WorkspaceError(
                    f"{workspace} holds imported pictures; '{_COMMANDS[stage]}' is for simulated "
                    "surveys: choose another workspace with -w"
                )
    lines, found = [], {}
    with _only_one(workspace):
        if "flight" in stages and "plan" not in stages:
            state = _state(workspace, "plan", planned, {}, imported)
            if state.startswith("stale"):
                warn(f"the plan is {state}; 'alice-survey plan -w {workspace}' renews it")
        for number, stage in enumerate(stages, 1):
            with part(stage, number, len(stages)):
                done = _work_of(stage)(workspace, config, executor or local_executor())
            with taken_from(workspace / stage):
                text, data = SUMMARIES[stage](workspace / stage)
            found[stage] = {"done": done, **data}
            lines.append(f"{stage}: {text}" if done else f"{stage}: (up to date) {text}")
    return "\n".join(lines), found


def plan_report(
    workspace: Path, survey: Path | None, *, every_setting: bool = False
) -> tuple[str, dict[str, Any]]:
    """Plan a survey, and show its main settings; or every one with its equation and source."""
    from missions.plan.rows import main_settings

    text, found = run(["plan"], workspace, survey)
    folder = workspace / "plan"
    if every_setting:
        table = (folder / "settings.txt").read_text(encoding="utf-8")
    else:
        table = main_settings(read_json(folder / "plan.json"))
    return f"{table}\n{text}", found


def settings(workspace: Path, survey: Path | None, *, needed: bool) -> SurveyConfig:
    """The settings of a workspace.

    Raises:
        ConfigError: the file is wrong, or none is there though it is needed.
    """
    if survey is not None:
        return load_config(survey)
    for path in (workspace / "survey.toml", Path("survey.toml")):
        if path.is_file():
            return load_config(path)
    if needed:
        raise ConfigError(
            f"no survey.toml in {workspace} or here: 'alice-survey init {workspace}' writes one"
        )
    return SurveyConfig()


def is_imported(workspace: Path) -> bool:
    """Whether the pictures of a workspace are real ones."""
    path = workspace / "images" / "survey.json"
    if not path.is_file():
        return False
    with taken_from(path):
        return bool(read_json(path).get("source") == "imported")


def init_survey(folder: Path, template: str = "survey.toml", area: Path | None = None) -> Path:
    """Write a commented settings file, never over one that is there.

    Args:
        folder: where to.
        template: which.
        area: a file with the area to survey instead of the template's.

    Raises:
        WorkspaceError: the file exists, the folder cannot be written, or the area is missing.
    """
    if area is not None and not area.is_file():
        raise WorkspaceError(f"{area}: no such file")
    path = folder / "survey.toml"
    if path.exists():
        raise WorkspaceError(f"{path} exists already; edit it, or remove it first")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        text = (resources.files("alice_survey") / template).read_text(encoding="utf-8")
        path.write_text(text if area is None else _with_area(text, area), encoding="utf-8")
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def _with_area(text: str, area: Path) -> str:
    """Settings whose rectangle is replaced by the area of a file."""
    rectangle = ("latitude_deg", "longitude_deg", "length_m", "width_m", "heading_deg", "datum_at")
    own = re.compile(rf"^(?=({'|'.join(rectangle)}) = )", re.MULTILINE)
    named = json.dumps(str(area.resolve()))
    return re.sub(
        r"^# file = .*$", lambda _: f"file = {named}", own.sub("# ", text), count=1, flags=re.M
    )


def run_demo(workspace: Path, executor: Executor | None) -> tuple[str, dict[str, Any]]:
    """Do the whole loop on the built-in survey, and say where its pictures are."""
    if not (workspace / "survey.toml").exists():
        init_survey(workspace, "demo.toml")
    text, found = run(LOOP, workspace, None, None, executor)
    pictures = [
        ("the plan", "plan/map.png"),
        ("a picture", "images/left/000000.png"),
        ("the surface", "dense/dem.png"),
        ("the mosaic", "mosaic/mosaic.png"),
        ("the mesh", "mesh/mesh.png"),
        ("the errors", "evaluation/errors.png"),
        ("the track", "evaluation/track.png"),
    ]
    rows = [f"  {what:12} {workspace / path}" for what, path in pictures]
    page = f"  {'all of it':12} {workspace / 'report' / 'report.html'}"
    return "\n".join([text, "", "To look at:", *rows, page]), found


def workspace_status(workspace: Path, survey: Path | None) -> tuple[str, dict[str, Any]]:
    """What a workspace holds, stage by stage, and the next command."""
    if not workspace.is_dir():
        raise WorkspaceError(f"{workspace}: no such folder; 'alice-survey init' makes one")
    imported = is_imported(workspace)
    config = settings(workspace, survey, needed=not imported)
    states: dict[str, str] = {}
    for stage in LOOP:
        if imported and stage in _SIMULATED and stage != "images":
            continue
        states[stage] = _state(workspace, stage, config, states, imported)
    pending = [stage for stage, state in states.items() if state != "up to date"]
    command = f"alice-survey {_COMMANDS[pending[0]]} -w {workspace}" if pending else None
    rows = []
    for stage, state in states.items():
        record = read_stage(workspace / stage)
        with taken_from(workspace / stage / STAGE_FILE):
            took = f"{float(record['took_s']):8.1f} s" if record else " " * 10
        rows.append(f"{stage:12} {state:32} {took}")
    after = f"next: {command}" if command else "nothing is left to do"
    return "\n".join([*rows, after]), {"stages": states, "next": command}


def _state(
    workspace: Path, stage: str, config: SurveyConfig, before: dict[str, str], imported: bool
) -> str:
    there = read_stage(workspace / stage) is not None
    if not there:
        return "interrupted" if (workspace / f"{stage}.partial").exists() else "missing"
    for need in _NEEDS[stage]:
        if before.get(need, "up to date") != "up to date":
            return f"stale ({need} is {before[need].split()[0]})"
    if imported and stage == "images":
        return "up to date"
    with taken_from(workspace / stage / STAGE_FILE):
        refly = stage == "plan" and "refly_of" in (read_stage(workspace / stage) or {})["settings"]
    if refly:
        return "up to date"  # what was made for the holes of a dive has no settings of its own
    try:
        with only_checking():
            stale = _work_of(stage)(workspace, config, SERIAL)
    except AliceError as error:
        return f"stale ({error})"
    return "stale (settings or inputs changed)" if stale else "up to date"


@contextlib.contextmanager
def _only_one(workspace: Path) -> Iterator[None]:
    """Hold the workspace so that no second run writes into it."""
    try:
        workspace.mkdir(parents=True, exist_ok=True)
        lock = (workspace / ".lock").open("w")
    except OSError as error:
        raise WorkspaceError(f"{workspace} cannot be written: {error.strerror}") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise WorkspaceError(
                f"another command is working in {workspace}; wait for it"
            ) from None
        yield
