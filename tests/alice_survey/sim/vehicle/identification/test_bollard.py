"""Thrust coefficients from readings at the mooring."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.sim.vehicle.identification.two_step import fit_pulls, read_pulls, with_thrust
from alice_survey.sim.vehicle.propulsion import add_thrust
from alice_survey.sim.vehicle.vehicle import vehicle_from

KNOWN = vehicle_from("alice")


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
