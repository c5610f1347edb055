"""A small cloud of many nodes, as the dense stage would write it."""

from pathlib import Path

import numpy as np
import pytest

from reconstruct import copc
from reconstruct.copc import PointSpool, write_copc
from reconstruct.dense.cloud import VERTEX, las_header, las_points
from reconstruct.views.model import WorldFrame

STEP_M = 1e-4
SPACING_M = 0.02


def rippled(length_m: float, width_m: float) -> np.ndarray:
    """(N, 3) points of a rippled floor about zero."""
    x, y = np.meshgrid(
        np.arange(-length_m / 2, length_m / 2, SPACING_M),
        np.arange(-width_m / 2, width_m / 2, SPACING_M),
    )
    z = 0.05 * np.sin(9 * x) * np.cos(7 * y)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def deep_cloud(path: Path, enu: np.ndarray, *, leaf: int = 400) -> Path:
    """Write a cloud with few points in each node.

    Args:
        path: of the file.
        enu: (N, 3) points; their colours go from green in the west to red in the east.
        leaf: most points of a node that has no children, about.
    """
    vertices = np.zeros(len(enu), VERTEX)
    middle = enu.mean(axis=0).round(1)
    vertices["x"], vertices["y"], vertices["z"] = (enu - middle).T
    vertices["nz"] = 1.0
    share = (enu[:, 0] - enu[:, 0].min()) / np.ptp(enu[:, 0])
    vertices["red"], vertices["green"] = 40 + 200 * share, 240 - 200 * share
    vertices["sigma"] = np.linspace(0.001, 0.002, len(enu))
    frame = WorldFrame(name="ned", datum=None, scaled=True, vertical_datum="sea surface")
    header = las_header(middle, frame)
    spool = PointSpool.of(path.with_name("scratch"), header, SPACING_M)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(copc, "_GRID_BITS", 4)
        patch.setattr(copc, "_LEAF_POINTS", leaf)
        write_copc(path, header, spool, [spool.add("0", las_points(vertices, header).array)])
    return path
