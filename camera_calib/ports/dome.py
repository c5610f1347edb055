"""A dome port, exactly: glass between two spheres of one centre, which the pupil may miss.

Light keeps `n r sin(angle of incidence)` from sphere to sphere (Bouguer's law for spherical
layers, M. Born, E. Wolf, "Principles of Optics", section 3.2.1), so that its whole path lies in
the plane of the centre, the pupil and the point. In that plane one angle is unknown; Newton's
method finds it. With the pupil at the centre the dome does nothing to any ray.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.ports.values import GLASS_AND_WATER, N_WATER_SPREAD, PortValues, Vector

_CENTRE = ("dome_x_m", "dome_y_m", "dome_z_m")
_STEPS = 40
_FEW_STEPS = 3
_SETTLED = 1e-8
"""After a step of Newton's method this short, in radians, its square is what is left."""


@dataclass(frozen=True, kw_only=True)
class DomePort(PortValues):
    """Spherical glass before the lens, centred on the pupil or not.

    Example:
        >>> import alice_survey as alice
        >>> dome = alice.DomePort(outer_radius_m=0.08, glass_thickness_m=0.006, dome_z_m=0.005)
        >>> dome.refracts, round(dome.magnification, 3)
        (True, 0.983)
    """

    shape: ClassVar[str] = "dome"
    parameters: ClassVar[tuple[str, ...]] = (
        *_CENTRE, "outer_radius_m", "glass_thickness_m", "n_glass", "n_water"
    )  # fmt: skip
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "outer_radius_m": (1e-3, 10.0), **GLASS_AND_WATER
    }  # fmt: skip
    places: ClassVar[tuple[str, ...]] = _CENTRE
    spreads: ClassVar[Mapping[str, float]] = {
        "dome_x_m": 0.005, "dome_y_m": 0.005, "dome_z_m": 0.02, "n_water": N_WATER_SPREAD
    }  # fmt: skip
    needs_air: ClassVar[bool] = True

    dome_x_m: float = 0.0
    dome_y_m: float = 0.0
    dome_z_m: float = 0.0
    """Centre of the dome in the camera's frame: z > 0 where the pupil is behind it."""
    outer_radius_m: float
    glass_thickness_m: float = 0.0
    n_glass: float = 1.49
    n_water: float = 1.34

    @classmethod
    def guess(cls) -> Self:
        """Of 80 mm radius, about the pupil."""
        return cls(outer_radius_m=0.08)

    @classmethod
    def from_design(cls, camera: CameraConfig, n_water: float) -> Self:
        """The port of a design, in water of an index."""
        return cls(
            **dict(zip(_CENTRE, camera.dome_centre_m, strict=True)),
            outer_radius_m=camera.dome_radius_m,
            glass_thickness_m=camera.glass_thickness_m,
            n_glass=camera.n_glass,
            n_water=n_water,
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        inner = self.outer_radius_m - self.glass_thickness_m
        off = math.hypot(self.dome_x_m, self.dome_y_m, self.dome_z_m)
        if not off < inner:
            raise CalibrationError(
                f"camera: the pupil is {off * 1e3:g} mm from the dome's centre, outside its inner "
                f"radius of {inner * 1e3:g} mm"
            )

    @property
    def refracts(self) -> bool:
        """Whether light bends at the port: not so where the pupil is at its centre."""
        bends = self.n_water != 1.0 or (self.glass_thickness_m > 0.0 and self.n_glass != 1.0)
        return bends and (self.dome_x_m, self.dome_y_m, self.dome_z_m) != (0.0, 0.0, 0.0)

    @property
    def front_cam(self) -> Vector:
        """The point of the outer surface straight before the centre."""
        return self.dome_x_m, self.dome_y_m, self.dome_z_m + self.outer_radius_m

    @property
    def magnification(self) -> float:
        """From the paraxial form of the equation that `dome_rays` solves."""
        inner = self.outer_radius_m - self.glass_thickness_m
        bend = _bend(inner, self.outer_radius_m, math.inf, self.n_glass, self.n_water)
        return 1.0 / (1.0 - bend * self.dome_z_m)

    @property
    def centre_cam(self) -> Array:
        """(3,) centre of the spheres."""
        return np.array([self.dome_x_m, self.dome_y_m, self.dome_z_m])

    @property
    def axis_cam(self) -> Vector:
        """The line through pupil and centre."""
        off = float(np.linalg.norm(self.centre_cam))
        if off == 0.0:
            return super().axis_cam
        x, y, z = (self.centre_cam / off).tolist()
        return x, y, z

    @property
    def by_motion(self) -> Array:
        """(7, 3) changes of the parameters as the port moves: of its centre."""
        return np.eye(len(self.parameters), 3)

    def clearance(self, points_cam: Array) -> tuple[Array, Array]:
        """Distance (N,) of points (N, 3) beyond the outer sphere, and its normals (N, 3)."""
        away = points_cam - self.centre_cam
        distance = np.linalg.norm(away, axis=1)
        return distance - self.outer_radius_m, away / distance[:, None]

    @property
    def words(self) -> str:
        """What the port is, in a few words."""
        x, y, z = 1e3 * self.centre_cam
        return (
            f"dome of {self.outer_radius_m * 1e3:.4g} mm radius, {self.glass_thickness_m * 1e3:.3g}"
            f" mm thick, its centre ({x:.3g}, {y:.3g}, {z:.3g}) mm from the pupil"
        )


def _bend(inner: float, outer: float, reach: float, n_glass: float, n_water: float) -> float:
    """Turn of light from air to a point at `reach`, over its distance from the centre."""
    return (
        (1.0 / n_glass - 1.0) / inner
        + (1.0 / n_water - 1.0 / n_glass) / outer
        - (1.0 / (n_water * reach))
    )


@compiled_ieee
def _turn(sin: float, cos: float, of: float) -> tuple[float, float, float]:
    """Sine and cosine of an angle plus asin(of), and the cosine of that."""
    side = math.sqrt(1.0 - of * of)
    return sin * side + cos * of, cos * side - sin * of, side


@compiled_ieee
def _step(
    sin: float, cos: float, along: float, aside: float, reach: float, port: Array
) -> tuple[float, float]:
    """Miss of the light that leaves the pupil at some angle, and its slope by that angle.

    In the plane of light, with the first axis from the centre to the point, the pupil is at
    (along, aside). A ray with direction angle a keeps h = along sin a - aside cos a over n from the
    centre, and on a sphere r lies asin(h / (n r)) before its direction. Five such turns lead from
    the direction in air to the place of the point: 0.

    Returns:
        Sine of the angle by which the light misses the point, and slope of that angle.
    """
    h = along * sin - aside * cos
    by_a, by_c = 1.0 / (port[3] - port[4]), 1.0 / (port[5] * port[3])
    by_b, by_d = by_a / port[5], 1.0 / (port[6] * port[3])
    by_e = 1.0 / (port[6] * reach)
    s, k, cos_a = _turn(sin, cos, -h * by_a)
    s, k, cos_b = _turn(s, k, h * by_b)
    s, k, cos_c = _turn(s, k, -h * by_c)
    s, k, cos_d = _turn(s, k, h * by_d)
    s, k, cos_e = _turn(s, k, -h * by_e)
    bend = by_b / cos_b - by_a / cos_a + by_d / cos_d - by_c / cos_c - by_e / cos_e
    return s, 1.0 + bend * (along * cos + aside * sin)


@compiled_ieee
def _first_lean(along: float, reach: float, port: Array) -> float:
    """Sine of the unknown angle over `aside`, of light near the centre."""
    outer, inner, n_glass, n_water = port[3], port[3] - port[4], port[5], port[6]
    bend = (1.0 / n_glass - 1.0) / inner + (1.0 / n_water - 1.0 / n_glass) / outer
    bend -= 1.0 / (n_water * reach)
    lean: float = bend / (1.0 + bend * along)
    return lean


@compiled_ieee
def _sine(along: float, aside: float, reach: float, port: Array) -> float:
    """Sine of the angle between the ray in air and the line from the centre to the point."""
    sin = min(max(_first_lean(along, reach, port) * aside, -0.9), 0.9)
    for _ in range(_STEPS):
        cos = math.sqrt(1.0 - sin * sin)
        miss, slope = _step(sin, cos, along, aside, reach, port)
        turn = miss / slope
        sin = min(max(sin - cos * turn - 0.5 * sin * turn * turn, -1.0), 1.0)
        if abs(turn) <= _SETTLED:
            return float(sin)
    return math.nan


@compiled_ieee
def dome_rays(points: Array, port: Array, rays: Array, leans: Array) -> None:
    """Rays in air of points in water (B, 3).

    Args:
        points: (B, 3).
        port: (7,).
        rays: (B, 3) to be filled in; NaN without one.
        leans: (B,) to be filled in for `dome_slopes`: sin(a) / aside.
    """
    count = len(points)
    cx, cy, cz, outer = port[0], port[1], port[2], port[3]
    reach, along, aside = np.empty(count), np.empty(count), np.empty(count)
    sin, last = np.empty(count), np.empty(count)
    off2 = cx * cx + cy * cy + cz * cz
    for j in range(count):
        x, y, z = points[j, 0] - cx, points[j, 1] - cy, points[j, 2] - cz
        reach[j] = math.sqrt(x * x + y * y + z * z)
        along[j] = -(x * cx + y * cy + z * cz) / reach[j]
        aside[j] = math.sqrt(max(off2 - along[j] * along[j], 0.0))
        sin[j] = min(max(_first_lean(along[j], reach[j], port) * aside[j], -0.9), 0.9)
    for j in range(count):
        turn, s = 0.0, sin[j]
        for _ in range(_FEW_STEPS):
            cos = math.sqrt(1.0 - s * s)
            miss, slope = _step(s, cos, along[j], aside[j], reach[j], port)
            turn = miss / slope
            s = min(max(s - cos * turn - 0.5 * s * turn * turn, -1.0), 1.0)
        sin[j], last[j] = s, turn
    for j in range(count):
        rays[j, 0] = rays[j, 1] = rays[j, 2] = math.nan
        if not reach[j] > outer:
            continue
        if not abs(last[j]) <= _SETTLED:
            sin[j] = _sine(along[j], aside[j], reach[j], port)
        lean = sin[j] / aside[j] if aside[j] > 0.0 else _first_lean(along[j], reach[j], port)
        leans[j] = lean
        stretch = (math.sqrt(1.0 - sin[j] * sin[j]) - lean * along[j]) / reach[j]
        rays[j, 0] = stretch * (points[j, 0] - cx) - lean * cx
        rays[j, 1] = stretch * (points[j, 1] - cy) - lean * cy
        rays[j, 2] = stretch * (points[j, 2] - cz) - lean * cz


@compiled_ieee
def dome_leave(rays: Array, port: Array, points: Array, directions: Array) -> None:
    """Points on the outer glass and unit directions in water of unit rays in air, (B, 3) each."""
    cx, cy, cz, outer, n_glass, n_water = port[0], port[1], port[2], port[3], port[5], port[6]
    inner = outer - port[4]
    off2 = cx * cx + cy * cy + cz * cz
    for j in range(len(rays)):
        dx, dy, dz = rays[j, 0], rays[j, 1], rays[j, 2]
        ahead = dx * cx + dy * cy + dz * cz
        reach = ahead + math.sqrt(ahead * ahead - off2 + inner * inner)
        # Position from the centre, and its unit vector: the normal.
        x, y, z = reach * dx - cx, reach * dy - cy, reach * dz - cz
        dx, dy, dz = _refract(dx, dy, dz, x / inner, y / inner, z / inner, 1.0 / n_glass)
        ahead = dx * x + dy * y + dz * z
        reach = math.sqrt(ahead * ahead - inner * inner + outer * outer) - ahead
        x, y, z = x + reach * dx, y + reach * dy, z + reach * dz
        dx, dy, dz = _refract(dx, dy, dz, x / outer, y / outer, z / outer, n_glass / n_water)
        points[j, 0], points[j, 1], points[j, 2] = x + cx, y + cy, z + cz
        directions[j, 0], directions[j, 1], directions[j, 2] = dx, dy, dz


@compiled_ieee
def _refract(
    dx: float, dy: float, dz: float, nx: float, ny: float, nz: float, ratio: float
) -> tuple[float, float, float]:
    """A unit ray behind a surface, by Snell's law; NaN where it is totally reflected."""
    cos = dx * nx + dy * ny + dz * nz
    bend = math.sqrt(1.0 - ratio * ratio * (1.0 - cos * cos)) - ratio * cos
    return ratio * dx + bend * nx, ratio * dy + bend * ny, ratio * dz + bend * nz


@compiled_ieee
def dome_slopes(
    points: Array, leans: Array, port: Array, by_ray: Array, by_point: Array, by_port: Array
) -> None:
    """Slopes of pixels by the point and the port, from those by the ray in air.

    With w the direction from the centre to the point, o = along w + aside q the pupil and a the
    angle that `dome_rays` finds, the ray is cos(a) w + sin(a) q. Slopes of a follow from the
    equation it solves; sin(a) / aside is kept as one number, which has a limit where aside is 0.

    Args:
        points: (B, 3).
        leans: (B,) their sin(a) / aside, of `dome_rays`.
        port: (7,).
        by_ray: (B, 2, 3) slopes of the pixels by the rays.
        by_point: (B, 2, 3) to be filled in.
        by_port: (B, 2, 7) to be filled in.
    """
    cx, cy, cz = port[0], port[1], port[2]
    outer, inner, n_glass, n_water = port[3], port[3] - port[4], port[5], port[6]
    for j in range(len(points)):
        wx, wy, wz = points[j, 0] - cx, points[j, 1] - cy, points[j, 2] - cz
        reach = math.sqrt(wx * wx + wy * wy + wz * wz)
        wx, wy, wz = wx / reach, wy / reach, wz / reach
        along = -(wx * cx + wy * cy + wz * cz)
        qx, qy, qz = -cx - along * wx, -cy - along * wy, -cz - along * wz
        aside = math.sqrt(qx * qx + qy * qy + qz * qz)
        if aside > 0.0:
            qx, qy, qz = qx / aside, qy / aside, qz / aside
        lean = leans[j]
        sin = lean * aside
        cos = math.sqrt(1.0 - sin * sin)
        h = along * sin - aside * cos
        # Of each turn asin(h / (n r)): the slope by h, which is 1 / (n r cos).
        by_a = 1.0 / math.sqrt(inner**2 - h * h)
        by_b = 1.0 / math.sqrt((n_glass * inner) ** 2 - h * h)
        by_c = 1.0 / math.sqrt((n_glass * outer) ** 2 - h * h)
        by_d = 1.0 / math.sqrt((n_water * outer) ** 2 - h * h)
        by_e = 1.0 / math.sqrt((n_water * reach) ** 2 - h * h)
        bend = by_b - by_a + by_d - by_c - by_e
        steep = 1.0 + bend * (along * cos + aside * sin)
        # Slopes of the angle by along, aside, reach and the port.
        by_along, by_aside, by_reach = (
            -bend * sin / steep,
            bend * cos / steep,
            -h * by_e / reach / steep,
        )
        at_inner = h * (by_a - by_b) / inner / steep
        at_outer = h * (by_c - by_d) / outer / steep
        by_glass = h * (by_b - by_c) / n_glass / steep
        by_water = h * (by_d - by_e) / n_water / steep
        by_inner, by_outer = -at_inner, -at_outer
        for row in range(2):
            gx, gy, gz = by_ray[j, row, 0], by_ray[j, row, 1], by_ray[j, row, 2]
            g_w = gx * wx + gy * wy + gz * wz
            g_q = gx * qx + gy * qy + gz * qz
            g_turn = cos * g_q - sin * g_w
            # The pixel moves by x . dw + y . do, with what the angle adds.
            for axis in range(3):
                g = gx if axis == 0 else (gy if axis == 1 else gz)
                w = wx if axis == 0 else (wy if axis == 1 else wz)
                q = qx if axis == 0 else (qy if axis == 1 else qz)
                o = along * w + aside * q
                d_along = o  # by dw; its part along w is taken off below
                d_aside = -along * q
                d_w = (cos - lean * along) * g - lean * g_w * d_along - lean * g_q * d_aside
                d_w += g_turn * (by_along * d_along + by_aside * d_aside)
                d_o = lean * (g - g_w * w - g_q * q)
                d_o += g_turn * (by_along * w + by_aside * q)
                by_point[j, row, axis] = d_w
                by_port[j, row, axis] = d_o
            across = by_point[j, row, 0] * wx + by_point[j, row, 1] * wy + by_point[j, row, 2] * wz
            for axis in range(3):
                w = wx if axis == 0 else (wy if axis == 1 else wz)
                moved = (by_point[j, row, axis] - across * w) / reach + g_turn * by_reach * w
                by_point[j, row, axis] = moved
                by_port[j, row, axis] = -moved - by_port[j, row, axis]
            by_port[j, row, 3] = g_turn * (by_inner + by_outer)
            by_port[j, row, 4] = -g_turn * by_inner
            by_port[j, row, 5] = g_turn * by_glass
            by_port[j, row, 6] = g_turn * by_water
