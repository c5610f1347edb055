"""The Run tab: the stages, and the job that makes them."""

import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import Field

from alice_survey.app.computing import (
    StageCost,
    correction,
    stage_costs,
    total_cost,
    workspace_size,
)
from alice_survey.app.pipeline import settings, stage_states
from alice_survey.app.stages import spec
from alice_survey.app.studio.endpoints.base import Call, Endpoint, Studio
from alice_survey.app.studio.jobs import OFFERED
from alice_survey.core.artefacts import STAGE_FILE, StageRecord, read_stage
from alice_survey.core.config import Config
from alice_survey.core.errors import AliceError
from alice_survey.core.executor import default_threads
from alice_survey.core.run.resources import processor
from alice_survey.core.stages import StageSpec, is_imported

UP_TO_DATE = "up to date"
_STALE = re.compile(r"stale \((.*)\)", re.DOTALL)
_COMMAND = re.compile(r"""(['"])alice-survey ([a-z][a-z -]*[a-z])( .*?)?\1""")
_NOT_THERE = ("missing", "interrupted")
_SIMULATED = ("run", "plan", "fly", "image", "calibrate", "evaluate")
"""Commands for simulated surveys."""


def survey_state(workspace: Path) -> dict[str, Any]:
    """State of every stage, commands that may be started, and what they would take.

    Args:
        workspace: folder of the survey; it need not exist.

    Returns:
        JSON values; `fault` is the line where settings or pictures cannot be read.
    """
    is_new = not any((workspace / name).exists() for name in ("survey.toml", "images", "plan"))
    found: dict[str, Any] = {
        "new": is_new, "fault": None, "stages": [], "commands": [],
        "disk": {"free_gb": _free_gb(workspace)}, "cores": default_threads(), "imported": False,
    }  # fmt: skip
    if is_new:
        inside = workspace.iterdir() if workspace.is_dir() else ()
        return found | {"others": sum(not path.name.startswith(".") for path in inside)}
    try:
        imported = found["imported"] = is_imported(workspace)
        config = settings(workspace, None, needed=not imported)
        states = stage_states(workspace, config)
        size = workspace_size(workspace, config.camera, config.imaging, config.reconstruct)
        costs = {} if size is None else _costs(workspace, stage_costs(size), states)
    except AliceError as error:
        return found | {"fault": str(error), "ways": ways_on(str(error))}
    found["stages"] = [_stage(workspace, spec(name), state) for name, state in states.items()]
    found["commands"] = _commands(states, costs, imported=imported)
    return found


def ways_on(line: str) -> list[dict[str, Any]]:
    """Commands that a line of a fault names, and whether the studio starts them."""
    found = {}
    for match in _COMMAND.finditer(line):
        words = match[2].split(" -")[0]
        name = next((n for n in (words, words.split()[0]) if n in OFFERED), None)
        found[match[0]] = {
            "command": match[0][1:-1],
            "name": None if name == "import-images" else name,
            "title": "" if name is None else OFFERED[name].title,
        }
    return list(found.values())


def _stage(workspace: Path, stage: StageSpec, state: str) -> dict[str, Any]:
    """One line of the list of stages."""
    folder = workspace / stage.folder
    record = read_stage(folder)
    stale = _STALE.fullmatch(state)
    made = None
    if record is not None:
        made_s = (folder / STAGE_FILE).stat().st_mtime
        made = datetime.fromtimestamp(made_s, UTC).isoformat(timespec="seconds")
    return {
        "name": stage.name, "folder": stage.folder, "command": stage.command,
        "about": stage.about.replace("`", ""),
        "state": "stale" if stale else state, "why": stale[1] if stale else "",
        "made_utc": made,
        "took_s": None if record is None else record.took_s,
        "products": [
            {"path": f"{stage.folder}/{path}", "about": what}
            for path, what in stage.products.items()
            if record is not None and (folder / path).exists()
        ],
    }  # fmt: skip


def _costs(
    workspace: Path, costs: Mapping[str, StageCost], states: Mapping[str, str]
) -> dict[str, StageCost]:
    """Costs of stages as those that ran here correct them; none where nothing is left."""
    if all(state == UP_TO_DATE for state in states.values()):
        return {}
    done: dict[str, StageRecord] = {}
    for name, state in states.items():
        record = read_stage(workspace / spec(name).folder)
        if state == UP_TO_DATE and record is not None:
            done[name] = record
    _, factor, _ = correction(costs, done, processor())
    return {name: cost.scale(factor) for name, cost in costs.items()}


def _commands(
    states: Mapping[str, str], costs: Mapping[str, StageCost], *, imported: bool
) -> list[dict[str, Any]]:
    """Commands that make stages, in order, and what each has left to do."""
    found = []
    for name, command in OFFERED.items():
        made = command.stages()
        if not made or (imported and name in _SIMULATED):
            continue
        left = [s for s in made if states.get(s, UP_TO_DATE) != UP_TO_DATE]
        known = [costs[stage] for stage in left if stage in costs]
        total = total_cost(known, default_threads()) if known else {}
        needs = {n for s in left for n in spec(s).needs if n not in made}
        found.append(
            {
                "name": name, "title": command.title, "left": left,
                "after": [n for n in states if n in needs and states[n] in _NOT_THERE],
                "cost": {name: round(value, 1) for name, value in total.items()} or None,
            }
        )  # fmt: skip
    return found


def _free_gb(workspace: Path) -> float:
    """Room on the disk of a workspace, which need not exist yet."""
    place = next(folder for folder in (workspace, *workspace.parents) if folder.exists())
    return shutil.disk_usage(place).free / 1e9


class _AskedCommand(Config):
    name: str
    arguments: dict[str, Any] = Field(default_factory=dict)


class _AskedLog(Config):
    job: int
    after: int = 0


@dataclass(frozen=True)
class _RunTab:
    studio: Studio

    def state(self, call: Call) -> dict[str, Any]:
        """Everything that the tab shows."""
        state = self.studio.jobs.state()
        last = state["last"]
        if last is not None:
            last["ways"] = ways_on(last["line"]) if last["state"] == "failed" else []
        found = survey_state(self.studio.workspace.folder) | state
        if last is not None and last["name"] == "import-images" and not found["imported"]:
            found["new"] = found["new"] or last["state"] != "done"
        return found

    def job(self, call: Call) -> dict[str, Any]:
        """The job alone."""
        return self.studio.jobs.state()

    def start(self, call: Call) -> dict[str, Any]:
        """Start a command of the list."""
        asked = call.read(_AskedCommand)
        return {"job": self.studio.jobs.start(asked.name, asked.arguments)}

    def stop(self, call: Call) -> dict[str, Any]:
        """End the running job as Ctrl-C would."""
        return {"stopping": self.studio.jobs.stop()}

    def log(self, call: Call) -> dict[str, Any]:
        """Lines of a job's log after those that the page has."""
        asked = call.ask(_AskedLog)
        return self.studio.jobs.log(asked.job, asked.after)


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """State, start, stop and log."""
    run = _RunTab(studio)
    return (
        Endpoint(path="/api/run", answer=run.state),
        Endpoint(path="/api/run/job", answer=run.job),
        Endpoint(path="/api/run/start", answer=run.start, method="POST", writes=True),
        Endpoint(path="/api/run/stop", answer=run.stop, method="POST", writes=True),
        Endpoint(path="/api/run/log", answer=run.log),
    )
