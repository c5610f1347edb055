"""The command line, made of the classes of `alice_survey.app.commands`."""

import atexit
import gc
import inspect
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from typer.core import TyperCommand, TyperGroup

from alice_survey.app.commands import COMMANDS
from alice_survey.app.commands.base import CommandModel, WorkspaceCommand, option
from alice_survey.core.contents import first_fault
from alice_survey.core.errors import NOT_GOOD_ENOUGH, known_fault, note

CONTEXT = {"help_option_names": ["-h", "--help"]}
SHARED = ("workspace", "survey", "threads", "scheduler", "cluster", "device", "as_json", "quiet",
          "log_file")  # fmt: skip
"""Fields that come last in the help."""
_ADVANCED = tuple(name for name in SHARED if name not in ("workspace", "survey", "as_json"))
"""Of these, and of a command's `advanced`, the help tells under a heading of their own."""
_VEHICLE = "The vehicle: coefficients from geometry and from logs, and how its two forms compare."
"""Help of the group of commands that is no command itself."""
GROUPS = {
    "Start": "studio demo run status",
    "Plan": "init plan fov",
    "Vehicle": "fly pilot vehicle import-log",
    "Camera": "target calibrate camera image",
    "Pictures": "import-images quality join import-control control",
    "Model": "reconstruct measure evaluate",
    "Share": "report mosaic-tiles",
}
"""Headings of the first help, and their commands."""
_ROADS = """\b
Three ways to begin:
  alice-survey demo                        # a small survey, from plan to report
  alice-survey reconstruct PHOTOS -o dive  # a folder of pictures, to the report
  alice-survey init reef --area reef.kml   # a survey to plan and fly"""
_METAVARS = {"Literal": None, "Path": "PATH", "str": "TEXT", "int": "N", "float": "NUMBER"}
"""What a value is called in the help, by its type; of a choice, its choices."""
RENAMED = {
    "simulate": "pilot --simulated",
    "scale": "control",
    "view": "studio",
    "vehicle replay": "vehicle identify --validate",
    "camera water": "camera",
    "camera mount": "camera convert",
    "plan map": "plan export --map",
    "plan current": "plan",
}
"""Commands of the last version, and what takes their arguments now."""


class StudioCommand(WorkspaceCommand):
    """Plan, run, look at and measure a survey in a browser.

    Serves one page for a workspace to this machine alone, until Ctrl-C: draw the area and watch
    the plan, start the stages, look at rasters and mesh at full resolution, measure. A GIS can open
    its rasters by their addresses.
    """

    name = "studio"
    examples = (
        "studio -w reef",
        "studio -w reef --log nav.csv",
        "studio -w reef --port 8000 --no-browser",
    )
    port: int = option(0, "To listen on; 0 for any that is free.", ge=0, le=65535)
    browser: bool = option(True, "Open the page in a browser.", "--browser/--no-browser")
    log: str | None = option(
        None, "Navigation CSV of a dive to follow, which grows.", metavar="LOG"
    )

    def run(self) -> None:
        """Serve it."""
        from alice_survey.app.studio.server import run_studio

        run_studio(self.workspace, self.port, browser=self.browser, show=typer.echo, log=self.log)


def _format_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write arguments and options of a command's help, the rare ones last."""
    sections: dict[str, list[Any]] = {"Arguments": [], "Options": [], "Advanced": []}
    for one in command.get_params(ctx):
        title = "Arguments" if one.param_type_name == "argument" else "Options"
        title = "Advanced" if one.name in command.callback.advanced else title
        sections[title].append(one.get_help_record(ctx))
    for title, rows in sections.items():
        if rows:
            with formatter.section(title):
                formatter.write_dl(rows)


class _Sectioned(TyperCommand):
    format_options = _format_options


class _Grouped(TyperGroup):
    """Commands below the headings of `GROUPS`."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the lists of commands."""
        for heading, names in GROUPS.items():
            with formatter.section(heading):
                rows = [(name, self.commands[name]) for name in names.split()]
                width = formatter.width - 18
                formatter.write_dl([(n, one.get_short_help_str(width)) for n, one in rows])


