"""Fins: lift, drag and stall of a surface, and the motion of a vehicle that they steer."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.fins import (
    Fin,
    Fins,
    add_fins,
    fin_slope,
    pack_fins,
    write_fin_matrix,
)
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests import oracles_dynamics as oracle
from tests.alice_survey.sim.vehicle.motions import advance, rates, state_of
from tests.oracles_navigation import jacobian

REMUS = vehicle_from("remus100")
PLANE = Fin(
    name="plane", positions_body_m=((-0.6, 0.1, 0.02),), shaft_body=(0.0, 1.0, 0.0), area_m2=0.01,
    aspect_ratio=2.0, most_angle_deg=20.0, most_rate_deg_s=40.0, profile_drag=0.01,
)  # fmt: skip
PACKED = pack_fins([PLANE], 1000.0)
SPEEDS = st.floats(-2.0, 2.0)


def wrench(fins: Fins, angles: Sequence[float] | Array, nu: Sequence[float] | Array) -> Array:
    force = np.zeros(6)
    add_fins(fins, np.array(angles), np.array(nu), force)
    return force


def test_lift_of_a_plane_at_a_small_angle() -> None:
    """1/2 rho A U^2 a alpha, with a = 1 / (1 / (1.8 pi) + 1 / (2 pi)) = 2.976 per radian: at 2 m/s
    and 3 deg 3.117 N, up at the stern (shaft to starboard); its drag is induced, and profile."""
    force = wrench(PACKED, [math.radians(3.0)], [2.0, 0, 0, 0, 0, 0])
    lift = 0.5 * 1000 * 0.01 * 4 * 2.9762 * math.radians(3.0)
    drag = 20.0 * (0.01 + (2.9762 * math.radians(3.0)) ** 2 / (0.9 * math.pi * 2.0))
    assert force[2] == pytest.approx(-lift, rel=1e-4)
    assert force[0] == pytest.approx(-drag, rel=1e-4)
    assert force[1] == 0.0
    np.testing.assert_allclose(force[3:], np.cross([-0.6, 0.1, 0.02], force[:3]), atol=1e-12)


def _triple(place: Array) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


@settings(max_examples=60, deadline=None)
@given(
    nu=st.tuples(*[SPEEDS] * 6),
    angles=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
    roll=st.floats(-math.pi, math.pi),
)
def test_the_wrench_is_that_of_vectors_in_space(
    nu: tuple[float, ...], angles: tuple[float, float], roll: float
) -> None:
    """Any motion, any angles, the tail turned about its axis."""
    turned = Rotation.from_euler("x", roll)
    fins = tuple(
        replace(
            fin,
            shaft_body=_triple(turned.apply(fin.shaft_body)),
            positions_body_m=tuple(map(_triple, turned.apply(fin.positions_body_m))),
            profile_drag=0.01,
        )
        for fin in REMUS.fins
    )
    vehicle = replace(REMUS, fins=fins)
    force = wrench(vehicle.plant.fins, angles, nu)
    expected = oracle.fin_wrench(vehicle, np.array(angles), np.array(nu))
    np.testing.assert_allclose(force, expected, atol=1e-10 * (1.0 + np.abs(expected).max()))


def test_the_matrix_of_fins_is_the_slope_of_their_wrench() -> None:
    nu, matrix = np.array([1.2, 0, 0, 0, 0, 0]), np.zeros((6, 3))
    write_fin_matrix(REMUS.plant.fins, nu, matrix, 1)
    slope = jacobian(lambda angles: wrench(REMUS.plant.fins, angles, nu), 2, 1e-6)
    np.testing.assert_allclose(matrix[:, 1:], slope, atol=1e-6 * np.abs(slope).max(axis=0).min())
    assert not matrix[:, 0].any()
    assert matrix[4, 1] < -10.0 and matrix[5, 2] < -10.0
    write_fin_matrix(REMUS.plant.fins, -nu, matrix, 1)
    assert not matrix.any()


def test_the_slope_by_velocity_is_that_of_fixed_fins() -> None:
    """Y_uv = -rho a S u of two fins, N_ur that times x^2 (Prestero's equations 4.51 and 4.52)."""
    slope = fin_slope(REMUS.plant.fins, np.array([1.5, 0, 0, 0, 0, 0]))
    force = 1030.0 * 3.1166 * 0.00665 * 1.5
    np.testing.assert_allclose(slope[[1, 2], [1, 2]], force, rtol=1e-4)
    np.testing.assert_allclose(slope[[4, 5], [4, 5]], 0.638**2 * force, rtol=1e-4)
    # In roll all four are lifted by their own motion.
    assert slope[3, 3] == pytest.approx(2 * 0.108**2 * force, rel=1e-4)


def test_a_drive_lags_and_is_limited_in_rate_and_angle() -> None:
    """From rest to 30 deg asked: 60 deg/s, then exp(-t / 0.1 s) to its limit of 13.6 deg."""
    state = state_of(REMUS)
    command = np.array([0.0, math.radians(30.0), math.radians(-1.0)])
    assert rates(REMUS, state, command_rps=command)[14] == pytest.approx(math.radians(60.0))
    states = advance(REMUS, state, 1.0, 0.01, command_rps=command)
    angles = np.degrees(states[:, 14:])
    until_s = (13.6 - 6.0) / 60.0
    time_s = np.arange(len(states)) * 0.01
    expected = np.where(
        time_s < until_s, 60.0 * time_s, 13.6 - 6.0 * np.exp(-(time_s - until_s) / 0.1)
    )
    np.testing.assert_allclose(angles[:, 0], expected, atol=0.05)
    np.testing.assert_allclose(angles[:, 1], -(1.0 - np.exp(-time_s / 0.1)), atol=1e-3)


def test_a_fin_square_to_the_flow_is_a_plate() -> None:
    force = wrench(PACKED, [0.0], [0, 0, 1.5, 0, 0, 0])
    assert force[2] == pytest.approx(-0.5 * 1000 * 0.01 * 1.5**2 * (0.56 + 0.01))
    assert abs(force[0]) < 1e-12


def test_lift_rises_to_the_stall_and_falls_smoothly_beyond() -> None:
    alpha = np.radians(np.linspace(-180.0, 180.0, 3601))
    lift = np.array([-wrench(PACKED, [a], [1.0, 0, 0, 0, 0, 0])[2] for a in alpha]) / 5.0
    assert np.degrees(abs(alpha[np.argmax(lift)])) == pytest.approx(21.0, abs=2.0)
    assert 0.9 < lift.max() < 1.2
    assert np.abs(np.diff(lift)).max() < 0.025
    np.testing.assert_allclose(lift, -lift[::-1], atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(nu=st.tuples(*[SPEEDS] * 6))
def test_fins_that_are_not_turned_take_energy_out(nu: tuple[float, ...]) -> None:
    assert wrench(REMUS.plant.fins, [0.0, 0.0], nu) @ nu <= 1e-12
