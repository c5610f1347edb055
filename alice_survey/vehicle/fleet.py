"""The vehicles known by name: ALICE and the SPARUS II it was built from.

Sources as in `hydrodynamics.geometry`: "model" is the public model of SPARUS II in Stonefish,
"Toulon" the model of the same vehicle in the MIR course there (Parameters.m).
"""

from functools import cache
from typing import Literal

from alice_survey.base.errors import VehicleError
from alice_survey.vehicle.coefficients import Coefficients
from alice_survey.vehicle.hydrodynamics.entrained import entrained_water
from alice_survey.vehicle.hydrodynamics.geometry import (
    ALICE,
    ALICE_PROPELLER_X_M,
    PROPELLER_X_M,
    SPARUS2,
    Geometry,
)
from alice_survey.vehicle.hydrodynamics.paper_tables import CALIBRATED, CFD, ESTIMATED
from alice_survey.vehicle.hydrodynamics.parts import estimate
from alice_survey.vehicle.propulsion import Thruster
from alice_survey.vehicle.vehicle import RigidBody, Vehicle

DENSITY = 1025.0
"""Density of sea water, kg/m^3, for which the paper's tables apply."""
DEPTH_RATING_M = 200.0
"""Carreras et al. 2018, for SPARUS II; ALICE has its hull."""
BATTERY_WH = 1400.0
"""SPARUS II carries 1.4 kWh of Li-ion cells by its maker's data sheet; more in
`missions.route.energy`, where the hotel load is derived, too."""
HOTEL_W = 60.0
GEOMETRIES = {"alice": ALICE, "sparus2": SPARUS2}
PAPER_SETS = {"estimated": ESTIMATED, "cfd": CFD, "calibrated": CALIBRATED}
OWN_SET = "calibrated"
"""The set that is meant where none is named."""
SETS = (*PAPER_SETS, "computed")
"""Names of the sets of coefficients: the paper's, and `computed` from the vehicle's geometry. The
paper's are of ALICE; with `sparus2` they stand for a hull 0.4 m shorter."""

_MERIT = 0.07 / 0.4566**1.5
"""k_q over k_t^1.5 of a Wageningen B propeller with three blades, blade area ratio 0.718, pitch 1,
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
"""w and t of the twin screws, by J. Holtrop and G. G. J. Mennen, Int. Shipb. Progress 29, 1982:
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


_T200_KT, _T200_KT_REVERSE = 0.472, 0.398
"""Blue Robotics' charts: 4.48e-6 and 3.78e-6 N per rpm^2 up to some 3400 rpm. At most 56.5 rev/s,
51.5 N: what it reaches on 16 V."""


def usual_kq(kt: float) -> float:
    """k_q of a propeller of this k_t that is as good as the one above."""
    return float(_MERIT * kt**1.5)


def _t200(name: str, x_m: float) -> Thruster:
    """A lateral thruster. Its dead band is 28 of 400 us of command (Blue Robotics): 4 to 5 rev/s.

    Inferred: a lag of 0.15 s, and propellers that turn by the right hand.
    """
    return Thruster(
        name=name, kind="tunnel", position_body_m=(x_m, 0.0, 0.0), direction_body=(0.0, 1.0, 0.0),
        diameter_m=0.076, kt_forward=_T200_KT, kt_reverse=_T200_KT_REVERSE,
        kq_forward=usual_kq(_T200_KT), kq_reverse=usual_kq(_T200_KT_REVERSE), handedness=1,
        most_rps=56.5, dead_band_rps=5.0, time_constant_s=0.15,
        advance_slope=_T200_KT * _KT_FALL, torque_slope=usual_kq(_T200_KT) * _KQ_FALL,
        jet_loss=_JET_LOSS, jet_drag=_JET_DRAG, efficiency=_EFFICIENCY,
    )  # fmt: skip