class _Parent(TyperGroup):
    """A command that has others below it."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write its options, and the commands below it."""
        _format_options(self, ctx, formatter)
        self.format_commands(ctx, formatter)


class _WithFolder(_Parent):
    """One that takes a folder as those below it do."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments."""
        first = args[0] if args else "-"
        is_folder = first not in self.commands and first[0] != "-" and Path(first).is_dir()
        return super().parse_args(ctx, ["-w", *args] if is_folder else args)


def make_app(commands: Sequence[type[CommandModel]] = (*COMMANDS, StudioCommand)) -> typer.Typer:
    """The program of some commands; those of two words are below the group of the first."""
    app = typer.Typer(
        name="alice-survey",
        help="Plan, fly, image and reconstruct close-range underwater imaging surveys, and score "
        "them.",
        cls=_Grouped if StudioCommand in commands else None,
        epilog=_ROADS,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings=CONTEXT,
        rich_markup_mode=None,
    )
    parents = {"": app}
    names = {command.name: command for command in commands}
    for name in dict.fromkeys(one.name.split()[0] for one in commands if " " in one.name):
        alone, in_folder = name in names, issubclass(names.get(name, object), WorkspaceCommand)
        parents[name] = typer.Typer(
            help=None if alone else _VEHICLE, invoke_without_command=alone,
            no_args_is_help=not alone, context_settings=CONTEXT, rich_markup_mode=None,
            cls=_WithFolder if in_folder else _Parent if alone else None,
        )  # fmt: skip
    for command in commands:
        group, _, name = command.name.rpartition(" ")
        about: dict[str, Any] = {
            "help": inspect.getdoc(command),
            "epilog": "\b\nExamples:\n"
            + "\n".join(f"  alice-survey {e}" for e in command.examples),
        }  # the first character keeps the lines
        if command.name in parents:
            parents[command.name].callback()(_callback(command, is_group=True))
            app.add_typer(parents[command.name], name=command.name, **about)
        else:
            parents[group].command(name, cls=_Sectioned, **about)(_callback(command))
    for name in parents.keys() - names - {""}:
        app.add_typer(parents[name], name=name)
    return app


def _callback(kind: type[CommandModel], *, is_group: bool = False) -> Callable[..., None]:
    """What typer calls for a command: it reads the options, and works within a session."""
    has_folder = (
        not is_group
        and "workspace" in kind.model_fields
        and not any(kind.declaration(name)["is_argument"] for name in kind.model_fields)
    )

    def call(context: typer.Context, **given: Any) -> None:
        if is_group and context.invoked_subcommand is not None:
            if given["quiet"] or given["log_file"]:
                raise typer.BadParameter(
                    f"--quiet and --log-file go behind '{context.invoked_subcommand}'"
                )
            return
        folder = given.pop("folder") if has_folder else None
        if folder is not None and given["workspace"] not in (folder, default):
            raise typer.BadParameter(
                f"two workspaces are given: {folder} and -w {given['workspace']}"
            )
        try:
            arguments = kind(**given | ({} if folder is None else {"workspace": folder}))
        except ValidationError as error:
            raise typer.BadParameter(first_fault(error)) from None
        from alice_survey.app.cli.session import session  # here, so that --help stays quick

        with session(sys.argv[1:], quiet=arguments.quiet, files=arguments.log_file or ()):
            result = arguments.run()
            if result is not None:
                arguments.show(*result)
                if not arguments.is_passed(result[1]):
                    raise typer.Exit(NOT_GOOD_ENOUGH)

    default = kind.model_fields["workspace"].default if has_folder else None
    fields = sorted(
        kind.model_fields, key=lambda name: SHARED.index(name) if name in SHARED else -1
    )
    parameters = [_parameter("context", typer.Context), *(_of_field(kind, name) for name in fields)]
    if has_folder:
        info = typer.Argument(metavar="WORKSPACE", help="The same as -w.", show_default=False)
        parameters.append(_parameter("folder", Annotated[Path | None, info], None))
    vars(call)["__signature__"] = inspect.Signature(parameters)
    vars(call)["advanced"] = (*kind.advanced.split(), *_ADVANCED)
    call.__annotations__ = {one.name: one.annotation for one in parameters}
    return call


