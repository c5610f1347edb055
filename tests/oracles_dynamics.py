"""The equations of motion a second time, slow and by the textbook.

T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011, written down as
printed there and by another road than the package's: attitude in Euler angles, the velocity over
ground as the state, C_RB in its form without linear velocity, rigid body and water apart, the
force of every coefficient by its name.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.fins import Fin
from alice_survey.sim.vehicle.propulsion import Thruster
from alice_survey.sim.vehicle.sea import Current
from alice_survey.sim.vehicle.vehicle import Vehicle
from tests.oracles_propulsion import wrench as thrust_wrench

FORCES, MOTIONS = "XYZKMN", "uvwpqr"
GRAVITY = 9.80665


def cross_matrix(a: Array) -> Array:
    """S(a), so that S(a) b is the cross product (2.10)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def ned_from_body(attitude: Array) -> Array:
    """R(Theta) from roll, pitch and heading (2.18)."""
    return Rotation.from_euler("ZYX", attitude[::-1]).as_matrix()


def attitude_rates_from_body_rates(attitude: Array) -> Array:
    """T(Theta) (2.28)."""
    sf, cf = np.sin(attitude[0]), np.cos(attitude[0])
    tt, ct = np.tan(attitude[1]), np.cos(attitude[1])
    return np.array([[1.0, sf * tt, cf * tt], [0.0, cf, -sf], [0.0, sf / ct, cf / ct]])


@dataclass(frozen=True)
class Part:
    """A rigid piece of the vehicle: the drained vehicle, or the water inside it."""

    mass: float
    cg: Array
    inertia: Array
    """(3, 3) about its own centre of gravity."""

    @cached_property
    def about_origin(self) -> Array:
        """I_b = I_g - m S(r)^2, the parallel-axis theorem (3.36)."""
        s = cross_matrix(self.cg)
        return self.inertia - self.mass * s @ s

    @cached_property
    def matrix(self) -> Array:
        """M_RB (3.44)."""
        s = cross_matrix(self.cg)
        return np.block(
            [[self.mass * np.eye(3), -self.mass * s], [self.mass * s, self.about_origin]]
        )

    def coriolis(self, nu: Array) -> Array:
        """C_RB in the form that holds no linear velocity (3.57)."""
        s, turn = cross_matrix(self.cg), cross_matrix(nu[3:])
        angular = -cross_matrix(self.about_origin @ nu[3:])
        return np.block(
            [[self.mass * turn, -self.mass * turn @ s], [self.mass * s @ turn, angular]]
        )


@cache
def parts(vehicle: Vehicle) -> tuple[Part, Part]:
    body = vehicle.rigid_body
    return (
        Part(body.dry_kg, np.array(body.cg_body_m), np.diag(body.inertia_kg_m2)),
        Part(
            body.entrained_kg,
            np.array(body.entrained_cg_body_m),
            np.diag(body.entrained_inertia_kg_m2),
        ),
    )


@cache
def added_mass(vehicle: Vehicle) -> Array:
    """M_A (6.38) by names; a name and its mirror share their mean."""
    named = vehicle.coefficients.values
    matrix = np.zeros((6, 6))
    for i, force in enumerate(FORCES):
        for j, motion in enumerate(MOTIONS):
            names = {f"{force}_{motion}dot", f"{FORCES[j]}_{MOTIONS[i]}dot"}
            given = [named[name] for name in names if name in named]
            matrix[i, j] = -sum(given) / len(given) if given else 0.0
    return matrix


def added_coriolis(mass: Array, nu: Array) -> Array:
    """C_A (6.43)."""
    linear = cross_matrix(mass[:3, :3] @ nu[:3] + mass[:3, 3:] @ nu[3:])
    angular = cross_matrix(mass[3:, :3] @ nu[:3] + mass[3:, 3:] @ nu[3:])
    return np.block([[np.zeros((3, 3)), -linear], [-linear, -angular]])


def damping_force(vehicle: Vehicle, nu: Array) -> Array:
    """The water's force on a body that moves steadily, term by term."""
    motion = dict(zip(MOTIONS, nu, strict=True))
    u, v, w = nu[:3]
    lift = {"Y_uv": abs(u) * v, "Z_uw": abs(u) * w, "M_uw": u * w, "N_uv": u * v}
    force = np.zeros(6)
    for name, value in vehicle.coefficients.values.items():
        if name.endswith("dot"):
            continue
        if name in lift:
            term = lift[name]
        elif len(name) == len("X_u"):
            term = motion[name[2]]
        elif name.endswith("_pos"):
            term = max(motion[name[2]], 0.0) ** 2
        elif name.endswith("_neg"):
            term = -(min(motion[name[2]], 0.0) ** 2)
        elif (
            f"{name}_pos" if motion[name[2]] > 0 else f"{name}_neg"
        ) in vehicle.coefficients.values:
            term = 0.0
        else:
            term = motion[name[2]] * abs(motion[name[3]])
        force[FORCES.index(name[0])] += value * term
    return force


