"""The way as a value: straights, arcs, turns on the spot and sway steps.

What a vehicle does at each leg, by what its fields say:

- straight (`length_m` > 0, all else 0): it goes ahead along its course at the plan's speed. It
  stops at the leg's end if a turn on the spot or a sway step follows, and starts from rest if one
  came before; otherwise it passes both ends at speed.
- arc (`curvature_per_m` not 0): the same way, on a circle; at most one full turn.
- turn on the spot (`turn_rad` not 0; length, curvature and side 0): it stands at `start_ne_m`,
  turns by `turn_rad` from `heading_rad` the way its sign says (positive to starboard), and stands
  still again. At most half a turn.
- sway step (`side_rad` exactly +-pi/2 or +-pi; curvature and turn 0): it stands, moves along its
  course at `Costs.sway_mps` with its heading held at `heading_rad + side_rad`, and stands again:
  with +pi/2 it moves to port, with -pi/2 to starboard, with +-pi astern.

`Costs.settle_s` is what each turn on the spot and each sway step takes besides its motion: braking
before, coming to rest after, and speeding up again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array

LegKind = Literal["straight", "arc", "spot", "sway"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Leg:
    """A straight, an arc, a turn on the spot or a sway step.

    The vehicle's heading (`heading_rad + side_rad`) is continuous from leg to leg, but for full
    turns. Its course may change at once where a turn on the spot or a sway step begins or ends:
    there it stops.
    """

    start_ne_m: tuple[float, float]
    heading_rad: float
    """Course of the path at its start, from north."""
    length_m: float
    """0 of a turn on the spot."""
    curvature_per_m: float = 0.0
    """Positive to starboard."""
    line: int = -1
    """Index of the plan's line, or -1 between lines."""
    turn_rad: float = 0.0
    """How far the vehicle turns on the spot, positive to starboard; 0 of all other legs."""
    side_rad: float = 0.0
    """The vehicle's heading minus the course: 0 ahead, +-pi/2 or +-pi in a sway step."""

    @property
    def kind(self) -> LegKind:
        """Which of the four it is."""
        if self.turn_rad:
            return "spot"
        if self.side_rad:
            return "sway"
        return "arc" if self.curvature_per_m else "straight"

    def places(self, along_m: Array) -> Array:
        """Where the path is, (N, 2) north and east, after distances (N,) from the leg's start."""
        return _places(np.array([self._start]), along_m)

    @property
    def _start(self) -> tuple[float, float, float, float]:
        return (*self.start_ne_m, self.heading_rad, self.curvature_per_m)

    @property
    def end_ne_m(self) -> tuple[float, float]:
        """Place where the leg ends."""
        half = self.curvature_per_m * self.length_m / 2
        chord = self.length_m if half == 0.0 else self.length_m * math.sin(half) / half
        mean = self.heading_rad + half
        north, east = self.start_ne_m
        return north + chord * math.cos(mean), east + chord * math.sin(mean)

    @property
    def end_heading_rad(self) -> float:
        """Course of the path at its end."""
        return self.heading_rad + self.curvature_per_m * self.length_m + self.turn_rad


def _places(begins: Array, along_m: Array) -> Array:
    """Places (N, 2) after distances (N,) along legs.

    Args:
        begins: (N, 4) or (1, 4) north, east, heading and curvature where each leg starts.
        along_m: from there.
    """
    heading, k = begins[:, 2], begins[:, 3]
    turned = heading + k * along_m / 2
    # The chord of an arc points along its mean heading and is sinc(half the angle) as long.
    chord = along_m * np.sinc(k * along_m / 2 / math.pi)
    ne: Array = begins[:, :2] + chord[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    return ne


def places_on(legs: Sequence[Leg], of: NDArray[np.intp], along_m: Array) -> Array:
    """Where legs are, (N, 2), after distances (N,) along those of indices (N,)."""
    return _places(np.array([leg._start for leg in legs]).reshape(-1, 4)[of], along_m)


@dataclass(frozen=True, kw_only=True)
class Route:
    """Legs that follow one another without a gap. Places are of the left port's glass."""

    legs: tuple[Leg, ...]

    @cached_property
    def starts_m(self) -> Array:
        """(L + 1,) distance along the route at which each leg starts, and the whole length."""
        return np.concatenate([[0.0], np.cumsum([leg.length_m for leg in self.legs])])

    @property
    def length_m(self) -> float:
        """Length of all legs."""
        return float(self.starts_m[-1])

    def places(self, along_m: Array) -> Array:
        """Where the route is, (N, 2), at distances (N,); it goes on straight beyond its ends."""
        starts = self.starts_m
        index = np.clip(np.searchsorted(starts, along_m, side="right") - 1, 0, len(self.legs) - 1)
        return places_on(self.legs, index, along_m - starts[index])
