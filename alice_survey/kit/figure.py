"""The style of every figure, and what figures share: colour bars, scale bars, north, saving.

This is the only module with matplotlib's settings. Others draw like this:

    @figure_style()
    def residual_plot(residuals_px: Array) -> Sheet:
        sheet = new_figure(2.6)
        axes = sheet.subplots()
        axes.hist(residuals_px, color=INKS[0])
        return sheet

    save_figure(residual_plot(residuals_px), folder / "residuals.png")

The same numbers give the same bytes.
"""

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap, to_hex
from matplotlib.figure import Figure as Sheet
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import ConfigError, WorkspaceError, file_faults
from alice_survey.core.frames import Array
from alice_survey.kit.document import EAST_NORTH, Figure
from alice_survey.kit.map import even_limit, round_length

__all__ = [
    "BAND", "GRID", "INK", "INKS", "MARKS", "SOFT", "WIDTH_IN", "Axes", "BoundaryNorm",
    "LineCollection", "LinearSegmentedColormap", "ListedColormap",
    "Outline", "PathPatch", "PolyCollection",
    "Sheet", "check_figure_path", "colour_bar", "draw_figure", "even_limit", "figure_style",
    "map_axes", "new_figure", "north_arrow", "palette_colours", "palette_steps", "plain_name",
    "png_of", "save_figure",
    "scale_bar", "shrunk_png", "svg_of", "withStroke",
]  # fmt: skip

INKS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's palette, safe for the colour-blind; lines also differ by their markers."""
MARKS = ("o", "s", "^", "D", "v", "x")
INK, SOFT, GRID, BAND = "#22313a", "#5d6d77", "#e3e8eb", "#dfe7ec"
WIDTH_IN = 7.6
_DPI = 130
_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#7b8a93",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "svg.hashsalt": "alice-survey",  # names within an SVG are random otherwise
    "svg.fonttype": "none",
}
_NO_DATES: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
}
_MAX_PX = 1600


class _ShownSheet(Sheet):  # type: ignore[misc]  # matplotlib has no types
    """A figure that a notebook shows without set-up."""

    def _repr_png_(self) -> bytes:
        return png_of(self)


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the kit's style: a context, or a decorator of a function that draws."""
    with mpl.rc_context(_STYLE):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Any:
    """An empty figure that lays itself out."""
    with figure_style():
        sheet = _ShownSheet(figsize=(width_in, height_in), dpi=_DPI, layout="constrained")
        FigureCanvasAgg(sheet)
    return sheet


def png_of(sheet: Any, dpi: float = _DPI, **options: Any) -> bytes:
    """A figure's pixels."""
    return _save_bytes(sheet, "png", dpi, options)


def svg_of(sheet: Any, dpi: float = _DPI, **options: Any) -> bytes:
    """A figure's vectors, with text as text."""
    return _save_bytes(sheet, "svg", dpi, options)


def check_figure_path(path: Path) -> None:
    """Refuse a file that no figure can be written to, before one is drawn.

    Raises:
        ConfigError: its name does not end with .png, .svg or .pdf.
    """
    if path.suffix.removeprefix(".").lower() not in _NO_DATES:
        endings = ", ".join(f".{kind}" for kind in _NO_DATES)
        raise ConfigError(f"{path}: figures are written as {endings}: change the suffix")


