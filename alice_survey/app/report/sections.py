"""The parts of a report: products, model, pictures, camera, mission, and how to reproduce it.

A number that the summary, the facts or a verdict says is not said again in a table.
"""

import platform
import tomllib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rasterio.enums import Resampling

from alice_survey.app import stages
from alice_survey.app.report.held import Held, number
from alice_survey.app.report.rasters import read_shrunk
from alice_survey.core.records import (
    CalibrationReportRecord,
    CamerasRecord,
    ControlRecord,
    FlightRecord,
    MeshRecord,
    PlaneRecord,
    PortRecord,
    ReferenceRecord,
    RegistrationRecord,
    ScoreRecord,
    SurfaceRecord,
)
from alice_survey.kit.document import Figure, Section, Table
from alice_survey.kit.figure import INKS, MARKS, draw_figure, shrunk_png
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
    sigma_length,
)
from camera_calib.camera import camera_from_json
from camera_calib.mount import mount_line
from camera_calib.rig import Rig, read_rig
from missions.values.plan_file import Plan
from reconstruct.stages import rig_file as rig_file_of

_MAX_LOST = 20
"""Pictures that are not in the model, of which more are only counted."""
_MAX_VALUES_PX = 4e6
_MAX_SETTING = 120
"""Characters of a setting's value that are shown."""
_DIGEST_CHARACTERS = 12


def sections(held: Held, *, has_map: bool, has_mesh: bool) -> Iterator[Section]:
    """All parts for which there is something, and what is needed to reproduce the survey."""
    mesh, plan = held.read(MeshRecord), held.plan
    score, control = held.read(ScoreRecord), held.read(ControlRecord)
    if has_map:
        yield Section(name="map", title="Map", scene="map")
    if plan is not None and not held.has("dense"):  # the plan is the result so far
        yield _mission(held, plan)
    if has_mesh and mesh is not None:
        text = (
            f"{count(mesh.triangles, 'triangle')}, {digits(mesh.area)} {held.unit}² of surface, "
            f"{share(mesh.textured_share)} of it with texture. The files are in mesh/."
        )
        yield Section(name="mesh", title="Mesh", text=[text], scene="mesh")
    planes = list(_planes(held))
    if planes:
        text = "plane.json next to the rasters of a plane says where a pixel lies in space."
        yield Section(name="planes", title="Planes", text=[text], figures=planes)
    if score is not None:
        yield _truth(score, held)
    if held.file(ReferenceRecord.path) or held.earlier:
        yield _comparison(held)
    if control is not None:
        yield _control(control)
    if held.has("dense"):
        yield _surface(held)
    if held.registration is not None:
        yield _model(held, held.registration)
    if held.rows("quality/quality.csv"):
        about = "Sharpness, contrast, brightness and veil of each picture along the survey."
        still = _stills(held, ("quality/quality.png", "Quality of the pictures", about))
        yield Section(name="quality", title="Quality of the pictures", figures=still)
    if held.has("mapping") or held.has("calibration"):
        yield _camera(held)
    if plan is not None and held.has("dense"):
        yield _mission(held, plan)
    yield _reproduce(held)


def _table(title: str, *rows: tuple[str, str | None]) -> Table:
    """What is known, by name; rows without a value are left out."""
    known = [(name, value) for name, value in rows if value not in (None, "", "unknown")]
    return Table(title=title, header=("what", "value"), rows=known)


def _stills(held: Held, *stills: tuple[str, str, str]) -> list[Figure]:
    """Pictures that stages have drawn, by path, title and what they show; those that are there."""
    return [
        Figure(png=shrunk_png(file), title=title, alt=shows, shows=shows)
        for path, title, shows in stills
        if (file := held.file(path)) is not None
    ]


