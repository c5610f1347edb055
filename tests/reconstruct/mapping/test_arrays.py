"""A model's observations as arrays, against the model's own, one by one."""

import numpy as np
import pycolmap

from reconstruct.mapping.arrays import MIN_POINTS, first_of, linked_groups, observations
from tests.reconstruct.mapping.test_mapper import block_mapped


def test_observations_are_those_of_the_model() -> None:
    model = pycolmap.Reconstruction(block_mapped().model)
    model.deregister_frame(max(model.reg_frame_ids()))
    seen = observations(model)
    posed = sorted(n for n, image in model.images.items() if image.has_pose)
    assert seen.pictures.tolist() == posed and len(posed) < model.num_images()
    assert seen.point_ids.tolist() == sorted(model.points3D)
    assert len(seen.point) == model.compute_num_observations() == seen.starts[-1]
    missed = seen.residuals(model)
    for n, number in enumerate(posed):
        image, rows = model.images[number], seen.of(n)
        assert seen.row(number) == n
        assert seen.keypoint[rows].tolist() == list(image.get_observation_point2D_idxs())
        for row in range(rows.start, rows.stop, 7):
            point2d = image.points2D[int(seen.keypoint[row])]
            point3d = model.points3D[point2d.point3D_id]
            assert seen.point_ids[seen.point[row]] == point2d.point3D_id
            np.testing.assert_array_equal(seen.pixels[row], point2d.xy)
            np.testing.assert_array_equal(seen.points[seen.point[row]], point3d.xyz)
            local = image.cam_from_world() * point3d.xyz
            np.testing.assert_allclose(seen.in_cameras[row], local, atol=1e-12)
            expected = image.camera.img_from_cam(local) - point2d.xy
            np.testing.assert_allclose(missed[row], expected, atol=1e-9)


def test_groups_are_the_stations_that_points_link() -> None:
    """Against steps from station to station, as many as there can be; the largest group is 0."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        station, point = rng.integers(0, 12, 70), rng.integers(0, 60, 70)
        group = linked_groups(station, point, 13)
        seen = np.bincount(station, minlength=13) >= MIN_POINTS
        shows = np.zeros((13, 60), int)
        shows[station, point] = seen[station]
        same = np.linalg.matrix_power(np.minimum(shows @ shows.T, 1), 12)[seen][:, seen] > 0
        np.testing.assert_array_equal((group[:, None] == group)[seen][:, seen], same)
        counts = np.bincount(group[seen])
        assert np.all(np.diff(counts) <= 0)
        assert not group[~seen].any()
        assert first_of(group).tolist() == [group.tolist().index(g) for g in range(len(counts))]
