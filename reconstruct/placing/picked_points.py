"""Points picked in pictures, found in space through the exact lenses of their cameras.

Picks that were matched to another one err together with it: what a person meant is as far from the
mark in the first picture as the hand was unsteady, and all that was found again is off the same
way. The noise of the matches alone says how well they agree; the covariance of the point holds
both (see `covariance_of_picks`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import warn
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.triangulate import nearest_to_rays
from reconstruct.placing.control_file import PICK_SIGMA_PX, Pick

_ROBUST_PX = 1.0
_WRONG_SIGMAS = 5.0
_WRONG_PX = 2.0
"""A pick further off than both is left out where three or more remain."""
_TRIED = 6
_COARSE = 3.0
"""How many of their sigmas picks of most points must be off to count as coarser than stated."""
_MIN_POINTS = 3
"""Points that say how coarse picks are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredPicture:
    """A registered picture: its camera, and where its pinhole stands in the model."""

    warp: PinholeWarp
    model_from_pinhole: RigidTransform

    def project(self, point: Array) -> Array:
        """Pixels (..., 2) of the picture as taken that show points (..., 3) of the model."""
        turn, place = self._stands
        return self.warp.camera.project((point - place) @ turn)

    def ray(self, pixel: Array) -> tuple[Array, Array]:
        """Starts and unit directions, (..., 3), in the model, of pixels (..., 2) as taken."""
        start, way = self.warp.camera.unproject(pixel)
        turn, place = self._stands
        return start @ turn.T + place, way @ turn.T

    @cached_property
    def _stands(self) -> tuple[Array, Array]:
        """Rotation (3, 3) `model_from_cam`, and where the entrance pupil is, (3,)."""
        pose = self.model_from_cam
        return pose.rotation.as_matrix(), np.asarray(pose.translation)

    @property
    def model_from_cam(self) -> RigidTransform:
        """The camera's own frame, whose origin is the entrance pupil, in the model."""
        return self.model_from_pinhole * self.warp.pinhole_from_cam


@dataclass(frozen=True, kw_only=True, eq=False)
class Spot:
    """A point found from picks."""

    name: str
    model: Array
    """(3,) place in the model."""
    covariance: Array
    """(3, 3) covariance by the picks; larger where they disagree."""
    views: int
    left_out: tuple[str, ...]
    """Pictures whose picks are off the common point."""
    rms_px: float


