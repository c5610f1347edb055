"""A flat port, exactly: a plane glass at some distance from the entrance pupil.

From the ray in air to the ray in water is closed form (Snell's law twice); from a point to the ray
in air is one root of a concave function, found by Newton's method to machine precision. Kernels
take `FlatPort.values`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.ports.values import GLASS_AND_WATER, N_WATER_SPREAD, PortValues, Vector

_NEWTON_STEPS = 60
_SETTLED = 1e-8
"""A step this short, against the tangent, leaves an error below 1.5 times its square, as t f'' / f'
of what Newton's method solves is 3 at most."""
_MIN_ROOT = 0.01
_NORMAL = ("normal_x", "normal_y")


@dataclass(frozen=True, kw_only=True)
class FlatPort(PortValues):
    """A plane glass before the lens.

    Without distance and thickness in water of index n it makes a pinhole magnified by n.

    Example:
        >>> import alice_survey as alice
        >>> alice.FlatPort(port_distance_m=0.02, glass_thickness_m=0.01).magnification
        1.34
    """

    shape: ClassVar[str] = "flat"
    parameters: ClassVar[tuple[str, ...]] = (
        "port_distance_m", "glass_thickness_m", "n_glass", "n_water", *_NORMAL
    )  # fmt: skip
    """The unit normal has two: its first two components, sines of the port's tilt about the
    camera's y and x axes."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "port_distance_m": (0.0, 5.0), **GLASS_AND_WATER
    }  # fmt: skip
    places: ClassVar[tuple[str, ...]] = ("port_distance_m",)
    tilts: ClassVar[tuple[str, ...]] = _NORMAL
    spreads: ClassVar[Mapping[str, float]] = {
        "port_distance_m": 0.02, **dict.fromkeys(_NORMAL, 0.05), "n_water": N_WATER_SPREAD
    }  # fmt: skip

    port_distance_m: float = 0.0
    """Distance from the entrance pupil to the inner glass, along the port's normal."""
    glass_thickness_m: float = 0.0
    n_glass: float = 1.52
    n_water: float = 1.34
    normal: Vector = (0.0, 0.0, 1.0)
    """Unit normal of the port in the camera frame, pointing into the water."""

    trusted_deg: ClassVar[float] = 70.0
    """By the paper, section III.B."""

    @classmethod
    def guess(cls) -> Self:
        """Two centimetres before the pupil."""
        return cls(port_distance_m=0.02)

    @classmethod
    def from_design(cls, camera: CameraConfig, n_water: float) -> Self:
        """The port of a design, in water of an index."""
        x, y = (float(np.sin(np.deg2rad(tilt))) for tilt in camera.port_tilt_deg)
        return cls(
            port_distance_m=camera.port_distance_m,
            glass_thickness_m=camera.glass_thickness_m,
            n_glass=camera.n_glass,
            n_water=n_water,
            normal=(x, y, float(np.sqrt(1.0 - x * x - y * y))),
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(math.hypot(*self.normal) - 1) > 1e-6 or self.normal[2] <= 0:
            raise CalibrationError(
                f"camera: normal {self.normal} is not a unit vector facing forward"
            )

    @cached_property
    def values(self) -> Array:
        """(7,) air gap, glass thickness, n_glass, n_water and the unit normal."""
        unit = np.asarray(self.normal) / math.hypot(*self.normal)
        lengths = self.port_distance_m, self.glass_thickness_m, self.n_glass, self.n_water
        return np.array([*lengths, *unit])

    @property
    def refracts(self) -> bool:
        """Whether light bends at the port; not so between air and air without glass."""
        return self.n_water != 1.0 or (self.glass_thickness_m > 0.0 and self.n_glass != 1.0)

    @property
    def front_cam(self) -> Vector:
        """The outer glass, straight before the pupil."""
        reach = self.port_distance_m + self.glass_thickness_m
        x, y, z = self.normal
        return reach * x, reach * y, reach * z

    @property
    def magnification(self) -> float:
        """The water's index, by Snell's law."""
        return self.n_water

    @property
    def axis_cam(self) -> Vector:
        """The normal."""
        return self.normal

    @property
    def by_motion(self) -> Array:
        """(6, 3) changes of the parameters as the port moves: of its distance alone."""
        moved = super().by_motion
        moved[0] = self.normal
        return moved

    def clearance(self, points_cam: Array) -> tuple[Array, Array]:
        """Distance (N,) of points (N, 3) beyond the outer glass, and its normal (N, 3)."""
        normal = np.array(self.normal)
        beyond = points_cam @ normal - self.port_distance_m - self.glass_thickness_m
        return beyond, np.tile(normal, (len(points_cam), 1))

    @property
    def words(self) -> str:
        """What the port is, in a few words."""
        return (
            f"port {self.port_distance_m * 1e3:.4g} mm + glass "
            f"{self.glass_thickness_m * 1e3:.4g} mm"
        )

    def parameter(self, name: str) -> float:
        """The value of one of `parameters`."""
        if name in _NORMAL:
            return float(self.normal[_NORMAL.index(name)])
        return super().parameter(name)

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The same port with some parameters set to other values."""
        x, y = (float(values.get(name, self.parameter(name))) for name in _NORMAL)
        if not x * x + y * y < 1.0:
            raise CalibrationError(f"camera: normal_x, normal_y = {x:.6g}, {y:.6g} exceed 1")
        port = super().with_parameters({n: v for n, v in values.items() if n not in _NORMAL})
        if set(_NORMAL) & set(values):
            return replace(port, normal=(x, y, math.sqrt(1.0 - x * x - y * y)))
        return port


@compiled_ieee
def air_tangent(radius: float, water: float, port: Array) -> float:
    """Tangent in air, against the port's normal, of the light from a point in the water.

    It solves t (air + glass / G + water / W) = radius with G = sqrt(n_g^2 + (n_g^2 - 1) t^2) and W
    in the same way (Snell's law twice, in tangents). The left side is concave in t: from below,
    Newton's method climbs to the root and never passes it; its slope at 0 gives such a lower
    bound. The start t / sqrt(1 - c t^2) from that bound t is exact to third order, and for one
    layer exact.

    Args:
        radius: distance of the point from the normal through the pupil, > 0.
        water: its distance from the outer glass, > 0.
        port: (7,).

    Returns:
        NaN where no light reaches the pupil.
    """
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    a_glass, b_glass = n_glass * n_glass, n_glass * n_glass - 1.0
    a_water, b_water = n_water * n_water, n_water * n_water - 1.0
    if air == 0.0:
        reach = glass / math.sqrt(b_glass) if b_glass > 0.0 else math.inf
        if glass == 0.0:
            reach = 0.0
        reach += water / math.sqrt(b_water) if b_water > 0.0 else math.inf
        if not radius < reach:
            return math.nan
    flat = air + glass / n_glass + water / n_water
    low = radius / flat
    bend = (glass * b_glass / n_glass**3 + water * b_water / n_water**3) / flat
    tangent: float = low / math.sqrt(max(1.0 - bend * low * low, _MIN_ROOT))
    for _ in range(_NEWTON_STEPS):
        t2 = tangent * tangent
        by_glass = 1.0 / math.sqrt(a_glass + b_glass * t2)
        by_water = 1.0 / math.sqrt(a_water + b_water * t2)
        to_glass, to_water = glass * by_glass, water * by_water
        slope = air + to_glass * a_glass * by_glass**2 + to_water * a_water * by_water**2
        step = (tangent * (air + to_glass + to_water) - radius) / slope
        tangent = max(tangent - step, low)
        if abs(step) <= _SETTLED * tangent:
            return tangent
    return math.nan


@compiled_ieee
def _air_tangents(radius: Array, water: Array, port: Array, tangent: Array, step: Array) -> None:
    """Three steps of `air_tangent` for a block of points, without branches.

    Args:
        radius: (B,) as there, or 0.
        water: (B,) as there; where it is not positive the results mean nothing.
        port: (7,).
        tangent: (B,) to be filled in.
        step: (B,) to be filled in: the last step.
    """
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    a_glass, b_glass = n_glass * n_glass, n_glass * n_glass - 1.0
    a_water, b_water = n_water * n_water, n_water * n_water - 1.0
    flat_glass, flat_water = glass / n_glass, 1.0 / n_water
    bend_glass, bend_water = flat_glass * b_glass / a_glass, flat_water * b_water / a_water
    for j in range(len(radius)):
        flat = air + flat_glass + flat_water * water[j]
        low = radius[j] / flat
        bend = (bend_glass + bend_water * water[j]) / flat
        t = low / math.sqrt(max(1.0 - bend * low * low, _MIN_ROOT))
        last = 0.0
        for _ in range(3):
            t2 = t * t
            by_glass = 1.0 / math.sqrt(a_glass + b_glass * t2)
            by_water = 1.0 / math.sqrt(a_water + b_water * t2)
            to_glass, to_water = glass * by_glass, water[j] * by_water
            slope = air + to_glass * a_glass * by_glass**2 + to_water * a_water * by_water**2
            last = (t * (air + to_glass + to_water) - radius[j]) / slope
            t = max(t - last, low)
        tangent[j] = t
        step[j] = last


@compiled_ieee
def flat_rays(points: Array, port: Array, rays: Array, turns: Array) -> None:
    """Rays in air of points in water (B, 3).

    Args:
        points: (B, 3).
        port: (7,).
        rays: (B, 3) to be filled in; NaN without one.
        turns: (B,) to be filled in for `flat_slopes`: tangent in air over the radius.
    """
    count = len(points)
    before, nx, ny, nz = port[0] + port[1], port[4], port[5], port[6]
    radius, water = np.empty(count), np.empty(count)
    tangent, step = np.empty(count), np.empty(count)
    for j in range(count):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        along = nx * x + ny * y + nz * z
        rx, ry, rz = x - along * nx, y - along * ny, z - along * nz
        radius[j], water[j] = math.sqrt(rx * rx + ry * ry + rz * rz), along - before
    _air_tangents(radius, water, port, tangent, step)
    for j in range(count):
        rays[j, 0] = rays[j, 1] = rays[j, 2] = math.nan
        if not water[j] > 0.0:
            continue
        if not abs(step[j]) <= _SETTLED * tangent[j]:
            tangent[j] = air_tangent(radius[j], water[j], port)
        if radius[j] > 0.0:
            turn = tangent[j] / radius[j]
        else:
            turn = 1.0 / (port[0] + port[1] / port[2] + water[j] / port[3])
        turns[j] = turn
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        along = nx * x + ny * y + nz * z
        rays[j, 0] = (x - along * nx) * turn + nx
        rays[j, 1] = (y - along * ny) * turn + ny
        rays[j, 2] = (z - along * nz) * turn + nz


@compiled_ieee
def flat_leave(rays: Array, port: Array, points: Array, directions: Array) -> None:
    """Points on the outer glass and unit directions in water of unit rays in air, (B, 3) each."""
    air, glass, n_glass, n_water, nx, ny, nz = port
    for j in range(len(rays)):
        dx, dy, dz = rays[j, 0], rays[j, 1], rays[j, 2]
        cos_air = dx * nx + dy * ny + dz * nz
        if not cos_air > 0.0:
            points[j, 0] = points[j, 1] = points[j, 2] = math.nan
            directions[j, 0] = directions[j, 1] = directions[j, 2] = math.nan
            continue
        sin2 = 1.0 - cos_air * cos_air
        cos_glass = math.sqrt(1.0 - sin2 / (n_glass * n_glass))
        cos_water = math.sqrt(1.0 - sin2 / (n_water * n_water))
        # Both spans lie in the plane of the air's ray and the normal.
        in_glass = glass / cos_glass
        by_ray = air / cos_air + in_glass / n_glass
        by_normal = in_glass * (cos_glass - cos_air / n_glass)
        points[j, 0] = by_ray * dx + by_normal * nx
        points[j, 1] = by_ray * dy + by_normal * ny
        points[j, 2] = by_ray * dz + by_normal * nz
        bend = cos_water - cos_air / n_water
        directions[j, 0] = dx / n_water + bend * nx
        directions[j, 1] = dy / n_water + bend * ny
        directions[j, 2] = dz / n_water + bend * nz


@compiled_ieee
def flat_slopes(
    points: Array, turns: Array, port: Array, by_ray: Array, by_point: Array, by_port: Array
) -> None:
    """Slopes of pixels by the point and the port, from those by the ray in air.

    With n the normal, h = n . p, w = p - h n = r e and t(r, h) the tangent in air, the ray is
    D = (t / r) w + n. Slopes of t follow from the implicit equation that `air_tangent` solves;
    those of D by the chain rule, written so that r may be 0 (t is odd in r).

    Args:
        points: (B, 3).
        turns: (B,) their tangents over the radius, of `flat_rays`.
        port: (7,).
        by_ray: (B, 2, 3) slopes of the pixels by the rays.
        by_point: (B, 2, 3) to be filled in.
        by_port: (B, 2, 6) to be filled in.
    """
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    nx, ny, nz = port[4], port[5], port[6]
    for j in range(len(points)):
        px, py, pz, turn = points[j, 0], points[j, 1], points[j, 2], turns[j]
        along = nx * px + ny * py + nz * pz
        water = along - air - glass
        ex, ey, ez = px - along * nx, py - along * ny, pz - along * nz
        radius = math.sqrt(ex * ex + ey * ey + ez * ez)
        tangent = turn * radius
        if radius > 0.0:
            ex, ey, ez = ex / radius, ey / radius, ez / radius
        t2 = tangent * tangent
        root_glass = math.sqrt(n_glass * n_glass + (n_glass * n_glass - 1.0) * t2)
        root_water = math.sqrt(n_water * n_water + (n_water * n_water - 1.0) * t2)
        glass3, water3 = root_glass**3, root_water**3
        steep = air + glass * n_glass * n_glass / glass3 + water * n_water * n_water / water3
        # Slopes of the tangent, which move D along e.
        by_r, by_h = 1.0 / steep, -tangent / (root_water * steep)
        bend = by_r - turn
        by_air = (tangent / root_water - tangent) / steep
        by_glass = (tangent / root_water - tangent / root_glass) / steep
        by_n_glass = tangent * glass * n_glass * (1.0 + t2) / (glass3 * steep)
        by_n_water = tangent * water * n_water * (1.0 + t2) / (water3 * steep)
        for row in range(2):
            gx, gy, gz = by_ray[j, row, 0], by_ray[j, row, 1], by_ray[j, row, 2]
            g_e, g_n = gx * ex + gy * ey + gz * ez, gx * nx + gy * ny + gz * nz
            by_e, by_n = g_e * bend, g_e * by_h - turn * g_n
            by_point[j, row, 0] = by_e * ex + by_n * nx + turn * gx
            by_point[j, row, 1] = by_e * ey + by_n * ny + turn * gy
            by_point[j, row, 2] = by_e * ez + by_n * nz + turn * gz
            by_port[j, row, 0] = g_e * by_air
            by_port[j, row, 1] = g_e * by_glass
            by_port[j, row, 2] = g_e * by_n_glass
            by_port[j, row, 3] = g_e * by_n_water
            for i in range(2):  # n moves by dn = (1, 0, -nx / nz) or (0, 1, -ny / nz)
                down = -(nx if i == 0 else ny) / nz
                p_dn = (px if i == 0 else py) + pz * down
                e_dn = (ex if i == 0 else ey) + ez * down
                g_dn = (gx if i == 0 else gy) + gz * down
                outward = by_h * p_dn - bend * along * e_dn
                by_port[j, row, 4 + i] = (
                    outward * g_e - turn * p_dn * g_n + (1.0 - turn * along) * g_dn
                )
