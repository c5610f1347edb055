"""Shapes of SPARUS II and ALICE, from which the coefficients are computed.

Body frame: x forward, y starboard, z down, origin at the centre of buoyancy, where the vertical
thruster sits (paper, section II). Sources:

- "model": the public model of SPARUS II in Stonefish, stonefish_ros, data/scenarios/sparus2.scn
  and the vertices of data/sparus2/*_phy.obj, whose x = 0 is the vertical thruster.
- "paper": Gutnik, Avni, Treibitz and Groper (2021). Its figure of dimensions is not legible; what
  its tables imply is named "inferred", with the rows it follows from.

Water inside, by one rule for every set of coefficients, counts to the rigid body's inertia and not
to its weight (its weight and its buoyancy cancel); added mass is that of the water outside.

The paper's wet sections are the nose and the tail. How far they reach is not published, but it
follows: dry vehicle and water fill the envelope together, and what the dry vehicle displaces has
its centre at the body's origin, the centre of buoyancy. Water is taken to fill the hull from a
bulkhead to either end, and the two bulkheads are where both conditions hold. (In truth the parts in
the wet sections displace some of it, and the sections reach a little further.)
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict

from alice_survey.core.errors import VehicleError
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

    def shift(self, by_m: float) -> "Outline":
        """The same shape, further forward."""
        return Outline(x_m=tuple(x + by_m for x in self.x_m), radius_m=self.radius_m)

    def stretch(self, tail_x_m: float, nose_x_m: float) -> "Outline":
        """The same radii on stations spread evenly to other ends."""
        scale = (nose_x_m - tail_x_m) / self.length_m
        return Outline(
            x_m=(*(tail_x_m + scale * (x - self.tail_x_m) for x in self.x_m[:-1]), nose_x_m),
            radius_m=self.radius_m,
        )


@dataclass(frozen=True, kw_only=True)
class Mast:
    """The mast: an upright strut of elliptic section on top of the hull."""

    x_m: float
    """Position of its middle."""
    chord_m: float
    """Chord along x; c_m in the paper."""
    width_m: float
    """Width across; w_m in the paper."""
    root_z_m: float
    """Height at which it leaves the hull; z points down."""
    height_m: float
    """Height, h_m in the paper."""

    @property
    def middle_z_m(self) -> float:
        """Mid-height: -(d_h + h_m) / 2 in the paper."""
        return self.root_z_m - self.height_m / 2.0

    @property
    def volume_m3(self) -> float:
        """Volume of the elliptic cylinder."""
        return math.pi / 4.0 * self.chord_m * self.width_m * self.height_m


@dataclass(frozen=True, kw_only=True)
class Pod:
    """A horizontal thruster: a motor body that carries the nozzle; two, mirrored."""

    outline: Outline
    """Outline from outside, nozzle included."""
    body_diameter_m: float
    """Diameter of the motor body without the nozzle; d_th in the paper."""
    y_m: float
    """Distance of its axis from the middle plane."""

    @property
    def body_volume_m3(self) -> float:
        """Solid volume: the motor body as a cylinder; the nozzle is open."""
        return math.pi / 4.0 * self.body_diameter_m**2 * self.outline.length_m


@dataclass(frozen=True, kw_only=True)
class PodArm:
    """The arm between hull and pod, on either side, at z = 0."""

    aft_x_m: float
    fore_x_m: float
    tip_y_m: float
    """Place where it meets the pod's body: the span b of the finned section."""
    thickness_m: float

    @property
    def chord_m(self) -> float:
        """Chord along x."""
        return self.fore_x_m - self.aft_x_m


