import numpy as np
import pytest

from reconstruct.mosaic.visibility import CameraOptics, Ground, see, visible_cells
from reconstruct.raster import DemGrid
from reconstruct.views.model import View
from reconstruct.views.range_shift import as_nodes, no_shift
from tests.oracles_dense import sees, stereo_views


def hills() -> np.ndarray:
    rows, columns = np.mgrid[:40, :50]
    height = 0.8 * np.sin(rows / 9.0 + 0.4) + 0.7 * np.cos(columns / 8.0)
    return height.astype(np.float32)


@pytest.mark.parametrize("camera", [(0.2, -0.2, 1.8), (-1.0, -3.9, 2.0), (4.9, 1.0, 1.7)])
def test_visible_cells_equal_a_walk_along_the_sight_line(camera: tuple[float, float, float]):
    height, cell, tolerance = hills(), 0.1, 0.15
    place = np.array(camera)
    visible = visible_cells(height, place, 0.0, 0.0, cell, tolerance, (0, 40, 0, 50))
    clear = unsure = 0
    for row in range(0, 40, 3):
        for column in range(0, 50, 3):
            rise = sees(height, place, cell, row, column)
            if abs(rise - tolerance) < 0.1:  # cells are steps: the two walks meet others of them
                unsure += 1
                continue
            clear += 1
            assert visible[row, column] == (rise < tolerance), (row, column, rise)
    assert clear > 2 * unsure
    assert 0.2 < visible.mean() < 0.98


def straight_nodes(view: View) -> np.ndarray:
    """A lens that changes nothing."""
    x, y = np.linspace(0, view.pinhole.width_px, 5), np.linspace(0, view.pinhole.height_px, 4)
    return np.stack(np.meshgrid(x, y), axis=-1)


def test_look_up_projects_as_the_view_does_and_prefers_its_middle():
    view = stereo_views(np.array([0.0]), np.array([0.0]))[0]
    size_px = view.pinhole.size_px
    grid = DemGrid(west=-1.01, north=0.91, cell=0.02, rows=90, columns=100)
    dem = np.full((90, 100), -12.0, np.float32)
    dem[40, 50] = np.nan
    surface = Ground(dem, grid).surface(grid)
    taken, shift = as_nodes(straight_nodes(view), *size_px), no_shift(*size_px)
    optics = CameraOptics(taken=taken, shift=shift, size_px=size_px)
    x, y, quality, ranges = see(view, optics, surface)
    rows, columns = np.mgrid[:90, :100] + 0.5
    world = np.stack(
        [grid.north_of(rows), grid.east_of(columns), np.full(rows.shape, 12.0)], axis=-1
    )
    pixels = view.project(world.reshape(-1, 3)).reshape(90, 100, 2)
    inside = quality > 0
    np.testing.assert_allclose(x[inside], pixels[inside][:, 0] - 0.5, atol=2e-3)
    np.testing.assert_allclose(y[inside], pixels[inside][:, 1] - 0.5, atol=2e-3)
    away = np.linalg.norm(world - view.world_from_cam.translation, axis=-1)
    np.testing.assert_allclose(ranges[inside], away[inside], rtol=1e-6)
    assert np.isnan(ranges[~inside]).all()
    border = np.minimum(pixels, size_px - pixels).min(axis=-1)
    expected = (border > 2.0) & np.isfinite(surface.height)
    np.testing.assert_array_equal(inside, expected)
    assert 0.2 < inside.mean() < 1.0
    best = np.unravel_index(np.argmax(quality), quality.shape)
    assert border[best] > 0.95 * border.max()
    assert not (quality * ~expected).any()
