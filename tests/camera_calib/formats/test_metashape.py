"""Metashape's XML, against its manual's equations written here again."""

import tempfile
from functools import partial
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from hypothesis import given, settings

from camera_calib.formats.convert import detect
from camera_calib.formats.metashape import read_metashape, write_metashape
from camera_calib.formats.rigs import ReadOptions
from camera_calib.rig import Rig
from tests.strategies_formats import (
    BOTH_LENSES,
    DATA,
    PLUMB_BOB,
    assert_same_pixels,
    fault_of,
    points_for,
    rigs,
)

SAMPLE = (DATA / "metashape.xml").read_text()
SENSOR = """<sensor id="{id}" label="{label}" type="{kind}"><resolution width="4000" height="3000"/>
<property name="pixel_width" value="0.0016"/>
<calibration type="{kind}" class="initial"><f>1</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="4000" height="3000"/><f>2000</f>
<cx>3</cx><k1>0.02</k1><k4>{k4}</k4></calibration></sensor>
"""
DOCUMENT = "<document version='2.0.0'><chunk label='a'><sensors>{}</sensors></chunk></document>"

fault = partial(fault_of, read_metashape)


def manual_pixels(text: str, points: np.ndarray) -> np.ndarray:
    """Appendix "Camera models" of the manual; angles from the axis below a right one."""
    root = ET.fromstring(text)  # noqa: S314 - written by the test
    value = {c.tag: c.text or "" for c in root}
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4, w, h = (
        float(value.get(name, 0.0))
        for name in (
            "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "width",
            "height",
        )
    )  # fmt: skip
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if value["projection"] == "fisheye":
        r0 = np.sqrt(x**2 + y**2)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r = np.sqrt(x**2 + y**2)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
    more = 1 + p3 * r**2 + p4 * r**4  # of PhotoScan 1.2
    x1 = x * radial + (p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y) * more
    y1 = y * radial + (p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y) * more
    return np.stack([w / 2 + cx + x1 * f + x1 * b1 + y1 * b2, h / 2 + cy + y1 * f], axis=1)


@settings(max_examples=50, deadline=None)
@given(rig=rigs(PLUMB_BOB, lenses=BOTH_LENSES, maximum=1))
def test_the_manuals_equations_give_our_pixels(rig: Rig) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (file,) = write_metashape(Path(folder) / "a.xml", rig)
        text = file.read_text()
    (camera,) = rig.cameras.values()
    points = points_for(camera)
    assert_same_pixels(camera.project(points), manual_pixels(text, points), 20)


def test_a_calibration_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(SAMPLE)
    assert detect(path).name == "metashape"
    (camera,) = read_metashape(path, ReadOptions()).cameras.values()
    points = points_for(camera)
    np.testing.assert_allclose(camera.project(points), manual_pixels(SAMPLE, points), atol=1e-9)
    assert (camera.parameter("p1"), camera.parameter("p2")) == (-0.0007, 0.0005)


def test_one_sensor_of_a_document_is_chosen(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    one = SENSOR.format(id=0, label="HERO 11 (3 mm)", kind="fisheye", k4=0.01)
    path.write_text(DOCUMENT.format(one))
    assert detect(path).name == "metashape"
    rig = read_metashape(path, ReadOptions())
    camera = rig.cameras["HERO_11__3_mm_"]
    assert (camera.lens.model, camera.fx_px, camera.cx_px) == ("fisheye", 2000, 2003)
    assert (camera.parameter("k1"), camera.parameter("k4")) == (0.02, 0.01)
    pictures = "<camera id='0'><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>\n"
    many = DOCUMENT.replace("</chunk>", f"<cameras>{pictures * 20_000}</cameras></chunk>")
    path.write_text(many.format(one))
    assert detect(path).name == "metashape"
    assert read_metashape(path, ReadOptions()).cameras == rig.cameras
    path.write_text(DOCUMENT.format(one + SENSOR.format(id=1, label="b", kind="frame", k4=0)))
    assert "HERO 11 (3 mm), b" in fault(path)
    assert "HERO 11 (3 mm), b" in fault(path, None, ReadOptions(camera="c"))
    (camera,) = read_metashape(path, ReadOptions(camera="b")).cameras.values()
    assert camera.lens.model == "opencv"


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    for old, new, named in (
        ("<k1>", "<k4>-900</k4><k1>", "k4"),
        ("frame", "spherical", "spherical"),
        ("3658.5", "-3658.5", "f is of no camera"),
        ("3658.5", "fast", "f: "),
        ("<width>5472</width>", "", "width"),
        ("</calibration>", "", "XML"),
        ("<calibration>", "<!DOCTYPE a><calibration>", "DOCTYPE"),
    ):
        assert named in fault(path, SAMPLE.replace(old, new, 1))
    assert "--camera" in fault(path, DOCUMENT.format(""))
