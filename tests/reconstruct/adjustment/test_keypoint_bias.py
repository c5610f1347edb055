"""Biases that all keypoints share, as changes of a lens."""

import numpy as np
import pytest

from reconstruct.adjustment.survey_fit import BIAS_PX, bias_covariance
from tests.reconstruct.rig_survey import four_cameras


def test_changes_of_a_lens_move_pixels_radially_by_the_sigma() -> None:
    """Drawn from the covariance and seen through the whole camera, port and all."""
    rig, rng = four_cameras(), np.random.default_rng(4)
    for owner, camera in rig.cameras.items():
        fields = [f for f in ("fx_px", "fy_px", "cx_px", "k1", "k2", "p1")
                  if f in camera.lens.parameters]  # fmt: skip
        names = [*(f"{owner}.{field}" for field in fields), f"{owner}.n_water"]
        covariance = bias_covariance(rig, names)
        assert not covariance[-1].any()
        assert not covariance[2].any(), "a shift of the whole picture"
        grid = np.stack(np.meshgrid(*(np.linspace(5, n - 6, 15) for n in (
            camera.width_px, camera.height_px))), axis=-1).reshape(-1, 2)  # fmt: skip
        starts, rays = camera.unproject(grid)
        squares, along = [], []
        for _ in range(200):
            step = rng.multivariate_normal(np.zeros(len(names)), covariance)
            values: dict[str, float] = {
                f: camera.parameter(f) + s for f, s in zip(fields, step, strict=False)
            }
            shift = camera.with_parameters(values).project(starts + 2.0 * rays) - grid
            out = grid - [camera.parameter("cx_px"), camera.parameter("cy_px")]
            squares.append((shift**2).sum(axis=1).mean())
            along.append(np.abs(shift.mean(axis=0)).max() / np.sqrt(squares[-1]))
            assert np.abs(np.corrcoef(shift[:, 0], out[:, 1])[0, 1]) < 0.5
        assert np.sqrt(np.mean(squares)) == pytest.approx(BIAS_PX, rel=0.2)
        assert np.median(along) < 0.35
