"""The parts of a report: products, model, pictures, camera, mission, and how to reproduce it.

A number that the summary, the facts or a verdict says is not said again in a table.
"""

import math
import platform
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from alice_survey.app import stages
from alice_survey.app.report import plots
from alice_survey.app.report.figures import Figures
from alice_survey.app.report.held import Held, known_column
from alice_survey.core.records import (
    CalibrationReportRecord,
    CamerasRecord,
    ControlRecord,
    DomingRecord,
    FlightRecord,
    MeshRecord,
    MosaicRecord,
    PlaneRecord,
    PortRecord,
    RegistrationRecord,
    ScoreRecord,
    SurfaceRecord,
)
from alice_survey.kit.document import Figure, Section, Table
from alice_survey.kit.figure import shrunk_png
from alice_survey.kit.words import (
    count,
    digits,
    duration,
    length,
    length_with_sigma,
    millimetres,
    parts,
    parts_with_sigma,
    share,
)
from camera_calib.camera import camera_from_json
from camera_calib.rig import Rig, read_rig
from missions.values.plan_file import Plan
from reconstruct.stages import rig_file as rig_file_of

_MAX_LOST = 20
"""Pictures that are not in the model, of which more are only counted."""
_PACKAGES = (
    "alice-survey", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "pycolmap",
    "open3d", "rasterio", "shapely", "pyproj",
)  # fmt: skip
_SETTINGS = "survey.toml"
_DIGEST_CHARACTERS = 12


class _Still(NamedTuple):
    """A picture that a stage has drawn."""

    path: str
    title: str
    shows: str
    good: str = ""
    otherwise: str = ""


def sections(figures: Figures, *, has_map: bool, has_mesh: bool) -> Iterator[Section]:
    """All parts for which there is something, and what is needed to reproduce the survey."""
    held = figures.held
    mesh, plan = held.read(MeshRecord), held.plan
    if has_map:
        yield _map(held)
    if plan is not None and not held.has("dense"):  # the plan is the result so far
        yield _mission(held, plan)
    if has_mesh and mesh is not None:
        text = (
            f"{count(mesh.triangles, 'triangle')}, {digits(mesh.area)} {held.unit}² of surface, "
            f"{share(mesh.textured_share)} of it with texture. The files are in mesh/."
        )
        yield Section(name="mesh", title="Mesh", text=[text], scene="mesh")
    if figures.truth is not None:
        yield _truth(figures.truth, held)
    if figures.reference or held.earlier:
        yield _comparison(figures)
    if figures.control is not None:
        yield _control(figures.control)
    if held.has("dense"):
        yield _surface(figures)
    planes = list(_planes(held))
    if planes:
        text = (
            "The same surface as someone sees it who faces each plane. plane.json next to the "
            "rasters in dense/planes/ and mosaic/planes/ says where a pixel lies in space."
        )
        yield Section(name="planes", title="Planes", text=[text], figures=planes)
    if figures.registration is not None:
        yield _model(figures, figures.registration)
    if held.has("mapping") or held.has("calibration"):
        yield _camera(held)
    if held.rows("quality/quality.csv"):
        still = _Still("quality/quality.png", "Quality along the survey",
                       "Sharpness, contrast, brightness and veil of each picture.",
                       "An even band.", "Look at the pictures named.")  # fmt: skip
        yield Section(name="quality", title="Quality of the pictures", figures=_stills(held, still))
    if plan is not None and held.has("dense"):
        yield _mission(held, plan)
    yield _reproduce(held)


def _table(title: str, *rows: tuple[str, str | None]) -> Table:
    """What is known, by name; rows without a value are left out."""
    known = [(name, value) for name, value in rows if value not in (None, "", "unknown")]
    return Table(title=title, header=("what", "value"), rows=known)


def _map(held: Held) -> Section:
    footprints = held.rows("mosaic/footprints.csv")
    areas, pixels = (known_column(footprints, name) for name in ("area_", "ground_pixel_"))
    tables = []
    if len(areas) and len(pixels):
        rows = [
            ("area of a picture", *(f"{f(areas):.2f} {held.unit}²" for f in (min, np.median, max))),
            ("pixel on the floor", *(length(float(f(pixels)), held.unit)
                                     for f in (min, np.median, max))),
        ]  # fmt: skip
        header = ("", "least", "median", "most")
        tables.append(Table(title="Footprints", header=header, rows=rows))
    return Section(name="map", title="Map", tables=tables, scene="map")


