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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import shown
from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, read_bytes, read_text
from camera_calib.formats.opencv_model import behind_port, camera_in_air, distorts, is_fisheye
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort

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
_NO_REFRACTION = -1
_PORT_PARAMETERS = 8
_MAX_PX = 10**7
_OURS = {"fx": "fx_px", "fy": "fy_px", "cx": "cx_px", "cy": "cy_px"}


@dataclass(frozen=True, kw_only=True)
class CameraRecord:
    """A camera as these files have it."""

    camera_id: int
    model: str
    width_px: int
    height_px: int
    params: tuple[float, ...]
    refraction: str | None = None
    """One of `PORTS`."""
    port: tuple[float, ...] = ()
    """Its parameters."""

    def fields(self, path: Path) -> Fields:
        """The record as named values, for checks that name file and camera."""
        names = MODELS[self.model][1]
        values = {
            "WIDTH": float(self.width_px),
            "HEIGHT": float(self.height_px),
            **{name: [value] for name, value in zip(names, self.params, strict=True)},
            "REFRAC_PARAMS": list(self.port),
        }
        return Fields(path=path, values=values, prefix=f"camera {self.camera_id}: ")


def record_of(camera_id: int, camera: Camera, *, port: bool) -> CameraRecord:
    """The record of a camera, of the smallest model that holds its distortion.

    Args:
        camera_id: number in the file.
        camera: without thin-prism terms.
        port: add the port's parameters.
    """
    if is_fisheye(camera):
        model = "OPENCV_FISHEYE"
    elif distorts(camera, "k3", "k4", "k5", "k6"):
        model = "FULL_OPENCV"
    else:
        model = "OPENCV" if distorts(camera, "k1", "k2", "p1", "p2") else "PINHOLE"
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


def camera_of(path: Path, record: CameraRecord) -> Camera:
    """The camera of a record, with its port.

    Raises:
        CalibrationError: a value is not a finite number or out of range.
    """
    fields = record.fields(path)
    names = MODELS[record.model][1]
    values = {_OURS.get(name, name): fields.number(name) for name in names}
    focal = "fx"
    if "f" in values:
        focal = "f"
        values["fx_px"] = values["fy_px"] = values.pop("f")
    size = (fields.size("WIDTH"), fields.size("HEIGHT"))
    lens: type[LensValues] = FisheyeLens if "FISHEYE" in record.model else OpenCVLens
    camera = camera_in_air(fields, focal, size, lens, values)
    if record.refraction is None:
        return camera
    key = "REFRAC_PARAMS"
    x, y, z, reach, thickness, n_air, n_glass, n_water = fields.numbers(key, 8).tolist()
    if n_air < 1 or min(n_glass, n_water) < n_air:
        raise fields.fault(key, f"has the indices {n_air} {n_glass} {n_water}")
    # Snell's law knows ratios only, so that an index of air other than 1 divides the others.
    shared = {
        "glass_thickness_m": thickness, "n_glass": n_glass / n_air, "n_water": n_water / n_air
    }  # fmt: skip
    if record.refraction == "DOMEPORT":
        centre = {"dome_x_m": x, "dome_y_m": y, "dome_z_m": z}
        return behind_port(
            fields, key, camera, DomePort, outer_radius_m=reach + thickness, **centre, **shared
        )
    if abs(math.hypot(x, y, z) - 1.0) > 1e-6 or z <= 0:
        raise fields.fault(key, f"has no unit normal facing forward: {x} {y} {z}")
    return behind_port(
        fields, key, camera, FlatPort, normal=(x, y, z), port_distance_m=reach, **shared
    )


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
                struct.pack("<Q", len(records)) + b"".join(_packed(record) for record in records)
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


def _packed(record: CameraRecord) -> bytes:
    number = MODELS[record.model][0]
    size = (record.width_px, record.height_px)
    start = struct.pack("<IiQQ", record.camera_id, number, *size)
    body = struct.pack(f"<{len(record.params)}d", *record.params)
    if record.refraction is None:
        return start + body + struct.pack("<i", _NO_REFRACTION)
    return (
        start
        + body
        + struct.pack(f"<i{_PORT_PARAMETERS}d", PORTS.index(record.refraction), *record.port)
    )


