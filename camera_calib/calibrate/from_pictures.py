"""Calibrate from pictures of a target: `alice-survey calibrate --left ... --right ...`."""

import contextlib
import math
import shlex
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.artefacts import read_json
from alice_survey.base.errors import CalibrationError, WorkspaceError
from alice_survey.base.executor import Executor, local_executor
from alice_survey.base.records import CalibrationRecord
from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.detect_views import Detections, Size, detect_views
from camera_calib.calibrate.files import finish, summary, warn_of_unseen
from camera_calib.calibrate.housing import (
    compare_housings,
    focal_ratios,
    housing_lines,
    likely_port,
)
from camera_calib.calibrate.moments import ClockOffset, clock_offset, track_of, views_at_moments
from camera_calib.calibrate.picture_sets import (
    PictureSet,
    check_own,
    find_pictures,
    pair_pictures,
    picture_times_s,
)
from camera_calib.calibrate.solve import (
    Intrinsics,
    blank_camera,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
    first_cameras,
)
from camera_calib.calibrate.start import same_numbering
from camera_calib.calibration import Calibration, TargetView
from camera_calib.camera import Camera
from camera_calib.freedom import intrinsics
from camera_calib.judge.uncertainty import baseline_sigma_m
from camera_calib.optics import PORTS
from camera_calib.picture_files import places_of_cameras
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.none import NO_PORT, NoPort
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig, read_rig, write_rig
from camera_calib.target_shape import (
    BOW_X,
    BOW_Y,
    SHEAR,
    STRETCH,
    TWIST,
    ShapeKind,
    marker_lines,
    shape_of,
)
from camera_calib.targets.target import Target, parse_target

