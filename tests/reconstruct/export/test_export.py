"""Products in UTM against Krueger's series and each other; exported pictures against exact rays."""

import csv
import json
import math
import shutil
from pathlib import Path

import cv2
import laspy
import numpy as np
import pycolmap
import pyproj
import pytest
import rasterio
from scipy.ndimage import map_coordinates

from alice_survey.core.executor import SERIAL
from reconstruct import export
from reconstruct.elevation import elevation_in
from reconstruct.evaluate.scores import read_mesh
from reconstruct.export import bilinear, destination, export_projected, export_undistorted
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View, read_frame, read_model, read_warps

pytestmark = pytest.mark.slow

CRS = "EPSG:32636"
CENTRAL_DEG, EAST_M, SCALE = 33.0, 500_000.0, 0.9996


def utm(latitude_deg: np.ndarray, longitude_deg: np.ndarray) -> np.ndarray:
    """Easting and northing of WGS 84 by Krueger's series (1912), to fractions of a millimetre."""
    a, f = 6378137.0, 1 / 298.257223563
    n = f / (2 - f)
    radius = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = [n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3, 13 / 48 * n**2 - 3 / 5 * n**3, 61 / 240 * n**3]
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg - CENTRAL_DEG)
    e = 2 * math.sqrt(n) / (1 + n)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arctanh(np.sin(lam) / np.sqrt(1 + t * t))
    x, y = eta.copy(), xi.copy()
    for j, c in enumerate(alpha, 1):
        x += c * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
        y += c * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
    return np.column_stack([EAST_M + SCALE * radius * x, SCALE * radius * y])