def _read_text(path: Path) -> list[CameraRecord]:
    records = []
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        items = line.split()
        if not items or items[0].startswith("#"):
            continue
        where = f"{path}: line {row}"
        if len(items) < 5:
            raise CalibrationError(f"{where}: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] expected")
        model = _known(where, items[1])
        count = len(MODELS[model][1])
        params, port = items[4 : 4 + count], items[4 + count :]
        if len(params) < count or (port and _is_number(port[0])):
            raise CalibrationError(f"{where}: {model} has {count} PARAMS: {len(items) - 4} found")
        if port:
            if port[0] not in PORTS:
                raise CalibrationError(
                    f"{where}: port {shown(port[0])}: {' and '.join(PORTS)} can be read"
                )
            if len(port) != 1 + _PORT_PARAMETERS:
                raise CalibrationError(
                    f"{where}: {port[0]} has {_PORT_PARAMETERS} REFRAC_PARAMS: "
                    f"{len(port) - 1} found"
                )
        try:
            records.append(
                CameraRecord(
                    camera_id=int(items[0]),
                    model=model,
                    width_px=int(items[2]),
                    height_px=int(items[3]),
                    params=tuple(map(float, params)),
                    refraction=port[0] if port else None,
                    port=tuple(map(float, port[1:])),
                )
            )
        except ValueError as error:
            raise CalibrationError(f"{where}: {shown(str(error))}") from None
        if max(abs(records[-1].width_px), abs(records[-1].height_px)) > _MAX_PX:
            raise CalibrationError(f"{where}: WIDTH or HEIGHT is over {_MAX_PX} px")
    return records


def _read_binary(path: Path) -> list[CameraRecord]:
    content = read_bytes(path)
    # Only one of the two kinds ends where the file ends: the other is 4 bytes or more off.
    for refractive in (False, True):
        records = _unpacked(path, content, refractive)
        if records is not None:
            return records
    raise CalibrationError(f"{path}: is not a cameras.bin of COLMAP or Refractive COLMAP")


def _unpacked(path: Path, content: bytes, refractive: bool) -> list[CameraRecord] | None:
    """Cameras of a binary file, or None when it is not of this kind to the last byte."""
    records = []
    at = 8
    try:
        (count,) = struct.unpack_from("<Q", content)
        for _ in range(min(count, len(content))):
            camera_id, number, width, height = struct.unpack_from("<IiQQ", content, at)
            model = {known: name for name, (known, _) in MODELS.items()}.get(number)
            if model is None:
                name = _model_name(number) if at == 8 else None
                if name is not None:
                    _known(f"{path}: camera {camera_id}", name)
                return None
            size = len(MODELS[model][1])
            params = struct.unpack_from(f"<{size}d", content, at + 24)
            at += 24 + 8 * size
            name = None
            port: tuple[float, ...] = ()
            if refractive:
                (refraction,) = struct.unpack_from("<i", content, at)
                at += 4
                if refraction != _NO_REFRACTION:
                    if not 0 <= refraction < len(PORTS):
                        return None
                    name = PORTS[refraction]
                    port = struct.unpack_from(f"<{_PORT_PARAMETERS}d", content, at)
                    at += 8 * _PORT_PARAMETERS
            records.append(
                CameraRecord(
                    camera_id=camera_id,
                    model=model,
                    width_px=width,
                    height_px=height,
                    params=params,
                    refraction=name,
                    port=port,
                )
            )
    except struct.error:
        return None
    return records if at == len(content) else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _model_name(number: int) -> str | None:
    names = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items()}
    return names.get(number)


def _known(where: str, model: str) -> str:
    if model not in MODELS:
        raise CalibrationError(
            f"{where}: model {shown(model)} is not held here: {', '.join(MODELS)} can be read"
        )
    return model
