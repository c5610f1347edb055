"""COLMAP's cameras.txt and cameras.bin, and the same with the ports of Refractive COLMAP.

COLMAP: https://colmap.github.io/format.html, one line a camera: `CAMERA_ID MODEL WIDTH HEIGHT
PARAMS[]`. Refractive COLMAP (She et al. 2024, https://arxiv.org/abs/2403.08640) appends
`REFRAC_MODEL REFRAC_PARAMS[]` to the line; its binary has an int32 after the parameters, the
refraction model's number or -1, and then its parameters. Lengths are in metres. A FLATPORT has `Nx
Ny Nz int_dist int_thick na ng nw`, the normal pointing into the water; a DOMEPORT `Cx Cy Cz
int_radius int_thick na ng nw`, its centre and the radius of its inner surface.
"""

import math
import struct
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, Self

import pycolmap
from pydantic import Field, model_validator

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import as_line
from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats import fields, opencv_model
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.values import PortValues

MODELS = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
    "SIMPLE_FISHEYE": (14, ("f", "cx", "cy")),
    "FISHEYE": (15, ("fx", "fy", "cx", "cy")),
}
"""Number and parameters of COLMAP's models that a lens here contains."""
PORTS = ("FLATPORT", "DOMEPORT")
"""Refraction models by their numbers; both have eight parameters, the last three indices."""
_WORDS = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT")
_NO_REFRACTION = -1
_PORT_PARAMETERS = 8
_OURS = {"fx": "fx_px", "fy": "fy_px", "cx": "cx_px", "cy": "cy_px"}


class CameraRecord(fields.FileModel):
    """A camera as these files have it, by the words of their comments."""

    camera_id: int = Field(alias="CAMERA_ID")
    model: str = Field(alias="MODEL")
    """One of `MODELS`."""
    width_px: fields.Pixels = Field(alias="WIDTH")
    height_px: fields.Pixels = Field(alias="HEIGHT")
    params: tuple[float, ...] = Field(alias="PARAMS")
    refraction: Literal["FLATPORT", "DOMEPORT"] | None = Field(None, alias="REFRAC_MODEL")
    port: tuple[float, ...] = Field((), alias="REFRAC_PARAMS")
    """Its parameters."""

    @model_validator(mode="after")
    def _check_counts(self) -> Self:
        ports = 0 if self.refraction is None else _PORT_PARAMETERS
        for model, kind, values, count in (
            (self.model, "PARAMS", self.params, len(MODELS[self.model][1])),
            (self.refraction, "REFRAC_PARAMS", self.port, ports),
        ):
            if len(values) != count:
                raise ValueError(f"{model} has {count} {kind}: {len(values)} found")
        return self


def record_of(camera_id: int, camera: Camera, *, port: bool) -> CameraRecord:
    """The record of a camera, of the smallest model that holds its distortion.

    Args:
        camera_id: number in the file.
        camera: without thin-prism terms.
        port: add the port's parameters.
    """
    if opencv_model.is_fisheye(camera):
        model = "OPENCV_FISHEYE"
    elif opencv_model.distorts(camera, "k3", "k4", "k5", "k6"):
        model = "FULL_OPENCV"
    else:
        model = "OPENCV" if opencv_model.distorts(camera, "k1", "k2", "p1", "p2") else "PINHOLE"
    return CameraRecord(
        camera_id=camera_id,
        model=model,
        width_px=camera.width_px,
        height_px=camera.height_px,
        params=tuple(camera.parameter(_OURS.get(name, name)) for name in MODELS[model][1]),
        **(_housing(camera) if port else {}),
    )


def _housing(camera: Camera) -> dict[str, Any]:
    values = camera.port.values.tolist()
    if camera.port.shape == FlatPort.shape:
        distance, thickness, n_glass, n_water, *normal = values
        return {
            "refraction": "FLATPORT",
            "port": (*normal, distance, thickness, 1.0, n_glass, n_water),
        }
    if camera.port.shape == DomePort.shape:
        x, y, z, radius, thickness, n_glass, n_water = values
        return {
            "refraction": "DOMEPORT",
            "port": (x, y, z, radius - thickness, thickness, 1.0, n_glass, n_water),
        }
    return {}


def camera_of_record(path: Path, record: CameraRecord) -> Camera:
    """The camera of a record, with its port.

    Raises:
        CalibrationError: a value is out of range.
    """
    where = f"{path}: camera {record.camera_id}:"
    names = MODELS[record.model][1]
    values = {_OURS.get(n, n): value for n, value in zip(names, record.params, strict=True)}
    if "f" in values:
        values["fx_px"] = values["fy_px"] = values.pop("f")
    size = (record.width_px, record.height_px)
    lens = FisheyeLens if "FISHEYE" in record.model else OpenCVLens
    if record.refraction is None:
        return opencv_model.camera_of(f"{where} {names[0]}", size, lens, values)
    x, y, z, reach, thickness, n_air, n_glass, n_water = record.port
    if n_air < 1 or min(n_glass, n_water) < n_air:
        raise CalibrationError(f"{where} REFRAC_PARAMS has the indices {n_air} {n_glass} {n_water}")
    # Snell's law knows ratios only, so that an index of air other than 1 divides the others.
    port: dict[str, Any] = {
        "glass_thickness_m": thickness, "n_glass": n_glass / n_air, "n_water": n_water / n_air
    }  # fmt: skip
    kind: type[PortValues] = FlatPort
    if record.refraction == "DOMEPORT":
        kind = DomePort
        port |= {"dome_x_m": x, "dome_y_m": y, "dome_z_m": z, "outer_radius_m": reach + thickness}
    elif abs(math.hypot(x, y, z) - 1.0) > 1e-6 or z <= 0:
        raise CalibrationError(
            f"{where} REFRAC_PARAMS has no unit normal facing forward: {x} {y} {z}"
        )
    else:
        port |= {"normal": (x, y, z), "port_distance_m": reach}
    return opencv_model.camera_of(f"{where} fx or REFRAC_PARAMS", size, lens, values, kind, port)