ONE_CAMERA = "camera"
"""Name of the camera of `--pictures`."""
_WRITTEN = (
    "rig.json", "rig_carried.json", "calibration.json", "corners.csv", "report.html", "report.json",
)  # fmt: skip
"""Files of this command; a folder with other files is not replaced."""
_MOST_FIRST_VIEWS = 30
_FEWEST_FITTING = 0.5
"""Share of a camera's pictures that must fit those of the others."""
_LEVELS = ("bad", "look", "good")


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Pictures to calibrate from, and prior knowledge."""

    left: str | None = None
    """Folder or pattern; the left camera is the reference."""
    right: str | None = None
    pictures: str | None = None
    """Pictures of a single camera, instead."""
    cameras: tuple[str, ...] = ()
    """`NAME=PLACE` of each camera, the reference first, where left and right do not do."""
    own_clocks: bool = False
    """Whether the cameras took their pictures by clocks of their own, without a common trigger."""
    target: str | None = None
    """Target, as `parse_target` reads it."""
    target_shape: ShapeKind = "sheet"
    """How it may differ from its drawing."""
    output: Path | None = None
    """Folder to write."""
    lens: str = "opencv5"
    water: bool = False
    """Whether the pictures were taken under water, through the ports."""
    start: Path | None = None
    """rig.json of a calibration in air, or an earlier one."""
    known: Intrinsics | None = None
    """Use of the intrinsics of `start`; None: prior if it has a covariance, or held."""
    port: str | None = None
    """Kind of the port, of `optics.PORTS`, or auto: the likeliest; flat where None."""
    dome_radius_mm: float | None = None
    """Outer radius of a dome."""
    port_distance_mm: float | None = None
    """First value; it is estimated."""
    glass_mm: float | None = None
    """Thickness of the glass."""
    glass_sigma_mm: float | None = None
    """Prior sigma of the thickness, which is then estimated; the indices below in the same way."""
    n_glass: float | None = None
    n_glass_sigma: float | None = None
    n_water: float | None = None
    n_water_sigma: float | None = None
    carry_to_n: float | None = None
    """Also write the rig in water of this index."""

    def places(self) -> dict[str, str]:
        """Folder or pattern by camera; the first is the reference.

        Raises:
            CalibrationError: they are missing or do not go together.
        """
        stereo = {"left": self.left, "right": self.right}
        given = {camera: place for camera, place in stereo.items() if place is not None}
        if self.pictures is not None:
            if given or self.cameras:
                raise CalibrationError(
                    "give --left and --right, or --camera, or --pictures, not two of them"
                )
            return {ONE_CAMERA: self.pictures}
        if len(given) == 1:
            raise CalibrationError(
                "give both --left and --right, or --pictures for a single camera"
            )
        named = places_of_cameras(self.cameras)
        if set(given) & set(named):
            raise CalibrationError("--camera names left or right, which is given too")
        given |= named
        if not given:
            raise CalibrationError(
                "these options are for pictures: give --left and --right, --pictures, or --camera; "
                "the pool of a survey takes none of them"
            )
        return given


def calibrate_pictures(
    settings: CalibrateOptions, executor: Executor | None = None
) -> tuple[str, dict[str, Any]]:
    """Calibrate from pictures and write a folder of results.

    Returns:
        What was found, as text and as JSON values.

    Raises:
        CalibrationError: the pictures, the target or the settings do not give a calibration.
    """
    places, output = settings.places(), settings.output
    if settings.target is None:
        raise CalibrationError("--target is missing: what is seen, such as 'chessboard 9x6 25mm'")
    if output is None:
        raise CalibrationError("-o is missing: the folder to write the calibration into")
    _check_output(output, settings.start)
    target = parse_target(settings.target)
    intrinsics(settings.lens)
    start = None if settings.start is None else read_rig(settings.start)
    _check_settings(settings, start)
    lists = {camera: find_pictures(place) for camera, place in places.items()}
    check_own(lists)
    clocks: Mapping[str, ClockOffset] = {}
    with _replacing(output) as partial:
        if settings.own_clocks:
            found, clocks = _on_one_clock(settings, lists, target, start, executor)
        else:
            found = detect_views(pair_pictures(lists), target, executor or local_executor())
            warn_of_unseen(found)
        # In the order of the options: the first camera is the reference.
        found = replace(found, sizes={name: found.sizes[name] for name in lists})
        calibration = calibrated(settings, found, target, start)
        rig = calibration.rig
        source = "; ".join([rig.source, *_clock_lines(clocks, rig.reference)])
        calibration = finish(partial, replace(calibration, rig=replace(rig, source=source)), found)
        CalibrationRecord.save(
            partial / "calibration.json",
            {
                **summary(calibration),
                "clocks": {name: asdict(offset) for name, offset in clocks.items()},
            },
        )
        if settings.carry_to_n is not None:
            write_rig(partial / "rig_carried.json", carried(calibration.rig, settings.carry_to_n))
    _check_useful(calibration, found, output)
    verdicts = read_json(output / "report.json")["verdicts"]
    text = calibration_text(calibration, target, verdicts)
    clock_lines = _clock_lines(clocks, calibration.rig.reference)
    text = "\n".join([text, *clock_lines, *_next(calibration, output, settings)])
    return text, read_json(output / "calibration.json")


def _on_one_clock(
    settings: CalibrateOptions,
    lists: Mapping[str, Sequence[Path]],
    target: Target,
    start: Rig | None,
    executor: Executor | None,
) -> tuple[Detections, dict[str, ClockOffset]]:
    """What the cameras saw when the first took its pictures, and the offsets of their clocks.

    Raises:
        CalibrationError: the target or the pictures do not show the clocks.
    """
    if len(lists) == 1 or target.is_ambiguous:
        raise CalibrationError(
            "--own-clocks needs two cameras or more, and a target whose corners have one numbering:"
            " an odd and an even count, such as 'chessboard 9x6 25mm', or markers"
        )
    times_s, sets = {}, []
    for name, paths in lists.items():
        for path, time_s in zip(paths, picture_times_s(name, paths), strict=True):
            sets.append(PictureSet(name=f"{name} {path.name}", paths={name: path}))
            times_s[sets[-1].name] = time_s
    found = detect_views(sets, target, executor or local_executor())
    warn_of_unseen(found)
    points = target.points
    start = None if start is None else _matching(start, found.sizes)
    kind = _kind(settings, start) if settings.water else NoPort.shape
    cameras = _cameras(settings, found.sizes, start, kind)
    if start is None:
        some = [
            view
            for name in cameras
            for view in _spread([v for v in found.views if name in v.pixels])
        ]
        cameras = first_cameras(some, points, cameras, settings.lens)
    tracks = {
        name: track_of(name, camera, found.views, times_s, points)
        for name, camera in cameras.items()
    }
    first, *others = tracks
    clocks = {
        name: clock_offset((first, name), tracks[first], tracks[name], cameras[name], points)
        for name in others
    }
    return replace(found, views=views_at_moments(tracks, clocks)), clocks


def _spread(views: Sequence[TargetView]) -> list[TargetView]:
    """Some views, evenly: enough for a first camera."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _MOST_FIRST_VIEWS).astype(int))
    return [views[v] for v in chosen]


