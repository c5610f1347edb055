"""Slow, obvious twins of the flat-port camera, written apart from it."""

import math
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from scipy.optimize import bisect, minimize

from alice_survey.core.frames import Array
from camera_calib.camera import Camera

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
"""In the order of OpenCV's vector."""


def lens_pixel(camera: Camera, ray_air: Array) -> Array:
    """Pixel of a ray in air, by OpenCV."""
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    distortion = np.array([camera.parameter(name) for name in COEFFICIENTS])
    ray = np.asarray(ray_air, dtype=np.float64).reshape(1, 1, 3)
    pixels, _ = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(2)


def reach_m(angle_air: float, layers: Sequence[tuple[float, float]]) -> float:
    """How far from the axis a ray ends behind layers of a thickness and an index each."""
    sine = math.sin(angle_air)
    return sum(thick_m * math.tan(math.asin(sine / n)) for thick_m, n in layers)


def project_by_bisection(camera: Camera, point_cam: Array) -> Array:
    """Pixel of a point through a port square to the axis: Fermat's principle by bisection.

    The derivative of the optical path with respect to where the light meets the glass is the
    difference of the sines, n sin = n' sin'. With both zero, the angle in air decides how far from
    the axis the light ends; that distance grows with it and is bisected.
    """
    x, y, z = point_cam
    radius = math.hypot(x, y)
    water_m = z - camera.parameter("port_distance_m") - camera.parameter("glass_thickness_m")

    layers = (
        (camera.parameter("port_distance_m"), 1.0),
        (camera.parameter("glass_thickness_m"), camera.parameter("n_glass")),
        (water_m, camera.n_water),
    )

    def misses(angle: float) -> float:
        return reach_m(angle, layers) - radius

    angle = bisect(misses, 0.0, math.pi / 2 - 1e-12, xtol=1e-15, rtol=1e-15, maxiter=200)
    ray = np.array([0.0, 0.0, 1.0])
    if radius > 0:
        ray[:2] = math.tan(angle) * np.array([x, y]) / radius
    return lens_pixel(camera, ray)


def project_by_shortest_path(camera: Camera, point_cam: Array) -> Array:
    """Pixel of a point through any port: the optical path, minimised in space.

    Light crosses the inner glass at A and the outer glass at B, each free in two dimensions. The
    path |A| + n_glass |B - A| + n_water |P - B| is convex; its least value is found by Newton's
    method on all four unknowns, without any thought of a plane of refraction.
    """
    normal = np.asarray(camera.port.axis_cam) / np.linalg.norm(camera.port.axis_cam)
    first = np.cross(normal, [0.3, -0.5, 0.8])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)], axis=1)
    inner = camera.parameter("port_distance_m") * normal
    outer = inner + camera.parameter("glass_thickness_m") * normal
    # Differences A - 0, B - A and P - B are linear in the unknowns: d = base + matrix @ unknowns.
    zeros = np.zeros((3, 2))
    spans = [
        (1.0, inner, np.hstack([axes, zeros])),
        (camera.parameter("n_glass"), outer - inner, np.hstack([-axes, axes])),
        (camera.n_water, np.asarray(point_cam) - outer, np.hstack([zeros, -axes])),
    ]

    def legs(unknowns: Array) -> list[tuple[float, Array, Array]]:
        return [(n, base + matrix @ unknowns, matrix) for n, base, matrix in spans]

    def path(unknowns: Array) -> float:
        return sum(n * float(np.linalg.norm(d)) for n, d, _ in legs(unknowns))

    def gradient(unknowns: Array) -> Array:
        return np.sum([n * m.T @ d / np.linalg.norm(d) for n, d, m in legs(unknowns)], axis=0)

    def hessian(unknowns: Array) -> Array:
        across = [np.eye(3) - np.outer(d, d) / (d @ d) for _, d, _ in legs(unknowns)]
        each = zip(legs(unknowns), across, strict=True)
        return np.sum([n * m.T @ a @ m / np.linalg.norm(d) for (n, d, m), a in each], axis=0)

    near, far = (float(surface @ normal) for surface in (inner, outer))
    sideways = (np.asarray(point_cam) @ axes) / float(np.asarray(point_cam) @ normal)
    start = np.concatenate([near * sideways, far * sideways])
    found = minimize(
        path, start, jac=gradient, hess=hessian, method="trust-exact", options={"gtol": 1e-9}
    ).x
    for _ in range(5):  # a trust region stops at the rounding of the path; the gradient goes on
        found = found - np.linalg.solve(hessian(found), gradient(found))
    return lens_pixel(camera, inner + axes @ found[:2])


def numeric_slope(at: Callable[..., Array], step: float) -> Array:
    """Slope of a function of one number at 0, by differences of sixth order."""
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    total = sum(w * (at(i * step) - at(-i * step)) for i, w in weights.items())
    return np.asarray(total / (60.0 * step))


def assert_slopes_by_point(camera: Camera, points: Array) -> None:
    """Analytic slopes by the point are those of `project`."""
    pixels, by_point, _ = camera.project_jacobian(points)
    np.testing.assert_allclose(pixels, camera.project(points), atol=1e-9)
    for axis in range(3):
        moved = numeric_slope(lambda h, a=axis: camera.project(points + h * np.eye(3)[a]), 1e-3)
        np.testing.assert_allclose(by_point[..., axis], moved, rtol=1e-6, atol=2e-4)


def assert_slopes(camera: Camera, points: Array, steps: Mapping[str, float]) -> None:
    """Analytic slopes are those of `project`, by the point and by each parameter."""
    assert_slopes_by_point(camera, points)
    by_parameter = camera.project_jacobian(points)[2]
    for i, name in enumerate(camera.parameters):
        value, step = camera.parameter(name), steps.get(name, 1e-4)
        moved = numeric_slope(
            lambda h, n=name, v=value: camera.with_parameters({n: v + h}).project(points), step
        )
        scale = 1e-8 * max(1.0, float(np.abs(moved).max())) + 1e-9 / step
        np.testing.assert_allclose(by_parameter[..., i], moved, rtol=1e-6, atol=scale, err_msg=name)
