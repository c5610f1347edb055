"""Convert a camera calibration from one tool's format to another's, and lose nothing silently."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError, warn
from camera_calib.approximation.residual import COLMAP_PARAMETERS, Residual, approximations
from camera_calib.camera import Camera
from camera_calib.formats.fields import camera_name
from camera_calib.formats.opencv_model import FISHEYE, distorts, is_fisheye
from camera_calib.formats.registry import (
    COVARIANCE,
    K3,
    MOUNT,
    PRISM,
    RATIONAL,
    CalibrationFormat,
    detect,
    format_named,
    of_target,
)
from camera_calib.formats.rigs import (
    ReadOptions,
    in_air,
    only,
    referenced,
    renamed,
    with_port,
)
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.dome import DomePort
from camera_calib.ports.none import NO_PORT
from camera_calib.rig import Rig

_TERMS = {K3: ("k3",), RATIONAL: ("k4", "k5", "k6"), PRISM: ("s1", "s2", "s3", "s4")}
MODELS = ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What to convert, and what may be changed or left out."""

    source: Path
    target: Path
    source_format: str | None = None
    """Format of the source; detected from the file when None."""
    target_format: str | None = None
    reading: ReadOptions = field(default_factory=ReadOptions)
    names: tuple[str, ...] = ()
    """New names of the cameras, in order."""
    port_distance_mm: float | None = None
    """To set, as the five below."""
    dome_radius_mm: float | None = None
    """Outer; makes the port a dome."""
    dome_centre_mm: tuple[float, float, float] | None = None
    glass_mm: float | None = None
    n_glass: float | None = None
    n_water: float | None = None
    water: tuple[float, float] | None = None
    """Nearest and farthest distance, m, over which a camera without port stands in for one with."""
    model: str | None = None
    """COLMAP's name of the model that stands in; `_best_model` when None."""
    drop_port: bool = False
    drop_covariance: bool = False
    overwrite: bool = False

    @property
    def port(self) -> dict[str, float]:
        """Fields of a port to set."""
        lengths = {
            "port_distance_m": self.port_distance_mm,
            "glass_thickness_m": self.glass_mm,
            "outer_radius_m": self.dome_radius_mm,
            **dict(zip(DomePort.parameters, self.dome_centre_mm or (), strict=False)),
        }
        given = {"n_glass": self.n_glass, "n_water": self.n_water}
        given |= {name: None if mm is None else mm / 1e3 for name, mm in lengths.items()}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class Price:
    """Errors of a stand-in without port against the exact camera."""

    model: str
    near_m: float
    far_m: float
    rms_px: float
    max_px: float

    def __str__(self) -> str:
        return (
            f"{self.model} for {self.near_m:g} to {self.far_m:g} m of water misses the exact "
            f"camera by {self.rms_px:.3f} px rms, {self.max_px:.3f} px at most"
        )


def convert(task: Conversion) -> tuple[str, dict[str, Any]]:
    """Read, change as requested, write.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        CalibrationError: a file is wrong, or the target's format cannot hold what the source has.
    """
    source = detect(task.source) if task.source_format is None else format_named(task.source_format)
    target = (
        of_target(task.target) if task.target_format is None else format_named(task.target_format)
    )
    rig = read_as(source, task.source, task.reading)
    if task.names:
        rig = renamed(rig, task.names)
    if task.port:
        rig = with_port(rig, dict(task.port))
        dry = [name for name, one in rig.cameras.items() if one.n_water == 1.0]
        if dry:
            raise CalibrationError(
                f"{task.source}: {', '.join(dry)} would look through a port into air: "
                "give --n-water (1.333 is fresh, 1.34 sea water)"
            )
    prices: Mapping[str, Price] = {}
    if task.water is not None:
        if task.drop_port:
            raise CalibrationError("--water and --drop-port: one of them, cameras in water or air")
        _may_lose_covariance(rig, task, f"{task.target}: cameras fitted in water have no longer")
        models = {n: task.model or _best_model(c, target) for n, c in rig.cameras.items()}
        rig, prices = in_water(rig, *task.water, models)
    for name in rig.cameras:  # they become names of files and folders
        if camera_name(task.source, name) != name:
            raise CalibrationError(f"{task.source}: camera name {name!r} has a slash: give --names")
    rig, notes = fitted(referenced(rig), target, task)
    existing = [path for path in target.targets(task.target, rig) if path.is_file()]
    if existing and not task.overwrite:
        raise CalibrationError(f"{existing[0]}: exists: name another, or add --overwrite")
    written = target.write(task.target, rig)
    for note in notes:
        warn(note)
    return _summary(source, target, rig, written, prices)


