import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Transformer
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core import frames

latitudes, longitudes = st.floats(-85, 85), st.floats(-180, 180)
angles = st.floats(-math.pi, math.pi)


@settings(deadline=None, max_examples=50)
@given(
    latitude=latitudes,
    longitude=longitudes,
    height_m=st.floats(-100, 5000),
    points=st.lists(st.tuples(*[st.floats(-5000, 5000)] * 3), min_size=1, max_size=5),
)
def test_local_and_geodetic_are_inverse(
    latitude: float, longitude: float, height_m: float, points: list[tuple[float, float, float]]
) -> None:
    datum = frames.Datum(latitude, longitude, height_m)
    ned = np.array(points)

    back = datum.ned_from_geodetic(datum.geodetic_from_ned(ned))

    np.testing.assert_allclose(back, ned, atol=1e-5)


@settings(deadline=None, max_examples=50)
@given(
    latitude=latitudes,
    longitude=longitudes,
    north=st.floats(-2000, 2000),
    east=st.floats(-2000, 2000),
    depth_m=st.floats(0, 3000),
)
def test_local_frame_is_projs_topocentric_one(
    latitude: float, longitude: float, north: float, east: float, depth_m: float
) -> None:
    """PROJ's own conversion, written apart from ours."""
    enu = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        "+step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={longitude!r} +lat_0={latitude!r} +h_0=0"
    )
    ned = np.array([[north, east, depth_m]])
    lat, lon, depth = frames.Datum(latitude, longitude).geodetic_from_ned(ned)[0]

    x_east, y_north, up = enu.transform(lon, lat, -depth)

    np.testing.assert_allclose([y_north, x_east, -up], [north, east, depth_m], atol=1e-5)


@settings(deadline=None, max_examples=50)
@given(latitude=latitudes, longitude=st.floats(-179, 179), bearing=st.floats(0, 359))
def test_short_distances_and_bearings_are_geodesic(
    latitude: float, longitude: float, bearing: float
) -> None:
    lon, lat, _ = Geod(ellps="WGS84").fwd(longitude, latitude, bearing, 100.0)

    ned = frames.Datum(latitude, longitude).ned_from_geodetic(np.array([[lat, lon, 0.0]]))[0]

    assert math.hypot(ned[0], ned[1]) == pytest.approx(100.0, abs=1e-6)
    turned = math.atan2(ned[1], ned[0]) - math.radians(bearing)
    assert math.degrees(math.remainder(turned, 2 * math.pi)) == pytest.approx(0.0, abs=1e-3)
    # The sea surface falls away from the tangent plane by d^2 / 2 R.
    assert ned[2] == pytest.approx(100.0**2 / 2 / 6.37e6, rel=0.01)


def test_the_datum_is_the_origin() -> None:
    datum = frames.Datum(32.8236, 34.9553, 17.0)
    places = np.array([[32.8236, 34.9553, 0.0], [32.8236, 34.9553, 12.5]])
    found = datum.ned_from_geodetic(places)
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.0], [0.0, 0.0, 12.5]], atol=1e-8)
    assert datum.geodetic_from_ned(np.empty((0, 3))).shape == (0, 3)


def test_the_utm_zone() -> None:
    zones = {
        (32.8, 34.96): 32636, (-33.9, 18.4): 32734, (0.0, -180.0): 32601, (0.0, 180.0): 32660,
        (60.0, 5.99): 32631, (60.0, 6.0): 32632,
    }  # fmt: skip
    assert {place: frames.Datum(*place).utm_epsg for place in zones} == zones


@given(roll=angles, pitch=st.floats(-1.5, 1.5), heading=angles)
def test_attitude_comes_back(roll: float, pitch: float, heading: float) -> None:
    rotation = frames.rotation_from_attitude(roll, pitch, heading)
    back = frames.attitude_from_rotation(rotation)
    assert (frames.rotation_from_attitude(*back) * rotation.inv()).magnitude() < 1e-9
    assert np.abs(np.angle(np.exp(1j * (back - [roll, pitch, heading])))).max() < 1e-7