def save_figure(sheet: Any, path: Path, dpi: float = _DPI, **options: Any) -> None:
    """Write a figure as what the file's name ends with: png, svg or pdf.

    Args:
        sheet: the figure.
        path: path of the file.
        dpi: pixels per inch, of what is drawn as pixels.
        options: options of matplotlib's `savefig`.

    Raises:
        ConfigError: the name has another ending, or the file cannot be written.
    """
    check_figure_path(path)
    content = _save_bytes(sheet, path.suffix.removeprefix(".").lower(), dpi, options)
    with file_faults(path, ConfigError, "written"), atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _save_bytes(sheet: Any, kind: str, dpi: float, options: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    with figure_style(), warnings.catch_warnings():
        # The name of a picture may have letters that the font lacks.
        warnings.filterwarnings("ignore", message="Glyph")
        if kind == "png" and not options:  # `savefig` draws twice where it lays out
            before, sheet.dpi = sheet.dpi, dpi
            canvas = FigureCanvasAgg(sheet)
            canvas.draw()
            words = {"dpi": dpi, "metadata": _NO_DATES[kind], "origin": "upper"}
            mpl.image.imsave(content, canvas.buffer_rgba(), format=kind, **words)
            sheet.dpi = before
        else:
            sheet.savefig(content, format=kind, dpi=dpi, metadata=_NO_DATES[kind], **options)
    return content.getvalue()


def draw_figure(
    paint: Callable[[Sequence[Any]], None],
    height_in: float,
    *,
    width_in: float = WIDTH_IN,
    **words: Any,
) -> Figure:
    """A report's figure from a function that paints on a list of axes, the only one.

    Args:
        paint: draws on the axes.
        height_in: inches.
        width_in: inches.
        words: title, alt, shows, good and otherwise of the figure.
    """
    with figure_style():
        sheet = new_figure(height_in, width_in)
        paint([sheet.subplots()])
        return Figure(png=png_of(sheet), svg=svg_of(sheet), **words)


def colour_bar(image: Any, axes: Any, label: str, **options: Any) -> Any:
    """A colour bar with numbers and its quantity.

    Args:
        image: an image, a contour or a collection.
        axes: one or several that share it.
        label: quantity and unit.
        options: options of matplotlib's `colorbar`.
    """
    first = np.ravel(axes)[0]
    bar = first.figure.colorbar(image, ax=axes, **{"shrink": 0.85, "pad": 0.02} | options)
    bar.set_label(label)
    bar.outline.set_visible(False)
    return bar


def map_axes(axes: Any, unit: str = "m", *, names: tuple[str, str] = EAST_NORTH) -> None:
    """East to the right and north up, at one scale, with a scale bar and an arrow to the north.

    Axes of other names have no north. Call it when everything is drawn, since bar and arrow follow
    the limits.
    """
    across, up = names
    axes.set(aspect="equal", xlabel=f"{across}, {unit}", ylabel=f"{up}, {unit}")
    for spine in axes.spines.values():
        spine.set_visible(True)
    scale_bar(axes, unit)
    if names == EAST_NORTH:
        north_arrow(axes)


def scale_bar(axes: Any, unit: str = "m") -> None:
    """A bar of a round length, at most a quarter of the axes' width, at the lower left.

    Args:
        axes: with one unit on both axes, and their limits set.
        unit: unit of the axes.
    """
    low, high = sorted(axes.get_xlim())
    bottom, top = sorted(axes.get_ylim())
    length = round_length(0.25 * (high - low))
    x, y = low + 0.04 * (high - low), bottom + 0.05 * (top - bottom)
    rim = [withStroke(linewidth=5, foreground="white")]
    axes.plot([x, x + length], [y, y], color=INK, lw=2.4, solid_capstyle="butt", zorder=20,
              path_effects=rim, scalex=False, scaley=False)  # fmt: skip
    axes.annotate(
        f"{length:g} {unit}", (x + length / 2, y), xytext=(0, 4), textcoords="offset points",
        ha="center", va="bottom", fontsize=8, color=INK, zorder=20,
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
    )  # fmt: skip


def north_arrow(axes: Any) -> None:
    """An arrow up with an N, at the upper right."""
    rim = [withStroke(linewidth=2.5, foreground="white")]
    axes.annotate(
        "N", (0.955, 0.95), xytext=(0, -24), xycoords="axes fraction", textcoords="offset points",
        ha="center", va="top", fontsize=9, fontweight="bold", color=INK, zorder=20,
        path_effects=rim,
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.6, "shrinkA": 0, "shrinkB": 0,
                    "path_effects": [withStroke(linewidth=4, foreground="white")]},
    )  # fmt: skip


def palette_colours(name: str, shares: Array) -> NDArray[np.uint8]:
    """Colours of a palette of matplotlib.

    Args:
        name: such as viridis.
        shares: (...) from 0, its first colour, to 1, its last.

    Returns:
        (..., 4) red, green, blue and opacity, 0 to 255.
    """
    return np.asarray((255 * mpl.colormaps[name](shares)).astype(np.uint8))


def palette_steps(name: str, count: int) -> list[str]:
    """Evenly spaced colours of a palette, #rrggbb."""
    return [to_hex(mpl.colormaps[name](i / (count - 1))) for i in range(count)]


def plain_name(name: str) -> str:
    """A name as it is: matplotlib takes text between dollars for mathematics."""
    return name.replace("$", r"\$")


def shrunk_png(path: Path, max_px: int = _MAX_PX) -> bytes:
    """A picture that a stage has drawn, at most this many pixels wide and high; on white.

    Raises:
        WorkspaceError: it cannot be decoded.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise WorkspaceError(f"{path} cannot be read as a picture: run its stage again")
    if picture.ndim == 3 and picture.shape[2] == 4:
        picture = np.where(picture[..., 3:] > 0, picture[..., :3], 255).astype(picture.dtype)
    height, width = picture.shape[:2]
    shrink = max(width, height) / max_px
    if shrink > 1.0:
        size = (max(1, round(width / shrink)), max(1, round(height / shrink)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    encoded: bytes = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return encoded
