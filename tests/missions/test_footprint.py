import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import LineString, Polygon, box
from shapely.ops import unary_union

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import rotation_from_attitude
from camera_calib.rig import Rig, design_rig
from missions.values.footprint import (
    camera_swath,
    common_swath,
    footprint_ne,
    footprint_polygon,
    footprint_size_m,
    level_pose,
    overlap,
    step_for_overlap,
)
from tests.cameras import changed

RIG = design_rig(CameraConfig(), WaterConfig())
LEFT = RIG.cameras["left"]
IDEAL = design_rig(CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0), WaterConfig()).cameras[
    "left"
]


def test_size_through_a_port_is_that_between_the_corners() -> None:
    """The corner's ray, by three tangents: its reach splits as the corner's pixel does."""
    halves_mm = (3384 * 3.69e-3 / 2, 2710 * 3.69e-3 / 2)
    for camera, layers_m in ((LEFT, (0.02, 0.01, 2.0)), (IDEAL, (0.0, 0.0, 2.0))):
        sine = math.sin(math.atan(math.hypot(*halves_mm) / 12.5))
        angles = [math.asin(sine / n) for n in (1.0, 1.52, 1.34)]
        reach = sum(d * math.tan(a) for d, a in zip(layers_m, angles, strict=True))
        sides = [2 * reach * half / math.hypot(*halves_mm) for half in halves_mm]
        assert footprint_size_m(camera, 2.0) == pytest.approx(sides, rel=1e-12)


@given(k1=st.floats(-0.25, 0.25), altitude_m=st.floats(0.5, 6.0), tilt=st.floats(-0.05, 0.05))
def test_the_size_is_of_the_largest_upright_rectangle_that_is_seen(
    k1: float, altitude_m: float, tilt: float
) -> None:
    """Also where a lens makes the sides hollow, or a tilted port makes them lean."""
    normal = (math.sin(tilt), 0.0, math.cos(tilt))
    camera = changed(LEFT, k1=k1, normal=normal)
    across, along = footprint_size_m(camera, altitude_m)

    floor_z = camera.front_cam[2] + altitude_m
    seen = camera.at_depth(camera.border(400), floor_z)[:, :2]
    top, right, bottom, left = (
        np.vstack([seen, seen[:1]])[400 * k : 400 * k + 401] for k in range(4)
    )
    low, high = (left[:, 0].max(), top[:, 1].max()), (right[:, 0].min(), bottom[:, 1].min())
    assert (across, along) == pytest.approx((high[0] - low[0], high[1] - low[1]), rel=1e-3)
    assert Polygon(seen).buffer(1e-3 * along).covers(box(*low, *high))
    assert not Polygon(seen).covers(box(low[0], low[1], high[0] + 0.01 * across, high[1]))
    assert not Polygon(seen).covers(box(low[0], low[1], high[0], high[1] + 0.01 * along))


@given(
    altitude_m=st.floats(0.3, 10),
    heading=st.floats(-3.2, 3.2),
    place=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
)
def test_a_level_footprint_is_the_same_wherever_it_points(
    altitude_m: float, heading: float, place: tuple[float, float]
) -> None:
    pose = level_pose(LEFT, np.array(place), altitude_m, 30.0, heading)
    border = footprint_ne(LEFT, pose, 30.0)

    c, s = math.cos(heading), math.sin(heading)
    about = (border - place) @ np.array([[c, -s], [s, c]])
    home = footprint_ne(LEFT, level_pose(LEFT, np.zeros(2), altitude_m, 30.0, 0.0), 30.0)
    np.testing.assert_allclose(about, home, atol=1e-9)


def test_altitude_counts_from_the_outer_glass_and_the_top_of_the_picture_is_ahead() -> None:
    pose = level_pose(LEFT, np.zeros(2), 2.0, 15.0, 0.0)
    glass = pose.apply(LEFT.front_cam)
    np.testing.assert_allclose(glass, [0.0, 0.0, 13.0], atol=1e-12)
    assert pose.translation[2] == pytest.approx(12.97)
    border = footprint_ne(LEFT, pose, 15.0)
    top_left, top_right, bottom_right, bottom_left = border[::16]
    assert top_left[0] > 0 > top_left[1]
    assert top_right[0] > 0 < top_right[1]
    assert bottom_right[0] < 0 < bottom_right[1]
    assert bottom_left[0] < 0 > bottom_left[1]


def test_every_border_point_is_seen_at_the_border() -> None:
    """The footprint projected back falls on the border, for a leaning vehicle too."""
    rotation = rotation_from_attitude(0.1, -0.15, 2.0) * RIG.body_from_cam("left").rotation
    pose = RigidTransform.from_components([3.0, -4.0, 12.0], rotation)
    hits = footprint_ne(LEFT, pose, 15.0)

    points = pose.inv().apply(np.column_stack([hits, np.full(len(hits), 15.0)]))

    np.testing.assert_allclose(LEFT.project(points), LEFT.border(16), atol=1e-8)


