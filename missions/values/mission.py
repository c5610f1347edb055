"""A mission as a vehicle's own software reads it from a file."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from alice_survey.core.frames import Array, Datum

Autopilot = Literal["cola2", "ardusub"]
"""Software of vehicles that follows missions."""
Manoeuvre = Literal["goto", "section", "keep", "anchor"]
"""goto: to a place from wherever the vehicle is. section: along the straight from a place to
another. keep: hold a place and a heading. anchor: stay about a place, facing it."""
Heave = Literal["depth", "altitude", "both"]
"""Both: by altitude where there is one, else by depth."""


@dataclass(frozen=True, kw_only=True)
class MissionStep:
    """One manoeuvre. Places are of the vehicle's reference point."""

    manoeuvre: Manoeuvre
    latitude_deg: float
    """Latitude where it ends, as `longitude_deg`."""
    longitude_deg: float
    start_deg: tuple[float, float] | None = None
    """Latitude and longitude where a section begins."""
    heave: Heave
    depth_m: float = math.nan
    """Below the surface; NaN where it is by altitude alone."""
    altitude_m: float = math.nan
    """Of the altimeter above the sea floor; NaN where it is by depth alone."""
    speed_mps: float
    tolerance_m: float = math.nan
    """How near to its end it is done; NaN where the file leaves it to the vehicle."""
    hold_s: float = 0.0
    """How long to stay there."""
    heading_rad: float = math.nan
    """Heading to hold; NaN where it follows from the way."""
    camera: Literal["on", "off"] | None = None
    """What pictures are switched to when it is done."""
    picture_step_m: float = math.nan
    """Distance from picture to picture from there on; NaN where the trigger controller decides."""


@dataclass(frozen=True, kw_only=True)
class Mission:
    """Steps in the order of flight."""

    autopilot: Autopilot
    """Software that the file is for."""
    steps: tuple[MissionStep, ...]

    def ends_ne(self, datum: Datum) -> Array:
        """Where steps end, (N, 2) metres north and east of a datum."""
        return self._local_ne(datum, [(s.latitude_deg, s.longitude_deg) for s in self.steps])

    def starts_ne(self, datum: Datum) -> Array:
        """Where sections begin, (N, 2) metres north and east of a datum; NaN of other steps."""
        nowhere = (math.nan, math.nan)
        return self._local_ne(datum, [step.start_deg or nowhere for step in self.steps])

    def _local_ne(self, datum: Datum, places_deg: list[tuple[float, float]]) -> Array:
        depths = np.nan_to_num([step.depth_m for step in self.steps])
        geodetic = np.column_stack([np.reshape(places_deg, (-1, 2)), depths])
        result = np.full((len(places_deg), 2), np.nan)
        known = np.isfinite(geodetic).all(axis=1)
        if known.any():
            result[known] = datum.ned_from_geodetic(geodetic[known])[:, :2]
        return result
