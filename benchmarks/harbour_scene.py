"""A harbour in closed form: wall, ladder, ship's hull, pile, boulders, floor, fish and weed.

Metres, NED: the wall's face is about at north 0 and looks south, the floor about at depth 6. Here
are numbers and formulas alone; `harbour_meshes` makes triangles of them for the renderer, and
`harbour_truth` distances for the judge.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array

FLOOR_M = 6.0
WALL_EAST_M = (-3.2, 2.5)
"""The wall ends in a corner in the east; in the west it goes on out of sight."""
WALL_TOP_M = 1.8
STONE_M = (0.52, 0.31)
"""Length and height of the wall's stones."""
JOINT_M = 0.04
"""From the middle of a joint to the flat of a stone."""
_RECESS_M = 0.015
_STEEPEST_WALL, _STEEPEST_FLOOR = 2.0, 0.5


@dataclass(frozen=True, kw_only=True)
class RoundedBox:
    """A box whose edges and corners are parts of cylinders and balls."""

    name: str
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    """Half of its sides along north, east and down, the rounding included."""
    radius_m: float


@dataclass(frozen=True, kw_only=True)
class Upright:
    """A vertical cylinder with flat ends."""

    name: str
    place_ne: tuple[float, float]
    depths: tuple[float, float]
    """Of its upper and lower end."""
    radius_m: float


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """An ellipsoid that is turned about the vertical."""

    name: str
    centre: tuple[float, float, float]
    semi_axes: tuple[float, float, float]
    heading_deg: float = 0.0


Solid = RoundedBox | Upright | Ellipsoid

HULL = RoundedBox(name="hull", centre=(0.5, 4.5, 2.5), half=(1.3, 1.5, 2.5), radius_m=0.9)
PILE = Upright(name="pile", place_ne=(-1.5, -1.7), depths=(1.5, 6.5), radius_m=0.18)
LADDER: tuple[Solid, ...] = (
    *(
        Upright(name="ladder", place_ne=(-0.16, e), depths=(1.5, 5.7), radius_m=0.025)
        for e in (0.6, 1.0)
    ),
    *(
        RoundedBox(
            name="ladder", centre=(-0.16, 0.8, z), half=(0.0175, 0.2, 0.0175), radius_m=0.004
        )
        for z in np.arange(2.0, 5.6, 0.28).round(2).tolist()
    ),
)
_BOULDERS = (
    # north, east, middle above the floor's mean, semi-axes, heading
    (-0.75, 1.75, 0.10, 0.26, 0.20, 0.19, 20.0),
    (-1.45, 0.35, 0.07, 0.17, 0.24, 0.14, 70.0),
    (-2.35, 1.30, 0.12, 0.22, 0.18, 0.17, -30.0),
    (-1.30, 2.60, 0.05, 0.30, 0.24, 0.16, 10.0),
    (-2.95, 2.75, 0.16, 0.20, 0.20, 0.20, 0.0),
    (-2.20, 3.80, 0.10, 0.28, 0.18, 0.18, 45.0),
    (-1.60, 4.90, 0.11, 0.19, 0.25, 0.15, -15.0),
    (-2.90, 0.10, 0.08, 0.15, 0.15, 0.15, 0.0),
)
BOULDERS = tuple(
    Ellipsoid(name="boulder", centre=(n, e, FLOOR_M - up), semi_axes=(a, b, c), heading_deg=turn)
    for n, e, up, a, b, c, turn in _BOULDERS
)
SOLIDS: tuple[Solid, ...] = (HULL, PILE, *LADDER, *BOULDERS)
PARTS = ("floor", "wall", "hull", "pile", "ladder", "boulder")


def floor_depth(north: Array, east: Array) -> Array:
    """Depth of the floor: long swells and ripples; its slope is below 0.5."""
    swell = 0.05 * np.sin(2 * np.pi * north / 2.7 + 0.5) * np.cos(2 * np.pi * east / 3.1)
    bent = 2 * np.pi * (0.8 * north + 0.6 * east) / 0.42 + 0.7 * np.sin(2 * np.pi * east / 1.9)
    depth: Array = FLOOR_M + swell + 0.012 * np.sin(bent)
    return depth


