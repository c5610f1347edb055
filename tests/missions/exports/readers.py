"""Readers written against the formats' descriptions, and geodesy that no code under test uses."""

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from pyproj import Geod

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array, Datum
from camera_calib.rig import Rig, design_rig
from missions.values.plan_file import Plan
from tests.missions.exports.plans import line, plan_of

WIDE = settings(
    max_examples=15,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
_GEOD = Geod(ellps="WGS84")
_COORDINATE = {"latitude": (-90.0, 90.0), "longitude": (-180.0, 180.0)}
_FINAL = ["final_latitude", "final_longitude", "final_depth", "final_altitude"]
_CHILDREN = {
    "goto": [*_FINAL, "heave_mode", "surge_velocity", "tolerance_xy", "no_altitude_goes_up"],
    "section": [
        "initial_latitude", "initial_longitude", "initial_depth", *_FINAL, "heave_mode",
        "surge_velocity", "tolerance_xy", "no_altitude_goes_up",
    ],
    "park": [
        *_FINAL, "final_yaw", "use_yaw", "heave_mode", "surge_velocity", "time",
        "no_altitude_goes_up",
    ],
}  # fmt: skip


@dataclass(frozen=True)
class Step:
    """One step of a COLA2 mission; keys are the file's own."""

    kind: str
    values: dict[str, float | bool | int]
    actions: list[str]


def local_ne(datum: Datum, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Metres north and east of the datum by the geodesic on the ellipsoid (Karney 2013).

    Over the tens of metres of these tests it differs from the local frame, some 15 m deeper, by
    2.4e-6 of the distance, and by its curvature, far below a tenth of a millimetre.
    """
    azimuth, _, distance = _GEOD.inv(datum.longitude_deg, datum.latitude_deg, lon_deg, lat_deg)
    return distance * math.cos(math.radians(azimuth)), distance * math.sin(math.radians(azimuth))


def turned(vector: tuple[float, float], heading_rad: float) -> Array:
    """A vector forward and right as north and east."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[cos, -sin], [sin, cos]]) @ np.array(vector)


def read_cola2(path: Path) -> list[Step]:
    """Strict reader of version 2.0: the names, their order and their values, and nothing else."""
    root = _root(path)
    assert root.tag == "mission"
    assert not root.attrib
    assert root[0].tag == "version"
    assert root[0].text == "2.0"
    steps = []
    for element in root[1:]:
        manoeuvre, actions = _step(element)
        kind = manoeuvre.attrib["type"]
        assert [child.tag for child in manoeuvre] == _CHILDREN[kind]
        values = {child.tag: _value(child) for child in manoeuvre}
        assert values["heave_mode"] in (0, 1, 2)
        steps.append(Step(kind, values, actions))
    return steps


def _root(path: Path) -> ET.Element:
    """The root; comments anywhere within it would break COLA2's readers."""
    parser = ET.XMLParser(  # noqa: S314
        target=ET.TreeBuilder(insert_comments=True, insert_pis=True)
    )
    root = ET.parse(path, parser).getroot()  # noqa: S314
    assert all(isinstance(element.tag, str) for element in root.iter())
    return root


def _step(element: ET.Element) -> tuple[ET.Element, list[str]]:
    assert element.tag == "mission_step"
    assert not element.attrib
    tags = [child.tag for child in element]
    assert tags in (["maneuver"], ["maneuver", "actions_list"])
    assert list(element[0].attrib) == ["type"]
    actions = []
    for action in element[1] if len(element) == 2 else []:
        assert action.tag == "action"
        assert [child.tag for child in action] == ["action_id"]
        actions.append(action[0].text or "")
    return element[0], actions


def _value(element: ET.Element) -> float | bool | int:
    assert not element.attrib
    assert len(element) == 0
    text = element.text or ""
    assert text == text.strip()
    if element.tag in ("use_yaw", "no_altitude_goes_up"):
        assert text in ("true", "false")
        return text == "true"
    if element.tag == "heave_mode":
        return int(text)
    number = float(text)
    for name, (low, high) in _COORDINATE.items():
        if element.tag.endswith(name):
            assert low <= number <= high
            assert len(text.partition(".")[2]) >= 9
    return number


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Plans anywhere on Earth, of any few lines."""
    place = st.floats(-40.0, 40.0)
    lines = []
    for _ in range(draw(st.integers(1, 4))):
        start = draw(place), draw(place)
        heading, length = draw(st.floats(0, 2 * math.pi)), draw(st.floats(0.5, 30.0))
        end = start[0] + length * math.cos(heading), start[1] + length * math.sin(heading)
        lines.append(line(start, end, draw(st.sampled_from(["survey", "cross", "fill"]))))
    cut = draw(st.integers(0, len(lines) - 1))
    dives = [(0, len(lines) - 1)] if cut == 0 else [(0, cut - 1), (cut, len(lines) - 1)]
    datum = Datum(draw(st.floats(-80, 80)), draw(st.floats(-179.9, 179.9)))
    return plan_of(
        lines,
        dives,
        datum=datum,
        home=(draw(place), draw(place)),
        altitude_m=draw(st.floats(1.0, 4.0)),
        speed_mps=draw(st.floats(0.1, 1.0)),
        name=draw(st.text(min_size=1, max_size=30)),
    )


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    """The stereo rig anywhere on the vehicle."""
    x, y, z = (draw(st.floats(-1.0, 1.0)) for _ in range(3))
    return design_rig(CameraConfig(position_body_m=(x, y, z)), WaterConfig())