def _clock_lines(clocks: Mapping[str, ClockOffset], reference: str) -> Iterator[str]:
    for name, offset in clocks.items():
        yield (
            f"clock of {name}: add {with_sigma(offset.seconds, offset.sigma_s)} s to its times to "
            f"get those of {reference} (from {offset.pictures} pictures)"
        )


def carried(rig: Rig, n_water: float) -> Rig:
    """The rig in other water, with a note in its source."""
    old = next(iter(rig.cameras.values())).n_water
    return replace(
        rig.in_water(n_water),
        source=f"{rig.source}, carried from water of index {old:g} to {n_water:g}",
    )


def _check_settings(settings: CalibrateOptions, start: Rig | None) -> None:
    ports = {
        "--port": settings.port,
        "--dome-radius": settings.dome_radius_mm,
        "--port-distance": settings.port_distance_mm,
        "--glass": settings.glass_mm,
        "--glass-sigma": settings.glass_sigma_mm,
        "--n-glass": settings.n_glass,
        "--n-glass-sigma": settings.n_glass_sigma,
        "--n-water": settings.n_water,
        "--n-water-sigma": settings.n_water_sigma,
        "--carry-to-n": settings.carry_to_n,
        "--intrinsics": settings.known,
    }
    if not settings.water:
        given = [name for name, value in ports.items() if value is not None]
        if given:
            raise CalibrationError(f"{', '.join(given)} need --water: pictures in air see no port")
        return
    if settings.known in ("held", "prior") and start is None:
        raise CalibrationError(
            f"--intrinsics {settings.known} needs --start, the rig.json of a calibration in air"
        )
    if settings.port == "dome" and settings.dome_radius_mm is None:
        raise CalibrationError("--port dome needs --dome-radius, of its outer surface in mm")
    if settings.glass_mm is None and settings.port != "none":
        thin = start is None or not any(
            "glass_thickness_m" in c.parameters and c.parameter("glass_thickness_m") > 0.0
            for c in start.cameras.values()
        )
        if thin:
            raise CalibrationError(
                "--water needs --glass, the thickness of the port in mm (0 for a thin film)"
            )


def calibrated(
    settings: CalibrateOptions, found: Detections, target: Target, start: Rig | None
) -> Calibration:
    """The calibration that the settings ask for.

    Args:
        settings: of the command.
        found: views of the target.
        target: what they show.
        start: a rig calibrated in air, or an earlier one.

    Raises:
        CalibrationError: the views do not determine it.
    """
    points, lens = target.points, settings.lens
    start = None if start is None else _matching(start, found.sizes)
    if not settings.water:
        bare = _cameras(settings, found.sizes, start, NoPort.shape)
        start = None if start is None else replace(start, cameras=bare)
        views = _numbered(found, target, bare, lens, known=start is not None)
        shape = shape_of(target, settings.target_shape)
        return calibrate_in_air(views, points, found.sizes, lens, start, shape)
    ratios: dict[str, float] = {}
    if start is not None:
        views = _numbered(found, target, start.cameras, lens, known=True)
        ratios = focal_ratios(views, points, start, lens)
    if settings.port == "auto":
        found_by = {kind: partial(_through, settings, found, target, start, kind) for kind in PORTS}
        calibration = compare_housings(found_by)
    else:
        kind = _kind(settings, start)
        try:
            calibration = _through(settings, found, target, start, kind)
        except CalibrationError as error:
            raise CalibrationError(f"{error}{_other_housing(ratios, kind)}") from None
    return replace(calibration, housing=replace(calibration.housing, focal_ratios=ratios))


