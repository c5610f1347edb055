"""What control says to picks at once, before the model is placed again.

Residuals of two placements: where the model lies now, and where the control points put it (a shift,
a turn and a scale; the scale is held where a rig gave it). What navigation and soft modes take of a
misfit shows in the next reconstruction only.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.placing.alignment import Similarity
from reconstruct.placing.control import ControlFit, tie_control
from reconstruct.placing.control_points import Control, TriangulatedPoint
from reconstruct.views.model import WorldFrame


def preview_control(
    control: Control,
    points: Mapping[str, TriangulatedPoint],
    lost: Mapping[str, str],
    frame: WorldFrame,
) -> dict[str, Any]:
    """Residuals of control points and bars.

    Args:
        control: what is known.
        points: where the model has its points.
        lost: why it has not others.
        frame: of the model.

    Returns:
        JSON values: `now` and `fitted`, each as `sparse/control.json` or None where there is no
        such placement, and `not_found` by name.
    """
    datum = frame.datum if frame.datum is not None else control.datum()
    ties = tie_control(control, points, lost, datum)
    still = Similarity(scale=1.0, rotation=Rotation.identity(), translation=np.zeros(3))
    start = ties.start(1.0 if frame.scaled else None)
    return {
        "now": ties.score(still, located=frame.name == "ned").to_json() if _says(ties) else None,
        "fitted": None if start is None else ties.score(start, located=True).to_json(),
        "not_found": dict(ties.lost),
    }


def _says(ties: ControlFit) -> bool:
    return bool(ties.ties or ties.bars)
