"""Residuals averaged in the target's frame: what a board itself leaves, whatever looks at it.

Noise differs from view to view, and an error of lens or port stays in the picture while the board
moves through it. What returns at the same place of the board in view after view is the board's own:
bent, stretched by the printer, a corner out of its place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import norm

from alice_survey.core.frames import Array
from camera_calib.calibration import Calibration
from camera_calib.target_shape import usual_shape

Cause = Literal["shape", "corners", "uneven"]

_MIN_VIEWS = 4
_FEW = 0.05
"""Share of a target's corners that are `a few`."""
_BY_CHANCE = 1e-3
_MAX_OF = 0.5
"""Share of what returns that makes a cause the likely one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetFrame:
    """What returns in the target's frame."""

    offsets_m: Array
    """(N, 3) places of the corners as residuals show them, minus those of the calibration; the part
    along rays is hardly known. NaN for a corner that was not seen."""
    returning_px: float
    """Root mean square length of what returns, a residual of every view; 0 if nothing does."""
    p_value: float
    """Probability of as much by chance, if views are independent of each other."""
    in_plane_m: float
    """Root mean square offset in the target's plane, beyond what noise gives."""
    cause: Cause
    """Most likely, if something returns: bends and stretch that were not adjusted, a few corners,
    or neither."""

    @property
    def returns(self) -> bool:
        """Whether this is more than chance."""
        return self.p_value < _BY_CHANCE


def target_frame(calibration: Calibration) -> TargetFrame | None:
    """Average the residuals of all pictures at every place of the target.

    With D the slopes of a corner's pixels by its place and r their residuals, over their sigmas,
    view v pulls at place n by g_nv = D^T r. Products of the pulls of two views with errors of their
    own are 0 on average, and their scatter is known from the products themselves, as any view's
    errors might have had the other sign.

    Returns:
        None with fewer than four views, or without the noise of the corners.
    """
    if len(calibration.views) < _MIN_VIEWS or calibration.spread is None:
        return None
    count = calibration.target_points.size
    information = calibration.spread.of_places.reshape(count, count)
    pulls, weight, points = _pulls(calibration)
    known = np.linalg.matrix_rank(weight, hermitian=True) == 3
    inverse = np.zeros_like(weight)
    inverse[known] = np.linalg.inv(weight[known])
    moved = np.einsum("nij,vnj->vni", inverse, pulls)
    products = np.einsum("vni,wni->vw", pulls, moved)
    own = float(np.trace(products))
    apart = products - np.diag(np.diag(products))
    scatter = float(np.sqrt(2.0 * (apart**2).sum()))
    excess = float(apart.sum())
    offsets = -moved.sum(axis=0)
    # Every view's own pull, squared, is what noise adds to the square of their sum.
    by_noise = (moved[..., :2] ** 2).sum(axis=0)
    plane = (offsets[:, :2] ** 2 - by_noise)[known]
    sigma_px = float(np.sqrt(np.mean(calibration.sigma_px**2)))

    def left(modes: Array) -> float:
        """Excess after offsets along modes (K, N, 3) and all unknowns were adjusted."""
        rows = modes.reshape(-1, count) @ information
        pull = pulls.sum(axis=0).ravel()
        table, pulled = rows @ modes.reshape(-1, count).T, modes.reshape(-1, count) @ pull
        values = np.linalg.lstsq(table, pulled, rcond=1e-10)[0]
        rest = (pull - values @ rows).reshape(-1, 3)
        return float(np.einsum("ni,nij,nj->", rest, inverse, rest)) - own

    squares = np.einsum("ni,nij,nj->n", offsets, weight, offsets)
    return TargetFrame(
        offsets_m=np.where(known[:, None], offsets, np.nan),
        returning_px=sigma_px * float(np.sqrt(max(excess, 0.0) / points)),
        p_value=float(norm.sf(excess / scatter)) if scatter > 0.0 else 1.0,
        in_plane_m=float(np.sqrt(max(plane.sum(axis=1).mean(), 0.0))) if known.any() else 0.0,
        cause=_cause(calibration.drawn_points, squares, excess, left),
    )


def _pulls(calibration: Calibration) -> tuple[Array, Array, int]:
    """(V, N, 3) pulls of the views, (N, 3, 3) their weight, and the number of points."""
    rig, target = calibration.rig, calibration.target_points
    pulls = np.zeros((len(calibration.views), *target.shape))
    weight, count = np.zeros((len(target), 3, 3)), 0
    weights = np.nan_to_num(calibration.weights)
    for c, (name, camera) in enumerate(rig.cameras.items()):
        for v in range(len(calibration.views)):
            residuals = calibration.residuals_px[v, c]
            seen = np.isfinite(residuals).all(axis=1)
            if not seen.any():
                continue
            pose = rig.cam_from_rig[name] * calibration.rig_from_target[v]
            _, by_point, _ = camera.project_jacobian(pose.apply(target[seen]))
            slopes = by_point @ pose.rotation.as_matrix() / calibration.sigma_px[v, c]
            missed = residuals[seen] * weights[v, c, seen, None] / calibration.sigma_px[v, c]
            pulls[v, seen] += np.einsum("nai,na->ni", slopes, missed)
            weight[seen] += np.einsum("nai,naj->nij", slopes, slopes)
            count += int(seen.sum())
    return pulls, weight, count


def _cause(drawn: Array, squares: Array, excess: float, left: Callable[[Array], float]) -> Cause:
    """What takes most of the excess away."""
    count = len(drawn)
    few = np.argsort(squares)[-max(round(_FEW * count), 1) :]
    axes = np.zeros((len(few), 3, count, 3))
    axes[np.arange(len(few))[:, None], np.arange(3), few[:, None], np.arange(3)] = 1.0
    modes: dict[Cause, Array] = {"corners": axes.reshape(-1, count, 3)}
    shape = usual_shape(drawn)
    if shape.parameters:
        modes["shape"] = shape.modes
    rest = {cause: left(some) for cause, some in modes.items()}
    cause = min(rest, key=lambda name: rest[name])
    return cause if rest[cause] < _MAX_OF * excess else "uneven"