def _other_housing(ratios: Mapping[str, float], kind: str) -> str:
    """What focal lengths say against a kind of port, for the end of a message."""
    likely = {name: likely_port(ratio) for name, ratio in ratios.items()}
    against = [
        name
        for name, port in likely.items()
        if (port == FlatPort.shape) != (kind == FlatPort.shape)
    ]
    if not against:
        return ""
    name = against[0]
    return (
        f"; focal lengths of {name} under water are {ratios[name]:.3f} times those in air, which "
        f"says --port {likely[name]}"
    )


def _numbered(
    found: Detections, target: Target, cameras: Mapping[str, Camera], lens: str, *, known: bool
) -> tuple[TargetView, ...]:
    """Views whose points all cameras number alike."""
    if not target.is_ambiguous or len(cameras) < 2:
        return found.views
    views, points = found.views, target.points
    near = cameras if known else first_cameras(views, points, cameras, lens)
    return tuple(same_numbering(near, views, points, target.symmetries))


def _through(
    settings: CalibrateOptions, found: Detections, target: Target, start: Rig | None, kind: str
) -> Calibration:
    """The calibration under water through ports of one kind."""
    points, lens = target.points, settings.lens
    shape = shape_of(target, settings.target_shape)
    cameras = _cameras(settings, found.sizes, start, kind)
    views = _numbered(found, target, cameras, lens, known=start is not None)
    known_to = {
        "glass_thickness_m": _metres(settings.glass_sigma_mm),
        "n_glass": settings.n_glass_sigma,
        "n_water": settings.n_water_sigma,
    }
    sigmas = {
        f"{name}.{parameter}": sigma
        for name, camera in cameras.items()
        for parameter, sigma in known_to.items()
        if sigma is not None and parameter in camera.parameters
    }
    if start is None:
        return calibrate_in_water_alone(views, points, cameras, lens, sigmas, shape)
    known = settings.known or ("held" if start.covariance is None else "prior")
    start = replace(start, cameras=cameras)
    return calibrate_through_ports(views, points, start, known, lens, sigmas, shape)


def _metres(length_mm: float | None) -> float | None:
    return None if length_mm is None else length_mm / 1e3


def _kind(settings: CalibrateOptions, start: Rig | None) -> str:
    """The kind of port that is named, or that of the start, or a flat one."""
    if settings.port in PORTS:
        return str(settings.port)
    old = NO_PORT if start is None else next(iter(start.cameras.values())).port
    return old.shape if old.parameters else FlatPort.shape


def _cameras(
    settings: CalibrateOptions, sizes: Mapping[str, Size], start: Rig | None, kind: str
) -> dict[str, Camera]:
    """Cameras of the start, or blank ones, behind ports of one kind."""
    if start is None:
        port = _port(kind, NO_PORT, settings)
        return {name: blank_camera(size, settings.lens, port) for name, size in sizes.items()}
    return {
        name: replace(camera, port=_port(kind, camera.port, settings))
        for name, camera in start.cameras.items()
    }


def _port(kind: str, old: PortValues, settings: CalibrateOptions) -> PortValues:
    """First values of a port of some kind: those of the start, or usual ones, or as named."""
    port = old if old.shape == kind else PORTS[kind].guess()
    given = {
        "glass_thickness_m": _metres(settings.glass_mm),
        "outer_radius_m": _metres(settings.dome_radius_mm),
        "n_glass": settings.n_glass,
        "n_water": settings.n_water,
        "port_distance_m": _metres(settings.port_distance_mm),
    }
    return port.with_parameters(
        {k: v for k, v in given.items() if v is not None and k in port.parameters}
    )


def _matching(start: Rig, sizes: Mapping[str, Size]) -> Rig:
    """The cameras of a start that are calibrated, if its pictures have the same size."""
    if not set(sizes) <= set(start.cameras):
        raise CalibrationError(
            f"the start has cameras {', '.join(start.cameras)}; pictures are of {', '.join(sizes)}"
        )
    for name, size in sizes.items():
        camera = start.cameras[name]
        if (camera.width_px, camera.height_px) != size:
            raise CalibrationError(
                f"pictures of {name} have {size[0]} x {size[1]} px, the start's camera "
                f"{camera.width_px} x {camera.height_px}"
            )
    names = list(sizes)
    to_first = start.cam_from_rig[names[0]].inv()
    return replace(
        start,
        cameras={name: start.cameras[name] for name in names},
        cam_from_rig={name: start.cam_from_rig[name] * to_first for name in names},
        body_from_rig=start.body_from_cam(names[0]),
    )