def _parameter(name: str, kind: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _of_field(kind: type[CommandModel], name: str) -> inspect.Parameter:
    """The parameter of a field: its help, metavar and bounds."""
    field, extra = kind.model_fields[name], kind.declaration(name)
    kind_of = str(field.annotation)
    metavar = next((m for known, m in _METAVARS.items() if known in kind_of), None)
    about: dict[str, Any] = {"help": field.description, "metavar": extra["metavar"] or metavar}
    names = extra["names"]
    if field.annotation is bool and not names:
        names = (kind.option_name(name),)  # else there was also one to say no
    for bound in field.metadata:
        for key, value in (("min", "ge"), ("max", "le")):
            if hasattr(bound, value):
                about[key] = getattr(bound, value)
    info = typer.Argument(**about) if extra["is_argument"] else typer.Option(*names, **about)
    default = inspect.Parameter.empty if field.is_required() else field.default
    return _parameter(name, Annotated[field.annotation, info], default)


app = make_app()


def _add_renamed(name: str, now: str) -> None:
    """Take a command under its former name, and note the new one."""

    def call(context: typer.Context) -> None:
        note(f"'{name}' is now '{now}', and is gone in the next version")
        given = [argument for argument in context.args if argument != "--ros"]
        context.find_root().command.main([*now.split(), *given], standalone_mode=False)

    taken = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
    group, _, last = name.rpartition(" ")
    parents = {one.name: one.typer_instance for one in app.registered_groups}
    parent = parents[group] if group else app
    assert parent is not None  # noqa: S101  `make_app` has made it
    parent.command(last, hidden=True, context_settings=taken)(call)


for _former, _now in RENAMED.items():
    _add_renamed(_former, _now)


def _print_version(is_given: bool) -> None:
    if is_given:
        from importlib.metadata import version

        typer.echo(f"alice-survey {version('alice-survey')}")
        raise typer.Exit


@app.callback()
def front_door(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Plan, fly, image and reconstruct close-range underwater imaging surveys, and score them."""


def main() -> None:
    """Run the command line; a known fault is one line on standard error.

    Exit codes, as the documentation shows them:
        0: done
        1: a known fault, in one line; of the program itself a traceback
        2: an option or argument that is none
        3: done, and not good enough: a flight that ended early, a calibration with a `bad` verdict,
            less than half of the pictures in the model, less than 90 % of the area covered as
            requested (`plan check`), a check (`fov --validate`) that failed, a mission of `pilot`
            that was not complete. `run` stops there unless `--accept` is given
        129, 130, 143: hung up, Ctrl-C, SIGTERM: the same command goes on from there
    """
    # Modules leave many objects that stay: looking through them again and again for garbage while
    # they are loaded takes a tenth of a command's start, and once more at its end half a second.
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)
    # Before numpy is loaded. Its threads wait for each other by spinning: products of small
    # matrices then cost several times the work, and rounding would depend on the number of cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app(_with_log_files(sys.argv[1:]))
    except Exception as error:  # libraries raise known faults as all kinds; bugs are raised again
        fault = known_fault(error)
        if fault is None:
            raise
        typer.echo(f"error: {fault}", err=True)
        raise SystemExit(1) from error


def _with_log_files(arguments: list[str]) -> list[str]:
    """Arguments with `--log-file` for `--events`, which it was in the last version."""
    if any(one.partition("=")[0] == "--events" for one in arguments):
        note("--events is now --log-file, and is gone in the next version")
    return [re.sub(r"^--events(?=$|=)", "--log-file", one) for one in arguments]
