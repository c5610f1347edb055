"""All formats, and conversions between them, in which nothing is lost silently."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError, ConfigError, warn
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats import colmap, metashape, opencv, rigs, robots
from camera_calib.formats.camera_files import MODELS
from camera_calib.formats.fields import PLAIN, camera_name, read_documents, read_text, yaml_files
from camera_calib.formats.opencv_model import MATRIX, StandIn, distorts, fit_camera, is_fisheye
from camera_calib.formats.rigs import CalibrationFormat
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.mount import mount_line, with_mount
from camera_calib.ports.none import NO_PORT
from camera_calib.rig import Rig, read_rig, write_rig

_TERMS = {rigs.K3: ("k3",), rigs.RATIONAL: ("k4", "k5", "k6"), rigs.PRISM: ("s1", "s2", "s3", "s4")}
_GRID, _DISTANCES = 15, 9
"""Places along each side of the frame, and distances, at which a camera without port is fitted."""
_PLAIN = rigs.PINHOLE - {rigs.PRISM}


def _write_own(path: Path, rig: Rig) -> list[Path]:
    write_rig(path, rig)
    return [path]


def _has(*keys: str, suffix: str | None = None) -> Callable[[Path, Mapping[str, Any]], bool]:
    """Whether a YAML file has one of these keys, or another file this suffix."""
    return lambda path, top: bool(set(keys) & set(top)) or path.suffix.lower() == suffix


FORMATS = {
    each.name: each
    for each in (
        CalibrationFormat(
            "metashape", "Metashape calibration XML",
            lambda path, _: path.suffix.lower() == ".xml"
            and re.search(r"<calibration[\s>]", read_text(path, metashape.PICTURES)) is not None,
            metashape.read_metashape, metashape.write_metashape, frozenset({rigs.K3}), 1),
        CalibrationFormat(
            "colmap", "COLMAP model and rig_config.json",
            lambda path, _: colmap.has_ports(path) is False, colmap.read_colmap,
            colmap.write_colmap, _PLAIN, files=colmap.model_files),
        CalibrationFormat(
            "refractive", "Refractive COLMAP cameras with FLATPORT or DOMEPORT",
            lambda path, _: colmap.has_ports(path) is True, colmap.read_colmap,
            colmap.write_refractive, rigs.PORTED - {rigs.PRISM}, files=colmap.model_files),
        CalibrationFormat(
            "kalibr", "Kalibr camchain YAML", _has("cam0"), robots.read_kalibr,
            robots.write_kalibr, frozenset()),
        CalibrationFormat("euroc", "EuRoC sensor YAML", _has("T_BS"), robots.read_kalibr),
        CalibrationFormat(
            "ros", "ROS camera_info YAML",
            _has("rectification_matrix", "projection_matrix", "binning_x"), robots.read_ros,
            robots.write_ros, _PLAIN, 1),
        CalibrationFormat(
            "orbslam", "ORB-SLAM YAML", _has("Camera.fx", "Camera1.fx"), robots.read_orbslam),
        CalibrationFormat("zed", "ZED calibration", _has(suffix=".conf"), robots.read_zed),
        CalibrationFormat(
            "matisse", "Matisse YAML", _has("full_sensor_width"), opencv.read_opencv),
        CalibrationFormat(
            "opencv", "OpenCV YAML or XML",
            _has(*(name + end for name in MATRIX for end in ("", "1")), suffix=".xml"),
            opencv.read_opencv, opencv.write_opencv, rigs.PINHOLE, 2, ".xml"),
        CalibrationFormat(
            "rig", "rig.json of this project", _has(suffix=".json"),
            lambda path, _: read_rig(path), _write_own, suffix=".json"),
    )
}  # fmt: skip
"""By name, in the order in which a file is asked whose it is."""


def format_named(name: str) -> CalibrationFormat:
    """A format by its name.

    Raises:
        CalibrationError: there is none of this name.
    """
    if name not in FORMATS:
        raise CalibrationError(f"no format {name!r}: {', '.join(FORMATS)}")
    return FORMATS[name]


def detect(path: Path) -> CalibrationFormat:
    """The format of a file or folder, from its name and content.

    Raises:
        CalibrationError: it does not exist, or is of no known format.
    """
    if not path.exists():
        raise CalibrationError(f"{path}: no such file or folder")
    files = yaml_files(path) if path.is_dir() else [path]
    top = read_documents(files[0])[0] if files and files[0].suffix.lower() in PLAIN else {}
    for each in FORMATS.values():
        if each.owns(path, top):
            return each
    raise CalibrationError(f"{path}: of no known format; those that are: {', '.join(FORMATS)}")


def of_target(path: Path) -> CalibrationFormat:
    """The format that the name of a new file calls for.

    Raises:
        CalibrationError: several formats have such names.
    """
    if path.name in colmap.CAMERA_FILES:
        return FORMATS["colmap"]
    for each in FORMATS.values():
        if each.suffix and each.suffix == path.suffix.lower():
            return each
    raise CalibrationError(f"{path}: name the format with --to: {', '.join(FORMATS)}")


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What to convert, and what may be changed or left out."""

    source: Path
    target: Path
    source_format: str | None = None
    """Format of the source; detected from the file when None."""
    target_format: str | None = None
    reading: rigs.ReadOptions = field(default_factory=rigs.ReadOptions)
    names: tuple[str, ...] = ()
    """New names of the cameras, in order."""
    port: Mapping[str, float] = field(default_factory=dict)
    """Fields of `FlatPort` or `DomePort` to set."""
    mount: str | None = None
    """How the rig sits on its vehicle, as of `with_mount`."""
    lever_m: tuple[float, float, float] | None = None
    water: tuple[float, float] | None = None
    """Nearest and farthest distance, m, over which a camera without port stands in for one with."""
    drop_port: bool = False
    drop_covariance: bool = False
    overwrite: bool = False


