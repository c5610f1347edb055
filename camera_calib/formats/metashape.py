"""Agisoft Metashape's XML: a calibration file, and the sensors of an exported `document`.

Equations of the manual's appendix on camera models (Metashape Professional 2.2 and 2.3), for frame
cameras with x = X / Z, y = Y / Z and for fisheyes (equidistant) with x, y scaled to the length of
the angle from the axis:

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y
    u = w / 2 + cx + x' (f + b1) + y' b2,  v = h / 2 + cy + y' f

Pixels count from the outer corner of the first one; p1 and p2 are OpenCV's p2 and p1. PhotoScan 1.2
to 1.4 has p3 and p4: p1 and p2 times (1 + p3 r^2 + p4 r^4). Versions until 2015 have fx, fy, skew
(now b2), cx and cy from the corner, and p1 and p2 as OpenCV. A camera with a frame's k4, p3, p4, b2
or a fisheye's p1 and p2 becomes the nearest one that has a lens here.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as ET

import numpy as np

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import xml_root
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import COEFFICIENTS, OpenCVLens
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
_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b2")
_OLD = {"fy": "f", "skew": "b2", "p1": "p2", "p2": "p1"}
"""Keys by those of versions that have fx."""


class _MetashapeCamera(fields.FileModel):
    projection: Literal["frame", "fisheye", "equidistant_fisheye"]
    width: fields.Pixels
    height: fields.Pixels


_Numbers = fields.numbers_model(("f",), (*_TERMS, "cx", "cy", "b1", "fx"))


def read_metashape(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a calibration, or one sensor of a document.

    Raises:
        CalibrationError: the file is malformed, has several sensors and none is chosen, or
            the nearest lens does not reach over the frame.
    """
    try:
        top = xml_root(fields.read_text(path, PICTURES))
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
    if top.tag == "calibration":
        return rigs.assemble(path, reading, "Metashape", ["cam0"], [_camera(path, top)], rigs.ONE)
    sensors = {
        str(sensor.get("label") or sensor.get("id")): sensor.findall("calibration")
        for sensor in top.iter("sensor")
    }
    known = {name: found[-1] for name, found in sensors.items() if found}  # the first is initial
    chosen = known if reading.camera is None else {reading.camera: known.get(reading.camera)}
    ((name, element),) = chosen.items() if len(chosen) == 1 else [("", None)]
    if element is None:
        labels = ", ".join(" ".join(each.split())[:40] for each in list(known)[:8])
        raise CalibrationError(f"{path}: choose one of its sensors with --camera: {labels}")
    return rigs.assemble(path, reading, "Metashape", [name], [_camera(path, element)], rigs.ONE)


def write_metashape(path: Path, rig: Rig) -> list[Path]:
    """Write a calibration file of one camera."""
    (camera,) = rig.cameras.values()
    kind = "fisheye" if opencv_model.is_fisheye(camera) else "frame"
    values = {
        "projection": kind,
        "width": camera.width_px,
        "height": camera.height_px,
        "f": camera.fy_px,
        "cx": camera.cx_px - 0.5 * camera.width_px,
        "cy": camera.cy_px - 0.5 * camera.height_px,
        "b1": camera.fx_px - camera.fy_px,
    } | {theirs: camera.parameter(ours) for theirs, ours in _KINDS[kind][1].items()}
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
    if "fx" in values:
        values = {_OLD.get(name, name): value for name, value in values.items()}
    found = _MetashapeCamera.check(path, values)
    others = (*_MetashapeCamera.known_keys(), "resolution", "date")
    t, size = _Numbers.check(path, values, "", others).model_dump(), (found.width, found.height)
    if t["fx"]:
        t |= {"b1": t["fx"] - t["f"], "cx": t["cx"] - 0.5 * size[0], "cy": t["cy"] - 0.5 * size[1]}
    lens, names = _KINDS[found.projection]
    ours = {
        "fx_px": t["f"] + t["b1"],
        "fy_px": t["f"],
        "cx_px": 0.5 * size[0] + t["cx"],
        "cy_px": 0.5 * size[1] + t["cy"],
    } | {own: t[theirs] for theirs, own in names.items()}
    camera = opencv_model.camera_of(f"{path}: f", size, lens, ours)
    lost = [name for name in _TERMS if name not in names and t[name] != 0.0]
    if not lost:
        return camera

    def project(rays: Array) -> Array:
        across, z = rays[..., :2], rays[..., 2:]
        r = np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
        plane = across / z if lens is OpenCVLens else across * np.arctan2(r, z) / r
        r2 = np.sum(plane**2, axis=-1, keepdims=True)
        radial = 1.0 + r2 * (t["k1"] + r2 * (t["k2"] + r2 * (t["k3"] + r2 * t["k4"])))
        p = np.array([t["p1"], t["p2"]])
        aside = p * (r2 + 2.0 * plane**2) + 2.0 * p[::-1] * np.prod(plane, axis=-1, keepdims=True)
        seen = plane * radial + aside * (1.0 + r2 * (t["p3"] + r2 * t["p4"]))
        u = camera.cx_px + camera.fx_px * seen[..., 0] + t["b2"] * seen[..., 1]
        return np.stack([u, camera.cy_px + camera.fy_px * seen[..., 1]], axis=-1)

    free = COEFFICIENTS[: 8 if "k4" in lost else 5] if lens is OpenCVLens else tuple(_FISHEYE_TERMS)
    where = f"{path}: {', '.join(lost)} of a {found.projection} camera"
    return opencv_model.nearest_camera(where, camera, free, project)
