"""Rigs behind ports as rigs without: the best camera of one centre in water, and its price."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from scipy.spatial.transform import RigidTransform

from alice_survey.base.errors import CalibrationError
from camera_calib.approximation.residual import COLMAP_PARAMETERS, Residual, approximations
from camera_calib.flat_port import FlatPortCamera
from camera_calib.formats.opencv_model import IN_AIR
from camera_calib.rig import Rig

MODELS = ("OPENCV", "FULL_OPENCV")


@dataclass(frozen=True, kw_only=True)
class Price:
    """What a stand-in without port costs against the exact camera."""

    model: str
    near_m: float
    far_m: float
    rms_px: float
    max_px: float

    def __str__(self) -> str:
        return (
            f"{self.model} for {self.near_m:g} to {self.far_m:g} m of water misses the exact "
            f"camera by {self.rms_px:.3f} px rms, {self.max_px:.3f} px at most"
        )


def in_water(rig: Rig, near_m: float, far_m: float, model: str) -> tuple[Rig, Mapping[str, Price]]:
    """The rig that other software can use under water without knowing of ports.

    Each camera is the best fit, over the frame and the interval of distances, of a camera with
    distortion that absorbs the refraction; its centre lies beside the entrance pupil, and the poses
    in the rig and on the vehicle follow it.

    Args:
        rig: exact.
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.
        model: one of `MODELS`.

    Returns:
        The rig, whose cameras are as in air and without covariance, and the price by camera.

    Raises:
        CalibrationError: the model is none of these, or a part of a frame sees nothing.
        ConfigError: the interval is empty or reaches into a port.
    """
    if model not in MODELS:
        raise CalibrationError(f"model {model}: {' or '.join(MODELS)} wanted")
    found = {
        name: _of_model(approximations(camera, near_m, far_m), model)
        for name, camera in rig.cameras.items()
    }
    cameras = {name: _stand_in(rig.cameras[name], fit) for name, fit in found.items()}
    poses = {name: _from_cam(fit) * rig.cam_from_rig[name] for name, fit in found.items()}
    prices = {
        name: Price(model=model, near_m=near_m, far_m=far_m, rms_px=fit.rms_px, max_px=fit.max_px)
        for name, fit in found.items()
    }
    source = f"{rig.source}; best {model} in water, {near_m:g} to {far_m:g} m"
    return (
        replace(rig, cameras=cameras, cam_from_rig=poses, source=source, covariance=None),
        prices,
    )


def _of_model(every: list[Residual], model: str) -> Residual:
    unwarped = (fit for fit in every if fit.stand_in.warped_at_m is None)
    return next(fit for fit in unwarped if fit.stand_in.model == model)


def _stand_in(camera: FlatPortCamera, fit: Residual) -> FlatPortCamera:
    stand_in = fit.stand_in
    values = dict(zip(COLMAP_PARAMETERS[stand_in.model], stand_in.params, strict=True))
    fx, fy, cx, cy = (values.pop(name) for name in ("fx", "fy", "cx", "cy"))
    return FlatPortCamera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        **{**values, **IN_AIR},
    )


def _from_cam(fit: Residual) -> RigidTransform:
    turn = fit.stand_in.approx_from_cam
    return RigidTransform.from_components(-turn.apply(fit.stand_in.centre_m), turn)
