"""Coefficients by shape: the computation behind `alice_survey/sim/vehicle/shapes.toml`.

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

Where the paper's printed form is wrong, the right one is computed and the printed one is named in
the docstring. The paper prints C_f with a minus and X_uu with u |u| on its right side; here C_f is
positive and X_uu = -1/2 rho A C_d is a coefficient.

A part is cut into elements. An element at p that feels motion along n adds J J^T times its added
mass to M_A, with J = (n, p x n) the motion of p along n by the vehicle's six; and its drag
-a |J nu| (J nu) J adds -a J |J_j| J_j to column j of the quadratic coefficients. So all signs
follow from places and directions. Drag of two motions at once is not expanded: the coefficients of
nu_j |nu_j| are those of one motion at a time, as in the paper.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import brentq, root

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import FORCES, MOTIONS, Coefficients
from alice_survey.sim.vehicle.vehicle import Hull

DENSITY = 1025.0
"""Sea water of 35 psu at 20 C (ITTC 1963), kg/m^3; its viscosity is 1.05372e-6 m^2/s."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Radius r(x) of a body of revolution, from its tail to its nose."""

    x_m: tuple[float, ...]
    """Stations, increasing towards the nose."""
    radius_m: tuple[float, ...]

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

    def strips(self, breaks_m: tuple[float, ...] = ()) -> Array:
        """(3, N) x, radius and weight of strips: `sum(w * f(x, r))` is the integral of f over x.

        Segments are also cut at x = 0, for |x|, and at given places. With 4 Gauss points a segment
        it is exact for polynomials in x up to the 7th degree.
        """
        inner = [b for b in (0.0, *breaks_m) if self.tail_x_m < b < self.nose_x_m]
        knots = np.unique([*self.x_m, *inner])
        half, middle = np.diff(knots) / 2.0, (knots[1:] + knots[:-1]) / 2.0
        x = (middle[:, None] + half[:, None] * _NODES).ravel()
        return np.stack([x, self.radius_at(x), (half[:, None] * _WEIGHTS).ravel()])

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

    def stretch(self, tail_x_m: float, nose_x_m: float) -> "Outline":
        """The same radii on stations spread evenly to other ends."""
        scale = (nose_x_m - tail_x_m) / self.length_m
        return Outline(
            x_m=(*(tail_x_m + scale * (x - self.tail_x_m) for x in self.x_m[:-1]), nose_x_m),
            radius_m=self.radius_m,
        )


class Mast(NamedTuple):
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


class Pod(NamedTuple):
    """A horizontal thruster: a motor body that carries the nozzle; two, mirrored."""

    outline: Outline
    """Outline from outside, nozzle included."""
    body_diameter_m: float
    """Diameter of the motor body without the nozzle; d_th in the paper."""
    y_m: float
    """Distance of its axis from the middle plane."""

    @property
    def volume_m3(self) -> float:
        """Solid volume of both: motor bodies as cylinders; the nozzles are open."""
        return math.pi / 2.0 * self.body_diameter_m**2 * self.outline.length_m


class PodArm(NamedTuple):
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


class Tunnel(NamedTuple):
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
        return self.outline.volume_m3 + self.mast.volume_m3 + self.pod.volume_m3

    @cached_property
    def envelope_x_m(self) -> float:
        """The x of the centre of the envelope."""
        moment = (
            self.outline.volume_m3 * self.outline.volume_x_m
            + self.mast.volume_m3 * self.mast.x_m
            + self.pod.volume_m3 * self.pod.outline.volume_x_m
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

    def room(x_m: float) -> float:
        return float(np.min(outline.radius_at(x_m + radius * np.cos(angle)) - needed))

    return float(brentq(room, inside, outside, xtol=1e-14))


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
    mast=SPARUS2.mast._replace(x_m=-0.472),
    pod=SPARUS2.pod._replace(
        outline=_POD.stretch(_POD.tail_x_m + _MOVED_M, _POD.nose_x_m + _MOVED_M)
    ),
    mount=SPARUS2.mount._replace(
        aft_x_m=SPARUS2.mount.aft_x_m + _MOVED_M, fore_x_m=SPARUS2.mount.fore_x_m + _MOVED_M
    ),
    # "At the farthest possible distance" (paper, section III.A); T200 propellers of 0.076 m.
    tunnels=(
        *SPARUS2.tunnels,
        *(Tunnel(end, round(farthest_tunnel_x(_ALICE_HULL, end), 3), "y", 0.076) for end in _ENDS),
    ),
)


