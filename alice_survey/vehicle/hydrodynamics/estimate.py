"""A whole set of coefficients from geometry alone."""

from collections.abc import Sequence

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.vehicle.coefficients import FORCES, LIFTS, MOTIONS, Coefficients
from alice_survey.vehicle.hydrodynamics.geometry import Geometry
from alice_survey.vehicle.hydrodynamics.lift import body_lift
from alice_survey.vehicle.hydrodynamics.parts import Flow, HullPart, parts

_NOTHING = 1e-9
"""Below this an entry is a zero by symmetry that rounding hides."""


def estimate(geometry: Geometry, flow: Flow | None = None) -> Coefficients:
    """Added mass, quadratic damping and body lift of a shape, as the set `computed`.

    Entries that the paper leaves out (Y_rr, Z_qq, Y_pdot ...) are kept: they follow from the same
    strips.

    Args:
        geometry: the vehicle.
        flow: the water; sea water at the paper's speed if not given.
    """
    flow = flow or Flow()
    each = parts(geometry, flow)
    outline = geometry.outline
    lift = body_lift(outline.length_m, outline.diameter_m, outline.nose_x_m, flow.density_kg_m3)
    values = {
        **named(sum((part.added_mass for part in each), np.zeros((6, 6))), kind="dot"),
        **named(sum((part.quadratic for part in each), np.zeros((6, 6))), kind="quadratic"),
        **dict(zip(LIFTS, lift, strict=True)),
    }
    return Coefficients(name="computed", values=values)


def part_coefficients(part: HullPart) -> dict[str, float]:
    """One part's share by name."""
    return {**named(part.added_mass, kind="dot"), **named(part.quadratic, kind="quadratic")}


def named(matrix: Array, *, kind: str) -> dict[str, float]:
    """A (6, 6) matrix by SNAME names: of `dot`, M_A with its sign turned; of `quadratic`, as is."""
    names: Sequence[tuple[int, int]] = [(i, j) for i in range(6) for j in range(6)]
    return {
        f"{FORCES[i]}_{MOTIONS[j]}dot" if kind == "dot" else f"{FORCES[i]}_{MOTIONS[j] * 2}": float(
            -matrix[i, j] if kind == "dot" else matrix[i, j]
        )
        for i, j in names
        if abs(matrix[i, j]) > _NOTHING
    }
