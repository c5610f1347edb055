"""Ground control of handheld GPS and hasty clicks: one point wrong, the rest far off its sigma."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import keep_warnings
from reconstruct.placing.control import (
    ControlFit,
    real_sigma_factor,
    tie_control,
    widen,
    without_wrong_points,
)
from reconstruct.placing.control_points import Control, KnownPoint, triangulate_picks
from reconstruct.placing.fit import PlacementFit, fit_control
from tests.reconstruct.placing.test_control import KNOWN, Gauge, in_gauge, picks_of, site
from tests.reconstruct.scenes import DATUM

_MORE = [[1.2, 0.55, 14.92], [2.3, 0.7, 15.02], [2.0, 1.5, 14.97], [1.0, 1.2, 15.08]]
POINTS = np.vstack([KNOWN, _MORE])
"""Nine points of the sea floor in NED."""
STATED_M, REAL_M = 0.002, 0.1
WRONG_M = (1.5, -1.0, 0.5)


def known(places: np.ndarray, sigma_m: float = STATED_M) -> Control:
    nan = float("nan")
    return Control(
        points=tuple(
            KnownPoint(
                name=f"p{k}", use="control", latitude_deg=nan, longitude_deg=nan, north_m=north,
                east_m=east, depth_m=down, height_m=nan, sigma_m=sigma_m, sigma_vertical_m=sigma_m,
            )
            for k, (north, east, down) in enumerate(places.tolist())
        )
    )  # fmt: skip


def tied(gauge: Gauge, places: np.ndarray, noise_px: float = 0.3) -> ControlFit:
    spots, lost = triangulate_picks(picks_of(POINTS[: len(places)], noise_px), gauge.cameras)
    return tie_control(known(places), spots, lost, DATUM)


def placed(gauge: Gauge, ties: ControlFit, known_scale: float | None) -> PlacementFit:
    start = ties.start(known_scale)
    assert start is not None
    poses: list[RigidTransform] = [c.model_from_pinhole for c in gauge.cameras.values()]
    return fit_control(
        site().records, poses, start, ties.equations, known_scale=known_scale, scale_sigma=0.0
    )


@pytest.mark.parametrize("known_scale", [None, 1.0])
def test_a_wrong_point_is_left_out_and_the_rest_has_its_real_sigma(
    known_scale: float | None,
) -> None:
    misses, factors = [], []
    for seed in range(10):
        rng, gauge = np.random.default_rng(seed), in_gauge(seed)
        places = POINTS + rng.normal(0, REAL_M, POINTS.shape)
        wrong = int(rng.integers(len(places)))
        places[wrong] += WRONG_M
        with keep_warnings() as said:
            ties = without_wrong_points(tied(gauge, places), known_scale)
        assert [t.name for t in ties.ties if t.use == "left out"] == [f"p{wrong}"]
        assert len(said) == 1 and f"p{wrong} is " in said[0]
        fit = placed(gauge, ties, known_scale)
        parameters = 6 if known_scale else 7
        factor = real_sigma_factor(ties, fit.ned_from_model, parameters)
        ties = widen(ties, factor)
        fit = placed(gauge, ties, known_scale)
        middle = fit.ned_from_model.apply(gauge.points(fit.middle_ned[None]))[0]
        misses.append((middle - fit.middle_ned) / fit.sigma_position_m)
        factors.append(factor)
        score = ties.score(fit.ned_from_model, located=True)
        assert score.sigma_factor == factor
        assert score.rms["control"].points == len(places) - 1
        assert [row.use for row in score.points].count("left out") == 1
    assert REAL_M / STATED_M * 0.85 < np.sqrt(np.mean(np.square(factors))) < REAL_M / STATED_M * 1.1
    assert 0.7 < np.sqrt(np.mean(np.square(misses))) < 1.4


def test_hasty_picks_count_with_what_they_are_worth() -> None:
    noise_px, misses = 6.0, []
    for seed in range(6):
        gauge = in_gauge(seed)
        picks = picks_of(POINTS, noise_px, seed)
        picks[seed] = replace(picks[seed], x_px=picks[seed].x_px + 150.0)
        with keep_warnings() as said:
            spots, lost = triangulate_picks(picks, gauge.cameras)
        assert not lost and len(said) == 1 and "count with a sigma of" in said[0]
        stated = float(said[0].rsplit("sigma of ", 1)[1].split()[0])
        assert 0.7 * noise_px < stated < 1.4 * noise_px
        assert [p for s in spots.values() for p in s.left_out] == [picks[seed].image]
        true = gauge.points(POINTS)
        for k, point in enumerate(true):
            off = spots[f"p{k}"].model - point
            misses.append(off @ np.linalg.solve(spots[f"p{k}"].covariance, off) / 3.0)
    assert 0.6 < np.mean(misses) < 1.5
