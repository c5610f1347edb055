"""Spots from picks that were matched to one another: their errors are as stated."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.rig import design_rig
from reconstruct.placing.control_points import Pick, RegisteredPicture, triangulate_picks

NADIR = Rotation.from_euler("z", 90, degrees=True)


def cameras(count: int) -> dict[str, RegisteredPicture]:
    """Pictures in a line, 2 m above the origin, 0.25 m apart."""
    camera = design_rig(CameraConfig(), WaterConfig(), scale=6).cameras["left"]
    warp = best_warp(camera, 1.5, 2.5)
    return {
        f"{n}.png": RegisteredPicture(
            warp=warp,
            model_from_pinhole=RigidTransform.from_components(
                [0.25 * (n - (count - 1) / 2), 0.1 * (n % 2), -2.0], NADIR
            ),
        )
        for n in range(count)
    }


def drawn(
    views: dict[str, RegisteredPicture], mark: float, match: float, rng: np.random.Generator
) -> list[Pick]:
    """A mark by eye in the first picture, and matches to it in the others.

    The match of a patch errs by the noise of the patch, which all share, and by that of the other
    picture; what is matched lies on a level floor.
    """
    first, *others = views
    place = np.zeros(3)
    marked = views[first].project(place) + rng.normal(0, mark, 2)
    patch = marked + rng.normal(0, match / np.sqrt(2), 2)
    start, way = views[first].ray(patch)
    meant = start - way * start[2] / way[2]

    def at(image: str, pixel: Array, sigma: float, to: str) -> Pick:
        return Pick(image=image, point="p", x_px=float(pixel[0]), y_px=float(pixel[1]),
                    sigma_px=sigma, matched_to=to)  # fmt: skip

    return [
        at(first, marked, mark, ""),
        *(
            at(o, views[o].project(meant) + rng.normal(0, match / np.sqrt(2), 2), match, first)
            for o in others
        ),
    ]


@pytest.mark.parametrize(("mark", "match"), [(0.5, 0.05), (0.05, 0.05), (0.02, 0.1)])
def test_errors_of_matched_spots_are_as_stated(mark: float, match: float) -> None:
    rng, views = np.random.default_rng(3), cameras(6)
    chi = []
    for _ in range(60):
        spot = triangulate_picks(drawn(views, mark, match, rng), views)[0]["p"]
        chi.append(spot.model @ np.linalg.solve(spot.covariance, spot.model))
    # three degrees of freedom; chi above 1 only widens
    assert 0.7**2 < np.mean(chi) / 3 < 1.3**2
