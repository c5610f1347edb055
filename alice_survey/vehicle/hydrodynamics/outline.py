"""A body of revolution along x: straight lines between stations, so that integrals are exact."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from alice_survey.base.errors import VehicleError
from alice_survey.base.frames import Array

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


class Strips(NamedTuple):
    """Places along an outline with weights: `sum(weight * f(x, r))` is the integral of f over x.

    With 4 Gauss points a segment it is exact for polynomials in x up to the 7th degree.
    """

    x_m: Array
    radius_m: Array
    weight_m: Array


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Radius r(x) of a body of revolution, from its tail to its nose."""

    x_m: tuple[float, ...]
    """Stations, increasing towards the nose."""
    radius_m: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.x_m) != len(self.radius_m) or len(self.x_m) < 2:
            raise VehicleError(
                f"an outline has {len(self.x_m)} stations and {len(self.radius_m)} radii: it "
                "needs as many of both, 2 or more"
            )
        if np.any(np.diff(self.x_m) < 0):
            raise VehicleError("the stations of an outline must go from the tail to the nose")
        if min(self.radius_m) < 0 or max(self.radius_m) <= 0:
            raise VehicleError("the radii of an outline must not be negative, nor all zero")

    @property
    def tail_x_m(self) -> float:
        """The x of its aft end."""
        return self.x_m[0]

    @property
    def nose_x_m(self) -> float:
        """The x of its fore end."""
        return self.x_m[-1]

    @property
    def length_m(self) -> float:
        """Length from end to end."""
        return self.x_m[-1] - self.x_m[0]

    @property
    def diameter_m(self) -> float:
        """Greatest diameter."""
        return 2.0 * max(self.radius_m)

    def radius_at(self, x_m: Array) -> Array:
        """r(x), metres, zero beyond the ends."""
        return np.interp(x_m, self.x_m, self.radius_m, left=0.0, right=0.0)

    def strips(self, breaks_m: tuple[float, ...] = ()) -> Strips:
        """Places to integrate at; segments are also cut at x = 0, for |x|, and at given places."""
        inner = [b for b in (0.0, *breaks_m) if self.tail_x_m < b < self.nose_x_m]
        knots = np.unique([*self.x_m, *inner])
        half, middle = np.diff(knots) / 2.0, (knots[1:] + knots[:-1]) / 2.0
        x = (middle[:, None] + half[:, None] * _NODES).ravel()
        return Strips(x, self.radius_at(x), (half[:, None] * _WEIGHTS).ravel())

    @cached_property
    def volume_m3(self) -> float:
        """Volume inside the outline."""
        _, r, w = self.strips()
        return float(np.pi * np.sum(w * r**2))

    @cached_property
    def volume_x_m(self) -> float:
        """The x of the centre of the volume."""
        x, r, w = self.strips()
        return float(np.pi * np.sum(w * r**2 * x) / self.volume_m3)

    @cached_property
    def side_area_m2(self) -> float:
        """Area of the silhouette seen from the side."""
        _, r, w = self.strips()
        return float(2.0 * np.sum(w * r))

    @cached_property
    def side_fullness(self) -> float:
        """Silhouette over length times diameter: 1 of a cylinder with flat ends."""
        return self.side_area_m2 / (self.length_m * self.diameter_m)

    @property
    def frontal_area_m2(self) -> float:
        """Area of the largest section."""
        return math.pi * self.diameter_m**2 / 4.0

    @cached_property
    def wetted_area_m2(self) -> float:
        """Area of the surface: frustums of cones, and flat ends if it has any."""
        x, r = np.array(self.x_m), np.array(self.radius_m)
        sides = np.sum((r[1:] + r[:-1]) * np.hypot(np.diff(x), np.diff(r)))
        return float(np.pi * (sides + r[0] ** 2 + r[-1] ** 2))

    def moved(self, by_m: float) -> "Outline":
        """The same shape, further forward."""
        return Outline(x_m=tuple(x + by_m for x in self.x_m), radius_m=self.radius_m)

    def stretched(self, tail_x_m: float, nose_x_m: float) -> "Outline":
        """The same radii on stations spread evenly to other ends."""
        scale = (nose_x_m - tail_x_m) / self.length_m
        return Outline(
            x_m=(*(tail_x_m + scale * (x - self.tail_x_m) for x in self.x_m[:-1]), nose_x_m),
            radius_m=self.radius_m,
        )
