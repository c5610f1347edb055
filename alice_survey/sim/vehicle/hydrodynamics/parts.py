"""Contribution of each part of a vehicle to its inertia and drag.

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
from alice_survey.sim.vehicle.hydrodynamics import added_mass, drag
from alice_survey.sim.vehicle.hydrodynamics.geometry import (
    Geometry,
    Mast,
    Outline,
    Pod,
    PodArm,
    Tunnel,
)

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
    axial = added_mass.ellipsoid_axial(outline.length_m, outline.diameter_m, density)
    across = w * added_mass.circle_section(r, density)
    finned = (x > mount.aft_x_m) & (x < mount.fore_x_m)
    heaving = across.copy()
    heaving[finned] = w[finned] * added_mass.finned_circle_section(
        r[finned], mount.tip_y_m, density
    )
    rolling = w[finned] * added_mass.finned_circle_roll(r[finned], mount.tip_y_m, density)
    inertia = (
        inertia_of(origin, _FORWARD, np.array([axial]))
        + inertia_of(points, _STARBOARD, across)
        + inertia_of(points, _DOWN, heaving)
    )
    inertia[3, 3] += rolling.sum()

    friction = drag.ittc57(flow.reynolds(outline.length_m))
    along = drag.ellipsoid_axial(outline.length_m, outline.diameter_m, friction)
    side = 0.5 * density * drag.cylinder_across(outline.length_m / outline.diameter_m) * 2.0 * r * w
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
        points, _FORWARD, w * added_mass.elliptic_section(mast.width_m, density)
    ) + inertia_of(points, _STARBOARD, w * added_mass.elliptic_section(mast.chord_m, density))
    along = drag.strut_along(mast.chord_m, mast.width_m, flow.reynolds(mast.chord_m))
    across = drag.plate_across(2.0 * mast.height_m / mast.chord_m)
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
    across = w * added_mass.circle_section(r, density)
    axial = added_mass.ellipsoid_axial(outline.length_m, pod.body_diameter_m, density)
    inertia = (
        inertia_of(middle, _FORWARD, np.array([axial]))
        + inertia_of(points, _STARBOARD, across)
        + inertia_of(points, _DOWN, across)
    )
    friction = drag.ittc57(flow.reynolds(outline.length_m))
    along = drag.ellipsoid_axial(outline.length_m, pod.body_diameter_m, friction)
    area = np.pi / 4.0 * pod.body_diameter_m**2
    crossing = drag.cylinder_across(outline.length_m / pod.body_diameter_m)
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
    along = drag.strut_along(mount.chord_m, mount.thickness_m, flow.reynolds(mount.chord_m))
    across = drag.plate_across(2.0 * span / mount.chord_m)
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
    amount = 0.5 * flow.density_kg_m3 * drag.tunnel_area(tunnel.diameter_m)
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
    return {**named(part.added_mass, kind="dot"), **named(part.quadratic, kind="quadratic")}


def named(matrix: Array, *, kind: Literal["dot", "quadratic"]) -> dict[str, float]:
    """A (6, 6) matrix by SNAME names: of `dot`, M_A with its sign turned; of `quadratic`, as is."""
    sign = -1.0 if kind == "dot" else 1.0
    return {
        f"{FORCES[i]}_{motion}{'dot' if kind == 'dot' else motion}": float(sign * matrix[i, j])
        for i in range(6)
        for j, motion in enumerate(MOTIONS)
        if abs(matrix[i, j]) > _NOTHING
    }
