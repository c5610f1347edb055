"""Gyroflow's lens profiles, of GoPros and other action cameras: starts of a calibration.

https://github.com/gyroflow/lens_profiles: JSON with OpenCV's numbers for one setting of a model of
camera, measured on another copy of it, in air. They are no calibration of the camera at hand: they
have a wide covariance, and a calibration that starts from one takes it as a weak prior.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from alice_survey.core.errors import CalibrationError
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.freedom import intrinsics
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Covariance, Rig

_FOCAL_SHARE, _CENTRE_SHARE, _DISTORTION = 0.03, 0.02, 0.05
"""Standard deviations between copies of a camera: of focal lengths over themselves, of the centre
over the width, of distortion terms. Far wider than any calibration."""
_KNOWN = {FisheyeLens.model: intrinsics("fisheye"), OpenCVLens.model: intrinsics("opencv5")}


class _Dimension(fields.FileModel):
    w: fields.Pixels
    h: fields.Pixels


class _Lens(fields.FileModel):
    camera_matrix: fields.Matrix33
    distortion_coeffs: fields.Numbers


class _LensProfile(fields.FileModel):
    calib_dimension: _Dimension
    fisheye_params: _Lens
    distortion_model: Literal["opencv_fisheye", "opencv_standard"] = "opencv_fisheye"
    digital_lens: Any = None
    input_horizontal_stretch: float = 1.0
    input_vertical_stretch: float = 1.0
    camera_brand: Any = ""
    camera_model: Any = ""
    lens_model: Any = ""


def read_gyroflow(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a profile, for the picture size it was measured at or one of the same shape.

    Raises:
        CalibrationError: a key is missing or wrong, or the camera's software bends the picture.
    """
    profile = _LensProfile.check(path, fields.read_json_values(path))
    if profile.digital_lens:
        raise CalibrationError(
            f"{path}: digital_lens bends the picture (SuperView, HyperView): use another"
        )
    for key in ("input_horizontal_stretch", "input_vertical_stretch"):
        if not np.isclose(getattr(profile, key), 1.0):
            raise CalibrationError(f"{path}: {key} is not 1: a stretched picture is not held")
    size, lens = (profile.calib_dimension.w, profile.calib_dimension.h), profile.fisheye_params
    kind = FisheyeLens if profile.distortion_model == "opencv_fisheye" else OpenCVLens
    where = f"{path}: fisheye_params.camera_matrix"
    camera = opencv_model.camera_of_matrix(
        where, lens.camera_matrix, lens.distortion_coeffs, size, kind
    )
    if reading.image_size is not None:
        width, height = reading.image_size
        if abs(width * size[1] - height * size[0]) > max(size):
            raise CalibrationError(
                f"{path}: is of {size[0]} x {size[1]} px: {width} x {height} has another shape"
            )
        smaller = camera.lens.downscale(size[0] / width)
        camera = replace(camera, width_px=width, height_px=height, lens=smaller)
    rig = rigs.assemble(path, reading, "Gyroflow", ["cam0"], [camera], rigs.ONE)
    words = f"{profile.camera_brand} {profile.camera_model} {profile.lens_model}".split()
    return replace(
        rig,
        source="start of a calibration: lens profile of "
        f"{' '.join(words)[:180] or path.name}, another camera",
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


def _refuse(path: Path, _: Rig) -> list[Path]:
    raise CalibrationError(f"{path}: lens profiles are read only: choose another --to")


def _owns(path: Path) -> bool:
    return path.suffix.lower() == ".json" and '"fisheye_params"' in fields.read_text(path)


FORMAT = rigs.CalibrationFormat(
    name="gyroflow",
    title="Gyroflow lens profile",
    holds=frozenset(),
    owns=_owns,
    read=read_gyroflow,
    write=_refuse,
)
