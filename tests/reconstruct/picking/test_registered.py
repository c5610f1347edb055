"""Which pictures see a place: as one picture after the other says, for thousands."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.rig import design_rig
from reconstruct.picking.registered import RegisteredPictures
from reconstruct.views.model import WorldFrame

FRAME = WorldFrame(name="ned", datum=None, scaled=True, vertical_datum="test")
UP = np.array([0.0, 0.0, -1.0])


def block(count: int, rng: np.random.Generator, half: float = 5.0) -> RegisteredPictures:
    """Pictures of two cameras over a square, 2 m above its floor at 10 m, tilted a little."""
    rig = design_rig(CameraConfig(), WaterConfig(), scale=6)
    warps = {name: best_warp(camera, 1.5, 2.5) for name, camera in rig.cameras.items()}
    centres = np.column_stack([rng.uniform(-half, half, (count, 2)), rng.uniform(7.8, 8.2, count)])
    nadir = Rotation.from_euler("z", rng.uniform(0, 360, (count, 1)), degrees=True)
    tilt = Rotation.from_rotvec(rng.normal(0, 0.1, (count, 3)))
    return RegisteredPictures(
        names=tuple(f"{n:05d}.png" for n in range(count)), camera=np.arange(count) % 2,
        station=np.arange(count) // 2, turns=(nadir * tilt).as_matrix(), centres=centres,
        warps=warps, frame=FRAME,
    )  # fmt: skip


def test_pictures_of_a_place_are_those_whose_rays_say_so() -> None:
    rng = np.random.default_rng(4)
    pictures, place = block(10_000, rng, 20.0), np.array([1.0, -2.0, 10.0])
    seen = {one.image: one for one in pictures.seeing(place, UP)}

    near = np.linalg.norm(pictures.centres[:, :2] - place[:2], axis=1) < 4.0
    expected = {}
    for row in np.flatnonzero(near).tolist():
        picture = pictures.picture(pictures.names[row])
        pixel = picture.project(place)
        size = picture.warp.size_px
        if np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel <= size).all():
            expected[pictures.names[row]] = pixel
    assert seen.keys() == expected.keys() and 4 < len(seen) < 40
    for name, pixel in expected.items():
        np.testing.assert_allclose(seen[name].pixel, pixel, atol=1e-6)
        start, way = pictures.picture(name).ray(pixel)
        assert np.linalg.norm(np.cross(place - start, way)) < 1e-8


def test_the_best_come_first() -> None:
    pictures, place = block(4000, np.random.default_rng(5)), np.array([0.0, 0.0, 10.0])
    seen = pictures.seeing(place, UP)
    middle = np.array(pictures.picture(seen[0].image).warp.size_px) / 2
    away = [float(np.linalg.norm(one.pixel - middle)) for one in seen]
    third = len(seen) // 3
    assert np.mean(away[:third]) < 0.8 * np.mean(away[-third:])


def test_a_wall_is_seen_from_its_front_alone() -> None:
    pictures, place = block(2000, np.random.default_rng(6)), np.array([0.0, 0.0, 10.0])
    north = pictures.seeing(place, np.array([1.0, 0.0, 0.0]))
    south = pictures.seeing(place, np.array([-1.0, 0.0, 0.0]))
    for seen, sign in ((north, 1.0), (south, -1.0)):
        rows = [pictures.row(one.image) for one in seen]
        assert rows and (sign * pictures.centres[rows, 0] > 0).all()
    assert len(north) + len(south) == len(pictures.seeing(place, UP))


def test_a_picture_stands_where_its_pinhole_does() -> None:
    pictures = block(10, np.random.default_rng(7))
    picture = pictures.picture("00003.png")
    pinhole = picture.model_from_pinhole * picture.warp.pinhole_from_cam
    expected = RigidTransform.from_components(
        pictures.centres[3], Rotation.from_matrix(pictures.turns[3])
    )
    np.testing.assert_allclose(pinhole.as_matrix(), expected.as_matrix(), atol=1e-12)
