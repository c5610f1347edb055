"""Lengths on a surface against those between the same spots of the true sea floor."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio

from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.terrain import read_terrain
from camera_calib.rig import read_rig
from reconstruct.evaluate.truth import read_true_poses
from reconstruct.measure.shapes import measure_line
from reconstruct.measure.surface import SOURCE, MeasuredSurface
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import read_model

PAIRS = 200


class TrueSpots:
    """Where spots of a model really are: what pictures show there, seen with the true cameras."""

    def __init__(self, workspace: Path) -> None:
        truth = workspace / "images" / "truth"
        self._source = workspace / SOURCE
        self._views = {view.image: view for view in read_model(workspace / "sparse").views}
        self._pictures = Pictures.open(workspace)
        self._rig, self._poses = read_rig(truth / "rig.json"), read_true_poses(truth / "poses.csv")
        self._terrain = read_terrain(truth / "terrain.ply")

    def of(self, points_ned: Array) -> Array:
        """(N, 3) of the true sea floor; NaN where no picture painted one, or its ray misses."""
        import open3d as o3d

        found = np.full_like(points_ned, np.nan)
        for n, point in enumerate(points_ned):
            with rasterio.open(self._source) as raster:
                number = next(raster.sample([point[[1, 0]]]))[0]
                names = json.loads(raster.tags()["PICTURES"])
            if not number:
                continue
            view = self._views[names[number - 1]]
            taken = self._pictures.warp(view.image).from_pinhole(view.project(point[None]))
            start, along = self._rig.cameras[view.camera].unproject(taken)
            pose = self._poses[view.image]
            start, along = pose.apply(start)[0], pose.rotation.apply(along)[0]
            # near to the surface, where single precision is fine enough
            start = start + (np.linalg.norm(point - start) - 0.3) * along
            ray = np.concatenate([start - self._terrain.offset_ned, along]).astype(np.float32)
            scene = self._terrain.raycasting_scene()
            reach = float(scene.cast_rays(o3d.core.Tensor(ray[None]))["t_hit"].numpy()[0])
            if reach < 0.6:
                found[n] = start + reach * along
        return found


@pytest.mark.slow
def test_lengths_are_as_wrong_as_their_sigmas_say(small_survey: Path) -> None:
    lengths, rises = length_errors(small_survey, np.random.default_rng(11))
    for errors in (lengths, rises):
        ratio = np.sqrt(np.mean(np.square(errors[:, 0] / errors[:, 1])))
        assert 0.5 < ratio < 1.4, ratio  # one survey is one draw of what all lengths share


def length_errors(workspace: Path, rng: np.random.Generator) -> tuple[Array, Array]:
    """(200, 2) errors and sigmas of lengths, and the same of height differences."""
    surface, truth = MeasuredSurface.of(workspace), TrueSpots(workspace)
    grid = surface.grid
    inside = surface.window(0, 0, grid.rows, grid.columns)[0]
    rows, columns = np.nonzero(np.isfinite(inside))
    found = ([], [])
    while len(found[0]) < PAIRS:
        pick = rng.integers(0, len(rows), 2)
        places = surface.places_of(rows[pick], columns[pick])
        places += rng.uniform(-0.4, 0.4, (2, 2)) * grid.cell
        height = surface.at(places).height
        if not np.isfinite(height).all():
            continue
        true = truth.of(np.column_stack([places[:, 1], places[:, 0], -height]))
        if not np.isfinite(true).all():
            continue
        figures = {one.name: one for one in measure_line(surface, places.tolist())}
        length = np.linalg.norm(true[1] - true[0])
        for name, value, into in (
            ("length", length, found[0]), ("height_difference", true[0, 2] - true[1, 2], found[1]),
        ):  # fmt: skip
            into.append((figures[name].value - value, figures[name].sigma))
    return np.array(found[0]), np.array(found[1])
