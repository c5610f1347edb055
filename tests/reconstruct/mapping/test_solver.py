from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform

from reconstruct.mapping.global_mapper import adjust
from reconstruct.mapping.mapper import Mapped, _options
from reconstruct.mapping.refraction import adjust_freely
from reconstruct.placing.alignment import align_rigid
from reconstruct.views.model_files import as_transform, rigid3d
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import pupils, started

BEND_M = 0.05


def bent(mapped: Mapped, scene: Scene) -> Mapped:
    """Poses and points along the first axis bent down at its ends."""
    model = pycolmap.Reconstruction(mapped.model)
    north = scene.points_ned[:, 0]
    middle, half = 0.5 * (north.max() + north.min()), 0.5 * np.ptp(north)

    def sunk(place: np.ndarray) -> np.ndarray:
        return place + np.array([0.0, 0.0, BEND_M * ((place[0] - middle) / half) ** 2])

    for frame in model.frames.values():
        pose = as_transform(frame.rig_from_world).inv()
        moved = RigidTransform.from_components(sunk(pose.translation), pose.rotation)
        frame.rig_from_world = rigid3d(moved.inv())
    for point in model.points3D.values():
        point.xyz = sunk(point.xyz)
    return replace(mapped, model=model)


def furthest_m(mapped: Mapped, other: Mapped, scene: Scene) -> float:
    """By how much the cameras of two models differ, wherever the models lie."""
    found, wanted = (pupils(m, scene)[0] for m in (mapped, other))
    return float(np.linalg.norm(align_rigid(found, wanted).apply(found) - wanted, axis=1).max())


@pytest.mark.slow
def test_more_than_a_thousand_pictures_end_at_the_optimum() -> None:
    """COLMAP's iterative solver leaves tens of millimetres of bend and reports convergence.

    Of ten lines of 28 m with some ten points in each picture, at the truth.
    """
    scene = make_scene(lines=10, stations=51, points=4000, noise_px=0.1)
    mapped, _ = started(scene, 0, (0.0, 0.0))
    assert len(scene.records) > 1000
    begun, best = bent(mapped, scene), adjust_freely(mapped)
    assert furthest_m(begun, best, scene) > 0.5 * BEND_M
    assert furthest_m(adjust_freely(begun), best, scene) < 0.08 * BEND_M
    model = pycolmap.Reconstruction(begun.model)
    adjust(model, _options(scene.rig.cam_from_rig, 1, "nothing"), tolerance=1e-6)
    assert furthest_m(replace(begun, model=model), best, scene) < 0.15 * BEND_M
