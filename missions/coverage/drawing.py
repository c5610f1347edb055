"""Maps of a certificate, as pictures and for a GIS: how often each place is seen, and holes."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, mapping

from alice_survey.core.artefacts import atomic_path, write_json
from alice_survey.core.frames import Array, Datum
from alice_survey.core.run import progress
from alice_survey.kit.figure import (
    Axes,
    BoundaryNorm,
    LinearSegmentedColormap,
    ListedColormap,
    Outline,
    PathPatch,
    Sheet,
    colour_bar,
    figure_style,
    map_axes,
    new_figure,
    save_figure,
)
from alice_survey.kit.words import count, share
from missions.coverage.certificate import Certificate
from missions.coverage.holes import Hole, geodetic
from missions.coverage.raster import north_up
from missions.coverage.stations import Stations
from missions.values.area import Area

NO_DATA = 65535
"""Outside of the area."""
_BANDS = (
    ("pictures", "pictures of all cameras"),
    ("least_pictures", "pictures of the camera that sees it least often"),
    ("least_lines", "lines of the camera that sees it on the fewest"),
    ("pairs", "stations that see it with all cameras at once"),
)
_BLOCK = 256


def write_coverage_tif(path: Path, certificate: Certificate) -> None:
    """Write how often each place of the area is seen, in UTM; 65535 outside of the area.

    A pixel takes the value of the certificate's cell that holds its middle.
    """
    import rasterio
    from pyproj import Transformer
    from rasterio.transform import from_origin

    datum, cell_m = certificate.area.datum, certificate.grid.cell_m
    crs = f"EPSG:{datum.utm_epsg}"
    corners_ne = certificate.area.corners_ne
    geodetic = datum.geodetic_from_ned(np.column_stack([corners_ne, np.zeros(len(corners_ne))]))
    to_utm = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east, north = to_utm.transform(geodetic[:, 1], geodetic[:, 0])
    west_m, north_m = float(np.min(east)), float(np.max(north))
    columns = max(1, int(np.ceil((np.max(east) - west_m) / cell_m)))
    rows = max(1, int(np.ceil((north_m - np.min(north)) / cell_m)))

    def places_ne(row: Array, column: Array) -> Array:
        """Local places, (..., 2), of rows and columns (corners of pixels)."""
        lon, lat = to_utm.transform(
            west_m + cell_m * column.ravel(), north_m - cell_m * row.ravel(), direction="INVERSE"
        )
        ned = datum.ned_from_geodetic(np.column_stack([lat, lon, np.zeros(lon.size)]))
        return ned[:, :2].reshape(*row.shape, 2)

    profile = {
        "driver": "GTiff", "width": columns, "height": rows, "count": len(_BANDS),
        "dtype": "uint16", "nodata": NO_DATA, "crs": crs, "compress": "deflate",
        "transform": from_origin(west_m, north_m, cell_m, cell_m),
        "tiled": True, "blockxsize": _BLOCK, "blockysize": _BLOCK,
    }  # fmt: skip
    with atomic_path(path) as temporary, rasterio.open(temporary, "w", **profile) as raster:
        for _, window in raster.block_windows(1):
            # Between the corners of a block the projection is even to a few micrometres.
            edges = [np.array(span, dtype=np.float64) for span in window.toranges()]
            corners = places_ne(*np.meshgrid(*edges, indexing="ij"))
            places = _between(corners, window.height, window.width)
            for band, (name, _) in enumerate(_BANDS, 1):
                values = sample_counts(certificate, getattr(certificate, name), places)
                raster.write(values, band, window=window)
        for band, (_, text) in enumerate(_BANDS, 1):
            raster.set_band_description(band, text)


def write_outlines(
    path: Path, datum: Datum, places: Sequence[tuple[MultiPolygon, dict[str, Any]]]
) -> None:
    """Write outlines of holes or weak places with what is known of them, RFC 7946 (WGS 84)."""
    features = [
        {"type": "Feature", "properties": known, "geometry": mapping(geodetic(outline, datum))}
        for outline, known in places
    ]
    write_json(path, {"type": "FeatureCollection", "features": features})


def sample_counts(
    certificate: Certificate, values: NDArray[np.uint16], places_ne: Array
) -> NDArray[np.uint16]:
    """Values of the cells that hold places (..., 2); `NO_DATA` outside of the area."""
    inside = certificate.grid.sample(certificate.inside, places_ne, False)
    found = certificate.grid.sample(values, places_ne, NO_DATA)
    return np.where(inside, np.minimum(found, NO_DATA - 1), np.uint16(NO_DATA))


def _between(corners: Array, rows: int, columns: int) -> Array:
    """Places, (rows, columns, 2), of the middles of pixels between the corners (2, 2, 2)."""
    down = ((np.arange(rows) + 0.5) / rows)[:, None, None]
    right = ((np.arange(columns) + 0.5) / columns)[None, :, None]
    top = corners[0, 0] * (1 - right) + corners[0, 1] * right
    bottom = corners[1, 0] * (1 - right) + corners[1, 1] * right
    return np.asarray(top * (1 - down) + bottom * down)


_AREA, _HOLE, _TRACK = "#17202a", "#c0392b", "#17202a"
_NONE = "#f5b7b1"
_SEEN = LinearSegmentedColormap.from_list("seen", ["#d6eaf8", "#5dade2", "#1f618d", "#0b2239"])
_MAX_PX = 1400
_NUMBERED = 12
_WIDTH_IN, _MIN_WIDTH_IN, _AROUND_IN = 9.0, 6.6, (1.5, 1.7)
"""Width of a sheet and its least, and what labels, bar, title and legend take of its sides."""
_MIN_MAP_IN, _MAX_MAP_IN = 2.2, 8.2
"""Height of a map."""
_MARGIN = 0.06
"""Margin around the area, as a share of its longer side."""
_CLASSES = 12
"""Most classes of counts."""


@progress.step("draw the coverage")
@figure_style()
def draw_certificate(
    path: Path, certificate: Certificate, holes: Sequence[Hole], title: str, stations: Stations
) -> None:
    """Draw how many pictures of all cameras see each place, with the holes outlined.

    Args:
        path: picture to write; its ending says which kind.
        certificate: what is drawn.
        holes: its holes, worst first; the first ones are numbered.
        title: of the map.
        stations: where pictures were taken, to be drawn as points.
    """
    figure, axes = map_sheet(_bounds(certificate.area))
    draw_counts(axes, certificate)
    draw_polygons(axes, certificate.area.survey, "survey area", edgecolor=_AREA, lw=1.4)
    _draw_no_go(axes, certificate.area)
    if len(stations):
        size = 5.0 if len(stations) < 1500 else 1.5
        axes.scatter(
            stations.glass_ne[:, 1], stations.glass_ne[:, 0], s=size, color=_TRACK, lw=0,
            alpha=0.55, zorder=3, label="stations",
        )  # fmt: skip
    for index, hole in enumerate(holes):
        label = "" if index else "below the requested overlap"
        draw_polygons(axes, hole.outline, label, edgecolor=_HOLE, lw=1.6)
        if index < _NUMBERED:
            number_place(axes, hole.place_ne, index + 1, _HOLE)
    finish_map(figure, axes, certificate.area.datum, title, _figures(certificate, holes))
    save_figure(figure, path)


def _class(low: int, following: int) -> str:
    return str(low) if following == low + 1 else f"{low}-{following - 1}"


def _figures(certificate: Certificate, holes: Sequence[Hole]) -> str:
    pattern = certificate.pattern
    asked = pattern.passes * pattern.pictures
    return (
        f"{count(certificate.stations, 'station')}, {count(certificate.taken, 'picture')}; seen "
        f"{share(certificate.covered_share, 2)}, in stereo "
        f"{share(certificate.stereo_share, 2)}, at the "
        f"requested overlap {share(certificate.share_at_overlap, 2)}\n(that is "
        f"{count(pattern.passes, 'line')} and {count(asked, 'picture')} of each "
        f"camera); {count(len(holes), 'hole')}, {sum(hole.area_m2 for hole in holes):.2f} m²; "
        f"grid {100 * certificate.grid.cell_m:.1f} cm"
    )


def _bounds(area: Area) -> tuple[float, float, float, float]:
    """South, west, north and east of a map of an area."""
    south, west, north, east = area.survey.bounds
    margin = _MARGIN * max(north - south, east - west)
    return south - margin, west - margin, north + margin, east + margin


def map_sheet(bounds_ne: tuple[float, float, float, float]) -> tuple[Sheet, Axes]:
    """A figure with one map; it is as high as the map needs.

    Args:
        bounds_ne: south, west, north and east of the map, metres.
    """
    south, west, north, east = bounds_ne
    tall = (north - south) / (east - west)
    map_in = min(max((_WIDTH_IN - _AROUND_IN[0]) * tall, _MIN_MAP_IN), _MAX_MAP_IN)
    wide_in = min(max(map_in / tall + _AROUND_IN[0], _MIN_WIDTH_IN), _WIDTH_IN)
    figure = new_figure(map_in + _AROUND_IN[1], wide_in)
    axes = figure.subplots()
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal", autoscale_on=False)
    return figure, axes


def finish_map(figure: Sheet, axes: Axes, datum: Datum, title: str, text: str) -> None:
    """Scale, north, labels and legend of a map, and a text over the legend."""
    map_axes(axes)
    axes.set_xlabel(f"east of {abs(datum.longitude_deg):.6f}° {'EW'[datum.longitude_deg < 0]}, m")
    axes.set_ylabel(f"north of {abs(datum.latitude_deg):.6f}° {'NS'[datum.latitude_deg < 0]}, m")
    axes.set_title(title, fontsize=12)
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower left", ncols=4, fontsize=8,
        title=text, title_fontsize=8.5, alignment="left",
    )  # fmt: skip


def draw_counts(axes: Axes, certificate: Certificate, opacity: float = 1.0) -> None:
    """How many pictures see each place, in steps that the eye can distinguish."""
    maximum = int(np.percentile(certificate.pictures[certificate.inside], 99.5))
    width = math.ceil(max(maximum, 1) / _CLASSES)
    steps = np.arange(1, maximum + 2 * width, width)
    colours = [_NONE, *(_SEEN(i / max(len(steps) - 2, 1)) for i in range(len(steps) - 1))]
    colour_map = ListedColormap(colours).with_extremes(bad=(0, 0, 0, 0), over=colours[-1])
    pixel_m = certificate.grid.cell_m / 2
    places, (south, west, north, east) = north_up(certificate.area, pixel_m, _MAX_PX)
    image = np.ma.masked_equal(sample_counts(certificate, certificate.pictures, places), NO_DATA)
    drawn = axes.imshow(
        image, extent=(west, east, south, north), cmap=colour_map, interpolation="nearest",
        norm=BoundaryNorm([0, *steps], len(colours)), alpha=opacity, zorder=0.6,
    )  # fmt: skip
    ticks = [0.5, *(steps[:-1] + steps[1:]) / 2]
    bar = colour_bar(drawn, axes, "pictures of all cameras", ticks=ticks)
    bar.ax.set_yticklabels(["0", *(_class(a, b) for a, b in itertools.pairwise(steps.tolist()))])
    bar.ax.tick_params(length=0, labelsize=8)


def draw_polygons(axes: Axes, shape: MultiPolygon, label: str, **style: Any) -> None:
    """Polygons with their holes, (north, east) in metres; an empty label is in no legend."""
    rings = [
        Outline(np.asarray(ring.coords)[:, 1::-1], closed=True)
        for polygon in shape.geoms
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    if rings:
        whole = Outline.make_compound_path(*rings)
        given = {"facecolor": "none", "zorder": 4, "label": label or "_nolegend_"} | style
        axes.add_patch(PathPatch(whole, **given))


def number_place(axes: Axes, place_ne: tuple[float, float], number: int, colour: str) -> None:
    """A number in a disc."""
    axes.annotate(
        str(number), xy=place_ne[::-1], ha="center", va="center", fontsize=8, weight="bold",
        color="white", zorder=8,
        bbox={"boxstyle": "circle,pad=0.22", "fc": colour, "ec": "white", "lw": 0.8},
    )  # fmt: skip


def _draw_no_go(axes: Axes, area: Area) -> None:
    draw_polygons(
        axes, area.no_go, "no-go zone", facecolor="#eaeded", edgecolor="#7f8c8d", hatch="//",
        lw=0.8, zorder=2,
    )  # fmt: skip