def restoring(vehicle: Vehicle, attitude: Array) -> Array:
    """g(eta) (4.6), the centre of buoyancy in the origin."""
    weight = vehicle.rigid_body.dry_kg * GRAVITY
    net = weight - vehicle.rigid_body.buoyancy_kg * GRAVITY
    x, y, z = np.array(vehicle.rigid_body.cg_body_m) * weight
    (sf, st, _), (cf, ct, _) = np.sin(attitude), np.cos(attitude)
    return np.array([
        net * st, -net * ct * sf, -net * ct * cf,
        -y * ct * cf + z * ct * sf, z * st + x * ct * cf, -x * ct * sf - y * st,
    ])  # fmt: skip


def propeller_wrench(vehicle: Vehicle, rps: Array, nu: Array) -> Array:
    """The wrench of all propellers, by all laws of thrust."""
    displaced_kg = vehicle.rigid_body.buoyancy_kg + vehicle.rigid_body.entrained_kg
    return thrust_wrench(vehicle.thrusters, vehicle.density_kg_m3, displaced_kg, rps, nu)


def fin_wrench(vehicle: Vehicle, angles: Array, nu: Array) -> Array:
    """The wrench of all fins, surface by surface, with vectors in three dimensions.

    The chord is turned about the shaft by a rotation matrix; lift is along shaft x velocity, drag
    against the velocity, both of the part of the velocity square to the shaft.
    """
    wrench = np.zeros(6)
    for fin, angle in zip(vehicle.fins, angles, strict=True):
        shaft = np.array(fin.shaft_body)
        chord = Rotation.from_rotvec(angle * shaft).apply([1.0, 0.0, 0.0])
        for place in np.array(fin.positions_body_m):
            velocity = nu[:3] + np.cross(nu[3:], place)
            flow = velocity - (velocity @ shaft) * shaft
            speed = np.linalg.norm(flow)
            if speed == 0.0:
                continue
            # The angle by which the chord is turned out of the flow, about the shaft.
            alpha = np.arctan2(np.cross(flow, chord) @ shaft, flow @ chord)
            c_lift = alpha * fin.slope
            c_drag = c_lift**2 / (np.pi * 0.9 * fin.aspect_ratio)
            share = np.clip((abs(alpha) - np.radians(fin.stall_deg)) / np.radians(10.0), 0.0, 1.0)
            share = 3 * share**2 - 2 * share**3
            c_lift = (1 - share) * c_lift + share * fin.plate_drag * np.sin(2 * alpha) / 2
            c_drag = (1 - share) * c_drag + share * fin.plate_drag * (1 - np.cos(2 * alpha)) / 2
            c_drag += fin.profile_drag
            force = c_lift * np.cross(shaft, flow / speed) - c_drag * flow / speed
            force *= 0.5 * vehicle.density_kg_m3 * fin.area_m2 * speed**2
            wrench += np.concatenate([force, np.cross(place, force)])
    return wrench


def fin_lag(fins: Sequence[Fin], angles: Array, commands: Array) -> Array:
    """Rates of the angles of fins."""
    rates = []
    for fin, angle, asked in zip(fins, angles, commands, strict=True):
        maximum, fastest = np.radians(fin.most_angle_deg), np.radians(fin.most_rate_deg_s)
        rate = (np.clip(asked, -maximum, maximum) - angle) / fin.time_constant_s
        rates.append(np.clip(rate, -fastest, fastest))
    return np.array(rates)


def lag(thrusters: Sequence[Thruster], rps: Array, command_rps: Array) -> Array:
    """Rates of thruster speeds."""
    rates = []
    for thruster, n, asked in zip(thrusters, rps, command_rps, strict=True):
        wanted = 0.0 if abs(asked) < thruster.dead_band_rps else asked
        wanted = np.clip(wanted, -thruster.most_rps, thruster.most_rps)
        rates.append((wanted - n) / thruster.time_constant_s)
    return np.array(rates)


def water(current: Current, time_s: float, depth_m: float) -> tuple[Array, Array, Array]:
    """Velocity (3,) NED, its rate by time and its slope by depth, off the knots of the grid."""

    def at(time: float, depth: float) -> Array:
        rows = [
            [np.interp(depth, current.depth_m, row[:, axis]) for axis in (0, 1)]
            for row in current.velocity_ne_mps
        ]
        columns = np.array(rows).T
        return np.array([*(np.interp(time, current.time_s, column) for column in columns), 0.0])

    # Linear between knots, so that differences are exact but for rounding.
    here = at(time_s, depth_m)
    by_time = (at(time_s + 1e-2, depth_m) - here) / 1e-2
    by_depth = (at(time_s, depth_m + 1e-2) - here) / 1e-2
    return here, by_time, by_depth


