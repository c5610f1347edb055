"""Which housing a camera looks through: a flat port, a dome, or none that bends light.

A flat port makes focal lengths the water's index times longer than in air, a dome about its pupil
leaves them as they are. Where both calibrations exist, their ratio shows the housing at once. Else
each housing is calibrated in turn, and the noise that each leaves is compared, with a price for
every parameter (G. Schwarz 1978, "Estimating the dimension of a model").
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from alice_survey.core.errors import AliceError, CalibrationError
from alice_survey.core.frames import Array
from camera_calib.calibrate.solve import blank_camera, first_cameras
from camera_calib.calibration import Calibration, HousingJudgement, HousingTrial, TargetView
from camera_calib.freedom import LensNames, lens_of
from camera_calib.ports.dome import DomePort
from camera_calib.ports.none import NoPort
from camera_calib.rig import Rig

_ALIKE = 1.01
"""Noise over the least one, below which a housing explains the views as well."""


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


def compare_housings(calibrations: Mapping[str, Callable[[], Calibration]]) -> Calibration:
    """Calibrate every housing, and return the likeliest with how the others did.

    Args:
        calibrations: by the name of the port.

    Raises:
        CalibrationError: none of them is determined by the views.
    """
    trials, found = [], {}
    for name, calibrate in calibrations.items():
        try:
            found[name] = calibrate()
        except AliceError as error:
            failed = HousingTrial(port=name, noise_px=math.nan, criterion=math.inf, why=str(error))
            trials.append(failed)
            continue
        trials.append(_trial(name, found[name]))
    if not found:
        reasons = "; ".join(f"{trial.port}: {trial.why}" for trial in trials)
        raise CalibrationError(f"no housing fits the views: {reasons}")
    best = min(trials, key=lambda trial: trial.criterion)
    chosen = found[best.port]
    return replace(chosen, housing=replace(chosen.housing, trials=tuple(trials), chosen=best.port))


def _trial(name: str, found: Calibration) -> HousingTrial:
    coordinates = 2 * int(np.isfinite(found.residuals_px[..., 0]).sum())
    parameters = 0 if found.rig.covariance is None else len(found.rig.covariance.parameters)
    criterion = 2.0 * coordinates * math.log(found.noise_px) + parameters * math.log(coordinates)
    return HousingTrial(port=name, noise_px=found.noise_px, criterion=criterion, why="")


def housing_lines(housing: HousingJudgement) -> list[str]:
    """What was compared, one line; nothing where nothing was."""
    if not housing.trials:
        return []
    shown = [
        f"{trial.port} {trial.noise_px:.4g} px" if not trial.why else f"{trial.port}: {trial.why}"
        for trial in housing.trials
    ]
    minimum = min(trial.noise_px for trial in housing.trials if not trial.why)
    alike = [trial.port for trial in housing.trials if trial.noise_px < _ALIKE * minimum]
    lines = [f"housing {housing.chosen}: noise with {', '.join(shown)}"]
    if set(alike) == {NoPort.shape, DomePort.shape}:
        lines.append("a dome about the pupil and no port are the same camera: both fit alike")
    elif len(alike) > 1:
        lines.append(
            f"{', '.join(alike)} fit alike: --start with a calibration in air tells them apart"
        )
    return lines
