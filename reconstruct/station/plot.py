"""A picture next to its depth, with a scale bar."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.kit.figure import colour_bar, figure_style, new_figure, save_figure
from reconstruct.views.model import View

_BARS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


@figure_style()
def plot_pair(
    path: Path,
    view: View,
    colour: NDArray[np.uint8],
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
) -> None:
    """Draw the left picture and its depth.

    Args:
        path: of the picture.
        view: of the depth.
        colour: (H, W, 3) BGR.
        depth: (H, W) m, NaN where unknown.
        sigma: (H, W) m.
    """
    height, width = depth.shape
    figure = new_figure(1.1 + 5.4 * height / width, 12.0)
    first, second = figure.subplots(1, 2)
    middle = float(np.nanmedian(depth))
    ground = middle / np.sqrt(view.fx_px * view.fy_px)
    first.imshow(np.ascontiguousarray(colour[..., ::-1]), interpolation="antialiased")
    bar = max((b for b in _BARS_M if b <= 0.3 * width * ground), default=_BARS_M[0])
    left, low = 0.06 * width, 0.92 * height
    first.plot([left, left + bar / ground], [low, low], color="white", lw=4)
    text = f"{bar:g} m" if bar >= 1 else f"{100 * bar:g} cm"
    first.text(
        left, low - 0.025 * height, f"{text} at {middle:.2f} m",
        color="white", ha="left", va="bottom",
    )  # fmt: skip
    first.set_title("left picture, without refraction and distortion")
    near, far = np.nanpercentile(depth, [1, 99])
    shown = second.imshow(depth, cmap="viridis_r", vmin=near, vmax=far, interpolation="nearest")
    second.set_facecolor("white")
    colour_bar(shown, second, "distance along the axis (m)")
    second.set_title(
        f"depth: {np.isfinite(depth).mean():.0%} of the picture, matching sigma "
        f"{1e3 * float(np.nanmedian(sigma)):.1f} mm",
        fontsize=10,
    )
    for axes in (first, second):
        axes.grid(visible=False)
        axes.set_xticks([])
        axes.set_yticks([])
    save_figure(figure, path, dpi=120)
