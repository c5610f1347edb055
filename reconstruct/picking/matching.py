"""A spot picked in one picture, found in others by least-squares matching.

The neighbourhood of the pick is seen as a piece of the plane that touches the surface there, and
that plane says where each of its pixels is in another picture, through both exact lenses. From the
best place of a search about that, shift, shear and stretch of the warp and brightness and contrast
are fitted to the other picture (Gruen 1985, "Adaptive least squares correlation"); the scatter of
what remains determines how well (White 1980; Newey & West 1987, for noise that neighbours share).

What one patch shows of its own precision is too little: grain that is finer than the pixels and a
surface that is not a plane leave errors that its residuals do not show. The matches of one pick
must meet in one point; how far they are off, over what they state, is the factor by which all are
worse.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from alice_survey.core.frames import Array
from reconstruct.picking.surface import SurfacePlace
from reconstruct.placing.control_points import (
    Pick,
    RegisteredPicture,
    TriangulatedPoint,
    own_sigmas,
    residuals,
    triangulate_picks,
)

Grey = NDArray[np.uint8]
HALF_PX = 7
"""A patch has this many pixels to either side of the pick."""
_WEIGHT_PX = 0.5 * HALF_PX
"""Sigma of the Gaussian weight of its pixels."""
_SPLINE = 5
_SPARE_PX = 12
"""Pixels around a part of a picture that its spline needs to be that of the whole."""
_MIN_REACH_PX, _MAX_REACH_PX = 4, 24
"""A search goes at least and at most this far from where the surface says."""
_REACH_SIGMAS = 4.0
_POSE_SIGMA_PX = 0.5
"""By what poses may move a place besides the surface."""
_ROUNDS = 20
_SETTLED_PX = 1e-4
_MIN_CORRELATION = 0.6
_RIVAL = 0.85
"""A second place whose correlation is more than this share of the best's: they look the same."""
_RIVAL_PX = 4
"""Places at least this far apart are two."""
_MAX_SIGMA_PX = 0.25
_MAX_DRIFT_PX = 1.5
"""The fit must end this close to where the search found the best place."""
_MAX_STRETCH = 0.3
_LAG_PX = 1
"""Residuals farther apart are independent."""


@dataclass(frozen=True, kw_only=True)
class NoMatch:
    """Why a spot is not found in a picture."""

    image: str
    why: str


class Matcher:
    """Finds one pick again."""

    def __init__(
        self, grey: Grey, picture: RegisteredPicture, pick: Pick, place: SurfacePlace
    ) -> None:
        """Take a pick.

        Args:
            grey: (H, W) the picture as taken.
            picture: its camera and pose.
            pick: in it.
            place: of the surface, where the pick's ray meets it.
        """
        self._pick, self._place = pick, place
        pixel = np.array([pick.x_px, pick.y_px])
        reach = np.arange(-HALF_PX, HALF_PX + 1.0)
        grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
        self._weight = np.exp(-0.5 * (grid**2).sum(axis=1) / _WEIGHT_PX**2)
        self._grid = grid
        starts, ways = picture.ray(pixel + grid)
        away = ((place.point - starts) @ place.normal) / (ways @ place.normal)
        self._points = starts + away[:, None] * ways
        self._own = _PicturePart.around(grey, pixel, HALF_PX + 1)
        self._shown = self._own.at(pixel + grid)[0]

    def find(self, image: str, grey: Grey, picture: RegisteredPicture) -> Pick | str:
        """Find the pick in another picture, with a sigma relative to the pick; else say why not.

        Args:
            image: its name.
            grey: (H, W) as taken.
            picture: its camera and pose.
        """
        if not np.isfinite(self._shown).all():
            return "the pick is too close to the edge of its picture"
        expected = picture.project(self._points)
        middle = picture.project(self._place.point)
        if not np.isfinite(expected).all():
            return "the picture does not see the spot"
        raised = picture.project(self._place.point - [0.0, 0.0, self._place.sigma])
        spread = float(np.hypot(np.linalg.norm(raised - middle), _POSE_SIGMA_PX))
        reach = int(np.clip(np.ceil(_REACH_SIGMAS * spread), _MIN_REACH_PX, _MAX_REACH_PX))
        extent = int(np.ceil(np.abs(expected - middle).max())) + reach + 2
        part = _PicturePart.around(grey, middle, extent)
        shift, likeness, rival = self._search(part, expected, reach)
        if likeness < _MIN_CORRELATION:
            return (
                f"nothing there looks like the pick (correlation {max(likeness, 0.0):.2f}): "
                "hidden, in other light, outside, or without texture"
            )
        if rival > _RIVAL * likeness:
            return "several places there look like the pick"
        fit = _fit(part, expected + shift, self._grid, self._shown, self._weight)
        if fit is None or np.linalg.norm(fit[0]) > _MAX_DRIFT_PX or fit[2] < _MIN_CORRELATION:
            return "the match does not settle"
        move, sigma, _ = fit
        if sigma > _MAX_SIGMA_PX:
            return f"too little texture: it would be known to {sigma:.1f} px only"
        x, y = (middle + shift + move).tolist()
        return replace(
            self._pick, image=image, x_px=x, y_px=y, sigma_px=sigma, matched_to=self._pick.image
        )

    def _search(
        self, part: "_PicturePart", expected: Array, reach: int
    ) -> tuple[Array, float, float]:
        """Best whole-pixel shift (2,), its correlation, and the best one of places apart."""
        steps = np.arange(-reach, reach + 1.0)
        shifts = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        seen = part.at((expected[None] + shifts[:, None]).reshape(-1, 2), order=1)[0]
        likeness = _correlations(self._shown, seen.reshape(len(shifts), -1), self._weight)
        likeness = np.where(np.isfinite(likeness), likeness, -1.0)
        best = int(np.argmax(likeness))
        square = likeness.reshape(len(steps), len(steps))
        peaks = (square >= ndimage.maximum_filter(square, 3)).ravel()
        apart = np.linalg.norm(shifts - shifts[best], axis=1) >= _RIVAL_PX
        others = likeness[peaks & apart]
        return shifts[best], float(likeness[best]), float(others.max(initial=-1.0))


