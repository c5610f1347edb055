"""Camera positions over the mosaic, by line, with what is known of their errors."""

from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

from alice_survey.core.artefacts import read_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from alice_survey.kit.document import EAST_NORTH, OWN_AXES
from alice_survey.kit.figure import (
    EllipseCollection,
    figure_style,
    map_axes,
    new_figure,
    save_figure,
    withStroke,
)
from reconstruct.placing.track import read_track_poses

_MAX_PX = 1800
_MAX_IN = 9.0
_TURN_DEG = 50.0
"""A track that turns by more than this between legs starts a new line."""
_MAX_NAMED = 24
"""Lines that the legend names one by one: a big survey has hundreds."""
_MIN_LINE = 3
"""Stations of a line; fewer lie in a turn."""
_TWO_SIGMA = 2.0
_COLOURS = (
    "#ff5d5d", "#4cc9f0", "#ffd166", "#06d6a0", "#f78c2c", "#c792ea", "#f4f1de", "#7bdff2",
)  # fmt: skip


@progress.step("draw the track")
@figure_style()
def plot_track_over(mosaic_tif: Path, track_csv: Path, path: Path) -> None:
    """Draw the stations of a track over its mosaic, each line in a colour, with 2-sigma ellipses.

    The ellipses are of the horizontal position in the world, from `track_covariance.npz` by the
    track where that is; they are drawn true to scale and left out where nothing places the model.

    Args:
        mosaic_tif: a mosaic of the same survey, of any size: it is read reduced.
        track_csv: `sparse/track.csv`.
        path: of the PNG.

    Raises:
        WorkspaceError: a file is missing or holds no track.
    """
    poses = read_track_poses(track_csv)
    if not poses:
        raise WorkspaceError(f"{track_csv} has no picture")
    picture, extent, tags = _read_mosaic(mosaic_tif)
    names = _stations(track_csv)
    places = np.stack([poses[name].translation for name in names])[:, :2]
    ellipses = _ellipses(track_csv.with_name("track_covariance.npz"), names, places)
    lines = split_lines(places)
    count = int(lines.max()) + 1
    width_in, height_in = _size(extent)
    figure = new_figure(height_in, width_in)
    axes = figure.subplots()
    axes.imshow(picture, extent=extent, interpolation="bilinear")
    axes.plot(places[:, 1], places[:, 0], color="white", linewidth=0.6, alpha=0.7, zorder=2)
    for number in range(count):
        on = lines == number
        colour = _COLOURS[number % len(_COLOURS)]
        label = f"line {number + 1}: {int(on.sum())} stations"
        if count > _MAX_NAMED:
            label = "_" if number else f"{count} lines of {int((lines >= 0).sum())} stations"
        axes.plot(
            places[on, 1], places[on, 0], "o-", color=colour, markersize=3.5, linewidth=1.2,
            markeredgecolor="black", markeredgewidth=0.4, zorder=4,
            label=label,
        )  # fmt: skip
    turning = lines < 0
    if turning.any():
        axes.plot(
            places[turning, 1], places[turning, 0], "o", color="0.8", markersize=3,
            markeredgecolor="black", markeredgewidth=0.4, zorder=3, label="in turns",
        )  # fmt: skip
    if ellipses is not None:
        wide, high, angle, said = ellipses
        axes.add_collection(
            EllipseCollection(
                wide, high, angle, units="xy", offsets=places[:, ::-1],
                offset_transform=axes.transData, facecolor="none", edgecolor="white",
                linewidth=0.7, alpha=0.8, zorder=3
            )
        )  # fmt: skip
        axes.plot([], [], "o", markersize=9, markerfacecolor="none", markeredgecolor="0.5",
                  label=said)  # fmt: skip
    axes.plot(places[0, 1], places[0, 0], "^", color="white", markeredgecolor="black", zorder=5)
    axes.annotate(
        "start", places[0, ::-1], xytext=(6, 6), textcoords="offset points", color="white",
        fontsize=8, zorder=6, path_effects=[withStroke(linewidth=2, foreground="black")],
    )  # fmt: skip
    margin = 0.02 * max(extent[1] - extent[0], extent[3] - extent[2])
    axes.set_xlim(min(extent[0], places[:, 1].min()) - margin,
                  max(extent[1], places[:, 1].max()) + margin)  # fmt: skip
    axes.set_ylim(min(extent[2], places[:, 0].min()) - margin,
                  max(extent[3], places[:, 0].max()) + margin)  # fmt: skip
    axes.set_facecolor("0.15")
    axes.grid(visible=False)
    map_axes(
        axes, tags.get("UNIT", "m"), names=OWN_AXES if tags.get("FRAME") == "model" else EAST_NORTH
    )
    axes.set_title(
        f"Camera positions over the mosaic: {len(poses)} pictures at {len(names)} stations"
    )
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    save_figure(figure, path, bbox_inches="tight")


