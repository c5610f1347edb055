"""What all lenses have: focal lengths and a centre."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

from pydantic import ConfigDict

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array

FOCAL_AND_CENTRE = ("fx_px", "fy_px", "cx_px", "cy_px")
MAX_PX = 1e7
"""Largest size of a picture, and largest focal length."""


@dataclass(frozen=True, kw_only=True)
class OpticalPart:
    """What a lens and a port have: finite values, some of which can be calibrated."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

    parameters: ClassVar[tuple[str, ...]]
    """Names of its parameters, ordered as its slopes."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
                raise CalibrationError(f"camera: {field.name} = {value} is not finite")

    def parameter(self, name: str) -> float:
        """The value of one of `parameters`."""
        return float(getattr(self, name))

    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """The same part with some parameters set to other values."""
        return replace(self, **{name: float(value) for name, value in values.items()})


@dataclass(frozen=True, kw_only=True)
class LensValues(OpticalPart, ABC):
    """A lens in air: rays of any length to pixels and back, by the kernels of its file."""

    model: ClassVar[str]
    """Its name in files."""

    falloff: ClassVar[float] = 4.0
    """Power of the cosine off the axis with which its pictures darken."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.fx_px, self.fy_px) <= 0:
            raise CalibrationError("camera: width_px, height_px, fx_px and fy_px must be positive")
        if max(self.fx_px, self.fy_px) > MAX_PX:
            raise CalibrationError(f"camera: a size or focal length exceeds {MAX_PX:g} px")

    @property
    @abstractmethod
    def values(self) -> Array:
        """Its parameters, and what else its kernels need."""

    def downscale(self, scale: float) -> Self:
        """The same lens with pixels `scale` times as large."""
        return replace(self, **{name: getattr(self, name) / scale for name in FOCAL_AND_CENTRE})