def _truth(score: ScoreRecord, held: Held) -> Section:
    cameras, surface, mosaic = score.cameras, score.surface, score.mosaic
    mesh = score.mesh
    rows = [
        ("cameras", cameras.rms_mm, cameras.max_mm, "position"),
        ("surface", surface.distance_rms_mm, surface.distance_max_mm, "distance from the truth"),
        ("mosaic", mosaic.position_rms_mm, mosaic.position_95_mm, "position; the larger: 95 %"),
        ("lengths", score.lengths.rms_mm, None, f"over {length(score.lengths.mean_length_m)}"),
        ("mesh", None if mesh is None else mesh.distance_rms_mm, None, "distance from the truth"),
    ]  # fmt: skip
    shown = [
        (name, *("" if mm is None else millimetres(mm) for mm in (rms, most)), of)
        for name, rms, most, of in rows
        if rms is not None or most is not None
    ]
    text = "The model was moved and rotated onto the truth by its cameras, and not scaled."
    about = "Map and histogram of height errors: those at the rim come from few pictures, a dome "
    about += "from calibration."
    return Section(
        name="truth",
        title="Error against the truth",
        text=[text],
        tables=[Table(title="Errors", header=("what", "rms", "largest", "of"), rows=shown)],
        figures=_stills(held, ("evaluation/errors.png", "Where the surface errs", about)),
    )


def _comparison(held: Held) -> Section:
    tables, stills = [], []
    found = held.read(ReferenceRecord)
    if found is not None:
        rows = [
            (what, length(part.rms_m), length(part.within_95_m), share(part.covered_share))
            for what, part in (
                ("survey to reference", found.survey_to_reference),
                ("reference to survey", found.reference_to_survey),
            )
        ]
        header = ("", "rms", "95 %", "covered")
        tables.append(Table(title=f"Distances from {found.name}", header=header, rows=rows))
        about = "Signed distance after the registration."
        stills.append(("reference/reference.png", "Distance from the reference", about))
    for name, change in held.earlier:
        values = [
            (key.replace("_", " "), digits(value) if isinstance(value, float) else str(value))
            for key, value in change.plain.items()
        ]
        tables.append(_table(f"Change since {name}", *values))
        about = "Height minus that of the earlier survey, and how sure it is."
        stills.append((f"against/{name}/change.png", f"Change since {name}", about))
    return Section(
        name="compared", title="Against other data", tables=tables, figures=_stills(held, *stills)
    )


def _control(score: ControlRecord) -> Section:
    rows = [
        (row.name, row.use, count(row.views, "picture"),
         ", ".join(map(length, (row.north_m, row.east_m, row.down_m))),
         digits(row.misfit_sigmas, 2))
        for row in score.points
    ]  # fmt: skip
    rows += [
        (row.name, row.use, length(row.known_m),
         f"{length(row.error_m)}, {parts(row.error_relative)}", digits(row.misfit_sigmas, 2))
        for row in score.bars
    ]  # fmt: skip
    header = ("point or bar", "use", "of", "error (of a point north, east, down)", "in sigmas")
    return Section(
        name="control",
        title="Control and check points",
        text=["Those used as check took no part in placing the model."],
        tables=[Table(title="Points and scale bars", header=header, rows=rows)],
    )


def _surface(held: Held) -> Section:
    found = held.read(SurfaceRecord)
    if held.surface is None or found is None:
        return Section(name="surface", title="Surface")
    moving = found.moving
    masked = None
    if moving is not None and moving.masked:
        masked = (
            f"parts of {moving.masked} of {count(moving.pictures, 'picture')}, "
            f"{moving.masked_share:.2%} of the area of all; mask_moving = false keeps them"
        )
    rows = [
        ("a height's sigma from the cameras alone", sigma_length(found.pose_sigma, held.unit)),
        ("sigma of a match", f"{digits(found.match_sigma_px, 2)} px"),
        ("heights count from", found.vertical_datum),
        ("masked since it moves", masked),
    ]
    about = "Masked parts of the pictures in which they are largest, outlined."
    return Section(
        name="surface",
        title="Surface",
        tables=[_table("Elevation model", *rows)],
        figures=[*_sigma_test(held), *_stills(held, ("dense/moving.png", "What moves", about))],
    )


