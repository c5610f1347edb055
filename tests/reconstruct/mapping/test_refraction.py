"""Refraction taken through COLMAP, against the truth and against an exact refractive adjustment."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from camera_calib.ports.dome import DomePort
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.refraction import SETTLED_PX, adjust_freely, refract
from reconstruct.mapping.working_range import warp_record
from reconstruct.placing.alignment import align_similarity
from reconstruct.views.range_shift import range_shift
from tests.oracles_refraction import adjust_through_ports
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import DISTANCES, points_of, pupils, rigid_rms, started

PORTS = [(0.02, 0.0), (0.02, 2.0), (0.05, 0.0), (0.05, 2.0)]


@cache
def scene_at(port_m: float, tilt_deg: float, noise_px: float = 0.3) -> Scene:
    return make_scene(
        lines=2,
        stations=4,
        points=500,
        noise_px=noise_px,
        port_distance_m=port_m,
        port_tilt_deg=(tilt_deg, 0.0),
        scale=1,
        relief_m=0.3,
    )


@cache
def started_at(*port: float) -> tuple[Mapped, Observations]:
    return started(scene_at(*port))


def assert_exact(mapped: Mapped, scene: Scene) -> None:
    assert rigid_rms(*points_of(mapped, scene)) < 0.01e-3
    assert rigid_rms(*pupils(mapped, scene)) < 0.01e-3


@pytest.mark.parametrize(("port_m", "tilt_deg"), PORTS)
def test_without_noise_nothing_is_left_of_the_port(
    port_m: float, tilt_deg: float, tmp_path: Path
) -> None:
    scene, start = scene_at(port_m, tilt_deg, 0.0), started_at(port_m, tilt_deg, 0.0)
    mapped, found = refract(*start, tmp_path)
    assert_exact(mapped, scene)
    assert abs(align_similarity(*points_of(mapped, scene)).scale - 1.0) < 1e-6
    assert found.settled
    assert found.moved_px[0] > 100 * SETTLED_PX
    bent = points_of(adjust_freely(start[0]), scene)
    assert rigid_rms(*bent) > 0.05e-3, "what was to be corrected was there"


@pytest.mark.parametrize(
    ("offset_m", "corrected_px", "contraction"),
    [
        ((0.0, 0.0, 0.0), 0.0, 0.0),
        ((0.0, 0.0, 0.005), 1.8e-4, 2.3e-6),
        ((0.012, -0.01, 0.02), 0.026, 1.7e-4),
    ],
)
def test_without_noise_nothing_is_left_of_a_dome(
    offset_m: tuple[float, float, float], corrected_px: float, contraction: float, tmp_path: Path
) -> None:
    """A dome of 50 mm before a pupil at its centre, 5 mm behind it, and strongly off it."""
    x, y, z = offset_m
    dome = DomePort(
        dome_x_m=x, dome_y_m=y, dome_z_m=z, outer_radius_m=0.05, glass_thickness_m=0.005
    )
    scene = make_scene(lines=2, stations=4, points=900, port=dome, scale=1, relief_m=0.3)
    mapped, found = refract(*started(scene), tmp_path)
    assert_exact(mapped, scene)
    assert found.settled
    assert found.corrected_px == pytest.approx(corrected_px, rel=0.2)
    record = warp_record(mapped.warps["left"], DISTANCES)
    assert record.contraction == pytest.approx(contraction, rel=0.2)


@pytest.mark.parametrize(
    ("port_m", "tilt_deg"),
    [PORTS[0], *(pytest.param(*p, marks=pytest.mark.slow) for p in PORTS[1:])],
)
def test_with_noise_points_are_those_of_an_exact_refractive_adjustment(
    port_m: float, tilt_deg: float, tmp_path: Path
) -> None:
    scene = scene_at(port_m, tilt_deg)
    mapped, _ = refract(*started_at(port_m, tilt_deg), tmp_path)
    points, true_points = points_of(mapped, scene)
    ids = np.array(sorted(mapped.model.points3D)) - 1
    _, oracle = adjust_through_ports(scene, scene.left.ned_from_cam, scene.points_ned[ids], ids)
    ours, best = rigid_rms(points, true_points), rigid_rms(oracle, true_points)
    assert 0.9 * best < ours < 1.05 * best
    assert rigid_rms(points, oracle) < 0.25 * best
    assert 0.5e-3 < best < 5e-3


def test_keypoints_end_where_the_field_of_the_lens_says(tmp_path: Path) -> None:
    """The later stages read the model through `RangeShift`: both must agree."""
    scene, start = scene_at(0.05, 2.0), started_at(0.05, 2.0)
    mapped, _ = refract(*start, tmp_path)
    for number, image in mapped.model.images.items():
        shift = range_shift(mapped.warps[scene.records[number - 1].camera])
        at = image.get_observation_point2D_idxs()
        warped = start[1].pixels[number - 1][at]
        points = [mapped.model.points3D[p.point3D_id].xyz for p in image.get_observation_points2D()]
        depth = np.array([(image.cam_from_world() * p)[2] for p in points])
        ideal = np.array([p.xy for p in image.get_observation_points2D()])
        np.testing.assert_allclose(ideal, shift.ideal(warped, depth), atol=2e-3)


def test_wrong_matches_go_and_right_ones_stay(tmp_path: Path) -> None:
    scene = scene_at(0.05, 0.0)
    rng = np.random.default_rng(4)
    pixels = [p.copy() for p in scene.pixels]
    for rows in pixels:
        bad = rng.choice(len(rows), 2, replace=False)
        rows[bad] += rng.choice([-1.0, 1.0], (2, 2)) * rng.uniform(25, 40, (2, 2))
    start = started(replace(scene, pixels=pixels))
    mapped, found = refract(*start, tmp_path)
    total, spoiled = start[0].model.compute_num_observations(), 2 * len(pixels)
    assert spoiled <= found.removed < spoiled + 0.25 * total
    assert rigid_rms(*points_of(mapped, scene)) < 4e-3


def test_with_matches_lost_observations_come_back(tmp_path: Path) -> None:
    """A track that lost a picture's keypoint gets it back, at its exact place."""
    scene, start = scene_at(0.05, 0.0), started_at(0.05, 0.0)
    seen = replace(start[1], pairs=scene.pairs)
    model = pycolmap.Reconstruction(start[0].model)
    for point in list(model.points3D)[::3]:
        track = model.points3D[point].track.elements
        if len(track) > 4:
            model.delete_observation(track[-1].image_id, track[-1].point2D_idx)
    lost = start[0].model.compute_num_observations() - model.compute_num_observations()
    assert lost > 10
    _, found = refract(
        replace(start[0], model=model), seen, tmp_path, cam_from_rig=scene.rig.cam_from_rig
    )
    assert found.added == pytest.approx(lost, abs=0.1 * lost)
    assert not list(tmp_path.iterdir()), "scratch is cleared"
