"""The calibration of a task: in air, or through the housing that is stated.

A flat port makes focal lengths the water's index times longer than in air, a dome about its pupil
leaves them as they are. Where both calibrations exist, their ratio shows a wrong housing at once.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.options import CalibrationTask
from camera_calib.calibrate.solve import (
    blank_camera,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
    first_cameras,
)
from camera_calib.calibration import Calibration, TargetView
from camera_calib.freedom import LensNames, lens_of
from camera_calib.optics import likely_port
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig


def calibrate_task(task: CalibrationTask, found: Detections) -> Calibration:
    """The calibration that options ask for.

    Args:
        task: what is known before.
        found: views of its target.

    Raises:
        CalibrationError: the views do not determine it, or are not of the start's cameras.
    """
    _check_sizes(task, found)
    if not task.water:
        cameras = task.cameras(found.sizes)
        start = None if task.start is None else replace(task.start, cameras=cameras)
        points = task.target.points
        return calibrate_in_air(found.views, points, found.sizes, task.lenses, start, task.shape)
    ratios: dict[str, float] = {}
    if task.start is not None:
        ratios = focal_ratios(found.views, task.target.points, task.start, task.lenses)
    try:
        calibration = _through(task, found)
    except CalibrationError as error:
        raise CalibrationError(f"{error}{_other_housing(ratios, task.ports)}") from None
    return replace(calibration, focal_ratios=ratios)


def _check_sizes(task: CalibrationTask, found: Detections) -> None:
    """Check that pictures are as large as those that the start was calibrated from.

    Raises:
        CalibrationError: they are not.
    """
    for name, camera in ({} if task.start is None else task.start.cameras).items():
        if (camera.width_px, camera.height_px) != found.sizes[name]:
            width, height = found.sizes[name]
            raise CalibrationError(
                f"pictures of {name} have {width} x {height} px, the start's camera "
                f"{camera.width_px} x {camera.height_px}"
            )


def _through(task: CalibrationTask, found: Detections) -> Calibration:
    """The calibration under water."""
    points, views, shape = task.target.points, found.views, task.shape
    cameras = task.cameras(found.sizes)
    sigmas = task.sigmas_of(cameras)
    if task.start is None:
        return calibrate_in_water_alone(views, points, cameras, task.lenses, sigmas, shape)
    start = replace(task.start, cameras=cameras)
    return calibrate_through_ports(views, points, start, task.known, task.lenses, sigmas, shape)


def focal_ratios(
    views: Sequence[TargetView], points: Array, in_air: Rig, lens: LensNames
) -> dict[str, float]:
    """Focal lengths under water, as if without a housing, over those in air, by camera.

    Args:
        views: under water.
        points: (N, 3) of the target, metres.
        in_air: calibrated in air.
        lens: name of a lens model, of all cameras or by camera.
    """
    blank = {
        name: blank_camera((camera.width_px, camera.height_px), lens_of(lens, name))
        for name, camera in in_air.cameras.items()
    }
    found = first_cameras(views, points, blank, lens)
    return {
        name: math.sqrt(
            camera.fx_px * camera.fy_px / (in_air.cameras[name].fx_px * in_air.cameras[name].fy_px)
        )
        for name, camera in found.items()
    }


def _other_housing(ratios: Mapping[str, float], kinds: Mapping[str, str]) -> str:
    """What focal lengths say against the ports, for the end of a message."""
    for name, ratio in ratios.items():
        likely = likely_port(ratio)
        if FlatPort.shape in (likely, kinds[name]) and likely != kinds[name]:
            return (
                f"; focal lengths of {name} under water are {ratio:.3f} times those in air, which "
                f"says --port {likely}"
            )
    return ""
