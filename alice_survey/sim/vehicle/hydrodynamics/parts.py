"""Laws of added mass and drag by shape, and the contribution of each part of a vehicle.

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import FORCES, MOTIONS, Coefficients
from alice_survey.sim.vehicle.hydrodynamics.geometry import (
    Geometry,
    Mast,
    Outline,
    Pod,
    PodArm,
    Tunnel,
)


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
    return _alpha(math.sqrt(squared))


def _alpha(e: float) -> float:
    return 2.0 * (1.0 - e**2) / e**3 * (0.5 * math.log((1.0 + e) / (1.0 - e)) - e)


def ellipsoid_mass(length_m: float, diameter_m: float, density: float) -> float:
    """m_e = 4/3 pi rho (l/2) (d/2)^2, kg: mass of the water that the spheroid displaces."""
    return 4.0 / 3.0 * math.pi * density * length_m / 2.0 * (diameter_m / 2.0) ** 2


def ellipsoid_axial(length_m: float, diameter_m: float, density: float) -> float:
    """Added mass of a prolate spheroid along its axis, kg: alpha_0 / (2 - alpha_0) m_e."""
    alpha = alpha_0(length_m, diameter_m)
    return alpha / (2.0 - alpha) * ellipsoid_mass(length_m, diameter_m, density)


def circle_section(radius_m: Array, density: float) -> Array:
    """Added mass of circular sections moving across, kg/m: rho pi r^2 (Fossen 2011; Newman)."""
    return density * np.pi * np.asarray(radius_m, dtype=np.float64) ** 2


def finned_circle_section(radius_m: Array, span_m: float, density: float) -> Array:
    """Added mass of a circle with two fins, moving at a right angle to them, kg/m.

    rho pi (b^2 - r^2 + r^4 / b^2), Newman (1977, table 4.3). As printed in the paper:
    pi rho (b^2 - r^2) / b^2, which is not a mass per length.

    Args:
        radius_m: radius of the circle.
        span_m: distance from the middle to the tip of a fin, not below the radius.
        density: kg/m^3.
    """
    r2, b2 = np.asarray(radius_m, dtype=np.float64) ** 2, span_m**2
    return density * np.pi * (b2 - r2 + r2**2 / b2)


def finned_circle_roll(radius_m: Array, span_m: float, density: float) -> Array:
    """Added inertia in roll of a circle with two fins, kg m^2/m (Newman 1977, table 4.3).

    rho r^4 ((2 a^2 - a sin 4a + sin^2(2a) / 2) / (pi sin^4 a) - pi / 2), sin a = 2 r b / (r^2 +
    b^2), a between pi / 2 and pi. Zero without fins, rho pi b^4 / 8 of the fins alone.
    """
    r = np.asarray(radius_m, dtype=np.float64)
    sine = 2.0 * r * span_m / (r**2 + span_m**2)
    a = np.pi - np.arcsin(np.clip(sine, 0.0, 1.0))
    bracket = 2.0 * a**2 - a * np.sin(4.0 * a) + 0.5 * np.sin(2.0 * a) ** 2
    return density * r**4 * (bracket / (np.pi * sine**4) - np.pi / 2.0)


def elliptic_section(across_m: float, density: float) -> float:
    """Added mass of an elliptic section, kg/m: rho pi / 4 of its square width across the flow.

    The paper's mast: (1/4) pi rho w_m^2 h_m in surge, (1/4) pi rho c_m^2 h_m in sway.
    """
    return density * math.pi / 4.0 * across_m**2


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


def tunnel_area(diameter_m: float) -> float:
    """C_d A of a tunnel's two mouths, m^2: R = rho u^2 pi d^2 C_BTO (Holtrop and Mennen 1982)."""
    return 2.0 * math.pi * diameter_m**2 * TUNNEL_CBTO


_FORWARD, _STARBOARD, _DOWN = np.eye(3)
_NOTHING = 1e-9
"""Below this an entry is a zero by symmetry that rounding hides."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True, kw_only=True)
class Flow:
    """The water, and the speed at which friction is evaluated."""

    density_kg_m3: float = 1025.0
    viscosity_m2_s: float = 1.05372e-6
    """Sea water of 35 psu at 20 C (ITTC 1963)."""
    speed_mps: float = 0.25
    """The axial speed of the paper's lift computations; its X_uu of the hull follows from it."""

    def reynolds(self, length_m: float) -> float:
        """U l / nu."""
        return self.speed_mps * length_m / self.viscosity_m2_s


@dataclass(frozen=True, kw_only=True, eq=False)
class HullPart:
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
    matrix: Array = motion.T @ (np.atleast_1d(mass_kg)[:, None] * motion)
    return matrix