@pytest.fixture(scope="module")
def workspace(small_survey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished survey that is exported both ways."""
    folder = tmp_path_factory.mktemp("export") / "survey"
    shutil.copytree(small_survey, folder)
    text, values = export_projected(folder, CRS)
    assert "UTM zone 36N" in text
    assert values["vertical_datum"] == read_frame(folder / "sparse" / "frame.json").vertical_datum
    export_undistorted(folder, SERIAL)
    return folder


def test_places_are_where_the_series_says(workspace: Path):
    with (workspace / "sparse" / "track.csv").open(newline="") as file:
        old = list(csv.DictReader(file))
    degrees = [np.array([float(r[f"{k}_deg"]) for r in old]) for k in ("latitude", "longitude")]
    local = np.array([[float(r["east_m"]), float(r["north_m"])] for r in old])
    frame = read_frame(workspace / "sparse" / "frame.json")
    # ten decimals of a degree are 0.01 mm
    np.testing.assert_allclose(destination(CRS, frame).places(local), utm(*degrees), atol=2e-4)


def test_heights_of_the_raster_are_those_of_the_old_one_at_the_same_places(workspace: Path):
    folder = workspace / "EPSG-32636"
    with (
        rasterio.open(workspace / "dense" / "dem.tif") as old,
        rasterio.open(folder / "dem.tif") as new,
    ):
        assert new.crs.to_epsg() == 32636
        assert new.tags()["VERTICAL_DATUM"] == old.tags()["VERTICAL_DATUM"]
        assert new.descriptions == old.descriptions
        assert new.transform.a == pytest.approx(old.transform.a)
        heights, cell = new.read(1), new.transform.a
        rows, columns = np.nonzero(np.isfinite(heights))
        assert len(rows) > 0.97 * np.isfinite(old.read(1)).sum()
        pick = np.random.default_rng(1).choice(len(rows), 2000, replace=False)
        rows, columns = rows[pick], columns[pick]
        x, y = new.transform * (columns + 0.5, rows + 0.5)
        back = pyproj.Transformer.from_crs(CRS, old.crs.to_wkt(), always_xy=True)
        east, north = back.transform(x, y)
    true = elevation_in(workspace / "dense")
    at = (true.north - north) / cell - 0.5, (east - true.west) / cell - 0.5
    expected = map_coordinates(true.height, at, order=1, cval=np.nan)
    error = heights[rows, columns] - expected
    error = error[np.isfinite(error)]
    assert len(error) > 1000
    assert np.percentile(np.abs(error), 95) < 2e-4


def test_cloud_and_mesh_lie_on_the_raster(workspace: Path):
    folder = workspace / "EPSG-32636"
    with rasterio.open(folder / "dem.tif") as raster:
        dem, at = raster.read(1), ~raster.transform
    cloud = laspy.read(folder / "cloud.copc.laz")
    old = laspy.read(workspace / "dense" / "cloud.copc.laz")
    assert len(cloud) == len(old)
    np.testing.assert_array_equal(np.sort(cloud["sigma"]), np.sort(old["sigma"]))
    with laspy.CopcReader.open(folder / "cloud.copc.laz") as reader:
        assert len(reader.query()) == len(old)
    assert cloud.header.parse_crs().to_epsg() == 32636
    assert "sigma" in cloud.point_format.extra_dimension_names
    offset = json.loads((folder / "projected.json").read_text())["mesh_offset"]
    lines = (folder / "mesh.obj").read_text().splitlines()
    mesh = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float) + offset
    assert sum(line.startswith("f ") for line in lines) > 1000
    assert (folder / "mesh.mtl").exists()
    for points in (np.column_stack([cloud.x, cloud.y, cloud.z])[::50], mesh[::20]):
        columns, rows = at * (points[:, 0], points[:, 1])
        r, c = rows.astype(int), columns.astype(int)
        inside = (r >= 0) & (c >= 0) & (r < dem.shape[0]) & (c < dem.shape[1])
        gap = points[inside, 2] - dem[r[inside], c[inside]]
        assert np.nanmedian(np.abs(gap)) < 0.005
    length = np.sqrt(np.square([cloud[name] for name in ("nx", "ny", "nz")]).sum(axis=0))
    np.testing.assert_allclose(length, 1.0, atol=1e-4)


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
    nearest = np.full(key.max() + 1, np.inf)
    np.minimum.at(nearest, key, local[:, 2])
    first = local[:, 2] < nearest[key] + 0.01
    return points[first], local[first]


def test_the_colmap_model_projects_to_where_the_exact_rays_land(workspace: Path):
    """The path of a pixel is found again by tracing positions through the exported resampling."""
    model = read_model(workspace / "sparse")
    warps = read_warps(workspace / "sparse" / "cameras.json")
    exported = pycolmap.Reconstruction(workspace / "undistorted" / "sparse" / "0")
    images = {image.name: image for image in exported.images.values()}
    for view in (model.views[0], model.views[-1]):
        points, local = seen_points(view, workspace)
        at = np.array([images[view.image].project_point(p) for p in points])
        warp = warps[view.camera]
        exact = warp.camera.project(warp.pinhole_from_cam.inv().apply(local))
        depth = export.surface_depth(view, *export.scene_of(workspace / "mesh"))
        maps = export.taken_at(Pictures.open(workspace), view, depth)
        places = at.T - 0.5
        found = 0.5 + np.stack([bilinear(one, *places) for one in maps], axis=1)
        known = np.isfinite(found).all(axis=1) & np.isfinite(exact).all(axis=1)
        assert known.sum() > 300
        miss = np.linalg.norm(found - exact, axis=1)[known]
        assert np.percentile(miss, 99) < 1e-3
        one_distance = np.linalg.norm(warp.from_pinhole(at) - exact, axis=1)[known]
        assert np.percentile(one_distance, 99) > 3 * np.percentile(miss, 99)


def test_other_programs_read_what_was_written(workspace: Path):
    folder = workspace / "undistorted"
    text, binary = (pycolmap.Reconstruction(folder / name) for name in ("sparse", "sparse/0"))
    views = read_model(workspace / "sparse").views
    assert text.num_reg_images() == binary.num_reg_images() == len(views)
    for image in text.images.values():
        picture = cv2.imread(str(folder / "images" / image.name))
        mask = cv2.imread(str(folder / "masks" / f"{image.name}.png"), cv2.IMREAD_GRAYSCALE)
        assert picture.shape[:2] == mask.shape == (image.camera.height, image.camera.width)
        assert (picture[mask == 0] == 0).all()
        assert 0.5 < (mask == 255).mean() <= 1.0
        assert picture[mask > 0].std() > 5
    shown = json.loads((folder / "export.json").read_text())["on_surface"]
    assert min(shown.values()) > 0.5