def read_as(source: CalibrationFormat, path: Path, reading: ReadOptions) -> Rig:
    """Read a rig; of several cameras only the one wanted, when one is named.

    Raises:
        CalibrationError: the message names the file.
    """
    try:
        rig = source.read(path, reading)
        if reading.camera is not None and len(rig.cameras) > 1:
            rig = only(rig, reading.camera)
    except CalibrationError as error:
        text = str(error)
        raise CalibrationError(text if str(path) in text else f"{path}: {text}") from None
    return rig


def fitted(rig: Rig, target: CalibrationFormat, task: Conversion) -> tuple[Rig, list[str]]:
    """The part of a rig that a format holds, and notes of what was left out as requested.

    Raises:
        CalibrationError: something would be lost without permission.
    """
    where = f"{task.target}: {target.title} cannot hold"
    notes = []
    for terms, names in _TERMS.items():
        bent = [name for name, camera in rig.cameras.items() if distorts(camera, *names)]
        if bent and terms not in target.holds:
            raise CalibrationError(
                f"{where} the distortion {' '.join(names)} of {', '.join(bent)}: "
                "choose another format, or add --water NEAR FAR (m) for the best fit"
            )
    wide = [n for n, one in rig.cameras.items() if is_fisheye(one) and FISHEYE not in target.holds]
    if wide:
        raise CalibrationError(
            f"{where} the fisheye lens of {', '.join(wide)}: choose another format, or add "
            "--water NEAR FAR (m) for the best fit"
        )
    behind = [name for name, camera in rig.cameras.items() if has_port(camera)]
    lost = any(rig.cameras[name].port.shape not in target.holds for name in behind)
    if task.drop_port or lost:
        if behind and not task.drop_port:
            raise CalibrationError(
                f"{where} the port of {', '.join(behind)} ({_port_words(rig.cameras[behind[0]])}): "
                "add --water NEAR FAR (m) for the best fit under water, --drop-port for the "
                "cameras in air"
            )
        if behind:
            notes.append(
                f"{task.target}: left out the port of {', '.join(behind)} "
                f"({_port_words(rig.cameras[behind[0]])}): these cameras are in air"
            )
        rig = in_air(rig)
    if rig.covariance is not None and (task.drop_covariance or COVARIANCE not in target.holds):
        _may_lose_covariance(rig, task, where)
        notes.append(f"{task.target}: left out {_covariance_words(rig)}")
        rig = replace(rig, covariance=None)
    if MOUNT not in target.holds and rig.body_from_rig is not None:
        notes.append(f"{task.target}: left out the rig's pose on the vehicle")
    if MOUNT in target.holds and rig.body_from_rig is None:
        notes.append(
            f"{task.source}: states no pose on the vehicle, which stays unknown: "
            "'alice-survey camera mount' states it"
        )
    return rig, notes


def _may_lose_covariance(rig: Rig, task: Conversion, why: str) -> None:
    if rig.covariance is not None and not task.drop_covariance:
        raise CalibrationError(f"{why} {_covariance_words(rig)}: add --drop-covariance")


def _covariance_words(rig: Rig) -> str:
    count = 0 if rig.covariance is None else len(rig.covariance.parameters)
    return f"the covariance of {count} parameters"


def has_port(camera: Camera) -> bool:
    """Whether a camera differs from one in air."""
    return bool(camera.port.parameters)


def _port_words(camera: Camera) -> str:
    return f"{camera.port.words}, water {camera.n_water:g}"


