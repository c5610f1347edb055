"""The rig as built: close to its design, not equal to it.

Pictures are taken with this rig. Calibration must estimate it; a reconstruction never reads it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from camera_calib.camera import Camera
from camera_calib.rig import Rig, design_rig

_SEED_STREAM = 3400

FOCAL_TOLERANCE = 0.003
CENTRE_TOLERANCE_PX = 10.0
"""Largest error at full resolution."""
PORT_TOLERANCE_M = 0.001
TURN_TOLERANCE_RAD = np.deg2rad(0.3)
TILT_TOLERANCE = float(np.sin(np.deg2rad(0.3)))
"""Largest error of a port's normal, about each axis."""
_DISTORTION = {
    "opencv": {"k1": (-0.06, -0.04), "k2": (0.02, 0.05), "p1": (-3e-4, 3e-4), "p2": (-3e-4, 3e-4)},
    "fisheye": {"k1": (-0.03, -0.01), "k2": (0.0, 0.01), "k3": (-1e-3, 1e-3)},
}
"""Least and largest terms of lenses as they are made, by lens model."""
BASELINE_TOLERANCE_M = 0.0002


def true_rig(camera: CameraConfig, water: WaterConfig, *, scale: int, seed: int) -> Rig:
    """The rig of a survey with errors of manufacture, the same for pool and sea.

    Focal length, principal point, lens distortion, port distance and the port's normal of each
    camera differ from the design, and so does the pose of the right camera; the left camera's place
    on the vehicle, glass and indices do not.

    Args:
        camera: the design.
        water: the water it is in.
        scale: how many pixels of the sensor, each way, make one of a picture.
        seed: the survey's seed.
    """
    rng = np.random.default_rng([seed, _SEED_STREAM])
    design = design_rig(camera, water)
    cameras = {name: _build(drawn, rng).downscale(scale) for name, drawn in design.cameras.items()}
    turn = Rotation.from_rotvec(rng.uniform(-TURN_TOLERANCE_RAD, TURN_TOLERANCE_RAD, 3))
    shift = rng.uniform(-BASELINE_TOLERANCE_M, BASELINE_TOLERANCE_M, 3)
    cameras = {name: _tilt(built, rng) for name, built in cameras.items()}
    pose = design.cam_from_rig["right"]
    right = RigidTransform.from_components(pose.translation + shift, turn * pose.rotation)
    return replace(
        design,
        cameras=cameras,
        cam_from_rig={"left": design.cam_from_rig["left"], "right": right},
        source="truth of a simulated survey",
    )


def _build(camera: Camera, rng: np.random.Generator) -> Camera:
    focal = 1.0 + rng.uniform(-FOCAL_TOLERANCE, FOCAL_TOLERANCE)
    skew = 1.0 + rng.uniform(-1e-4, 1e-4)
    centre = rng.uniform(-CENTRE_TOLERANCE_PX, CENTRE_TOLERANCE_PX, 2)
    port = _shift(camera, camera.port.places, PORT_TOLERANCE_M, rng)
    port = {name: max(value, camera.port.minimum(name)) for name, value in port.items()}
    terms = {name: rng.uniform(*ends) for name, ends in _DISTORTION[camera.lens.model].items()}
    return camera.with_parameters(
        {
            "fx_px": camera.fx_px * focal,
            "fy_px": camera.fy_px * focal * skew,
            "cx_px": camera.cx_px + float(centre[0]),
            "cy_px": camera.cy_px + float(centre[1]),
            **terms,
            **port,
        }
    )


def _tilt(camera: Camera, rng: np.random.Generator) -> Camera:
    return camera.with_parameters(_shift(camera, camera.port.tilts, TILT_TOLERANCE, rng))


def _shift(
    camera: Camera, names: Sequence[str], tolerance: float, rng: np.random.Generator
) -> dict[str, float]:
    return {name: camera.parameter(name) + rng.uniform(-tolerance, tolerance) for name in names}