def wall_north(east: Array, depth: Array) -> Array:
    """North of the wall's face: stones of unlike thickness, rough, in courses; slope below 2."""
    length, height = STONE_M
    course = np.floor(depth / height)
    along = east / length + 0.37 * np.mod(course, 2.0)
    stone = np.floor(along)
    hashed = np.modf(np.abs(np.sin(12.9898 * course + 78.233 * stone) * 43758.5453))[0]
    rough = np.sin(2 * np.pi * east / 0.23 + 6 * hashed) * np.sin(2 * np.pi * depth / 0.17)
    proud = 0.024 + 0.018 * hashed + 0.005 * rough
    from_ends = length * (0.5 - np.abs(along - stone - 0.5))
    from_beds = height * (0.5 - np.abs(depth / height - course - 0.5))
    north: Array = _RECESS_M - proud * _smooth(from_ends / JOINT_M) * _smooth(from_beds / JOINT_M)
    return north


def _smooth(t: Array) -> Array:
    t = np.clip(t, 0.0, 1.0)
    step: Array = t * t * (3.0 - 2.0 * t)
    return step


STEEPEST = {"wall": _STEEPEST_WALL, "floor": _STEEPEST_FLOOR}


@dataclass(frozen=True, kw_only=True)
class Fish:
    """A fish as an ellipsoid that swims along an ellipse in front of wall and hull."""

    middle: tuple[float, float, float]
    reach: tuple[float, float, float]
    """Half of its way along north, east and down."""
    period_s: float
    phase: float
    semi_axes: tuple[float, float, float] = (0.17, 0.03, 0.06)

    def place(self, time_s: float) -> Array:
        """(3,) its middle."""
        angle = 2 * np.pi * time_s / self.period_s + self.phase
        way = np.array([np.sin(angle), np.cos(angle), np.sin(2 * angle)])
        place: Array = np.asarray(self.middle) + np.asarray(self.reach) * way
        return place

    def turn(self, time_s: float) -> Rotation:
        """From the fish's axes (forward, right, down) to NED."""
        ahead = self.place(time_s + 1e-3) - self.place(time_s - 1e-3)
        return Rotation.from_euler("Z", np.arctan2(ahead[1], ahead[0]))


FISH = (
    Fish(middle=(-0.8, 1.0, 4.3), reach=(0.3, 1.6, 0.3), period_s=31.0, phase=0.3),
    Fish(middle=(-1.0, 1.2, 5.2), reach=(0.2, 1.8, 0.2), period_s=43.0, phase=2.1),
    Fish(middle=(-1.5, 3.8, 4.4), reach=(0.2, 1.5, 0.4), period_s=37.0, phase=4.4),
    Fish(middle=(-1.9, 2.0, 5.4), reach=(0.7, 2.2, 0.1), period_s=57.0, phase=1.0),
)


@dataclass(frozen=True, kw_only=True)
class Weed:
    """A blade that is held at its foot and sways: its place is a parabola of its height."""

    foot_ne: tuple[float, float]
    length_m: float
    phase: float
    half_width_m: float = 0.012
    half_thickness_m: float = 0.0015
    period_s: float = 6.3

    def lean(self, share: Array, time_s: float) -> Array:
        """(N, 2) north and east of its middle line from its foot, at shares of its length."""
        angle = 2 * np.pi * time_s / self.period_s + self.phase - 1.5 * share
        sway = 0.35 * self.length_m * share**2
        return np.stack([0.6 * sway * np.cos(angle), sway * np.sin(angle)], axis=-1)

    def line(self, share: Array, time_s: float) -> Array:
        """(N, 3) its middle line."""
        north, east = self.foot_ne
        foot = float(floor_depth(np.array(north), np.array(east)))
        at = np.column_stack([self.lean(share, time_s), -self.length_m * share])
        line: Array = at + np.array([north, east, foot])
        return line


WEEDS = tuple(
    Weed(
        foot_ne=(n + 0.05 * np.cos(2.4 * k), e + 0.05 * np.sin(2.4 * k)),
        length_m=0.35 + 0.03 * k,
        phase=0.5 * k + n,
    )
    for n, e in ((-1.9, 0.9), (-0.5, 2.1), (-2.5, 3.2))
    for k in range(8)
)
