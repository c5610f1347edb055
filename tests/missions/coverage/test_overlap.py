import math
from dataclasses import replace

import numpy as np
import pytest

from alice_survey.core.config import CameraConfig, WaterConfig
from camera_calib.rig import Rig, design_rig
from missions.coverage.stations import stations_of_lines
from tests.missions.exports.plans import RIG as REAL
from tests.oracles_coverage import lawnmower, pinhole_rig
from tests.oracles_overlap import measured_side_overlap

IDEAL = design_rig(CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0), WaterConfig())


def middle_row_m(rig: Rig, altitude_m: float) -> float:
    """Width of a footprint across its middle, where it is widest, by three tangents."""
    camera = rig.cameras["left"]
    sine = math.sin(math.atan(camera.width_px / 2 / camera.fx_px))
    layers = (
        (camera.parameter("port_distance_m"), 1.0),
        (camera.parameter("glass_thickness_m"), camera.parameter("n_glass")),
        (altitude_m, camera.n_water),
    )
    return 2 * sum(thick * math.tan(math.asin(sine / n)) for thick, n in layers)


@pytest.mark.parametrize("spacing_m", [0.5, 1.3, 2.5])
def test_rectangles_overlap_by_what_their_width_leaves(spacing_m: float) -> None:
    rig = pinhole_rig(2.0, 1.0)
    stations = stations_of_lines(lawnmower(4, 5, spacing_m, 0.5), 1.0)

    shares, _ = measured_side_overlap(rig, stations)

    expected = max(0.0, 1.0 - spacing_m / 2.0)
    assert shares.mean() == pytest.approx(expected, abs=1e-3)
    assert shares.min() == pytest.approx(expected, abs=1e-3)


def test_lines_one_metre_apart_overlap_as_the_paper_should_have_said() -> None:
    """At 2 m altitude: 29.3 % through an ideal port, 30 to 32 % through real ones."""
    stations = stations_of_lines(lawnmower(4, 5, 1.0, 0.46), 2.0)

    assert measured_side_overlap(IDEAL, stations)[0].mean() == pytest.approx(0.293, abs=1e-3)
    assert 0.30 < measured_side_overlap(REAL, stations)[0].mean() < 0.32


def test_a_vehicle_off_its_line_overlaps_less_on_one_side() -> None:
    """Lines alternate: one flown 0.1 m off loses that on one side and gains it on the other."""
    lines = lawnmower(4, 3, 1.0, 0.46)
    exact = stations_of_lines(lines, 2.0)
    places = exact.glass_ne.copy()
    places[exact.line == 1, 1] += 0.1
    off = replace(exact, glass_ne=places)
    width_m = middle_row_m(REAL, 2.0)

    shares, at = measured_side_overlap(REAL, off)

    of_line = [shares[off.line[at] == line].mean() for line in range(3)]
    # To starboard: of lines 0 and 2, flown north, the one to the east; of 1 and 3 the one west.
    assert of_line == pytest.approx(1 - np.array([1.1, 1.1, 1.0]) / width_m, abs=2e-3)
    assert shares.min() == pytest.approx(1 - 1.1 / width_m, abs=2e-3)


def test_a_rolled_vehicle_loses_overlap_on_the_side_it_looks_away_from() -> None:
    exact = stations_of_lines(lawnmower(4, 2, 1.0, 0.46), 2.0)
    attitude = exact.attitude_rad.copy()
    attitude[:, 0] = np.where(exact.line == 0, math.radians(5.0), 0.0)
    before, at = measured_side_overlap(REAL, exact)
    after, _ = measured_side_overlap(REAL, replace(exact, attitude_rad=attitude))

    # A camera rolled by 5 degrees to starboard looks 2 tan(5 deg) = 0.17 m to port.
    first = exact.line[at] == 0
    lost = (before - after)[first].mean()
    width_m = middle_row_m(REAL, 2.0)
    assert lost == pytest.approx(2.0 * math.tan(math.radians(5.0)) / width_m, abs=0.02)
