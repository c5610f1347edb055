from dataclasses import replace

import numpy as np

from reconstruct.placing.place import scale_by_altitudes
from tests.reconstruct.scenes import make_scene


def test_altitudes_scale_a_model_within_their_sigma() -> None:
    """Over 24 seeds of one error that all altitudes share, of 2 % as stated, and white ones."""
    scene, metres = make_scene(points=3000, relief_m=0.02), 2.5
    mono = [i for i, r in enumerate(scene.records) if r.camera == "left"]
    centres = np.stack([scene.ned_from_cam[i].translation for i in mono])
    floor = np.median(scene.points_ned[:, 2])
    errors = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        shared = 1.0 + 0.02 * rng.standard_normal()
        heights = (floor - centres[:, 2]) * shared * (1.0 + 0.01 * rng.standard_normal(len(mono)))
        records = [
            replace(scene.records[i], altitude_m=h, sigma_altitude_m=0.02 * h)
            for i, h in zip(mono, heights, strict=True)
        ]
        found = scale_by_altitudes(records, centres / metres, scene.points_ned / metres)
        assert found is not None
        errors.append(np.log(found[0] / metres) / found[1])
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_a_model_without_altitudes_gets_no_scale_of_them() -> None:
    scene = make_scene(points=100)
    records = [replace(r, altitude_m=float("nan")) for r in scene.records]
    centres = np.stack([p.translation for p in scene.ned_from_cam])
    assert scale_by_altitudes(records, centres, scene.points_ned) is None


def test_relief_below_makes_the_scale_less_certain() -> None:
    sigmas = []
    for relief in (0.02, 0.3):
        scene = make_scene(points=3000, relief_m=relief)
        mono = [i for i, r in enumerate(scene.records) if r.camera == "left"]
        centres = np.stack([scene.ned_from_cam[i].translation for i in mono])
        records = [replace(scene.records[i], altitude_m=2.0, sigma_altitude_m=0.02) for i in mono]
        found = scale_by_altitudes(records, centres, scene.points_ned)
        assert found is not None
        sigmas.append(found[1])
    assert sigmas[1] > 1.5 * sigmas[0]
    assert sigmas[0] < 0.1
