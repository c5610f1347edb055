import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from alice_survey.core.frames import Array
from camera_calib.lenses.opencv import (
    COEFFICIENTS,
    distort_slopes,
    fold,
    opencv_pixels,
    radial,
    undistort,
)

SPAN = (0.3, 0.15, 2e-3, 2e-3, 0.05, 0.3, 0.1, 0.03, 2e-3, 1e-3, 2e-3, 1e-3)
"""Largest size of each of COEFFICIENTS here."""


@st.composite
def lenses(draw: st.DrawFn) -> Array:
    return np.array([draw(st.floats(-size, size)) for size in SPAN])


def vector(**values: float) -> Array:
    return np.array([values.get(name, 0.0) for name in COEFFICIENTS])


def opencv(u: float, v: float, k: Array) -> Array:
    ray = np.array([[[u, v, 1.0]]])
    seen, _ = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), np.eye(3), k)
    return np.asarray(seen, dtype=np.float64).reshape(2)


def distort(u: float, v: float, k: Array) -> tuple[float, float]:
    """(x, y) of the ray with tangents (u, v): pixels of a lens of focal length 1."""
    pixels = np.empty((1, 2))
    lens = np.array([1.0, 1.0, 0.0, 0.0, *k, np.inf])
    opencv_pixels(np.array([[u, v, 1.0]]), lens, pixels)
    return float(pixels[0, 0]), float(pixels[0, 1])


@given(k=lenses(), u=st.floats(-0.7, 0.7), v=st.floats(-0.6, 0.6))
def test_it_is_opencvs_model_term_by_term(k: Array, u: float, v: float) -> None:
    np.testing.assert_allclose(distort(u, v, k), opencv(u, v, k), atol=1e-14)


@given(k=lenses(), u=st.floats(-0.7, 0.7), v=st.floats(-0.6, 0.6))
def test_slopes_are_those_of_the_model(k: Array, u: float, v: float) -> None:
    step = 1e-4

    def fourth_order(du: float, dv: float) -> Array:
        near = np.subtract(distort(u + du, v + dv, k), distort(u - du, v - dv, k))
        far = np.subtract(distort(u + 2 * du, v + 2 * dv, k), distort(u - 2 * du, v - 2 * dv, k))
        return np.asarray((8 * near - far) / (12 * step))

    x, y, x_u, x_v, y_u, y_v = distort_slopes(u, v, tuple(k))

    assert (x, y) == distort(u, v, k)
    np.testing.assert_allclose([x_u, y_u], fourth_order(step, 0.0), atol=1e-10)
    np.testing.assert_allclose([x_v, y_v], fourth_order(0.0, step), atol=1e-10)


@settings(max_examples=300)
@given(k=lenses(), radius=st.floats(0.0, 0.95), azimuth=st.floats(-3.2, 3.2))
def test_a_ray_before_the_fold_comes_back(k: Array, radius: float, azimuth: float) -> None:
    # Tangential and prism terms move the fold a little: some distance is kept from it.
    reach = radius * min(math.sqrt(fold(k)), 1.0)
    u, v = reach * math.cos(azimuth), reach * math.sin(azimuth)
    x, y, x_u, x_v, y_u, y_v = distort_slopes(u, v, tuple(k))
    assume(x_u * y_v - x_v * y_u > 0.05)

    np.testing.assert_allclose(undistort(x, y, tuple(k), fold(k)), (u, v), atol=1e-11)


def test_a_cubic_lens_folds_where_its_slope_vanishes() -> None:
    assert fold(vector(k1=-0.3)) == pytest.approx(1 / 0.9, rel=1e-12)  # 1 + 3 k1 w = 0
    assert fold(vector(k1=0.3)) == math.inf
    assert fold(vector()) == math.inf


@given(k=lenses())
def test_radial_distortion_rises_up_to_the_fold_and_not_beyond(k: Array) -> None:
    def seen(w: float) -> float:
        ratio, _, _ = radial(w, tuple(k))
        return math.sqrt(w) * float(ratio)

    end = min(fold(k), 4.0)
    before = [seen(w) for w in np.linspace(0.0, end, 200)[:-1]]
    assert np.all(np.diff(before) > 0)
    if end < 4.0 and radial(end, tuple(k))[2] > 1e-6:
        assert seen(end * 1.02) < seen(end) or radial(end * 1.02, tuple(k))[2] <= 0


def test_a_rational_lens_ends_at_its_pole() -> None:
    k = vector(k4=-0.5)  # r / (1 - 0.5 r^2) rises to infinity at r^2 = 2
    assert fold(k) == pytest.approx(2.0, rel=1e-12)
    u, v = undistort(*distort(1.3, 0.1, k), tuple(k), fold(k))
    np.testing.assert_allclose((u, v), (1.3, 0.1), atol=1e-12)
