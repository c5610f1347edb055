"""What is needed to reproduce a survey: settings, versions, digests, time and memory."""

import platform
from collections.abc import Iterator
from importlib.metadata import version

from alice_survey import stages
from alice_survey.kit.document import Section, Table
from alice_survey.kit.words import duration
from alice_survey.report import plots
from alice_survey.report.figures import Figures
from alice_survey.report.held import Held

_PACKAGES = (
    "alice-survey", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "pycolmap",
    "open3d", "rasterio", "shapely", "pyproj",
)  # fmt: skip
_SETTINGS = "survey.toml"
_SHORT = 12
"""Length of a digest as shown."""


def section(figures: Figures) -> Section:
    """Stages, versions, settings and files."""
    held = figures.held
    drawn = plots.stage_times(figures)
    return Section(
        name="reproduce",
        title="Time, versions and settings",
        text=list(_words(held)),
        figures=[] if drawn is None else [drawn],
        tables=[
            table
            for table in (_stages(held), _versions(held), _changed(held), _files(held))
            if table.rows
        ],
    )


def _words(held: Held) -> Iterator[str]:
    settings = held.workspace / _SETTINGS
    if settings.is_file():
        yield (
            "The same settings, inputs and versions give the same results; a stage is run again "
            "when its digest changes."
        )
    if held.simulated:
        yield "Everything is seeded: 'alice-survey run' with the same survey.toml flies it again."


def _stages(held: Held) -> Table:
    rows = []
    for name, stage in held.stages.items():
        rows.append(
            (
                name,
                str(stage.version),
                duration(stage.took_s),
                "" if stage.cpu_s is None else duration(stage.cpu_s),
                "" if stage.peak_mib is None else f"{stage.peak_mib:.0f} MiB",
                f"{len(stage.inputs)}",
                stage.digest[:_SHORT],
            )
        )
    header = ("stage", "version", "time", "CPU time", "memory", "input files", "digest")
    return Table(title="Stages", header=header, rows=rows)


def _versions(held: Held) -> Table:
    recorded: dict[str, str] = {}
    for stage in held.stages.values():
        recorded |= stage.versions
    rows = [(name, recorded.get(name) or version(name)) for name in _PACKAGES]
    rows.append(("Python", platform.python_version()))
    rows.append(("machine", f"{platform.system()} {platform.machine()}"))
    return Table(title="Versions", header=("package", "version"), rows=rows)


def _changed(held: Held) -> Table:
    """Settings as in the file; missing ones have their defaults."""
    import tomllib

    path = held.workspace / _SETTINGS
    rows: list[tuple[str, str]] = []
    if path.is_file():
        for key, value in tomllib.loads(path.read_text(encoding="utf-8")).items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            rows += [(f"{key}.{name}".rstrip("."), _short(part)) for name, part in parts]
    return Table(title="Settings in survey.toml", header=("setting", "value"), rows=rows)


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 120 else f"{text[:117]}..."


def _files(held: Held) -> Table:
    rows = []
    for stage in stages.STAGES:
        for path, about in stage.products.items():
            whole = held.workspace / stage.folder / path
            if stage.folder in held.stages and whole.exists():
                size = f"{whole.stat().st_size / 1e6:.1f} MB" if whole.is_file() else ""
                rows.append((f"{stage.folder}/{path}", about, size))
    return Table(title="Files", header=("file", "what it is", "size"), rows=rows)
