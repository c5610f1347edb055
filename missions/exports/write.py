"""All exports of a plan: missions that vehicles load, and files that people look at."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from alice_survey.base.artefacts import atomic_path, read_stage
from alice_survey.base.config import SurveyConfig, parse_config
from alice_survey.base.errors import PlanError
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from camera_calib.rig import Rig, design_rig
from missions.exports.cola2 import write_cola2, write_cola2_v1
from missions.exports.geojson import write_geojson
from missions.exports.gpx import write_gpx
from missions.exports.kml import write_kml
from missions.exports.mavlink import Item, mission_items
from missions.exports.mount import Mount, mount_of
from missions.exports.options import Options, line_tolerance_m
from missions.exports.places import lat_lon
from missions.exports.qgroundcontrol import write_qgroundcontrol, write_qgroundcontrol_survey
from missions.exports.tables import write_lines, write_stations, write_waypoints
from missions.exports.waypoints import Waypoint, all_waypoints
from missions.exports.wpl import write_wpl
from missions.values.plan_file import Plan, read_plan

Format = Literal["cola2", "cola2-v1", "qgc", "qgc-survey", "wpl", "kml", "gpx", "geojson", "csv"]
FORMATS: tuple[Format, ...] = get_args(Format)


@dataclass(frozen=True, kw_only=True)
class _Job:
    plan: Plan
    rig: Rig
    mount: Mount
    options: Options
    dives: list[tuple[Waypoint, ...]]
    tolerance_m: float
    home_lat_lon_deg: tuple[float, float]

    def items(self, dive: int) -> list[Item]:
        return mission_items(self.plan, self.dives[dive], self.tolerance_m)


@progress.step("write missions for vehicles")
def write_exports(
    folder: Path,
    plan: Plan,
    rig: Rig,
    *,
    formats: Sequence[str] | None = None,
    options: Options | None = None,
    line_depths: Sequence[Array] | None = None,
) -> list[Path]:
    """Write a plan in the formats of vehicles, planners and maps.

    What a vehicle flies is one file a dive (`mission_dive1.xml`), what is looked at is one file.

    Args:
        folder: where to; made when missing.
        plan: the plan.
        rig: its cameras on the vehicle.
        formats: some of `FORMATS`; None for all.
        options: what vehicles need said beside the plan.
        line_depths: of each line the glass's depth at its stations, (stations,); None for the
            plan's own.

    Returns:
        The files, in order.

    Raises:
        PlanError: a format is not known, or depths do not fit.
    """
    wanted = _known(formats)
    given = options or Options()
    mount = mount_of(rig, given.altimeter_body_m)
    ((lat, lon),) = lat_lon(plan.datum, _home_ne(plan, mount), 0.0)
    job = _Job(
        plan=plan,
        rig=rig,
        mount=mount,
        options=given,
        dives=all_waypoints(plan, mount, line_depths),
        tolerance_m=line_tolerance_m(plan, rig, given),
        home_lat_lon_deg=(float(lat), float(lon)),
    )
    folder.mkdir(parents=True, exist_ok=True)
    files = [path for name in wanted for path in _WRITERS[name](folder, job)]
    return [*files, _write_about(folder / "about.txt", job, files)]


def export_report(
    plan_path: Path,
    formats: Sequence[str] | None = None,
    out: Path | None = None,
    config: SurveyConfig | None = None,
    *,
    camera_on: str | None = None,
    camera_off: str | None = None,
) -> tuple[str, dict[str, Any]]:
    """`alice-survey plan export`: write a finished plan in the formats of vehicles and maps.

    Args:
        plan_path: `plan.json`, or the folder that holds it.
        formats: some of `FORMATS`; None for all.
        out: folder to write to; None for `exports` beside the plan.
        config: the survey, for where camera and altimeter are; None for the settings that the plan
            was made with, which lie beside it.
        camera_on: COLA2's service that starts pictures; None for the default of `Options`.
        camera_off: the one that stops them.

    Returns:
        What to print, and the same as JSON values.

    Raises:
        PlanError: it is no plan, or a format is not known.
    """
    path = plan_path / "plan.json" if plan_path.is_dir() else plan_path
    plan = read_plan(path)
    survey = config if config is not None else _config_beside(path)
    rig = design_rig(survey.camera, survey.water)
    default = Options()
    options = Options(
        altimeter_body_m=survey.camera.dvl_position_body_m,
        pixel_um=survey.camera.pixel_um,
        camera_on=default.camera_on if camera_on is None else camera_on,
        camera_off=default.camera_off if camera_off is None else camera_off,
    )
    folder = path.parent / "exports" if out is None else out
    files = write_exports(folder, plan, rig, formats=formats, options=options)
    tolerance_m = line_tolerance_m(plan, rig, options)
    text = "\n".join(
        [
            f"{folder}: {counted(len(files), 'file')} of {counted(plan.stations, 'station')} in "
            f"{counted(len(plan.dives), 'dive')}, tolerance {tolerance_m:.3f} m",
            *(f"  {file.name:<24}{file.stat().st_size / 1000:>9.1f} kB" for file in files),
        ]
    )
    about = {
        "folder": str(folder),
        "tolerance_m": tolerance_m,
        "files": [{"name": file.name, "bytes": file.stat().st_size} for file in files],
    }
    return text, about


def _known(formats: Sequence[str] | None) -> list[Format]:
    if formats is None:
        return list(FORMATS)
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise PlanError(f"format {unknown[0]!r} is not known; known are {', '.join(FORMATS)}")
    return [name for name in FORMATS if name in formats]


def _home_ne(plan: Plan, mount: Mount) -> Array:
    """Where the reference point is when the glass is at home, headed as the first dive starts."""
    first = plan.dives[0].route.legs[0]
    heading = np.array([first.heading_rad + first.side_rad])
    return mount.vehicle_ne(np.array([plan.home_ne_m]), heading)


def _each_dive(
    folder: Path, job: _Job, name: str, write: Callable[[Path, int], None]
) -> list[Path]:
    paths = [folder / name.format(number + 1) for number in range(len(job.dives))]
    for number, path in enumerate(paths):
        write(path, number)
    return paths


def _cola2(folder: Path, job: _Job) -> list[Path]:
    def write(path: Path, dive: int) -> None:
        write_cola2(path, job.plan, job.dives[dive], job.mount, job.options, job.tolerance_m)

    return _each_dive(folder, job, "mission_dive{}.xml", write)


def _cola2_v1(folder: Path, job: _Job) -> list[Path]:
    def write(path: Path, dive: int) -> None:
        write_cola2_v1(path, job.plan, job.dives[dive], job.mount, job.options, job.tolerance_m)

    return _each_dive(folder, job, "mission_v1_dive{}.xml", write)


def _qgc(folder: Path, job: _Job) -> list[Path]:
    def write(path: Path, dive: int) -> None:
        write_qgroundcontrol(
            path, job.plan, job.dives[dive], job.items(dive), job.home_lat_lon_deg, job.mount
        )

    return _each_dive(folder, job, "mission_dive{}.plan", write)


def _qgc_survey(folder: Path, job: _Job) -> list[Path]:
    def write(path: Path, dive: int) -> None:
        write_qgroundcontrol_survey(
            path,
            job.plan,
            job.dives[dive],
            job.items(dive),
            job.home_lat_lon_deg,
            job.mount,
            job.rig,
            job.options,
        )

    return _each_dive(folder, job, "survey_dive{}.plan", write)


def _wpl(folder: Path, job: _Job) -> list[Path]:
    def write(path: Path, dive: int) -> None:
        write_wpl(path, job.home_lat_lon_deg, job.items(dive))

    return _each_dive(folder, job, "mission_dive{}.waypoints", write)


def _kml(folder: Path, job: _Job) -> list[Path]:
    write_kml(folder / "plan.kml", job.plan, job.rig)
    return [folder / "plan.kml"]


def _gpx(folder: Path, job: _Job) -> list[Path]:
    write_gpx(folder / "plan.gpx", job.plan, job.dives)
    return [folder / "plan.gpx"]


def _geojson(folder: Path, job: _Job) -> list[Path]:
    write_geojson(folder / "plan.geojson", job.plan, job.rig)
    return [folder / "plan.geojson"]


def _csv(folder: Path, job: _Job) -> list[Path]:
    write_lines(folder / "lines.csv", job.plan)
    write_stations(folder / "stations.csv", job.plan)
    write_waypoints(folder / "waypoints.csv", job.dives)
    return [folder / name for name in ("lines.csv", "stations.csv", "waypoints.csv")]


_WRITERS: dict[Format, Callable[[Path, _Job], list[Path]]] = {
    "cola2": _cola2, "cola2-v1": _cola2_v1, "qgc": _qgc, "qgc-survey": _qgc_survey, "wpl": _wpl,
    "kml": _kml, "gpx": _gpx, "geojson": _geojson, "csv": _csv,
}  # fmt: skip

_ABOUT = (
    ("mission_v1_dive", "COLA2 mission, version 1"),
    ("survey_dive", "QGroundControl plan for ArduSub, its lines as one survey item"),
    ("about.txt", "what the files hold, and how"),
    (".xml", "COLA2 mission, version 2.0 (SPARUS II)"),
    (".plan", "QGroundControl plan for ArduSub"),
    (".waypoints", "QGC WPL 110 mission for ArduSub"),
    (".kml", "KML for globes"),
    (".gpx", "GPX for chart plotters"),
    (".geojson", "GeoJSON for geographic information systems"),
    ("lines.csv", "table of the lines"),
    ("stations.csv", "table of the places of pictures"),
    ("waypoints.csv", "table of the way-points, of glass and vehicle"),
)


def about_file(file: Path) -> str:
    """What a file that `write_exports` wrote is, in words."""
    return next(about for part, about in _ABOUT if part in file.name)


def counted(number: int, what: str) -> str:
    """A number of things, in the singular where it is one."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _write_about(path: Path, job: _Job, files: Sequence[Path]) -> Path:
    """What the files are, and of which point of the vehicle."""
    text = [
        f"{job.plan.name}: plan of {counted(len(job.plan.lines), 'line')}, "
        f"{counted(job.plan.stations, 'station')}, {counted(len(job.dives), 'dive')}",
        "",
        f"Missions (.xml, .plan, .waypoints): {job.mount.about}",
        "Maps and tables (.kml, .gpx, .geojson, .csv): places are of the left port's glass; "
        "waypoints.csv has both.",
        f"Tolerance at the ends of lines: {job.tolerance_m:.3f} m.",
        f"COLA2 actions: {job.options.camera_on} starts pictures, {job.options.camera_off} stops "
        "them: name them as your vehicle does.",
        "",
        *(f"{file.name}: {about_file(file)}" for file in files),
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(text) + "\n", encoding="utf-8", newline="\n")
    return path


def _config_beside(path: Path) -> SurveyConfig:
    """Camera and water that a plan was made with."""
    stage = read_stage(path.parent)
    settings = {} if stage is None else stage.settings
    if "camera" not in settings or "water" not in settings:
        raise PlanError(
            f"{path}: lies in no finished plan folder, so that where the camera sits on the "
            "vehicle is not known: give the survey's settings too"
        )
    return parse_config({key: settings[key] for key in ("camera", "water")}, str(path.parent))
