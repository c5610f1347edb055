"""All formats: how each is read and written, what it holds, how it is recognised."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from alice_survey.core.errors import CalibrationError
from camera_calib.formats.camera_files import read_records
from camera_calib.formats.colmap import (
    CAMERA_FILES,
    RIG_CONFIG,
    model_files,
    read_colmap,
    write_colmap,
    write_refractive,
)
from camera_calib.formats.fields import read_text, read_yaml
from camera_calib.formats.gyroflow import KEY, read_gyroflow
from camera_calib.formats.kalibr import read_kalibr, write_kalibr
from camera_calib.formats.metashape import PICTURES, is_metashape, read_metashape, write_metashape
from camera_calib.formats.mrcal import SUFFIX, mrcal_files, read_mrcal, write_mrcal
from camera_calib.formats.opencv import read_opencv, write_opencv
from camera_calib.formats.rigs import ReadOptions, file_each
from camera_calib.formats.ros import SUFFIXES, read_ros, write_ros
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig, read_rig, write_rig

K3, RATIONAL, PRISM, COVARIANCE, MOUNT = "k3", "rational", "prism", "covariance", "mount"
FISHEYE, FLAT, DOME = FisheyeLens.model, FlatPort.shape, DomePort.shape
_PINHOLE = frozenset({K3, RATIONAL, PRISM})
_ALL = _PINHOLE | {FISHEYE, FLAT, DOME, COVARIANCE, MOUNT}
_COLMAP = frozenset({K3, RATIONAL, FISHEYE})


@dataclass(frozen=True, kw_only=True)
class CalibrationFormat:
    """One format of camera calibrations."""

    name: str
    title: str
    holds: frozenset[str]
    """More than cameras with k1 k2 p1 p2: terms, lenses, ports, and what belongs to the rig."""
    read: Callable[[Path, ReadOptions], Rig]
    write: Callable[[Path, Rig], list[Path]]
    targets: Callable[[Path, Rig], list[Path]]
    """The files that writing a rig to a path would replace."""


def _read_own(path: Path, reading: ReadOptions) -> Rig:
    del reading  # rig.json leaves nothing open
    return read_rig(path)


def _write_own(path: Path, rig: Rig) -> list[Path]:
    write_rig(path, rig)
    return [path]


def _itself(path: Path, rig: Rig) -> list[Path]:
    del rig
    return [path]


def _not_written(path: Path, rig: Rig) -> list[Path]:
    del rig
    raise CalibrationError(f"{path}: lens profiles are read only: choose another --to")


_FORMATS = (
    CalibrationFormat(
        name="rig",
        title="rig.json of this project",
        holds=_ALL,
        read=_read_own,
        write=_write_own,
        targets=_itself,
    ),
    CalibrationFormat(
        name="opencv",
        title="OpenCV YAML or XML",
        holds=_ALL,
        read=read_opencv,
        write=write_opencv,
        targets=_itself,
    ),
    CalibrationFormat(
        name="colmap",
        title="COLMAP model and rig_config.json",
        holds=_COLMAP,
        read=read_colmap,
        write=write_colmap,
        targets=model_files,
    ),
    CalibrationFormat(
        name="refractive",
        title="Refractive COLMAP cameras with FLATPORT or DOMEPORT",
        holds=_COLMAP | {FLAT, DOME},
        read=read_colmap,
        write=write_refractive,
        targets=model_files,
    ),
    CalibrationFormat(
        name="kalibr",
        title="Kalibr camchain YAML",
        holds=frozenset({FISHEYE}),
        read=read_kalibr,
        write=write_kalibr,
        targets=_itself,
    ),
    CalibrationFormat(
        name="ros",
        title="ROS camera_info YAML",
        holds=frozenset({K3, RATIONAL, FISHEYE}),
        read=read_ros,
        write=write_ros,
        targets=file_each,
    ),
    CalibrationFormat(
        name="metashape",
        title="Metashape calibration XML",
        holds=frozenset({K3, FISHEYE}),
        read=read_metashape,
        write=write_metashape,
        targets=_itself,
    ),
    CalibrationFormat(
        name="mrcal",
        title="mrcal .cameramodel",
        holds=_PINHOLE,
        read=read_mrcal,
        write=write_mrcal,
        targets=mrcal_files,
    ),
    CalibrationFormat(
        name="gyroflow",
        title="Gyroflow lens profile",
        holds=frozenset(),
        read=read_gyroflow,
        write=_not_written,
        targets=_not_written,
    ),
)
FORMATS = {each.name: each for each in _FORMATS}


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
    name = _of_folder(path) if path.is_dir() else _of_file(path)
    if name is None:
        raise CalibrationError(f"{path}: of no known format: name it with --from")
    return FORMATS[name]


def of_target(path: Path) -> CalibrationFormat:
    """The format that the name of a new file calls for.

    Raises:
        CalibrationError: several formats have such names.
    """
    if path.name in CAMERA_FILES:
        return FORMATS["colmap"]
    by_suffix = {".json": "rig", ".xml": "opencv", SUFFIX: "mrcal"}
    if path.suffix.lower() not in by_suffix:
        raise CalibrationError(f"{path}: name the format with --to: {', '.join(FORMATS)}")
    return FORMATS[by_suffix[path.suffix.lower()]]


def _of_folder(path: Path) -> str | None:
    for name in CAMERA_FILES:
        if (path / name).is_file():
            return _of_file(path / name)
    if (path / RIG_CONFIG).is_file():
        return "colmap"
    if any(path.glob(f"*{SUFFIX}")):
        return "mrcal"
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    return "ros" if files and all(_of_file(file) == "ros" for file in files) else None


def _of_file(path: Path) -> str | None:
    suffix = path.suffix.lower()
    if suffix in (".txt", ".bin"):
        ports = any(record.refraction for record in read_records(path))
        return "refractive" if ports else "colmap"
    if suffix == SUFFIX:  # may be larger than others
        return "mrcal"
    text = read_text(path, PICTURES if suffix == ".xml" else None)
    if suffix == ".json":
        other = "gyroflow" if f'"{KEY}"' in text else "rig"
        return "colmap" if text.lstrip().startswith("[") else other
    if suffix == ".xml" and is_metashape(text):
        return "metashape"
    if suffix == ".xml" or text.startswith("%YAML:1.") or "!!opencv-matrix" in text:
        return "opencv"
    if suffix in SUFFIXES:
        fields = read_yaml(path)
        if "cam0" in fields:
            return "kalibr"
        if "camera_matrix" in fields and "image_width" in fields:
            return "ros"
    return None