def _truth(score: ScoreRecord, held: Held) -> Section:
    cameras, surface, mosaic = score.cameras, score.surface, score.mosaic
    seen, mesh = surface.seen_from_3_stations, score.mesh
    rows = [
        ("cameras", None, cameras.max_mm, "position"),
        ("surface", None, surface.distance_max_mm, "distance from the true surface"),
        ("mosaic", mosaic.position_rms_mm, mosaic.position_95_mm, "position; the larger: 95 %"),
        ("lengths", score.lengths.rms_mm, None, f"over {length(score.lengths.mean_length_m)}"),
        ("surface, 3 stations and more", None if seen is None else seen.distance_rms_mm, None,
         f"{share(None if seen is None else seen.share)} of the area"),
        ("mesh", None if mesh is None else mesh.distance_rms_mm, None, "distance from the truth"),
    ]  # fmt: skip
    within = surface.completeness_within_px
    return Section(
        name="truth",
        title="Error against the truth",
        text=[
            "The sea floor was simulated, so that every error is known. The model was moved and "
            "rotated onto the truth by its cameras; its scale was not fitted."
        ],
        tables=[
            Table(
                title="Errors",
                header=("what", "rms", "largest", "of"),
                rows=[
                    (name, *("" if mm is None else millimetres(mm) for mm in (rms, most)), of)
                    for name, rms, most, of in rows
                    if rms is not None or most is not None
                ],
            ),
            Table(
                title="Share of the area within so many ground pixels "
                f"({millimetres(surface.ground_pixel_mm)}) of the truth",
                header=[f"{pixels} px" for pixels in within],
                rows=[[share(value) for value in within.values()]],
            ),
        ],
        figures=[
            *_stills(held, _Still(
                "evaluation/errors.png", "Where the surface errs",
                "Map and histogram of height errors.", "Without a slope or a dome.",
                "Errors at the rim come from few pictures; a dome from calibration.",
            )),
        ],
    )  # fmt: skip


def _comparison(figures: Figures) -> Section:
    tables, stills = [], []
    found = figures.reference
    if found:
        rows = [
            (what, length(part.median_m), length(part.rms_m), length(part.within_95_m),
             share(part.covered_share))
            for what, part in (
                ("survey to reference", found.survey_to_reference),
                ("reference to survey", found.reference_to_survey),
            )
        ]  # fmt: skip
        title = f"Distances from {found.reference.rsplit('/', 1)[-1]}"
        header = ("", "median", "rms", "95 %", "covered")
        tables.append(Table(title=title, header=header, rows=rows))
        stills.append(
            _Still("reference/reference.png", "Distance from the reference",
                   "Signed distance after the registration.", "No slope, no dome.",
                   "A dome or a slope is the survey's, or the registration's.")
        )  # fmt: skip
    for name, change in figures.held.earlier:
        plain = change.plain.items()
        rows_of = [(key.replace("_", " "), _plain(value)) for key, value in plain]
        tables.append(_table(f"Change since {name}", *rows_of))
        stills.append(
            _Still(f"against/{name}/change.png", f"Change since {name}",
                   "Height minus that of the earlier survey, and how sure it is.",
                   "Where nothing has changed, nothing is coloured.")
        )  # fmt: skip
    return Section(
        name="compared",
        title="Against other data",
        tables=tables,
        figures=_stills(figures.held, *stills),
    )


def _plain(value: float | str) -> str:
    return digits(float(value)) if isinstance(value, float) else str(value)


def _control(score: ControlRecord) -> Section:
    points = [
        (row.name, row.use, str(row.views), length(row.north_m), length(row.east_m),
         length(row.down_m), digits(row.misfit_sigmas, 2))
        for row in score.points
    ]  # fmt: skip
    bars = [
        (row.name, row.use, length(row.known_m), length(row.error_m),
         parts(row.error_relative), digits(row.misfit_sigmas, 2))
        for row in score.bars
    ]  # fmt: skip
    tables = [
        Table(title="Points", rows=points,
              header=("point", "use", "pictures", "north", "east", "down", "in sigmas")),
        Table(title="Scale bars", rows=bars,
              header=("bar", "use", "length", "error", "relative", "in sigmas")),
    ]  # fmt: skip
    return Section(
        name="control",
        title="Control and check points",
        text=["Those used as check took no part in placing the model."],
        tables=[table for table in tables if table.rows],
    )