def _main(name: str, x_m: float, y_m: float, handedness: Literal[-1, 1]) -> Thruster:
    """A horizontal thruster: place, k_t, 3000 rpm (model) and lag (Toulon); dead band inferred."""
    return Thruster(
        name=name, kind="open", position_body_m=(x_m, y_m, 0.0), direction_body=(1.0, 0.0, 0.0),
        diameter_m=0.08, kt_forward=0.698, kt_reverse=0.293, kq_forward=usual_kq(0.698),
        kq_reverse=usual_kq(0.293), handedness=handedness, most_rps=50.0,
        dead_band_rps=2.0, time_constant_s=0.8, advance_slope=0.698 * _KT_FALL,
        torque_slope=usual_kq(0.698) * _KQ_FALL, thrust_deduction=_DEDUCTION, wake_fraction=_WAKE,
        efficiency=_EFFICIENCY,
    )  # fmt: skip


_HEAVE = Thruster(
    name="vertical", kind="tunnel", position_body_m=(0.0, 0.0, 0.07),
    direction_body=(0.0, 0.0, 1.0), diameter_m=0.08, kt_forward=0.537, kt_reverse=0.278,
    kq_forward=usual_kq(0.537), kq_reverse=usual_kq(0.278), handedness=1, most_rps=50.0,
    dead_band_rps=2.0, time_constant_s=0.4, advance_slope=0.537 * _KT_FALL,
    torque_slope=usual_kq(0.537) * _KQ_FALL,
    jet_loss=_JET_LOSS, jet_drag=_JET_DRAG, efficiency=_EFFICIENCY,
)  # fmt: skip
"""Place, k_t, 3000 rpm (model) and lag (Toulon). Down is its strong side, as in Toulon."""


@cache
def _rigid_body(geometry: Geometry) -> RigidBody:
    """The dry vehicle and the water inside.

    52 kg weighed, 52.1 kg displaced (paper; Toulon): it floats up by 1 N when nothing holds it. Its
    centre of gravity is 0.0365 m below the centre of buoyancy (model; Toulon has 0.02) and no
    further forward: it is trimmed level. Its inertia is the model's of SPARUS II (computed from its
    parts); ALICE's own is not published, and its dry section is the same.
    """
    dry_kg, buoyancy_kg = 52.0, 52.1
    inside = entrained_water(geometry, buoyancy_kg, DENSITY)
    return RigidBody(
        dry_kg=dry_kg,
        buoyancy_kg=buoyancy_kg,
        entrained_kg=inside.mass_kg,
        cg_body_m=(0.0, 0.0, 0.0365),
        inertia_kg_m2=(0.52, 7.47, 7.39),
        entrained_cg_body_m=(inside.x_m, 0.0, 0.0),
        entrained_inertia_kg_m2=inside.inertia_kg_m2,
    )


def _thrusters(name: str) -> tuple[Thruster, ...]:
    """The surge pair turns in opposite senses, the port one by the right hand (model)."""
    aft = ALICE_PROPELLER_X_M if name == "alice" else PROPELLER_X_M
    lateral = (_t200(t.name, t.x_m) for t in GEOMETRIES[name].tunnels if t.axis == "y")
    return (_main("starboard", aft, 0.167, -1), _main("port", aft, -0.167, 1), _HEAVE, *lateral)


@cache
def _computed(name: str) -> Coefficients:
    return estimate(GEOMETRIES[name])


def vehicle(name: str, coefficients: str = OWN_SET) -> Vehicle:
    """A vehicle by its name, `alice` or `sparus2`, with a named set of coefficients.

    Args:
        name: name of the vehicle.
        coefficients: `estimated`, `cfd` or `calibrated`, the paper's; or `computed` from its shape.

    Raises:
        VehicleError: a name is not known.
    """
    if coefficients not in SETS:
        raise VehicleError(f"coefficients {coefficients!r} are not known; known: {', '.join(SETS)}")
    if name not in GEOMETRIES:
        raise VehicleError(
            f"vehicle {name!r} is not known; known: {', '.join(GEOMETRIES)}, or a TOML file"
        )
    return Vehicle(
        name=name,
        rigid_body=_rigid_body(GEOMETRIES[name]),
        coefficients=PAPER_SETS.get(coefficients) or _computed(name),
        thrusters=_thrusters(name),
        hull=GEOMETRIES[name].hull,
        density_kg_m3=DENSITY,
        depth_rating_m=DEPTH_RATING_M,
        battery_wh=BATTERY_WH,
        hotel_w=HOTEL_W,
    )
