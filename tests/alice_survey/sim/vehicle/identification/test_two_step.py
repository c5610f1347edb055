"""The paper's calibration in turn, and thrust coefficients from readings at the mooring."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows
from alice_survey.sim.vehicle.identification.two_step import (
    calibrate,
    fit_pulls,
    read_pulls,
    with_thrust,
)
from alice_survey.sim.vehicle.propulsion import add_thrust
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


def pull_csv(
    path: Path, noise_n: float, seed: int = 0, factors: tuple[float, float] = (0.8, 1.2)
) -> Path:
    """Readings of a pair with shares of the model's k_t forward and in reverse."""
    rng = np.random.default_rng(seed)
    rows = ["thruster,rpm,force_n"]
    for rpm in (-2400, -1800, -1200, -600, 600, 1200, 1800, 2400):
        speeds, force = np.zeros(5), np.zeros(6)
        speeds[:2] = rpm / 60
        add_thrust(KNOWN.plant.propulsion, speeds, np.zeros(6), force)
        pulled = force[0] * factors[0 if rpm > 0 else 1] + rng.normal(0, noise_n)
        rows.append(f"port+starboard,{rpm},{pulled:.6f}")
    path.write_text("\n".join(rows) + "\n")
    return path


def test_factors_are_found_forward_and_reverse(tmp_path: Path) -> None:
    found = fit_pulls(read_pulls(pull_csv(tmp_path / "pull.csv", 0.0)), KNOWN)
    assert [(one.way, one.thrusters) for one in found] == [
        ("forward", ("port", "starboard")), ("reverse", ("port", "starboard")),
    ]  # fmt: skip
    assert found[0].factor == pytest.approx(0.8, rel=1e-6)
    assert found[1].factor == pytest.approx(1.2, rel=1e-6)
    changed = with_thrust(KNOWN, found)
    before, after = np.zeros(6), np.zeros(6)
    speeds = np.array([30.0, 30.0, 0, 0, 0])
    add_thrust(KNOWN.plant.propulsion, speeds, np.zeros(6), before)
    add_thrust(changed.plant.propulsion, speeds, np.zeros(6), after)
    assert after[0] == pytest.approx(0.8 * before[0])
    assert changed.thrusters[2] == KNOWN.thrusters[2]


def test_sigmas_are_those_of_the_readings(tmp_path: Path) -> None:
    scores = []
    for seed in range(200):
        found = fit_pulls(read_pulls(pull_csv(tmp_path / "pull.csv", 0.1, seed)), KNOWN)
        scores.append([(found[0].factor - 0.8) * found[0].model / found[0].sigma])
    # Student's t of three degrees of freedom: a median of its absolute value of 0.765.
    assert np.median(np.abs(scores)) == pytest.approx(0.765, abs=0.12)


@pytest.mark.parametrize(
    ("force_n", "message"), [(0, r"port\+starboard: all forward readings"), (-3, "-3 N at 600 rpm")]
)
def test_a_thruster_must_push_the_way_it_turns(
    tmp_path: Path, force_n: float, message: str
) -> None:
    path = tmp_path / "pull.csv"
    path.write_text(f"thruster,rpm,force_n\nport+starboard,600,{force_n}\n")
    with pytest.raises(VehicleError, match=message):
        fit_pulls(read_pulls(path), KNOWN)
