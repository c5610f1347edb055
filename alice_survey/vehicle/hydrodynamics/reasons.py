"""Which equation a coefficient comes from, and why some of the paper's cannot be had from shape."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from alice_survey.vehicle.hydrodynamics import added_mass
from alice_survey.vehicle.hydrodynamics.geometry import Geometry
from alice_survey.vehicle.hydrodynamics.paper_tables import PaperRow
from alice_survey.vehicle.hydrodynamics.parts import Flow

EQUATIONS = {
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


def equation(row: PaperRow) -> str:
    """The equation that a row's coefficient is computed by."""
    whole = EQUATIONS[row.coefficient]
    return _HULL_EQUATIONS.get(row.coefficient, whole) if row.part == "hull" else whole


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the reasons are drawn from."""

    geometry: Geometry
    flow: Flow
    shares: Mapping[str, Mapping[str, float]]
    """Coefficients of each part by its name."""


def reason(row: PaperRow, evidence: Evidence) -> str:
    """Why the paper's value in a row is not what its shape gives; empty if nothing is known."""
    if row.table == "V" and _is_damping(row.coefficient):
        return "this column holds the paper's CFD here, not its formulas: see table IV"
    for names, explain in _EXPLANATIONS:
        if row.coefficient in names:
            return explain(evidence)
    return ""


def _is_damping(name: str) -> bool:
    return len(name) == 4 and name[2] == name[3]


def _surge_mass(evidence: Evidence) -> str:
    outline = evidence.geometry.outline
    hull, mast = evidence.shares["hull"], evidence.shares["mast"]
    literal = added_mass.ellipsoid_axial_as_printed(
        outline.length_m, outline.diameter_m, evidence.flow.density_kg_m3
    )
    return (
        f"the paper's value follows from e = 1 - (d/l)^2 as printed: hull {literal:.3f} + mast "
        f"{-mast['X_udot']:.3f} = {literal - mast['X_udot']:.3f} kg; with e = sqrt(1 - (d/l)^2) "
        f"the hull has {-hull['X_udot']:.3f} kg"
    )


def _mast_arm(evidence: Evidence) -> str:
    mass, arm = -evidence.shares["mast"]["Y_vdot"], -evidence.geometry.mast.middle_z_m
    return (
        f"the paper's K_vdot asks an arm of {0.216 / mass:.2f} m for {mass:.2f} kg of mast, its "
        f"K_pp / K_vv one of {_DRAG_ARM_M:.3f} m; here {arm:.3f} m"
    )


def _roll_mass(evidence: Evidence) -> str:
    mast, pods = -evidence.shares["mast"]["K_pdot"], -evidence.shares["pods"]["K_pdot"]
    return (
        "the paper has the mast alone, on a short arm (see K_vdot); over its height the mast has "
        f"{mast:.3f}, the pods {pods:.3f}"
    )


def _mast_pitch_mass(evidence: Evidence) -> str:
    mass, arm = -evidence.shares["mast"]["X_udot"], -evidence.geometry.mast.middle_z_m
    return (
        f"the paper's equation, {mass:.3f} kg of mast (as in its X_udot) on (d_h + h_m) / 2 = "
        f"{arm:.3f} m, gives the value computed and not the one printed"
    )


def _finned(evidence: Evidence) -> str:
    outline, mount = evidence.geometry.outline, evidence.geometry.mount
    hull = -evidence.shares["hull"]["Y_vdot"]
    a_metre = evidence.flow.density_kg_m3 * math.pi * (outline.diameter_m / 2.0) ** 2
    return (
        "no fin lowers added mass: the finned section as printed seems to count for nothing. The "
        f"paper's Z_wdot is the bare hull, {hull:.2f} kg, without {(hull - 69.536) / a_metre:.3f} "
        f"m of it (the mounts' chord is {mount.chord_m:.3f} m); M_wdot and M_qdot are of the same "
        "strips"
    )


def _mast_drag_along(evidence: Evidence) -> str:
    mast, geometry = evidence.geometry.mast, evidence.geometry
    arm, computed = -mast.middle_z_m, -evidence.shares["mast"]["X_uu"]
    implied = 0.144 / arm
    head = 0.5 * evidence.flow.density_kg_m3 * mast.width_m * mast.height_m
    others = -sum(share.get("X_uu", 0.0) for share in evidence.shares.values()) - computed
    return (
        f"the mast: M_uu = 0.144 makes it {implied:.2f} of X_uu, C_d {implied / head:.2f} by "
        f"frontal area, an edge of a plate; as an elliptic strut at Re "
        f"{evidence.flow.reynolds(geometry.mast.chord_m):.2g} it has {computed:.2f}, C_d "
        f"{computed / head:.2f} (CFD's M_uu: {0.9 / arm:.2f}). With the paper's mast X_uu would "
        f"be {-others - implied:.2f}"
    )


def _cross_flow_moment(evidence: Evidence) -> str:
    return (
        "the paper's 42.515 of the hull does not follow from its outline: the strips that give its "
        f"Y_vv have {-evidence.shares['hull']['N_vv']:.1f} (CFD 16.9); mast and pods sit aft and "
        "take from it"
    )


def _turning_drag(evidence: Evidence) -> str:
    outline, hull = evidence.geometry.outline, evidence.shares["hull"]
    ends = -hull["Y_vv"] * (outline.length_m / 2.0) ** 3
    return (
        f"Y_vv of the hull times (l/2)^3 is {ends:.1f}, as if all drag sat at the ends, and with "
        f"the mast {ends - evidence.shares['mast']['N_rr']:.1f}; integrating |x|^3 over the strips "
        f"the hull has {-hull['N_rr']:.1f} (CFD 26.4 in all)"
    )


def _mast_drag_across(evidence: Evidence) -> str:
    return (
        f"the paper's K_pp / K_vv is a mast of {3.397 / _DRAG_ARM_M:.1f} kg/m at {_DRAG_ARM_M:.3f} "
        f"m; as a plate of its size on a wall it has {-evidence.shares['mast']['Y_vv']:.1f} at "
        f"{-evidence.geometry.mast.middle_z_m:.3f} m"
    )


def _roll_drag(evidence: Evidence) -> str:
    mast, arm = evidence.shares["mast"], -evidence.geometry.mast.middle_z_m
    return (
        f"the paper lumps the mast halfway up, here {mast['Y_vv'] * arm**3:.3f}, and leaves out "
        f"the pods; over its height the mast has {mast['K_pp']:.3f}, the pods "
        f"{evidence.shares['pods']['K_pp']:.3f}"
    )


_DRAG_ARM_M = math.sqrt(0.192 / 3.397)
"""Of the mast by the paper's K_pp = K_vv h^2."""

_EXPLANATIONS: tuple[tuple[tuple[str, ...], Callable[[Evidence], str]], ...] = (
    (("X_udot",), _surge_mass),
    (("K_vdot", "N_pdot"), _mast_arm),
    (("K_pdot",), _roll_mass),
    (("M_udot",), _mast_pitch_mass),
    (("Z_wdot", "M_wdot", "M_qdot"), _finned),
    (("X_uu", "M_uu"), _mast_drag_along),
    (("N_vv", "M_ww"), _cross_flow_moment),
    (("N_rr", "M_qq"), _turning_drag),
    (("K_vv", "K_rr"), _mast_drag_across),
    (("K_pp",), _roll_drag),
)
