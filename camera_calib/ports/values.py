"""What all ports have: the water behind them, and where they end."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import numpy as np
from pydantic import ConfigDict

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array

Vector = tuple[float, float, float]
RANGES: Mapping[str, tuple[float, float, str]] = {
    "port_distance_m": (0.0, 100.0, " m"),
    "glass_thickness_m": (0.0, 10.0, " m"),
    "outer_radius_m": (1e-3, 10.0, " m"),
    "n_glass": (1.0, 3.0, ""),
    "n_water": (1.0, 2.0, ""),
}
"""Least and largest values; the wall of a tank may be some metres away."""


def lowest(name: str) -> float:
    """Least value of a parameter of a port; minus infinity where it has none."""
    return RANGES[name][0] if name in RANGES else -math.inf


@dataclass(frozen=True, kw_only=True)
class PortValues:
    """What stands between a lens and the water; rays are straight in the water.

    Axes are the camera's (right, down, forward) with the origin at the entrance pupil.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

    shape: ClassVar[str]
    """Its name in files."""
    kind: ClassVar[int]
    """Its number in kernels."""
    parameters: ClassVar[tuple[str, ...]]
    """Names of its parameters, ordered as its slopes."""
    estimated: ClassVar[tuple[str, ...]]
    """Those that a calibration finds; glass and indices are known better."""
    needs_air: ClassVar[bool] = False
    """Whether views under water alone hardly tell its place from the lens's focal length."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
                raise CalibrationError(f"camera: {field.name} = {value} is not finite")
            least, most, unit = RANGES.get(field.name, (-math.inf, math.inf, ""))
            if field.name in RANGES and not least <= value <= most:
                raise CalibrationError(
                    f"camera: {field.name} = {value:g}: {least:g} to {most:g}{unit} allowed"
                )

    @property
    def values(self) -> Array:
        """Its parameters as kernels take them."""
        raise NotImplementedError

    @property
    def n_water(self) -> float:
        """Index of refraction of the water."""
        raise NotImplementedError

    @property
    def refracts(self) -> bool:
        """Whether light bends at the port."""
        raise NotImplementedError

    @property
    def front_cam(self) -> Vector:
        """The foremost point of its outer surface; altitudes are measured from there."""
        raise NotImplementedError

    @property
    def magnification(self) -> float:
        """How many times smaller small angles about the axis are in water than in air."""
        raise NotImplementedError

    @property
    def axis_cam(self) -> Vector:
        """Unit vector of the line through the pupil about which the port is symmetric."""
        return 0.0, 0.0, 1.0

    @property
    def by_motion(self) -> Array:
        """(P, 3) changes of the parameters as the port moves by a metre along each axis."""
        return np.zeros((len(self.parameters), 3))

    def clearance(self, points_cam: Array) -> tuple[Array, Array]:
        """Distance (N,) of points (N, 3) beyond the outer surface, and its normals there (N, 3)."""
        raise NotImplementedError

    @property
    def words(self) -> str:
        """What the port is, in a few words."""
        raise NotImplementedError

    def parameter(self, name: str) -> float:
        """The value of one of `parameters`."""
        return float(getattr(self, name))

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The same port with some parameters set to other values."""
        return replace(self, **{name: float(value) for name, value in values.items()})
