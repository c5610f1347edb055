"""The parts of a report: products, model, pictures, camera, mission, and how to reproduce it."""

import math
import platform
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from alice_survey.app.report import plots
from alice_survey.app.report.figures import Figures
from alice_survey.app.report.held import Held, known_column
from alice_survey.app.report.planes import planes_section
from alice_survey.core import stages
from alice_survey.core.records import (
    CalibrationRecord,
    CalibrationReportRecord,
    CamerasRecord,
    ControlRecord,
    DomingRecord,
    FlightRecord,
    MeshRecord,
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

_MAX_LOST = 20
"""Pictures that are not in the model, of which more are only counted."""


def sections(figures: Figures, *, has_map: bool, has_mesh: bool) -> Iterator[Section]:
    """All parts for which there is something, and what is needed to reproduce the survey."""
    if has_map:
        yield _map(figures)
    held = figures.held
    mesh = held.read(MeshRecord)
    if has_mesh and mesh is not None:
        yield _mesh(mesh, held.unit)
    if figures.truth is not None:
        yield _truth(figures.truth, held)
    if figures.reference or held.earlier:
        yield _compared(figures)
    if figures.control is not None:
        yield _control(figures.control)
    if held.has("dense"):
        yield _surface(figures)
    planes = planes_section(held)
    if planes is not None:
        yield planes
    if figures.registration is not None:
        yield _model(figures, figures.registration)
    if held.has("mapping") or held.has("calibration"):
        yield _camera(figures)
    if held.rows("quality/quality.csv"):
        yield _quality(held)
    if held.plan is not None:
        yield _mission(held, held.plan)
    yield _reproduce(figures)


def _map(figures: Figures) -> Section:
    held = figures.held
    footprints = held.rows("mosaic/footprints.csv")
    text = []
    if held.has("plan", "flight"):
        text.append(
            "Plan and flown track differ by navigation's error as well as by the vehicle's."
        )
    tables = []
    areas, pixels = (known_column(footprints, name) for name in ("area_", "ground_pixel_"))
    if len(areas) and len(pixels):
        tables.append(
            Table(
                title="Footprints",
                header=("", "least", "median", "most"),
                rows=[
                    ("area of a picture", *(f"{v:.2f} {held.unit}²" for v in _three(areas))),
                    ("pixel on the floor", *(length(v, held.unit) for v in _three(pixels))),
                ],
            )
        )
    return Section(name="map", title="Map", text=text, tables=tables, scene="map")


def _three(values: Any) -> tuple[float, float, float]:
    return float(values.min()), float(np.median(values)), float(values.max())


def _mesh(found: MeshRecord, unit: str) -> Section:
    return Section(
        name="mesh",
        title="Mesh",
        text=[
            f"{count(found.triangles, 'triangle')}, {digits(found.area)} {unit}² of "
            f"surface, {share(found.textured_share)} of it with texture. The files are "
            "in mesh/."
        ],
        scene="mesh",
    )


def _truth(score: ScoreRecord, held: Held) -> Section:
    cameras, surface, mosaic = score.cameras, score.surface, score.mosaic
    rows: list[Sequence[str]] = [
        ("cameras", _mm(cameras.rms_mm), _mm(cameras.max_mm), "position, rms"),
        ("surface", _mm(surface.distance_rms_mm), _mm(surface.distance_max_mm),
         "distance from the true surface, rms over all cells"),
        ("mosaic", _mm(mosaic.position_rms_mm), _mm(mosaic.position_95_mm),
         "position, rms; 95 % are below the larger one"),
        ("lengths", _mm(score.lengths.rms_mm), "",
         f"rms, over {length(score.lengths.mean_length_m)}"),
        ("dome", _mm(surface.doming.dome_mm), "", "bend of the whole surface"),
    ]  # fmt: skip
    seen = surface.seen_from_3_stations
    if seen is not None:
        rows.insert(
            2, ("surface, 3 stations and more", _mm(seen.distance_rms_mm), "",
                f"{share(seen.share)} of the area"),
        )  # fmt: skip
    if score.mesh is not None:
        rows.insert(
            3, ("mesh", _mm(score.mesh.distance_rms_mm), "", "distance from the true surface, rms")
        )
    within = surface.completeness_within_px
    return Section(
        name="truth",
        title="Error against the truth",
        text=[
            "The sea floor was simulated, so that every error is known. The model was moved and "
            "turned onto the truth by its cameras; its scale was not fitted: it is "
            f"{parts(1e-6 * cameras.scale_error_ppm)} off."
        ],
        tables=[
            Table(title="Errors", header=("what", "error", "largest", "of"), rows=rows),
            Table(
                title="Share of the area within so many ground pixels "
                f"({_mm(surface.ground_pixel_mm)}) of the truth",
                header=[f"{pixels} px" for pixels in within],
                rows=[[share(value) for value in within.values()]],
            ),
        ],
        figures=_stills(held, [
            ("evaluation/errors.png", "Where the surface errs",
             "Map and histogram of height errors.",
             "Without a slope or a dome.",
             "Errors at the rim come from few pictures; a dome from calibration."),
        ]),
    )  # fmt: skip


def _mm(value: float | None) -> str:
    return "" if value is None else millimetres(value)


def _compared(figures: Figures) -> Section:
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
        tables.append(
            Table(
                title=f"Distances from {found.reference.rsplit('/', 1)[-1]}",
                header=("", "median", "rms", "95 %", "covered"),
                rows=rows,
            )
        )
        stills.append(
            ("reference/reference.png", "Distance from the reference",
             "Signed distance after the registration.", "No slope, no dome.",
             "A dome or a slope is the survey's, or the registration's.")
        )  # fmt: skip
    for name, change in figures.held.earlier:
        tables.append(
            Table(
                title=f"Change since {name}",
                header=("what", "value"),
                rows=[(name.replace("_", " "), _plain(v)) for name, v in change.plain.items()],
            )
        )
        stills.append(
            (f"against/{name}/change.png", f"Change since {name}",
             "Height minus that of the earlier survey, and how sure it is.",
             "Where nothing has changed, nothing is coloured.", "")
        )  # fmt: skip
    return Section(
        name="compared",
        title="Against other data",
        tables=tables,
        figures=_stills(figures.held, stills),
    )


def _plain(value: float | str) -> str:
    return digits(float(value)) if isinstance(value, float) else str(value)


def _control(score: ControlRecord) -> Section:
    points: list[Sequence[str]] = [
        (row.name, row.use, str(row.views), length(row.north_m), length(row.east_m),
         length(row.down_m), digits(row.misfit_sigmas, 2))
        for row in score.points
    ]  # fmt: skip
    bars: list[Sequence[str]] = [
        (row.name, row.use, length(row.known_m), length(row.error_m),
         parts(row.error_relative), digits(row.misfit_sigmas, 2))
        for row in score.bars
    ]  # fmt: skip
    tables = []
    if points:
        header = ("point", "use", "pictures", "north", "east", "down", "in sigmas")
        tables.append(Table(title="Points", header=header, rows=points))
    if bars:
        columns = ("bar", "use", "length", "error", "relative", "in sigmas")
        tables.append(Table(title="Scale bars", header=columns, rows=bars))
    return Section(
        name="control",
        title="Control and check points",
        text=["Those used as check took no part in placing the model."],
        tables=tables,
    )


def _surface(figures: Figures) -> Section:
    surface, held = figures.surface, figures.held
    found = held.read(SurfaceRecord)
    if surface is None or found is None:
        return Section(name="surface", title="Surface")
    unit = held.unit
    rows = [
        ("cell", length(surface.cell, unit)),
        ("area with a height", f"{digits(surface.area)} {unit}²"),
        ("relief (99 % of it)", length(surface.high - surface.low, unit)),
        ("share of the planned area", share(surface.covered)),
        ("sigma of a height, median", length(surface.sigma_median, unit)),
        ("of that the cameras' share", length(found.pose_sigma, unit)),
        ("sigma of a match", f"{digits(found.match_sigma_px, 2)} px"),
        ("stations that see a spot, median", f"{surface.stations_median:.0f}"),
        ("heights count from", found.vertical_datum),
    ]
    text = []
    moving = found.moving
    if moving is not None and moving.masked:
        text.append(
            f"Parts of {moving.masked} of {count(moving.pictures, 'picture')} are masked "
            f"({moving.masked_share:.2%} of the area of all): other stations show something else "
            "there. They move, or are shadows that move with the lamps. Mosaic and texture do "
            "without them. mask_moving = false below [reconstruct] keeps them."
        )
    drawn = [
        plots.heights(figures), plots.sigma_test(figures), plots.seen_by(figures),
        *_stills(held, [
            ("dense/moving.png", "What moves",
             "Masked parts of the pictures in which they are largest, outlined.",
             "Fish, weed, divers, shadows.",
             "Look at dense/moving; mask_moving = false below [reconstruct] keeps all."),
        ]),
    ]  # fmt: skip
    return Section(
        name="surface",
        title="Surface",
        text=text,
        tables=[Table(title="Elevation model", header=("what", "value"), rows=rows)],
        figures=[figure for figure in drawn if figure is not None],
    )


def _model(figures: Figures, found: RegistrationRecord) -> Section:
    rows = [
        ("pictures", f"{found.registered} of {found.total}"),
        ("points", f"{found.points:,}"),
        ("pictures that see a point, mean", digits(found.mean_track_length)),
        ("reprojection error, mean", f"{digits(found.mean_reprojection_px)} px"),
        ("scale", found.scale_source or "unknown"),
    ]
    doming = found.doming or DomingRecord()
    for way, bend in doming.bends.items():
        rows.append((f"sag {way} the lines", length_with_sigma(bend.sag_m, bend.sag_sigma_m)))
        taken_out = bend.straightened_per_m * bend.length_m**2 / 8.0
        rows.append((f"sag {way} the lines that navigation took out", length(taken_out)))
    scale = doming.scale
    if scale is not None:
        own = parts_with_sigma(scale.mean - 1.0, scale.mean_sigma)
        rows.append(("scale by what each station sees alone", own))
    place = found.georeference
    if place is not None:
        residuals = (place.rms_north_m, place.rms_east_m, place.rms_depth_m)
        sigmas = (place.sigma_north_m, place.sigma_east_m, place.sigma_depth_m)
        axes = ("north", "east", "depth")
        rows += [
            (f"navigation's residual {axis}", f"{length(value)} rms")
            for axis, value in zip(axes, residuals, strict=True)
            if value is not None
        ]
        rows += [
            (f"sigma of the whole survey, {axis}", length(value))
            for axis, value in zip(axes, sigmas, strict=True)
            if value is not None
        ]
        if place.sigma_heading_deg is not None:
            rows.append(("sigma of its heading", _degrees(place.sigma_heading_deg)))
        if place.sigma_tilt_deg is not None:
            rows.append(("sigma of its level", _degrees(place.sigma_tilt_deg)))
        if place.mount is not None:
            rows.append(("mount of the rig", place.mount.words))
    for joint in found.joints:
        apart = (joint.sigma_north_m, joint.sigma_east_m, joint.sigma_depth_m)
        what = f"of {count(joint.stations, 'station')} that navigation alone joins to the others"
        rows.append(
            (f"sigma north, east and depth {what}", ", ".join(length(value) for value in apart))
        )
        rows.append((f"sigma of heading {what}", _degrees(joint.sigma_heading_deg)))
    lost = figures.held.rows("sparse/unregistered.csv")
    tables = [Table(title="Model", header=("what", "value"), rows=rows)]
    if lost:
        shown = [(row["image"], row["reason"], row["placed_by"] or "not placed") for row in lost]
        if len(shown) > _MAX_LOST:
            rest = f"{len(shown) - _MAX_LOST} more in sparse/unregistered.csv"
            shown = [*shown[:_MAX_LOST], (rest, "", "")]
        tables.append(
            Table(title="Pictures not in the model", header=("picture", "why", "placed by"),
                  rows=shown)
        )  # fmt: skip
    notes = figures.held.frame.notes
    drawn = [plots.camera_sigmas(figures), plots.pictures_used(figures)]
    return Section(
        name="model",
        title="Camera track and points",
        text=[f"How it was made: {'; '.join(notes)}."] if notes else [],
        tables=tables,
        figures=[figure for figure in drawn if figure is not None],
    )


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{digits(value, 2)} deg"


def _camera(figures: Figures) -> Section:
    held = figures.held
    calibrated, refined = held.read(CalibrationReportRecord), held.read(PortRecord)
    own, cameras = held.read(CalibrationRecord), held.read(CamerasRecord)
    text, tables, drawn = [], [], []
    if calibrated is not None:
        text.append(
            f"Calibrated from {count(calibrated.views, 'view')}: "
            f"{digits(calibrated.rms_px, 2)} px rms. The calibration's own report is "
            "calibration/report.html."
        )
        tables.append(
            Table(
                title="Calibration",
                header=("parameter", "value", "sigma", "unit"),
                rows=[
                    (row.name, f"{row.value:.8g}", _sigma(row.sigma), row.unit)
                    for row in calibrated.parameters
                ],
            )
        )
    if refined is not None:
        text.append(
            f"The survey's own pictures refined the rig from {refined.observations:,} "
            f"observations at {refined.stations} stations, within what calibration knew."
        )
        if refined.contradiction is not None:
            text.append(f"But {refined.contradiction}.")
        tables.append(
            Table(
                title="Rig refined by the survey",
                header=("parameter", "calibrated", "refined", "sigma before", "sigma after"),
                rows=[
                    (name, f"{a:.8g}", f"{b:.8g}", _sigma(before), _sigma(after))
                    for name, a, b, before, after in zip(
                        refined.parameters,
                        refined.before,
                        refined.after,
                        refined.prior_sigmas,
                        refined.sigmas,
                        strict=True,
                    )
                ],
            )
        )
        drawn.append(plots.correlations(refined.parameters, np.array(refined.correlation)))
    elif own is not None:
        drawn.append(plots.correlations(own.parameters, np.array(own.correlation)))
    if cameras is not None:
        rig_file = held.file("sparse/rig.json") or stages.rig_file(held.workspace)
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
        place: list[str] = []
        if rig is not None:
            first = rig.cam_from_rig[next(iter(cameras.cameras))]
            pose = first * rig.cam_from_rig[name].inv()
            tilt = np.rad2deg(np.arccos(np.clip(pose.rotation.as_matrix()[2, 2], -1.0, 1.0)))
            shift = ", ".join(f"{1e3 * value:z.1f}" for value in pose.translation)
            place = [f"{shift} mm", f"{tilt:.1f} deg"]
        housings.append((name, one.port.words, *place))
    tables = [
        Table(title="Cameras", header=("camera", "pixels", "lens", "parameters"), rows=lenses)
    ]
    if rig is not None:
        header = ("camera", "housing", "right, down, forward", "off the first's axis")
        tables.append(Table(title="Housings and places", header=header, rows=housings))
    return tables


def _sigma(value: float | None) -> str:
    if value is None or not math.isfinite(value) or value == 0.0:
        return "held"
    return f"{value:.2g}"


def _quality(held: Held) -> Section:
    rows = held.rows("quality/quality.csv")
    flagged = [row for row in rows if row["reasons"]]
    table = Table(
        title="Pictures that stand out",
        header=("picture", "why"),
        rows=[(row["image"], row["reasons"]) for row in flagged] or [("none", "")],
    )
    return Section(
        name="quality",
        title="Quality of the pictures",
        text=[f"{len(flagged)} of {count(len(rows), 'picture')} stand out; all are used where "
              "they can be."],
        tables=[table],
        figures=_stills(held, [
            ("quality/quality.png", "Quality along the survey",
             "Sharpness, contrast, brightness and veil of each picture.",
             "An even band.", "Look at the pictures named."),
        ]),
    )  # fmt: skip


def _mission(held: Held, plan: Plan) -> Section:
    rows = [
        ("altitude, speed", f"{plan.altitude_m:g} m, {plan.speed_mps:g} m/s"),
        ("lines", f"{len(plan.lines)}, {plan.line_spacing_m:.2f} m apart"),
        ("stations", f"{plan.stations}, {plan.station_spacing_m:.2f} m apart"),
        ("overlap", f"{plan.reached_forward_overlap:.0%} forward, "
                    f"{plan.reached_side_overlap:.0%} side"),
        ("a picture every", f"{plan.interval_s:.2f} s"),
        ("exposure", f"{1e3 * plan.exposure_s:.2g} ms"),
        ("motion blur", f"{plan.blur_px:.2f} px"),
        ("pixel on the floor", length(plan.pixel_m)),
        ("dives, time, energy", f"{len(plan.dives)}, {duration(plan.duration_s)}, "
                                f"{plan.energy_wh:.1f} Wh"),
    ]  # fmt: skip
    tables = [Table(title="Plan", header=("what", "value"), rows=rows)]
    flight = held.read(FlightRecord)
    if flight is not None:
        line = flight.on_lines
        tables.append(
            Table(
                title="Flight",
                header=("what", "value"),
                rows=[
                    ("ending", flight.ending),
                    ("stations", f"{flight.stations} of {flight.stations_planned}"),
                    ("time", duration(flight.duration_s)),
                    ("energy", f"{sum(flight.energy_wh.values()):.1f} Wh"),
                    ("off the line", f"{length(line.cross_track_rms_m)} rms"),
                    ("of that the control's part",
                     f"{length(line.believed_cross_track_rms_m)} rms"),
                    ("error of navigation", f"{length(flight.navigation_error_rms_m)} rms"),
                    ("pictured as often as required", share(flight.coverage.share_at_overlap)),
                ],
            )
        )  # fmt: skip
    settings = held.file("plan/settings.txt")
    text = ["Every setting with its equation, source and limit is in plan/settings.txt."]
    return Section(
        name="mission",
        title="Mission",
        text=text if settings is not None else [],
        tables=tables,
        figures=_stills(held, [
            ("plan/map.png", "The plan", "Area, lines, turns and stations.", "", ""),
            ("flight/track.png", "Plan and flown track", "Where the vehicle flew, and how far "
             "it was off its lines.", "The track lies on the lines.",
             "Check the current, the thrusters and navigation."),
        ]),
    )  # fmt: skip


def _stills(held: Held, wanted: Sequence[tuple[str, str, str, str, str]]) -> list[Figure]:
    """Pictures that stages have drawn: path, title, what it shows, good, otherwise."""
    found = []
    for path, title, shows, good, otherwise in wanted:
        file = held.file(path)
        if file is not None:
            found.append(
                Figure(
                    png=shrunk_png(file), title=title, alt=shows, shows=shows, good=good,
                    otherwise=otherwise,
                )
            )  # fmt: skip
    return found


_PACKAGES = (
    "alice-survey", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "pycolmap",
    "open3d", "rasterio", "shapely", "pyproj",
)  # fmt: skip
_SETTINGS = "survey.toml"
_SHORT = 12
"""Length of a digest as shown."""


def _reproduce(figures: Figures) -> Section:
    """Stages, versions, settings and files."""
    held = figures.held
    drawn = plots.stage_times(figures)
    makers = (_stage_table, _version_table, _settings_table, _file_table)
    tables = [table_of(held) for table_of in makers]
    return Section(
        name="reproduce",
        title="Time, versions and settings",
        text=list(_reproduction(held)),
        figures=[] if drawn is None else [drawn],
        tables=[table for table in tables if table.rows],
    )


def _reproduction(held: Held) -> Iterator[str]:
    settings = held.workspace / _SETTINGS
    if settings.is_file():
        yield (
            "The same settings, inputs and versions give the same results; a stage is run again "
            "when its digest changes."
        )
    if held.simulated:
        yield "Everything is seeded: 'alice-survey run' with the same survey.toml flies it again."


def _stage_table(held: Held) -> Table:
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
    import tomllib

    path = held.workspace / _SETTINGS
    rows: list[tuple[str, str]] = []
    if path.is_file():
        for key, value in tomllib.loads(path.read_text(encoding="utf-8")).items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            rows += [(f"{key}.{name}".rstrip("."), _shortened(part)) for name, part in parts]
    return Table(title="Settings in survey.toml", header=("setting", "value"), rows=rows)


def _shortened(value: object) -> str:
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
