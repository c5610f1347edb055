"""A bend of the model is told from errors of navigation, however these last."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import BendRecord
from reconstruct.placing.alignment import level
from reconstruct.placing.fit import fit_navigation
from tests.reconstruct.placing.test_sigmas import (
    BODY_FROM_CAM,
    DATUM,
    flight,
    flown,
)


def bends_of(
    body: RigidTransform, records: list[ImageRecord], along: float, across: float, seed: int = 0
) -> tuple[BendRecord, ...]:
    """Of a model in a frame of its own whose heights err by these curvatures north and east."""
    rng = np.random.default_rng(seed)
    cameras = body * BODY_FROM_CAM["cam"]
    n, e = (cameras.translation - cameras.translation.mean(axis=0))[:, :2].T
    down = -0.5 * (along * n**2 + across * e**2)
    zero = np.zeros_like(down)
    turns = Rotation.from_rotvec(np.column_stack([-across * e, along * n, zero]))
    bent = RigidTransform.from_components(
        cameras.translation + np.column_stack([zero, zero, down]), turns * cameras.rotation
    )
    own = RigidTransform.from_components(rng.normal(0, 30, 3), Rotation.random(rng=rng))
    poses = [own.inv() * pose for pose in bent]
    floor = np.column_stack([rng.uniform(0, 5, (300, 2)), rng.normal(15, 0.1, 300)])
    centres = np.stack([pose.translation for pose in poses])
    levelled = level(own.inv().apply(floor), centres)
    fit = fit_navigation(records, poses, BODY_FROM_CAM, DATUM, levelled, known_scale=1.0)
    assert fit is not None
    return fit.bends


@pytest.mark.parametrize("tau_s", [1.0, 4000.0])
def test_a_bent_block_shows_its_curvature(tau_s: float) -> None:
    body = flight(8, 40)
    for seed in range(3):
        found = bends_of(body, flown(body, [3, seed], tau_s), 4e-3, -6e-3, seed)
        along, across = found
        assert along.curvature_per_m == pytest.approx(4e-3, abs=3.5 * along.sigma_per_m)
        assert across.curvature_per_m == pytest.approx(-6e-3, abs=3.5 * across.sigma_per_m)
        assert along.sigma_per_m < 1e-3
        assert along.length_m == pytest.approx(19.5, rel=0.06)
        assert along.sag_m == pytest.approx(along.curvature_per_m * along.length_m**2 / 8)
        assert along.is_significant(1e-3)


def test_straight_blocks_are_not_called_bent_and_sigmas_are_true() -> None:
    body, pulls, called = flight(6, 20), [], 0
    for seed in range(30):
        tau_s = [1.0, 60.0, 4000.0][seed % 3]
        for bend in bends_of(body, flown(body, [8, seed], tau_s), 0.0, 0.0, seed):
            pulls.append(bend.curvature_per_m / bend.sigma_per_m)
            called += bend.is_significant(1e-4)
    assert len(pulls) == 60
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4
    assert called <= 2


def test_sigmas_that_are_stated_too_small_do_not_make_a_bend() -> None:
    body = flight(6, 20)
    honest = bends_of(body, flown(body, 3, 1.0), 0.0, 0.0)
    boasted = bends_of(body, flown(body, 3, 1.0, factor=20.0), 0.0, 0.0)
    for sure, unsure in zip(honest, boasted, strict=True):
        assert unsure.sigma_per_m > 8.0 * sure.sigma_per_m
        assert not unsure.is_significant(1e-4)


def test_jumps_of_the_depth_sensor_do_not_make_a_bend() -> None:
    body = flight(6, 20)
    records = flown(body, 4, 1.0)
    for k in (0, 19, 20, 39):
        records[k] = replace(records[k], depth_m=records[k].depth_m + 1.5)
    for bend in bends_of(body, records, 0.0, 0.0):
        assert abs(bend.curvature_per_m) < 4.0 * bend.sigma_per_m
        assert not bend.is_significant(1e-3)


def test_a_line_has_no_bend_across_and_a_few_stations_have_none() -> None:
    body = flight(1, 20)
    (along,) = bends_of(body, flown(body, 5, 1.0), 3e-3, 0.0)
    assert along.curvature_per_m == pytest.approx(3e-3, abs=4 * along.sigma_per_m)
    short = flight(1, 6)
    assert bends_of(short, flown(short, 5, 1.0), 0.0, 0.0) == ()
