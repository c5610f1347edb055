import numpy as np

from reconstruct.mosaic.seams import Blend


def test_one_view_comes_out_as_it_went_in() -> None:
    rng = np.random.default_rng(1)
    colour = rng.uniform(0, 255, (128, 144, 3)).astype(np.float32)
    valid = np.zeros((128, 144), bool)
    valid[40:80, 45:100] = True
    blend = Blend(160, 192)
    blend.add(16, 32, colour, valid, valid)
    found = blend.result()[16:144, 32:176]
    np.testing.assert_allclose(found[valid], colour[valid], atol=2e-3)


def test_a_step_between_two_views_becomes_a_slope_and_detail_stays() -> None:
    rng = np.random.default_rng(2)
    fine = rng.normal(0, 10, (128, 128, 1)).astype(np.float32) * np.ones(3, np.float32)
    left = np.zeros((128, 128), bool)
    left[:, :64] = True
    everywhere = np.ones_like(left)
    blend = Blend(128, 128)
    blend.add(0, 0, fine + 100, everywhere, left)
    blend.add(0, 0, fine + 140, everywhere, ~left)
    rest = (blend.result() - fine)[..., 0].mean(axis=0)
    assert abs(rest[:8].mean() - 100) < 1
    assert abs(rest[-8:].mean() - 140) < 1
    steps = np.diff(rest)
    assert steps.min() > -0.5
    assert steps.max() < 8
    np.testing.assert_allclose(blend.result() - rest[None, :, None], fine, atol=0.6)
