"""The parameters that a fit may free: their names, places, values and bounds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import FORCES, LIFTS, MOTIONS, Coefficients, both_ways
from alice_survey.sim.vehicle.identification import sensitivity as term
from alice_survey.sim.vehicle.identification.sensitivity import Physics, Terms
from alice_survey.sim.vehicle.vehicle import Vehicle

CURRENTS = ("current_north_mps", "current_east_mps")
NET_BUOYANCY = "net_buoyancy_n"
TRIMS = ("trim_x_m", "trim_y_m", "trim_z_m")
BIASES = tuple(f"bias_{m}_{'mps' if i < 3 else 'rad_s'}" for i, m in enumerate(MOTIONS))
GAINS = tuple(f"gain_{force}" for force in FORCES)
OTHERS = (*CURRENTS, NET_BUOYANCY, *TRIMS, *BIASES, *GAINS)
"""Parameters that are not coefficients: a constant current; buoyancy minus weight; where the weight
acts from the centre of buoyancy (its righting moment only, not the inertia); constant errors of the
velocity and rate sensors; and factors on the forces and moments that a log gives, where its thrusts
are no calibrated ones (speeds of thrusters are not scaled: a bollard pull calibrates those)."""
GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"current": CURRENTS, "trim": TRIMS, "bias": BIASES, "buoyancy": (NET_BUOYANCY,), "gain": GAINS}
)
"""Short names of several parameters."""
QUADRATICS = (term.QUADRATIC, term.QUADRATIC_POS, term.QUADRATIC_NEG)
_GREATEST: Mapping[int, float] = MappingProxyType({term.CURRENT: 5.0, term.TRIM: 1.0})


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameters:
    """Free parameters of a vehicle; everything else is as in the vehicle."""

    vehicle: Vehicle
    names: tuple[str, ...]
    fixed: Mapping[str, float]
    """Values of `OTHERS` that are not free; zero, or as in the vehicle, if not named."""

    @cached_property
    def terms(self) -> Terms:
        """For compiled code."""
        places = [place_of(name) for name in self.names]
        columns = np.array(places, dtype=np.int64).reshape(-1, 3).T
        return Terms(*(np.ascontiguousarray(column) for column in columns))

    @cached_property
    def start(self) -> Array:
        """(P,) values that the vehicle has."""
        return np.array([self._given_value(name) for name in self.names])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """(P,) lower and upper limits.

        Damping of a motion by itself takes energy out and a diagonal added mass is not negative:
        those coefficients are not positive. A current is at most 5 m/s, a lever at most 1 m.
        """
        lower, upper = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for k, name in enumerate(self.names):
            kind, i, j = place_of(name)
            if kind in (term.LINEAR, *QUADRATICS, term.ADDED_MASS) and i == j:
                upper[k] = 0.0
            elif kind == term.GAIN:
                lower[k] = 0.0
            elif kind in _GREATEST:
                lower[k], upper[k] = -_GREATEST[kind], _GREATEST[kind]
        return lower, upper

    def coefficients(self, values: Array, name: str) -> Coefficients:
        """The vehicle's set with the free coefficients replaced."""
        free = {
            key: float(value)
            for key, value in zip(self.names, values, strict=True)
            if key not in OTHERS
        }
        return self.vehicle.coefficients.with_values(name, free)

    def others(self, values: Array) -> dict[str, float]:
        """All parameters that are not coefficients."""
        free = dict(zip(self.names, (float(v) for v in values), strict=True))
        return {name: free.get(name, self._given_value(name)) for name in OTHERS}

    def physics(self, values: Array) -> Physics:
        """The vehicle with values (P,) of the parameters, for compiled code.

        Raises:
            VehicleError: the inertia is not positive definite.
        """
        vehicle = self.vehicle.with_coefficients(self.coefficients(values, "trial"))
        others = self.others(values)
        body = vehicle.plant.body
        body = body._replace(
            buoyancy_n=body.weight_n + others[NET_BUOYANCY],
            cg=np.array([others[name] for name in TRIMS]),
        )
        return Physics(
            body,
            vehicle.plant.propulsion,
            np.array([thruster.time_constant_s for thruster in vehicle.thrusters]),
            np.array([others[name] for name in CURRENTS]),
            np.array([others[name] for name in BIASES]),
            np.array([others[name] for name in GAINS]),
            np.zeros(6),
        )

    def _given_value(self, name: str) -> float:
        if name not in OTHERS:
            return self.vehicle.coefficients.value(name)
        if name in self.fixed:
            return self.fixed[name]
        rigid, body = self.vehicle.rigid_body, self.vehicle.plant.body
        if name == NET_BUOYANCY:
            return float(body.buoyancy_n - body.weight_n)
        if name in GAINS:
            return 1.0
        return float(rigid.cg_body_m[TRIMS.index(name)]) if name in TRIMS else 0.0