def convert(task: Conversion) -> tuple[str, dict[str, Any]]:
    """Read, change as requested, write.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        CalibrationError: a file is wrong, or the target's format cannot hold what the source has.
    """
    source = detect(task.source) if task.source_format is None else format_named(task.source_format)
    named = task.target_format
    target = of_target(task.target) if named is None else format_named(named)
    rig = _change(_read(source, task.source, task.reading), task)
    prices: Mapping[str, StandIn] = {}
    if task.water is not None:
        if task.drop_port:
            raise CalibrationError("--water and --drop-port: one of them, cameras in water or air")
        _may_lose_covariance(rig, task, f"{task.target}: cameras fitted in water have no longer")
        rig, prices = in_water(rig, *task.water)
    for name in rig.cameras:  # they become names of files and folders
        camera_name(task.source, name)
    rig, notes = fit_to_format(rigs.refer_to_first(rig), target, task)
    existing = [path for path in target.files(task.target, rig) if path.is_file()]
    if existing and not task.overwrite:
        raise CalibrationError(f"{existing[0]}: exists: name another, or add --overwrite")
    written = target.write(task.target, rig)
    for note in notes:
        warn(note)
    lines = [f"{source.title} -> {target.title}: {', '.join(map(str, written))}"]
    for name, c in rig.cameras.items():
        place = _port_words(c) if c.port.parameters else "in water" if prices else "in air"
        lines.append(
            f"{name}: {c.width_px} x {c.height_px} px, f {c.fx_px:.3f} {c.fy_px:.3f}, "
            f"c {c.cx_px:.3f} {c.cy_px:.3f} px, {place}"
        )
    for name, price in prices.items():
        near_m, far_m = task.water or (0.0, 0.0)
        lines.append(
            f"{name}: {price.model} for {near_m:g} to {far_m:g} m of water misses the "
            f"exact camera by {price.rms_px:.3f} px rms, {price.max_px:.3f} px at most"
        )
    if len(rig.cameras) > 1:
        lines.append(f"baseline {rig.baseline_m:.6g} m")
    if rigs.MOUNT in target.holds:
        lines.append(mount_line(rig))
    data = {
        "from": source.name,
        "to": target.name,
        "written": list(map(str, written)),
        "cameras": {name: camera.to_json() for name, camera in rig.cameras.items()},
        "price": {
            name: {key: getattr(one, key) for key in ("model", "rms_px", "max_px")}
            for name, one in prices.items()
        },
        "baseline_m": rig.baseline_m if len(rig.cameras) > 1 else None,
    }
    return "\n".join(lines), data


