"""The commands that the studio may start, each with the types of its arguments.

A page gives a name of this list and JSON values. They are checked here and written as one
argument each, options as `--name=value`: no value can become another option, nor reach a shell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, ValidationError

from alice_survey.core.config import Config
from alice_survey.core.contents import first_fault
from alice_survey.core.errors import ConfigError
from alice_survey.core.stages import names


def _given(path: Path) -> Path:
    """A path that a person has typed: absolute, or below their home."""
    path = path.expanduser()
    if not path.is_absolute():
        raise ValueError(f"{path} is not a whole path, such as {Path.home() / path.name}")
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    return path


Given = Annotated[Path, AfterValidator(_given)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w.-]{0,63}$")]
CameraName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_-]{0,39}$")]
Threads = Annotated[int | None, Field(ge=1, le=256)]
Scale = Annotated[int | None, Field(ge=1, le=16)]
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Text = Annotated[str, Field(min_length=1, max_length=400, pattern=r"^[^\x00-\x1f]*$")]


class Arguments(Config):
    """Arguments of a command; a field's name is that of its option."""

    plain: ClassVar[tuple[str, ...]] = ()
    """Fields that are no options; they follow these."""
    called: ClassVar[Mapping[str, str]] = {}
    """Options whose name is not that of their field."""

    def words(self, workspace: Path) -> list[str]:
        """Arguments of the command line, after the command's own words."""
        options, plain = [f"--workspace={workspace}"], list[str]()
        for field in type(self).model_fields:
            value = getattr(self, field)
            if field in self.plain:
                plain += [str(one) for one in _each(value)]
                continue
            option = f"--{self.called.get(field, field.replace('_', '-'))}"
            if isinstance(value, bool):
                options += [option] if value else []
            else:
                options += [f"{option}={one}" for one in _each(value)]
        return [*options, "--", *plain] if plain else options


def _each(value: object) -> list[object]:
    """Values of an argument; none where it is not given."""
    if isinstance(value, Mapping):
        return [f"{name}={one}" for name, one in value.items()]
    if isinstance(value, tuple):
        return list(value)
    return [] if value is None else [value]


class WorkingArguments(Arguments):
    """Arguments of a command that computes."""

    threads: Threads = None


class RenderingArguments(WorkingArguments):
    """Arguments of a command that renders pictures."""

    scale: Scale = None


class PlanArguments(Arguments):
    """Arguments of `plan`."""

    vehicle: Name | None = None


class FlyArguments(PlanArguments):
    """Arguments of `fly`."""

    controller: Literal["sway", "los"] | None = None
    dive: Annotated[int | None, Field(ge=1, le=1000)] = None


class ReconstructArguments(WorkingArguments):
    """Arguments of `reconstruct`."""

    called: ClassVar[Mapping[str, str]] = {"planes": "plane"}
    planes: tuple[Text, ...] = Field((), max_length=16)
    crs: Annotated[str | None, Field(pattern=r"^EPSG:[0-9]{1,6}$")] = None
    export: Literal["undistorted"] | None = None


class EvaluateArguments(WorkingArguments):
    """Arguments of `evaluate`."""

    reference: Given | None = None
    against: Given | None = None


class ImportImagesArguments(WorkingArguments):
    """Arguments of `import-images`."""

    plain: ClassVar[tuple[str, ...]] = ("folders",)
    called: ClassVar[Mapping[str, str]] = {"cameras": "camera", "videos": "video"}
    folders: tuple[Given, ...] = Field((), max_length=100)
    cameras: dict[CameraName, Given] = Field({}, max_length=8)
    videos: tuple[Given, ...] = Field((), max_length=1000)
    bag: Given | None = None
    overlap: Annotated[float | None, Field(ge=0.3, le=0.95)] = None
    every: Annotated[float | None, Field(ge=0.01, le=3600)] = None
    recursive: bool = False
    navigation: Given | None = None
    clock_offset: Number | None = None
    time_zone: Annotated[str | None, Field(pattern=r"^[A-Za-z][\w/+-]{0,63}$")] = None
    vertical_datum: Text | None = None
    rig: Given | None = None
    masks: Given | None = None
    triggers: Given | None = None


