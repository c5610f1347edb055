"""A vehicle as a value: rigid body, coefficients and thrusters, and derived matrices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import ConfigDict

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import Coefficients
from alice_survey.sim.vehicle.dynamics import Body, Plant
from alice_survey.sim.vehicle.fins import Fin, pack_fins
from alice_survey.sim.vehicle.propulsion import Thruster, pack
from alice_survey.sim.vehicle.sea import GRAVITY


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


@dataclass(frozen=True, kw_only=True)
class RigidBody:
    """Mass and its distribution; lengths from the centre of buoyancy, the body's origin."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    dry_kg: float
    """Mass in air, drained."""
    buoyancy_kg: float
    """Mass of the water that the drained vehicle displaces."""
    entrained_kg: float
    """Water inside the hull that moves along; its weight is carried by its own buoyancy."""
    cg_body_m: tuple[float, float, float]
    """Centre of gravity of the drained vehicle."""
    inertia_kg_m2: tuple[float, float, float]
    """Inertia of the drained vehicle about its centre of gravity, roll, pitch, yaw."""
    entrained_cg_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entrained_inertia_kg_m2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """About its own centre of gravity."""

    @cached_property
    def mass_matrix(self) -> Array:
        """M_RB, (6, 6), about the origin (Fossen 2011, 3.44), with the water inside."""
        total = np.zeros((6, 6))
        for mass, cg, inertia in (
            (self.dry_kg, self.cg_body_m, self.inertia_kg_m2),
            (self.entrained_kg, self.entrained_cg_body_m, self.entrained_inertia_kg_m2),
        ):
            s = _cross_matrix(cg)
            total[:3, :3] += mass * np.eye(3)
            total[:3, 3:] -= mass * s
            total[3:, :3] += mass * s
            total[3:, 3:] += np.diag(inertia) - mass * s @ s
        return total

    @cached_property
    def displaced(self) -> Array:
        """(6, 3) momentum, about the origin, of the displaced water by its velocity."""
        inside = self.entrained_kg
        return np.vstack([
            (self.buoyancy_kg + inside) * np.eye(3),
            inside * _cross_matrix(self.entrained_cg_body_m),
        ])  # fmt: skip


def _cross_matrix(a: tuple[float, float, float]) -> Array:
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Vehicle:
    """All inputs of the equations of motion of a vehicle."""

    name: str
    rigid_body: RigidBody
    coefficients: Coefficients
    thrusters: tuple[Thruster, ...]
    fins: tuple[Fin, ...] = ()
    """Drives of fins: one or more surfaces each, that turn together."""
    hull: Hull = POINT
    """Extent of the hull; its origin alone for a vehicle that is not flown."""
    density_kg_m3: float = 1025.0
    depth_rating_m: float | None = None
    battery_wh: float | None = None
    hotel_w: float | None = None
    """Everything but thrusters and strobes."""

    @cached_property
    def mass(self) -> Array:
        """M = M_RB + M_A, (6, 6).

        Raises:
            VehicleError: it is not positive definite.
        """
        mass: Array = self.rigid_body.mass_matrix + self.coefficients.added_mass
        minimum = float(np.linalg.eigvalsh(mass)[0])
        if minimum <= 0:
            raise VehicleError(
                f"the inertia matrix of {self.name} with {self.coefficients.name!r} coefficients "
                f"has the eigenvalue {minimum:.3g}: an added mass has the wrong sign"
            )
        return mass

    @cached_property
    def plant(self) -> Plant:
        """For compiled code."""
        rigid, kinds = self.rigid_body, self.coefficients
        displaced_kg = rigid.buoyancy_kg + rigid.entrained_kg
        inertia = rigid.mass_matrix[:, :3]
        body = Body(
            mass=np.ascontiguousarray(self.mass),
            mass_inverse=np.ascontiguousarray(np.linalg.inv(self.mass)),
            in_current=np.ascontiguousarray(np.hstack([inertia, inertia - rigid.displaced])),
            linear=kinds.linear,
            quadratic=kinds.quadratic,
            quadratic_back=kinds.quadratic_back,
            lift=kinds.lift,
            weight_n=rigid.dry_kg * GRAVITY,
            buoyancy_n=rigid.buoyancy_kg * GRAVITY,
            cg=np.array(rigid.cg_body_m),
        )
        return Plant(
            body,
            pack(self.thrusters, self.density_kg_m3, displaced_kg),
            pack_fins(self.fins, self.density_kg_m3),
        )

    @property
    def actuators(self) -> int:
        """Number of thrusters and drives of fins."""
        return len(self.thrusters) + len(self.fins)

    @cached_property
    def configuration_matrix(self) -> Array:
        """B, (6, n): wrench = B thrust; the arms, and the torque of propellers at forward speed."""
        columns = []
        for thruster in self.thrusters:
            direction = np.array(thruster.direction_body)
            moment = np.cross(thruster.position_body_m, direction)
            kept = thruster.kt_forward * (1.0 - thruster.thrust_deduction)
            reaction = thruster.diameter_m * thruster.kq_forward / kept
            columns.append([*direction, *(moment - thruster.handedness * reaction * direction)])
        return np.array(columns, np.float64).reshape(-1, 6).T

    def with_coefficients(self, coefficients: Coefficients) -> "Vehicle":
        """The same vehicle with another set."""
        return replace(self, coefficients=coefficients)

    def health_of(self, left: Mapping[str, float]) -> Array:
        """Share of its greatest speed squared that each thruster has left, (n,).

        Args:
            left: by thruster, 0 failed to 1 intact; intact when not named.

        Raises:
            VehicleError: a thruster is not known.
        """
        names = [thruster.name for thruster in self.thrusters]
        for name in left:
            if name not in names:
                raise VehicleError(
                    f"{self.name} has no thruster {name!r}; it has {', '.join(names)}"
                )
        return np.array([left.get(name, 1.0) for name in names])

    def without(self, thrusters: Sequence[str]) -> "Vehicle":
        """The same vehicle with some thrusters taken off."""
        return self.weaken(dict.fromkeys(thrusters, 0.0))

    def weaken(self, left: Mapping[str, float]) -> "Vehicle":
        """The same vehicle with weaker thrusters, and without those that have failed.

        Args:
            left: as in `health_of`.

        Raises:
            VehicleError: a thruster is not known.
        """
        pairs = zip(self.thrusters, self.health_of(left).tolist(), strict=True)
        kept = tuple(
            replace(t, most_rps=t.most_rps * share**0.5) for t, share in pairs if share > 0
        )
        return replace(self, thrusters=kept)
