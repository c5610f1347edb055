import numpy as np
import pycolmap
import pytest
from scipy.optimize import minimize

from reconstruct.mapping.arrays import observations
from reconstruct.mapping.bundle import move_points
from tests.reconstruct.scenes import make_scene
from tests.reconstruct.true_models import started


@pytest.mark.parametrize("robust_px", [None, 0.5])
def test_points_move_to_the_minimum_of_their_own_errors(robust_px: float | None) -> None:
    """Against a general minimiser, with one keypoint in fifty far off."""
    scene = make_scene(lines=2, stations=6, points=400, noise_px=0.3)
    model, rng = started(scene, 3, (1e-3, 0.0))[0].model, np.random.default_rng(7)
    for image in model.images.values():
        for keypoint in image.points2D:
            if rng.random() < 0.02:
                keypoint.xy = keypoint.xy + rng.normal(0, 20.0, 2)
    for point in model.points3D.values():
        point.xyz = point.xyz + rng.normal(0, 0.03, 3)
    before = pycolmap.Reconstruction(model)

    move_points(model, robust_px)

    seen = observations(before)
    for k in range(0, len(seen.point_ids), 23):
        rows = np.flatnonzero(seen.point == k)
        images = [before.images[int(seen.pictures[seen.starts[1:].searchsorted(r, "right")])]
                  for r in rows]  # fmt: skip

        def cost(xyz: np.ndarray, rows=rows, images=images) -> float:
            squares = np.array([
                ((image.project_point(xyz) - seen.pixels[r]) ** 2).sum()
                for image, r in zip(images, rows, strict=True)
            ])  # fmt: skip
            if robust_px is not None:
                squares = robust_px**2 * np.log1p(squares / robust_px**2)
            return float(squares.sum())

        number = int(seen.point_ids[k])
        found = model.points3D[number].xyz
        best = minimize(cost, found, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9})
        assert cost(found) < cost(before.points3D[number].xyz)
        assert cost(found) <= best.fun * (1 + 1e-6) + 1e-9
        assert found == pytest.approx(best.x, abs=2e-5)