def _summary(
    source: CalibrationFormat,
    target: CalibrationFormat,
    rig: Rig,
    written: Sequence[Path],
    prices: Mapping[str, Price],
) -> tuple[str, dict[str, Any]]:
    lines = [f"{source.title} -> {target.title}: {', '.join(str(path) for path in written)}"]
    for name, c in rig.cameras.items():
        place = _port_words(c) if has_port(c) else "in water" if prices else "in air"
        lines.append(
            f"{name}: {c.width_px} x {c.height_px} px, f {c.fx_px:.3f} {c.fy_px:.3f}, "
            f"c {c.cx_px:.3f} {c.cy_px:.3f} px, {place}"
        )
    lines += [f"{name}: {price}" for name, price in prices.items()]
    if len(rig.cameras) > 1:
        lines.append(f"baseline {rig.baseline_m:.6g} m")
    data = {
        "from": source.name,
        "to": target.name,
        "written": [str(path) for path in written],
        "cameras": {name: camera.to_json() for name, camera in rig.cameras.items()},
        "price": {name: asdict(price) for name, price in prices.items()},
        "baseline_m": rig.baseline_m if len(rig.cameras) > 1 else None,
    }
    return "\n".join(lines), data


def _best_model(camera: Camera, target: CalibrationFormat) -> str:
    if not is_fisheye(camera):
        return "OPENCV"
    return "OPENCV_FISHEYE" if FISHEYE in target.holds else "FULL_OPENCV"


def in_water(
    rig: Rig, near_m: float, far_m: float, models: Mapping[str, str]
) -> tuple[Rig, Mapping[str, Price]]:
    """The rig for other software under water that has no port model.

    Each camera is the best fit, over the frame and the interval of distances, of a camera with
    distortion that absorbs the refraction; its centre lies next to the entrance pupil, and the
    poses in the rig and on the vehicle follow it.

    Args:
        rig: exact.
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.
        models: by camera, each one of `MODELS`.

    Returns:
        The rig, whose cameras are as in air and without covariance, and the price by camera.

    Raises:
        CalibrationError: the model is none of these, a part of a frame sees nothing, or the fit is
            no lens over the whole frame.
        ConfigError: the interval is empty or reaches into a port.
    """
    for model in models.values():
        if model not in MODELS:
            raise CalibrationError(f"model {model}: {' or '.join(MODELS)} expected")
    found = {
        name: approximations(camera, near_m, far_m, models=(models[name],))[-1]
        for name, camera in rig.cameras.items()
    }
    cameras = {name: _stand_in(rig.cameras[name], fit) for name, fit in found.items()}
    for name, one in cameras.items():
        if not np.isfinite(one.unproject(one.border())[1]).all():
            raise CalibrationError(
                f"the best {models[name]} of {name} folds back inside the frame: give another "
                "--model, or a format that holds fisheyes"
            )
    poses = {name: _from_cam(fit) * rig.cam_from_rig[name] for name, fit in found.items()}
    prices = {
        name: Price(
            model=models[name], near_m=near_m, far_m=far_m, rms_px=fit.rms_px, max_px=fit.max_px
        )
        for name, fit in found.items()
    }
    words = ", ".join(dict.fromkeys(models.values()))
    source = f"{rig.source}; best {words} in water, {near_m:g} to {far_m:g} m"
    return (
        replace(rig, cameras=cameras, cam_from_rig=poses, source=source, covariance=None),
        prices,
    )


def _stand_in(camera: Camera, fit: Residual) -> Camera:
    stand_in = fit.stand_in
    values = dict(zip(COLMAP_PARAMETERS[stand_in.model], stand_in.params, strict=True))
    focal = {f"{name}_px": values.pop(name) for name in ("fx", "fy", "cx", "cy")}
    kind = FisheyeLens if stand_in.model == "OPENCV_FISHEYE" else OpenCVLens
    return replace(camera, lens=kind(**focal, **values), port=NO_PORT)


def _from_cam(fit: Residual) -> RigidTransform:
    turn = fit.stand_in.approx_from_cam
    return RigidTransform.from_components(-turn.apply(fit.stand_in.centre_m), turn)
