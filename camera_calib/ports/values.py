"""What all ports have: the water behind them, and where they end."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import ConfigDict

from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array

Vector = tuple[float, float, float]
GLASS_AND_WATER: Mapping[str, tuple[float, float]] = {
    "glass_thickness_m": (0.0, 10.0),
    "n_glass": (1.0, 3.0),
    "n_water": (1.0, 2.0),
}
"""Least and largest values of what every port with glass has."""
N_WATER_SPREAD = 0.005
"""Standard deviation of the index of water about which nothing is known."""


@dataclass(frozen=True, kw_only=True)
class PortValues(ABC):
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
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Least and largest values; the wall of a tank may be some metres away."""
    places: ClassVar[tuple[str, ...]] = ()
    """Parameters, in metres, that place it before the lens."""
    tilts: ClassVar[tuple[str, ...]] = ()
    """Parameters that tilt it: sines of angles."""
    spreads: ClassVar[Mapping[str, float]] = {}
    """Standard deviations of parameters of a port of which only the kind is known."""
    labels: ClassVar[Mapping[str, str]] = {}
    """What each parameter is, with its value as `{}`; lengths are stated in millimetres."""
    needs_air: ClassVar[bool] = False
    """Whether views under water alone leave its place and the lens's focal length undetermined."""

    trusted_deg: ClassVar[float] = math.inf
    """Full angle of a lens in air up to which it is trusted to be sharp."""

    @classmethod
    @abstractmethod
    def guess(cls) -> Self:
        """A usual one, from which a calibration can start."""

    @classmethod
    @abstractmethod
    def from_design(cls, camera: CameraConfig, n_water: float) -> Self:
        """The port of a design, in water of an index."""

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """The settings of `CameraConfig` that design it; those of other kinds have no meaning."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
                raise CalibrationError(f"camera: {field.name} = {value} is not finite")
            if field.name not in self.ranges:
                continue
            minimum, maximum = self.ranges[field.name]
            if not minimum <= value <= maximum:
                unit = " m" if field.name.endswith("_m") else ""
                raise CalibrationError(
                    f"camera: {field.name} = {value:g}: {minimum:g} to {maximum:g}{unit} allowed"
                )

    @property
    @abstractmethod
    def values(self) -> Array:
        """Its parameters as kernels take them."""

    @property
    @abstractmethod
    def n_water(self) -> float:
        """Index of refraction of the water."""

    @property
    @abstractmethod
    def refracts(self) -> bool:
        """Whether light bends at the port."""

    @property
    @abstractmethod
    def front_cam(self) -> Vector:
        """The foremost point of its outer surface; altitudes are measured from there."""

    @property
    @abstractmethod
    def magnification(self) -> float:
        """How many times smaller small angles about the axis are in water than in air."""

    @property
    def axis_cam(self) -> Vector:
        """Unit vector of the line through the pupil about which the port is symmetric."""
        return 0.0, 0.0, 1.0

    @property
    def by_motion(self) -> Array:
        """(P, 3) changes of the parameters as the port moves by a metre along each axis."""
        return np.zeros((len(self.parameters), 3))

    @abstractmethod
    def clearance(self, points_cam: Array) -> tuple[Array, Array]:
        """Distance (N,) of points (N, 3) beyond the outer surface, and its normals there (N, 3)."""

    @property
    @abstractmethod
    def words(self) -> str:
        """What the port is, in a few words."""

    @property
    def estimated(self) -> tuple[str, ...]:
        """Parameters that a calibration finds; glass and indices are known better."""
        return (*self.places, *self.tilts)

    def minimum(self, name: str) -> float:
        """Least value of a parameter; minus infinity where it has none."""
        return self.ranges.get(name, (-math.inf, math.inf))[0]

    def parameter(self, name: str) -> float:
        """The value of one of `parameters`."""
        return float(getattr(self, name))

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The same port with some parameters set to other values."""
        return replace(self, **{name: float(value) for name, value in values.items()})
