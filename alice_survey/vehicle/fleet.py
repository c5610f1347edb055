"""The vehicles that are known by name: ALICE and the SPARUS II it was built from."""

from alice_survey.errors import VehicleError
from alice_survey.vehicle.coefficients import Coefficients
from alice_survey.vehicle.propulsion import Thruster
from alice_survey.vehicle.vehicle import RigidBody, Vehicle

_ESTIMATED = {
    "X_udot": -2.806, "Y_vdot": -78.459, "Y_rdot": -8.529, "K_vdot": -0.216, "K_pdot": -0.042,
    "N_pdot": 0.102, "Z_wdot": -69.536, "M_udot": 0.0321, "M_wdot": 11.253, "M_qdot": -20.963,
    "N_rdot": -22.537, "X_uu": -7.616, "Y_vv": -214.398, "Z_ww": -214.398, "M_ww": 26.634,
    "N_vv": -26.17, "K_pp": -0.192, "K_vv": -3.397, "M_qq": -180.682, "N_rr": -180.381,
    "M_uu": 0.144, "K_rr": 0.753, "Y_uv": -39.71, "Z_uw": -39.71, "M_uw": -8.498, "N_uv": 8.498,
}  # fmt: skip
_CFD = {
    "X_uu": -8.375, "M_uu": 0.9, "Y_vv": -146.95, "K_vv": -6.5, "N_vv": -12.675, "N_rr": -26.377,
    "K_rr": 0.558, "K_pp": -0.287, "M_qq": -34.551, "Z_ww": -174.525, "M_ww": 11.4,
    "Y_uv": -35.428, "Z_uw": -35.428, "M_uw": -3.37, "N_uv": 3.37,
}  # fmt: skip
_CALIBRATED = {
    "X_udot": -28.06, "Y_vdot": -23.53, "Y_rdot": -2.559, "Z_wdot": -27.812, "M_wdot": 5.626,
    "M_qdot": -10.481, "N_rdot": -11.268, "X_uu": -15.23, "Y_vv": -321.597, "Z_ww": -326.169,
    "M_ww": 0.096, "N_vv": -1.954, "N_rr": -54.114,
}  # fmt: skip

ESTIMATED = Coefficients(name="estimated", values=_ESTIMATED)
CFD = ESTIMATED.replaced("cfd", _CFD)
CALIBRATED = CFD.replaced("calibrated", _CALIBRATED)


_MERIT = 0.07 / 0.4566**1.5
"""k_q over k_t^1.5 of a Wageningen B propeller with three blades, blade area ratio 0.718, pitch 1.0,
in water at rest (k_t 0.4566, k_q 0.0700; T. I. Fossen's MSS toolbox, remus100): 0.227. No torque of
these propellers could be found: inferred to be as good as that one, both ways. Momentum theory asks
for 0.090 at least; Stonefish's k_q of 0.01 for a k_t of 0.698 is 0.017."""
_KT_FALL, _KQ_FALL = (1 - 0.1798 / 0.4566) / 0.6632, (1 - 0.0312 / 0.07) / 0.6632
"""Share of k_t and k_q lost per advance ratio, of the same propeller (k_t 0.1798 and k_q 0.0312 at
J = 0.6632): inferred for the others."""
_EFFICIENCY = 0.55
"""Shaft over electrical power: a T200 takes 390 W (24 A at 16 V, Blue Robotics) for 51.4 N, which
by the k_q above is 216 W on the shaft. Inferred for SPARUS II's own thrusters, of which no power is
published."""
_WAKE, _DEDUCTION = 0.19, 0.17
"""Of the twin screws, by J. Holtrop and G. G. J. Mennen, Int. Shipbuilding Progress 29, 1982:
w = 0.3095 C_B + 10 C_V C_B - 0.23 D / sqrt(B T) and t = 0.325 C_B - 0.1885 D / sqrt(B T), with
C_B 0.72 (75 L in 1.96 x 0.23 x 0.23 m), C_V 0.006 (ITTC-57 and form factor 1.07 at 0.25 m/s) and
D 0.08 m. Inferred: it is a regression over ships; Burcher and Rydill's values for submarines,
which the paper takes, could not be read. Delphin2 (one screw on the axis) has 0.36 and 0.11."""
_JET_LOSS = 0.27
"""Delphin2's simulator has exp(-0.35 u^2), u in m/s, for tunnels of 70 mm with jets of 0.883 m/s
(github.com/Southampton-Maritime-Robotics/DelphinROSv3, the dead reckoner): 0.35 x 0.883^2. Inferred
to scale with the jet as Palmer has it. His moment arm could not be read: no `jet_centre_m`."""
_JET_DRAG = (0.565993917435650, 7.608906885747783, 0.056535966126787, 0.896791505996002)
"""From the same file, of the same group as the paper's source: a hull of 1.96 m and 0.080 m^3 with
tunnels of 70 mm, nearly ALICE's."""


