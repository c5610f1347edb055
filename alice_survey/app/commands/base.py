"""A command is a class: its docstring is the help, its fields the options, and `run` does the work.

The command line makes its options of the fields (`alice_survey.app.cli.main`), and the studio
checks by them what a page asks for. Numeric packages are imported by `run` alone, so that `--help`
stays quick.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import typer
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, field_validator

from alice_survey.core.errors import ConfigError, extra, note, offer

if TYPE_CHECKING:
    from alice_survey.core.executor import Executor

Result = tuple[str, Any]
"""What a command gives: text, and JSON values."""
WORK = Path("work")
Choice = Literal["auto", "cpu", "gpu"]
"""What refines depth."""


def option(default: Any, text: str, *names: str, metavar: str | None = None, **bounds: Any) -> Any:
    """A field that is an option.

    Args:
        default: value where it is not given; `...` where it must be.
        text: its help.
        names: where they are not that of the field.
        metavar: what its value is called in the help.
        bounds: `ge` and `le`.
    """
    extra: Any = {"names": names, "metavar": metavar, "is_argument": False}
    return Field(default, description=text, json_schema_extra=extra, **bounds)


def argument(default: Any, text: str, metavar: str | None = None) -> Any:
    """A field that is an argument without a name."""
    extra: Any = {"names": (), "metavar": metavar, "is_argument": True}
    return Field(default, description=text, json_schema_extra=extra)


class CommandModel(BaseModel, coerce_numbers_to_str=True):
    """A command and its arguments."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)
    name: ClassVar[str]
    """Its words on the command line."""
    examples: ClassVar[Sequence[str]] = ()
    """Arguments to show in its help, after the program's name."""
    advanced: ClassVar[str] = ""
    """Fields that few need: the help tells of them last."""
    title: ClassVar[str] = ""
    """What it does, in words; only where the studio offers it."""
    offered: ClassVar[Sequence[str]] = ()
    """Fields that a page of the studio may set."""
    _said: str = PrivateAttr("")
    quiet: bool = option(False, "Show warnings, errors and the result alone.", "-q", "--quiet")
    log_file: list[Path] | None = option(
        None, "Add all that happens to this file, as lines of JSON.",
        metavar="FILE",
    )  # fmt: skip

    @classmethod
    def declaration(cls, field: str) -> Any:
        """What `option` or `argument` keeps of a field."""
        return cls.model_fields[field].json_schema_extra

    @classmethod
    def option_name(cls, field: str) -> str:
        """The long name of an option."""
        named = [name for name in cls.declaration(field)["names"] if name.startswith("--")]
        return named[0].split("/")[0] if named else f"--{field.replace('_', '-')}"

    @classmethod
    def stages(cls) -> list[str]:
        """Stages that it makes."""
        from alice_survey.app.stages import names

        return names(cls.name)

    def words(self) -> list[str]:
        """This command on the command line: a value is never taken for another option."""
        options, plain = list[str](), list[str]()
        for field in type(self).model_fields:
            value = getattr(self, field) if field in self.model_fields_set else None
            values = value if isinstance(value, list) else [] if value is None else [value]
            if self.declaration(field)["is_argument"]:
                plain += map(str, values)
            elif isinstance(value, bool):
                options += [self.option_name(field)] * value
            else:
                options += [f"{self.option_name(field)}={one}" for one in values]
        return [*self.name.split(), *options, *(["--", *plain] if plain else [])]

    def run(self) -> Result | None:
        """Do its work."""
        raise NotImplementedError

    def is_passed(self, data: Any) -> bool:
        """Whether a result is good enough to end with exit code 0."""
        parts = (data, *data.values()) if isinstance(data, dict) else ()
        return not any(isinstance(part, dict) and part.get("shortfall") for part in parts)

    def say(self, text: str) -> None:
        """Print what the text of the result begins with, before the command ends."""
        from alice_survey.core.run.progress import current

        if not getattr(self, "as_json", False):
            with current().paused_bars():
                typer.echo(text)
            self._said = text

    def show(self, text: str, data: Any) -> None:
        """Print a result."""
        from alice_survey.core.run.progress import current

        remaining = text.removeprefix(self._said).lstrip("\n") if self._said else text
        if getattr(self, "as_json", False):
            typer.echo(json.dumps(data, indent=2))
        elif remaining or not self._said:
            typer.echo(remaining)
        current().report("result", text)


class ReportCommand(CommandModel):
    """A command whose result is text or JSON."""

    as_json: bool = option(False, "Print machine-readable JSON.", "--json")


