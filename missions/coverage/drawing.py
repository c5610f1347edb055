"""Maps of a certificate: how often each place is seen, and where it is not."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon

from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from missions.coverage.certificate import Certificate
from missions.coverage.geofiles import NO_DATA, sampled
from missions.coverage.holes import Hole
from missions.coverage.raster import Grid
from missions.coverage.stations import Stations
from missions.values.area import Area
from missions.values.line import Line

_AREA, _HOLE, _TRACK, _AGAIN = "#17202a", "#c0392b", "#17202a", "#d35400"
_NONE = "#f5b7b1"
_SEEN = LinearSegmentedColormap.from_list("seen", ["#d6eaf8", "#5dade2", "#1f618d", "#0b2239"])
_RISK = LinearSegmentedColormap.from_list("risk", ["#e8f8f5", "#f7dc6f", "#e67e22", "#78281f"])
_LONGEST_PX = 1400
_NUMBERED = 12
_WIDTH_IN, _LEAST_WIDTH_IN, _HEAD_IN, _FOOT_IN = 9.0, 6.6, 0.95, 0.72
"""Of the sheet, and its least; of title and axis label; of legend and figures below the map."""
_MAP_IN, _LEAST_MAP_IN, _MOST_MAP_IN = 7.55, 2.2, 8.2
"""Width of a map between its labels and the colours' bar, and its least and greatest height."""
_MARGIN = 0.06
"""Around the area, of its longer side."""
_CLASSES = 12
"""At most, of counts that are told apart."""


@progress.step("draw the coverage")
def draw_certificate(
    path: Path,
    certificate: Certificate,
    holes: Sequence[Hole],
    title: str,
    *,
    stations: Stations | None = None,
    again: Sequence[Line] = (),
) -> None:
    """Draw how many pictures of all cameras see each place, with the holes outlined.

    Args:
        path: picture to write; its ending says which kind.
        certificate: what is drawn.
        holes: its holes, worst first; the first ones are numbered.
        title: of the map.
        stations: where pictures were taken, to be drawn as points.
        again: lines that fly the holes again.
    """
    most = int(np.percentile(certificate.pictures[certificate.inside], 99.5))
    width = math.ceil(max(most, 1) / _CLASSES)
    steps = np.arange(1, most + 2 * width, width)
    colours = [_NONE, *(_SEEN(i / max(len(steps) - 2, 1)) for i in range(len(steps) - 1))]
    colour_map = ListedColormap(colours).with_extremes(bad=(0, 0, 0, 0), over=colours[-1])
    figure, axes = _sheet(certificate.area)
    image, extent = _north_up(certificate, certificate.pictures)
    drawn = axes.imshow(
        image, extent=extent, origin="lower", cmap=colour_map, interpolation="nearest",
        norm=BoundaryNorm([0, *steps], len(colours)), zorder=1,
    )  # fmt: skip
    bar = figure.colorbar(
        drawn, ax=axes, shrink=0.7, pad=0.02, ticks=[0.5, *(steps[:-1] + steps[1:]) / 2]
    )
    bar.ax.set_yticklabels(["0", *(_class(a, b) for a, b in itertools.pairwise(steps.tolist()))])
    bar.ax.tick_params(length=0, labelsize=8)
    bar.set_label("pictures of all cameras", fontsize=9)
    _outline(axes, certificate.area.survey, _AREA, 1.4, "survey area")
    _no_go(axes, certificate.area)
    if stations is not None and len(stations):
        size = 5.0 if len(stations) < 1500 else 1.5
        axes.scatter(
            stations.glass_ne[:, 1], stations.glass_ne[:, 0], s=size, color=_TRACK, lw=0,
            alpha=0.55, zorder=3, label="stations",
        )  # fmt: skip
    for index, hole in enumerate(holes):
        _outline(
            axes, hole.outline, _HOLE, 1.6, "not at the overlap requested" if not index else ""
        )
        if index < _NUMBERED:
            _number(axes, hole, index + 1)
    if again:
        ends = [(line.start_ne_m[::-1], line.end_ne_m[::-1]) for line in again]
        axes.add_collection(
            LineCollection(
                ends, colors=_AGAIN, linewidths=1.8, zorder=5, label="lines to fly again"
            )
        )
    _furniture(figure, axes, certificate.area)
    axes.set_title(title, loc="left", fontsize=12, weight="bold")
    _foot(figure, _figures(certificate, holes))
    figure.savefig(path, dpi=130, metadata=_plain(path))


