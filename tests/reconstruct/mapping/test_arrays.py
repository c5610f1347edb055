"""A model's observations as arrays, against the model's own, one by one."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from reconstruct.mapping.arrays import observed
from reconstruct.views import model_files
from tests.reconstruct.mapping.test_mapper import block_mapped


def test_observations_are_those_of_the_model() -> None:
    model = pycolmap.Reconstruction(block_mapped().model)
    lost = max(model.reg_frame_ids())
    model.deregister_frame(lost)
    seen = observed(model)
    posed = sorted(n for n, image in model.images.items() if image.has_pose)
    assert seen.pictures.tolist() == posed and len(posed) < model.num_images()
    assert seen.point_ids.tolist() == sorted(model.points3D)
    assert len(seen.point) == model.compute_num_observations() == seen.starts[-1]
    missed = seen.misses(model)
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


def test_an_empty_model_has_no_observations() -> None:
    seen = observed(pycolmap.Reconstruction())
    assert len(seen.pictures) == len(seen.point) == len(seen.points) == 0
    assert seen.pixels.shape == (0, 2) and seen.in_cameras.shape == (0, 3)


def test_a_copy_for_which_there_was_no_room_is_named(tmp_path: Path) -> None:
    model = block_mapped().model
    model.write_binary(tmp_path)
    whole = (tmp_path / "images.bin").read_bytes()
    for length in (4, 30, len(whole) // 2, len(whole) - 1):
        (tmp_path / "images.bin").write_bytes(whole[:length])
        with pytest.raises(OSError):
            dict(model_files._all_keypoints(tmp_path / "images.bin"))
