"""Exported pictures against exact rays, and their files as other programs read them."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from alice_survey.core.executor import SERIAL
from reconstruct.evaluate.scores import read_mesh
from reconstruct.export import bilinear, export_undistorted
from reconstruct.views.model import View, read_model, read_warps


@pytest.fixture(scope="module")
def workspace(small_survey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished survey whose pictures are exported; one picture has a mask of its own."""
    folder = tmp_path_factory.mktemp("export") / "survey"
    shutil.copytree(small_survey, folder)
    export_undistorted(folder, SERIAL)
    return folder


def seen_points(view: View, workspace: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points of the mesh that a view's pinhole sees first, world and camera, by a z-buffer."""
    vertices, triangles = read_mesh(workspace / "mesh")
    points = vertices[triangles].mean(axis=1)
    local = view.world_from_cam.inv().apply(points)
    pixels = view.pinhole.project(local)
    inside = (local[:, 2] > 0) & (pixels > 12).all(axis=1)
    inside &= (pixels < np.array(view.pinhole.size_px) - 12).all(axis=1)
    points, local, pixels = points[inside], local[inside], pixels[inside]
    block = (pixels // 12).astype(int)
    key = block[:, 1] * 10_000 + block[:, 0]
    nearest: dict[int, float] = {}
    for k, z in zip(key.tolist(), local[:, 2].tolist(), strict=True):
        nearest[k] = min(nearest.get(k, np.inf), z)
    first = local[:, 2] < np.array([nearest[k] for k in key.tolist()]) + 0.01
    return points[first], local[first]


def test_the_colmap_model_projects_to_where_the_exact_rays_land(workspace: Path):
    """The path of a pixel is found again by tracing positions through the exported resampling."""
    model = read_model(workspace / "sparse")
    warps = read_warps(workspace / "sparse" / "cameras.json")
    exported = pycolmap.Reconstruction(workspace / "undistorted" / "sparse" / "0")
    images = {image.name: image for image in exported.images.values()}
    from reconstruct import export
    from reconstruct.pictures.undistorted import Pictures

    for view in (model.views[0], model.views[-1]):
        points, local = seen_points(view, workspace)
        at = np.array([images[view.image].project_point(p) for p in points])
        warp = warps[view.camera]
        exact = warp.camera.project(warp.pinhole_from_cam.inv().apply(local))
        scene = export.scene_of(workspace / "mesh")
        depth = export.surface_depth(view, *scene)
        maps = export.taken_at(Pictures.open(workspace), view, depth)
        found = 0.5 + np.stack(
            [bilinear(one, at[:, 0] - 0.5, at[:, 1] - 0.5) for one in maps], axis=1
        )
        known = np.isfinite(found).all(axis=1) & np.isfinite(exact).all(axis=1)
        assert known.sum() > 300
        miss = np.linalg.norm(found - exact, axis=1)[known]
        assert np.percentile(miss, 99) < 1e-3
        one_distance = np.linalg.norm(warp.from_pinhole(at) - exact, axis=1)[known]
        assert np.percentile(one_distance, 99) > 3 * np.percentile(miss, 99)


def test_other_programs_read_what_was_written(workspace: Path):
    folder = workspace / "undistorted"
    text, binary = (pycolmap.Reconstruction(folder / name) for name in ("sparse", "sparse/0"))
    assert (
        text.num_reg_images()
        == binary.num_reg_images()
        == len(read_model(workspace / "sparse").views)
    )
    for image in text.images.values():
        picture = cv2.imread(str(folder / "images" / image.name))
        mask = cv2.imread(str(folder / "masks" / f"{image.name}.png"), cv2.IMREAD_GRAYSCALE)
        assert picture.shape[:2] == mask.shape == (image.camera.height, image.camera.width)
        assert (picture[mask == 0] == 0).all()
        assert 0.5 < (mask == 255).mean() <= 1.0
        assert picture[mask > 0].std() > 5
    shown = json.loads((folder / "export.json").read_text())["on_surface"]
    assert min(shown.values()) > 0.5
