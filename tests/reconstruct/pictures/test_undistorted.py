from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.ndimage import map_coordinates

from alice_survey.core.artefacts import write_json
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from reconstruct.mapping.self_calibration import self_calibrated_warp
from reconstruct.pictures.undistorted import (
    Pictures,
    sample_spline,
    show_at,
    spline_nodes,
    undistortion_maps,
)
from reconstruct.views.model_files import colmap_pinhole
from tests.cameras import flat_port_camera

WIDTH, HEIGHT = 320, 240


def port_lens() -> PinholeWarp:
    camera = flat_port_camera(
        width_px=WIDTH, height_px=HEIGHT, fx_px=300.0, fy_px=301.0, cx_px=158.0, cy_px=121.0,
        k1=-0.15, k2=0.05, p1=1e-3, p2=-5e-4, port_distance_m=0.02, glass_thickness_m=0.01,
        normal=(np.sin(0.02), 0.0, np.cos(0.02)),
    )  # fmt: skip
    return best_warp(camera, 1.5, 2.5)


def opencv_lens(k1: float = -0.3) -> PinholeWarp:
    return self_calibrated_warp(
        pycolmap.Camera(
            model="OPENCV", width=WIDTH, height=HEIGHT,
            params=[280.0, 282.0, 161.0, 118.0, k1, 0.1, 1e-3, 5e-4],
        )
    )  # fmt: skip


def test_samples_equal_those_of_another_spline_inside_and_at_edges() -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 256, (20, 24, 3)).astype(np.uint8)
    x, y = (rng.uniform(0, last, (1, 60)).astype(np.float32) for last in (23, 19))
    x[0, :3], y[0, 3:5], x[0, 5:7] = -1, (0, 19), (0, 23)
    found = np.full((1, 60, 3), -7, np.float32)
    sample_spline(spline_nodes(picture), x, y, 1, 3, found)
    assert (found[0, :3] == -7).all()
    assert (found[..., 0] == -7).all()
    for k in (1, 2):
        expected = map_coordinates(picture[..., k].astype(float), (y[0], x[0]), mode="mirror")
        np.testing.assert_allclose(found[0, 3:, k], expected[3:], atol=0.02)


@pytest.mark.parametrize("wave_px", [4, 6, 12])
def test_turned_waves_come_out_better_than_by_lanczos(wave_px: float) -> None:
    def wave(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        turns = (np.cos(k) * x + np.sin(k) * y for k in (0.3, 1.4, 2.6))
        return 128 + 25 * np.sum([np.cos(2 * np.pi / wave_px * turn) for turn in turns], axis=0)

    y, x = np.mgrid[:200, :200].astype(np.float32)
    taken = np.repeat(np.rint(wave(x, y))[..., None], 3, axis=2).astype(np.uint8)
    at = 0.95 * x + 0.03 * y + 2.3, 0.94 * y - 0.03 * x + 7.1
    found = show_at(taken, *at), cv2.remap(taken, *at, cv2.INTER_LANCZOS4)
    errors = [np.std((shown[..., 0] - wave(*at))[10:-10, 10:-10]) for shown in found]
    assert 12**-0.5 < errors[0] < errors[1]


LENSES = pytest.mark.parametrize("lens", [port_lens(), opencv_lens()], ids=["port", "opencv"])


@LENSES
def test_pixels_come_back(lens: PinholeWarp) -> None:
    x, y = np.meshgrid(np.linspace(20, WIDTH - 20, 9), np.linspace(20, HEIGHT - 20, 7))
    taken = np.stack([x, y], axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(lens.from_pinhole(lens.to_pinhole(taken)), taken, atol=1e-6)


def test_the_port_lens_sees_points_at_the_working_range_as_its_pinhole() -> None:
    lens = port_lens()
    rng = np.random.default_rng(1)
    z = lens.working_range_m
    points = np.column_stack([rng.uniform(-0.6, 0.6, (50, 2)), np.full(50, z)])
    ideal = lens.to_pinhole(lens.camera.project(points))
    moved = lens.pinhole_from_cam.apply(points)
    expected = colmap_pinhole(lens.pinhole).img_from_cam(moved)
    np.testing.assert_allclose(ideal, expected, atol=1e-6)


@LENSES
def test_warped_pictures_carry_their_own_coordinates(lens: PinholeWarp, tmp_path: Path) -> None:
    """A picture whose grey levels are its coordinates shows where every warped pixel came from."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    coded = np.stack([x * 0.75, y, np.zeros_like(x)], axis=-1).astype(np.float32)
    pictures = workspace_of(tmp_path, lens, np.rint(coded).astype(np.uint8))
    warped, valid = pictures.colour("camera/a.png"), pictures.valid("camera/a.png")
    pinhole = lens.pinhole
    assert warped.shape == (pinhole.height_px, pinhole.width_px, 3)
    rows, columns = np.nonzero(valid)
    source = lens.from_pinhole(np.stack([columns, rows], axis=1).astype(float) + 0.5) - 0.5
    inner = np.all((source > 2) & (source < [WIDTH - 3, HEIGHT - 3]), axis=1)
    assert inner.mean() > 0.9
    shown = warped[rows, columns, :2][inner].astype(float) / [0.75, 1.0]
    assert np.abs(shown - source[inner]).max() < 1.5
    assert np.abs((shown - source[inner]).mean(axis=0)).max() < 0.05
    assert warped[~valid].max(initial=0) == 0


def test_pixels_beyond_the_fold_of_a_polynomial_are_not_valid() -> None:
    camera = pycolmap.Camera(
        model="RADIAL", width=WIDTH, height=HEIGHT, params=[200.0, 160.0, 120.0, -0.35, 0.02]
    )
    lens = self_calibrated_warp(camera)
    x, y = undistortion_maps(lens)
    seen = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    rows, columns = np.nonzero(seen)
    x, y = columns + 0.5 - lens.pinhole.cx_px, rows + 0.5 - lens.pinhole.cy_px
    radius = np.hypot(x, y) / lens.pinhole.focal_px
    # r (1 + k1 r^2 + k2 r^4) turns back where 1 + 3 k1 r^2 + 5 k2 r^4 = 0
    fold = np.sqrt(min(r.real for r in np.roots([5 * 0.02, 3 * -0.35, 1]) if r.real > 0))
    pixel = 1.0 / lens.pinhole.focal_px
    assert fold - 5 * pixel < radius.max() < fold + pixel


def workspace_of(
    tmp_path: Path, lens: PinholeWarp, picture: np.ndarray, mask: str = ""
) -> Pictures:
    (tmp_path / "images" / "camera").mkdir(parents=True)
    (tmp_path / "sparse").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "camera" / "a.png"), picture)
    image = {"camera": "camera", "station": 0, "mask": mask}
    known = {"cameras": {"camera": lens.to_json()}, "images": {"camera/a.png": image}}
    write_json(tmp_path / "sparse" / "cameras.json", known)
    return Pictures.open(tmp_path)


def test_masks_follow_the_warp(tmp_path: Path) -> None:
    lens = port_lens()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :100] = 0
    pictures = workspace_of(tmp_path, lens, np.full((HEIGHT, WIDTH, 3), 90, np.uint8), "m.png")
    cv2.imwrite(str(tmp_path / "images" / "m.png"), mask)
    valid = pictures.valid("camera/a.png")
    edge = lens.to_pinhole(np.array([[100.0, y] for y in (40.0, 120.0, 200.0)]))
    x, y = edge.astype(int).T
    assert not valid[y, x - 3].any() and valid[y, x + 3].all()
