"""Extent of a vehicle's hull from its origin, for keeping it off sea floor and zones."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import ConfigDict

from alice_survey.core.frames import Array


@dataclass(frozen=True, kw_only=True)
class Hull:
    """The reach of a hull; metres in the body, from the centre of buoyancy.

    What hangs below it, DVL and ports, is placed by a survey's settings.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    profile_body_m: tuple[tuple[float, float, float], ...]
    """Points in the plane of symmetry, from the nose along the keel to the tail, between which the
    lower side of the hull runs straight or inside."""
    half_breadth_m: float
    """Half width to the outer edge of attachments on either side."""

    @property
    def nose_m(self) -> float:
        """Extent ahead of the origin."""
        return max(point[0] for point in self.profile_body_m)

    @property
    def tail_m(self) -> float:
        """Extent astern of the origin."""
        return -min(point[0] for point in self.profile_body_m)

    @cached_property
    def points_body_m(self) -> Array:
        """(P, 3) the profile, for compiled code."""
        return np.array(self.profile_body_m, dtype=np.float64)


POINT = Hull(profile_body_m=((0.0, 0.0, 0.0),), half_breadth_m=0.0)
"""Hull of a vehicle whose shape is not given."""
