"""Evidence against a calibration, by draws of linear problems and by surveys of known rigs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera_calib.rig import Covariance, Rig
from reconstruct.adjustment.survey_fit import contradiction, fit_survey
from tests.reconstruct.adjustment.test_survey_fit import modelled, noisy

NAMES = tuple(f"left.p{n}" for n in range(6))


def linear_fit(
    rng: np.random.Generator, wrong: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change, prior and what is left of 6 parameters, of which readings measure 4 combinations.

    The truth is drawn from the prior, plus `wrong` of its sigmas.
    """
    root = rng.normal(size=(6, 6)) * np.logspace(-4, 2, 6)[:, None]
    prior = root @ root.T
    truth = root @ rng.normal(size=6) + wrong * np.sqrt(np.diag(prior))
    seen = rng.normal(size=(4, 6)) / np.sqrt(np.diag(prior))
    readings = seen @ truth + 0.3 * rng.normal(size=4)
    gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + 0.09 * np.eye(4))
    return gain @ readings, prior, prior - gain @ seen @ prior


def test_a_right_calibration_is_contradicted_as_seldom_as_stated():
    rng = np.random.default_rng(1)
    found = [contradiction(NAMES, *linear_fit(rng, np.zeros(6))) for _ in range(4000)]
    assert sum(one is not None for one in found) <= 4  # of 4000 at 1e-4


def test_a_wrong_parameter_is_found_and_named():
    rng = np.random.default_rng(2)
    wrong = np.zeros(6)
    wrong[3] = 12.0
    found = [contradiction(NAMES, *linear_fit(rng, wrong)) for _ in range(200)]
    known = [one for one in found if one is not None]
    assert len(known) > 180
    named = sum("left.p3" in one.pulls for one in known)
    assert named > 0.6 * len(known)
    assert all(3 <= one.directions <= 4 for one in known)


def test_nothing_free_contradicts_nothing():
    assert contradiction((), np.empty(0), np.empty((0, 0)), np.empty((0, 0))) is None
    still = contradiction(NAMES, np.zeros(6), np.eye(6), np.eye(6))
    assert still is None


STATED = {"port_distance_m": 5e-5, "normal_x": 2e-4, "normal_y": 2e-4, "n_water": 2e-4}


def believed(rig: Rig, wrong: dict[str, float]) -> Rig:
    """The rig with parameters of its left camera off, and all of its ports stated as `STATED`."""
    left = rig.cameras["left"]
    off = {name: left.parameter(name) + by for name, by in wrong.items()}
    names = tuple(f"{camera}.{field}" for camera in rig.cameras for field in STATED)
    sigmas = np.array([STATED[name.split(".")[1]] for name in names])
    return replace(
        rig,
        cameras={**rig.cameras, "left": left.with_parameters(off)},
        covariance=Covariance(parameters=names, matrix=np.diag(sigmas**2)),
    )


@pytest.mark.parametrize(
    ("wrong", "about"),
    [({}, None), ({"normal_x": 0.004}, "normal_x"), ({"port_distance_m": 0.008}, "")],
)
def test_a_port_stated_too_well_is_named_and_a_right_one_is_not(
    tmp_path: Path, wrong: dict[str, float], about: str | None
):
    scene = noisy(5)
    rig = believed(scene.rig, wrong)
    mapped, seen = modelled(scene, rig, tmp_path)
    found = fit_survey(mapped, seen, rig, port=True, pose=False).contradiction
    assert (found is None) == (about is None)
    if found is not None and about is not None:
        assert about in found.words
        assert found.words.count("sigmas") >= 2
        assert "\n" not in found.words
