"""Hydrodynamic coefficients by their SNAME names, and their matrices.

A name is the force or moment, an underscore, and what it is the derivative by: `Y_vdot` (added
mass), `Y_v` (linear damping), `Y_vv` (of v |v|), `Y_uv` (body lift). Values are as in SNAME:
derivatives of the force that the water exerts, so that damping and added mass are negative.

A hull that is not the same both ways has two values of a quadratic damping: `Z_ww_pos` while w is
positive (sinking) and `Z_ww_neg` while it is negative (rising); each counts instead of `Z_ww`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array

FORCES = "XYZKMN"
MOTIONS = "uvwpqr"
LIFTS = ("Y_uv", "Z_uw", "M_uw", "N_uv")
_SYMMETRY = 0.02
"""Most relative difference of the two names of one added mass, by rounding in a table."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Coefficients:
    """A named set of hydrodynamic coefficients, SI units (radians)."""

    name: str
    values: Mapping[str, float]
    """SNAME name to value; others are zero, except for the mirror of an added mass."""

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            if _kind(name) is None:
                raise VehicleError(
                    f"coefficient {name!r} is not known; names are like Y_vdot, Y_vv"
                )
            if not np.isfinite(value):
                raise VehicleError(f"coefficient {name} is {value}, not a finite number")

    @cached_property
    def added_mass(self) -> Array:
        """M_A, (6, 6), kg and kg m and kg m^2: minus the derivatives, symmetric.

        Raises:
            VehicleError: two names of one added mass (Y_rdot, N_vdot) differ by more than rounding.
        """
        given = self._matrix("dot")
        matrix = np.zeros((6, 6))
        for i in range(6):
            for j in range(i, 6):
                a, b = given[i, j], given[j, i]
                both = np.array([value for value in (a, b) if not np.isnan(value)])
                if len(both) == 2 and abs(a - b) > _SYMMETRY * max(abs(a), abs(b)):
                    raise VehicleError(
                        f"{FORCES[i]}_{MOTIONS[j]}dot = {a:g} and {FORCES[j]}_{MOTIONS[i]}dot = "
                        f"{b:g} are one added mass: make them equal"
                    )
                matrix[i, j] = matrix[j, i] = -both.mean() if len(both) else 0.0
        return matrix

    @cached_property
    def linear(self) -> Array:
        """(6, 6) coefficients of nu: force i is sum over j of [i, j] nu_j."""
        return np.nan_to_num(self._matrix("linear"))

    @cached_property
    def quadratic(self) -> Array:
        """(6, 6) coefficients of nu |nu|: force i is sum over j of [i, j] nu_j |nu_j|, nu_j > 0."""
        return self._one_way("quadratic_pos")

    @cached_property
    def quadratic_back(self) -> Array:
        """(6, 6) the same where nu_j < 0."""
        return self._one_way("quadratic_neg")

    def value(self, name: str) -> float:
        """A coefficient by its name; of one way what is given for both, if it is not given."""
        own = self.values.get(name)
        return self.values.get(both_ways(name), 0.0) if own is None else own

    @cached_property
    def lift(self) -> Array:
        """(4,) body lift: Y_uv, Z_uw, M_uw, N_uv."""
        return np.array([self.values.get(name, 0.0) for name in LIFTS])

    def with_values(self, name: str, values: Mapping[str, float]) -> "Coefficients":
        """Another set with some values replaced or added.

        An added mass replaces its mirror too: a new N_vdot drops the old Y_rdot; and a damping of
        both ways those of one: a new Z_ww drops Z_ww_pos and Z_ww_neg.
        """
        kept = {
            key: value
            for key, value in self.values.items()
            if _mirror(key) not in values
            and (both_ways(key) == key or both_ways(key) not in values)
        }
        return Coefficients(name=name, values={**kept, **values})

    def _one_way(self, kind: str) -> Array:
        both, own = self._matrix("quadratic"), self._matrix(kind)
        return np.nan_to_num(np.where(np.isnan(own), both, own))

    def _matrix(self, kind: str) -> Array:
        matrix = np.full((6, 6), np.nan)
        for name, value in self.values.items():
            if _kind(name) == kind:
                matrix[FORCES.index(name[0]), MOTIONS.index(name[2])] = value
        return matrix


def both_ways(name: str) -> str:
    """Name of the damping of both ways that a damping of one way stands for; others unchanged."""
    return name[:-4] if name.endswith(("_pos", "_neg")) else name


def _kind(name: str) -> str | None:
    """`dot`, `linear`, `quadratic` (`_pos`, `_neg`), `lift`, or None if it is not a name."""
    if name in LIFTS:
        return "lift"
    if len(name) < 3 or name[0] not in FORCES or name[1] != "_" or name[2] not in MOTIONS:
        return None
    kinds = {"dot": "dot", "": "linear", name[2]: "quadratic"}
    kinds |= {f"{name[2]}{way}": f"quadratic{way}" for way in ("_pos", "_neg")}
    return kinds.get(name[3:])


def _mirror(name: str) -> str:
    """Name of an added mass with force and motion exchanged; other names unchanged."""
    if _kind(name) != "dot":
        return name
    force, motion = FORCES.index(name[0]), MOTIONS.index(name[2])
    return f"{FORCES[motion]}_{MOTIONS[force]}dot"