class ImportLogArguments(Arguments):
    """Arguments of `import-log`, which writes a navigation CSV into the workspace."""

    plain: ClassVar[tuple[str, ...]] = ("log",)
    log: Given
    output: Annotated[str, Field(pattern=r"^navigation[\w-]{0,40}\.csv$")] = "navigation.csv"
    declination: Number | None = None
    clock_offset: Number | None = None
    dead_reckon: bool = False

    def words(self, workspace: Path) -> list[str]:
        """Arguments of the command line; it knows no workspace."""
        written = self.model_copy(update={"output": workspace / self.output})
        return super(ImportLogArguments, written).words(workspace)[1:]


class ControlArguments(WorkingArguments):
    """Arguments of `control`."""

    dictionary: Name | None = None
    points: Text | None = None
    length: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None


class PlanCheckArguments(WorkingArguments):
    """Arguments of `plan check`."""

    plain: ClassVar[tuple[str, ...]] = ("log",)
    log: Given | None = None
    triggers: Given | None = None


class PlanRevisitArguments(WorkingArguments):
    """Arguments of `plan revisit`."""

    sigma: Annotated[float | None, Field(ge=1e-3, le=1e6)] = None


class PlanExportArguments(Arguments):
    """Arguments of `plan export`."""

    called: ClassVar[Mapping[str, str]] = {"formats": "format"}
    formats: tuple[Name, ...] = Field((), max_length=32)


@dataclass(frozen=True, kw_only=True)
class Startable:
    """A command that the studio may start."""

    title: str
    """What it does, in words."""
    arguments: type[Arguments]
    stages: Sequence[str] = ()
    """Those that it makes."""


COMMANDS: Mapping[str, Startable] = {
    "run": Startable(title="Make all that is left", arguments=RenderingArguments, stages=names()),
    "plan": Startable(title="Plan the survey", arguments=PlanArguments, stages=names("plan")),
    "fly": Startable(title="Fly the plan", arguments=FlyArguments, stages=names("fly")),
    "image": Startable(
        title="Render the pictures", arguments=RenderingArguments, stages=names("image")
    ),
    "calibrate": Startable(
        title="Calibrate the cameras", arguments=WorkingArguments, stages=names("calibrate")
    ),
    "reconstruct": Startable(
        title="Reconstruct the sea floor", arguments=ReconstructArguments,
        stages=names("calibrate", "reconstruct"),
    ),
    "evaluate": Startable(
        title="Score the survey", arguments=EvaluateArguments, stages=names("evaluate")
    ),
    "report": Startable(
        title="Write the report", arguments=WorkingArguments, stages=names("report")
    ),
    "import-images": Startable(title="Import pictures", arguments=ImportImagesArguments),
    "import-log": Startable(title="Import a vehicle's log", arguments=ImportLogArguments),
    "control": Startable(title="Find coded markers, or scale a model", arguments=ControlArguments),
    "quality": Startable(title="Judge the pictures", arguments=WorkingArguments),
    "plan check": Startable(title="Check what a dive has seen", arguments=PlanCheckArguments),
    "plan revisit": Startable(title="Plan a dive over weak places", arguments=PlanRevisitArguments),
    "plan export": Startable(title="Write the plan for vehicles", arguments=PlanExportArguments),
}  # fmt: skip
"""All of them, by the words that a terminal takes."""


def words_of(name: str, arguments: Mapping[str, Any], workspace: Path) -> list[str]:
    """The arguments of `alice-survey` for a command that a page asks for.

    Args:
        name: one of `COMMANDS`.
        arguments: JSON values by the names of fields.
        workspace: folder to work in.

    Raises:
        ConfigError: there is no such command, or an argument is not what it takes.
    """
    if name not in COMMANDS:
        raise ConfigError(f"there is no command {name!r}: {', '.join(COMMANDS)}")
    try:
        given = COMMANDS[name].arguments.model_validate(arguments)
    except ValidationError as error:
        raise ConfigError(f"{name}: {first_fault(error, 'arguments')}") from None
    return [*name.split(), *given.words(workspace.resolve())]