@given(roll=angles, pitch=angles, heading=angles)
def test_the_rotation_is_fossens(roll: float, pitch: float, heading: float) -> None:
    """J1 of SNAME's z-y-x angles (Fossen 2011, eq. 2.18), written out."""
    c, s = np.cos([roll, pitch, heading]), np.sin([roll, pitch, heading])
    (cr, cp, ch), (sr, sp, sh) = c, s
    expected = [
        [ch * cp, -sh * cr + ch * sp * sr, sh * sr + ch * cr * sp],
        [sh * cp, ch * cr + sr * sp * sh, -ch * sr + sp * sh * cr],
        [-sp, cp * sr, cp * cr],
    ]
    found = frames.rotation_from_attitude(roll, pitch, heading).as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_attitude_takes_arrays() -> None:
    found = frames.attitude_from_rotation(
        frames.rotation_from_attitude(np.zeros(4), 0.1, np.arange(4.0))
    )
    np.testing.assert_allclose(found, [[0.0, 0.1, heading] for heading in range(4)], atol=1e-12)


def test_the_nadir_mount() -> None:
    body = frames.BODY_FROM_NADIR_CAM.apply([[0, 0, 1], [0, -1, 0], [1, 0, 0]])
    np.testing.assert_allclose(body, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)


def test_between_poses_it_is_straight_and_turns_evenly() -> None:
    time_s = np.array([0.0, 1.0, 3.0])
    places = np.array([[0.0, 0, 0], [1, 2, 3], [5, 2, 1]])
    rotation = Rotation.from_euler("Z", [[0.0], [0.4], [-0.4]])
    given_poses = RigidTransform.from_components(places, rotation)
    same = frames.interpolate_poses(time_s, given_poses, time_s)
    np.testing.assert_allclose(same.as_matrix(), given_poses.as_matrix(), atol=1e-12)
    at = frames.interpolate_poses(time_s, given_poses, np.array([0.25, 2.0]))
    np.testing.assert_allclose(at.translation, [[0.25, 0.5, 0.75], [3.0, 2.0, 2.0]], atol=1e-12)
    np.testing.assert_allclose(at.rotation.as_euler("ZYX")[:, 0], [0.1, 0.0], atol=1e-12)
    for beyond in (-0.1, 3.1):
        with pytest.raises(ValueError):
            frames.interpolate_poses(time_s, given_poses, np.array([beyond]))


def test_across_north_the_shorter_way_is_taken() -> None:
    rotation = frames.rotation_from_attitude(0.0, 0.0, np.deg2rad([350.0, 10.0]))
    track = RigidTransform.from_components(np.zeros((2, 3)), rotation)
    at = frames.interpolate_poses(np.array([0.0, 1.0]), track, np.linspace(0, 1, 5))
    headings = np.rad2deg(frames.attitude_from_rotation(at.rotation)[:, 2])
    np.testing.assert_allclose(headings, [-10, -5, 0, 5, 10], atol=1e-9)


@given(vector=st.tuples(*[st.floats(-3, 3)] * 3), place=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_a_pose_comes_back_from_json(
    vector: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    pose = RigidTransform.from_components(place, Rotation.from_rotvec(vector))
    back = frames.pose_from_json(frames.pose_to_json(pose))
    np.testing.assert_allclose(back.as_matrix(), pose.as_matrix(), atol=1e-12)
    assert frames.pose_to_json(pose)["quaternion_xyzw"][3] >= 0


def test_neighbouring_frames_compose() -> None:
    """ned_from_cam = ned_from_body * body_from_cam, seen by one point."""
    ned_from_body = RigidTransform.from_components(
        [10.0, 20.0, 3.0], frames.rotation_from_attitude(0.0, 0.0, math.pi / 2)
    )
    body_from_cam = RigidTransform.from_components([0.5, 0.0, 0.1], frames.BODY_FROM_NADIR_CAM)
    point = (ned_from_body * body_from_cam).apply([0.2, 0.0, 2.0])
    # Heading east: the bow's 0.5 m go east, the picture's right (starboard) goes south.
    np.testing.assert_allclose(point, [9.8, 20.5, 5.1], atol=1e-12)
