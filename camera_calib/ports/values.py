"""What all ports have: the water behind them, and where they end."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.lenses.values import OpticalPart

Vector = tuple[float, float, float]
GLASS_AND_WATER: Mapping[str, tuple[float, float]] = {
    "glass_thickness_m": (0.0, 0.5),
    "n_glass": (1.0, 3.0),
    "n_water": (1.0, 2.0),
}
"""Least and largest values of what every port with glass has."""
N_WATER_SPREAD = 0.005
"""Standard deviation of the index of water about which nothing is known."""


@dataclass(frozen=True, kw_only=True)
class PortValues(OpticalPart):
    """What stands between a lens and the water, by itself nothing; rays are straight in the water.

    Axes are the camera's (right, down, forward) with the origin at the entrance pupil.
    """

    shape: ClassVar[str]
    """Its name in files."""
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Least and largest values; the wall of a tank may be some metres away."""
    places: ClassVar[tuple[str, ...]] = ()
    """Parameters, in metres, that place it before the lens."""
    tilts: ClassVar[tuple[str, ...]] = ()
    """Parameters that tilt it: sines of angles."""
    spreads: ClassVar[Mapping[str, float]] = {}
    """Standard deviations of parameters of a port of which only the kind is known."""
    needs_air: ClassVar[bool] = False
    """Whether views under water alone leave its place and the lens's focal length undetermined."""

    trusted_deg: ClassVar[float] = math.inf
    """Full angle of a lens in air up to which it is trusted to be sharp."""

    @classmethod
    def guess(cls) -> Self:
        """A usual one, from which a calibration can start."""
        return cls()

    @classmethod
    def from_design(cls, camera: CameraConfig, n_water: float) -> Self:
        """The port of a design, in water of an index."""
        return cls()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (minimum, maximum) in self.ranges.items():
            value = getattr(self, name)
            if not minimum <= value <= maximum:
                unit = " m" if name.endswith("_m") else ""
                raise CalibrationError(
                    f"camera: {name} = {value:g}: {minimum:g} to {maximum:g}{unit} allowed"
                )

    @cached_property
    def values(self) -> Array:
        """Its parameters as kernels take them."""
        return np.array([self.parameter(name) for name in self.parameters])

    @property
    def n_water(self) -> float:
        """Index of refraction of the water; 1 where nothing is known of what is looked through."""
        return 1.0

    @property
    def refracts(self) -> bool:
        """Whether light bends at the port."""
        return False

    @property
    def front_cam(self) -> Vector:
        """The foremost point of its outer surface; altitudes are measured from there."""
        return 0.0, 0.0, 0.0

    @property
    def magnification(self) -> float:
        """How many times smaller small angles about the axis are in water than in air."""
        return 1.0

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
        return points_cam[:, 2], np.tile(self.axis_cam, (len(points_cam), 1))

    @property
    def words(self) -> str:
        """What the port is, in a few words."""
        return "no port"

    @property
    def estimated(self) -> tuple[str, ...]:
        """Parameters that a calibration finds; glass and indices are known better."""
        return (*self.places, *self.tilts)

    def minimum(self, name: str) -> float:
        """Least value of a parameter; minus infinity where it has none."""
        return self.ranges.get(name, (-math.inf, math.inf))[0]
