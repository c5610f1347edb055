"""The paper's calibration in turn, on manoeuvres without a current."""

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows
from alice_survey.sim.vehicle.identification.two_step import calibrate
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle.identification.manoeuvres import fly, hidden

KNOWN = vehicle_from("alice")
TRUTH = {
    "X_udot": -15.0, "X_uu": -12.0, "Z_wdot": -35.0, "Z_ww": -380.0, "N_rdot": -9.0, "N_rr": -70.0,
    "Y_vdot": -40.0, "Y_vv": -260.0,
}  # fmt: skip


def test_coefficients_are_found_in_turn() -> None:
    found = calibrate(
        make_windows(fly(hidden(TRUTH), duration_s=120.0), KNOWN),
        free_parameters(KNOWN, tuple(TRUTH)),
    )
    for name, value, step in zip(TRUTH, found.values, found.step, strict=True):
        added_mass = name.endswith("dot")
        # The added mass rides on a body of 75 kg, or 24 kg m2 in yaw: 6 % of it is little of both.
        assert value == pytest.approx(TRUTH[name], rel=0.06 if added_mass else 0.01), name
        assert step == {"X": "surge", "Z": "heave"}.get(name[0], "turns")
    assert np.all(found.sigma > 0)


def test_a_held_current_is_taken_off() -> None:
    current = (0.15, -0.1)
    windows = make_windows(fly(hidden(TRUTH), duration_s=60.0, current=current), KNOWN)
    names = ("X_uu", "N_rr")
    held = {"current_north_mps": current[0], "current_east_mps": current[1]}
    calm = calibrate(make_windows(fly(hidden(TRUTH), duration_s=60.0), KNOWN),
                     free_parameters(KNOWN, names))  # fmt: skip
    known = calibrate(windows, free_parameters(KNOWN, names, held))
    unknown = calibrate(windows, free_parameters(KNOWN, names))
    np.testing.assert_allclose(known.values, calm.values, rtol=0.01)
    assert abs(unknown.values[0] - calm.values[0]) > 0.05 * abs(calm.values[0])


def test_a_current_cannot_be_calibrated_in_turn() -> None:
    windows = make_windows(fly(hidden({}), duration_s=5.0), KNOWN)
    with pytest.raises(VehicleError, match="current_north_mps"):
        calibrate(windows, free_parameters(KNOWN, ("X_uu", "current")))