class Entrained(NamedTuple):
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


def entrained_water(geometry: Geometry, buoyancy_kg: float) -> Entrained:
    """Water in the nose and tail of a vehicle that displaces a mass of water when drained."""
    water_m3 = geometry.envelope_volume_m3 - buoyancy_kg / DENSITY
    outline = geometry.outline
    moment = geometry.envelope_volume_m3 * geometry.envelope_x_m
    tail, nose = outline.tail_x_m, outline.nose_x_m

    def wet(bulkheads: Array) -> Array:
        return _moments(outline, tail, bulkheads[0]) + _moments(outline, bulkheads[1], nose)

    def unbalance(bulkheads: Array) -> Array:
        return wet(bulkheads)[:2] - [water_m3, moment]

    found = root(unbalance, np.array([tail, nose]) / 2.0, tol=1e-14)
    volume, first, second, across = wet(found.x)
    tail_x, nose_x = found.x.tolist()
    x = first / volume
    lengthwise = DENSITY * (second - volume * x**2 + across)
    return Entrained(
        mass_kg=float(DENSITY * volume),
        x_m=float(x),
        inertia_kg_m2=(float(2.0 * DENSITY * across), float(lengthwise), float(lengthwise)),
        nose_from_x_m=nose_x,
        tail_to_x_m=tail_x,
    )


def _moments(outline: Outline, aft_x: float, fore_x: float) -> Array:
    """Volume, its first and second moment about x = 0, and the integral of pi r^4 / 4."""
    if fore_x <= aft_x:
        return np.zeros(4)
    strips = outline.strips(breaks_m=(aft_x, fore_x))
    x, r, w = strips[:, (strips[0] > aft_x) & (strips[0] < fore_x)]
    area = np.pi * r**2
    across = area**2 / (4.0 * np.pi)
    return np.array([np.sum(w * f) for f in (area, area * x, area * x**2, across)])


def alpha_0(length_m: float, diameter_m: float) -> float:
    """Lamb's constant of a prolate spheroid along its axis (Lamb 1932; Fossen 2011).

    alpha_0 = 2 (1 - e^2) / e^3 (1/2 ln((1 + e) / (1 - e)) - e), e = sqrt(1 - (d / l)^2).
    As printed in the paper: e = 1 - (d / l)^2, and (l / 2) ln, a length in a pure number.
    2/3 for a sphere, 0 for a needle.
    """
    squared = 1.0 - (diameter_m / length_m) ** 2
    if squared < 1e-6:
        # The closed form loses its digits near a sphere: its series in e^2.
        return 2.0 * (1.0 - squared) * (1.0 / 3.0 + squared / 5.0)
    e = math.sqrt(squared)
    return 2.0 * (1.0 - e**2) / e**3 * (0.5 * math.log((1.0 + e) / (1.0 - e)) - e)


def ellipsoid_axial(length_m: float, diameter_m: float) -> float:
    """Added mass of a prolate spheroid along its axis, kg: alpha_0 / (2 - alpha_0) m_e.

    m_e = 4/3 pi rho (l/2) (d/2)^2, the mass of the water that the spheroid displaces.
    """
    alpha = alpha_0(length_m, diameter_m)
    displaced_kg = 4.0 / 3.0 * math.pi * DENSITY * length_m / 2.0 * (diameter_m / 2.0) ** 2
    return alpha / (2.0 - alpha) * displaced_kg


def finned_circle_section(radius_m: Array, span_m: float) -> Array:
    """Added mass of a circle with two fins, moving at a right angle to them, kg/m.

    rho pi (b^2 - r^2 + r^4 / b^2), Newman (1977, table 4.3). As printed in the paper:
    pi rho (b^2 - r^2) / b^2, which is not a mass per length.

    Args:
        radius_m: radius of the circle.
        span_m: distance from the middle to the tip of a fin, not below the radius.
    """
    r2, b2 = np.asarray(radius_m, dtype=np.float64) ** 2, span_m**2
    return DENSITY * np.pi * (b2 - r2 + r2**2 / b2)