def _surface(figures: Figures) -> Section:
    held = figures.held
    found = held.read(SurfaceRecord)
    if figures.surface is None or found is None:
        return Section(name="surface", title="Surface")
    moving = found.moving
    masked = None
    if moving is not None and moving.masked:
        masked = (
            f"parts of {moving.masked} of {count(moving.pictures, 'picture')}, "
            f"{moving.masked_share:.2%} of the area of all; mask_moving = false keeps them"
        )
    rows = [
        ("share of a height's sigma that is the cameras'", length(found.pose_sigma, held.unit)),
        ("sigma of a match", f"{digits(found.match_sigma_px, 2)} px"),
        ("heights count from", found.vertical_datum),
        ("masked since it moves", masked),
    ]
    still = _Still(
        "dense/moving.png", "What moves",
        "Masked parts of the pictures in which they are largest, outlined.",
        "Fish, weed, divers, shadows.",
        "Look at dense/moving; mask_moving = false below [reconstruct] keeps all.",
    )  # fmt: skip
    return Section(
        name="surface",
        title="Surface",
        tables=[_table("Elevation model", *rows)],
        figures=[*plots.sigma_test(held), *plots.overlap(held), *_stills(held, still)],
    )


def _planes(held: Held) -> Iterator[Figure]:
    """Mosaic, else surface, of every further plane."""
    for stage, what in (("mosaic", "mosaic"), ("dense", "dem")):
        for folder in sorted((held.workspace / stage / "planes").glob("*")):
            painted = held.workspace / "mosaic" / "planes" / folder.name / "mosaic.png"
            there = held.has(stage) and all(
                (folder / name).is_file() for name in (f"{what}.png", "plane.json")
            )
            if there and (what == "mosaic" or not painted.is_file()):
                yield _plane(held, folder, what)


def _plane(held: Held, folder: Path, what: str) -> Figure:
    plane = PlaneRecord.read(folder / "plane.json")
    shows = f"Surface over the plane: {plane.about}. No picture looks at it."
    if what == "mosaic":
        found = MosaicRecord.read(folder / "mosaic.json")
        wide, high = (side * found.pixel for side in (found.width_px, found.height_px))
        shows = (
            f"Mosaic of the plane: {plane.about}, {length(wide, held.unit)} wide and "
            f"{length(high, held.unit)} high."
        )
    png = shrunk_png(folder / f"{what}.png")
    return Figure(png=png, title=f"Plane {plane.name}", alt=shows, shows=shows)


def _model(figures: Figures, found: RegistrationRecord) -> Section:
    rows: list[tuple[str, str | None]] = [
        ("points", f"{found.points:,}"),
        ("pictures that see a point, mean", digits(found.mean_track_length)),
    ]
    doming = found.doming or DomingRecord()
    for way, bend in doming.bends.items():
        removed = bend.straightened_per_m * bend.length_m**2 / 8.0
        rows.append((f"sag {way} the lines", length_with_sigma(bend.sag_m, bend.sag_sigma_m)))
        rows.append((f"sag {way} the lines that navigation took out", length(removed)))
    if doming.scale is not None:
        own = parts_with_sigma(doming.scale.mean - 1.0, doming.scale.mean_sigma)
        rows.append(("scale by what each station sees alone", own))
    place = found.georeference
    if place is not None:
        for axis in ("north", "east", "depth"):
            rms, sigma = (getattr(place, f"{kind}_{axis}_m") for kind in ("rms", "sigma"))
            rows.append((f"navigation's residual {axis}, rms", length(rms)))
            rows.append((f"sigma of the whole survey, {axis}", length(sigma)))
        rows.append(("sigma of its heading", _degrees(place.sigma_heading_deg)))
        rows.append(("sigma of its level", _degrees(place.sigma_tilt_deg)))
        rows.append(("mount of the rig", None if place.mount is None else place.mount.words))
    rows += [
        (f"sigma of heading of {count(joint.stations, 'station')} that navigation alone joins",
         _degrees(joint.sigma_heading_deg))
        for joint in found.joints
    ]  # fmt: skip
    tables = [_table("Model", *rows)]
    lost = [
        (row["image"], row["reason"], row["placed_by"] or "not placed")
        for row in figures.held.rows("sparse/unregistered.csv")
    ]
    if lost:
        more = len(lost) - _MAX_LOST
        rest = [(f"{more} more in sparse/unregistered.csv", "", "")] if more > 0 else []
        header, shown = ("picture", "why", "placed by"), [*lost[:_MAX_LOST], *rest]
        tables.append(Table(title="Pictures not in the model", header=header, rows=shown))
    notes = figures.held.frame.notes
    return Section(
        name="model",
        title="Camera track and points",
        text=[f"How it was made: {'; '.join(notes)}."] if notes else [],
        tables=tables,
        figures=[*plots.camera_sigmas(figures.held), *plots.pictures_used(figures.held)],
    )