def draw_risk(
    path: Path, area: Area, grid: Grid, probability: Array, title: str, text: str
) -> None:
    """Draw the probability, (rows, columns), that a place is not covered at the overlap requested.

    NaN is outside of the area.
    """
    figure, axes = _sheet(area)
    image, extent = _resampled(area, grid, probability)
    colour_map = _RISK.with_extremes(bad=(0, 0, 0, 0))
    drawn = axes.imshow(
        image, extent=extent, origin="lower", cmap=colour_map, interpolation="nearest",
        vmin=0.0, vmax=max(float(np.nanmax(probability)), 1e-9), zorder=1,
    )  # fmt: skip
    bar = figure.colorbar(drawn, ax=axes, shrink=0.7, pad=0.02, format="{x:.0%}")
    bar.set_label("share of flights that leave a hole here", fontsize=9)
    _outline(axes, area.survey, _AREA, 1.4, "survey area")
    _no_go(axes, area)
    _furniture(figure, axes, area)
    axes.set_title(title, loc="left", fontsize=12, weight="bold")
    _foot(figure, text)
    figure.savefig(path, dpi=130, metadata=_plain(path))


def _class(low: int, following: int) -> str:
    return str(low) if following == low + 1 else f"{low}-{following - 1}"


def _figures(certificate: Certificate, holes: Sequence[Hole]) -> str:
    pattern = certificate.pattern
    asked = pattern.passes * pattern.pictures
    holes_text = f"{len(holes)} hole" if len(holes) == 1 else f"{len(holes)} holes"
    return (
        f"{certificate.stations} stations, {certificate.taken} pictures; seen "
        f"{certificate.covered_share:.2%}, in stereo {certificate.stereo_share:.2%}, at the "
        f"overlap requested {certificate.share_at_overlap:.2%}\n(that is {pattern.passes} "
        f"line{'s' if pattern.passes > 1 else ''} and {asked} pictures of each camera); "
        f"{holes_text}, {sum(hole.area_m2 for hole in holes):.2f} m²; "
        f"grid {100 * certificate.grid.cell_m:.1f} cm"
    )


def _sheet(area: Area) -> tuple[Figure, Axes]:
    south, west, north, east = area.survey.bounds
    margin = 2 * _MARGIN * max(north - south, east - west)
    tall = (north - south + margin) / (east - west + margin)
    map_in = min(max(_MAP_IN * tall, _LEAST_MAP_IN), _MOST_MAP_IN)
    wide_in = min(max(map_in / tall + _WIDTH_IN - _MAP_IN, _LEAST_WIDTH_IN), _WIDTH_IN)
    high_in = _FOOT_IN + map_in + _HEAD_IN
    figure = Figure(
        figsize=(wide_in, high_in), facecolor="white",
        layout=ConstrainedLayoutEngine(
            rect=(0, _FOOT_IN / high_in, 1, 1 - (_FOOT_IN + 0.05) / high_in)
        ),
    )  # fmt: skip
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.grid(color="#e5e8e8", lw=0.6)
    axes.set_axisbelow(True)
    datum = area.datum
    axes.set_xlabel(f"east of {abs(datum.longitude_deg):.6f}° {'EW'[datum.longitude_deg < 0]}, m")
    axes.set_ylabel(f"north of {abs(datum.latitude_deg):.6f}° {'NS'[datum.latitude_deg < 0]}, m")
    return figure, axes