@dataclass(frozen=True, kw_only=True)
class Tunnel:
    """A thruster's tunnel through the hull."""

    name: str
    x_m: float
    axis: Literal["y", "z"]
    diameter_m: float


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Geometry from which the coefficients are computed."""

    name: str
    outline: Outline
    mast: Mast
    pod: Pod
    mount: PodArm
    tunnels: tuple[Tunnel, ...]

    @cached_property
    def hull(self) -> Hull:
        """Extent of hull and pods, to the millimetre."""
        x, radius = np.array(self.outline.x_m), np.array(self.outline.radius_m)
        keel = x[radius == radius.max()]
        deepest = float(radius.max())
        profile = (
            (self.outline.nose_x_m, 0.0), (float(keel.max()), deepest), (0.0, deepest),
            (float(keel.min()), deepest), (self.outline.tail_x_m, 0.0),
        )  # fmt: skip
        return Hull(
            profile_body_m=tuple((round(ahead, 3), 0.0, round(down, 3)) for ahead, down in profile),
            half_breadth_m=round(self.pod.y_m + max(self.pod.outline.radius_m), 3),
        )

    @cached_property
    def envelope_volume_m3(self) -> float:
        """Volume of hull, mast and pods, water inside the hull included."""
        return self.outline.volume_m3 + self.mast.volume_m3 + 2.0 * self.pod.body_volume_m3

    @cached_property
    def envelope_x_m(self) -> float:
        """The x of the centre of the envelope."""
        pods = 2.0 * self.pod.body_volume_m3
        moment = (
            self.outline.volume_m3 * self.outline.volume_x_m
            + self.mast.volume_m3 * self.mast.x_m
            + pods * self.pod.outline.volume_x_m
        )
        return moment / self.envelope_volume_m3


T200_DIAMETER_M, T200_LENGTH_M, SHELL_M = 0.100, 0.113, 0.003
"""Space that a Blue Robotics T200 takes inside the hull: across its nozzle, and along its axis with
the motor (inferred: outer sizes rounded); thickness of the hull around it (model)."""


def farthest_tunnel_x(outline: Outline, end: Literal["bow", "stern"]) -> float:
    """Farthest x at which a hull still holds a lateral thruster.

    The rule: the thruster, a cylinder lying athwartships at z = 0, stays inside the outline minus
    the shell: r(x + R cos a) - shell >= hypot(L / 2, R sin a) all around its rims.

    Args:
        outline: outline of the hull, wide enough for the thruster where it is widest.
        end: end of the hull.

    Returns:
        x of the thruster's axis, metres.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    radius = T200_DIAMETER_M / 2.0
    needed = np.hypot(T200_LENGTH_M / 2.0, radius * np.sin(angle)) + SHELL_M
    radii = np.array(outline.radius_m)
    inside = float(np.mean(np.array(outline.x_m)[radii == radii.max()]))
    outside = outline.nose_x_m if end == "bow" else outline.tail_x_m
    for _ in range(60):
        middle = (inside + outside) / 2.0
        fits = bool(np.all(outline.radius_at(middle + radius * np.cos(angle)) >= needed))
        inside, outside = (middle, outside) if fits else (inside, middle)
    return inside


_SPARUS2_HULL = Outline(
    x_m=(
        -0.734154, -0.722134, -0.706948, -0.676643, -0.623930, -0.555016, -0.500000,
        0.764586, 0.784872, 0.805726, 0.823562, 0.840801, 0.850143, 0.854092, 0.854530,
    ),
    radius_m=(
        0.0, 0.017104, 0.031838, 0.053842, 0.081666, 0.106123, 0.115000,
        0.115000, 0.112172, 0.105355, 0.093810, 0.072545, 0.047782, 0.012134, 0.0,
    ),
)  # fmt: skip
"""Radii of the rings of vertices of hull_phy.obj (model): 1.589 m by 0.230 m, as the paper states
for SPARUS II. A blunt nose of 0.09 m, a cylinder, a tail that tapers over 0.234 m."""

_POD = Outline(
    x_m=(
        -0.611691, -0.565670, -0.557542, -0.412740, -0.396122, -0.383270, -0.376656,
    ),
    radius_m=(0.052104, 0.059550, 0.033483, 0.033744, 0.031560, 0.021695, 0.0),
)  # fmt: skip
"""Rings of thruster_phy.obj (model): a motor body of 0.067 m, a nozzle of 0.119 m around its
end."""

SPARUS2 = Geometry(
    name="sparus2",
    outline=_SPARUS2_HULL,
    # antenna_phy.obj (model): x -0.4263 to -0.3496, y +/-0.0198, top at z = -0.368.
    mast=Mast(x_m=-0.388, chord_m=0.0767, width_m=0.0395, root_z_m=-0.115, height_m=0.253),
    pod=Pod(outline=_POD, body_diameter_m=0.067, y_m=0.166883),
    # thruster_phy.obj (model): the arm's root runs from x = -0.515 to -0.346, its tip from -0.514
    # to -0.380; their mean. z +/-0.0188.
    mount=PodArm(aft_x_m=-0.515, fore_x_m=-0.363, tip_y_m=0.1335, thickness_m=0.0375),
    # The propeller's diameter (model); the tunnel's own is not published.
    tunnels=(Tunnel(name="vertical", x_m=0.0, axis="z", diameter_m=0.08),),
)

_ALICE_HULL = _SPARUS2_HULL.stretch(-0.90, 1.06)
"""Inferred. The paper states 1.6 m, but its tables hold for 1.96 m only: Y_uv = -39.71 gives
l_h / d_h = 8.52, and M_uw = -8.498 gives x_cp = -0.214 and so x_n = 1.06. Both ends of ALICE were
rebuilt (a nose with camera and thruster, "completely redesigned" tail), so that the shape of the
ends is SPARUS II's stretched with the whole. With the ends of SPARUS II unstretched on a longer
cylinder Y_vv of the hull would be 1.4 % above the paper's, as it is 0.2 %."""

_ENDS: tuple[Literal["bow", "stern"], ...] = ("bow", "stern")
_MOVED_M = -0.472 - SPARUS2.mast.x_m
"""Inferred. N_pdot / K_vdot = -0.102 / 0.216 puts the mast at x = -0.472; its neighbours on the
tail section, the pods, are taken to have moved with it."""