def _degrees(value: float | None) -> str | None:
    return None if value is None else f"{digits(value, 2)} deg"


def _camera(held: Held) -> Section:
    calibrated, refined = held.read(CalibrationReportRecord), held.read(PortRecord)
    cameras = held.read(CamerasRecord)
    text, tables, drawn = [], [], list[Figure]()
    if calibrated is not None:
        text.append(
            f"Calibrated from {count(calibrated.views, 'view')}: "
            f"{digits(calibrated.rms_px, 2)} px rms. The calibration's own report, with every "
            "parameter, is calibration/report.html."
        )
    if refined is not None:
        text.append(
            f"The survey's own pictures refined the rig from {refined.observations:,} "
            f"observations at {refined.stations} stations, within what calibration knew."
        )
        if refined.contradiction is not None:
            text.append(f"But {refined.contradiction}.")
        values = zip(
            refined.parameters, refined.before, refined.after, refined.prior_sigmas,
            refined.sigmas, strict=True,
        )  # fmt: skip
        tables.append(
            Table(
                title="Rig refined by the survey",
                header=("parameter", "calibrated", "refined", "sigma before", "sigma after"),
                rows=[
                    (name, f"{a:.8g}", f"{b:.8g}", _sigma(before), _sigma(after))
                    for name, a, b, before, after in values
                ],
            )
        )
    if cameras is not None:
        rig_file = held.file("sparse/rig.json") or rig_file_of(held.workspace)
        rig = None if rig_file is None else read_rig(rig_file)
        if rig is None:
            text.append("The cameras calibrated themselves from the survey's pictures.")
        elif calibrated is None and refined is None:
            text.append(f"The rig is as imported with the pictures: {rig.source}.")
        tables += _cameras(cameras, rig)
        if rig is not None and rig.body_from_rig is not None:
            drawn.append(plots.mount(rig))
    return Section(name="camera", title="Camera and rig", text=text, tables=tables, figures=drawn)


def _cameras(cameras: CamerasRecord, rig: Rig | None) -> list[Table]:
    """Lens and housing of every camera and, where the rig is known, its place on it."""
    lenses, housings = [], []
    for name, warp in cameras.cameras.items():
        one = camera_from_json(warp["camera"])
        values = {key: one.parameter(key) for key in one.lens.parameters}
        terms = ", ".join(f"{key} {value:.6g}" for key, value in values.items() if value)
        lenses.append((name, f"{one.width_px} x {one.height_px}", one.lens.model, terms))
        if rig is not None:
            first = rig.cam_from_rig[next(iter(cameras.cameras))]
            pose = first * rig.cam_from_rig[name].inv()
            tilt = np.rad2deg(np.arccos(np.clip(pose.rotation.as_matrix()[2, 2], -1.0, 1.0)))
            shift = ", ".join(f"{1e3 * value:z.1f}" for value in pose.translation)
            housings.append((name, one.port.words, f"{shift} mm", f"{tilt:.1f} deg"))
    header = ("camera", "housing", "right, down, forward", "off the first's axis")
    tables = [
        Table(title="Cameras", header=("camera", "pixels", "lens", "parameters"), rows=lenses),
        Table(title="Housings and places", header=header, rows=housings),
    ]
    return [table for table in tables if table.rows]


def _sigma(value: float | None) -> str:
    if value is None or not math.isfinite(value) or value == 0.0:
        return "fixed"
    return f"{value:.2g}"