def find_spots(
    picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> tuple[dict[str, Spot], dict[str, str]]:
    """Find every picked point that two or more registered pictures show.

    Returns:
        Spots by name, with the middles of markers whose four corners were found; and why other
        points were not found, by name.
    """
    by_name: dict[str, list[Pick]] = {}
    for pick in picks:
        if pick.image in cameras:
            by_name.setdefault(pick.point, []).append(pick)
    by_name = _with_real_sigmas(by_name, cameras)
    found, lost = {}, {}
    for name in sorted({pick.point for pick in picks}):
        seen = by_name.get(name, [])
        if len({p.image for p in seen}) < 2:
            lost[name] = f"picked in {len(seen)} pictures of the model; two or more are needed"
            continue
        spot = _triangulate(name, seen, cameras)
        if isinstance(spot, str):
            lost[name] = spot
        else:
            found[name] = spot
    for name in sorted({n.rsplit(".", 1)[0] for n in found if "." in n} - set(found)):
        corners = [found.get(f"{name}.{k}") for k in range(4)]
        whole = [c for c in corners if c is not None]
        if len(whole) == 4:
            found[name] = Spot(
                name=name,
                model=np.mean([c.model for c in whole], axis=0),
                covariance=np.sum([c.covariance for c in whole], axis=0) / 16.0,
                views=min(c.views for c in whole),
                left_out=(),
                rms_px=float(np.sqrt(np.mean([c.rms_px**2 for c in whole]))),
            )
    return found, lost


def _with_real_sigmas(
    by_name: Mapping[str, list[Pick]], cameras: Mapping[str, RegisteredPicture]
) -> dict[str, list[Pick]]:
    """Picks whose sigmas are what those of most points miss by, where that is far more."""
    sizes = []
    for some in by_name.values():
        start = _nearest(some, cameras) if len({p.image for p in some}) > 1 else ""
        if isinstance(start, str):
            continue
        off = _fit(start, some, cameras)[0] / np.array([[p.sigma_px] for p in some])
        if np.isfinite(off).all():
            sizes.append(float(np.sqrt(np.sum(off**2) / (2 * len(some) - 3))))
    factor = float(np.median(sizes)) if len(sizes) >= _MIN_POINTS else 1.0
    if factor <= _COARSE:
        return dict(by_name)
    usual = float(np.median([p.sigma_px for some in by_name.values() for p in some]))
    warn(
        f"picks of most of {len(sizes)} points are {factor:.2g} times as far off as their sigma of "
        f"{usual:.2g} px: they count with a sigma of {factor * usual:.2g} px"
    )
    return {
        name: [replace(p, sigma_px=factor * p.sigma_px) for p in some]
        for name, some in by_name.items()
    }


def _triangulate(
    name: str, picks: list[Pick], cameras: Mapping[str, RegisteredPicture]
) -> Spot | str:
    """The point that fits the picks best, or why there is none."""
    start = _nearest(picks, cameras)
    if isinstance(start, str):
        return start
    kept = list(picks)
    while True:
        off, point, jacobian = _fit(start, kept, cameras)
        if not np.isfinite(off).all():
            return "a picture that it was picked in cannot see it"
        worst = _worst(off, kept)
        if worst <= 1.0:
            break
        if len(kept) < 4:
            miss_px = float(np.linalg.norm(off, axis=1).max())
            return f"its picks are {miss_px:.1f} px off one common point"
        kept = _without_one(point, kept, off, cameras)
    miss_px = np.linalg.norm(off, axis=1)
    sigma = np.repeat(own_sigmas(kept), 2)
    chi = float(((off.ravel() / sigma) ** 2).sum()) / (2 * len(kept) - 3)
    gain = gain_of(jacobian, sigma)
    covariance = gain @ covariance_of_picks(kept, jacobian, max(1.0, chi)) @ gain.T
    names = {p.image for p in kept}
    return Spot(
        name=name,
        model=point,
        covariance=covariance,
        views=len(kept),
        left_out=tuple(p.image for p in picks if p.image not in names),
        rms_px=float(np.sqrt((miss_px**2).mean())),
    )


def own_sigmas(picks: Sequence[Pick]) -> Array:
    """(N,) noise of one coordinate of each pick apart from what picks share, px.

    A match errs by the noise of both pictures, which is half its variance in either: with the first
    picture's half the pick that others were matched to takes part.
    """
    of: dict[str, list[float]] = {}
    for pick in picks:
        if pick.matched_to:
            of.setdefault(pick.matched_to, []).append(pick.sigma_px / np.sqrt(2.0))
    return np.array(
        [
            pick.sigma_px / np.sqrt(2.0) if pick.matched_to
            else float(np.median(of[pick.image])) if pick.image in of
            else pick.sigma_px
            for pick in picks
        ]
    )  # fmt: skip


def gain_of(jacobian: Array, sigma: Array) -> Array:
    """(3, 2 N) how the point moves with pixels of these sigmas (2 N,) and slopes (2 N, 3)."""
    weighted = jacobian / (sigma**2)[:, None]
    return np.asarray(np.linalg.solve(jacobian.T @ weighted, weighted.T), np.float64)


def covariance_of_picks(picks: Sequence[Pick], jacobian: Array, factor: float = 1.0) -> Array:
    """(2 N, 2 N) covariance of the pixels of picks of one point, as readings of what was meant.

    Matched picks follow the error of the mark in their first picture and the noise of the patch
    around it, along the surface, which is taken as square to the mean direction of the pictures.

    Args:
        picks: of the point.
        jacobian: (2 N, 3) slopes of their pixels by the point.
        factor: by which the variances of own noise are larger than stated.
    """
    own, slopes = own_sigmas(picks), jacobian.reshape(-1, 2, 3)
    found: Array = np.diag(np.repeat(factor * own**2, 2)).astype(np.float64)
    along = np.linalg.svd(jacobian)[2][:2].T
    in_plane = slopes @ along
    row = {pick.image: n for n, pick in enumerate(picks)}
    for image in sorted({pick.matched_to for pick in picks} - {""}):
        matched = [n for n, pick in enumerate(picks) if pick.matched_to == image]
        first = row.get(image, matched[0])
        marked = picks[first].sigma_px if image in row else PICK_SIGMA_PX
        follow = in_plane[matched] @ np.linalg.inv(in_plane[first])
        noise = factor * float(np.median(own[matched])) ** 2
        rows = [2 * n + k for n in matched for k in range(2)]
        together = follow.reshape(-1, 2) @ follow.reshape(-1, 2).T
        found[np.ix_(rows, rows)] += (marked**2 + noise) * together
        if image in row:
            at = [2 * first, 2 * first + 1]
            found[np.ix_(at, at)] = marked**2 * np.eye(2)
            found[np.ix_(rows, at)] = marked**2 * follow.reshape(-1, 2)
            found[np.ix_(at, rows)] = found[np.ix_(rows, at)].T
    return found


def residuals(
    point: Array, picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> Array:
    """(N, 2) pixels at which pictures see a point minus where it was picked."""
    return np.stack([cameras[p.image].project(point) - [p.x_px, p.y_px] for p in picks])


def _worst(off: Array, picks: Sequence[Pick]) -> float:
    """The largest miss, over what a right pick may miss by."""
    limit = np.array([max(_WRONG_PX, _WRONG_SIGMAS * p.sigma_px) for p in picks])
    return float((np.linalg.norm(off, axis=1) / limit).max())


def _without_one(
    point: Array, picks: list[Pick], off: Array, cameras: Mapping[str, RegisteredPicture]
) -> list[Pick]:
    """Leave out the pick without which the others agree best; among many, the worst.

    Among few, a wrong pick draws the point to itself and lets a right one look worse.
    """
    order = np.argsort(-np.linalg.norm(off, axis=1), kind="stable")[:_TRIED]
    choices = [[p for k, p in enumerate(picks) if k != out] for out in order]
    misses = [_worst(_fit(point, choice, cameras)[0], choice) for choice in choices]
    return choices[int(np.argmin(misses))]


def _nearest(picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]) -> Array | str:
    """The point nearest to all rays, (3,)."""
    rays = [cameras[p.image].ray(np.array([p.x_px, p.y_px])) for p in picks]
    starts, ways = np.stack([r[0] for r in rays]), np.stack([r[1] for r in rays])
    if not np.isfinite(starts + ways).all():
        return "a pick is beyond the reach of its lens"
    found: Array = nearest_to_rays(starts[:, None], ways[:, None])[0]
    return found if np.isfinite(found).all() else "the pictures see it from one direction only"


def _fit(
    start: Array, picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> tuple[Array, Array, Array]:
    """Misses (N, 2) px of the best point, the point (3,), and their derivatives (2 N, 3)."""
    picked = np.array([[p.x_px, p.y_px] for p in picks])
    own = own_sigmas(picks)
    usual = float(np.median(own))
    near_px = max(_ROBUST_PX, 2.0 * usual)
    weight = np.repeat(usual / own, 2)
    unit = float(np.linalg.norm(start - cameras[picks[0].image].model_from_pinhole.translation))

    def misses(x: Array) -> Array:
        point = start + unit * x
        seen = np.stack([cameras[p.image].project(point) for p in picks])
        return np.asarray(np.nan_to_num((seen - picked).ravel(), nan=1e6))

    def weighted(x: Array) -> Array:
        found: Array = weight * misses(x)
        return found

    found = least_squares(
        weighted, np.zeros(3), loss="soft_l1", f_scale=near_px, xtol=1e-12,
        ftol=1e-12, gtol=1e-12, jac="3-point",
    )  # fmt: skip
    jacobian = np.empty((2 * len(picks), 3))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        jacobian[:, axis] = (misses(found.x + step) - misses(found.x - step)) / (2e-6 * unit)
    off = misses(found.x).reshape(-1, 2)
    return np.where(np.abs(off) >= 1e6, np.nan, off), start + unit * found.x, jacobian
