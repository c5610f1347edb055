"""How well a model predicts a log."""

import numpy as np
import pytest

from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows
from alice_survey.sim.vehicle.identification.report import fit_percent, validate
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle.identification.manoeuvres import fly, hidden


def test_the_fit_is_as_defined() -> None:
    y = np.array([[1.0], [2.0], [3.0], [6.0]])
    assert fit_percent(y, y)[0] == 100.0
    assert fit_percent(y, np.full((4, 1), 3.0))[0] == 0.0
    # Off by one everywhere: 2 against the root of 4 + 1 + 0 + 9.
    assert fit_percent(y, y + 1)[0] == pytest.approx(100 * (1 - 2 / np.sqrt(14)))
    gappy = y.copy()
    gappy[1] = np.nan
    assert np.isfinite(fit_percent(gappy, y)[0])
    assert np.isnan(fit_percent(np.ones((3, 1)), np.ones((3, 1)))[0])


def test_the_truth_predicts_itself_and_a_wrong_model_does_not() -> None:
    truth = hidden({"X_uu": -12.0, "N_rr": -70.0})
    log = fly(truth, duration_s=40.0, current=(0.1, 0.05))
    parameters = free_parameters(vehicle_from("alice"), ("X_uu", "N_rr", "current"))
    windows = make_windows(log, vehicle_from("alice"), window_s=10.0)
    right = validate(windows, parameters, np.array([-12.0, -70.0, 0.1, 0.05]))
    wrong = validate(windows, parameters, np.array([-24.0, -35.0, 0.1, 0.05]))
    assert np.all(right.fit_percent > 99.0)
    assert np.all(right.constant_fit_percent < 60.0)
    assert wrong.fit_percent[0] < 97.0
    assert wrong.fit_percent[5] < 95.0


def test_a_motion_that_follows_the_log_is_not_scored() -> None:
    windows = make_windows(
        fly(hidden({}), duration_s=10.0), vehicle_from("alice"), given=("p", "q")
    )
    parameters = free_parameters(vehicle_from("alice"), ("X_uu",))
    found = validate(windows, parameters, parameters.start)
    assert np.all(np.isnan(found.fit_percent[3:5]))
    assert np.all(found.fit_percent[[0, 1, 2, 5]] > 99.0)
