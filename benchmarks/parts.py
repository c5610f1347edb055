"""All benchmarks, in the order in which they run, and what each needs."""

import importlib.util
from collections.abc import Sequence
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
    module: str = ""
    """Of `benchmarks`; the part's name if empty."""
    arguments: str = ""
    """Without `--quick` and `--json`."""
    passes: Sequence[str] = ()
    """Options passed on where they are given; `work` is the part's own folder."""
    long: bool = False
    """Whether it takes more than ten minutes on two cores."""
    packages: Sequence[str] = ()
    """Of the extra `bench`, by the names that are imported, that it cannot do without."""
    needs_mitsuba: bool = False

    @property
    def file(self) -> str:
        """The module's name in `benchmarks`."""
        return self.module or self.name.replace("-", "_")

    def command(self, settings: Settings) -> list[str]:
        """What runs this part alone, for a Python."""
        values = {**vars(settings), "work": settings.work / self.name}
        passed = [
            word
            for name in self.passes
            if values[name] is not None
            for word in (f"--{name}", str(values[name]))
        ]
        quick = ["--quick"] if settings.quick else []
        return ["-m", f"benchmarks.{self.file}", *self.arguments.split(), *passed, *quick]

    def reason_to_leave_out(self, settings: Settings) -> str | None:
        """Why it cannot run here; None where it can."""
        missing = [name for name in self.packages if importlib.util.find_spec(name) is None]
        if missing:
            return f"{', '.join(missing)} missing: install the extra `bench`"
        if self.needs_mitsuba and settings.mitsuba is None:
            return "no --mitsuba PYTHON to render it with"
        return None


_WORK = ("work",)
_PEER = ("coverage_path_planner",)
PARTS = (
    Part(name="camera-speed", module="camera", arguments="--only speed"),
    Part(
        name="camera-calibration", module="camera", arguments="--only calibration target housings"
    ),
    Part(name="planner", packages=_PEER),
    Part(name="planner-angles", module="planner", arguments="--angles", long=True, packages=_PEER),
    Part(name="studio"),
    Part(name="vehicle"),
    Part(name="missions"),
    Part(name="faults", packages=("rclpy",)),
    Part(name="bend", passes=_WORK),
    Part(name="precision", passes=_WORK, long=True),
    Part(name="draws", passes=_WORK, long=True),
    Part(name="cluster", passes=_WORK, long=True, packages=("distributed",)),
    Part(name="scale", passes=_WORK, long=True),
    Part(name="many-pictures", passes=_WORK, long=True),
    Part(name="refine-gpu", packages=("numba_cuda",)),
    Part(
        name="reconstruct-peers",
        module="reconstruct",
        arguments="--only peers",
        passes=("work", "demo", "pyorthomosaic"),
        long=True,
    ),
    Part(name="harbour", passes=_WORK, long=True),
    Part(name="facade", passes=("work", "mitsuba"), long=True, needs_mitsuba=True),
    Part(name="turbid", passes=_WORK, long=True),
    Part(name="mosaic", passes=_WORK, long=True),
    Part(name="colour", passes=_WORK, long=True),
    Part(name="real-pictures", passes=("data", "work"), long=True),
)


def chosen(names: Sequence[str]) -> list[Part]:
    """Parts by their names or by those of their modules, in their fixed order; all for none.

    Raises:
        ValueError: there is no such part.
    """
    known = {part.name for part in PARTS} | {part.file for part in PARTS}
    if unknown := sorted(set(names) - known):
        raise ValueError(f"no part {', '.join(unknown)}; there are {', '.join(sorted(known))}")
    return [part for part in PARTS if not names or {part.name, part.file} & {*names}]
