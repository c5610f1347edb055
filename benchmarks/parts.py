"""All benchmarks, in the order in which they run, and what each needs."""

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

SHORT_REPEATS = 3
"""Of what takes less than ten minutes on two cores; what takes more runs once."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What all parts share."""

    work: Path
    """Folder for what parts leave behind; each has its own in it."""
    quick: bool = False
    data: Path = Path("../shared/data")
    """Real pictures."""
    demo: Path | None = None
    """A workspace with the demo's rendered pictures; rendered again where there is none."""
    pyorthomosaic: str | None = None
    """A Python that has pyOrthomosaic."""
    mitsuba: str | None = None
    """A Python that has Mitsuba."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A benchmark, or what of it runs by itself."""

    name: str
    module: str
    """Of `benchmarks`."""
    arguments: Callable[[Settings, Path], Sequence[str]] = lambda _, __: ()
    """From settings and the part's own folder; without `--quick` and `--json`."""
    long: bool = False
    """Whether it takes more than ten minutes on two cores."""
    packages: Sequence[str] = ()
    """Of the extra `bench`, by the names that are imported, that it cannot do without."""
    needs: Callable[[Settings], str | None] = lambda _: None
    """Why it cannot run; None where it can."""

    @property
    def repeats(self) -> int:
        """How often it runs by default."""
        return 1 if self.long else SHORT_REPEATS

    def command(self, settings: Settings) -> list[str]:
        """What runs this part alone, for a Python."""
        arguments = self.arguments(settings, settings.work / self.name)
        quick = ["--quick"] if settings.quick else []
        return ["-m", f"benchmarks.{self.module}", *arguments, *quick]

    def reason_to_leave_out(self, settings: Settings) -> str | None:
        """Why it cannot run here; None where it can."""
        lacking = [name for name in self.packages if importlib.util.find_spec(name) is None]
        if lacking:
            return f"{', '.join(lacking)} missing: install the extra `bench`"
        return self.needs(settings)


def _pictures_in(folder: Path) -> list[Path]:
    files = folder.iterdir() if folder.is_dir() else iter(())
    return sorted(file for file in files if file.suffix.lower() in (".jpg", ".png"))


def _feature_folder(settings: Settings) -> Path:
    return settings.data / ("opencv_stereo" if settings.quick else "haltbrekken/left")


def _features(settings: Settings, _: Path) -> Sequence[str]:
    return [str(picture) for picture in _pictures_in(_feature_folder(settings))[:2]]


def _need_features(settings: Settings) -> str | None:
    folder = _feature_folder(settings)
    return None if len(_pictures_in(folder)) > 1 else f"no pictures in {folder}"


def _reconstruct(only: str) -> Callable[[Settings, Path], Sequence[str]]:
    def arguments(settings: Settings, work: Path) -> Sequence[str]:
        found = ["--work", str(work), "--only", only]
        if only not in ("growth", "peers"):
            found += ["--data", str(settings.data)]
        if only == "peers" and settings.demo is not None and not settings.quick:
            found += ["--demo", str(settings.demo)]
        if only != "growth" and settings.pyorthomosaic is not None:
            found += ["--pyorthomosaic", settings.pyorthomosaic]
        return found

    return arguments


def _real(folder: str) -> Callable[[Settings], str | None]:
    def needs(settings: Settings) -> str | None:
        if settings.quick:
            return "--quick: takes minutes at its smallest; real-pictures has a smaller set"
        there = (settings.data / folder).is_dir()
        return None if there else f"no pictures in {settings.data / folder}"

    return needs


def _facade(settings: Settings, work: Path) -> Sequence[str]:
    python = () if settings.mitsuba is None else ("--mitsuba", settings.mitsuba)
    return ("--work", str(work), *python)


def _need_mitsuba(settings: Settings) -> str | None:
    return None if settings.mitsuba is not None else "no --mitsuba PYTHON to render it with"


PARTS = (
    Part(name="camera-speed", module="camera", arguments=lambda _, __: ("--only", "speed")),
    Part(name="camera-pose", module="camera", arguments=lambda _, __: ("--only", "pose")),
    Part(
        name="camera-calibration",
        module="camera",
        arguments=lambda _, __: ("--only", "calibration", "target"),
    ),
    Part(name="planner", module="planner", packages=("coverage_path_planner",)),
    Part(
        name="planner-angles",
        module="planner",
        arguments=lambda _, __: ("--angles",),
        long=True,
        packages=("coverage_path_planner",),
    ),
    Part(name="studio", module="studio"),
    Part(name="vehicle", module="vehicle"),
    Part(name="missions", module="missions"),
    Part(name="features", module="features", arguments=_features, needs=_need_features),
    Part(name="refraction", module="refraction"),
    Part(name="bend", module="bend", arguments=lambda _, work: ("--work", str(work))),
    Part(
        name="precision",
        module="precision",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(
        name="cluster",
        module="cluster",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
        packages=("distributed",),
    ),
    Part(
        name="scale",
        module="scale",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(
        name="many-pictures",
        module="many_pictures",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(name="refine-gpu", module="refine_gpu", packages=("numba_cuda",)),
    Part(
        name="reconstruct-peers",
        module="reconstruct",
        arguments=_reconstruct("peers"),
        long=True,
    ),
    Part(
        name="reconstruct-growth",
        module="reconstruct",
        arguments=_reconstruct("growth"),
        long=True,
    ),
    Part(
        name="reconstruct-haltbrekken",
        module="reconstruct",
        arguments=_reconstruct("haltbrekken"),
        long=True,
        needs=_real("haltbrekken"),
    ),
    Part(
        name="reconstruct-brighton",
        module="reconstruct",
        arguments=_reconstruct("brighton"),
        long=True,
        needs=_real("brighton_beach"),
    ),
    Part(
        name="harbour",
        module="harbour",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(name="facade", module="facade", arguments=_facade, long=True, needs=_need_mitsuba),
    Part(
        name="turbid",
        module="turbid",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(
        name="mosaic",
        module="mosaic",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(
        name="colour",
        module="colour",
        arguments=lambda _, work: ("--work", str(work)),
        long=True,
    ),
    Part(
        name="real-pictures",
        module="real_pictures",
        arguments=lambda settings, work: (str(settings.data), str(work)),
        long=True,
    ),
)


def chosen(names: Sequence[str]) -> list[Part]:
    """Parts by their names or by those of their modules, in their fixed order; all for none.

    Raises:
        ValueError: there is no such part.
    """
    known = {part.name for part in PARTS} | {part.module for part in PARTS}
    if unknown := sorted(set(names) - known):
        raise ValueError(f"no part {', '.join(unknown)}; there are {', '.join(sorted(known))}")
    return [part for part in PARTS if not names or {part.name, part.module} & {*names}]