def finned_circle_roll(radius_m: Array, span_m: float) -> Array:
    """Added inertia in roll of a circle with two fins, kg m^2/m (Newman 1977, table 4.3).

    rho r^4 ((2 a^2 - a sin 4a + sin^2(2a) / 2) / (pi sin^4 a) - pi / 2), sin a = 2 r b / (r^2 +
    b^2), a between pi / 2 and pi. Zero without fins, rho pi b^4 / 8 of the fins alone.
    """
    r = np.asarray(radius_m, dtype=np.float64)
    sine = 2.0 * r * span_m / (r**2 + span_m**2)
    a = np.pi - np.arcsin(np.clip(sine, 0.0, 1.0))
    bracket = 2.0 * a**2 - a * np.sin(4.0 * a) + 0.5 * np.sin(2.0 * a) ** 2
    return DENSITY * r**4 * (bracket / (np.pi * sine**4) - np.pi / 2.0)


CYLINDER_CD = 1.2
"""C_d0 of a long cylinder across the flow, subcritical (paper)."""
LONG_CYLINDER = 57.5
"""l / d from which end effects are negligible (paper, after Uematsu and Yamada 1995)."""
TUNNEL_CBTO = 0.012
"""C_BTO of a thruster tunnel with sharp edges off the middle of a bow: the upper end of 0.003 to
0.012 (Holtrop and Mennen 1982, International Shipbuilding Progress 29)."""


def ittc57(reynolds: float) -> float:
    """C_f = 0.075 / (log10 Re - 2)^2, the ITTC-1957 line. As printed: with a minus."""
    return 0.075 / (math.log10(reynolds) - 2.0) ** 2


def ellipsoid_drag(length_m: float, diameter_m: float, friction: float) -> float:
    """C_d by frontal area of an ellipsoid along its axis (Hoerner 1965; paper).

    0.44 d / l + 4 C_f l / d + 4 C_f (d / l)^(1/2).
    """
    slim = diameter_m / length_m
    return 0.44 * slim + 4.0 * friction / slim + 4.0 * friction * math.sqrt(slim)


def cylinder_across(fineness: float) -> float:
    """C_d by silhouette of a cylinder of finite l / d across the flow (Uematsu and Yamada 1995).

    1.2 (0.58 + 0.17 log10(l / d)^1.6) up to l / d = 57.5, 1.2 beyond.
    """
    if fineness > LONG_CYLINDER:
        return CYLINDER_CD
    return CYLINDER_CD * (0.58 + 0.17 * math.pow(math.log10(max(fineness, 1.0)), 1.6))


def plate_across(aspect: float) -> float:
    """C_d of a rectangular plate across the flow.

    1.10 + 0.02 (a + 1 / a), a fit in common use to the plates of Hoerner (1965, chapter 3), up to
    an aspect ratio of 30; its source could not be read. On a wall a plate counts with its
    mirror image: twice its height over its width.
    """
    return 1.10 + 0.02 * (aspect + 1.0 / aspect)


def strut_along(chord_m: float, width_m: float, reynolds: float) -> float:
    """C_d by frontal area of a strut of elliptic section along its chord, subcritical.

    2 C_f (1 + c / t) + 1.1 t / c (Hoerner 1965, chapter 6), with laminar C_f = 1.328 / sqrt(Re)
    (Blasius, one side).

    Args:
        chord_m: c, along the flow.
        width_m: t, across it.
        reynolds: by the chord.
    """
    friction = 1.328 / math.sqrt(reynolds)
    slim = width_m / chord_m
    return 2.0 * friction * (1.0 + 1.0 / slim) + 1.1 * slim


_FORWARD, _STARBOARD, _DOWN = np.eye(3)
_NOTHING = 1e-9
"""Below this an entry is a zero by symmetry that rounding hides."""


def reynolds(length_m: float) -> float:
    """U l / nu, at the axial speed of the paper's lift computations.

    Its X_uu of the hull follows from that speed.
    """
    return 0.25 * length_m / 1.05372e-6


class HullPart(NamedTuple):
    """One part's contribution."""

    name: str
    added_mass: Array
    """(6, 6) share of M_A, about the body's origin."""
    quadratic: Array
    """(6, 6) coefficients of nu |nu|."""