def split_lines(places: Array) -> NDArray[np.int64]:
    """Number the lines of a track, (N,); -1 for stations in turns.

    Args:
        places: (N, 2) in the order they were visited.
    """
    count = len(places)
    if count < _MIN_LINE:
        return np.zeros(count, dtype=np.int64)
    legs = np.diff(places, axis=0)
    course = np.arctan2(legs[:, 1], legs[:, 0])
    found = np.full(count, -1, dtype=np.int64)
    first, number = 0, 0
    for leg in range(1, count):
        ends = leg == count - 1
        turned = not ends and abs(_wrap(course[leg] - _mean(course[first:leg]))) > np.deg2rad(
            _TURN_DEG
        )
        if not (ends or turned):
            continue
        if leg - first + 1 >= _MIN_LINE:
            free = found[first : leg + 1] < 0
            found[first : leg + 1] = np.where(free, number, found[first : leg + 1])
            number += 1
        first = leg
    return found


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _mean(angles: Array) -> float:
    return float(np.angle(np.exp(1j * angles).mean()))


def _stations(track_csv: Path) -> list[str]:
    """The first picture of every station, by time where known, else by number."""
    rows = [row for _, row in read_csv(track_csv, exact=True)[1]]
    timed = all(row["time_s"] for row in rows)
    rows.sort(key=lambda r: (float(r["time_s"]) if timed else 0.0, int(r["station"]), r["image"]))
    first: dict[int, str] = {}
    for row in rows:
        first.setdefault(int(row["station"]), row["image"])
    return list(first.values())


def _ellipses(
    path: Path, names: list[str], places: Array
) -> tuple[Array, Array, Array, str] | None:
    """Whole axes (N,) of 2-sigma ellipses, their angle from east in degrees, and a legend."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as data:
        if not str(data["parts"]).startswith("place"):
            return None
        at = {str(image): k for k, image in enumerate(data["image"])}
        covariances = data["covariance"][[at[name] for name in names]][:, :2, :2]
    known = np.isfinite(covariances).all(axis=(1, 2))
    covariances = np.where(known[:, None, None], covariances, 0.0)
    squares, axes = np.linalg.eigh(covariances)
    sizes = 2.0 * _TWO_SIGMA * np.sqrt(np.maximum(squares, 0.0))
    angle = np.rad2deg(np.arctan2(axes[:, 0, 1], axes[:, 1, 1]))
    largest = float(sizes[:, 1].max()) / 2.0
    said = f"{largest:.2g} m" if largest >= 1 else f"{1e3 * largest:.3g} mm"
    return sizes[:, 1], sizes[:, 0], angle, f"2-sigma ellipses, up to {said}"


def _read_mosaic(path: Path) -> tuple[Array, tuple[float, float, float, float], dict[str, str]]:
    """A mosaic reduced, (H, W, 3) from 0 to 1, dark where empty; west, east, south, north; tags."""
    try:
        with rasterio.open(path) as raster:
            shrink = max(1.0, max(raster.width, raster.height) / _MAX_PX)
            shape = (max(1, int(raster.height / shrink)), max(1, int(raster.width / shrink)))
            bands = list(range(1, min(raster.count, 3) + 1))
            resampling = rasterio.enums.Resampling.average
            colour = raster.read(bands, out_shape=(len(bands), *shape), resampling=resampling)
            valid = raster.dataset_mask(out_shape=shape) > 0
            bounds, tags = raster.bounds, raster.tags()
    except rasterio.errors.RasterioIOError as error:
        raise WorkspaceError(f"{path}: no mosaic: {error}") from None
    whole = float(np.iinfo(colour.dtype).max) if colour.dtype.kind == "u" else 1.0
    picture = np.moveaxis(colour.astype(np.float64) / whole, 0, -1)
    picture = np.repeat(picture, 3, axis=-1) if picture.shape[-1] == 1 else picture
    picture = np.where(valid[..., None], np.clip(picture[..., :3], 0, 1), 0.15)
    return picture, (bounds.left, bounds.right, bounds.bottom, bounds.top), tags


def _size(extent: tuple[float, float, float, float]) -> tuple[float, float]:
    """Size of a figure for a map with a legend at its right, inches."""
    wide, high = extent[1] - extent[0], extent[3] - extent[2]
    scale = (_MAX_IN - 2.0) / max(wide, high, 1e-9)
    return max(4.0, wide * scale) + 2.4, max(3.0, high * scale) + 0.8
