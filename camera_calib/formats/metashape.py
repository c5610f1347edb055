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
from xml.etree import ElementTree as ET

from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, read_text
from camera_calib.formats.opencv_model import camera_in_air, is_fisheye
from camera_calib.formats.rigs import ReadOptions, assemble
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.rig import Rig

PICTURES = (b"<cameras", b"</cameras>")
"""Marks around the poses of all pictures."""
_FRAME = {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p2", "p2": "p1"}
"""Names here by Metashape's."""
_FISHEYE = {name: name for name in ("k1", "k2", "k3", "k4")}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b2")
_KINDS: Mapping[str, tuple[type[LensValues], Mapping[str, str]]] = {
    "frame": (OpenCVLens, _FRAME),
    "fisheye": (FisheyeLens, _FISHEYE),
    "equidistant_fisheye": (FisheyeLens, _FISHEYE),
}


def is_metashape(text: str) -> bool:
    """Whether an XML text is Metashape's."""
    return "<calibration" in text and ("<projection>" in text or "<sensor" in text)


def read_metashape(path: Path, reading: ReadOptions) -> Rig:
    """Read a calibration, or one sensor of a document.

    Raises:
        CalibrationError: the file is malformed, has several sensors and none is chosen, or
            parameters that no lens here has.
    """
    text = read_text(path, PICTURES)
    try:
        top = ET.fromstring(text)  # noqa: S314 - without a document type
    except (ET.ParseError, ValueError) as error:
        raise CalibrationError(f"{path}: not valid XML: {error}") from None
    if top.tag == "calibration":
        return assemble(path, reading, "Metashape", ["cam0"], [_camera(path, top)], _ONE)
    sensors = {
        str(sensor.get("label") or sensor.get("id")): sensor.find("calibration")
        for sensor in top.iter("sensor")
    }
    known = {name: found for name, found in sensors.items() if found is not None}
    wanted = known if reading.camera is None else {reading.camera: known.get(reading.camera)}
    ((name, element),) = wanted.items() if len(wanted) == 1 else [("", None)]
    if element is None:
        labels = ", ".join(" ".join(each.split())[:40] for each in list(known)[:8])
        raise CalibrationError(f"{path}: choose one of its sensors with --camera: {labels}")
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in name)
    return assemble(path, reading, "Metashape", [plain.lstrip("_.-") or "cam0"],
                    [_camera(path, element)], _ONE)  # fmt: skip


def write_metashape(path: Path, rig: Rig) -> list[Path]:
    """Write a calibration file.

    Raises:
        CalibrationError: the rig has several cameras.
    """
    if len(rig.cameras) > 1:
        raise CalibrationError(
            f"{path}: a calibration file of Metashape holds one camera, the rig has "
            f"{len(rig.cameras)}: choose one with --camera"
        )
    (camera,) = rig.cameras.values()
    kind = "fisheye" if is_fisheye(camera) else "frame"
    values: dict[str, object] = {
        "projection": kind,
        "width": camera.width_px,
        "height": camera.height_px,
        "f": camera.fy_px,
        "cx": camera.cx_px - 0.5 * camera.width_px,
        "cy": camera.cy_px - 0.5 * camera.height_px,
        "b1": camera.fx_px - camera.fy_px,
    }
    values |= {theirs: camera.parameter(ours) for theirs, ours in _KINDS[kind][1].items()}
    top = ET.Element("calibration")
    for name, value in values.items():
        ET.SubElement(top, name).text = str(value)
    ET.indent(top)
    with atomic_path(path) as temporary:
        ET.ElementTree(top).write(temporary, encoding="UTF-8", xml_declaration=True)
    return [path]


_ONE = (RigidTransform.identity(),)


def _camera(path: Path, element: ET.Element) -> Camera:
    values: dict[str, object] = {child.tag: (child.text or "").strip() for child in element}
    resolution = element.find("resolution")
    if resolution is not None:
        values |= resolution.attrib
    fields = Fields(path=path, values=values)
    kind = element.get("type") or fields.text("projection")
    if kind not in _KINDS:
        raise CalibrationError(f"{path}: projection {kind!r}; {', '.join(_KINDS)} can be read")
    lens, names = _KINDS[kind]

    def value(name: str) -> float:
        return fields.number(name) if name in fields else 0.0

    lost = [name for name in _COEFFICIENTS if name not in names and value(name) != 0.0]
    if lost:
        raise CalibrationError(
            f"{path}: {', '.join(lost)} of a {kind} camera: no lens here has them: calibrate again "
            "in Metashape with these at 0"
        )
    size = fields.size("width"), fields.size("height")
    f = fields.number("f")
    ours = {
        "fx_px": f + value("b1"),
        "fy_px": f,
        "cx_px": 0.5 * size[0] + value("cx"),
        "cy_px": 0.5 * size[1] + value("cy"),
    }
    return camera_in_air(
        fields, "f", size, lens, ours | {own: value(theirs) for theirs, own in names.items()}
    )
