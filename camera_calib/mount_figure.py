"""A drawing of a rig on its vehicle: from above, and from starboard."""

from collections.abc import Mapping
from itertools import product

import numpy as np

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from alice_survey.kit.figure import (
    INK,
    INKS,
    MARKS,
    SOFT,
    Axes,
    plain_name,
)
from camera_calib.rig import Rig

_RAY_SHARE = 0.6
"""Length of rays over the size of what is drawn."""
_MIN_M = 0.3
_FROM_ABOVE, _FROM_STARBOARD = [1, 0], [0, 2]
"""Axes of the vehicle (forward, right, down) that each drawing has to the right and upright."""

_Field = tuple[Array, Array, Array]


def paint_mount(above: Axes, side: Axes, rig: Rig) -> None:
    """Draw a rig's cameras on two axes: from above, and from starboard.

    Raises:
        CalibrationError: its mount is unknown.
    """
    if rig.body_from_rig is None:
        raise CalibrationError("nothing is drawn: the rig's mount is unknown")
    fields = {name: _field_of_view(rig, name) for name in rig.cameras}
    places = np.stack([field[0] for field in fields.values()])
    reach = _RAY_SHARE * max(float(np.abs(places).max()), _MIN_M)
    _paint(above, fields, reach, _FROM_ABOVE)
    _paint(side, fields, reach, _FROM_STARBOARD)
    above.set(title="from above", xlabel="right (m)", ylabel="forward (m)")
    side.set(title="from starboard", xlabel="forward (m)", ylabel="down (m)")
    side.invert_yaxis()


def _paint(axes: Axes, fields: Mapping[str, _Field], reach: float, shown: list[int]) -> None:
    """Draw cameras by the two axes of the vehicle that are shown; rays have length `reach`, m."""
    styles = product(MARKS, INKS)  # so that cameras of the same ink differ
    for (mark, ink), (name, (place, corners, top)) in zip(styles, fields.items(), strict=False):
        at, rim = place[shown], (place + reach * corners)[:, shown]
        axes.plot(*np.vstack([rim, rim[:1]]).T, color=ink, lw=1.0)
        for corner in rim:
            axes.plot(*np.stack([at, corner]).T, color=ink, lw=0.6)
        axes.plot(*at, mark, color=ink, ms=5, label=plain_name(name))
        edge = (place + reach * top)[shown]
        axes.annotate("top", edge, color=ink, ha="center", va="center", fontsize=8)
    axes.plot(0, 0, "+", color=INK, ms=11, mew=1.5)
    axes.annotate("navigation", (0, 0), xytext=(6, -12), textcoords="offset points", color=INK)
    bow = np.array([0.8 * reach, 0.0, 0.0])[shown]
    axes.annotate("", bow, (0, 0), arrowprops={"arrowstyle": "->", "color": SOFT})
    axes.annotate("bow", bow, xytext=(4, 4), textcoords="offset points", color=SOFT)
    axes.set_aspect("equal")


def _field_of_view(rig: Rig, name: str) -> _Field:
    """Place of a camera's front glass (3,), rays of its corners (4, 3), middle of the top (3,)."""
    camera, body_from_cam = rig.cameras[name], rig.body_from_cam(name)
    width, height = camera.width_px, camera.height_px
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, 0]], float)
    rays = body_from_cam.rotation.apply(camera.unproject(pixels)[1])
    return body_from_cam.apply(camera.front_cam), rays[:4], rays[4]
