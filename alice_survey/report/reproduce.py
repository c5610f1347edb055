"""What it takes to make a survey again: settings, versions, digests, time and memory."""

import platform
from collections.abc import Iterator
from importlib.metadata import version

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
        memory = stage.get("peak_mib")
        rows.append(
            (
                name,
                str(stage.get("version", "")),
                duration(float(stage.get("took_s", 0.0))),
                "" if stage.get("cpu_s") is None else duration(float(stage["cpu_s"])),
                "" if memory is None else f"{memory:.0f} MiB",
                f"{len(stage.get('inputs', {}))}",
                str(stage.get("digest", ""))[:_SHORT],
            )
        )
    header = ("stage", "version", "time", "CPU time", "memory", "input files", "digest")
    return Table(title="Stages", header=header, rows=rows)


def _versions(held: Held) -> Table:
    recorded: dict[str, str] = {}
    for stage in held.stages.values():
        recorded |= stage.get("versions") or {}
    rows = [(name, recorded.get(name) or version(name)) for name in _PACKAGES]
    rows.append(("Python", platform.python_version()))
    rows.append(("machine", f"{platform.system()} {platform.machine()}"))
    return Table(title="Versions", header=("package", "version"), rows=rows)


def _changed(held: Held) -> Table:
    """The settings as they are in the file: what is not there has its default."""
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


_PRODUCTS = (
    ("sparse/track.csv", "camera track with sigmas"),
    ("sparse/model", "COLMAP model"),
    ("dense/dem.tif", "elevation model (GeoTIFF)"),
    ("dense/sigma.tif", "sigma of its heights"),
    ("dense/cloud.laz", "point cloud with colour, normal, sigma"),
    ("mosaic/mosaic.tif", "orthomosaic (cloud-optimised GeoTIFF)"),
    ("mosaic/footprints.geojson", "what each picture shows"),
    ("mesh/mesh.glb", "textured mesh"),
    ("evaluation/score.json", "errors against the truth"),
    ("plan/exports", "plan for vehicles"),
)


def _files(held: Held) -> Table:
    rows = []
    for path, about in _PRODUCTS:
        whole = held.workspace / path
        if path.split("/")[0] in held.stages and whole.exists():
            size = whole.stat().st_size / 1e6 if whole.is_file() else None
            rows.append((path, about, "" if size is None else f"{size:.1f} MB"))
    return Table(title="Files", header=("file", "what it is", "size"), rows=rows)
