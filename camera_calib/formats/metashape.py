"""Agisoft Metashape's XML: a calibration file, and the sensors of an exported `document`.

Equations of the manual's appendix on camera models (Metashape Professional 2.2 and 2.3), for frame
cameras with x = X / Z, y = Y / Z and for fisheyes (equidistant) with x, y scaled to the length of
the angle from the axis:

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y
    u = w / 2 + cx + x' (f + b1) + y' b2,  v = h / 2 + cy + y' f

Pixels count from the outer corner of the first one; p1 and p2 are OpenCV's p2 and p1. A frame's k4,
a fisheye's p1 and p2, and b2 have no place in lenses here, p3 and p4 are of older versions.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as ET

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import xml_root
from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.rig import Rig

PICTURES = (b"<cameras", b"</cameras>")
"""Marks around the poses of all pictures."""
_FISHEYE_TERMS = {name: name for name in ("k1", "k2", "k3", "k4")}
_KINDS: Mapping[str, tuple[type[LensValues], Mapping[str, str]]] = {
    "frame": (OpenCVLens, {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p2", "p2": "p1"}),
    "fisheye": (FisheyeLens, _FISHEYE_TERMS),
    "equidistant_fisheye": (FisheyeLens, _FISHEYE_TERMS),
}
"""The lens, and names here by Metashape's, of its projections."""
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b2")


class _MetashapeCamera(fields.FileModel):
    projection: Literal["frame", "fisheye", "equidistant_fisheye"]
    width: fields.Pixels
    height: fields.Pixels
    f: float
    cx: float = 0.0
    cy: float = 0.0
    b1: float = 0.0
    b2: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    p3: float = 0.0
    p4: float = 0.0


def read_metashape(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a calibration, or one sensor of a document.

    Raises:
        CalibrationError: the file is malformed, has several sensors and none is chosen, or
            parameters that no lens here has.
    """
    try:
        top = xml_root(fields.read_text(path, PICTURES))
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
    if top.tag == "calibration":
        return rigs.assemble(path, reading, "Metashape", ["cam0"], [_camera(path, top)], rigs.ONE)
    sensors = {
        str(sensor.get("label") or sensor.get("id")): sensor.find("calibration")
        for sensor in top.iter("sensor")
    }
    known = {name: found for name, found in sensors.items() if found is not None}
    chosen = known if reading.camera is None else {reading.camera: known.get(reading.camera)}
    ((name, element),) = chosen.items() if len(chosen) == 1 else [("", None)]
    if element is None:
        labels = ", ".join(" ".join(each.split())[:40] for each in list(known)[:8])
        raise CalibrationError(f"{path}: choose one of its sensors with --camera: {labels}")
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in name)
    names = [plain.lstrip("_.-") or "cam0"]
    return rigs.assemble(path, reading, "Metashape", names, [_camera(path, element)], rigs.ONE)


def write_metashape(path: Path, rig: Rig) -> list[Path]:
    """Write a calibration file of one camera."""
    (camera,) = rig.cameras.values()
    kind: Literal["fisheye", "frame"] = "fisheye" if opencv_model.is_fisheye(camera) else "frame"
    values = _MetashapeCamera(
        projection=kind,
        width=camera.width_px,
        height=camera.height_px,
        f=camera.fy_px,
        cx=camera.cx_px - 0.5 * camera.width_px,
        cy=camera.cy_px - 0.5 * camera.height_px,
        b1=camera.fx_px - camera.fy_px,
        **{theirs: camera.parameter(ours) for theirs, ours in _KINDS[kind][1].items()},
    ).model_dump(exclude_unset=True)
    top = ET.Element("calibration")
    for name, value in values.items():
        ET.SubElement(top, name).text = str(value)
    ET.indent(top)
    with atomic_path(path) as temporary:
        ET.ElementTree(top).write(temporary, encoding="UTF-8", xml_declaration=True)
    return [path]


def _camera(path: Path, element: ET.Element) -> Camera:
    values: dict[str, object] = {child.tag: (child.text or "").strip() for child in element}
    resolution = element.find("resolution")
    values |= {} if resolution is None else resolution.attrib
    if element.get("type"):
        values["projection"] = element.get("type")
    found = _MetashapeCamera.check(path, values)
    lens, names = _KINDS[found.projection]
    lost = [n for n in _COEFFICIENTS if n not in names and getattr(found, n) != 0.0]
    if lost:
        raise CalibrationError(
            f"{path}: {', '.join(lost)} of a {found.projection} camera: no lens here has them: "
            "calibrate again in Metashape with these at 0"
        )
    ours = {
        "fx_px": found.f + found.b1,
        "fy_px": found.f,
        "cx_px": 0.5 * found.width + found.cx,
        "cy_px": 0.5 * found.height + found.cy,
    }
    terms = {own: getattr(found, theirs) for theirs, own in names.items()}
    return opencv_model.camera_of(f"{path}: f", (found.width, found.height), lens, ours | terms)


def _owns(path: Path) -> bool:
    if path.suffix.lower() != ".xml":
        return False
    text = fields.read_text(path, PICTURES)
    return "<calibration" in text and ("<projection>" in text or "<sensor" in text)


FORMAT = rigs.CalibrationFormat(
    name="metashape",
    title="Metashape calibration XML",
    holds=frozenset({rigs.K3}),
    owns=_owns,
    read=read_metashape,
    write=write_metashape,
    max_cameras=1,
)
