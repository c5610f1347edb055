"""A survey is laid on a reference of any kind, and its distance from it is what was put in."""

import struct
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Datum
from reconstruct.evaluate.reference import first_placement, read_reference
from reconstruct.evaluate.registration import (
    CloudFit,
    ReferenceSurface,
    covers,
    distances,
    register_cloud,
)
from reconstruct.placing.alignment import Similarity
from tests.alice_survey.app.report.tiny import write_raster

DATUM = Datum(46.8426, -91.9946)
UTM = 32615


def ground(rng: np.random.Generator, count: int, lift_m: float = 0.0) -> np.ndarray:
    """Points on a hilly ground of 20 x 20 m."""
    xy = rng.uniform(-10, 10, (count, 2))
    z = 0.8 * np.sin(xy[:, 0] / 2.1) + 0.6 * np.cos(xy[:, 1] / 1.7 + xy[:, 0] / 5)
    return np.column_stack([xy, z + 160 + lift_m])


def moved(scale: float) -> Similarity:
    """Where the survey truly lies on the reference, about their middle."""
    turn = Rotation.from_rotvec([0.004, -0.006, 0.01])
    middle = np.array([0.0, 0.0, 160.0])
    shift = np.array([0.15, -0.1, 0.3])
    return Similarity(
        scale=scale, rotation=turn, translation=middle + shift - scale * turn.apply(middle)
    )


def undone(pose: Similarity, points: np.ndarray) -> np.ndarray:
    return pose.rotation.inv().apply(points - pose.translation) / pose.scale


def fitted(
    own: np.ndarray, reference: ReferenceSurface, rng: np.random.Generator, free_scale: bool
) -> CloudFit:
    start = first_placement(own, reference)
    return register_cloud(own, reference, start, free_scale=free_scale, rng=rng)


@pytest.mark.parametrize("scale", [1.0, 1.013])
def test_a_known_motion_and_scale_are_found(scale: float) -> None:
    rng = np.random.default_rng(1)
    reference = ReferenceSurface.of(ground(rng, 40_000))
    true = moved(scale)
    own = undone(true, ground(rng, 30_000))
    fit = fitted(own, reference, rng, scale != 1.0)
    left = np.linalg.norm(fit.reference_from_cloud.apply(own) - true.apply(own), axis=1)
    assert left.max() < 0.01
    assert fit.reference_from_cloud.scale == pytest.approx(scale, abs=4e-4)
    assert (fit.scale_sigma == 0.0) == (scale == 1.0)


def test_the_rigid_fit_is_that_of_open3d() -> None:
    rng = np.random.default_rng(2)
    points, own = ground(rng, 20_000), undone(moved(1.0), ground(rng, 8_000))
    points[:, 2] += 0.01 * rng.normal(size=len(points))
    reference = ReferenceSurface.of(points)
    fit = fitted(own, reference, rng, False)
    target, source = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (points, own))
    target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    start = np.eye(4)
    start[:3, 3] = first_placement(own, reference).translation
    theirs = o3d.pipelines.registration.registration_icp(
        source, target, 1.0, start,
        o3d.pipelines.registration.TransformationEstimationPointToPlane(),
        o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=100),
    )  # fmt: skip
    expected = own @ theirs.transformation[:3, :3].T + theirs.transformation[:3, 3]
    assert np.abs(fit.reference_from_cloud.apply(own) - expected).max() < 0.01


def test_what_differs_does_not_pull_the_fit() -> None:
    rng = np.random.default_rng(3)
    reference = ReferenceSurface.of(ground(rng, 40_000))
    own = ground(rng, 30_000)
    changed = (own[:, 0] > 4) & (own[:, 1] > 4)  # 9 %
    own[changed, 2] += 0.7
    fit = fitted(own, reference, rng, True)
    still = own[~changed]
    assert np.abs(fit.reference_from_cloud.apply(still) - still).max() < 0.02


def test_distances_are_the_lift_whatever_the_spacing() -> None:
    rng = np.random.default_rng(4)
    sparse, dense = ground(rng, 8_000), ground(rng, 40_000, lift_m=0.05)
    ours = distances(dense, ReferenceSurface.of(sparse), rng)
    back = distances(sparse, ReferenceSurface.of(dense), rng)
    assert np.median(ours.signed_m) == pytest.approx(0.05, rel=0.15)
    assert np.median(back.signed_m) == pytest.approx(-0.05, rel=0.15)
    figures = ours.to_json(0.02)
    assert figures["median_px"] == pytest.approx(2.5, rel=0.15)
    assert figures["nearest_point_median_m"] > 1.3 * figures["median_m"]


