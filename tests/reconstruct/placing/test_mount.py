"""A mount that nobody stated is found from attitudes and pictures, with its sigmas."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import warn
from alice_survey.core.frames import Array
from camera_calib.mount import mount_rotation
from reconstruct.placing.alignment import level
from reconstruct.placing.fit import PlacementFit, fit_navigation
from reconstruct.placing.navigation import USUAL_INSTALLATION, Installation
from reconstruct.placing.place import fit_with_mount
from tests.reconstruct.placing.test_sigmas import DATUM, flight, flown

BODY = flight(8, 15)


def placed(
    words: str, seed: int, *, tau_s: float = 1.0, calls: list[str] | None = None
) -> tuple[PlacementFit, RigidTransform, Array]:
    """Fit with an unknown mount: the fit, the true mount, errors of turn (rad) and place (m).

    With `calls` each fit on the way adds its number to them, and warns of it.
    """
    rng = np.random.default_rng([seed, 7])
    mount = RigidTransform.from_components(
        rng.uniform([0.2, -0.3, 0.0], [0.6, 0.3, 0.3]),
        Rotation.from_rotvec(rng.normal(0, 0.1, 3)) * mount_rotation(words),
    )
    truth = RigidTransform.from_components(rng.normal(0, 30, 3), Rotation.random(rng=rng))
    noise = Rotation.from_rotvec(rng.normal(0, 1e-4, (len(BODY), 3)))
    poses = [
        truth.inv() * body * mount * RigidTransform.from_rotation(n)
        for body, n in zip(BODY, noise, strict=True)
    ]
    floor = np.column_stack([rng.uniform(0, 7, (300, 2)), rng.normal(15, 0.1, 300)])
    centres = np.stack([pose.translation for pose in poses])
    fit_to = partial(
        fit_navigation,
        flown(BODY, [seed, 3], tau_s),
        poses,
        levelled=level(truth.inv().apply(floor), centres),
        known_scale=1.0,
    )

    def navigate(
        mounts: Mapping[str, RigidTransform] | None, installed: Installation
    ) -> PlacementFit | None:
        if calls is not None:
            calls.append(f"fit {len(calls)}")
            warn(calls[-1])
        return fit_to(mounts, DATUM, installed=installed)

    fit = fit_with_mount(
        flown(BODY, [seed, 3], tau_s), poses, {"cam": RigidTransform.identity()}, navigate,
        USUAL_INSTALLATION,
    )  # fmt: skip
    assert fit is not None
    found = fit.ned_from_model
    shift = found.apply(centres).mean(axis=0) - truth.apply(centres).mean(axis=0)
    turn = (found.rotation * truth.rotation.inv()).as_rotvec()
    return fit, mount, np.r_[turn, shift]


@pytest.mark.parametrize("words", ["nadir-bow-left", "forward+45"])
def test_the_mount_is_found_within_its_sigmas(words: str) -> None:
    turns, arms, places = [], [], []
    for seed in range(6):
        fit, true, error = placed(words, seed)
        assert fit.mount is not None
        off = (true.rotation * fit.mount.body_from_rig.rotation.inv()).as_rotvec(degrees=True)
        assert np.abs(off).max() < 2.0
        turns.append(off / fit.mount.turn_sigma_deg)
        arm = true.translation - fit.mount.body_from_rig.translation
        arms.append(arm / fit.mount.lever_sigma_m)
        assert np.all(fit.mount.lever_sigma_m[:2] < 0.1)  # lines to and fro show it
        assert 0.1 < fit.mount.lever_sigma_m[2] < 0.3  # and 1.5 deg of roll and pitch this one
        places.append(error / np.sqrt(np.diag(fit.covariance))[:6])
    for ratios, low in ((turns, 0.4), (np.array(arms)[:, :2], 0.4), (places, 0.3)):
        assert low < np.sqrt(np.mean(np.square(ratios))) < 1.6