class _PicturePart:
    """A part of a picture as a quintic spline, with its slopes."""

    def __init__(self, grey: Grey, left: int, top: int) -> None:
        self._corner = np.array([left, top], dtype=np.float64)
        self._size = np.array(grey.shape[::-1])
        pixels = grey.astype(np.float64)
        self._plain = pixels
        find: Any = ndimage
        self._spline = (
            find.spline_filter(pixels, order=_SPLINE, mode="mirror") if pixels.size else pixels
        )

    @classmethod
    def around(cls, grey: Grey, pixel: Array, extent: int) -> "_PicturePart":
        """Pixels up to an extent around a pixel."""
        reach, size = extent + _SPARE_PX, np.array(grey.shape[::-1])
        low = np.clip(np.floor(pixel).astype(int) - reach, 0, size)
        high = np.clip(np.floor(pixel).astype(int) + reach + 1, 0, size)
        return cls(grey[low[1] : high[1], low[0] : high[0]], int(low[0]), int(low[1]))

    def at(self, pixels: Array, order: int = _SPLINE, step: float = 0.0) -> Array:
        """Grey levels (1, N) at pixels (N, 2), and with a step slopes by x and y below, (3, N)."""
        place = pixels - self._corner
        inside = ((place >= 0.5) & (place <= self._size - 0.5)).all(axis=1)
        found = np.full((3 if step else 1, len(pixels)), np.nan)
        source = self._plain if order == 1 else self._spline
        at = place[inside, ::-1].T - 0.5

        find: Any = ndimage

        def read(where: Array) -> Array:
            values: Array = find.map_coordinates(
                source, where, order=order, mode="mirror", prefilter=False
            )
            return values

        if not inside.any():
            return found
        found[0, inside] = read(at)
        for row, axis in ((1, 1), (2, 0)) if step else ():
            ahead = np.zeros((2, 1))
            ahead[axis] = step
            found[row, inside] = (read(at + ahead) - read(at - ahead)) / (2 * step)
        return found


def _correlations(first: Array, others: Array, weight: Array) -> Array:
    """(N,) weighted correlations of a patch (P,) with others (N, P)."""
    total = weight.sum()
    a = first - first @ weight / total
    b = others - (others @ weight / total)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        found: Array = (b @ (weight * a)) / np.sqrt((a * a) @ weight * ((b * b) @ weight))
    return found


def _fit(
    part: _PicturePart, start: Array, grid: Array, shown: Array, weight: Array
) -> tuple[Array, float, float] | None:
    """Shift (2,) from a start (P, 2), its sigma and the correlation there; None without an end."""
    change = np.zeros(6)  # shift, then what the grid's x and y add to it
    design = np.concatenate(
        [np.tile(np.eye(2), (len(grid), 1, 1)), grid[:, :1, None] * np.eye(2),
         grid[:, 1:, None] * np.eye(2)], axis=2
    )  # fmt: skip
    for _ in range(_ROUNDS):
        seen = part.at(start + design @ change, step=0.05)
        if not np.isfinite(seen).all():
            return None
        slopes = np.einsum("ip,pik->pk", seen[1:], design)
        gain, level = np.linalg.lstsq(
            np.sqrt(weight)[:, None] * np.column_stack([seen[0], np.ones(len(grid))]),
            np.sqrt(weight) * shown, rcond=None,
        )[0]  # fmt: skip
        if not gain > 0:
            return None
        rest = shown - gain * seen[0] - level
        columns = np.column_stack([gain * slopes, seen[0], np.ones(len(grid))])
        matrix = columns.T @ (weight[:, None] * columns)
        try:
            inverse = np.linalg.inv(matrix)
        except np.linalg.LinAlgError:
            return None
        step = inverse @ (columns.T @ (weight * rest))
        change = change + step[:6]
        if np.abs(change[2:]).max() > _MAX_STRETCH or np.linalg.norm(change[:2]) > 2 * HALF_PX:
            return None
        if np.linalg.norm(step[:2]) < _SETTLED_PX:
            return (
                change[:2],
                _sigma(columns, weight, rest, inverse),
                float(_correlations(shown, seen[:1], weight)[0]),
            )
    return None


