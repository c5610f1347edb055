"""Options and behaviour that all commands share."""

import contextlib
import functools
import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer.models import ArgumentInfo

from alice_survey.core.device import Choice, is_gpu_chosen

if TYPE_CHECKING:
    from alice_survey.core.executor import Executor

CONTEXT = {"help_option_names": ["-h", "--help"]}

Workspace = Annotated[
    Path, typer.Option("-w", "--workspace", help="Folder that holds the stages of one survey.")
]
SurveyFile = Annotated[
    Path | None,
    typer.Option(
        "-s", "--survey", help="Settings; WORKSPACE/survey.toml, then ./survey.toml, if not given."
    ),
]
Threads = Annotated[
    int | None, typer.Option(min=1, max=256, help="Cores to use; all when not given.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run tasks on the Dask cluster of this scheduler."),
]
ClusterFile = Annotated[
    Path | None,
    typer.Option("--cluster", metavar="FILE", help="Run tasks on the Dask cluster of this file."),
]
Device = Annotated[
    Choice,
    typer.Option(help="What refines depth: auto takes an NVIDIA GPU if one can be used."),
]
Scale = Annotated[
    int | None,
    typer.Option(min=1, max=16, help="Divide the resolution of rendered pictures by this."),
]
RigCamera = Annotated[str | None, typer.Option(help="Camera of the rig; its first if not given.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON.")]
Quiet = Annotated[
    bool, typer.Option("-q", "--quiet", help="Show warnings, errors and the result alone.")
]
LogFile = Annotated[
    Path | None, typer.Option("--log-file", help="Add all that happens, with times, to this file.")
]
Events = Annotated[Path | None, typer.Option("--events", help="Add it as JSON lines to this file.")]
WORK = Path("work")
Folder = Annotated[
    Path | None, typer.Argument(metavar="WORKSPACE", help="The same as -w.", show_default=False)
]
_SESSION = {"quiet": (Quiet, False), "log_file": (LogFile, None), "events": (Events, None)}


def executor_of(threads: int | None) -> "Executor":
    """Where a command runs its tasks, by its option `--threads`."""
    from alice_survey.core.executor import local_executor  # here, so that --help stays quick

    if threads is not None:
        import cv2

        cv2.setNumThreads(threads)
    return local_executor(threads)


@contextlib.contextmanager
def executor_on(
    workspace: Path,
    threads: int | None,
    scheduler: str | None,
    cluster: Path | None,
    device: Choice = "cpu",
) -> "Iterator[Executor]":
    """Within this block, where a command runs its tasks: on a cluster if one is given."""
    if scheduler is None and cluster is None:
        yield replace(executor_of(threads), uses_gpu=is_gpu_chosen(device))
        return
    if device == "gpu":
        raise typer.BadParameter("--device gpu is for this machine: a cluster uses processors")
    if scheduler is not None and cluster is not None:
        raise typer.BadParameter("give --scheduler or --cluster, not both")
    if threads is not None:
        raise typer.BadParameter("--threads is for this machine: a cluster has its own workers")
    from alice_survey.core.cluster.engine import cluster_executor

    with cluster_executor(workspace, scheduler, cluster) as executor:
        yield executor


def examples(*lines: str) -> str:
    """An epilog that keeps its lines (the first character disables wrapping)."""
    return "\b\nExamples:\n" + "\n".join(f"  alice-survey {line}" for line in lines)


def print_result(table: str, data: Any, as_json: bool) -> None:
    """Print a command's result as text, or as JSON if requested."""
    typer.echo(json.dumps(data, indent=2) if as_json else table)
    from alice_survey.core.run.progress import current

    current().report("result", table)


def with_sessions(app: typer.Typer) -> None:
    """Give every command of an app the options of a session, and do its work within one.

    A command that works in a workspace, and has no arguments of its own, takes the workspace as an
    argument too.
    """
    if app.registered_callback is not None and app.registered_callback.callback is not None:
        app.registered_callback.callback = _in_session(app.registered_callback.callback)
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = _in_session(_with_folder(command.callback))
    for group in app.registered_groups:
        if group.typer_instance is not None:
            with_sessions(group.typer_instance)


def _with_folder(command: Callable[..., Any]) -> Callable[..., Any]:
    signature = inspect.signature(command)
    kinds = [get_args(parameter.annotation) for parameter in signature.parameters.values()]
    if get_args(Workspace) not in kinds or any(
        isinstance(part, ArgumentInfo) for kind in kinds for part in kind
    ):
        return command
    default = signature.parameters["workspace"].default

    @functools.wraps(command)
    def wrapped(*args: Any, folder: Path | None, workspace: Path, **kwargs: Any) -> Any:
        if folder is not None and workspace not in (default, folder):
            raise typer.BadParameter(f"two workspaces are given: {folder} and -w {workspace}")
        return command(*args, workspace=folder or workspace, **kwargs)

    return _declared(wrapped, command, {"folder": (Folder, None)})


def _declared(
    wrapped: Callable[..., Any], command: Callable[..., Any], options: Mapping[str, tuple[Any, Any]]
) -> Callable[..., Any]:
    """A command with the options of another and more of its own: their types and defaults."""
    signature = inspect.signature(command)
    more = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in options.items()
    ]
    parameters = [*signature.parameters.values(), *more]
    vars(wrapped)["__signature__"] = signature.replace(parameters=parameters)
    kinds = {name: kind for name, (kind, _) in options.items()}
    wrapped.__annotations__ = {**command.__annotations__, **kinds}
    return wrapped


def _in_session(command: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(command)
    def wrapped(
        *args: Any, quiet: bool, log_file: Path | None, events: Path | None, **kwargs: Any
    ) -> Any:
        context = next((v for v in kwargs.values() if hasattr(v, "invoked_subcommand")), None)
        below = None if context is None else context.invoked_subcommand
        if below is not None:
            if quiet or log_file or events:
                raise typer.BadParameter(f"--quiet, --log-file and --events go behind '{below}'")
            return command(*args, **kwargs)
        from alice_survey.app.cli.session import session  # here, so that --help stays quick

        with session(sys.argv[1:], quiet=quiet, log_file=log_file, events=events):
            return command(*args, **kwargs)

    return _declared(wrapped, command, _SESSION)
