"""Lengths and areas between picked pixels, with their standard deviations.

In the folder of a pair a pixel's depth is matched again by least squares; in a reconstructed
workspace its exact ray is cut with the DEM, or with the ray of a second picture. What is known of
the calibration moves all points together: its covariance is carried through the exact
triangulation, so that an error of the baseline scales a length and leaves its points side by side.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from alice_survey.core.artefacts import need_stage, read_json
from alice_survey.core.contents import taken_from
from alice_survey.core.errors import ReconstructionError, WorkspaceError
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp, warp_from_json
from camera_calib.rig import Rig, read_rig
from reconstruct.evaluate.elevation import StoredElevation
from reconstruct.measure.errors import SharedErrors, shared_errors
from reconstruct.measure.figures import polygon_area, polyline, slopes_of
from reconstruct.picking.registered import RegisteredPictures
from reconstruct.picking.surface import ShownPlaces, shown_places
from reconstruct.placing.control_points import Pick, RegisteredPicture, triangulate_picks
from reconstruct.planes import LEVEL_PLANE
from reconstruct.station.pair import pair_samplers, read_depth, to_axes
from reconstruct.station.precise import precise_depth
from reconstruct.station.solve import PairOptics, calibration_slopes, stereo_rig
from reconstruct.views.model import scaled_view
from reconstruct.views.model_files import all_points

_NUMBER = r"(-?\d+(?:\.\d+)?)"
_PIXEL = re.compile(rf"(?:(?P<image>[^=]+?):)?{_NUMBER},{_NUMBER}")
_TWO_PICTURES_SIGMA_PX = 0.5
"""Sigma of a spot picked in two pictures, where no sigma of picking is given."""


@dataclass(frozen=True, kw_only=True)
class PickedPixel:
    """A pixel as taken, from the outer corner of the first."""

    image: str | None
    x: float
    y: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Located:
    """Points and how well they are known."""

    points: Array
    """(N, 3) points, metres."""
    own: Array
    """(N, 3, 3) covariance of each point alone."""
    shared: Array
    """(P, N, 3) how all move with parameters of covariance `parameters`."""
    parameters: Array
    """(P, P) covariance of the parameters."""
    axes: tuple[str, str, str]
    notes: tuple[str, ...]

    def sigma(self, figure: Callable[[Array], float]) -> tuple[float, float]:
        """Standard deviations of a figure of the points: independent part, and shared part."""
        slope = slopes_of(figure, self.points)
        own = float(np.einsum("ni,nij,nj->", slope, self.own, slope))
        along = np.einsum("pni,ni->p", self.shared, slope)
        return np.sqrt(max(own, 0.0)), np.sqrt(max(float(along @ self.parameters @ along), 0.0))


def measure(
    folder: Path, points: str, *, pick_sigma_px: float = 0.0, n_water_sigma: float = 0.0
) -> tuple[str, dict[str, Any]]:
    """Measure between picked pixels.

    Args:
        folder: of a pair (`pair.json`), or a reconstructed workspace.
        points: two or more, with blanks between: `x,y` in the left picture of a pair as taken;
            `IMAGE:x,y` in a workspace, or `IMAGE:x,y=IMAGE:x,y` where two pictures show the spot.
            Pixels count from 0 at the middle of the first, as viewers show them.
        pick_sigma_px: standard deviation with which pixels were picked.
        n_water_sigma: of the index of the water, where the rig's covariance does not name it.

    Returns:
        Text for the terminal, and figures: distances from point to point, their sum, and with
        three or more points the closed polygon's area.

    Raises:
        ReconstructionError: the points cannot be read, or one has no depth.
        WorkspaceError: the folder is neither a pair nor a reconstructed workspace.
    """
    picks = parse_picks(points)
    if (folder / "pair.json").is_file():
        located = _in_pair(folder, picks, pick_sigma_px, n_water_sigma)
    elif (folder / "sparse").is_dir():
        located = _in_workspace(folder, picks, pick_sigma_px)
    else:
        raise WorkspaceError(
            f"{folder}: neither the folder of a pair (pair.json) nor a reconstructed workspace "
            "(sparse/)"
        )
    return _described(points.split(), located)


def parse_picks(points: str) -> list[tuple[PickedPixel, ...]]:
    """Read points as `measure` takes them.

    Raises:
        ReconstructionError: fewer than two, or one of another form.
    """
    found = []
    for word in points.split():
        spots = []
        for part in word.split("="):
            match = _PIXEL.fullmatch(part)
            if match is None:
                raise ReconstructionError(
                    f"point {word!r}: give x,y or IMAGE:x,y or IMAGE:x,y=IMAGE:x,y"
                )
            x, y = float(match[2]) + 0.5, float(match[3]) + 0.5
            spots.append(PickedPixel(image=match["image"], x=x, y=y))
        if len(spots) > 2:
            raise ReconstructionError(f"point {word!r}: at most two pictures can show a spot")
        found.append(tuple(spots))
    if len(found) < 2:
        raise ReconstructionError(f"{len(found)} points; two or more are needed to measure")
    return found


def _segment(number: int, points: Array) -> float:
    """Length of one segment of that line."""
    return polyline(points[number : number + 2])


def _described(words: list[str], located: Located) -> tuple[str, dict[str, Any]]:
    lines, segments = [], []
    count = len(located.points)

    def entry(figure: Callable[[Array], float], unit: str) -> dict[str, float]:
        own, shared = located.sigma(figure)
        return {
            f"value_{unit}": figure(located.points),
            f"sigma_{unit}": float(np.hypot(own, shared)),
            f"sigma_of_pixels_{unit}": own,
            f"sigma_of_calibration_{unit}": shared,
        }

    for n in range(count - 1):
        found = entry(partial(_segment, n), "m")
        segments.append({"from": words[n], "to": words[n + 1], **found})
        lines.append(
            f"{words[n]} to {words[n + 1]}: {1e3 * found['value_m']:.2f} mm, sigma "
            f"{1e3 * found['sigma_m']:.2f} mm ({1e3 * found['sigma_of_pixels_m']:.2f} of pixels, "
            f"{1e3 * found['sigma_of_calibration_m']:.2f} of calibration)"
        )
    data: dict[str, Any] = {
        "format": "alice-survey measure",
        "version": 1,
        "points": [
            {
                "pixel": word,
                **dict(zip((f"{a}_m" for a in located.axes), map(float, p), strict=True)),
                "sigma_m": float(np.sqrt(np.trace(c))),
            }
            for word, p, c in zip(words, located.points, located.own, strict=True)
        ],
        "distances": segments,
        "notes": list(located.notes),
    }
    if count > 2:
        data["length"] = entry(polyline, "m")
        data["area"] = entry(polygon_area, "m2")
        lines.append(
            f"length of the line: {1e3 * data['length']['value_m']:.2f} mm, sigma "
            f"{1e3 * data['length']['sigma_m']:.2f} mm"
        )
        lines.append(
            f"area of the polygon: {1e4 * data['area']['value_m2']:.3f} cm2, sigma "
            f"{1e4 * data['area']['sigma_m2']:.3f} cm2"
        )
    lines.extend(f"note: {note}" for note in located.notes)
    return "\n".join(lines), data


def _in_pair(
    folder: Path, picks: list[tuple[PickedPixel, ...]], pick_sigma_px: float, n_water_sigma: float
) -> Located:
    about = read_json(folder / "pair.json")
    rig = read_rig(folder / "rig.json")
    with taken_from(folder / "pair.json"):
        first, second = (warp_from_json(warp) for warp in about["lenses"])
        scale, inflation = float(about["scale"]), float(about["inflation"])
        left, pictures = str(about["left"]), [folder / name for name in about["pictures"]]
    optics = PairOptics(rig=stereo_rig(rig), warps=(first, second))
    for pick in picks:
        if len(pick) > 1 or pick[0].image is not None:
            raise ReconstructionError("points of a pair are x,y in its left picture")
    taken = np.array([[p[0].x, p[0].y] for p in picks])
    _check_inside(taken, first, left)
    view, other = (scaled_view(view, scale) for view in optics.views)
    greys = pair_samplers(optics, (pictures[0], pictures[1]), (view, other))
    depth_map = read_depth(folder)
    ratio = np.array(view.pinhole.size_px) / first.pinhole.size_px
    pixels = first.to_pinhole(taken) * ratio
    found = precise_depth((view, other), greys, depth_map, pixels)
    lost = np.flatnonzero(~np.isfinite(found.depth))
    if len(lost):
        x, y = taken[lost[0]] - 0.5
        raise ReconstructionError(
            f"pixel {x:g},{y:g}: the right picture does not show the same there (no texture, "
            "hidden, or outside); pick another close by"
        )
    points = view.at_depth(pixels, found.depth)
    sigma = found.sigma * inflation
    step = 1e-3 * found.depth
    along = (view.at_depth(pixels, found.depth + step) - points) / step[:, None]
    own = (sigma**2)[:, None, None] * along[:, :, None] * along[:, None, :]
    for axis in range(2):
        moved = first.to_pinhole(taken + np.eye(2)[axis]) * ratio
        aside = (view.at_depth(moved, found.depth) - points) * pick_sigma_px
        own = own + aside[:, :, None] * aside[:, None, :]
    both = np.stack([taken, optics.rig.pixels(points)[1]])
    shared, parameters = _calibration(rig, both, n_water_sigma)
    flip = np.diag([1.0, -1.0, -1.0])
    notes = [f"rig: {rig.source}"]
    if not len(parameters):
        notes.append("the rig has no covariance: sigmas are those of the pixels alone")
    return Located(
        points=to_axes(points),
        own=flip @ own @ flip,
        shared=shared @ flip,
        parameters=parameters,
        axes=("right", "up", "back"),
        notes=tuple(notes),
    )


def _calibration(rig: Rig, pixels: Array, n_water_sigma: float) -> tuple[Array, Array]:
    """Slopes (P, N, 3) of points by what is known of a rig, and the covariance of that."""
    slopes, matrix = np.zeros((0, pixels.shape[1], 3)), np.zeros((0, 0))
    if rig.covariance is not None:
        slopes, used = calibration_slopes(rig, pixels, rig.covariance.sigmas)
        matrix = rig.covariance.matrix[np.ix_(used, used)]
    named = () if rig.covariance is None else rig.covariance.parameters
    if n_water_sigma > 0 and not any(name.endswith(".n_water") for name in named):
        names = list(rig.cameras)[:2]
        water, _ = calibration_slopes(rig, pixels, {f"{n}.n_water": n_water_sigma for n in names})
        slopes = np.concatenate([slopes, water.sum(axis=0, keepdims=True)])
        matrix = block_diag(matrix, [n_water_sigma**2])
    return slopes, matrix


def _check_inside(taken: Array, warp: PinholeWarp, name: str) -> None:
    for x, y in taken:
        if not (0 <= x <= warp.size_px[0] and 0 <= y <= warp.size_px[1]):
            raise ReconstructionError(
                f"pixel {x - 0.5:g},{y - 0.5:g} is outside of {name} "
                f"({warp.size_px[0]} x {warp.size_px[1]})"
            )


def _in_workspace(
    workspace: Path, picks: list[tuple[PickedPixel, ...]], pick_sigma_px: float
) -> Located:
    pictures = RegisteredPictures.read(workspace)
    if not pictures.frame.scaled:
        raise ReconstructionError("the model has no scale: lengths in it are not metres")
    known = all_points(workspace / "sparse" / "model")[1][:, [1, 0]]
    low, high = np.percentile(known, 2.0, axis=0), np.percentile(known, 98.0, axis=0)
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    errors = shared_errors(workspace, LEVEL_PLANE, pictures.frame, bounds)
    points, own = [], []
    for spots in picks:
        cameras = {spot.image: pictures.picture(spot.image) for spot in spots if spot.image}
        if None in {spot.image for spot in spots}:
            raise ReconstructionError("points of a workspace are IMAGE:x,y: name the picture")
        marks = [
            Pick(
                image=spot.image or "", point="spot", x_px=spot.x, y_px=spot.y,
                sigma_px=pick_sigma_px or _TWO_PICTURES_SIGMA_PX,
            )
            for spot in spots
        ]  # fmt: skip
        for mark in marks:
            place = np.array([[mark.x_px, mark.y_px]])
            _check_inside(place, cameras[mark.image].warp, mark.image)
        if len(marks) == 2:
            point, covariance = _crossed(marks, cameras)
        else:
            dem = StoredElevation.of(need_stage(workspace, "dense", "reconstruct"))
            shown = shown_places(dem, cameras[marks[0].image], place)
            point, covariance = _on_surface(marks[0], shown, errors, pick_sigma_px)
        points.append(point)
        own.append(covariance)
    turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    enu = np.stack(points) @ turn
    grown = errors.scale_sigma * (enu - enu.mean(axis=0))
    motions = np.concatenate([errors.motions_at(enu[:, :2]), grown[:, :, None]], axis=2)
    return Located(
        points=enu,
        own=turn @ np.stack(own) @ turn,
        shared=np.moveaxis(motions, 2, 0),
        parameters=block_diag(errors.covariance, np.eye(1)),
        axes=("east", "north", "up"),
        notes=errors.notes,
    )


def _crossed(
    picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> tuple[Array, Array]:
    """The point that two pictures show, and its covariance."""
    found, lost = triangulate_picks(picks, cameras)
    if not found:
        raise ReconstructionError(
            f"{' and '.join(map(_named, picks))} show no common spot: {lost['spot']}: pick again"
        )
    return found["spot"].model, found["spot"].covariance


def _on_surface(
    pick: Pick, shown: ShownPlaces, errors: SharedErrors, sigma_px: float
) -> tuple[Array, Array]:
    """The place that one picture shows, and its covariance."""
    if not np.isfinite(shown.points).all():
        raise ReconstructionError(
            f"{_named(pick)}: its ray meets no known surface; pick another pixel, or the spot in "
            "two pictures as IMAGE:x,y=IMAGE:x,y"
        )
    sigma = errors.own_sigma(shown.points[:, [1, 0]], shown.sigma)
    moves = np.column_stack([sigma * shown.by_height[0], sigma_px * shown.by_pixel[0]])
    return shown.points[0], moves @ moves.T


def _named(pick: Pick) -> str:
    return f"{pick.image}:{pick.x_px - 0.5:g},{pick.y_px - 0.5:g}"
