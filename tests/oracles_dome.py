"""A dome port by tracing rays: spheres met by roots of a quadratic, Snell's law in angles."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from camera_calib.ports.dome import DomePort

Array = NDArray[np.float64]


def traced(port: DomePort, ray_air: Array) -> tuple[Array, Array, Array]:
    """Points on the inner and the outer sphere, and the unit direction in water, of a ray in air.

    At each sphere the ray is turned, about the axis across the plane of incidence, by the
    difference of the angles of incidence and refraction.
    """
    centre = np.array([port.dome_x_m, port.dome_y_m, port.dome_z_m])
    place, way = np.zeros(3), _unit(ray_air)
    radii = (port.outer_radius_m - port.glass_thickness_m, port.outer_radius_m)
    indices = (1.0, port.n_glass, port.n_water)
    places = []
    for surface in range(2):
        off = place - centre
        half = float(way @ off)
        root_of = half**2 - float(off @ off) + radii[surface] ** 2
        place = place + (math.sqrt(max(root_of, 0.0)) - half) * way
        normal = (place - centre) / radii[surface]
        axis = _cross(normal, way)
        sine = math.hypot(*axis)
        if sine > 0.0:
            bent = math.asin(indices[surface] / indices[surface + 1] * min(sine, 1.0))
            angle = bent - math.atan2(sine, float(normal @ way))
            way = math.cos(angle) * way + math.sin(angle) / sine * _cross(axis, way)
        places.append(place)
    return places[0], places[1], way


def ray_to(port: DomePort, point_cam: Array) -> Array:
    """Unit ray in air whose light reaches a point: two components are sought by Powell's method."""
    straight = _unit(point_cam)
    side = _unit(np.cross(straight, [0.3, -0.5, 0.81]))
    up = np.cross(straight, side)

    def ray(sideways: Array) -> Array:
        return _unit(straight + sideways[0] * side + sideways[1] * up)

    def miss(sideways: Array) -> Array:
        _, outer, way = traced(port, ray(sideways))
        off = _cross(way, _unit(point_cam - outer))
        return np.array([off @ side, off @ up])

    found = root(miss, np.zeros(2), method="hybr", options={"xtol": 1e-15})
    assert np.abs(found.fun).max() < 1e-13
    return ray(found.x)


def optical_path_slopes(port: DomePort, inner: Array, outer: Array, point_cam: Array) -> Array:
    """Slopes of the optical path from the pupil to a point by places on both spheres, (4,).

    By Fermat's principle all are 0 for the path of light.
    """
    centre = np.array([port.dome_x_m, port.dome_y_m, port.dome_z_m])
    slopes = []
    for k, place in enumerate((inner, outer)):
        normal = place - centre
        before = place / np.linalg.norm(place) if k == 0 else _unit(outer - inner) * port.n_glass
        after = (
            _unit(outer - inner) * port.n_glass
            if k == 0
            else (_unit(point_cam - outer) * port.n_water)
        )
        across = np.cross(normal, [0.3, -0.5, 0.81])
        axes = np.stack([_unit(across), _unit(np.cross(normal, across))])
        slopes.append(axes @ (before - after))
    return np.concatenate(slopes)


def _unit(vector: Array) -> Array:
    return vector / math.hypot(*vector)


def _cross(first: Array, second: Array) -> Array:
    """What `np.cross` gives for two vectors, in a twentieth of its time."""
    (a, b, c), (d, e, f) = first.tolist(), second.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])
