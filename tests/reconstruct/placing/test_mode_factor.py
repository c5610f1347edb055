"""How much larger a model's soft modes are than its pictures say is found with their place."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from reconstruct.placing.alignment import level
from reconstruct.placing.fit import PlacementFit, fit_navigation
from tests.reconstruct.placing.test_sigmas import BODY_FROM_CAM, DATUM, flight, flown

_MODES, _SIGMA_M = 16, 0.03
_FIRST = 7
"""Parameters of the placement before the modes."""


def waves(centres: Array) -> Array:
    """(N, 6, K) smooth heave of a block, waves of different lengths north and east."""
    span = np.ptp(centres[:, :2], axis=0)
    n, e = ((centres[:, :2] - centres[:, :2].min(axis=0)) / span).T
    modes = np.zeros((len(centres), 6, _MODES))
    for k in range(_MODES):
        modes[:, 2, k] = np.cos(np.pi * (k % 4 + 1) * n) * np.cos(np.pi * (k // 4 + 1) * e)
    return _SIGMA_M * modes


def fitted(
    seed: int, factor: float, *, apart_m: float | None = None, unit_m: float = 1e-3
) -> tuple[PlacementFit, Array]:
    """A model deformed by this many times its sigmas, placed; its errors, in the fit's order.

    With `apart_m` its second half is so far east of where it ought to be, and nothing links it: its
    motions are counted in this unit.
    """
    rng = np.random.default_rng([7, seed])
    body = flight(8, 40)
    cameras = body * BODY_FROM_CAM["cam"]
    modes = waves(cameras.translation)
    sizes = factor * rng.normal(size=_MODES)
    if apart_m is not None:
        joint = np.zeros((len(modes), 6, 3))
        joint[len(modes) // 2 :, :3] = unit_m * np.eye(3)
        modes = np.concatenate([modes, joint], axis=2)
        sizes = np.append(sizes, [0.0, apart_m / unit_m, 0.0])
    bent = RigidTransform.from_components(
        cameras.translation - (modes @ sizes)[:, :3], cameras.rotation
    )
    own = RigidTransform.from_components(rng.normal(0, 30, 3), Rotation.random(rng=rng))
    turn = own.inv().rotation.as_matrix()
    modes[:, :3], modes[:, 3:] = turn @ modes[:, :3], turn @ modes[:, 3:]
    poses = [own.inv() * pose for pose in bent]
    floor = np.column_stack([rng.uniform(0, 5, (300, 2)), rng.normal(15, 0.1, 300)])
    levelled = level(own.inv().apply(floor), np.stack([pose.translation for pose in poses]))
    fit = fit_navigation(
        flown(body, [4, seed], 1.0), poses, BODY_FROM_CAM, DATUM, levelled,
        known_scale=1.0, modes=modes, joints=0 if apart_m is None else 3,
    )  # fmt: skip
    assert fit is not None
    return fit, fit.modes - sizes


def whitened(factor: float) -> tuple[Array, Array]:
    """Factors found of 12 models, and errors of their modes over what is stated."""
    found, off = [], []
    for seed in range(12):
        fit, error = fitted(seed, factor)
        found.append(fit.record.soft_modes_factor)
        off.append(error / np.sqrt(np.diag(fit.joint)[_FIRST:]))
    return np.array(found), np.array(off)


def test_modes_of_the_stated_size_stay_as_they_are() -> None:
    found, off = whitened(1.0)
    assert np.count_nonzero(found > 1.0) <= 1
    assert 0.8 < np.sqrt((off**2).mean()) < 1.2


@pytest.mark.parametrize("factor", [2.5, 6.0])
def test_modes_larger_than_stated_are_found_and_their_sigmas_are_true(factor: float) -> None:
    found, off = whitened(factor)
    assert 0.85 * factor < np.median(found) < 1.2 * factor
    assert 0.75 < np.sqrt((off**2).mean()) < 1.3
