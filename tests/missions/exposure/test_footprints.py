import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from camera_calib.camera import Camera
from missions.exposure.footprints import (
    altitude_for_pixel_m,
    footprint_range,
    line_spacing,
    pixel_on_floor_m,
)
from missions.values.footprint import footprint_size_m, overlap
from tests.missions.exposure.surveys import conflict_of, survey
from tests.oracles_imaging import traced_footprint, traced_spot

STEP_M = 0.3


def sure_half_m(camera: Camera, altitude_m: float) -> tuple[float, float]:
    """Half the width and length of the rectangle between a footprint's corners."""
    corner = traced_spot(camera, float(camera.width_px), float(camera.height_px), altitude_m)
    return float(corner[0]), float(corner[1])


def overlap_of_row(first: Polygon, second: Polygon, along_m: float) -> float:
    """Share of one row of the first footprint that lies in the second."""
    row = Polygon([(-9, along_m - 1e-4), (9, along_m - 1e-4), (9, along_m), (-9, along_m)])
    strip = first.intersection(row)
    return strip.intersection(second).area / strip.area


def test_one_metre_lines_at_two_metres_surely_overlap_by_27_percent_not_45() -> None:
    """And by 29 % on the middle row, where a footprint is widest."""
    rig, config = survey(ideal_port=True, plan={"line_spacing_m": 1.0})
    spacing = line_spacing(rig, config.plan, STEP_M)

    halves = 3384 * 3.69e-3 / 2, 2710 * 3.69e-3 / 2
    reach = 2.0 * math.tan(math.asin(math.sin(math.atan(math.hypot(*halves) / 12.5)) / 1.34))
    width = 2 * reach * halves[0] / math.hypot(*halves)
    assert spacing.mean_overlap == pytest.approx(1 - 1 / width, abs=1e-9)
    assert round(100 * spacing.mean_overlap, 1) == 27.1
    here, there = (traced_footprint(rig.cameras["left"], 2.0, x) for x in (0.0, 1.0))
    assert overlap_of_row(here, there, 0.0) == pytest.approx(0.293, abs=1e-3)


@pytest.mark.parametrize(("ideal", "wanted"), [(False, 0.29), (True, 0.45), (False, 0.7)])
def test_the_spacing_yields_the_overlap_on_traced_footprints(ideal: bool, wanted: float) -> None:
    rig, config = survey(ideal_port=ideal, plan={"side_overlap": wanted})
    spacing = line_spacing(rig, config.plan, STEP_M)
    here = traced_footprint(rig.cameras["left"], 2.0, 0.0)
    there = traced_footprint(rig.cameras["left"], 2.0, spacing.spacing_m)

    assert spacing.bound_by == "side_overlap"
    # Every row that both pictures surely show is shared as requested, that of the corners just so.
    rows = np.linspace(0.0, 1.0 - 1e-6, 6) * sure_half_m(rig.cameras["left"], 2.0)[1]
    shares = [overlap_of_row(here, there, float(row)) for row in rows]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] == pytest.approx(wanted, abs=1e-3)
    assert shares[0] < wanted + 0.025
    by_area = here.intersection(there).area / here.area
    assert wanted < by_area < shares[0]


@settings(max_examples=25, deadline=None)
@given(plan=st.fixed_dictionaries({
    "altitude_m": st.floats(1.2, 6.0), "side_overlap": st.floats(0.3, 0.7),
    "track_error_m": st.floats(0.0, 0.08), "overlap_over_relief": st.booleans(),
}))  # fmt: skip
def test_neighbours_off_their_lines_still_overlap_as_requested(plan: dict[str, Any]) -> None:
    rig, config = survey(plan={"relief_m": 0.2, **plan})
    altitude_m, wanted = plan["altitude_m"], plan["side_overlap"]
    track_error_m, over_relief = plan["track_error_m"], plan["overlap_over_relief"]
    spacing = line_spacing(rig, config.plan, STEP_M)
    ground_m = altitude_m - 0.2 if over_relief else altitude_m
    here = traced_footprint(rig.cameras["left"], ground_m, -track_error_m)
    there = traced_footprint(rig.cameras["left"], ground_m, spacing.spacing_m + track_error_m)
    shared = overlap_of_row(here, there, sure_half_m(rig.cameras["left"], ground_m)[1] - 1e-4)

    reached = spacing.off_track_overlap
    if not over_relief:
        across_m = footprint_size_m(rig.cameras["left"], altitude_m)[0]
        reached = overlap(across_m, spacing.spacing_m + 2 * track_error_m)
    assert shared == pytest.approx(reached, abs=2e-3)
    assert reached >= wanted - 1e-9
    if spacing.bound_by.startswith("side_overlap"):
        assert reached == pytest.approx(wanted, abs=1e-9)


def test_little_overlap_is_bound_by_stereo_without_gaps() -> None:
    rig, config = survey(plan={"side_overlap": 0.0})
    spacing = line_spacing(rig, config.plan, STEP_M)
    assert spacing.bound_by == "no gap in stereo"
    assert spacing.mean_overlap > 0.05
    assert spacing.stereo_overlap == pytest.approx(0.0, abs=1e-9)


def test_footprints_over_the_relief_grow_with_the_way_down() -> None:
    rig, config = survey()
    prints = footprint_range(rig, config.plan, STEP_M)
    assert [p.altitude_m for p in (prints.top, prints.mean, prints.bottom)] == [1.65, 2.0, 2.35]
    for p in (prints.top, prints.mean, prints.bottom):
        half_m, along_m = sure_half_m(rig.cameras["left"], p.altitude_m)
        assert (p.across_m, p.along_m) == pytest.approx((2 * half_m, 2 * along_m), rel=1e-9)
        # A tenth of a metre of baseline is not seen by both, on either side; between the corners
        # lines see more than one picture surely does.
        assert p.across_m - 0.1 < p.stereo_across_m < p.across_m - 0.1 + 0.06


@given(pixel_mm=st.floats(0.05, 3.0))
def test_altitude_and_pixel_are_inverse(pixel_mm: float) -> None:
    rig, _ = survey()
    camera = rig.cameras["left"]
    altitude_m = altitude_for_pixel_m(camera, pixel_mm * 1e-3)
    assert pixel_on_floor_m(camera, altitude_m) == pytest.approx(pixel_mm * 1e-3, rel=1e-12)


def test_what_no_altitude_resolves_suggests_nothing() -> None:
    rig, config = survey(camera={"baseline_m": 2.0, "focal_mm": 50.0})
    error = conflict_of(line_spacing, rig, config.plan, STEP_M)
    assert error.suggestion is None and len(str(error).splitlines()) == 1


@pytest.mark.parametrize("distance_m", [0.01, 0.02, 0.03])
def test_through_real_ports_they_overlap_by_28_to_29_percent(distance_m: float) -> None:
    rig, config = survey(plan={"line_spacing_m": 1.0}, camera={"port_distance_m": distance_m})
    assert 0.279 <= line_spacing(rig, config.plan, STEP_M).mean_overlap <= 0.29