def _sigma_test(held: Held) -> Iterator[Figure]:
    """True errors of the heights over their stated sigmas."""
    files = [held.file(path) for path in ("evaluation/error.tif", "dense/sigma.tif")]
    errors, sigmas = (
        np.ma.getdata(read_shrunk(file, [1], _MAX_VALUES_PX, Resampling.nearest)[0][0])
        if file is not None
        else np.empty((0, 0))
        for file in files
    )
    if not errors.size or errors.shape != sigmas.shape:
        return
    known = np.isfinite(errors) & (sigmas > 0)
    ratio = errors[known].astype(np.float64) / sigmas[known]
    if not len(ratio):
        return

    def paint(axes: Sequence[Any]) -> None:
        grid = np.linspace(-4, 4, 161)
        axes[0].hist(ratio, bins=81, range=(-4, 4), density=True, color=INKS[0], label="found")
        normal = np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)
        axes[0].plot(grid, normal, color=INKS[1], label="as stated")
        axes[0].set(xlabel="error over its stated sigma", ylabel="share", yticks=[])
        axes[0].legend()

    one, two = (share(float((np.abs(ratio) <= sigmas).mean())) for sigmas in (1, 2))
    yield draw_figure(
        paint, 2.3,
        title="Test of the stated sigmas",
        alt="Histogram of errors of heights over their stated sigmas, next to the normal curve",
        shows="The true errors of the heights in units of their stated sigmas: median "
        f"{float(np.median(ratio)):+.2f}; {one} lie within one sigma (68 % expected) and {two} "
        "within two (95 %).",
        good="The bars follow the line.",
        otherwise="Bars wider than the line: multiply the sigmas by the rms. A median off zero: "
        "neighbouring heights share an error, such as of one camera's position.",
    )  # fmt: skip


def _planes(held: Held) -> Iterator[Figure]:
    """Mosaic, else surface, of every further plane."""
    folders = [file.parent for file in held.workspace.glob("dense/planes/*/plane.json")]
    for folder in sorted(folders) if held.has("dense") else ():
        plane = PlaneRecord.read(folder / "plane.json")
        painted = held.file(f"mosaic/planes/{folder.name}/mosaic.png")
        shows = f"Mosaic of the plane: {plane.about}."
        if painted is None:
            shows = f"Surface over the plane: {plane.about}."
            shows += " No picture looks at it." if held.has("mosaic") else ""
        png = shrunk_png(painted or folder / "dem.png")
        yield Figure(png=png, title=f"Plane {plane.name}", alt=shows, shows=shows)


def _model(held: Held, found: RegistrationRecord) -> Section:
    rows: list[tuple[str, str | None]] = [
        ("points", f"{found.points:,}"),
        ("pictures that see a point, mean", digits(found.mean_track_length)),
    ]
    doming, place = found.doming, found.georeference
    for way, bend in ({} if doming is None else doming.bends).items():
        removed = length(bend.straightened_per_m * bend.length_m**2 / 8.0)
        sag = length_with_sigma(bend.sag_m, bend.sag_sigma_m)
        rows.append((f"sag {way} the lines", f"{sag}; {removed} that navigation took out"))
    if doming is not None and doming.scale is not None:
        own = parts_with_sigma(doming.scale.mean - 1.0, doming.scale.mean_sigma)
        rows.append(("scale by what each station sees alone", own))
    if place is not None:
        for axis in ("north", "east", "depth"):
            sizes = (getattr(place, f"{kind}_{axis}_m") for kind in ("rms", "sigma"))
            rms, sigma = map(sigma_length, sizes)
            rows.append((f"navigation {axis}", f"residuals {rms} rms, sigma of the survey {sigma}"))
        turns = (place.sigma_heading_deg, place.sigma_tilt_deg)
        heading, tilt = ("unknown" if t is None else f"{digits(t, 2)} deg" for t in turns)
        rows.append(("sigma of the survey's heading, level", f"{heading}, {tilt}"))
        rows.append(("mount of the rig", None if place.mount is None else place.mount.words))
    tables = [_table("Model", *rows)]
    lost = [(row["image"], row["reason"]) for row in held.rows("sparse/unregistered.csv")]
    if lost:
        more = len(lost) - _MAX_LOST
        rest = [(f"{more} more in sparse/unregistered.csv", "")] if more > 0 else []
        header, shown = ("picture", "why"), [*lost[:_MAX_LOST], *rest]
        tables.append(Table(title="Pictures not in the model", header=header, rows=shown))
    notes = held.frame.notes
    return Section(
        name="model",
        title="Camera track and points",
        text=[f"How it was made: {'; '.join(notes)}."] if notes else [],
        tables=tables,
        figures=[*_camera_sigmas(held)],
    )


