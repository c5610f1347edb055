"""Gyroflow's lens profiles, of GoPros and other action cameras: starts of a calibration.

https://github.com/gyroflow/lens_profiles: JSON with OpenCV's numbers for one setting of a model of
camera, measured on another copy of it, in air. They are no calibration of the camera at hand: they
have a wide covariance, and a calibration that starts from one takes it as a weak prior.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.formats.fields import Fields, read_json_fields
from camera_calib.formats.opencv_model import read_camera
from camera_calib.formats.rigs import ReadOptions, assemble
from camera_calib.freedom import intrinsics
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.rig import Covariance, Rig

KEY = "fisheye_params"
_FOCAL_SHARE, _CENTRE_SHARE, _DISTORTION = 0.03, 0.02, 0.05
"""Standard deviations between copies of a camera: of focal lengths over themselves, of the centre
over the width, of distortion terms. Far wider than any calibration."""
_KNOWN = {FisheyeLens.model: intrinsics("fisheye"), OpenCVLens.model: intrinsics("opencv5")}
_MODELS: Mapping[str, type[LensValues]] = {
    "opencv_fisheye": FisheyeLens,
    "opencv_standard": OpenCVLens,
}


def read_gyroflow(path: Path, reading: ReadOptions) -> Rig:
    """Read a profile, for the picture size it was measured at or one of the same shape.

    Raises:
        CalibrationError: a key is missing or wrong, or the camera's software bends the picture.
    """
    fields = read_json_fields(path)
    model = fields.text("distortion_model") if "distortion_model" in fields else "opencv_fisheye"
    if model not in _MODELS:
        raise fields.fault("distortion_model", f"is {model}; {' or '.join(_MODELS)} can be read")
    if fields.values.get("digital_lens"):
        raise fields.fault("digital_lens", "bends the picture (SuperView, HyperView): use another")
    for key in ("input_horizontal_stretch", "input_vertical_stretch"):
        if key in fields and not np.isclose(fields.number(key), 1.0):
            raise fields.fault(key, "is not 1: a picture that is stretched is not held")
    dimension = fields.fields("calib_dimension")
    size = dimension.size("w"), dimension.size("h")
    camera = read_camera(
        fields.fields(KEY), "camera_matrix", "distortion_coeffs", size, _MODELS[model]
    )
    if reading.image_size is not None:
        width, height = reading.image_size
        if abs(width * size[1] - height * size[0]) > max(size):
            raise CalibrationError(
                f"{path}: is of {size[0]} x {size[1]} px: {width} x {height} has another shape"
            )
        lens = camera.lens.reduced(size[0] / width)
        camera = replace(camera, width_px=width, height_px=height, lens=lens)
    rig = assemble(path, reading, "Gyroflow", ["cam0"], [camera], [RigidTransform.identity()])
    words = [_words(fields, key) for key in ("camera_brand", "camera_model", "lens_model")]
    named = " ".join(filter(None, words)) or path.name
    return replace(
        rig,
        source=f"start of a calibration: lens profile of {named}, another camera",
        covariance=_spread(rig),
    )


def _spread(rig: Rig) -> Covariance:
    """Covariance of the lenses between copies of a camera."""
    (name,) = rig.cameras
    camera = rig.cameras[name]
    pinhole = [_FOCAL_SHARE * camera.fx_px] * 2 + [_CENTRE_SHARE * camera.width_px] * 2
    fields = _KNOWN[camera.lens.model]
    sigmas = pinhole + [_DISTORTION] * (len(fields) - len(pinhole))
    return Covariance(
        parameters=tuple(f"{name}.{field}" for field in fields), matrix=np.diag(np.square(sigmas))
    )


def _words(fields: Fields, key: str) -> str:
    return " ".join(str(fields.values.get(key, "")).split())[:60]