def read_records(path: Path) -> list[CameraRecord]:
    """Cameras of a cameras.txt or cameras.bin of either kind, in the order of their numbers.

    Raises:
        CalibrationError: no such file, or it is malformed, or a model is none of `MODELS`.
    """
    records = _read_binary(path) if path.suffix.lower() == ".bin" else _read_text(path)
    if not records:
        raise CalibrationError(f"{path}: holds no camera")
    ids = [record.camera_id for record in records]
    if len(set(ids)) != len(ids):
        raise CalibrationError(f"{path}: two cameras of one CAMERA_ID")
    return sorted(records, key=lambda record: record.camera_id)


def write_records(path: Path, records: Sequence[CameraRecord]) -> None:
    """Write the cameras.txt or cameras.bin of Refractive COLMAP."""
    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".bin":
            temporary.write_bytes(
                struct.pack("<Q", len(records)) + b"".join(_pack(record) for record in records)
            )
        else:
            head = [
                "# Camera list with one line of data per camera:",
                "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] OPTIONAL[REFRAC_MODEL "
                "REFRAC_PARAMS[]]",
                f"# Number of cameras: {len(records)}",
            ]
            text = "\n".join([*head, *map(_line, records)]) + "\n"
            temporary.write_text(text, encoding="utf-8")


def _line(record: CameraRecord) -> str:
    items = [record.camera_id, record.model, record.width_px, record.height_px]
    items += map(_digits, record.params)
    if record.refraction is not None:
        items += [record.refraction, *map(_digits, record.port)]
    return " ".join(map(str, items))


def _digits(value: float) -> str:
    return f"{value:.17g}"


def _pack(record: CameraRecord) -> bytes:
    number, params = MODELS[record.model][0], record.params
    start = struct.pack("<IiQQ", record.camera_id, number, record.width_px, record.height_px)
    end = struct.pack("<i", _NO_REFRACTION)
    if record.refraction is not None:
        kind = PORTS.index(record.refraction)
        end = struct.pack(f"<i{_PORT_PARAMETERS}d", kind, *record.port)
    return start + struct.pack(f"<{len(params)}d", *params) + end


def _read_text(path: Path) -> list[CameraRecord]:
    records = []
    for row, line in enumerate(fields.read_text(path).splitlines(), start=1):
        items = line.split()
        if not items or items[0].startswith("#"):
            continue
        where = f"line {row}: "
        if len(items) < 5:
            raise CalibrationError(f"{path}: {where}CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] expected")
        _check_model(f"{path}: {where}", items[1])
        values: dict[str, Any] = dict(zip(_WORDS, items, strict=False))
        values["PARAMS"] = list(takewhile(_is_number, items[4:]))
        port = items[4 + len(values["PARAMS"]) :]
        if port:
            values |= {"REFRAC_MODEL": port[0], "REFRAC_PARAMS": port[1:]}
        records.append(CameraRecord.check(path, values, where))
    return records


def _read_binary(path: Path) -> list[CameraRecord]:
    content = fields.read_bytes(path)
    others = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items()}
    first = int.from_bytes(content[12:16], "little") if len(content) >= 16 else -1
    if first in others:
        _check_model(f"{path}: first camera: ", others[first])
    # Only one of the two kinds ends where the file ends: the other is 4 bytes or more off.
    for refractive in (False, True):
        try:
            records = _unpack(content, refractive)
        except (struct.error, KeyError, IndexError, ValueError):
            continue
        if records is not None:
            return records
    raise CalibrationError(f"{path}: is not a cameras.bin of COLMAP or Refractive COLMAP")


def _unpack(content: bytes, refractive: bool) -> list[CameraRecord] | None:
    """Cameras of a binary file, or None when it is not of this kind to the last byte."""
    numbers = {number: name for name, (number, _) in MODELS.items()}
    records: list[CameraRecord] = []
    at = 8
    (count,) = struct.unpack_from("<Q", content)
    for _ in range(min(count, len(content))):
        camera_id, number, width, height = struct.unpack_from("<IiQQ", content, at)
        model, at = numbers[number], at + 24
        params = struct.unpack_from(f"<{len(MODELS[model][1])}d", content, at)
        at += 8 * len(params)
        kind, port = _NO_REFRACTION, ()
        if refractive:
            (kind,) = struct.unpack_from("<i", content, at)
            at += 4
        if kind != _NO_REFRACTION:
            port = struct.unpack_from(f"<{_PORT_PARAMETERS}d", content, at)
            at += 8 * _PORT_PARAMETERS
        records.append(
            CameraRecord(
                camera_id=camera_id, model=model, width_px=width, height_px=height, params=params,
                refraction={_NO_REFRACTION: None, **dict(enumerate(PORTS))}[kind], port=port,
            )
        )  # fmt: skip
    return records if at == len(content) else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check_model(where: str, model: str) -> None:
    if model not in MODELS:
        raise CalibrationError(
            f"{where}model {as_line(model)} is not held here: {', '.join(MODELS)} can be read"
        )
