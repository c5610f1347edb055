"""Convert a camera calibration from one tool's format to another's, and lose nothing silently."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from alice_survey.base.errors import CalibrationError, warn
from camera_calib.flat_port import FlatPortCamera
from camera_calib.formats.fields import camera_name
from camera_calib.formats.in_water import Price, in_water
from camera_calib.formats.opencv_model import IN_AIR, distorts
from camera_calib.formats.registry import (
    COVARIANCE,
    K3,
    MOUNT,
    PORT,
    PRISM,
    RATIONAL,
    Format,
    detect,
    format_named,
    of_target,
)
from camera_calib.formats.rigs import UNKNOWN_MOUNT, Reading, only, referenced, renamed, with_port
from camera_calib.rig import Rig

_TERMS = {K3: ("k3",), RATIONAL: ("k4", "k5", "k6"), PRISM: ("s1", "s2", "s3", "s4")}


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What to convert, and what may be changed or left out on the way."""

    source: Path
    target: Path
    source_format: str | None = None
    """By name; found from the file when None."""
    target_format: str | None = None
    reading: Reading = field(default_factory=Reading)
    names: tuple[str, ...] = ()
    """New names of the cameras, in order."""
    port: tuple[tuple[str, float], ...] = ()
    """Fields of the port to set: `port_distance_m`, `glass_thickness_m`, `n_glass`, `n_water`."""
    water: tuple[float, float] | None = None
    """Nearest and farthest distance, m, over which a camera without port stands in for one with."""
    model: str = "OPENCV"
    """COLMAP's name of the model that stands in."""
    drop_port: bool = False
    drop_covariance: bool = False
    overwrite: bool = False