def _read(source: CalibrationFormat, path: Path, reading: rigs.ReadOptions) -> Rig:
    """A rig; of several cameras the one that is named."""
    try:
        rig = source.read(path, reading)
        if reading.camera is not None and len(rig.cameras) > 1:
            rig = rigs.only(rig, reading.camera)
    except CalibrationError as error:
        text = str(error)
        raise CalibrationError(text if str(path) in text else f"{path}: {text}") from None
    return rig


def _change(rig: Rig, task: Conversion) -> Rig:
    """A rig with the names, port and mount that are stated."""
    if task.names:
        rig = rigs.rename_cameras(rig, task.names)
    if task.port:
        rig = rigs.with_port(rig, task.port)
        dry = [name for name, one in rig.cameras.items() if one.n_water == 1.0]
        if dry:
            raise CalibrationError(
                f"{task.source}: {', '.join(dry)} would look through a port into air: "
                "give --n-water (1.333 is fresh, 1.34 sea water)"
            )
    if task.mount is not None:
        return with_mount(rig, task.mount, task.lever_m)
    if task.lever_m is not None:
        raise CalibrationError("--lever goes with --mount")
    return rig


def fit_to_format(rig: Rig, target: CalibrationFormat, task: Conversion) -> tuple[Rig, list[str]]:
    """The part of a rig that a format holds, and notes of what was left out as requested.

    Raises:
        CalibrationError: something would be lost without permission.
    """
    where, instead = f"{task.target}: {target.title} cannot hold", "add --water NEAR FAR (m) for"
    notes = []
    for terms, names in _TERMS.items():
        lost = [name for name, one in rig.cameras.items() if distorts(one, *names)]
        if lost and terms not in target.holds:
            raise CalibrationError(
                f"{where} the distortion {' '.join(names)} of {', '.join(lost)}: choose "
                f"another format, or {instead} the best fit"
            )
    if target.max_cameras is not None and len(rig.cameras) > target.max_cameras:
        raise CalibrationError(f"{where} {len(rig.cameras)} cameras: choose one with --camera")
    behind = {name: camera for name, camera in rig.cameras.items() if camera.port.parameters}
    if behind and (
        task.drop_port or any(c.port.shape not in target.holds for c in behind.values())
    ):
        port = f"the port of {', '.join(behind)} ({_port_words(next(iter(behind.values())))})"
        if not task.drop_port:
            raise CalibrationError(
                f"{where} {port}: {instead} the best fit under water, --drop-port for the cameras "
                "in air"
            )
        notes.append(f"{task.target}: left out {port}: these cameras are in air")
        rig = rigs.in_air(rig)
    if rig.covariance is not None and (task.drop_covariance or rigs.COVARIANCE not in target.holds):
        _may_lose_covariance(rig, task, where)
        count = len(rig.covariance.parameters)
        notes.append(f"{task.target}: left out the covariance of {count} parameters")
        rig = replace(rig, covariance=None)
    if rigs.MOUNT not in target.holds and rig.body_from_rig is not None:
        notes.append(f"{task.target}: left out the rig's pose on the vehicle")
    if rigs.MOUNT in target.holds and rig.body_from_rig is None:
        notes.append(
            f"{task.source}: states no pose on the vehicle, which stays unknown: --mount states it"
        )
    return rig, notes


