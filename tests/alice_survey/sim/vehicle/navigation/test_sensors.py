"""Instruments: what they report of a known truth."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import rotations
from alice_survey.sim.vehicle.navigation import filter as nf
from alice_survey.sim.vehicle.navigation import sensors as part
from alice_survey.sim.vehicle.navigation import tick
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from tests.alice_survey.sim.vehicle.navigation.navigation_runs import TICK_S, fly, straight, track

angles = st.floats(-3.0, 3.0)
vectors = st.tuples(angles, angles, angles).map(np.array)
SILENT = 1e-15


def silent(suite: part.SensorSuite | None = None) -> part.Sensors:
    """Instruments without error or loss."""
    packed = (suite or part.SensorSuite()).pack()
    words = ("noise", "walk", "sigma", "loss", "probability")
    kinds = {}
    for kind in ("imu", "compass", "dvl", "pressure", "gps", "usbl"):
        spec = getattr(packed, kind)
        names = [name for name in spec._fields if any(word in name for word in words)]
        kinds[kind] = spec._replace(**dict.fromkeys(names, SILENT))
    return packed._replace(**kinds, current_sigma_mps=SILENT)


def ping(
    sensors: part.Sensors, truth: Array, floor: FloorGrid, count: int = 1
) -> nf.NavigationState:
    """What the DVL hears at a place; number `count` of its pings."""
    rng = np.random.default_rng(0)
    nav = nf.new_navigation(sensors, truth, rng)
    rotations.matrix_of(truth[3:7], nav.turns[nf.TRUTH_NOW])
    tick.measure_dvl(0.0, count, truth, np.array([0.1, -0.2, 0.0]), floor, sensors, nav, rng)
    return nav


def at_depth(depth_m: float, attitude: Rotation | None = None) -> Array:
    """A truth at rest."""
    turned = (attitude or Rotation.identity()).as_quat()
    return np.array([0.0, 0.0, depth_m, *turned, *np.zeros(6)])


@given(rotation=vectors, angle=vectors)
def test_turns_are_those_of_scipy(rotation: Array, angle: Array) -> None:
    before = Rotation.from_rotvec(rotation)
    after = before * Rotation.from_rotvec(angle)
    quaternion, between, matrix = before.as_quat(), np.zeros(3), np.zeros((3, 3))
    rotations.turn(quaternion, angle)
    rotations.turn_between(before.as_quat(), after.as_quat(), between)
    rotations.matrix_of(quaternion, matrix)
    np.testing.assert_allclose(matrix, after.as_matrix(), atol=1e-12)
    shortest = (before.inv() * after).as_rotvec()
    # Half a turn has two vectors.
    assert np.linalg.norm(between) <= np.pi + 1e-9
    rest = Rotation.from_rotvec(between).inv() * Rotation.from_rotvec(shortest)
    assert rest.magnitude() < 1e-9


def test_increments_of_the_imu_rebuild_the_motion() -> None:
    sensors, truth = silent(), track(60.0)
    nav = nf.new_navigation(sensors, truth[0], np.random.default_rng(0))
    nav.hidden[:] = 0.0
    lever = sensors.place[part.IMU]
    attitude = Rotation.from_quat(truth[0, 3:7])
    velocity = truth[0, 7:10] + attitude.apply(np.cross(truth[0, 10:13], lever))
    rng = np.random.default_rng(0)
    for before, now in pairwise(truth):
        rotations.matrix_of(now[3:7], nav.turns[nf.TRUTH_NOW])
        tick.measure_imu(TICK_S, before, now, sensors, nav, rng)
        push, turn = nav.readings[nf.PUSH : nf.PUSH + 3], nav.readings[nf.TURN : nf.TURN + 3]
        velocity = velocity + attitude.apply(push) + np.array([0.0, 0.0, 9.80665 * TICK_S])
        attitude = attitude * Rotation.from_rotvec(turn)
    last = Rotation.from_quat(truth[-1, 3:7])
    assert (attitude.inv() * last).magnitude() < 1e-8
    expected = truth[-1, 7:10] + last.apply(np.cross(truth[-1, 10:13], lever))
    np.testing.assert_allclose(velocity, expected, atol=1e-8)


def test_the_imu_errs_by_its_random_walks() -> None:
    sensors, truth = part.SensorSuite().pack(), at_depth(3.0)
    rng = np.random.default_rng(3)
    nav = nf.new_navigation(sensors, truth, rng)
    nav.hidden[:] = 0.0
    rotations.matrix_of(truth[3:7], nav.turns[nf.TRUTH_NOW])
    rows = np.empty((4000, 9))
    for row in rows:
        tick.measure_imu(TICK_S, truth, truth, sensors, nav, rng)
        row[:] = nav.readings[: nf.RATES + 3]
    sigma = rows.std(axis=0)
    # The mean of three axes of 4000 draws is good to 0.65 %: four of those.
    assert sigma[:3].mean() == pytest.approx(np.deg2rad(0.01) * TICK_S**0.5, rel=0.026)
    assert sigma[3:6].mean() == pytest.approx(60e-6 * 9.80665 * TICK_S**0.5, rel=0.026)
    np.testing.assert_allclose(rows[:, :3], rows[:, 6:] * TICK_S, atol=1e-15)


def test_beams_hear_the_floor_and_the_velocity_at_the_dvl() -> None:
    sensors = silent()
    attitude = Rotation.from_euler("ZYX", [2.0, 0.05, -0.1])
    truth = at_depth(8.0, attitude)
    truth[7:10], truth[10:13] = [0.3, -0.1, 0.05], [0.1, -0.2, 0.3]
    nav = ping(sensors, truth, level_floor(15.0))
    dvl = truth[:3] + attitude.apply(sensors.place[part.DVL])
    reach = (15.0 - dvl[2]) / attitude.apply(sensors.beams)[:, 2]
    np.testing.assert_allclose(nav.readings[nf.RANGE : nf.RANGE + 4], reach, atol=1e-4)
    velocity = attitude.inv().apply(truth[7:10]) + np.cross(truth[10:13], sensors.place[part.DVL])
    heard = part.beam_velocity(sensors.beams, nav.readings[nf.BEAM : nf.BEAM + 4])
    np.testing.assert_allclose(heard, velocity, atol=1e-9)
    assert np.all(np.isnan(nav.readings[nf.WATER_BEAM : nf.WATER_BEAM + 4]))
    through = ping(sensors, truth, level_floor(15.0), count=0).readings
    np.testing.assert_allclose(
        part.beam_velocity(sensors.beams, through[nf.WATER_BEAM : nf.WATER_BEAM + 4]),
        velocity - attitude.inv().apply([0.1, -0.2, 0.0]),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("depth_m", "tilt_rad", "beams", "water"),
    [
        (13.0, 0.0, 4, False),  # too near for a layer of water
        (14.85, 0.0, 0, False),  # nearer than the least range
        (14.3, 0.3, 4, False),
        (8.0, np.deg2rad(26.0), 0, False),  # tilted too far
    ],
)
def test_the_dvl_hears_what_is_in_its_reach(
    depth_m: float, tilt_rad: float, beams: int, water: bool
) -> None:
    truth = at_depth(depth_m, Rotation.from_rotvec([0.0, tilt_rad, 0.0]))
    heard = ping(silent(), truth, level_floor(15.0), count=0).readings
    assert np.isfinite(heard[nf.BEAM : nf.BEAM + 4]).sum() == beams
    assert np.isfinite(heard[nf.WATER_BEAM]) == water


def test_an_imu_at_rest_feels_its_weight_upwards() -> None:
    sensors, truth = silent(), at_depth(3.0, Rotation.from_euler("ZYX", [1.0, 0.0, np.pi / 2]))
    nav = nf.new_navigation(sensors, truth, np.random.default_rng(0))
    rotations.matrix_of(truth[3:7], nav.turns[nf.TRUTH_NOW])
    tick.measure_imu(TICK_S, truth, truth, sensors, nav, np.random.default_rng(0))
    # Rolled to starboard, port is up: -y.
    push = nav.readings[nf.PUSH : nf.PUSH + 3] / TICK_S
    np.testing.assert_allclose(push, [0.0, -9.80665, 0.0], atol=1e-9)


def test_over_a_deep_floor_the_dvl_hears_the_water_alone() -> None:
    sensors = silent()
    heard = ping(sensors, at_depth(8.0), level_floor(200.0)).readings
    assert np.all(np.isnan(heard[nf.RANGE : nf.RANGE + 4]))
    through = part.beam_velocity(sensors.beams, heard[nf.WATER_BEAM : nf.WATER_BEAM + 4])
    np.testing.assert_allclose(through, [-0.1, 0.2, 0.0], atol=1e-9)


@given(velocity=vectors, missing=st.integers(0, 4))
def test_three_beams_give_the_velocity_as_four_do(velocity: Array, missing: int) -> None:
    beams = part.janus_beams(np.deg2rad(30.0))
    along = beams @ velocity
    if missing < 4:
        along[missing] = np.nan
    np.testing.assert_allclose(part.beam_velocity(beams, along), velocity, atol=1e-9)
    along[(missing + 1) % 4] = np.nan
    along[(missing + 2) % 4] = np.nan
    assert np.all(np.isnan(part.beam_velocity(beams, along)))


def test_no_echo_comes_in_a_drop_out() -> None:
    suite = part.SensorSuite(dvl_dropouts_s=((2.0, 3.0), (5.0, 5.5)))
    run = fly(suite.pack(), straight(8.0), level_floor(15.0), 0)
    heard = np.any(np.isfinite(run.innovations[::4, 2:6]), axis=1)
    time_s = np.arange(len(heard)) * 0.2
    silent_then = ((time_s > 1.99) & (time_s < 2.99)) | ((time_s > 4.99) & (time_s < 5.49))
    assert not heard[silent_then].any()
    assert heard[~silent_then].mean() > 0.9
