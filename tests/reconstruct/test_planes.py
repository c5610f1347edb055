"""Planes against closed forms, and the best plane of scenes that are known."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import ConfigError
from reconstruct.planes import (
    LEVEL_PLANE,
    Plane,
    best_plane,
    facing,
    read_plane,
    turn_model,
    write_plane,
)
from reconstruct.raster import crs_of, frame_tags
from reconstruct.views.model import MEAN_PLANE, SparseModel, WorldFrame, write_frame
from tests.oracles_dense import CODED, FRAME, sparse_model, stereo_views

NADIR = sparse_model(stereo_views(0.3 * np.arange(3.0), np.zeros(3)), CODED)


def wall_model(facing_deg: float, tilt_deg: float, seed: int = 0, floor: int = 0) -> SparseModel:
    """Points on a wall 8 m wide and 4 m high, 2 cm rough, 5 m down, seen from 3 m in front of it.

    Args:
        facing_deg: compass direction of the wall's outer normal.
        tilt_deg: its lean back from the vertical.
        seed: of the points.
        floor: points of a narrow strip of sea floor at its foot, 0.5 m wide.
    """
    rng = np.random.default_rng(seed)
    azimuth, lean = math.radians(facing_deg), math.radians(tilt_deg)
    out = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])  # level part of the normal
    along = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    normal = math.cos(lean) * out + math.sin(lean) * np.array([0.0, 0.0, -1.0])
    rise = math.cos(lean) * np.array([0.0, 0.0, -1.0]) - math.sin(lean) * out
    foot = np.array([20.0, -7.0, 9.0])
    u, v = rng.uniform(-4, 4, 3000), rng.uniform(0, 4, 3000)
    points = foot + u[:, None] * along + v[:, None] * rise
    points += rng.normal(0, 0.02, (3000, 1)) * normal
    ground = foot + rng.uniform(-4, 4, (floor, 1)) * along + rng.uniform(0, 0.5, (floor, 1)) * out
    into = Rotation.from_matrix(np.column_stack([np.cross(-rise, -normal), -rise, -normal]))
    views = tuple(
        replace(
            NADIR.views[0],
            image=f"{n}.png",
            world_from_cam=RigidTransform.from_components(
                foot + 2.0 * rise + 3.0 * normal + (n - 2.0) * along, into
            ),
        )
        for n in range(5)
    )
    everything = np.vstack([points, ground])
    return replace(
        NADIR, views=views, points_world=everything, observations=np.empty((0, 2), np.int64)
    )


@pytest.mark.parametrize(
    ("facing_deg", "tilt_deg", "up", "right", "into"),
    [
        (180.0, 0.0, (0, 0, -1), (0, 1, 0), (1, 0, 0)),  # from the south: north is ahead
        (0.0, 0.0, (0, 0, -1), (0, -1, 0), (-1, 0, 0)),
        (90.0, 0.0, (0, 0, -1), (1, 0, 0), (0, -1, 0)),  # from the east: right is north
        (180.0, 90.0, (1, 0, 0), (0, 1, 0), (0, 0, 1)),  # lying: the level plane
        (180.0, -90.0, (-1, 0, 0), (0, 1, 0), (0, 0, -1)),  # a ceiling
    ],
)
def test_axes_are_those_of_someone_who_faces_the_plane(
    facing_deg: float, tilt_deg: float, up: tuple, right: tuple, into: tuple
):
    matrix = facing(facing_deg, tilt_deg).as_matrix()
    np.testing.assert_allclose(matrix, np.array([up, right, into]), atol=1e-12)


def test_a_leaning_plane_faces_up_and_an_overhanging_one_down():
    for tilt in (35.0, -35.0):
        up, right, into = facing(250.0, tilt).as_matrix()
        assert -into[2] == pytest.approx(-math.sin(math.radians(tilt)))  # down is positive
        assert right[2] == pytest.approx(0.0, abs=1e-15)
        assert math.degrees(math.atan2(-into[1], -into[0])) % 360 == pytest.approx(250.0)
        np.testing.assert_allclose(np.cross(up, right), into, atol=1e-12)


def test_a_turned_model_shows_the_same_pixels():
    plane = Plane(
        name="any",
        about="",
        plane_from_world=RigidTransform.from_components([1.0, -2.0, 3.0], facing(77.0, 12.0)),
    )
    moved = turn_model(NADIR, plane)
    for before, after in zip(NADIR.views, moved.views, strict=True):
        np.testing.assert_allclose(
            after.project(moved.points_world), before.project(NADIR.points_world), atol=1e-9
        )
    assert turn_model(NADIR, LEVEL_PLANE) is NADIR
    assert crs_of(NADIR.frame) is not None
    assert crs_of(moved.frame) is None
    with pytest.raises(ValueError, match=r"frame\.json"):
        write_frame(Path("frame.json"), moved.frame)


def test_plane_json_turns_a_pixel_into_a_point(tmp_path: Path):
    plane = best_plane(wall_model(200.0, 15.0))
    write_plane(tmp_path, plane, FRAME)
    about = json.loads((tmp_path / "plane.json").read_text())
    point_ned = np.array([4.0, -3.0, 11.0])
    x_up, x_right, x_into = plane.plane_from_world.apply(point_ned)
    enu = (
        np.array(about["origin_enu"])
        + x_right * np.array(about["right_enu"])
        + x_up * np.array(about["up_enu"])
        - x_into * np.array(about["out_enu"])
    )
    np.testing.assert_allclose(enu, [-3.0, 4.0, -11.0], atol=1e-9)
    again = read_plane(tmp_path)
    np.testing.assert_allclose(
        again.plane_from_world.as_matrix(), plane.plane_from_world.as_matrix(), atol=1e-12
    )
    tags = frame_tags(turn_model(NADIR, plane).frame)
    origin = [float(value) for value in tags["PLANE_ORIGIN_ENU"].split()]
    np.testing.assert_allclose(origin, about["origin_enu"])
    assert read_plane(tmp_path / "none").is_level


@pytest.mark.parametrize(("facing_deg", "tilt_deg"), [(180.0, 0.0), (40.0, -30.0), (300.0, 45.0)])
def test_the_best_plane_is_the_wall_upright(facing_deg: float, tilt_deg: float):
    plane = best_plane(wall_model(facing_deg, tilt_deg, floor=20_000))  # dense, yet little area
    turn = plane.plane_from_world.rotation * facing(facing_deg, tilt_deg).inv()
    assert np.rad2deg(turn.magnitude()) < 0.5
    assert plane.plane_from_world.rotation.as_matrix()[1, 2] == pytest.approx(0.0, abs=1e-12)


def test_without_gravity_the_pictures_say_what_is_up():
    floating = WorldFrame(name="model", datum=None, scaled=False, vertical_datum=MEAN_PLANE)
    model = replace(wall_model(180.0, 80.0), frame=floating)  # nearly the mean plane, as levelled
    plane = best_plane(model)
    assert not plane.is_level
    up_in_pictures = model.views[0].world_from_cam.rotation.apply([0.0, -1.0, 0.0])
    turned_up = plane.plane_from_world.rotation.apply(up_in_pictures)
    np.testing.assert_allclose(turned_up, [1.0, 0.0, 0.0], atol=0.01)


@pytest.mark.parametrize(
    ("planes", "said"),
    [
        (["wall"], "give level, auto, or NAME=facing DEGREES"),
        (["wall=north"], "give level, auto, or NAME=facing DEGREES"),
        (["../wall=facing 3"], "a letter and up"),
        (["auto=facing 3"], "give level, auto"),
        (["wall=facing 400"], "0 to 360"),
        (["wall=facing 40 tilt 100"], "-90"),
        (["wall=facing 3", "Wall=facing 4"], "wall, wall have one name"),
        ([], "no plane"),
    ],
)
def test_a_wrong_plane_is_one_line_that_says_what_to_write(planes: list[str], said: str):
    with pytest.raises(ConfigError) as caught:
        change_section(SurveyConfig(), "reconstruct", planes=planes)
    assert said in str(caught.value)
    assert "reconstruct.planes" in str(caught.value)
    assert "\n" not in str(caught.value)