def derivative(
    time_s: float,
    eta: Array,
    nu_ground: Array,
    rps: Array,
    command_rps: Array,
    load: Array,
    vehicle: Vehicle,
    current: Current,
) -> tuple[Array, Array, Array]:
    """Rates of eta (N, E, D, roll, pitch, heading), of the velocity over ground, and of actuators.

    `rps` and `command_rps` hold the angles of fins after the speeds of thrusters.

    Newton for the bodies, with the velocity over ground:
        M_RB nu_g' + C_RB(nu_g) nu_g = tau - g + F.
    The water's force F holds added mass and damping of the velocity relative to the water, and the
    push of the pressure that speeds up the water itself, on all of the water that is displaced, at
    its centre (of that displaced by the drained vehicle the origin):
        F = -M_A nu_r' - C_A(nu_r) nu_r + damping(nu_r) + m_displaced dV/dt.
    A horizontal current that changes with depth alone carries no speed of its own along its slope,
    so that dV/dt of a drop of water is the rate by time at one place.
    """
    rotation = ned_from_body(eta[3:])
    velocity, by_time, by_depth = water(current, time_s, eta[2])
    nu_water = np.array([*(rotation.T @ velocity), 0.0, 0.0, 0.0])
    nu_relative = nu_ground - nu_water
    ground_ned = rotation @ nu_ground[:3]
    # The water's velocity at the vehicle, in turning axes.
    along = by_time + by_depth * ground_ned[2]
    water_rate = np.zeros(6)
    water_rate[:3] = rotation.T @ along - cross_matrix(nu_ground[3:]) @ nu_water[:3]

    rigid = parts(vehicle)
    mass_rigid, mass_added = sum(p.matrix for p in rigid), added_mass(vehicle)
    count = len(vehicle.thrusters)
    force = load + propeller_wrench(vehicle, rps[:count], nu_relative)
    force = force - restoring(vehicle, eta[3:])
    force = force + fin_wrench(vehicle, rps[count:], nu_relative)
    force = force + damping_force(vehicle, nu_relative)
    force = force - added_coriolis(mass_added, nu_relative) @ nu_relative
    force = force - sum(p.coriolis(nu_ground) for p in rigid) @ nu_ground
    force = force + mass_added @ water_rate
    body = vehicle.rigid_body
    for displaced, centre in (
        (body.buoyancy_kg, np.zeros(3)),
        (body.entrained_kg, np.array(body.entrained_cg_body_m)),
    ):
        push = displaced * rotation.T @ by_time
        force[:3] += push
        force[3:] += cross_matrix(centre) @ push
    nu_rate = np.linalg.solve(mass_rigid + mass_added, force)
    eta_rate = np.concatenate([ground_ned, attitude_rates_from_body_rates(eta[3:]) @ nu_ground[3:]])
    turns = lag(vehicle.thrusters, rps[:count], command_rps[:count])
    fins = fin_lag(vehicle.fins, rps[count:], command_rps[count:])
    return eta_rate, nu_rate, np.concatenate([turns, fins])


def energy(vehicle: Vehicle, eta: Array, nu: Array) -> float:
    """Kinetic (with that of the water around) and potential energy in still water, J."""
    mass = sum(p.matrix for p in parts(vehicle)) + added_mass(vehicle)
    cg_ned = eta[:3] + ned_from_body(eta[3:]) @ np.array(vehicle.rigid_body.cg_body_m)
    body = vehicle.rigid_body
    potential = GRAVITY * (body.buoyancy_kg * eta[2] - body.dry_kg * cg_ned[2])
    return float(0.5 * nu @ mass @ nu + potential)


def integrate(
    vehicle: Vehicle,
    current: Current,
    eta: Array,
    nu_relative: Array,
    rps: Array,
    at_s: Array,
    commands_rps: Array,
    loads: Array,
) -> tuple[Array, Array, Array]:
    """The motion by an adaptive method of order 8, tight enough to stand for the truth.

    Args:
        vehicle: what moves.
        current: its water.
        eta: (6,) at the first time.
        nu_relative: (6,) relative to the water at the first time.
        rps: (n,) thruster speeds at the first time.
        at_s: (T,) times; commands and loads are constant between neighbours.
        commands_rps: (T - 1, n)
        loads: (T - 1, 6)

    Returns:
        (T, 6) eta, (T, 6) velocity relative to the water, (T, n) thruster speeds.
    """

    def over_water(time_s: float, eta: Array) -> Array:
        velocity = water(current, time_s, eta[2])[0]
        return np.array([*(ned_from_body(eta[3:]).T @ velocity), 0.0, 0.0, 0.0])

    state = np.concatenate([eta, nu_relative + over_water(at_s[0], eta), rps])
    states = [state]
    for i, (command, load) in enumerate(zip(commands_rps, loads, strict=True)):

        def rate(time_s: float, y: Array, command: Array = command, load: Array = load) -> Array:
            return np.concatenate(
                derivative(time_s, y[:6], y[6:12], y[12:], command, load, vehicle, current)
            )

        found = solve_ivp(
            rate, (at_s[i], at_s[i + 1]), states[-1], method="DOP853", rtol=1e-11, atol=1e-12
        )
        if not found.success:
            raise RuntimeError(found.message)
        states.append(found.y[:, -1])
    rows = np.array(states)
    relative = [row[6:12] - over_water(t, row[:6]) for t, row in zip(at_s, rows, strict=True)]
    return rows[:, :6], np.array(relative), rows[:, 12:]
