"""Slow, obvious twins of the imaging settings."""

import math

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import Polygon

from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.rig import Rig
from tests.oracles_camera import project_by_bisection


def traced_spot(camera: Camera, x_px: float, y_px: float, altitude_m: float) -> Array:
    """Where a pixel of a lens without distortion, square to its port, meets a level floor."""
    x, y = (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px
    out = math.hypot(x, y)
    sine = out / math.sqrt(1.0 + out * out)
    reach = 0.0
    for thickness, index in (
        (camera.parameter("port_distance_m"), 1.0),
        (camera.parameter("glass_thickness_m"), camera.parameter("n_glass")),
        (altitude_m, camera.n_water),
    ):
        reach += thickness * math.tan(math.asin(sine / index))
    return reach / max(out, 1e-12) * np.array([x, y])


def traced_footprint(camera: Camera, altitude_m: float, shift_across_m: float) -> Polygon:
    """The footprint, x across and y along, of a camera moved across."""
    w, h = camera.width_px, camera.height_px
    t = np.linspace(0.0, 1.0, 40, endpoint=False)
    border = [(w * s, 0.0) for s in t] + [(w, h * s) for s in t]
    border += [(w * (1 - s), h) for s in t] + [(0.0, h * (1 - s)) for s in t]
    spots = [traced_spot(camera, x, y, altitude_m) for x, y in border]
    return Polygon([(x + shift_across_m, y) for x, y in spots])


def moved_pixel(rig: Rig, point_body: Array, velocity: Array, rates: Array, time_s: float) -> Array:
    """Pixel of a spot of the floor after the vehicle moved and turned for a while, (2,)."""
    name = rig.reference
    turned = RigidTransform.from_components(velocity * time_s, Rotation.from_rotvec(rates * time_s))
    body_point = turned.inv().apply(point_body)
    return project_by_bisection(rig.cameras[name], rig.body_from_cam(name).inv().apply(body_point))


def blur_circle_px(focal_m: float, f_number: float, pixel_m: float, s: float, d: float) -> float:
    """Blur circle on the sensor of a lens focused at s of a point at d: images, then triangles."""
    sensor = 1.0 / (1.0 / focal_m - 1.0 / s)
    image = 1.0 / (1.0 / focal_m - 1.0 / d)
    return focal_m / f_number * abs(image - sensor) / image / pixel_m
