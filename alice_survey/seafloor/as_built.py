"""The rig as built: close to its design, not equal to it.

Pictures are taken with this rig. Calibration must estimate it; a reconstruction never reads it.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.config import CameraConfig, WaterConfig
from camera_calib.flat_port import FlatPortCamera
from camera_calib.rig import Rig, design_rig

_SEED_STREAM = 3400

FOCAL_TOLERANCE = 0.003
CENTRE_TOLERANCE_PX = 10.0
"""Largest error at full resolution."""
PORT_TOLERANCE_M = 0.001
TURN_TOLERANCE_RAD = np.deg2rad(0.3)
TILT_TOLERANCE = float(np.sin(np.deg2rad(0.3)))
"""Largest error of a port's normal, about each axis."""
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
    cameras = {name: _built(drawn, rng).reduced(scale) for name, drawn in design.cameras.items()}
    turn = Rotation.from_rotvec(rng.uniform(-TURN_TOLERANCE_RAD, TURN_TOLERANCE_RAD, 3))
    shift = rng.uniform(-BASELINE_TOLERANCE_M, BASELINE_TOLERANCE_M, 3)
    cameras = {name: _tilted(built, rng) for name, built in cameras.items()}
    pose = design.cam_from_rig["right"]
    right = RigidTransform.from_components(pose.translation + shift, turn * pose.rotation)
    return replace(
        design,
        cameras=cameras,
        cam_from_rig={"left": design.cam_from_rig["left"], "right": right},
        source="truth of a simulated survey",
    )


def _built(camera: FlatPortCamera, rng: np.random.Generator) -> FlatPortCamera:
    focal = 1.0 + rng.uniform(-FOCAL_TOLERANCE, FOCAL_TOLERANCE)
    skew = 1.0 + rng.uniform(-1e-4, 1e-4)
    centre = rng.uniform(-CENTRE_TOLERANCE_PX, CENTRE_TOLERANCE_PX, 2)
    port_m = camera.port_distance_m + rng.uniform(-PORT_TOLERANCE_M, PORT_TOLERANCE_M)
    return replace(
        camera,
        fx_px=camera.fx_px * focal,
        fy_px=camera.fy_px * focal * skew,
        cx_px=camera.cx_px + float(centre[0]),
        cy_px=camera.cy_px + float(centre[1]),
        k1=rng.uniform(-0.06, -0.04),
        k2=rng.uniform(0.02, 0.05),
        p1=rng.uniform(-3e-4, 3e-4),
        p2=rng.uniform(-3e-4, 3e-4),
        port_distance_m=max(port_m, 0.0),
    )


def _tilted(camera: FlatPortCamera, rng: np.random.Generator) -> FlatPortCamera:
    x, y = camera.normal[:2] + rng.uniform(-TILT_TOLERANCE, TILT_TOLERANCE, 2)
    return camera.with_parameters({"normal_x": float(x), "normal_y": float(y)})