def _may_lose_covariance(rig: Rig, task: Conversion, why: str) -> None:
    if rig.covariance is not None and not task.drop_covariance:
        count = len(rig.covariance.parameters)
        raise CalibrationError(f"{why} the covariance of {count} parameters: add --drop-covariance")


def _port_words(camera: Camera) -> str:
    return f"{camera.port.words}, water {camera.n_water:g}"


def in_water(rig: Rig, near_m: float, far_m: float) -> tuple[Rig, Mapping[str, StandIn]]:
    """The rig for other software under water that has no port model.

    Each camera is the best fit, over the frame and the interval of distances, of a camera with
    distortion that absorbs the refraction; its centre lies next to the entrance pupil, and the
    poses in the rig and on the vehicle follow it.

    Args:
        rig: exact.
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.

    Returns:
        The rig, whose cameras are as in air and without covariance, and by camera the fit.

    Raises:
        CalibrationError: a part of a frame sees nothing, or the fit is no lens over all of it.
        ConfigError: the interval is empty or reaches into a port.
    """
    fits = {name: fit_in_water(one, near_m, far_m) for name, one in rig.cameras.items()}
    for name, fit in fits.items():
        if not np.isfinite(fit.camera.unproject(fit.camera.border())[1]).all():
            raise CalibrationError(
                f"the best {fit.model} of {name} folds back inside the frame: choose a format "
                "that holds its port"
            )
    words = ", ".join(dict.fromkeys(fit.model for fit in fits.values()))
    fitted = replace(
        rig,
        cameras={name: fit.camera for name, fit in fits.items()},
        cam_from_rig={n: fit.approx_from_cam * rig.cam_from_rig[n] for n, fit in fits.items()},
        source=f"{rig.source}; best {words} in water, {near_m:g} to {far_m:g} m",
        covariance=None,
    )
    return fitted, fits


def fit_in_water(camera: Camera, near_m: float, far_m: float) -> StandIn:
    """Fit a camera without port to the exact rays of one behind a port, as of `in_water`.

    Unknown are a shift along the port's axis, a turn (as bundle adjustment finds with a tilted
    port) and the parameters of COLMAP's model; nine distances count alike.
    """
    glass = float(np.nanmax(camera.unproject(camera.border(8))[0][:, 2], initial=0.0))
    glass = max(float(camera.front_cam[2]), glass)
    if not glass < near_m < far_m < np.inf:
        raise ConfigError(
            f"distances {near_m:g} to {far_m:g} m: give near < far, both beyond the port's outer "
            f"glass, {glass:g} m from the entrance pupil"
        )
    pixels = camera.frame_grid(_GRID, _GRID)
    points = np.stack([camera.at_depth(pixels, z) for z in np.linspace(near_m, far_m, _DISTANCES)])
    if not np.all(np.isfinite(points)):
        raise CalibrationError(
            "a part of the frame sees nothing: the lens model or the port does not reach the "
            "corners"
        )
    axis, stretch = np.array(camera.port.axis_cam), camera.port.magnification
    kind, model = (FisheyeLens, "OPENCV_FISHEYE") if is_fisheye(camera) else (OpenCVLens, "OPENCV")
    fx, fy = stretch * camera.fx_px, stretch * camera.fy_px
    lens = kind(fx_px=fx, fy_px=fy, cx_px=camera.cx_px, cy_px=camera.cy_px)
    first = replace(camera, lens=lens, port=NO_PORT)

    def pose(unknowns: Array) -> RigidTransform:
        turn = Rotation.from_rotvec(unknowns[1:4])
        return RigidTransform.from_components(-turn.apply(unknowns[0] * axis), turn)

    return fit_camera(first, MODELS[model][1][4:], points, pixels, pose, 4)
