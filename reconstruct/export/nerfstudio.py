"""nerfstudio's `transforms.json`: poses, pinholes and first points of a splat or a radiance field.

Its convention (docs.nerf.studio, "Data conventions"): camera to world, with the camera's x to the
right, y up and z backwards (OpenGL); the world's z up.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import write_json
from alice_survey.core.frames import Array
from reconstruct.ply import write_ply
from reconstruct.views.model import SparseModel, View

_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
                   ("red", "u1"), ("green", "u1"), ("blue", "u1")])  # fmt: skip
_GREY = 128


def write_nerfstudio(folder: Path, model: SparseModel, names: Mapping[str, str]) -> None:
    """Write `transforms.json` and `points.ply` of exported pictures.

    Args:
        folder: with `images/` and `masks/`.
        model: of the pictures.
        names: of the exported pictures, by those of the views.
    """
    points = np.zeros(len(model.points_world), _POINT)
    points["x"], points["y"], points["z"] = (model.points_world @ _ENU_FROM_NED.T).T
    points["red"] = points["green"] = points["blue"] = _GREY
    write_ply(folder / "points.ply", [points], ["sparse points: east, north, up"])
    frames = [
        {
            "file_path": f"images/{names[view.image]}",
            "mask_path": f"masks/{names[view.image]}.png",
            "fl_x": view.pinhole.fx_px,
            "fl_y": view.pinhole.fy_px,
            "cx": view.pinhole.cx_px,
            "cy": view.pinhole.cy_px,
            "w": view.pinhole.width_px,
            "h": view.pinhole.height_px,
            "transform_matrix": world_from_gl(view).tolist(),
        }
        for view in model.views
    ]
    write_json(
        folder / "transforms.json",
        {"camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames},
    )


def world_from_gl(view: View) -> Array:
    """(4, 4) pose of a view's camera in OpenGL's axes, in a world of east, north, up."""
    pose = np.eye(4)
    pose[:3, :3] = _ENU_FROM_NED @ view.world_from_cam.rotation.as_matrix() @ _OPENCV_FROM_OPENGL
    pose[:3, 3] = _ENU_FROM_NED @ view.world_from_cam.translation
    return pose