def motion_along(points_body: Array, direction_body: Array) -> Array:
    """J, (N, 6): velocity of points along a direction by each of the vehicle's six motions."""
    points = np.atleast_2d(points_body)
    direction = np.broadcast_to(direction_body, points.shape)
    return np.hstack([direction, np.cross(points, direction)])


def inertia_of(points_body: Array, direction_body: Array, mass_kg: Array) -> Array:
    """M_A, (6, 6), of masses (N,) that points (N, 3) feel along a direction (3,)."""
    motion = motion_along(points_body, direction_body)
    return motion.T @ (np.atleast_1d(mass_kg)[:, None] * motion)


def drag_of(points_body: Array, direction_body: Array, drag_kg_m: Array) -> Array:
    """Quadratic coefficients, (6, 6), of drags (N,) N/(m/s)^2 that points feel along a direction.

    Entry [i, j] is of force i by motion j alone.
    """
    motion = motion_along(points_body, direction_body)
    return -motion.T @ (np.atleast_1d(drag_kg_m)[:, None] * motion * np.abs(motion))


def parts(geometry: Geometry) -> tuple[HullPart, ...]:
    """Hull, mast, pods, mounts and tunnels."""
    pod = geometry.pod
    return (
        _hull(geometry),
        _mast(geometry.mast),
        *(
            _revolved("pod", pod.outline, pod.body_diameter_m, pod.outline.volume_x_m, y)
            for y in (pod.y_m, -pod.y_m)
        ),
        _mounts(geometry.mount, geometry.outline),
        *(_tunnel(tunnel) for tunnel in geometry.tunnels),
    )


def _on_axis(x_m: Array, y_m: Array | float = 0.0) -> Array:
    points = np.zeros((len(x_m), 3))
    points[:, 0], points[:, 1] = x_m, y_m
    return points


def _revolved(
    name: str,
    outline: Outline,
    diameter_m: float,
    centre_x_m: float,
    y_m: float,
    breaks_m: tuple[float, ...] = (),
) -> HullPart:
    """Ellipsoid along, as thick as `diameter_m`; circular strips across."""
    x, r, w = outline.strips(breaks_m)
    points, centre = _on_axis(x, y_m), _on_axis(np.array([centre_x_m]), y_m)
    across = w * DENSITY * np.pi * r**2
    axial = ellipsoid_axial(outline.length_m, diameter_m)
    friction = ittc57(reynolds(outline.length_m))
    along = ellipsoid_drag(outline.length_m, diameter_m, friction) * np.pi / 4.0 * diameter_m**2
    side = 0.5 * DENSITY * cylinder_across(outline.length_m / diameter_m) * 2.0 * r * w
    return HullPart(
        name,
        inertia_of(centre, _FORWARD, np.array([axial]))
        + inertia_of(points, _STARBOARD, across)
        + inertia_of(points, _DOWN, across),
        drag_of(centre, _FORWARD, np.array([0.5 * DENSITY * along]))
        + drag_of(points, _STARBOARD, side)
        + drag_of(points, _DOWN, side),
    )


def _hull(geometry: Geometry) -> HullPart:
    """A body of revolution, with fins where the mounts are, in heave and roll."""
    outline, mount = geometry.outline, geometry.mount
    breaks = (mount.aft_x_m, mount.fore_x_m)
    hull = _revolved("hull", outline, outline.diameter_m, 0.0, 0.0, breaks)
    strips = outline.strips(breaks)
    x, r, w = strips[:, (strips[0] > mount.aft_x_m) & (strips[0] < mount.fore_x_m)]
    more = finned_circle_section(r, mount.tip_y_m) - DENSITY * np.pi * r**2
    added = hull.added_mass + inertia_of(_on_axis(x), _DOWN, w * more)
    added[3, 3] += np.sum(w * finned_circle_roll(r, mount.tip_y_m))
    return hull._replace(added_mass=added)


