"""A drawing of a rig on its vehicle: from above, and from starboard."""

from pathlib import Path

import numpy as np

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from alice_survey.kit.figure import (
    INK,
    INKS,
    SOFT,
    figure_style,
    new_figure,
    plain_name,
    save_figure,
)
from camera_calib.rig import Rig

_HEIGHT_IN, _WIDTH_IN = 4.4, 9.0
_RAY_SHARE = 0.6
"""Length of rays over the size of what is drawn."""
_LEAST_M = 0.3


@figure_style()
def plot_mount(rig: Rig, path: Path) -> None:
    """Draw every camera's place, field of view and the top of its pictures on the vehicle.

    Args:
        rig: mounted.
        path: of the figure.

    Raises:
        CalibrationError: its mount is unknown.
    """
    if rig.body_from_rig is None:
        raise CalibrationError("nothing is drawn: the rig's mount is unknown")
    fields = {name: _field_of_view(rig, name) for name in rig.cameras}
    places = np.stack([field[0] for field in fields.values()])
    reach = _RAY_SHARE * max(float(np.abs(places).max()), _LEAST_M)
    figure = new_figure(_HEIGHT_IN, _WIDTH_IN)
    for axes, title, across, label in zip(
        figure.subplots(1, 2),
        ("from above", "from starboard"),
        (1, 2),
        ("right (m)", "down (m)"),
        strict=True,
    ):
        vertical = across == 2
        for ink, (name, (place, corners, top)) in zip(INKS, fields.items(), strict=False):
            # From above forward is up; from starboard it is to the right and down is down.
            ends = place + reach * np.vstack([corners, corners[:1]])
            at, rim, mark = (_seen(v, across) for v in (place[None], ends, ends[:4] + 0.0))
            axes.plot(*rim.T, color=ink, lw=1.0)
            for corner in mark:
                axes.plot(*np.vstack([at[0], corner]).T, color=ink, lw=0.6)
            edge = _seen(np.vstack([place + reach * top]), across)[0]
            axes.plot(*at[0], "o", color=ink, ms=5, label=plain_name(name))
            axes.annotate("top", edge, color=ink, ha="center", va="center", fontsize=8)
        axes.plot(0, 0, "+", color=INK, ms=11, mew=1.5)
        axes.annotate("navigation", (0, 0), xytext=(6, -12), textcoords="offset points", color=INK)
        bow = _seen(np.array([[0.0, 0, 0], [0.8 * reach, 0, 0]]), across)
        axes.annotate("", bow[1], bow[0], arrowprops={"arrowstyle": "->", "color": SOFT})
        axes.annotate("bow", bow[1], xytext=(4, 4), textcoords="offset points", color=SOFT)
        axes.set(title=title, aspect="equal")
        axes.set(**({"xlabel": "forward (m)", "ylabel": label} if vertical else
                    {"xlabel": label, "ylabel": "forward (m)"}))  # fmt: skip
        if vertical:
            axes.invert_yaxis()
    axes.legend(loc="best")
    save_figure(figure, path)


def _seen(points: Array, across: int) -> Array:
    """(N, 2) of the drawing: right and forward from above, forward and down from starboard."""
    return points[:, [0, 2]] if across == 2 else points[:, [1, 0]]


def _field_of_view(rig: Rig, name: str) -> tuple[Array, Array, Array]:
    """Place of a camera's front glass (3,), rays of its corners (4, 3), middle of the top (3,)."""
    camera, body_from_cam = rig.cameras[name], rig.body_from_cam(name)
    width, height = camera.width_px, camera.height_px
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, 0]], float)
    rays = body_from_cam.rotation.apply(camera.unproject(pixels)[1])
    return body_from_cam.apply(camera.front_cam), rays[:4], rays[4]
