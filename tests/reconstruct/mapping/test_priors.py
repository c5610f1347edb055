import numpy as np

from reconstruct.mapping.priors import adjust_freely, pinhole_positions, refine_with_positions
from reconstruct.mapping.robust import pixel_sigma
from tests.reconstruct.mapping.test_mapper import camera_rms, mapped_scene
from tests.reconstruct.scenes import DATUM, make_scene


def test_vague_positions_do_not_spoil_a_model_of_precise_pixels() -> None:
    """COLMAP takes pixels to have unit sigma: of 0.05 px they would count 400 times too little."""
    scene = make_scene(lines=2, stations=5, points=6000, noise_px=0.05, seed=8)
    mapped = adjust_freely(mapped_scene(scene))
    assert 0.8 * 0.05 < pixel_sigma(mapped.model) < 1.4 * 0.05
    positions, sigmas = pinhole_positions(scene.records, scene.rig, mapped.lenses, DATUM)
    station = np.array([r.station for r in scene.records])
    noise = np.random.default_rng(1).normal(0, 0.1, (station.max() + 1, 3))[station]
    vague = np.full_like(sigmas, 0.1)
    refined = refine_with_positions(mapped, scene.records, positions + noise, vague)
    assert refined is not mapped
    free = camera_rms(mapped, scene)
    assert 0.5 * free < camera_rms(refined, scene) < 1.3 * free