def _sigma(columns: Array, weight: Array, rest: Array, inverse: Array) -> float:
    """Sigma of a coordinate of the shift, from residuals that neighbours share."""
    side = 2 * HALF_PX + 1
    terms = ((weight * rest)[:, None] * columns[:, :]).T.reshape(-1, side, side)
    fall = 1.0 - np.abs(np.arange(-_LAG_PX, _LAG_PX + 1)) / (_LAG_PX + 1)
    near = ndimage.convolve1d(terms, fall, axis=1, mode="constant")
    flat = ndimage.convolve1d(near, fall, axis=2, mode="constant").reshape(len(terms), -1)
    middle = terms.reshape(len(terms), -1) @ flat.T
    count = weight.sum() ** 2 / (weight**2).sum()
    covariance = inverse @ (0.5 * (middle + middle.T)) @ inverse * count / (count - len(terms))
    return float(np.sqrt(max(np.trace(covariance[:2, :2]) / 2, 0.0)))


_USUAL_FACTOR, _USUAL_WEIGHT = 2.0, 4.0
"""Sigmas of least-squares matching are known to be about half of the errors (Gruen 1985; Baltsavias
1991); it counts as so many readings next to those of the matches themselves."""
_WRONG_SIGMAS = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A pick and where it was found again."""

    picks: tuple[Pick, ...]
    """The pick itself first."""
    refused: tuple[NoMatch, ...]
    meeting: TriangulatedPoint | None
    """The point that they have in common."""


def refine(
    pick: Pick,
    images: Sequence[str],
    place: SurfacePlace,
    picture: Callable[[str], RegisteredPicture],
    grey: Callable[[str], Grey],
) -> Refined:
    """Find a pick in other pictures.

    Args:
        pick: by eye.
        images: to look in.
        place: of the surface, where its ray meets it.
        picture: camera and pose by name.
        grey: pixels as taken by name.
    """
    matcher = Matcher(grey(pick.image), picture(pick.image), pick, place)
    found: dict[str, Pick] = {}
    refused: list[NoMatch] = []
    for image in images:
        if image == pick.image:
            continue
        got = matcher.find(image, grey(image), picture(image))
        if isinstance(got, str):
            refused.append(NoMatch(image=image, why=got))
        else:
            found[image] = got
    cameras = {image: picture(image) for image in (pick.image, *found)}
    while True:
        picks = [pick, *found.values()]
        meeting = triangulate_picks(picks, cameras)[0].get(pick.point) if found else None
        if meeting is None:
            break
        away = residuals(meeting.model, picks, cameras) / own_sigmas(picks)[:, None]
        factor = _factor(away)
        off = np.linalg.norm(away[1:], axis=1) / factor
        if len(found) < 3 or off.max() <= _WRONG_SIGMAS:
            break
        worst = picks[1 + int(np.argmax(off))].image
        del found[worst]
        refused.append(
            NoMatch(image=worst, why=f"{off.max():.0f} sigmas off the point that the others show")
        )
    if meeting is None:
        refused += [
            NoMatch(image=image, why="it does not meet the pick in one point") for image in found
        ]
        return Refined(picks=(pick,), refused=tuple(refused), meeting=None)
    picks = [pick, *(replace(one, sigma_px=factor * one.sigma_px) for one in picks[1:])]
    meeting = triangulate_picks(picks, cameras)[0].get(pick.point)
    return Refined(picks=tuple(picks), refused=tuple(refused), meeting=meeting)


def _factor(off: Array) -> float:
    """By which matches are worse than they state, at least 1, by residuals (N, 2) over sigmas."""
    total = float((np.minimum(np.abs(off), 2 * _WRONG_SIGMAS) ** 2).sum())
    mean = (total + _USUAL_WEIGHT * _USUAL_FACTOR**2) / (off.size - 3 + _USUAL_WEIGHT)
    return float(np.sqrt(max(1.0, mean)))