def free_parameters(
    vehicle: Vehicle, names: Sequence[str], fixed: Mapping[str, float] | None = None
) -> Parameters:
    """Parameters by their names, or by the names of groups: current, trim, bias, buoyancy, gain.

    Raises:
        VehicleError: a name is not known, comes twice, or is fixed as well; two names stand for one
            added mass; a fixed one is a coefficient.
    """
    flat = [one for name in names for one in GROUPS.get(name, (name,))]
    places: dict[tuple[int, int, int], str] = {}
    for name in flat:
        kind, i, j = place_of(name)
        place = (kind, min(i, j), max(i, j)) if kind == term.ADDED_MASS else (kind, i, j)
        if place in places:
            raise VehicleError(f"{places[place]} and {name} are one parameter: free it once")
        places[place] = name
    for name in flat:
        if both_ways(name) != name and both_ways(name) in flat:
            raise VehicleError(
                f"{both_ways(name)} stands for both ways: free it, or {both_ways(name)}_pos and "
                f"{both_ways(name)}_neg"
            )
    for name in fixed or {}:
        if name not in OTHERS:
            raise VehicleError(f"{name} cannot be held by hand; these can: {', '.join(OTHERS)}")
        if name in flat:
            raise VehicleError(f"{name} is free and held at once")
    return Parameters(vehicle=vehicle, names=tuple(flat), fixed=dict(fixed or {}))


def unit_of(name: str) -> str:
    """The unit of a parameter, SI and radians.

    Raises:
        VehicleError: the name is not known.
    """
    kind, i, j = place_of(name)
    if kind == term.GAIN:
        return "1"
    if kind in (term.CURRENT, term.TRIM, term.BUOYANCY, term.BIAS):
        suffix = name.split("_", 2)[2]
        return {"mps": "m/s", "rad_s": "rad/s", "m": "m", "n": "N"}[suffix]
    force, turning = ("N m" if i >= 3 else "N"), j >= 3
    if kind == term.ADDED_MASS:
        return ("kg", "kg m", "kg m2")[int(i >= 3) + int(turning)]
    if kind == term.LIFT:
        return f"{force} s2/m2"
    power = "2" if kind in QUADRATICS else ""
    return f"{force} s{power}" + ("" if turning else f"/m{power}")


def place_of(name: str) -> tuple[int, int, int]:
    """Kind, row and column of a parameter.

    Raises:
        VehicleError: the name is not known.
    """
    for kind, group in (
        (term.CURRENT, CURRENTS),
        (term.TRIM, TRIMS),
        (term.BIAS, BIASES),
        (term.GAIN, GAINS),
    ):
        if name in group:
            return kind, group.index(name), 0
    if name == NET_BUOYANCY:
        return term.BUOYANCY, 0, 0
    if name in LIFTS:
        return term.LIFT, FORCES.index(name[0]), MOTIONS.index(name[3])
    if len(name) > 2 and name[0] in FORCES and name[1] == "_" and name[2] in MOTIONS:
        kinds = {"dot": term.ADDED_MASS, "": term.LINEAR, name[2]: term.QUADRATIC}
        kinds |= {f"{name[2]}_pos": term.QUADRATIC_POS, f"{name[2]}_neg": term.QUADRATIC_NEG}
        if name[3:] in kinds:
            return kinds[name[3:]], FORCES.index(name[0]), MOTIONS.index(name[2])
    known = ", ".join((*GROUPS, *OTHERS))
    raise VehicleError(
        f"parameter {name!r} is not known; known: X_udot, X_u, X_uu, Z_ww_neg, ..., {known}"
    )
