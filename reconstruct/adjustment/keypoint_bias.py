"""Keypoints are not corners: what a calibration leaves open of where a lens puts them.

A detector of features finds texture whose blur, light and scale change from the middle of a picture
to its edge a little farther in or out than a calibration saw the corners of its target, and does so
in all pictures alike, so that the number of keypoints does not lessen it. A survey therefore knows
the radial part of its lenses no better than that, however well a calibration determined it. Ports
and poses, whose effect depends on the distance, are known as well as stated; with lenses held to
their own small sigmas, the bias would pull at those instead.
"""

from collections.abc import Sequence

import numpy as np

from alice_survey.core.frames import Array
from camera_calib.rig import Rig

BIAS_PX = 0.01
"""Sigma of the bias, root mean square over a picture: in rendered surveys it is 0.005 to 0.007."""
_RADIAL = frozenset({"fx_px", "fy_px", *(f"k{i}" for i in range(1, 7))})
_GRID = 24
"""Places along a side of the picture at which a lens is sampled."""


def bias_covariance(rig: Rig, names: Sequence[str], sigma_px: float = BIAS_PX) -> Array:
    """Changes of a rig that are worth a radial bias of keypoints, as a covariance (K, K).

    Changes of a lens are as likely as the pixels that they move are near: with J the slopes of the
    pixels by the lens's L radial parameters, it is `sigma^2 / L` times the inverse of the mean of
    J^T J, which makes `sigma^2` the expected mean square shift over the picture.

    Args:
        rig: cameras.
        names: parameters of the rig; those that are not radial ones of a lens have no bias.
        sigma_px: of the bias.
    """
    found = np.zeros((len(names), len(names)))
    for owner, camera in rig.cameras.items():
        at = {field: names.index(f"{owner}.{field}") for field in camera.lens.parameters
              if field in _RADIAL and f"{owner}.{field}" in names}  # fmt: skip
        if not at:
            continue
        axes = [(np.arange(_GRID) + 0.5) / _GRID * n for n in (camera.width_px, camera.height_px)]
        starts, rays = camera.unproject(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
        lit = np.isfinite(rays).all(axis=1)
        by_all = camera.project_jacobian(starts[lit] + rays[lit])[2]
        slopes = by_all[..., [camera.parameters.index(field) for field in at]].reshape(-1, len(at))
        size = np.linalg.norm(slopes, axis=0)
        inverse = np.linalg.inv((slopes / size).T @ (slopes / size)) / np.outer(size, size)
        found[np.ix_([*at.values()], [*at.values()])] = sigma_px**2 / len(at) * lit.sum() * inverse
    return found