def drag_of(points_body: Array, direction_body: Array, drag_kg_m: Array) -> Array:
    """Quadratic coefficients, (6, 6), of drags (N,) N/(m/s)^2 that points feel along a direction.

    Entry [i, j] is of force i by motion j alone.
    """
    motion = motion_along(points_body, direction_body)
    matrix: Array = -motion.T @ (np.atleast_1d(drag_kg_m)[:, None] * motion * np.abs(motion))
    return matrix


def parts(geometry: Geometry, flow: Flow) -> tuple[HullPart, ...]:
    """Hull, mast, pods, mounts and tunnels."""
    pods = [_pod(geometry.pod, side, flow) for side in (1.0, -1.0)]
    tunnels = [_tunnel(tunnel, flow) for tunnel in geometry.tunnels]
    return (
        _hull(geometry, flow),
        _mast(geometry.mast, flow),
        _sum("pods", pods),
        _mounts(geometry.mount, geometry.outline, flow),
        _sum("tunnels", tunnels),
    )


def _sum(name: str, each: Sequence[HullPart]) -> HullPart:
    nothing = np.zeros((6, 6))
    return HullPart(
        name=name,
        added_mass=sum((part.added_mass for part in each), nothing),
        quadratic=sum((part.quadratic for part in each), nothing),
    )


def _on_axis(x_m: Array, y_m: float = 0.0) -> Array:
    points = np.zeros((len(x_m), 3))
    points[:, 0], points[:, 1] = x_m, y_m
    return points


def _hull(geometry: Geometry, flow: Flow) -> HullPart:
    """Ellipsoid along; circular strips across, finned where the mounts are, in heave."""
    outline, mount, density = geometry.outline, geometry.mount, flow.density_kg_m3
    x, r, w = outline.strips(breaks_m=(mount.aft_x_m, mount.fore_x_m))
    points, origin = _on_axis(x), np.zeros((1, 3))
    axial = ellipsoid_axial(outline.length_m, outline.diameter_m, density)
    across = w * circle_section(r, density)
    finned = (x > mount.aft_x_m) & (x < mount.fore_x_m)
    heaving = across.copy()
    heaving[finned] = w[finned] * finned_circle_section(r[finned], mount.tip_y_m, density)
    rolling = w[finned] * finned_circle_roll(r[finned], mount.tip_y_m, density)
    inertia = (
        inertia_of(origin, _FORWARD, np.array([axial]))
        + inertia_of(points, _STARBOARD, across)
        + inertia_of(points, _DOWN, heaving)
    )
    inertia[3, 3] += rolling.sum()

    friction = ittc57(flow.reynolds(outline.length_m))
    along = ellipsoid_drag(outline.length_m, outline.diameter_m, friction)
    side = 0.5 * density * cylinder_across(outline.length_m / outline.diameter_m) * 2.0 * r * w
    quadratic = (
        drag_of(origin, _FORWARD, np.array([0.5 * density * along * outline.frontal_area_m2]))
        + drag_of(points, _STARBOARD, side)
        + drag_of(points, _DOWN, side)
    )
    return HullPart(name="hull", added_mass=inertia, quadratic=quadratic)


def _mast(mast: Mast, flow: Flow) -> HullPart:
    """Elliptic strips up its height; a plate across, on the hull as on a wall; a strut along."""
    density = flow.density_kg_m3
    z = mast.middle_z_m + mast.height_m / 2.0 * _NODES
    w = mast.height_m / 2.0 * _WEIGHTS
    points = np.column_stack([np.full(4, mast.x_m), np.zeros(4), z])
    inertia = inertia_of(
        points, _FORWARD, w * elliptic_section(mast.width_m, density)
    ) + inertia_of(points, _STARBOARD, w * elliptic_section(mast.chord_m, density))
    along = strut_along(mast.chord_m, mast.width_m, flow.reynolds(mast.chord_m))
    across = plate_across(2.0 * mast.height_m / mast.chord_m)
    quadratic = drag_of(points, _FORWARD, 0.5 * density * along * mast.width_m * w) + drag_of(
        points, _STARBOARD, 0.5 * density * across * mast.chord_m * w
    )
    return HullPart(name="mast", added_mass=inertia, quadratic=quadratic)


def _pod(pod: Pod, side: float, flow: Flow) -> HullPart:
    """Ellipsoid along, of the motor body: water passes through the nozzle; strips across."""
    density, outline, y = flow.density_kg_m3, pod.outline, side * pod.y_m
    x, r, w = outline.strips()
    points = _on_axis(x, y)
    middle = _on_axis(np.array([outline.volume_x_m]), y)
    across = w * circle_section(r, density)
    axial = ellipsoid_axial(outline.length_m, pod.body_diameter_m, density)
    inertia = (
        inertia_of(middle, _FORWARD, np.array([axial]))
        + inertia_of(points, _STARBOARD, across)
        + inertia_of(points, _DOWN, across)
    )
    friction = ittc57(flow.reynolds(outline.length_m))
    along = ellipsoid_drag(outline.length_m, pod.body_diameter_m, friction)
    area = np.pi / 4.0 * pod.body_diameter_m**2
    crossing = cylinder_across(outline.length_m / pod.body_diameter_m)
    sideways = 0.5 * density * crossing * 2.0 * r * w
    quadratic = (
        drag_of(middle, _FORWARD, np.array([0.5 * density * along * area]))
        + drag_of(points, _STARBOARD, sideways)
        + drag_of(points, _DOWN, sideways)
    )
    return HullPart(name="pod", added_mass=inertia, quadratic=quadratic)


