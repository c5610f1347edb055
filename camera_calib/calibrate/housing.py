"""The calibration of a task: in air, or through the housing that is stated or that fits best.

A flat port makes focal lengths the water's index times longer than in air, a dome about its pupil
leaves them as they are. Where both calibrations exist, their ratio shows the housing at once. Else
each housing is calibrated in turn, and the noise that each leaves is compared, with a price for
every parameter (G. Schwarz 1978, "Estimating the dimension of a model").
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from alice_survey.core.errors import AliceError, CalibrationError
from alice_survey.core.frames import Array
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.options import AUTO, CalibrationTask
from camera_calib.calibrate.solve import (
    blank_camera,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
    first_cameras,
)
from camera_calib.calibrate.start import same_numbering
from camera_calib.calibration import Calibration, HousingTrial, TargetView
from camera_calib.camera import Camera
from camera_calib.freedom import LensNames, lens_of
from camera_calib.optics import PORTS, likely_port
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig
from camera_calib.target_shape import shape_of


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
        cameras = task.cameras(found.sizes, task.ports)
        start = None if task.start is None else replace(task.start, cameras=cameras)
        shape = shape_of(task.target, task.target_shape)
        views = _number_alike(task, found, cameras)
        return calibrate_in_air(views, task.target.points, found.sizes, task.lenses, start, shape)
    ratios: dict[str, float] = {}
    if task.start is not None:
        views = _number_alike(task, found, task.start.cameras)
        ratios = focal_ratios(views, task.target.points, task.start, task.lenses)
    if AUTO in task.ports.values():
        calibration = _likeliest(task, found)
    else:
        try:
            calibration = _through(task, found, task.ports)
        except CalibrationError as error:
            raise CalibrationError(f"{error}{_other_housing(ratios, task.ports)}") from None
    return replace(calibration, housing=replace(calibration.housing, focal_ratios=ratios))


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


def _number_alike(
    task: CalibrationTask, found: Detections, cameras: Mapping[str, Camera]
) -> Sequence[TargetView]:
    """Views whose points all cameras number alike."""
    if not task.target.is_ambiguous or len(cameras) < 2:
        return found.views
    points = task.target.points
    if task.start is None:
        cameras = first_cameras(found.views, points, cameras, task.lenses)
    return same_numbering(cameras, found.views, points, task.target.symmetries)


def _through(task: CalibrationTask, found: Detections, kinds: Mapping[str, str]) -> Calibration:
    """The calibration under water through ports of the named kinds."""
    points, shape = task.target.points, shape_of(task.target, task.target_shape)
    cameras = task.cameras(found.sizes, kinds)
    views, sigmas = _number_alike(task, found, cameras), task.sigmas_of(cameras)
    if task.start is None:
        return calibrate_in_water_alone(views, points, cameras, task.lenses, sigmas, shape)
    start = replace(task.start, cameras=cameras)
    return calibrate_through_ports(views, points, start, task.known, task.lenses, sigmas, shape)


def _likeliest(task: CalibrationTask, found: Detections) -> Calibration:
    """The calibration through the likeliest housing, with how the others did."""
    trials, calibrations = [], {}
    for kind in PORTS:
        try:
            calibrations[kind] = _through(task, found, dict.fromkeys(found.sizes, kind))
        except AliceError as error:
            trials.append(
                HousingTrial(port=kind, noise_px=math.nan, criterion=math.inf, why=str(error))
            )
            continue
        trials.append(judge_housing(kind, calibrations[kind]))
    best = min(trials, key=lambda trial: trial.criterion).port
    if best not in calibrations:
        reasons = "; ".join(f"{trial.port}: {trial.why}" for trial in trials)
        raise CalibrationError(f"no housing fits the views: {reasons}")
    chosen = calibrations[best]
    return replace(chosen, housing=replace(chosen.housing, trials=tuple(trials), chosen=best))


def judge_housing(kind: str, found: Calibration) -> HousingTrial:
    """How well views fit one kind of port; fewer parameters are likelier at the same noise."""
    coordinates = 2 * int(np.isfinite(found.residuals_px[..., 0]).sum())
    parameters = 0 if found.rig.covariance is None else len(found.rig.covariance.parameters)
    criterion = 2.0 * coordinates * math.log(found.noise_px) + parameters * math.log(coordinates)
    return HousingTrial(port=kind, noise_px=found.noise_px, criterion=criterion, why="")


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
