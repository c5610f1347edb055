"""A pick found again in all other pictures, with sigmas that their agreement confirms.

What one patch shows of its own precision is too little: grain that is finer than the pixels and a
surface that is not a plane leave errors that its residuals do not show. The matches of one pick
must meet in one point; how far they are off, over what they state, is the factor by which all are
worse.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruct.picking.matching import Grey, Match, Matcher, NoMatch
from reconstruct.picking.surface import SurfacePlace
from reconstruct.placing.control_points import (
    Pick,
    RegisteredPicture,
    TriangulatedPoint,
    own_sigmas,
    residuals,
    triangulate_picks,
)

_USUAL_FACTOR, _USUAL_WEIGHT = 2.0, 4.0
"""Sigmas of least-squares matching are known to be about half of the errors (Gruen 1985; Baltsavias
1991); it counts as so many readings next to those of the matches themselves."""
_WRONG_SIGMAS = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A pick and where it was found again."""

    picks: tuple[Pick, ...]
    """The pick itself first."""
    matches: tuple[Match, ...]
    """One for each of the other picks, with the sigma that these state."""
    refused: tuple[NoMatch, ...]
    spot: TriangulatedPoint | None
    """The point that they have in common."""
    factor: float
    """By which sigmas were enlarged."""


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
    mark = np.array([pick.x_px, pick.y_px])
    matcher = Matcher(grey(pick.image), picture(pick.image), mark, place)
    found: dict[str, Match] = {}
    refused: list[NoMatch] = []
    for image in images:
        if image == pick.image:
            continue
        got = matcher.find(image, grey(image), picture(image))
        if isinstance(got, Match):
            found[image] = got
        else:
            refused.append(got)
    cameras = {image: picture(image) for image in (pick.image, *found)}
    while True:
        picks = [pick, *(_pick_of(match, pick) for match in found.values())]
        spot = triangulate_picks(picks, cameras)[0].get(pick.point) if found else None
        if spot is None:
            break
        factor = _factor(spot, picks, cameras)
        worst, off = _worst(spot, picks, cameras, factor)
        if len(found) < 3 or off <= _WRONG_SIGMAS:
            break
        del found[worst]
        refused.append(
            NoMatch(image=worst, why=f"{off:.0f} sigmas off the point that the others show")
        )
    if spot is None:
        refused += [
            NoMatch(image=image, why="it does not meet the pick in one point") for image in found
        ]
        return Refined(
            picks=(pick,), matches=(), refused=tuple(refused), spot=None, factor=_USUAL_FACTOR
        )
    matches = [replace(m, sigma_px=factor * m.sigma_px) for m in found.values()]
    picks = [pick, *(_pick_of(match, pick) for match in matches)]
    return Refined(
        picks=tuple(picks), matches=tuple(matches), refused=tuple(refused), factor=factor,
        spot=triangulate_picks(picks, cameras)[0].get(pick.point),
    )  # fmt: skip


def _pick_of(match: Match, pick: Pick) -> Pick:
    x, y = match.pixel.tolist()
    return replace(
        pick, image=match.image, x_px=x, y_px=y, sigma_px=match.sigma_px, matched_to=pick.image
    )


def _factor(
    spot: TriangulatedPoint, picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> float:
    """By which matches are worse than they state, at least 1."""
    off = residuals(spot.model, picks, cameras) / own_sigmas(picks)[:, None]
    spare = 2 * len(picks) - 3
    total = float((np.minimum(np.abs(off), 2 * _WRONG_SIGMAS) ** 2).sum())
    mean = (total + _USUAL_WEIGHT * _USUAL_FACTOR**2) / (spare + _USUAL_WEIGHT)
    return float(np.sqrt(max(1.0, mean)))


def _worst(
    spot: TriangulatedPoint,
    picks: Sequence[Pick],
    cameras: Mapping[str, RegisteredPicture],
    factor: float,
) -> tuple[str, float]:
    """The match that is farthest off the common point, and by how many of its sigmas."""
    off = np.linalg.norm(residuals(spot.model, picks, cameras), axis=1) / own_sigmas(picks) / factor
    worst = 1 + int(np.argmax(off[1:]))
    return picks[worst].image, float(off[worst])
