"""A real BlueROV2 in a tank: frames and step of its logs, each run predicted from the others."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.sim.vehicle.identification.output_error import (
    OutputErrorFit,
    PriorSigmas,
    fit_output_error,
)
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows
from alice_survey.sim.vehicle.identification.report import validate
from alice_survey.sim.vehicle.log import VehicleLog, read_column_map, read_foreign_log
from alice_survey.sim.vehicle.vehicle import vehicle_from_file

HERE = Path(__file__).parent
QUICK_S = 0.05
FREE = (
    "X_u", "X_uu", "Y_v", "Y_vv", "Z_w", "Z_ww", "N_r", "N_rr", "gain_X", "gain_Y", "gain_Z",
    "gain_N", "buoyancy",
)  # fmt: skip
"""The thrusts of the data set are a curve of the pulses, not calibrated: their scale is free. The
added mass is that of the vehicle's file, since only its ratio to the scale can be seen."""
ROV = vehicle_from_file(HERE / "bluerov2.toml")
PARAMETERS = free_parameters(ROV, FREE)
MOVING = [0, 1, 2, 5]


@pytest.fixture(scope="module")
def runs(shared_data: Path) -> list[VehicleLog]:
    columns = read_column_map(HERE / "tank_columns.toml")
    return [
        read_foreign_log(shared_data / "bluerov2" / f"odom-12-01-2024-run{k}.csv", columns)
        for k in (1, 2, 3, 4)
    ]


def test_frames_and_step_of_the_runs_are_as_mapped(runs: list[VehicleLog]) -> None:
    for run in runs:
        rotation = Rotation.from_quat(run.quaternion_xyzw)
        moved = np.diff(run.position_ned, axis=0)
        velocity = rotation.apply(run.velocity_body)
        between = 0.5 * (velocity[1:] + velocity[:-1])
        for axis in range(3):
            assert np.corrcoef(between[:, axis], moved[:, axis])[0, 1] > 0.85
        turned = (rotation[:-1].inv() * rotation[1:]).as_rotvec()
        rates = 0.5 * (run.rates_body[1:] + run.rates_body[:-1])
        # The step that the turns show: their spread over that of the rates.
        step_s = np.sqrt(np.sum(turned**2) / np.sum(rates**2))
        assert step_s == pytest.approx(0.1, rel=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("left_out", [0, 3])  # each alone predicts the others, too
def test_each_run_is_predicted_from_the_others(runs: list[VehicleLog], left_out: int) -> None:
    # Rolling and pitching answer to nothing in the log: they follow it.
    windows = [
        window
        for k, run in enumerate(runs)
        if k != left_out
        for window in make_windows(run, ROV, window_s=5.0, given=("p", "q"))
    ]
    fit = fit_output_error(windows, PARAMETERS, max_step_s=QUICK_S)
    shorter = make_windows(runs[left_out], ROV, window_s=10.0, given=("p", "q"))
    found = validate(shorter, PARAMETERS, fit.values, max_step_s=QUICK_S)
    model, constant = found.fit_percent[MOVING], found.constant_fit_percent[MOVING]
    assert np.all(model > 20.0)
    assert np.all(model < 90.0)
    assert np.all(model > constant + 30.0)
    # All in all better than the published coefficients, too.
    published = validate(shorter, PARAMETERS, PARAMETERS.start, max_step_s=QUICK_S)
    assert model.mean() > published.fit_percent[MOVING].mean() + 10.0


@pytest.fixture(scope="module", params=[None, PriorSigmas()], ids=["no prior", "prior"])
def single(
    runs: list[VehicleLog], request: pytest.FixtureRequest
) -> tuple[PriorSigmas | None, list[OutputErrorFit]]:
    """A fit to each run alone."""
    fits = [
        fit_output_error(
            make_windows(run, ROV, window_s=5.0, given=("p", "q")), PARAMETERS,
            max_step_s=QUICK_S, prior=request.param,
        )
        for run in runs
    ]  # fmt: skip
    return request.param, fits


@pytest.mark.slow
def test_unseen_runs_are_not_predicted_worse_than_by_the_start(
    runs: list[VehicleLog], single: tuple[PriorSigmas | None, list[OutputErrorFit]]
) -> None:
    """Each run alone predicts the three others: with the prior never worse than the start does."""
    prior, fits = single
    gains, model = [], []
    for k, run in enumerate(runs):
        windows = make_windows(run, ROV, window_s=10.0, given=("p", "q"))
        start, *others = (
            validate(windows, PARAMETERS, values, max_step_s=QUICK_S).fit_percent[MOVING]
            for values in (PARAMETERS.start, *(fit.values for fit in fits[:k] + fits[k + 1 :]))
        )
        gains += [other - start for other in others]
        model += others
    at_bounds = sum(int(fit.at_bound.sum()) for fit in fits)
    assert 50.0 < np.mean(model) < 60.0
    if prior is None:
        assert np.min(gains) < -5.0
        assert at_bounds >= 2
    else:
        assert -1.0 < np.min(gains) < 5.0
        assert at_bounds == 0


@pytest.mark.slow
def test_fits_to_different_runs_differ_by_their_sigmas(
    single: tuple[PriorSigmas | None, list[OutputErrorFit]],
) -> None:
    """Fits with one prior share its error, which does not set them apart."""
    scores = []
    for a, b in itertools.combinations(single[1], 2):
        own = [np.diag(fit.covariance - fit.prior_covariance) for fit in (a, b)]
        variance = np.sum(own, axis=0)
        free = ~(a.at_bound | b.at_bound)
        scores += ((a.values - b.values)[free] / np.sqrt(variance[free])).tolist()
    assert len(scores) > 60
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.5