def _kq(kt: float) -> float:
    return float(_MERIT * kt**1.5)


def _t200(name: str, x_m: float) -> Thruster:
    return Thruster(
        name=name, kind="tunnel", position_body_m=(x_m, 0.0, 0.0), direction_body=(0.0, 1.0, 0.0),
        diameter_m=0.076, kt_forward=0.47, kt_reverse=0.40, kq_forward=_kq(0.47),
        kq_reverse=_kq(0.40), handedness=1, most_rps=55.0, dead_band_rps=5.0, time_constant_s=0.15,
        advance_slope=0.47 * _KT_FALL, torque_slope=_kq(0.47) * _KQ_FALL, jet_loss=_JET_LOSS,
        jet_drag=_JET_DRAG, efficiency=_EFFICIENCY,
    )  # fmt: skip


def _main(name: str, y_m: float, handedness: int) -> Thruster:
    return Thruster(
        name=name, kind="open", position_body_m=(-0.573, y_m, 0.0), direction_body=(1.0, 0.0, 0.0),
        diameter_m=0.08, kt_forward=0.698, kt_reverse=0.293, kq_forward=_kq(0.698),
        kq_reverse=_kq(0.293), handedness=1 if handedness > 0 else -1, most_rps=50.0,
        dead_band_rps=2.0, time_constant_s=0.8, advance_slope=0.698 * _KT_FALL,
        torque_slope=_kq(0.698) * _KQ_FALL, thrust_deduction=_DEDUCTION, wake_fraction=_WAKE,
        efficiency=_EFFICIENCY,
    )  # fmt: skip


_HEAVE = Thruster(
    name="vertical", kind="tunnel", position_body_m=(0.0, 0.0, 0.07),
    direction_body=(0.0, 0.0, 1.0), diameter_m=0.08, kt_forward=0.537, kt_reverse=0.278,
    kq_forward=_kq(0.537), kq_reverse=_kq(0.278), handedness=1, most_rps=50.0, dead_band_rps=2.0,
    time_constant_s=0.4, advance_slope=0.537 * _KT_FALL, torque_slope=_kq(0.537) * _KQ_FALL,
    jet_loss=_JET_LOSS, jet_drag=_JET_DRAG, efficiency=_EFFICIENCY,
)  # fmt: skip
_RIGID = RigidBody(
    dry_kg=52.0, buoyancy_kg=52.0, entrained_kg=23.0, cg_body_m=(0.0, 0.0, 0.0365),
    inertia_kg_m2=(0.52, 7.47, 7.39), entrained_inertia_kg_m2=(0.15, 10.0, 10.0),
)  # fmt: skip


def vehicle(name: str, coefficients: str = "calibrated") -> Vehicle:
    """A vehicle by its name, `alice` or `sparus2`, with a named set of coefficients.

    Raises:
        VehicleError: a name is not known.
    """
    sets = {"estimated": ESTIMATED, "cfd": CFD, "calibrated": CALIBRATED}
    if coefficients not in sets:
        raise VehicleError(f"coefficients {coefficients!r} are not known; known: {', '.join(sets)}")
    horizontal = (_main("starboard", 0.167, -1), _main("port", -0.167, 1))
    thrusters = {
        "alice": (*horizontal, _HEAVE, _t200("bow", 0.86), _t200("stern", -0.76)),
        "sparus2": (*horizontal, _HEAVE),
    }
    if name not in thrusters:
        raise VehicleError(f"vehicle {name!r} is not known; known: {', '.join(thrusters)}")
    return Vehicle(
        name=name, rigid_body=_RIGID, coefficients=sets[coefficients], thrusters=thrusters[name]
    )
