"""What a stage is: its dependencies, its implementation and its output.

Stages are declared in `stages.py` of each package, and listed in `alice_survey.app.stages`. What
does the work is named as `module:function` and loaded when the stage is made, so that `status`
compares digests without it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from alice_survey.core import artefacts, records
from alice_survey.core.artefacts import Stage, damage, read_stage, run_stage, why_stale
from alice_survey.core.config import UNRECORDED, VEHICLE_FILES, Config, constants_of
from alice_survey.core.errors import AliceError
from alice_survey.core.executor import Executor

Summary = tuple[str, dict[str, Any]]
"""Result of a stage: a line of text, and JSON values."""
StageWork = Callable[..., Callable[[], object] | None]
"""Takes the workspace, the folder to write into and where tasks run; the settings by keyword.

It returns what draws and writes the rest, where the result is known before.
"""
WHOLE = "survey"
"""Names all settings at once in `StageSpec.takes`."""


@dataclass(frozen=True, kw_only=True)
class StageSpec:
    """One step of a survey: its dependencies, its implementation and its output."""

    name: str
    """Name, also of its package and its command, where it has its own."""
    folder: str
    """The folder of the workspace that it writes."""
    command: str
    """The command that makes it."""
    about: str
    version: int
    """Increase it when the stage's code changes its result; `tests/test_stage_code.py` checks."""
    work: str
    """`module:function` of a `StageWork`."""
    summary: Callable[[Path], Summary]
    """Takes the stage's folder."""
    shortfall: Callable[[Path], str] = lambda folder: ""
    """Takes the stage's folder. Why what it made is not good enough, in a line; else empty."""
    takes: Sequence[str] = ()
    """Dotted names of the settings that the work takes, each by the last part of its name."""
    needs: Sequence[str] = ()
    """Stages that it requires."""
    uses: Sequence[str] = ()
    """Stages that it uses if they exist."""
    settings: "Mapping[str, Any] | SettingsPart" = field(default_factory=dict)
    """All settings that the result depends on, as `settings_of` reads them."""
    setting_files: Sequence[str] = ()
    """Dotted names of the settings that are files, or lists of files."""
    inputs: Callable[[Path], Sequence[Path]] = lambda workspace: ()
    """All files of a workspace that the result depends on."""
    content: Callable[[Path], Mapping[str, Any]] = lambda workspace: {}
    """What else of a workspace it depends on, where that is not whole files; as JSON values."""
    resumes: bool = False
    """Work resumes from what an interrupted run of the same digest left."""
    simulated: bool = False
    """It is for simulated surveys: imported pictures have no such stage."""
    products: Mapping[str, str] = field(default_factory=dict)
    """Its products for users: paths below its folder, and descriptions."""
    reported: Sequence[str] = ()
    """Files that a report reads: paths below its folder, `.` for all of it."""

    def stage(self, workspace: Path, config: Config) -> Stage:
        """Dependencies of the stage, in a workspace."""
        return Stage(
            name=self.folder,
            version=self.version,
            settings=settings_of(self.settings, config) | dict(self.content(workspace)),
            inputs=[*self.inputs(workspace), *files_of(self.setting_files, config)],
            resumes=self.resumes,
            command=self.command,
        )

    def make(
        self,
        workspace: Path,
        config: Config,
        executor: Executor,
        say: Callable[[Path], object] = lambda folder: None,
    ) -> bool:
        """Run the stage unless it is up to date.

        Args:
            workspace: folder of the survey.
            config: its settings.
            executor: where tasks run.
            say: takes the unfinished folder once it holds the result, before the rest is written.

        Returns:
            True when done, False when nothing had changed.
        """
        module, function = self.work.split(":")
        taken = {
            name.rpartition(".")[2]: config if name == WHOLE else attrgetter(name)(config)
            for name in self.takes
        }

        def work(folder: Path) -> None:
            do: StageWork = getattr(import_module(module), function)
            with executor.start() as started:
                if write_rest := do(workspace, folder, started, **taken):
                    say(folder)
                    write_rest()

        return run_stage(workspace, self.stage(workspace, config), work)

    def need(self, workspace: Path) -> Path:
        """The folder of the stage, finished.

        Raises:
            WorkspaceError: it is not there; the message names the command that makes it.
        """
        planned = (workspace / "survey.toml").is_file() or (workspace / "plan").is_dir()
        command = self.command if planned or self.name != "image" else "import-images"
        return artefacts.need_stage(workspace, self.folder, command)

    def state(self, workspace: Path, config: Config, before: Mapping[str, str]) -> str:
        """Whether the stage is up to date, or why it is not.

        Args:
            workspace: folder of the survey.
            config: its settings.
            before: states of earlier stages, by name.
        """
        record = read_stage(workspace / self.folder)
        if record is None:
            partial = workspace / f"{self.folder}.partial"
            return "interrupted" if partial.exists() else "missing"
        if "refly_of" in record.settings or (self.name == "image" and is_imported(workspace)):
            # It was made by another command, from other settings.
            damaged = damage(workspace / self.folder, record)
            return "up to date" if damaged is None else f"stale (damaged: {damaged})"
        for name in (*self.needs, *self.uses):
            state = before.get(name, "up to date")
            if state != "up to date" and not (name in self.uses and state == "missing"):
                return f"stale ({name} is {state.split()[0]})"
        try:
            why = why_stale(workspace, self.stage(workspace, config))
        except AliceError as error:
            why = str(error)
        return "up to date" if why is None else f"stale ({why})"