class WorkspaceCommand(CommandModel):
    """A command that works in the workspace of a survey."""

    workspace: Path = option(
        WORK, "Folder that holds the stages of one survey.", "-w", "--workspace"
    )

    @field_validator("workspace")
    @classmethod
    def _no_file(cls, workspace: Path) -> Path:
        if workspace.exists() and not workspace.is_dir():
            raise ValueError(f"{workspace} is a file, no folder (videos: import-images --video)")
        return workspace

    def show_next(self, found: object, folder: Path) -> None:
        """Show what was brought into a folder, and the command that goes on."""
        after = "" if self.quiet else f"; next: {offer('reconstruct', '-w', self.workspace)}"
        typer.echo(f"{found}\nin {folder}{after}")


class SurveyCommand(WorkspaceCommand, ReportCommand):
    """A command that reads the settings of a survey."""

    survey: Path | None = option(
        None, "Settings; WORKSPACE/survey.toml, then ./survey.toml, if not given.",
        "-s", "--survey",
    )  # fmt: skip

    def settings(self, *, needed: bool = False) -> Any:
        """The settings, as `pipeline.settings` finds them."""
        from alice_survey.app.pipeline import settings

        return settings(self.workspace, self.survey, needed=needed)


class ThreadsCommand(CommandModel):
    """A command that computes on cores of this machine."""

    threads: int | None = option(None, "Cores to use; all when not given.", ge=1, le=256)

    def executor(self) -> "Executor":
        """Where its tasks run."""
        from alice_survey.core.executor import local_executor

        if self.threads is not None:
            import cv2

            cv2.setNumThreads(self.threads)
        return local_executor(self.threads)


class ClusterCommand(ThreadsCommand, SurveyCommand):
    """A command that computes on this machine or on a cluster."""

    scheduler: str | None = option(
        None, "Run tasks on the Dask cluster of this scheduler.", metavar="ADDRESS"
    )
    cluster: Path | None = option(
        None, "Run tasks on the Dask cluster of this file.", metavar="FILE"
    )

    @contextlib.contextmanager
    def started_executor(self, device: Choice = "cpu") -> "Iterator[Executor]":
        """Within this block, where its tasks run: on a cluster if one is given."""
        if self.scheduler is None and self.cluster is None:
            yield replace(self.executor(), uses_gpu=is_gpu_chosen(device))
            return
        if device == "gpu":
            raise typer.BadParameter("--device gpu is for this machine: a cluster uses processors")
        if self.scheduler is not None and self.cluster is not None:
            raise typer.BadParameter("give --scheduler or --cluster, not both")
        if self.threads is not None:
            raise typer.BadParameter("--threads is for this machine: a cluster has its own workers")
        from alice_survey.core.cluster.engine import cluster_executor

        with cluster_executor(self.workspace, self.scheduler, self.cluster) as executor:
            yield executor


class DeviceCommand(ClusterCommand):
    """A command that refines depth."""

    device: Choice = option(
        "auto", "What refines depth: auto takes an NVIDIA GPU if one can be used."
    )


SCALE = option(None, "Divide the resolution of rendered pictures by this.", ge=1, le=16)
OUTPUT = option(None, "Folder to write.", "-o", "--output", metavar="DIR")


def is_gpu_chosen(choice: Choice) -> bool:
    """Whether to work on the GPU of this machine, which is then named in a note.

    Args:
        choice: `auto` takes the GPU if there is one that can be used; `cpu` looks for none.

    Raises:
        ConfigError: `gpu` is chosen and none can be used.
    """
    if choice == "cpu":
        return False
    if find_spec("numba_cuda") is None:
        name, missing = None, extra("gpu")
    else:
        name, missing = _first_gpu()
    if name is not None:
        note(f"depth is refined on the GPU, {name}")
    elif choice == "gpu":
        raise ConfigError(f"--device gpu: {missing}")
    return name is not None


def _first_gpu() -> tuple[str | None, str]:
    """Name of the first GPU; None without one, and what is missing."""
    # Memory is freed at once, not ten arrays later: other processes use the same GPU.
    os.environ.setdefault("NUMBA_CUDA_MAX_PENDING_DEALLOCS_COUNT", "0")
    try:
        from numba import cuda
    except ImportError as error:
        return None, f"numba-cuda cannot be loaded ({error}): {extra('gpu')}"
    if not cuda.is_available():
        why = " ".join(str(cuda.cuda_error() or "no NVVM").split())
        return None, f"no NVIDIA GPU answers ({why}): install its driver; {extra('gpu')}"
    return getattr(cuda.gpus[0], "name", "simulated"), ""  # numba's simulator has no name
