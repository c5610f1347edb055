"""A survey line: a straight run with pictures."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from alice_survey.core.frames import Array

LineKind = Literal["survey", "cross", "closing", "fill", "tie"]
"""survey: of the pattern. cross: across it. closing: back over the start, so that the block's end
is tied to its beginning. fill: what the pattern could not reach."""
LINE_KINDS: tuple[LineKind, ...] = get_args(LineKind)


@dataclass(frozen=True, kw_only=True)
class Line:
    """A straight run at constant speed with pictures at both ends and evenly between.

    Places are of the left port's outer glass.
    """

    kind: LineKind
    start_ne_m: tuple[float, float]
    end_ne_m: tuple[float, float]
    stations: int

    @property
    def length_m(self) -> float:
        """Distance from the first to the last picture."""
        return math.dist(self.start_ne_m, self.end_ne_m)

    @property
    def heading_rad(self) -> float:
        """Direction of travel, clockwise from north, in [0, 2 pi)."""
        north, east = self.end_ne_m[0] - self.start_ne_m[0], self.end_ne_m[1] - self.start_ne_m[1]
        return math.atan2(east, north) % (2 * math.pi)

    @property
    def stations_ne(self) -> Array:
        """Where the pictures are taken, (stations, 2)."""
        t = np.linspace(0.0, 1.0, self.stations)[:, None]
        return np.array(self.start_ne_m) * (1 - t) + np.array(self.end_ne_m) * t

    def offsets_m(self, points_ne: Array) -> Array:
        """How far places (..., 2) are along the line from its start, and to starboard of it."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        found: Array = (points_ne - np.array(self.start_ne_m)) @ np.array([[cos, -sin], [sin, cos]])
        return found

    def reverse(self) -> "Line":
        """The same line flown the other way."""
        return replace(self, start_ne_m=self.end_ne_m, end_ne_m=self.start_ne_m)

    def to_json(self) -> dict[str, Any]:
        """The line as `plan.json` holds it."""
        return {
            "kind": self.kind,
            "start_ne_m": list(self.start_ne_m),
            "end_ne_m": list(self.end_ne_m),
            "heading_deg": round(math.degrees(self.heading_rad), 9) % 360.0,
            "stations": self.stations,
        }