@dataclass(frozen=True, kw_only=True)
class SettingsPart:
    """Some values of a section of the settings."""

    section: str
    only: frozenset[str] | None = None
    without: frozenset[str] = frozenset()


def only(section: str, *names: str) -> SettingsPart:
    """The values of some names."""
    return SettingsPart(section=section, only=frozenset(names))


def without(section: str, *names: str) -> SettingsPart:
    """The values of all other names."""
    return SettingsPart(section=section, without=frozenset(names))


def settings_of(requested: Any, config: Config) -> Any:
    """Settings as JSON values: what a stage's digest is made of.

    Args:
        requested: a `SettingsPart`; the dotted name of a value or a section; a mapping of these; or
            a value that stands for itself.
        config: the settings of a survey.

    Returns:
        Values in the form that `requested` has; files by their names alone, so that a survey may be
        moved.
    """
    if isinstance(requested, Mapping):
        return {key: settings_of(value, config) for key, value in requested.items()}
    if not isinstance(requested, str | SettingsPart):
        return requested
    part = SettingsPart(section=requested) if isinstance(requested, str) else requested
    value = attrgetter(part.section)(config)
    if not isinstance(value, BaseModel):
        return list(value) if isinstance(value, tuple) else value
    values = value.model_dump(
        mode="json",
        include=None if part.only is None else set(part.only),
        exclude=set(part.without),
    )
    kept = {
        name: constant
        for name, constant in constants_of(part.section).items()
        if name not in part.without
        and (part.only is None or name in part.only)
        and f"{part.section}.{name}" not in UNRECORDED
    }
    return kept | {name: _file_name(getattr(value, name), values[name]) for name in values}


def _file_name(value: Any, as_json: Any) -> Any:
    """A file's name, of a path or of text that names a vehicle's file; other values as JSON."""
    is_file = isinstance(value, str) and value.lower().endswith(VEHICLE_FILES)
    return Path(value).name if is_file or isinstance(value, Path) else as_json


def files_of(requested: Sequence[str], config: Config) -> list[Path]:
    """The files that settings name; none for those that are not set."""
    values = [attrgetter(name)(config) for name in requested]
    return [path for value in values for path in (value if isinstance(value, list) else [value])
            if path is not None]  # fmt: skip


def is_imported(workspace: Path) -> bool:
    """Whether the pictures of a workspace are real ones."""
    stage = read_stage(workspace / "images")
    if stage is not None and stage.command:
        return stage.command != "image"
    pictures = records.PicturesRecord.read_existing(workspace / "images" / "survey.json")
    return pictures is not None and pictures.source == "imported"