def test_a_camera_that_looks_up_sees_no_sea_floor() -> None:
    level = level_pose(LEFT, np.zeros(2), 2.0, 15.0, 0.0)
    up = RigidTransform.from_components(
        level.translation, Rotation.from_rotvec([math.pi, 0, 0]) * level.rotation
    )
    assert np.isnan(footprint_ne(LEFT, up, 15.0)).all()
    with pytest.raises(PlanError):
        footprint_polygon(LEFT, up, 15.0)

    below = footprint_ne(LEFT, level, 12.0)
    assert np.isnan(below).all()


def test_a_footprint_bulges() -> None:
    """Refraction draws the corners in: the middle row is 3 % wider than what is surely seen."""
    polygon = footprint_polygon(LEFT, level_pose(LEFT, np.zeros(2), 2.0, 15.0, 0.0), 15.0)
    across, along = footprint_size_m(LEFT, 2.0)
    south, west, north, east = polygon.bounds

    assert 1.03 * across < east - west < 1.035 * across
    assert 1.04 * along < north - south < 1.055 * along
    assert polygon.buffer(1e-6).covers(box(-along / 2, -across / 2, along / 2, across / 2))


def leaning(rig: Rig) -> Rig:
    """A rig whose cameras are not square to each other."""
    right = RigidTransform.from_components(
        [-0.1, 0.003, 0.001], Rotation.from_rotvec([0.01, -0.02, 0.03])
    )
    normal = (math.sin(0.02), 0.0, math.cos(0.02))
    return replace(
        rig,
        cameras={"left": rig.cameras["left"], "right": changed(LEFT, normal=normal)},
        cam_from_rig={"left": RigidTransform.identity(), "right": right},
    )


@settings(deadline=None, max_examples=30)
@given(
    altitude_m=st.floats(0.5, 6.0),
    forward=st.floats(0.15, 0.95),
    rig=st.sampled_from([RIG, leaning(RIG)]),
)
def test_what_a_swath_promises_is_seen(altitude_m: float, forward: float, rig: Rig) -> None:
    """Slow twin: the union of both cameras' real footprints along a line holds the swath."""
    step_m = step_for_overlap(footprint_size_m(LEFT, altitude_m)[1], forward)
    depth_m = 50.0
    glass_body = rig.body_from_cam("left").apply(LEFT.front_cam)
    union = {}
    for name in rig.cameras:
        shapes = []
        for i in range(-6, 7):
            body = np.array([i * step_m, 0.0, depth_m - altitude_m]) - glass_body
            pose = RigidTransform.from_translation(body) * rig.body_from_cam(name)
            shapes.append(footprint_polygon(rig.cameras[name], pose, depth_m))
        union[name] = unary_union(shapes)
    reach = 2 * step_m
    middle = Polygon([(-reach, -99), (reach, -99), (reach, 99), (-reach, 99)])

    for name in rig.cameras:
        swath = camera_swath(rig, name, altitude_m, step_m)
        seen = union[name].intersection(middle)
        edges = [
            LineString([(-reach, side), (reach, side)])
            for side in (-swath.port_m + 1e-6, swath.starboard_m - 1e-6)
        ]
        assert all(seen.buffer(1e-7).covers(edge) for edge in edges)
        # ... and not much less than is seen.
        assert swath.across_m > 0.95 * (seen.bounds[3] - seen.bounds[1])

    both = common_swath(rig, altitude_m, step_m)
    assert both.half_across_m == min(both.port_m, both.starboard_m)


def test_the_stereo_swath_is_narrower_by_the_baseline() -> None:
    left = camera_swath(RIG, "left", 2.0, 0.47)
    both = common_swath(RIG, 2.0, 0.47)

    assert left.port_m == pytest.approx(left.starboard_m)
    assert both.port_m == pytest.approx(left.port_m - 0.1)
    assert both.starboard_m == pytest.approx(left.starboard_m)
    assert left.along_m == pytest.approx(2 * left.ahead_m)
    # Cameras that see nothing in common have none.
    wide = design_rig(CameraConfig(baseline_m=2.0), WaterConfig())
    assert common_swath(wide, 1.0, 0.2).half_across_m < 0


@given(extent_m=st.floats(0.1, 10), share=st.floats(0, 0.95))
def test_overlap_and_step_are_inverse(extent_m: float, share: float) -> None:
    assert overlap(extent_m, step_for_overlap(extent_m, share)) == pytest.approx(share)
    assert overlap(extent_m, 2 * extent_m) == 0.0
