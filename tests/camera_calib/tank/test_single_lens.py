import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.base.errors import CalibrationError
from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import TargetView
from camera_calib.flat_port import FlatPortCamera
from camera_calib.freedom import intrinsics
from camera_calib.tank.single_lens import LensView, _covariance, _fit, calibrate_single_lens

Array = NDArray[np.float64]

LENS = FlatPortCamera(
    width_px=1360,
    height_px=1024,
    fx_px=1100.0,
    fy_px=1103.0,
    cx_px=690.0,
    cy_px=505.0,
    k1=-0.25,
    k2=0.12,
    p1=0.001,
    p2=-0.0008,
    n_water=1.0,
)
BOARD = np.array([[x, y, 0.0] for y in range(6) for x in range(9)]) * 0.03
SIZE = (LENS.width_px, LENS.height_px)


def views(rng: np.random.Generator, count: int = 16, noise_px: float = 0.1) -> list[LensView]:
    """Whole boards all over the frame, tilted."""
    made: list[LensView] = []
    while len(made) < count:
        turn = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        place = rng.uniform([-0.35, -0.3, 0.35], [0.35, 0.3, 0.8])
        pixels = LENS.project(turn.apply(BOARD - BOARD.mean(axis=0)) + place)
        if np.isfinite(pixels).all() and np.all((pixels > 0) & (pixels < SIZE)):
            noisy = pixels + noise_px * rng.normal(size=pixels.shape)
            made.append(LensView(name=f"{len(made):02d}", pixels=noisy))
    return made


def test_without_noise_the_lens_is_found() -> None:
    found = calibrate_single_lens(
        views(np.random.default_rng(1), noise_px=0.0), BOARD, SIZE, ["opencv4"]
    )

    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        # OpenCV takes points and pixels in single precision.
        assert found.camera.parameter(name) == pytest.approx(LENS.parameter(name), abs=2e-2)
    assert found.camera.k1 == pytest.approx(LENS.k1, abs=1e-4)
    assert found.chosen.rms_px < 1e-3 and found.camera.n_water == 1.0
    assert not found.rejected and len(found.views) == 16


def test_held_out_error_chooses_the_model_that_made_the_pictures() -> None:
    found = calibrate_single_lens(views(np.random.default_rng(2), 10), BOARD, SIZE)

    by_name = {model.name: model for model in found.tried}
    assert found.chosen.name in ("opencv4", "opencv5", "prism", "rational")
    assert found.chosen.held_out_px < 1.05 * by_name["opencv4"].held_out_px
    assert 0.1 < found.chosen.held_out_px < 0.2
    assert by_name["k1"].held_out_px > 2 * found.chosen.held_out_px
    assert by_name["full"].rms_px <= by_name["opencv4"].rms_px + 1e-9


def folding_views() -> list[LensView]:
    """In the middle of a frame at whose border the lens turns back."""
    lens = LENS.with_parameters({"k1": -0.62, "k2": 0.0, "p1": 0.0, "p2": 0.0})
    rng = np.random.default_rng(4)
    made = []
    for i in range(10):
        turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3))
        place = rng.uniform([-0.05, -0.05, 0.5], [0.05, 0.05, 0.7])
        pixels = lens.project(turn.apply(BOARD - BOARD.mean(axis=0)) + place)
        made.append(LensView(name=str(i), pixels=pixels))
    return made


def test_a_model_that_folds_back_in_the_frame_is_not_taken() -> None:
    found = calibrate_single_lens(folding_views(), BOARD, SIZE, ["k1", "pinhole"])

    by_name = {model.name: model for model in found.tried}
    assert by_name["k1"].folds and not by_name["pinhole"].folds
    assert by_name["k1"].held_out_px < 0.1 * by_name["pinhole"].held_out_px
    assert found.chosen.name == "pinhole"


def test_only_folding_models_are_an_error() -> None:
    with pytest.raises(CalibrationError, match="folds back within the frame"):
        calibrate_single_lens(folding_views(), BOARD, SIZE, ["k1"])


def test_sigmas_are_true() -> None:
    errors = []
    free = intrinsics("opencv4")
    for seed in range(60):
        drawn = views(np.random.default_rng(100 + seed), 10)
        fit = _fit(drawn, BOARD, SIZE, "opencv4")
        sigmas = np.sqrt(np.diag(_covariance(fit, drawn, BOARD, free)))
        miss = [fit.camera.parameter(name) - LENS.parameter(name) for name in free]
        errors.append(np.array(miss) / sigmas)
    normalised = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all((normalised > 0.75) & (normalised < 1.3)), dict(
        zip(free, normalised, strict=True)
    )


def test_the_general_calibration_finds_the_same_lens() -> None:
    """Another solver, with a robust loss, from the same views: the same lens to its sigmas."""
    drawn = views(np.random.default_rng(8))
    found = calibrate_single_lens(drawn, BOARD, SIZE, ["opencv4"])
    targets = [TargetView(name=v.name, pixels={"lens": v.pixels}) for v in drawn]

    other = calibrate_in_air(targets, BOARD, {"lens": SIZE}, "opencv4").rig

    sigmas = np.sqrt(np.diag(found.covariance))
    for name, sigma in zip(found.free, sigmas, strict=True):
        apart = other.cameras["lens"].parameter(name) - found.camera.parameter(name)
        assert abs(apart) < 0.5 * sigma
        assert other.sigmas[f"lens.{name}"] == pytest.approx(sigma, rel=0.15)


def test_a_blurred_view_is_left_out_and_named() -> None:
    rng = np.random.default_rng(5)
    good = views(rng)
    moved = LensView(name="moved", pixels=good[3].pixels + rng.normal(0.0, 3.0, (54, 2)))

    found = calibrate_single_lens([*good, moved], BOARD, SIZE, ["opencv4"])

    assert list(found.rejected) == ["moved"]
    assert 2.0 < found.rejected["moved"] < 6.0
    assert found.chosen.rms_px < 0.2


def test_the_same_pictures_give_the_same_digits() -> None:
    drawn = views(np.random.default_rng(9), 8)
    first, second = (calibrate_single_lens(drawn, BOARD, SIZE, ["opencv5"]) for _ in range(2))
    assert first.camera == second.camera
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_points_that_were_not_found_do_not_count() -> None:
    rng = np.random.default_rng(6)
    whole = views(rng)
    part = [LensView(name=v.name, pixels=v.pixels.copy()) for v in whole]
    for view in part:
        view.pixels[rng.choice(54, 8, replace=False)] = np.nan

    found = calibrate_single_lens(part, BOARD, SIZE, ["opencv4"])

    assert found.camera.fx_px == pytest.approx(LENS.fx_px, abs=2.0)
    assert 0.1 < found.chosen.rms_px < 0.17


@pytest.mark.parametrize(
    ("count", "models", "says"),
    [
        (5, ["opencv4"], "5 usable pictures of the target in air; at least 6"),
        (8, ["fisheye"], "no lens model is called fisheye"),
        (8, [], r"no lens model is called \(none\)"),
    ],
)
def test_bad_input_is_one_clear_line(count: int, models: list[str], says: str) -> None:
    with pytest.raises(CalibrationError, match=says) as error:
        calibrate_single_lens(views(np.random.default_rng(7), count), BOARD, SIZE, models)
    assert "\n" not in str(error.value)
