"""The paper's tables of coefficients next to values computed from shape, as numbers."""

from dataclasses import dataclass

from alice_survey.vehicle.hydrodynamics.geometry import ALICE
from alice_survey.vehicle.hydrodynamics.paper_tables import TABLES, PaperRow
from alice_survey.vehicle.hydrodynamics.parts import Flow, estimate, part_coefficients, parts

CLOSE_PERCENT, NEAR_PERCENT = 1.0, 5.0
"""Differences up to which a row counts as reproduced, and as near."""
_EQUATIONS = {
    "X_udot": "-alpha_0 / (2 - alpha_0) m_e - rho pi/4 w_m^2 h_m",
    "Y_vdot": "-int rho pi r^2 dx - rho pi/4 c_m^2 h_m",
    "Z_wdot": "-int rho pi r^2 dx; b^2 - r^2 + r^4/b^2 at the mounts",
    "Y_rdot": "= N_vdot",
    "N_vdot": "-int x dm, strips of Y_vdot",
    "N_rdot": "-int x^2 dm, strips of Y_vdot",
    "M_wdot": "int x dm, strips of Z_wdot",
    "M_qdot": "-int x^2 dm, strips of Z_wdot",
    "K_vdot": "int z dm, mast in sway",
    "K_pdot": "-int (y^2 + z^2) dm, mast, pods, fins",
    "N_pdot": "int x z dm, mast in sway",
    "M_udot": "-int z dm, mast in surge",
    "X_uu": "-rho/2 A (0.44 d/l + 4 C_f (l/d + sqrt(d/l))); strut; tunnels",
    "Y_vv": "-rho/2 1.2 k_1(l/d) int 2r dx; mast as a plate",
    "Z_ww": "-rho/2 1.2 k_1(l/d) int 2r dx; mounts as plates",
    "N_vv": "-int x dD, strips of Y_vv",
    "M_ww": "int x dD, strips of Z_ww",
    "N_rr": "-int |x|^3 dD, strips of Y_vv",
    "M_qq": "-int |x|^3 dD, strips of Z_ww",
    "K_vv": "int z dD, mast in sway",
    "K_pp": "-int |z|^3 dD of the mast - |y|^3 D of pods, mounts",
    "K_rr": "int z x |x| dD, mast in sway",
    "M_uu": "-int z dD, mast in surge",
    "Y_uv": "-rho/2 d^2 0.003 (180/pi) l/d",
    "Z_uw": "-rho/2 d^2 0.003 (180/pi) l/d",
    "M_uw": "-Z_uw x_cp, x_cp = x_n - 0.65 l",
    "N_uv": "Y_uv x_cp, x_cp = x_n - 0.65 l",
}  # fmt: skip
"""By SNAME name, dm and dD being the positive mass and drag of an element. C_f is ITTC-57's."""

_HULL_EQUATIONS = {
    "X_uu": "-rho/2 A (0.44 d/l + 4 C_f (l/d + sqrt(d/l)))",
    "Y_vv": "-rho/2 1.2 k_1(l/d) int 2r dx",
    "Z_ww": "-rho/2 1.2 k_1(l/d) int 2r dx",
}


@dataclass(frozen=True, kw_only=True)
class CoefficientRow:
    """One row of the paper and the value computed for it."""

    table: str
    coefficient: str
    part: str
    printed: float
    paper: float
    """Printed value with its sign corrected."""
    computed: float
    difference_percent: float
    """Difference relative to the paper's size; positive is a greater value."""
    mark: str
    """`reproduced` within 1 %, `near` within 5 %, else `no`."""
    paper_other: float | None
    """CFD or calibrated value."""
    factor: float | None
    """Calibration factor as printed, table V."""
    equation: str


def coefficient_rows() -> tuple[CoefficientRow, ...]:
    """Every row of the paper's three tables."""
    whole = estimate(ALICE).values
    hull = next(part_coefficients(p) for p in parts(ALICE, Flow()) if p.name == "hull")
    rows = []
    for row in TABLES:
        computed = (hull if row.part == "hull" else whole)[row.coefficient]
        difference = 100.0 * (computed - row.value) / abs(row.value)
        rows.append(
            CoefficientRow(
                table=row.table,
                coefficient=row.coefficient,
                part=row.part,
                printed=row.printed,
                paper=row.value,
                computed=computed,
                difference_percent=difference,
                mark=_mark(difference),
                paper_other=row.other,
                factor=row.factor,
                equation=_equation(row),
            )
        )
    return tuple(rows)


def _mark(difference_percent: float) -> str:
    if abs(difference_percent) <= CLOSE_PERCENT:
        return "reproduced"
    return "near" if abs(difference_percent) <= NEAR_PERCENT else "no"


def _equation(row: PaperRow) -> str:
    whole = _EQUATIONS[row.coefficient]
    return _HULL_EQUATIONS.get(row.coefficient, whole) if row.part == "hull" else whole