def _next(calibration: Calibration, output: Path, settings: CalibrateOptions) -> list[str]:
    """Location of the results, and what to do with them."""
    rig = shlex.quote(str(output / "rig.json"))
    lines = [f"rig in {output / 'rig.json'}; read {output / 'report.html'}"]
    if settings.carry_to_n is not None:
        lines.append(f"in water of index {settings.carry_to_n:g}: {output / 'rig_carried.json'}")
    if settings.water:
        lines.append(f"next: alice-survey camera uncertainty {rig}")
    else:
        given = {"pictures": settings.pictures, "left": settings.left, "right": settings.right}
        short = [f"--{option} {option[0].upper()}" for option, place in given.items() if place]
        long = [f"--camera {text.partition('=')[0]}=FOLDER" for text in settings.cameras]
        places = " ".join([*short, *long])
        lines.append(
            f"next, behind ports, with pictures under water: alice-survey calibrate {places} "
            f"--target T --water --glass MM --start {rig} -o DIR"
        )
    return lines


def _check_useful(calibration: Calibration, found: Detections, output: Path) -> None:
    """Reject a result that is no calibration, after its files are written for a look.

    Raises:
        CalibrationError: most pictures of a camera do not fit those of the others.
    """
    for name in calibration.rig.cameras:
        seen = sum(name in view.pixels for view in found.views)
        fits = sum(name in view.pixels for view in calibration.views)
        if fits < _FEWEST_FITTING * seen:
            raise CalibrationError(
                f"only {fits} of {seen} pictures of {name} fit those of the other cameras: are "
                "pictures of one number, or of one place in the lists, of one moment, and did the "
                f"cameras stay as they were to each other? ({output} shows more; do not use its "
                "rig.json)"
            )


def _check_output(output: Path, start: Path | None) -> None:
    """Reject a folder that is not of this command before the work starts.

    Raises:
        WorkspaceError: it cannot be written or would take something with it.
    """
    if not output.name or output.name == "..":
        raise WorkspaceError(f"-o {output}: name a new folder, such as -o air")
    if not output.exists():
        return
    if not output.is_dir():
        raise WorkspaceError(f"{output} is a file: name a folder with -o")
    others = sorted(path.name for path in output.iterdir() if path.name not in _WRITTEN)
    if others:
        raise WorkspaceError(
            f"{output} holds other files (such as {others[0]}): choose another folder with -o"
        )
    if start is not None and start.resolve().parent == output.resolve():
        raise WorkspaceError(
            f"{output} holds the rig of --start, which would be replaced: choose another folder "
            "with -o"
        )


