"""How figures of a calibration report look: style, and parts that several of them share."""

from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from alice_survey.frames import Array
from camera_calib.fit_quality import Profile
from camera_calib.judgement import Judgement

COLOURS = ("#1b6ca8", "#d1603d", "#3a8f5c", "#7a4fa3", "#b8860b", "#4d6470")
"""Of the cameras, in the rig's order; then again from the start."""
INK, SOFT, GRID, BAND = "#22313a", "#6b7b85", "#e3e8eb", "#dfe7ec"
SEQUENTIAL = LinearSegmentedColormap.from_list(
    "depth", ["#f4f9fb", "#bcdcea", "#6fb1d1", "#2f7fb0", "#15507f", "#0b2545"]
)
DIVERGING = LinearSegmentedColormap.from_list(
    "opposed", ["#a63c1f", "#e39b7b", "#fbfbfb", "#86b7d6", "#14548a"]
)
_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
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
}
_DPI = 130
WIDTH = 10.4
_MOST_LABELS = 45

Draw = Callable[[Figure], None]


def png(height: float, draw: Draw, width: float = WIDTH) -> bytes:
    """Draw a figure of some inches and return its file; the bytes depend on the numbers only."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure)
        file = BytesIO()
        figure.savefig(file, format="png", dpi=_DPI, metadata={"Software": None})
    return file.getvalue()


def colour(index: int) -> str:
    """Of a camera by its place in the rig."""
    return COLOURS[index % len(COLOURS)]


def plain(name: str) -> str:
    """A name as it is: matplotlib takes text between dollars for mathematics."""
    return name.replace("$", r"\$")


def axes_grid(figure: Figure, count: int, rows: int = 1) -> list[list[Axes]]:
    """Axes by row and column."""
    grid = figure.subplots(rows, count, squeeze=False)
    return [list(row) for row in grid]


def draw_frame(axes: Axes, judged: Judgement, camera: str) -> None:
    """The camera's frame, y down."""
    model = judged.calibration.rig.cameras[camera]
    axes.set(xlim=(0, model.width_px), ylim=(model.height_px, 0), aspect="equal")
    axes.grid(visible=False)
    axes.set_xlabel("x (px)")
    for spine in axes.spines.values():
        spine.set_visible(True)


def frame_height(judged: Judgement, rows: int = 1) -> float:
    """Height of a figure with one column per camera."""
    shapes = [c.height_px / c.width_px for c in judged.calibration.rig.cameras.values()]
    wide = WIDTH / max(len(shapes), 1.35)
    return rows * (min(max(shapes) * wide * 0.82, 6.0) + 0.75)


def short(name: str, most: int = 18) -> str:
    """The end of a long name."""
    return name if len(name) <= most else f"...{name[3 - most :]}"


def draw_profile(above: Axes, below: Axes, found: Profile, index: int, name: str) -> None:
    """A camera's binned residuals, with twice the sigma of each bin as an error bar."""
    count = np.maximum(found.count, 1)
    style: dict[str, Any] = {
        "color": colour(index),
        "marker": "o",
        "ms": 4,
        "lw": 1.3,
        "elinewidth": 1.0,
        "capsize": 2,
        "label": plain(name),
    }
    shift = 0.12 * (found.edges[1] - found.edges[0]) * index
    at = found.centres + shift
    above.errorbar(at, found.rms_px, found.expected_px / np.sqrt(count), **style)
    below.errorbar(at, found.outward_px, 2 * found.expected_px / np.sqrt(count), **style)
    above.set_xlim(0, found.edges[-1])
    below.set_xlim(0, found.edges[-1])


def finish_profile(above: Axes, below: Axes, label: str, noise: float) -> None:
    """Limits, labels and the zero line of a pair of profile axes."""
    above.set(ylabel="rms of one coordinate (px)")
    above.set_ylim(0, max(above.get_ylim()[1], 1.6 * noise))
    below.axhline(0, color=INK, lw=1.0, ls="--")
    reach = max(np.abs(below.get_ylim()).max(), 0.5 * noise)
    below.set(ylim=(-reach, reach), xlabel=label, ylabel="mean part outward (px)")
    above.legend(loc="lower left", ncols=3)


def shared_levels(maps: Sequence[Array]) -> Array:
    """About ten round numbers for some maps together, from 0 unless all values are far from it."""
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    low = low if low > 0.5 * high else 0.0
    return np.asarray(MaxNLocator(10).tick_values(low, max(high, low + 1e-9)), dtype=np.float64)


def draw_map(axes: Axes, judged: Judgement, name: str, values: Array, levels: Array) -> Any:
    """A filled map over a frame, with contour lines that carry their numbers."""
    pixels = judged.cameras[name].map_pixels
    x, y = pixels[0, :, 0], pixels[:, 0, 1]
    shown = np.ma.masked_invalid(values)
    image = axes.contourf(x, y, shown, levels=levels, cmap=SEQUENTIAL)
    lines = axes.contour(x, y, shown, levels=levels[1:-1], colors="white", linewidths=0.7)
    middle = (levels[0] + levels[-1]) / 2
    for label in axes.clabel(lines, levels[1:-1:2], fmt="%g", fontsize=7.5):
        label.set_color("white" if float(label.get_text()) > middle else INK)
    axes.set_facecolor("#d9d9d9")
    draw_frame(axes, judged, name)
    return image


def label_views(axes: Axes, names: list[str]) -> None:
    """Ticks with the names of views, as many as there is room for."""
    shown = range(0, len(names), -(-len(names) // _MOST_LABELS))
    long = max(len(name) for name in names) > 4
    axes.set_xticks(
        list(shown),
        [plain(short(names[i])) for i in shown],
        rotation=60 if long else 0,
        ha="right" if long else "center",
        rotation_mode="anchor",
    )