def _mounts(mount: PodArm, hull: Outline, flow: Flow) -> HullPart:
    """Plates in heave, struts in surge; their added mass is in the hull's finned strips."""
    density = flow.density_kg_m3
    middle_x = (mount.aft_x_m + mount.fore_x_m) / 2.0
    root = float(hull.radius_at(np.array([middle_x]))[0])
    span = mount.tip_y_m - root
    along = strut_along(mount.chord_m, mount.thickness_m, flow.reynolds(mount.chord_m))
    across = plate_across(2.0 * span / mount.chord_m)
    middle_y = (root + mount.tip_y_m) / 2.0
    points = _on_axis(np.full(2, middle_x))
    points[:, 1] = middle_y, -middle_y
    frontal, plan = span * mount.thickness_m, span * mount.chord_m
    quadratic = drag_of(points, _FORWARD, np.full(2, 0.5 * density * along * frontal)) + drag_of(
        points, _DOWN, np.full(2, 0.5 * density * across * plan)
    )
    return HullPart(name="mounts", added_mass=np.zeros((6, 6)), quadratic=quadratic)


def _tunnel(tunnel: Tunnel, flow: Flow) -> HullPart:
    """Drag of the mouths in surge; the water inside belongs to the hull's."""
    points = _on_axis(np.array([tunnel.x_m]))
    amount = 0.5 * flow.density_kg_m3 * tunnel_area(tunnel.diameter_m)
    return HullPart(
        name=tunnel.name,
        added_mass=np.zeros((6, 6)),
        quadratic=drag_of(points, _FORWARD, np.array([amount])),
    )


def centre_of_pressure(nose_x_m: float, length_m: float) -> float:
    """x_cp = x_n - 0.65 l, metres."""
    return nose_x_m - 0.65 * length_m


def body_lift(
    length_m: float, diameter_m: float, nose_x_m: float, density: float
) -> dict[str, float]:
    """Lift of a slender hull at a small angle: coefficients of u v and u w, by SNAME name.

    C_L = 0.003 (180 / pi) l / d by angle, 1/rad, on d^2, and Y_uv = Z_uw = -1/2 rho d^2 C_L
    (Hoerner and Borst 1975; paper, section V.C). A force at x gives M = -x Z and N = x Y, so that
    M_uw = -x_cp Z_uw. As printed: M_uw = Z_uw x_cp; the tables have the right sign.
    """
    slope = 0.003 * (180.0 / math.pi) * length_m / diameter_m
    force = -0.5 * density * diameter_m**2 * slope
    x = centre_of_pressure(nose_x_m, length_m)
    return {"Y_uv": force, "Z_uw": force, "M_uw": -x * force, "N_uv": x * force}


def estimate(geometry: Geometry, flow: Flow | None = None) -> Coefficients:
    """Added mass, quadratic damping and body lift of a shape, as the set `computed`.

    Entries that the paper leaves out (Y_rr, Z_qq, Y_pdot ...) are kept: they follow from the same
    strips.

    Args:
        geometry: the vehicle.
        flow: the water; sea water at the paper's speed if not given.
    """
    flow = flow or Flow()
    outline = geometry.outline
    lift = body_lift(outline.length_m, outline.diameter_m, outline.nose_x_m, flow.density_kg_m3)
    whole = part_coefficients(_sum(geometry.name, parts(geometry, flow)))
    return Coefficients(name="computed", values={**whole, **lift})


def part_coefficients(part: HullPart) -> dict[str, float]:
    """One part's share by name."""
    return {
        **by_name(part.added_mass, kind="dot"),
        **by_name(part.quadratic, kind="quadratic"),
    }


def by_name(matrix: Array, *, kind: Literal["dot", "quadratic"]) -> dict[str, float]:
    """A (6, 6) matrix by SNAME names: of `dot`, M_A with its sign turned; of `quadratic`, as is."""
    sign = -1.0 if kind == "dot" else 1.0
    return {
        f"{FORCES[i]}_{motion}{'dot' if kind == 'dot' else motion}": float(sign * matrix[i, j])
        for i in range(6)
        for j, motion in enumerate(MOTIONS)
        if abs(matrix[i, j]) > _NOTHING
    }
