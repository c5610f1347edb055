"""Lengths and areas between pixels that are picked in pictures, with their standard deviations.

A pixel of one picture is found again in the others that see it; the exact rays give the point. How
picks, poses and rig move the figures is in `reconstruct.picking.lengths`: two pictures of one
stereo station are a workspace like any other.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.measure.figures import polygon_area, polyline
from reconstruct.picking.lengths import Lengths, PickedFigure, PolylineFigure
from reconstruct.picking.matching import refine
from reconstruct.picking.registered import RegisteredPictures
from reconstruct.picking.surface import ModelSurface, SurfacePlace
from reconstruct.pictures.undistorted import read_colour
from reconstruct.placing.control_command import note_scale
from reconstruct.placing.control_points import PICK_SIGMA_PX, Pick

_NUMBER = r"(-?\d+(?:\.\d+)?)"
_PIXEL = re.compile(rf"(?P<image>[^=]+?):{_NUMBER},{_NUMBER}")
_MAX_LOOKED_IN = 16
"""Pictures in which a pick is looked for again, the best ones."""
_KEPT = 32
"""Pictures that are kept in memory."""
_EXACT_PX = 1e-3
"""Sigma of a pixel that is taken as it is, and least one of what the surface says."""


def measure(
    workspace: Path, points: str, *, pick_sigma_px: float = 0.0
) -> tuple[str, dict[str, Any]]:
    """Measure between picked pixels.

    Args:
        workspace: reconstructed.
        points: two or more, with blanks between: `IMAGE:x,y`, which is found again in other
            pictures, or `IMAGE:x,y=IMAGE:x,y` where two pictures show the point. Pixels count from
            0 at the centre of the first, as viewers show them.
        pick_sigma_px: standard deviation with which pixels were picked; where two pictures were
            picked in by hand, 0 stands for the usual one.

    Returns:
        Text for the terminal, and figures: distances from point to point, their sum, and with
        three or more points the closed polygon's area.

    Raises:
        ReconstructionError: the points cannot be read, or one is not found.
        WorkspaceError: there is no model.
    """
    words = points.split()
    marks = parse_picks(points, pick_sigma_px)
    pictures = RegisteredPictures.read(workspace)
    if not pictures.frame.scaled:
        raise ReconstructionError("the model has no scale: lengths in it are not metres")
    finder = _PickFinder(workspace, pictures)
    picks = [finder.find(some) if len(some) == 1 else finder.check(some) for some in marks]
    lines = [PolylineFigure(value=partial(_segment, n), power=1) for n in range(len(picks) - 1)]
    if len(picks) > 2:
        lines += [
            PolylineFigure(value=polyline, power=1),
            PolylineFigure(value=polygon_area, power=2),
        ]
    places, figures = Lengths(workspace, pictures).figures(picks, lines)
    return _describe(words, places, figures)


def scale_model(workspace: Path, points: str, length_m: float) -> str:
    """Note the true distance between two picked points of a model in `scale.json`.

    Args:
        workspace: folder with a finished `sparse/`.
        points: two of them, as `measure` takes points.
        length_m: their true distance.

    Returns:
        What was found, in one line.

    Raises:
        ReconstructionError: the points cannot be understood or found, or the scale is known from
            the rig already.
    """
    marks, words = parse_picks(points.replace("+", "=")), points.split()
    if len(words) != 2:
        raise ReconstructionError(f"--points needs two points, got {len(words)}: {points!r}")
    pictures = RegisteredPictures.read(workspace)
    finder, lengths = _PickFinder(workspace, pictures), Lengths(workspace, pictures)
    first, second = (
        lengths.target(finder.find(some) if len(some) == 1 else finder.check(some)).model
        for some in marks
    )
    return note_scale(workspace, (words[0], words[1]), first, second, length_m)


def parse_picks(points: str, sigma_px: float = 0.0) -> list[tuple[Pick, ...]]:
    """Read points as `measure` takes them, each with its one or two picks.

    Raises:
        ReconstructionError: fewer than two, or one of another form.
    """
    found = []
    for word in points.split():
        parts = [_PIXEL.fullmatch(part) for part in word.split("=")]
        matches = [match for match in parts if match is not None]
        if len(matches) < len(parts) or len(parts) > 2:
            raise ReconstructionError(f"point {word!r}: give IMAGE:x,y or IMAGE:x,y=IMAGE:x,y")
        sigma = sigma_px or (PICK_SIGMA_PX if len(parts) == 2 else _EXACT_PX)
        found.append(
            tuple(
                Pick(
                    image=match["image"], point=word, x_px=float(match[2]) + 0.5,
                    y_px=float(match[3]) + 0.5, sigma_px=sigma,
                )
                for match in matches
            )
        )  # fmt: skip
    if len(found) < 2:
        raise ReconstructionError(f"{len(found)} points; two or more are needed to measure")
    return found


class _PickFinder:
    """Finds picks of one picture in the others of a workspace."""

    def __init__(self, workspace: Path, pictures: RegisteredPictures) -> None:
        self._pictures, self._images = pictures, workspace / "images"
        self._surface = ModelSurface(workspace)
        self._grey = lru_cache(_KEPT)(self._read)

    def _read(self, image: str) -> Any:
        return cv2.cvtColor(read_colour(self._images / image), cv2.COLOR_BGR2GRAY)

    def check(self, picks: Sequence[Pick]) -> Sequence[Pick]:
        """Picks that lie in their pictures.

        Raises:
            ReconstructionError: one does not.
        """
        for pick in picks:
            width, height = self._pictures.warp(pick.image).size_px
            if not (0 <= pick.x_px <= width and 0 <= pick.y_px <= height):
                raise ReconstructionError(f"{_text(pick)} is outside of its {width} x {height}")
        return picks

    def find(self, picks: Sequence[Pick]) -> Sequence[Pick]:
        """A pick with those that were found from it in other pictures.

        Where nothing there looks like it, its ray is cut with the elevation model.

        Raises:
            ReconstructionError: it meets no known surface, or no other picture shows it.
        """
        (pick,) = self.check(picks)
        place = self._surface.met_by(
            *self._pictures.picture(pick.image).ray(np.array([pick.x_px, pick.y_px]))
        )
        seen = self._pictures.seeing(place.point, place.normal)[:_MAX_LOOKED_IN]
        images = [one.image for one in seen if one.image != pick.image]
        found = refine(pick, images, place, self._pictures.picture, self._grey)
        if found.meeting is not None:
            return found.picks
        if images and self._surface.is_dense:
            return pick, self._by_surface(pick, place, images[0])
        why = f": {found.refused[0].why}" if found.refused else ""
        raise ReconstructionError(
            f"{_text(pick)} is not found in another picture{why}; pick another pixel, or the "
            "point in two pictures as IMAGE:x,y=IMAGE:x,y"
        )

    def _by_surface(self, pick: Pick, place: SurfacePlace, image: str) -> Pick:
        """Where another picture sees what the ray of a pick meets, as well as that is known."""
        picture, near = self._pictures.picture(image), self._pictures.picture(pick.image)
        seen = picture.project(place.point)
        _, way = near.ray(np.array([pick.x_px, pick.y_px]))
        along = place.sigma * way / abs(way @ place.normal)
        sigma = float(np.linalg.norm(picture.project(place.point + along) - seen))
        x, y = seen.tolist()
        return replace(
            pick, image=image, x_px=x, y_px=y, sigma_px=max(sigma, _EXACT_PX),
            matched_to=pick.image,
        )  # fmt: skip


def _text(pick: Pick) -> str:
    return f"{pick.image}:{pick.x_px - 0.5:g},{pick.y_px - 0.5:g}"


def _segment(number: int, points: Array) -> float:
    """Length of one segment of the line through points."""
    return polyline(points[number : number + 2])


def _describe(
    words: Sequence[str], places: Array, figures: Sequence[PickedFigure]
) -> tuple[str, dict[str, Any]]:
    def entry(figure: PickedFigure, unit: str) -> dict[str, float]:
        return {
            f"value_{unit}": figure.value,
            f"sigma_{unit}": figure.sigma,
            f"sigma_of_pixels_{unit}": figure.sigma_picks,
            f"sigma_of_poses_{unit}": figure.sigma_poses,
            f"sigma_of_calibration_{unit}": figure.sigma_scale,
        }

    count = len(words) - 1
    segments = [
        {"from": words[n], "to": words[n + 1], **entry(figures[n], "m")} for n in range(count)
    ]
    lines = [
        f"{words[n]} to {words[n + 1]}: {_millimetres(figures[n])} "
        f"({1e3 * figures[n].sigma_picks:.2f} of pixels, {1e3 * figures[n].sigma_poses:.2f} of "
        f"poses, {1e3 * figures[n].sigma_scale:.2f} of calibration)"
        for n in range(count)
    ]
    data: dict[str, Any] = {
        "format": "alice-survey measure",
        "version": 2,
        "points": [
            {"pixel": word, "east_m": float(east), "north_m": float(north), "up_m": -float(down)}
            for word, (north, east, down) in zip(words, places, strict=True)
        ],
        "distances": segments,
    }
    if count > 1:
        length, area = figures[-2:]
        data["length"], data["area"] = entry(length, "m"), entry(area, "m2")
        lines.append(f"length of the line: {_millimetres(length)}")
        lines.append(
            f"area of the polygon: {1e4 * area.value:.3f} cm2, sigma {1e4 * area.sigma:.3f} cm2"
        )
    return "\n".join(lines), data


def _millimetres(length: PickedFigure) -> str:
    return f"{1e3 * length.value:.2f} mm, sigma {1e3 * length.sigma:.2f} mm"
