import numpy as np
import pytest

from camera_calib.target_shape import AS_DRAWN, BOW_X, BOW_Y, SHEAR, STRETCH, TWIST, usual_shape
from tests.camera_calib.calibration_scenes import board


def test_bows_are_those_of_mrcal() -> None:
    """`mrcal.ref_calibration_object`: z = kx (1 - x^2) + ky (1 - y^2), x and y from -1 to 1."""
    points = board(7, 5, 0.03)
    shape = usual_shape(points)
    values = np.zeros(len(shape.parameters))
    values[[shape.parameters.index(name) for name in (BOW_X, BOW_Y)]] = 2e-3, -1e-3
    z = shape.with_values(values).offsets_m.reshape(5, 7, 3)
    assert z[..., 2][0, 0] == z[..., 2][-1, -1] == 0.0
    assert z[2, 3, 2] == pytest.approx(1e-3)
    assert z[0, 3, 2] == pytest.approx(2e-3)
    assert z[2, 0, 2] == pytest.approx(-1e-3)
    assert z[2, 1, 2] == pytest.approx(2e-3 * (1 - (2 / 3) ** 2) - 1e-3)
    assert np.abs(z[..., :2]).max() == 0.0


def test_stretch_is_the_ratio_of_lengths_and_shear_the_loss_of_a_right_angle() -> None:
    points = board(7, 5, 0.03)
    shape = usual_shape(points)
    at = shape.parameters.index
    values = np.zeros(len(shape.parameters))
    values[at(STRETCH)], values[at(SHEAR)] = 1e-3, 2e-4
    moved = (points + shape.with_values(values).offsets_m).reshape(5, 7, 3)
    along, down = moved[0, -1] - moved[0, 0], moved[-1, 0] - moved[0, 0]
    ratio = np.linalg.norm(along) / 0.18 / (np.linalg.norm(down) / 0.12)
    assert ratio == pytest.approx(1.001, abs=1e-6)
    cosine = along @ down / np.linalg.norm(along) / np.linalg.norm(down)
    assert cosine == pytest.approx(2e-4, rel=1e-2)


def test_modes_move_no_target_as_a_whole_and_differ_from_each_other() -> None:
    """None is a motion or a size, which poses and the target's own size bear."""
    points = board(9, 6, 0.025)
    shape = usual_shape(points)
    centred = points - points.mean(axis=0)
    turns = np.stack([np.cross(axis, centred) for axis in np.eye(3)])
    rigid = np.concatenate([np.ones((3, 54, 1)) * np.eye(3)[:, None], turns, centred[None]])
    everything = np.concatenate([rigid, shape.modes]).reshape(-1, 162)
    everything /= np.linalg.norm(everything, axis=1, keepdims=True)
    assert np.linalg.svd(everything, compute_uv=False)[-1] > 0.05
    assert len(set(shape.parameters)) == len(shape.parameters)
    assert {BOW_X, BOW_Y, TWIST} < set(shape.parameters)


def test_the_prior_grows_with_the_target() -> None:
    small, large = usual_shape(board(7, 5, 0.03)), usual_shape(board(7, 5, 0.15))
    bow = small.parameters.index(BOW_X)
    assert large.prior_sigmas[bow] == pytest.approx(5.0 * small.prior_sigmas[bow])
    assert 0.4e-3 < small.prior_sigmas[bow] < 1.5e-3
    stretch = small.parameters.index(STRETCH)
    assert large.prior_sigmas[stretch] == small.prior_sigmas[stretch]


def test_two_rows_cannot_show_a_ripple_across_them() -> None:
    names = usual_shape(board(6, 3, 0.03)).parameters
    assert "target.bend_30_m" in names
    assert "target.bend_03_m" not in names


def test_a_target_in_space_has_no_shape_of_a_sheet() -> None:
    corner = np.concatenate([board(5, 4, 0.03), board(5, 4, 0.03)[:, [0, 2, 1]]])
    assert usual_shape(corner) is AS_DRAWN
    assert AS_DRAWN.prior.parameters == ()