def _mast(mast: Mast) -> HullPart:
    """Elliptic strips up its height; a plate across, on the hull as on a wall; a strut along.

    Added mass of an elliptic section, kg/m: rho pi / 4 of its square width across the flow. The
    paper's mast: (1/4) pi rho w_m^2 h_m in surge, (1/4) pi rho c_m^2 h_m in sway.
    """
    z = mast.middle_z_m + mast.height_m / 2.0 * _NODES
    w = mast.height_m / 2.0 * _WEIGHTS
    points = np.column_stack([np.full(4, mast.x_m), np.zeros(4), z])
    along = strut_along(mast.chord_m, mast.width_m, reynolds(mast.chord_m))
    across = plate_across(2.0 * mast.height_m / mast.chord_m)
    return HullPart(
        "mast",
        inertia_of(points, _FORWARD, w * DENSITY * math.pi / 4.0 * mast.width_m**2)
        + inertia_of(points, _STARBOARD, w * DENSITY * math.pi / 4.0 * mast.chord_m**2),
        drag_of(points, _FORWARD, 0.5 * DENSITY * along * mast.width_m * w)
        + drag_of(points, _STARBOARD, 0.5 * DENSITY * across * mast.chord_m * w),
    )


def _mounts(mount: PodArm, hull: Outline) -> HullPart:
    """Plates in heave, struts in surge; their added mass is in the hull's finned strips."""
    middle_x = (mount.aft_x_m + mount.fore_x_m) / 2.0
    root = float(hull.radius_at(np.array([middle_x]))[0])
    span, middle_y = mount.tip_y_m - root, (root + mount.tip_y_m) / 2.0
    along = strut_along(mount.chord_m, mount.thickness_m, reynolds(mount.chord_m))
    across = plate_across(2.0 * span / mount.chord_m)
    points = _on_axis(np.full(2, middle_x), np.array([middle_y, -middle_y]))
    pressed = np.full(2, 0.5 * DENSITY * span)
    return HullPart(
        "mounts",
        np.zeros((6, 6)),
        drag_of(points, _FORWARD, pressed * along * mount.thickness_m)
        + drag_of(points, _DOWN, pressed * across * mount.chord_m),
    )


def _tunnel(tunnel: Tunnel) -> HullPart:
    """Drag of the mouths in surge; the water inside belongs to the hull's.

    R = rho u^2 pi d^2 C_BTO of both (Holtrop and Mennen 1982).
    """
    amount = DENSITY * math.pi * tunnel.diameter_m**2 * TUNNEL_CBTO
    points = _on_axis(np.array([tunnel.x_m]))
    drag = drag_of(points, _FORWARD, np.array([amount]))
    return HullPart(tunnel.name, np.zeros((6, 6)), drag)


def body_lift(length_m: float, diameter_m: float, nose_x_m: float) -> dict[str, float]:
    """Lift of a slender hull at a small angle: coefficients of u v and u w, by SNAME name.

    C_L = 0.003 (180 / pi) l / d by angle, 1/rad, on d^2, and Y_uv = Z_uw = -1/2 rho d^2 C_L
    (Hoerner and Borst 1975; paper, section V.C). A force at x gives M = -x Z and N = x Y, so that
    M_uw = -x_cp Z_uw. As printed: M_uw = Z_uw x_cp; the tables have the right sign.
    """
    slope = 0.003 * (180.0 / math.pi) * length_m / diameter_m
    force = -0.5 * DENSITY * diameter_m**2 * slope
    x = nose_x_m - 0.65 * length_m  # the centre of pressure
    return {"Y_uv": force, "Z_uw": force, "M_uw": -x * force, "N_uv": x * force}


def estimate(geometry: Geometry) -> Coefficients:
    """Added mass, quadratic damping and body lift of a shape, as the set `computed`.

    Entries that the paper leaves out (Y_rr, Z_qq, Y_pdot ...) are kept: they follow from the same
    strips.
    """
    outline = geometry.outline
    lift = body_lift(outline.length_m, outline.diameter_m, outline.nose_x_m)
    _, added, quadratic = zip(*parts(geometry), strict=True)
    whole = part_coefficients(
        HullPart(geometry.name, np.sum(added, axis=0), np.sum(quadratic, axis=0))
    )
    return Coefficients(name="computed", values={**whole, **lift})


def part_coefficients(part: HullPart) -> dict[str, float]:
    """One part's share by SNAME name: M_A with its sign turned, and its drag."""
    return {
        f"{FORCES[i]}_{motion}{ending or motion}": float(matrix[i, j])
        for matrix, ending in ((-part.added_mass, "dot"), (part.quadratic, ""))
        for i in range(6)
        for j, motion in enumerate(MOTIONS)
        if abs(matrix[i, j]) > _NOTHING
    }
