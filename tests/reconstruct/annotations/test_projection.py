"""Annotations in pictures against the true sea floor that was rendered, and their sigmas."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import ReconstructionError
from alice_survey.sim.seafloor.terrain import Terrain, read_terrain
from camera_calib.rig import read_rig
from reconstruct.annotations.marks import sigma_of_area
from reconstruct.annotations.projection import OnPlane, Projector
from reconstruct.annotations.values import DrawnShape
from reconstruct.evaluate.truth import read_true_poses
from reconstruct.placing.alignment import align_rigid

PICK_PX = 0.5


@dataclass(frozen=True)
class Truth:
    """Where rendered pixels are on the true sea floor, in the frame of the model."""

    folder: Path
    projector: Projector

    @cached_property
    def poses(self) -> dict[str, RigidTransform]:
        return read_true_poses(self.folder / "poses.csv")

    @cached_property
    def terrain(self) -> Terrain:
        return read_terrain(self.folder / "terrain.ply")

    @cached_property
    def world_from_truth(self) -> RigidTransform:
        names, centres = self.projector.pictures.names, self.projector.pictures.centres
        return align_rigid(np.array([self.poses[n].translation for n in names]), centres)

    def hits(self, image: str, pixels: np.ndarray) -> np.ndarray:
        import open3d as o3d

        camera = read_rig(self.folder / "rig.json").cameras[image.split("/")[0]]
        starts, ways = camera.unproject(pixels)
        starts = self.poses[image].apply(starts)
        ways = self.poses[image].rotation.apply(ways)
        rays = np.column_stack([starts - self.terrain.offset_ned, ways]).astype(np.float32)
        reach = self.terrain.raycasting_scene().cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        return self.world_from_truth.apply(starts + reach[:, None].astype(float) * ways)

    def pixels(self, image: str, points: np.ndarray) -> np.ndarray:
        camera = read_rig(self.folder / "rig.json").cameras[image.split("/")[0]]
        cam_from_world = self.poses[image].inv() * self.world_from_truth.inv()
        return camera.project(cam_from_world.apply(points))


@pytest.fixture(scope="module")
def truth(small_survey: Path) -> Truth:
    return Truth(small_survey / "images" / "truth", Projector(small_survey))


def scatter(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([20, 20], [544, 431], (count, 2))


def over_sigma(miss: np.ndarray, sigma: np.ndarray) -> float:
    """Root mean square of misses over sigmas; without the few beside edges that hide a step."""
    ratio = np.linalg.norm(miss, axis=1) / sigma
    ratio = np.sort(ratio[np.isfinite(ratio)])
    assert len(ratio) > 0.9 * len(miss)
    kept = ratio[: int(0.99 * len(ratio))]
    return float(np.sqrt(np.mean(kept**2)))


def test_picked_vertices_lie_within_their_sigma_on_the_true_sea_floor(truth: Truth) -> None:
    rng = np.random.default_rng(1)
    misses, sigmas, exact, exact_sigmas = [], [], [], []
    for image in truth.projector.pictures.names[::3]:
        pixels = scatter(rng, 100)
        true = truth.hits(image, pixels)
        noisy = truth.projector.to_plane(image, pixels + rng.normal(0, PICK_PX, pixels.shape))
        misses.append((noisy.points - true)[:, [1, 0]])
        sigmas.append(noisy.sigma)
        sure = truth.projector.to_plane(image, pixels, 0.0)
        exact.append((sure.points - true)[:, [1, 0]])
        exact_sigmas.append(sure.sigma)
        assert np.nanmedian(sure.sigma) < 0.5 * np.nanmedian(noisy.sigma)
    ratio = over_sigma(np.concatenate(misses), np.concatenate(sigmas))
    assert 0.7 < ratio < 1.4
    # without noise of picks: what poses and the surface do, here 0.3 mm where a pixel is 2.7
    assert 0.7 < over_sigma(np.concatenate(exact), np.concatenate(exact_sigmas)) < 1.4
    assert np.nanmedian(np.linalg.norm(np.concatenate(exact), axis=1)) < 3e-4


def test_what_one_picture_shows_is_found_in_others(truth: Truth) -> None:
    rng = np.random.default_rng(2)
    misses, sigmas, shown = [], [], 0
    for image in truth.projector.pictures.names[1::5]:
        pixels = scatter(rng, 40)
        true = truth.hits(image, pixels)
        noisy = truth.projector.to_plane(image, pixels + rng.normal(0, PICK_PX, pixels.shape))
        for other in (
            truth.projector.to_picture(name, noisy) for name in truth.projector.pictures.names
        ):
            if other.image == image or other.seen.sum() < 5:
                continue
            shown += 1
            miss = other.pixels - truth.pixels(other.image, true)
            misses.append(miss[other.seen])
            sigmas.append(other.sigma[other.seen])
    assert shown > 20
    assert 0.7 < over_sigma(np.concatenate(misses), np.concatenate(sigmas)) < 1.4


def test_there_and_back_again_is_the_same_pixel(truth: Truth) -> None:
    image = truth.projector.pictures.names[4]
    pixels = scatter(np.random.default_rng(4), 50)
    back = truth.projector.to_picture(image, truth.projector.to_plane(image, pixels))
    known = np.isfinite(back.pixels[:, 0])
    assert known.sum() > 45 and back.seen[known].mean() > 0.95
    np.testing.assert_allclose(back.pixels[known], pixels[known], atol=1e-6)


def test_an_outline_is_shown_in_the_pictures_above_it(truth: Truth) -> None:
    spots = truth.projector.to_plane(
        truth.projector.pictures.names[4],
        np.array([[250.0, 200], [300, 200], [300, 250], [250, 250]]),
    )
    shown = truth.projector.shown_in(spots)
    assert len(shown) > 3 and truth.projector.pictures.names[4] in {one.image for one in shown}
    for one in shown:
        assert one.seen.mean() > 0.5
        np.testing.assert_allclose(
            one.pixels, truth.pixels(one.image, spots.points), atol=2.0
        )  # of what the model has there


def test_a_vertex_beyond_the_surface_is_one_line(truth: Truth) -> None:
    image = truth.projector.pictures.names[0]
    shape = DrawnShape(kind="polygon", points=((100.0, 100.0), (200.0, 100.0), (-4e3, 1e4)))
    with pytest.raises(ReconstructionError, match="1 of 3 vertices") as caught:
        truth.projector.on_plane(shape, image)
    assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(ReconstructionError, match="nowhere"):
        truth.projector.on_plane(shape, "nowhere.png")


def test_the_sigma_of_an_area_is_what_picks_do() -> None:
    """Monte Carlo over vertices that err alone, and a shift of all that leaves the area."""
    rng = np.random.default_rng(5)
    ring = np.array([[0.0, 0], [1.0, 0.1], [1.2, 0.9], [0.4, 1.1], [-0.1, 0.6]])
    hole = np.array([[0.4, 0.4], [0.4, 0.6], [0.6, 0.6], [0.6, 0.4]])
    shape = DrawnShape(kind="polygon", points=as_places(ring), holes=(as_places(hole),))
    sigma = 0.01
    spots = [spots_of(np.array(one), sigma) for one in shape.rings]
    predicted = sigma_of_area(shape, spots)
    areas = []
    for _ in range(400):
        shift = rng.normal(0, 1.0, 2)
        moved = [np.array(r) + rng.normal(0, sigma, (len(r), 2)) + shift for r in shape.rings]
        areas.append(shape.with_rings(moved).area)
    assert np.std(areas) / predicted == pytest.approx(1.0, abs=0.12)


def as_places(ring: np.ndarray) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in ring)


def spots_of(ring: np.ndarray, sigma: float) -> OnPlane:
    count = len(ring)
    return OnPlane(
        points=np.column_stack([ring[:, 1], ring[:, 0], np.zeros(count)]),
        own=np.broadcast_to(sigma**2 * np.eye(2), (count, 2, 2)),
        shared=np.broadcast_to(np.eye(2), (count, 2, 2)),
    )