def _camera_sigmas(held: Held) -> Iterator[Figure]:
    """Stated sigmas of the cameras along the survey."""
    rows = [r for r in held.track if number(r, "sigma_north_m") > 0]
    if not rows:
        return
    station = np.array([number(row, "station") for row in rows])
    where = "in the survey" if held.frame.datum is None else "on the Earth"

    def paint(axes: Sequence[Any]) -> None:
        for axis, ink, mark in zip(("north", "east", "depth"), INKS, MARKS, strict=False):
            sigma = [1e2 * number(row, f"sigma_{axis}_m") for row in rows]
            axes[0].plot(station, sigma, mark, ms=3, color=ink, label=axis)
        axes[0].set(xlabel="station", ylabel=f"sigma {where}, cm", ylim=(0, None))
        axes[0].legend()

    yield draw_figure(
        paint, 2.9,
        title="How well each camera is placed",
        alt="Standard deviations of camera positions by station",
        shows="The model's own standard deviation of every camera, by station. What all cameras "
        "share is navigation's error of the whole survey.",
        good="No station stands out.",
        otherwise="A rise at the ends of lines asks for a line across them; a single station that "
        "stands out has too few points.",
    )  # fmt: skip


def _camera(held: Held) -> Section:
    calibrated, refined = held.read(CalibrationReportRecord), held.read(PortRecord)
    cameras = held.read(CamerasRecord)
    text, tables = [], []
    if calibrated is not None:
        text.append(
            f"Calibrated from {count(calibrated.views, 'view')}: "
            f"{digits(calibrated.rms_px, 2)} px rms. The calibration's own report, with every "
            "parameter, is calibration/report.html."
        )
    if refined is not None:
        text.append(
            f"The survey's own pictures refined the rig from {refined.observations:,} "
            f"observations at {refined.stations} stations, within what calibration knew; "
            "sparse/port.json has every parameter before and after, with its sigmas."
        )
        if refined.contradiction is not None:
            text.append(f"But {refined.contradiction}.")
    if cameras is not None:
        rig_file = held.file("sparse/rig.json") or rig_file_of(held.workspace)
        rig = None if rig_file is None else read_rig(rig_file)
        if rig is None:
            text.append("The cameras calibrated themselves from the survey's pictures.")
        elif calibrated is None and refined is None:
            text.append(f"The rig is as imported with the pictures: {rig.source}.")
        if rig is not None and rig.body_from_rig is not None:
            text.append(f"The {mount_line(rig)}.")
        tables.append(_cameras(cameras, rig))
    return Section(name="camera", title="Camera and rig", text=text, tables=tables)


def _cameras(cameras: CamerasRecord, rig: Rig | None) -> Table:
    """Lens of every camera and, where the rig is known, its housing and its place on it."""
    rows = list[Sequence[str]]()
    for name, warp in cameras.cameras.items():
        one = camera_from_json(warp["camera"])
        lens = f"{one.lens.model}, {one.width_px} x {one.height_px} px"
        if rig is None:
            values = {key: one.parameter(key) for key in one.lens.parameters}
            terms = ", ".join(f"{key} {value:.6g}" for key, value in values.items() if value)
            rows.append((name, f"{lens}: {terms}"))
            continue
        pose = rig.cam_from_rig[next(iter(cameras.cameras))] * rig.cam_from_rig[name].inv()
        tilt = np.rad2deg(np.arccos(np.clip(pose.rotation.as_matrix()[2, 2], -1.0, 1.0)))
        shift = ", ".join(f"{1e3 * value:z.1f}" for value in pose.translation)
        rows.append((name, lens, one.port.words, f"{shift} mm", f"{tilt:.1f} deg"))
    header = ("camera", "lens", "housing", "right, down, forward", "off the first's axis")
    return Table(title="Cameras", header=header[: 2 if rig is None else None], rows=rows)