def convert(task: Conversion) -> tuple[str, dict[str, Any]]:
    """Read, change as asked, write.

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
        rig, prices = in_water(rig, *task.water, task.model)
    for name in rig.cameras:  # they become names of files and folders
        if camera_name(task.source, name) != name:
            raise CalibrationError(f"{task.source}: camera name {name!r} has a slash: give --names")
    rig, notes = fitted(referenced(rig), target, task)
    existing = [path for path in target.targets(task.target, rig) if path.is_file()]
    if existing and not task.overwrite:
        raise CalibrationError(f"{existing[0]}: exists: name another, or say --overwrite")
    written = target.write(task.target, rig)
    for note in notes:
        warn(note)
    return _summary(source, target, rig, written, prices)


def convert_files(
    source: Path,
    target: Path,
    *,
    source_format: str | None = None,
    target_format: str | None = None,
    image_size: tuple[int, int] | None = None,
    extrinsics: Path | None = None,
    unit_m: float = 1.0,
    camera: str | None = None,
    names: str | None = None,
    port_distance_mm: float | None = None,
    glass_mm: float | None = None,
    n_glass: float | None = None,
    n_water: float | None = None,
    water: tuple[float, float] | None = None,
    model: str = "OPENCV",
    drop_port: bool = False,
    drop_covariance: bool = False,
    overwrite: bool = False,
) -> tuple[str, dict[str, Any]]:
    """`convert` with the values of the command line.

    Args:
        source: file or folder to read.
        target: file or folder to write.
        source_format: by name; found from the file when None.
        target_format: by name; from the target's name when None.
        image_size: width and height, px, when the file tells none.
        extrinsics: OpenCV file of R and T when they are not with the intrinsics.
        unit_m: length of one unit of the file's translations.
        camera: the only one wanted.
        names: new names of the cameras, separated by commas.
        port_distance_mm: from the entrance pupil to the inner glass.
        glass_mm: thickness of the port.
        n_glass: its index.
        n_water: index of the water.
        water: distances over which to fit cameras without port, m.
        model: `OPENCV` or `FULL_OPENCV`, for them.
        drop_port: leave the port out.
        drop_covariance: leave the covariance out.
        overwrite: replace what is there.
    """
    given = {
        "port_distance_m": None if port_distance_mm is None else port_distance_mm / 1e3,
        "glass_thickness_m": None if glass_mm is None else glass_mm / 1e3,
        "n_glass": n_glass,
        "n_water": n_water,
    }
    reading = Reading(
        image_size=image_size, extrinsics=extrinsics, metres_per_unit=unit_m, camera=camera
    )
    return convert(
        Conversion(
            source=source,
            target=target,
            source_format=source_format,
            target_format=target_format,
            reading=reading,
            names=() if names is None else tuple(names.split(",")),
            port=tuple((name, value) for name, value in given.items() if value is not None),
            water=water,
            model=model,
            drop_port=drop_port,
            drop_covariance=drop_covariance,
            overwrite=overwrite,
        )
    )


def read_as(source: Format, path: Path, reading: Reading) -> Rig:
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


def fitted(rig: Rig, target: Format, task: Conversion) -> tuple[Rig, list[str]]:
    """The part of a rig that a format holds, and notes of what was left out as asked.

    Raises:
        CalibrationError: something would be lost that nobody allowed to be lost.
    """
    where = f"{task.target}: {target.title} cannot hold"
    notes = []
    for terms, names in _TERMS.items():
        bent = [name for name, camera in rig.cameras.items() if distorts(camera, *names)]
        if bent and terms not in target.holds:
            raise CalibrationError(
                f"{where} the distortion {' '.join(names)} of {', '.join(bent)}: "
                "choose another format, or say --water NEAR FAR (m) for the best fit"
            )
    behind = [name for name, camera in rig.cameras.items() if has_port(camera)]
    if task.drop_port or (behind and PORT not in target.holds):
        if behind and not task.drop_port:
            raise CalibrationError(
                f"{where} the port of {', '.join(behind)} ({_port_words(rig.cameras[behind[0]])}): "
                "say --water NEAR FAR (m) for the best fit under water, --drop-port for the "
                "cameras in air"
            )
        if behind:
            notes.append(
                f"{task.target}: left out the port of {', '.join(behind)} "
                f"({_port_words(rig.cameras[behind[0]])}): these cameras are in air"
            )
        rig = with_port(rig, IN_AIR)
    if rig.covariance is not None and (task.drop_covariance or COVARIANCE not in target.holds):
        _may_lose_covariance(rig, task, where)
        notes.append(f"{task.target}: left out {_covariance_words(rig)}")
        rig = replace(rig, covariance=None)
    if MOUNT not in target.holds and rig.body_from_rig is not UNKNOWN_MOUNT:
        notes.append(f"{task.target}: left out the rig's pose on the vehicle")
    if MOUNT in target.holds and rig.body_from_rig is UNKNOWN_MOUNT:
        notes.append(
            f"{task.source}: tells no pose on the vehicle: {next(iter(rig.cameras))} is taken to "
            "look down from the body's origin"
        )
    return rig, notes


def _may_lose_covariance(rig: Rig, task: Conversion, why: str) -> None:
    if rig.covariance is not None and not task.drop_covariance:
        raise CalibrationError(f"{why} {_covariance_words(rig)}: say --drop-covariance")


def _covariance_words(rig: Rig) -> str:
    count = 0 if rig.covariance is None else len(rig.covariance.parameters)
    return f"the covariance of {count} parameters"


def has_port(camera: FlatPortCamera) -> bool:
    """Whether a camera differs from one in air."""
    return any(getattr(camera, name) != value for name, value in IN_AIR.items())


def _port_words(camera: FlatPortCamera) -> str:
    return (
        f"{camera.port_distance_m * 1e3:g} mm, glass {camera.glass_thickness_m * 1e3:g} mm, "
        f"water {camera.n_water:g}"
    )


def _summary(
    source: Format,
    target: Format,
    rig: Rig,
    written: Sequence[Path],
    prices: Mapping[str, Price],
) -> tuple[str, dict[str, Any]]:
    lines = [f"{source.title} -> {target.title}: {', '.join(str(path) for path in written)}"]
    for name, c in rig.cameras.items():
        place = f"port {_port_words(c)}" if has_port(c) else "in water" if prices else "in air"
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