def _mission(held: Held, plan: Plan) -> Section:
    overlap = f"{plan.reached_forward_overlap:.0%} forward, {plan.reached_side_overlap:.0%} side"
    dives = f"{len(plan.dives)}, {duration(plan.duration_s)}, {plan.energy_wh:.1f} Wh"
    rows = [
        ("altitude, speed", f"{plan.altitude_m:g} m, {plan.speed_mps:g} m/s"),
        ("lines", f"{len(plan.lines)}, {plan.line_spacing_m:.2f} m apart"),
        ("stations", f"{plan.stations}, {plan.station_spacing_m:.2f} m apart"),
        ("overlap", overlap),
        ("covered as requested", share(plan.coverage)),
        ("a picture every", f"{plan.interval_s:.2f} s"),
        ("exposure", f"{1e3 * plan.exposure_s:.2g} ms"),
        ("motion blur", f"{plan.blur_px:.2f} px"),
        ("pixel on the floor", length(plan.pixel_m)),
        ("dives, time, energy", dives),
    ]
    tables = [_table("Plan", *rows)]
    flight = held.read(FlightRecord)
    if flight is not None:
        line = flight.on_lines
        tables.append(
            _table(
                "Flight",
                ("time", duration(flight.duration_s)),
                ("energy", f"{sum(flight.energy_wh.values()):.1f} Wh"),
                ("off the line, rms", length(line.cross_track_rms_m)),
                ("of that the control's part", length(line.believed_cross_track_rms_m)),
                ("error of navigation, rms", length(flight.navigation_error_rms_m)),
            )
        )
    settings = held.file("plan/settings.txt")
    text = ["Every setting with its equation, source and limit is in plan/settings.txt."]
    return Section(
        name="mission",
        title="Mission",
        text=text if settings is not None else [],
        tables=tables,
        figures=_stills(
            held,
            _Still("plan/map.png", "The plan", "Area, lines, turns and stations."),
            _Still("flight/track.png", "Plan and flown track", "Where the vehicle flew, and how "
                   "far it was off its lines; navigation's error is part of that.",
                   "The track lies on the lines.",
                   "Check the current, the thrusters and navigation."),
        ),
    )  # fmt: skip


def _stills(held: Held, *stills: _Still) -> list[Figure]:
    """Those that are there."""
    found = []
    for still in stills:
        file = held.file(still.path)
        if file is not None:
            found.append(
                Figure(
                    png=shrunk_png(file), title=still.title, alt=still.shows, shows=still.shows,
                    good=still.good, otherwise=still.otherwise,
                )
            )  # fmt: skip
    return found


def _reproduce(held: Held) -> Section:
    """Stages, versions, settings and files."""
    text = []
    if held.simulated:
        text.append("Everything is seeded: 'alice-survey run' with the same settings repeats it.")
    makers = (_stage_table, _version_table, _settings_table, _file_table)
    tables = [table_of(held) for table_of in makers]
    return Section(
        name="reproduce",
        title="Time, versions and settings",
        text=text,
        tables=[table for table in tables if table.rows],
    )


def _stage_table(held: Held) -> Table:
    rows = [
        (
            name,
            str(stage.version),
            duration(stage.took_s),
            "" if stage.cpu_s is None else duration(stage.cpu_s),
            "" if stage.peak_mib is None else f"{stage.peak_mib:.0f} MiB",
            f"{len(stage.inputs)}",
            stage.digest[:_DIGEST_CHARACTERS],
        )
        for name, stage in held.stages.items()
    ]
    header = ("stage", "version", "time", "CPU time", "memory", "input files", "digest")
    return Table(title="Stages", header=header, rows=rows)


def _version_table(held: Held) -> Table:
    recorded: dict[str, str] = {}
    for stage in held.stages.values():
        recorded |= stage.versions
    rows = [(name, recorded.get(name) or version(name)) for name in _PACKAGES]
    rows.append(("Python", platform.python_version()))
    rows.append(("machine", f"{platform.system()} {platform.machine()}"))
    return Table(title="Versions", header=("package", "version"), rows=rows)


def _settings_table(held: Held) -> Table:
    """Settings as in the file; missing ones have their defaults."""
    path = held.workspace / _SETTINGS
    rows: list[tuple[str, str]] = []
    if path.is_file():
        for key, value in tomllib.loads(path.read_text(encoding="utf-8")).items():
            inner = value.items() if isinstance(value, dict) else [("", value)]
            rows += [(f"{key}.{name}".rstrip("."), _shorten(part)) for name, part in inner]
    return Table(title="Settings in survey.toml", header=("setting", "value"), rows=rows)


def _shorten(value: object) -> str:
    text = str(value)
    return text if len(text) <= 120 else f"{text[:117]}..."


def _file_table(held: Held) -> Table:
    rows = []
    for stage in stages.STAGES:
        for path, about in stage.products.items():
            whole = held.workspace / stage.folder / path
            if stage.folder in held.stages and whole.exists():
                size = f"{whole.stat().st_size / 1e6:.1f} MB" if whole.is_file() else ""
                rows.append((f"{stage.folder}/{path}", about, size))
    return Table(title="Files", header=("file", "what it is", "size"), rows=rows)