ALICE = Geometry(
    name="alice",
    outline=_ALICE_HULL,
    mast=replace(SPARUS2.mast, x_m=-0.472),
    pod=replace(SPARUS2.pod, outline=_POD.shift(_MOVED_M)),
    mount=replace(
        SPARUS2.mount,
        aft_x_m=SPARUS2.mount.aft_x_m + _MOVED_M,
        fore_x_m=SPARUS2.mount.fore_x_m + _MOVED_M,
    ),
    # "At the farthest possible distance" (paper, section III.A); T200 propellers of 0.076 m.
    tunnels=(
        *SPARUS2.tunnels,
        *(
            Tunnel(
                name=end,
                x_m=round(farthest_tunnel_x(_ALICE_HULL, end), 3),
                axis="y",
                diameter_m=0.076,
            )
            for end in _ENDS
        ),
    ),
)


_EXACT_M = 1e-12
_MAX_STEPS = 200


@dataclass(frozen=True, kw_only=True)
class Entrained:
    """Water inside the hull."""

    mass_kg: float
    x_m: float
    """Position of its centre, from the centre of buoyancy."""
    inertia_kg_m2: tuple[float, float, float]
    """Inertia about its own centre: roll, pitch, yaw."""
    nose_from_x_m: float
    """Bulkhead from which water fills the nose."""
    tail_to_x_m: float
    """Bulkhead up to which water fills the tail."""


def entrained_water(geometry: Geometry, buoyancy_kg: float, density: float) -> Entrained:
    """Water in the nose and tail sections.

    Args:
        geometry: the vehicle.
        buoyancy_kg: mass of the water that the drained vehicle displaces.
        density: density of the water, kg/m^3.

    Raises:
        VehicleError: the envelope has no room for it, or the bulkheads would cross.
    """
    water_m3 = geometry.envelope_volume_m3 - buoyancy_kg / density
    if water_m3 < 0:
        raise VehicleError(
            f"{geometry.name} displaces {buoyancy_kg:g} kg but its envelope holds "
            f"{density * geometry.envelope_volume_m3:.1f} kg: give a larger hull or less buoyancy"
        )
    outline = geometry.outline
    moment = geometry.envelope_volume_m3 * geometry.envelope_x_m

    def tail_bulkhead(nose_x: float) -> float:
        left = water_m3 - _moments(outline, nose_x, outline.nose_x_m)[0]
        if left <= 0:
            return outline.tail_x_m

        def missing(x: float) -> float:
            return float(_moments(outline, outline.tail_x_m, x)[0] - left)

        return _root(missing, outline.tail_x_m, nose_x)

    def unbalance(nose_x: float) -> float:
        tail = _moments(outline, outline.tail_x_m, tail_bulkhead(nose_x))[1]
        return float(tail + _moments(outline, nose_x, outline.nose_x_m)[1] - moment)

    def all_in_nose(x: float) -> float:
        return float(_moments(outline, x, outline.nose_x_m)[0] - water_m3)

    foremost = outline.nose_x_m
    aftmost = _root(all_in_nose, outline.tail_x_m, outline.nose_x_m)
    if not unbalance(aftmost) >= 0 >= unbalance(foremost):
        raise VehicleError(
            f"water in the ends of {geometry.name} cannot put the centre of buoyancy at the "
            f"origin: the envelope's centre is at x = {geometry.envelope_x_m:.3f} m"
        )
    nose_x = _root(unbalance, aftmost, foremost)
    tail_x = tail_bulkhead(nose_x)
    volume, first, second, across = _moments(outline, nose_x, outline.nose_x_m) + _moments(
        outline, outline.tail_x_m, tail_x
    )
    x = first / volume
    lengthwise = density * (second - volume * x**2 + across)
    return Entrained(
        mass_kg=float(density * volume),
        x_m=float(x),
        inertia_kg_m2=(float(2.0 * density * across), float(lengthwise), float(lengthwise)),
        nose_from_x_m=nose_x,
        tail_to_x_m=tail_x,
    )


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Root of a function between two places, to 1e-12 m.

    The Illinois rule of false position (Dowell & Jarratt, 1971). scipy's solvers would do, but take
    a tenth of a second to load, at every start of a command that plans.
    """
    at_low, at_high = function(low), function(high)
    for _ in range(_MAX_STEPS):
        if at_high == 0.0 or abs(high - low) <= _EXACT_M:
            break
        place = high - at_high * (high - low) / (at_high - at_low)
        value = function(place)
        if value * at_high <= 0.0:
            low, at_low = high, at_high
        else:
            at_low /= 2.0
        high, at_high = place, value
    return high


def _moments(outline: Outline, aft_x: float, fore_x: float) -> Array:
    """Volume, its first and second moment about x = 0, and the integral of pi r^4 / 4."""
    if fore_x <= aft_x:
        return np.zeros(4)
    x, r, w = outline.strips(breaks_m=(aft_x, fore_x))
    within = (x > aft_x) & (x < fore_x)
    x, area, w = x[within], np.pi * r[within] ** 2, w[within]
    across = area**2 / (4.0 * np.pi)
    return np.array([np.sum(w * f) for f in (area, area * x, area * x**2, across)])
