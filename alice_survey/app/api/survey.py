"""A survey's workspace as one object."""

import html
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from alice_survey.app.api.arrays import Dem, Mosaic, Track, read_dem, read_mosaic, read_track
from alice_survey.core.artefacts import need_stage, stage_command
from alice_survey.core.config import SurveyConfig
from alice_survey.core.contents import first_fault
from alice_survey.core.errors import ConfigError, file_faults, warn
from camera_calib.rig import Rig, design_rig, read_rig
from missions.values.plan_file import Plan, read_plan
from reconstruct.stages import rig_file
from reconstruct.views.model import SparseModel, read_model


def call(command: str, **options: Any) -> Any:
    """Do what a command of the command line does.

    Args:
        command: its words after `alice-survey`, such as `measure` or `plan check`.
        options: as its help names them, with `_` for `-`, and its arguments; a list of several.

    Returns:
        What it prints with `--json`; None of a command that has no such option.

    Raises:
        ConfigError: there is no such command or option, or a value is none that it takes.
        AliceError: it cannot be done; the message states what to change.

    Example:
        >>> import alice_survey as alice
        >>> alice.call("fov", validate=True)["passed"]
        True
    """
    import typer
    from pydantic import ValidationError

    from alice_survey.app.commands import COMMANDS

    kinds = {kind.name: kind for kind in COMMANDS}
    if command not in kinds:
        raise ConfigError(f"there is no command {command!r}: one of {', '.join(sorted(kinds))}")
    kind = kinds[command]
    fields = {kind.option_name(one)[2:].replace("-", "_"): one for one in kind.model_fields}
    given = {fields.get(n, n): v.folder if isinstance(v, Survey) else v for n, v in options.items()}
    kinds_of = {n: one.annotation for n, one in kind.model_fields.items()}
    many = {n for n, of in kinds_of.items() if list in [get_origin(k) for k in (of, *get_args(of))]}
    single = {n for n in many & {*given} if isinstance(given[n], str | float | int | Path)}
    given |= {name: [given[name]] for name in single}
    try:
        result = kind(**given).run()
    except ValidationError as error:
        raise ConfigError(f"{command}: {first_fault(error, known=fields)}") from None
    except typer.BadParameter as error:
        raise ConfigError(f"{command}: {error.message}") from None
    return None if result is None else result[1]


@dataclass(frozen=True)
class Survey:
    """A workspace: the folder that holds the settings and the stages of one survey.

    Args:
        folder: the workspace; it need not exist yet.

    Example:
        >>> import alice_survey as alice
        >>> reef = alice.Survey.new("reef")
        >>> plan = reef.plan()
        >>> len(plan.lines), round(plan.duration_s / 60)
        (17, 30)
    """

    folder: Path

    def __init__(self, folder: str | Path) -> None:
        object.__setattr__(self, "folder", Path(folder))

    @classmethod
    def new(
        cls, folder: str | Path, *, area: str | Path | None = None, example: str = "survey"
    ) -> "Survey":
        """Create a workspace with a commented `survey.toml`.

        Args:
            folder: the workspace; created if missing.
            area: GeoJSON, KML, GPX, GeoPackage, shapefile, WKT or CSV of the area to survey.
            example: `survey` (the paper's mission), `demo` or `caesarea`.

        Raises:
            WorkspaceError: there is a `survey.toml` already, or the folder cannot be written.
            PlanError: the file holds no area that can be surveyed.

        Example:
            >>> import alice_survey as alice
            >>> alice.Survey.new("harbour", example="caesarea").config.plan.altitude_m
            3.0
        """
        from alice_survey.app.pipeline import init_survey

        init_survey(Path(folder), f"{example}.toml", None if area is None else Path(area))
        return cls(folder)

    @property
    def config(self) -> SurveyConfig:
        """The settings of `survey.toml`; defaults where a workspace holds imported pictures."""
        from alice_survey.app.pipeline import settings
        from alice_survey.core.stages import is_imported

        return settings(self.folder, None, needed=not is_imported(self.folder))

    def with_settings(self, **sections: Mapping[str, Any]) -> "Survey":
        """This survey after a change of settings in `survey.toml`, whose comments stay.

        Args:
            sections: settings and their values, by section; None takes a setting out.

        Raises:
            ConfigError: a value is not one that a survey may have; the file is as it was.

        Example:
            >>> import alice_survey as alice
            >>> wreck = alice.Survey.new("wreck").with_settings(plan={"altitude_m": 1.5})
            >>> wreck.config.plan.altitude_m
            1.5
        """
        from missions.plan.preview import draft_settings

        if lost := [name for name, one in sections.items() if not isinstance(one, Mapping)]:
            raise ConfigError(f'{lost[0]} is not a section: give one, as plan={{"altitude_m": 2}}')
        path = self.folder / "survey.toml"
        with file_faults(path, ConfigError):
            text = path.read_bytes().decode()
        draft_settings(text, path, sections).write()
        return self

    def run(self, *stages: str, threads: int | None = None) -> dict[str, Any]:
        """Run stages in the order given; those that are up to date are skipped.

        Args:
            stages: names as `alice-survey status` shows them; all when none is given.
            threads: cores to use; None for all.

        Returns:
            Results by stage, as in its summary.

        Raises:
            AliceError: a stage cannot be done; the message states what to change.
        """
        from alice_survey.app.pipeline import run
        from alice_survey.app.stages import names
        from alice_survey.core.executor import local_executor

        return run(stages or names(), self.folder, None, executor=local_executor(threads))[1]

    def plan(self) -> Plan:
        """Plan the survey if its plan is missing or stale, and return the plan.

        A new plan makes later stages stale; `read_plan` only reads one.
        """
        self.run("plan")
        return read_plan(self.folder / "plan" / "plan.json")

    def status(self) -> dict[str, str]:
        """State of each stage: up to date, stale (and why), interrupted or missing."""
        from alice_survey.app.pipeline import workspace_status

        return dict(workspace_status(self.folder, None)[1]["stages"])

    @property
    def rig(self) -> Rig:
        """The rig as calibrated or imported, or as designed where there is neither."""
        path, config = rig_file(self.folder), self.config
        return design_rig(config.camera, config.water) if path is None else read_rig(path)

    @property
    def model(self) -> SparseModel:
        """Registered views and points."""
        return read_model(self._folder_of("sparse"))

    @property
    def track(self) -> Track:
        """Positions of the pictures, with covariances."""
        return read_track(self._folder_of("sparse"))

    @property
    def dem(self) -> Dem:
        """Heights of the surface with their sigmas, at most 4,000 cells a side."""
        return read_dem(self._folder_of("dense") / "dem.tif")

    @property
    def mosaic(self) -> Mosaic:
        """The orthomosaic, at most 4,000 pixels a side."""
        return read_mosaic(self._folder_of("mosaic") / "mosaic.tif")

    def _folder_of(self, name: str) -> Path:
        """A folder that `reconstruct` has finished; a warning says that it is out of date."""
        from alice_survey.app.stages import spec

        folder = need_stage(self.folder, name, "reconstruct")
        if (state := self.status()[spec(name).name]) != "up to date":
            warn(f"{folder} is {state}: {stage_command('reconstruct', self.folder)!r} renews it")
        return folder

    def __fspath__(self) -> str:
        """The folder, so that what takes a workspace takes a survey too."""
        return str(self.folder)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{html.escape(stage)}</td><td>{html.escape(state)}</td></tr>"
            for stage, state in self.status().items()
        )
        return f"<b>{html.escape(str(self.folder))}</b><table>{rows}</table>"