def _north_up(
    certificate: Certificate, values: NDArray[np.uint16]
) -> tuple[Any, tuple[float, float, float, float]]:
    """Counts on a grid with north up, masked outside of the area, and its extent for imshow."""
    places, extent = _pixels(certificate.area, certificate.grid.cell_m)
    found = sampled(certificate, values, places)
    return np.ma.masked_equal(found, NO_DATA), extent


def _resampled(
    area: Area, grid: Grid, values: Array
) -> tuple[Any, tuple[float, float, float, float]]:
    places, extent = _pixels(area, grid.cell_m)
    cells = np.floor(grid.cells_of(places)).astype(np.int64)
    row, column = cells[..., 0], cells[..., 1]
    on = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
    found = np.full(on.shape, np.nan)
    found[on] = values[row[on], column[on]]
    return np.ma.masked_invalid(found), extent


def _pixels(area: Area, cell_m: float) -> tuple[Array, tuple[float, float, float, float]]:
    """Middles of pixels, (rows, columns, 2), from the south-west corner of an area."""
    south, west, north, east = area.survey.bounds
    pixel_m = max(cell_m / 2, max(north - south, east - west) / _LONGEST_PX)
    rows, columns = (
        max(1, math.ceil((high - low) / pixel_m)) for low, high in ((south, north), (west, east))
    )
    at = np.meshgrid(
        south + pixel_m * (np.arange(rows) + 0.5), west + pixel_m * (np.arange(columns) + 0.5),
        indexing="ij",
    )  # fmt: skip
    extent = (west, west + pixel_m * columns, south, south + pixel_m * rows)
    return np.stack(at, axis=-1), extent


def _outline(axes: Axes, shape: MultiPolygon, colour: str, width: float, label: str) -> None:
    rings = [
        np.asarray(ring.coords)[:, 1::-1]
        for polygon in shape.geoms
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    edges = LineCollection(
        rings, colors=colour, linewidths=width, zorder=4, label=label or "_nolegend_"
    )
    axes.add_collection(edges)


def _no_go(axes: Axes, area: Area) -> None:
    rings = [np.asarray(polygon.exterior.coords)[:, 1::-1] for polygon in area.no_go.geoms]
    if rings:
        axes.add_collection(
            PolyCollection(
                rings, facecolors="#eaeded", edgecolors="#7f8c8d", hatch="//", lw=0.8, zorder=2,
                label="no-go zone",
            )
        )  # fmt: skip


def _number(axes: Axes, hole: Hole, number: int) -> None:
    axes.annotate(
        str(number), xy=hole.place_ne[::-1], ha="center", va="center", fontsize=8, weight="bold",
        color="white", zorder=8,
        bbox={"boxstyle": "circle,pad=0.22", "fc": _HOLE, "ec": "white", "lw": 0.8},
    )  # fmt: skip


def _foot(figure: Figure, text: str) -> None:
    figure.text(
        0.012, 0.1 / figure.get_figheight(), text, fontsize=8.5, color="#333333", va="bottom"
    )


def _furniture(figure: Figure, axes: Axes, area: Area) -> None:
    """Limits, legend and a north arrow."""
    south, west, north, east = area.survey.bounds
    margin = _MARGIN * max(north - south, east - west)
    axes.set_xlim(west - margin, east + margin)
    axes.set_ylim(south - margin, north + margin)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="lower center", ncol=5, frameon=False, fontsize=8,
        bbox_to_anchor=(0.5, 0.43 / figure.get_figheight()),
    )  # fmt: skip
    axes.annotate(
        "N", xy=(0.975, 0.99), xytext=(0, -28), xycoords="axes fraction",
        textcoords="offset points", ha="center", va="center", fontsize=10, weight="bold", zorder=9,
        arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.4},
    )  # fmt: skip


def _plain(path: Path) -> dict[str, None]:
    """No date and no version in the file: the same map is the same bytes."""
    if path.suffix.lower() == ".pdf":
        return {"CreationDate": None, "Creator": None, "Producer": None}
    return {"Software": None}