@contextlib.contextmanager
def _replacing(output: Path) -> Iterator[Path]:
    """A folder to write to that replaces `output` on success."""
    partial = output.with_name(f"{output.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    try:
        yield partial
        if output.exists():
            shutil.rmtree(output)
        partial.rename(output)
    finally:
        if partial.exists():
            shutil.rmtree(partial)


def calibration_text(
    calibration: Calibration, target: Target, verdicts: Sequence[Mapping[str, str]]
) -> str:
    """What is bad, fit, baselines, lenses, ports and verdicts; lengths in millimetres.

    Args:
        calibration: with its rig's covariance.
        target: its squares or tags set the scale of the baseline.
        verdicts: `level` and `text` of each, the worst first, as in `report.json`.
    """
    rig, square = calibration.rig, (calibration.residuals_px**2).sum(axis=-1)
    bad = [f"bad: {verdict['text']}" for verdict in verdicts if verdict["level"] == "bad"]
    lines = [
        *bad,
        f"{len(calibration.views)} views, {int(np.isfinite(square).sum())} points, "
        f"{calibration.rms_px:.3f} px rms (noise {calibration.noise_px:.3f} px)",
        *_baseline_lines(rig, target),
        *_shape_lines(calibration),
        *housing_lines(calibration.housing),
    ]
    for name in rig.cameras:
        lines += _camera_lines(rig, name)
    lines += _verdict_lines(verdicts, len(calibration.warnings))
    return "\n".join(lines)


def _shape_lines(calibration: Calibration) -> Iterator[str]:
    """How the target differs from its drawing, and how much of the noise goes together."""
    shape = calibration.shape

    def stated(name: str, scale: float) -> str:
        number, sigma = shape.known(name)
        return with_sigma(scale * number, scale * sigma)

    if shape.parameters:
        yield (
            f"target: bow over its width {stated(BOW_X, 1e3)} mm, over its height "
            f"{stated(BOW_Y, 1e3)} mm, twist {stated(TWIST, 1e3)} mm; x over y longer by "
            f"{stated(STRETCH, 1e2)} %, shear {stated(SHEAR, 1e2)} %"
        )
    yield from marker_lines(shape)
    if calibration.spread is not None:
        noise = calibration.spread.noise
        yield (
            f"noise of corners: {noise.together_share:.0%} goes together in a picture; places on "
            f"the target err by {1e3 * noise.place_sigmas_m[0]:.3f} mm in its plane"
        )


def _baseline_lines(rig: Rig, target: Target) -> Iterator[str]:
    for name in list(rig.cameras)[1:]:
        length_m = float(np.linalg.norm(rig.cam_from_rig[name].translation))
        sigma_m = baseline_sigma_m(rig, name)
        unit = "tags" if target.kind == "apriltag" else "squares"
        to = f" from {rig.reference} to {name}" if len(rig.cameras) > 2 else ""
        yield (
            f"baseline{to} {with_sigma(1e3 * length_m, 1e3 * sigma_m)} mm = "
            f"{with_sigma(length_m / target.size_m, sigma_m / target.size_m)} {unit} of "
            f"{1e3 * target.size_m:g} mm"
        )


def _camera_lines(rig: Rig, name: str) -> Iterator[str]:
    camera, sigmas = rig.cameras[name], rig.sigmas

    def stated(field: str, unit: str, scale: float = 1.0) -> str:
        number, sigma = scale * camera.parameter(field), sigmas.get(f"{name}.{field}")
        if sigma is None:
            return f"{number:.6g}{unit} (held)"
        return f"{with_sigma(number, scale * sigma)}{unit}"

    yield f"{name}: focal lengths {stated('fx_px', ' px')}, {stated('fy_px', ' px')}"
    if not camera.port.parameters:
        return
    parts = [
        label.format(stated(field, " mm", 1e3) if field.endswith("_m") else stated(field, ""))
        for field, label in camera.port.labels.items()
    ]
    if camera.port.tilts:
        tilt_deg, sigma_deg = port_tilt_deg(rig, name)
        known = f"{tilt_deg:.3g}" if sigma_deg is None else with_sigma(tilt_deg, sigma_deg)
        held = " (held)" if sigma_deg is None else ""
        parts.insert(len(camera.port.places), f"tilt {known} deg{held}")
    yield f"{name} {camera.port.shape} port: {', '.join(parts)}"


def port_tilt_deg(rig: Rig, name: str) -> tuple[float, float | None]:
    """Angle between a port's normal and the camera's axis, and its sigma; None where held.

    For a port without tilt the direction of an error is open; its sigma is the larger of the two.
    """
    x, y, z = rig.cameras[name].port.axis_cam
    sine = math.hypot(x, y)
    fields = [f"{name}.{tilt}" for tilt in rig.cameras[name].port.tilts]
    tilt_deg = math.degrees(math.atan2(sine, z))
    if rig.covariance is None or not set(fields) <= set(rig.covariance.parameters):
        return tilt_deg, None
    at = [rig.covariance.parameters.index(field) for field in fields]
    block = rig.covariance.matrix[np.ix_(at, at)]
    if sine == 0.0:
        variance = float(np.linalg.eigvalsh(block)[-1])
    else:
        along = np.array([x, y]) / sine
        variance = float(along @ block @ along)
    return tilt_deg, math.degrees(math.sqrt(max(variance, 0.0)) / z)


def _verdict_lines(verdicts: Sequence[Mapping[str, str]], warnings: int) -> Iterator[str]:
    counts = Counter(verdict["level"] for verdict in verdicts)
    words = [f"{counts[level]} {level}" for level in _LEVELS if counts[level]]
    yield f"verdicts: {', '.join(words)}; {warnings} warnings"
    for verdict in verdicts:
        if verdict["level"] == "look":
            yield f"  look: {verdict['text']}"