def test_only_common_ground_is_compared() -> None:
    rng = np.random.default_rng(5)
    whole = ground(rng, 40_000)
    half = ReferenceSurface.of(whole[whole[:, 0] < 0])
    covered = covers(half, whole)
    assert covered[whole[:, 0] < -0.5].mean() > 0.97
    assert not covered[whole[:, 0] > 0.5].any()
    assert distances(whole, half, rng).covered_share == pytest.approx(0.5, abs=0.03)
    with pytest.raises(WorkspaceError):
        distances(whole + np.array([100.0, 0, 0]), half, rng)


def utm(points: np.ndarray) -> np.ndarray:
    """Local east, north, up of the datum in UTM and heights."""
    lat_lon = DATUM.geodetic_from_ned(np.column_stack([points[:, 1], points[:, 0], -points[:, 2]]))
    east, north = Transformer.from_crs(4326, UTM, always_xy=True).transform(
        lat_lon[:, 1], lat_lon[:, 0]
    )
    return np.column_stack([east, north, -lat_lon[:, 2]])


def write_cloud(path: Path, points: np.ndarray) -> Path:
    """A LAS or LAZ file in UTM."""
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = np.floor(points.min(axis=0)), [1e-4] * 3
    header.add_crs(CRS.from_epsg(UTM))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(str(path))
    return path


@pytest.mark.parametrize("kind", ["laz", "las"])
def test_a_cloud_in_utm_comes_back_to_local_metres(tmp_path: Path, kind: str) -> None:
    points = ground(np.random.default_rng(7), 3_000)
    found, placed = read_reference(write_cloud(tmp_path / f"c.{kind}", utm(points)), DATUM)
    assert placed
    np.testing.assert_allclose(found, points, atol=3e-4)


@pytest.mark.parametrize("nodata", [-9999, None])
def test_cells_of_an_elevation_model_are_points_at_their_middles(
    tmp_path: Path, nodata: int | None
) -> None:
    corner = tuple(utm(np.array([[-5.0, 5.0, 0.0]]))[0, :2])
    height = np.arange(400, dtype=np.float32).reshape(20, 20) / 100
    height[3, 4] = -9999
    path = write_raster(tmp_path / "dem.tif", height[None], 0.5, corner, crs=UTM, nodata=nodata)
    found, placed = read_reference(path, DATUM)
    assert placed
    assert len(found) == 399
    # The first cell's middle lies a quarter of a metre in; UTM is turned and stretched a little.
    np.testing.assert_allclose(found[0], [-4.75, 4.75, 0.0], atol=0.02)
    assert found[-1, 2] == pytest.approx(3.99, abs=1e-4)


@pytest.mark.slow
def test_a_real_cloud_is_read_in_local_metres(shared_data: Path) -> None:
    datum = Datum(46.842607083333334, -91.99455988888889)
    points, placed = read_reference(shared_data / "brighton_beach" / "model.laz", datum)
    assert placed
    assert len(points) == 940_393
    assert np.abs(points[:, :2]).max() < 120
    assert 150 < points[:, 2].min() < points[:, 2].max() < 175


@pytest.mark.slow
def test_packed_points_that_are_damaged_are_refused(tmp_path: Path) -> None:
    """Unpacking them here would end the program."""
    path = write_cloud(tmp_path / "c.laz", utm(ground(np.random.default_rng(7), 3_000)))
    whole = path.read_bytes()
    at = struct.unpack_from("<I", whole, 96)[0] + 8
    spoilt = [
        whole[: at + 100] + b"\xff" * 2000 + whole[at + 2100 :],
        whole[:at] + b"\xff" * 500 + whole[at + 500 :],
        whole[: len(whole) // 2],
        whole[: at - 8] + struct.pack("<q", len(whole) - 8) + whole[at:-4] + b"\xff" * 4,
        whole[:100] + struct.pack("<I", 1 << 31) + whole[104:],
        whole[:243] + struct.pack("<I", 1 << 31) + whole[247:],
    ]
    for data in spoilt:
        path.write_bytes(data)
        try:
            points, _ = read_reference(path, DATUM)
        except WorkspaceError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
        else:  # damage that a decoder cannot see
            assert np.isfinite(points).all()
    path.write_bytes(spoilt[2])
    with pytest.raises(WorkspaceError):
        read_reference(path, DATUM)


def test_a_model_in_no_place_on_earth_is_refused(tmp_path: Path) -> None:
    height = np.arange(400, dtype=np.float32).reshape(20, 20)
    local = 'LOCAL_CS["mine",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
    for crs, corner in ((f"EPSG:{UTM}", (1e30, 1e30)), (local, (0.0, 0.0))):
        write_raster(tmp_path / "m.tif", height[None], 1.0, corner, crs=crs)
        with pytest.raises(WorkspaceError):
            read_reference(tmp_path / "m.tif", DATUM)