def _mission(held: Held, plan: Plan) -> Section:
    rows = [
        ("altitude, speed", f"{plan.altitude_m:g} m, {plan.speed_mps:g} m/s"),
        ("lines", f"{len(plan.lines)}, {plan.line_spacing_m:.2f} m apart"),
        ("stations", f"{plan.stations}, {plan.station_spacing_m:.2f} m apart"),
        ("covered as requested", share(plan.coverage)),
        ("dives, time, energy",
         f"{len(plan.dives)}, {duration(plan.duration_s)}, {plan.energy_wh:.1f} Wh"),
    ]  # fmt: skip
    tables = [_table("Plan", *rows)]
    flight = held.read(FlightRecord)
    if flight is not None:
        line, energy_wh = flight.on_lines, sum(flight.energy_wh.values())
        own = length(line.believed_cross_track_rms_m)
        rows = [
            ("time, energy", f"{duration(flight.duration_s)}, {energy_wh:.1f} Wh"),
            ("off the line, rms", f"{length(line.cross_track_rms_m)}; the control's part {own}"),
            ("error of navigation, rms", length(flight.navigation_error_rms_m)),
        ]
        tables.append(_table("Flight", *rows))
    text = "Every setting with its equation and limit is in plan/settings.txt."
    return Section(
        name="mission",
        title="Mission",
        text=[text] if held.file("plan/settings.txt") is not None else [],
        tables=tables,
        figures=_stills(
            held,
            ("plan/map.png", "The plan", "Area, lines, turns and stations."),
            ("flight/track.png", "Plan and flown track", "Where the vehicle flew, and how far it "
             "was off its lines; navigation's error is part of that."),
        ),
    )  # fmt: skip


def _reproduce(held: Held) -> Section:
    """Stages, versions, settings and files."""
    seeded = "Everything is seeded: 'alice-survey run' with the same settings repeats it."
    tables = [table_of(held) for table_of in (_stages, _versions, _settings, _files)]
    return Section(
        name="reproduce",
        title="Time, versions and settings",
        text=[seeded] if held.simulated else [],
        tables=[table for table in tables if table.rows],
    )


def _stages(held: Held) -> Table:
    rows = [
        (
            name,
            str(stage.version),
            duration(stage.took_s),
            "" if stage.cpu_s is None else duration(stage.cpu_s),
            "" if stage.peak_mib is None else f"{stage.peak_mib:.0f} MiB",
            stage.digest[:_DIGEST_CHARACTERS],
        )
        for name, stage in held.stages.items()
    ]
    header = ("stage", "version", "time", "CPU time", "memory", "digest")
    return Table(title="Stages", header=header, rows=rows)


def _versions(held: Held) -> Table:
    found = {name: text for stage in held.stages.values() for name, text in stage.versions.items()}
    found |= {"Python": platform.python_version()}
    found |= {"machine": f"{platform.system()} {platform.machine()}"}
    return Table(title="Versions", header=("package", "version"), rows=list(found.items()))


def _settings(held: Held) -> Table:
    """Settings as in the file; missing ones have their defaults."""
    path = held.workspace / "survey.toml"
    rows: list[tuple[str, str]] = []
    if path.is_file():
        for key, value in tomllib.loads(path.read_text(encoding="utf-8")).items():
            inner = value.items() if isinstance(value, dict) else [("", value)]
            for name, part in inner:
                text = str(part)
                short = text if len(text) <= _MAX_SETTING else f"{text[: _MAX_SETTING - 3]}..."
                rows.append((f"{key}.{name}".rstrip("."), short))
    return Table(title="Settings in survey.toml", header=("setting", "value"), rows=rows)


def _files(held: Held) -> Table:
    rows = [
        (f"{stage.folder}/{path}", about)
        for stage in stages.STAGES
        for path, about in stage.products.items()
        if stage.folder in held.stages and (held.workspace / stage.folder / path).exists()
    ]
    return Table(title="Files", header=("file", "what it is"), rows=rows)
