"""Correct the colours of picture files for the dispersion of water and port."""

import io
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from alice_survey.core.errors import CalibrationError, ImageError
from alice_survey.core.executor import SERIAL, Executor
from camera_calib.approximation.dispersion import (
    Maps,
    channel_cameras,
    channel_maps,
    frame_shifts,
    shifts_report,
    undisperse,
)
from camera_calib.camera import Camera
from camera_calib.picture_files import is_cut_short, read_pixels
from camera_calib.rig import read_rig
from camera_calib.water import WAVELENGTH_NM

_JPEG_QUALITY = 95
_Cameras = tuple[tuple[str, Camera], ...]
_Job = tuple[Path, Path, _Cameras, float]


def undisperse_files(
    pictures: Sequence[Path],
    folder: Path,
    *,
    rig: Path,
    camera: str | None = None,
    range_m: float,
    temperature_c: float,
    salinity_psu: float,
    depth_m: float,
    glass: str = "bk7",
    wavelengths_nm: Sequence[float] | None = None,
    executor: Executor = SERIAL,
) -> tuple[str, dict[str, Any]]:
    """Warp red and blue onto green in pictures, and write them under their names to a folder.

    Args:
        pictures: colour pictures of 8 or 16 bits of one camera, whole or reduced by a whole number.
        folder: for the corrected ones; made when missing.
        rig: `rig.json`; its indices hold for green.
        camera: whose pictures these are; the rig's first when not given.
        range_m: from the entrance pupil to the scene, along the axis.
        temperature_c: temperature of the water.
        salinity_psu: salinity of the water.
        depth_m: depth of the camera below the surface.
        glass: material of the port, one of `glass.GLASSES`.
        wavelengths_nm: of red, green and blue; the middle of their bands when not given.
        executor: where tasks run.

    Returns:
        The size of the shifts as text and as JSON values.

    Raises:
        ImageError: a picture is missing, has no colour or another size, or would be overwritten.
        CalibrationError: the rig cannot be read, lacks the camera, or does not cover the frame.
        ConfigError: water or glass are out of range.
    """
    cameras = read_rig(rig).cameras
    name = next(iter(cameras)) if camera is None else camera
    if name not in cameras:
        raise CalibrationError(f"{rig}: no camera {name!r}; it has {', '.join(cameras)}")
    if cameras[name].n_water == 1.0:
        raise CalibrationError(
            f"{rig}: {name} is calibrated in air (n_water 1), where colours do not part: give the "
            "rig under water"
        )
    channels = channel_cameras(
        cameras[name],
        temperature_c=temperature_c,
        salinity_psu=salinity_psu,
        depth_m=depth_m,
        glass=glass,
        wavelengths_nm=wavelengths_nm or WAVELENGTH_NM.tolist(),
    )
    text, data = shifts_report(frame_shifts(channels, range_m), range_m)
    targets = _targets(pictures, folder)
    folder.mkdir(parents=True, exist_ok=True)
    items = tuple(channels.items())
    jobs: list[_Job] = [
        (source, target, items, range_m) for source, target in zip(pictures, targets, strict=True)
    ]
    written = list(executor.map(_undisperse_file, jobs, label="colours"))
    data = {"camera": name, **data, "pictures": [path.name for path in written]}
    return f"{text}\n{len(written)} pictures of {name} corrected in {folder}", data


def _targets(pictures: Sequence[Path], folder: Path) -> list[Path]:
    names = [path.name for path in pictures]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ImageError(f"two pictures are named {twice}: correct them into folders of their own")
    targets = [folder / name for name in names]
    for source, target in zip(pictures, targets, strict=True):
        if not source.is_file():
            raise ImageError(f"{source}: no such picture")
        if target.exists() and target.samefile(source):
            raise ImageError(f"{source}: would be overwritten; give another folder")
        if target.exists():
            raise ImageError(f"{target} exists: give another folder, or remove it")
    return targets


def _undisperse_file(job: _Job) -> Path:
    """Correct one file; the warp is kept from picture to picture."""
    source, target, cameras, range_m = job
    if is_cut_short(source):
        raise ImageError(f"{source}: the file is cut short: copy it again, or leave it out")
    stored = read_pixels(source, cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise ImageError(f"{source}: cannot be read as a picture")
    if stored.ndim != 3 or stored.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{source}: needs three colours of 8 or 16 bits to correct")
    maps = _maps(cameras, range_m, stored.shape[1], stored.shape[0])
    if maps is None:
        green = dict(cameras)["green"]
        raise ImageError(
            f"{source}: {stored.shape[1]} x {stored.shape[0]} px, but the camera has "
            f"{green.width_px} x {green.height_px}"
        )
    corrected = stored.copy()  # blue, green, red and maybe a mask
    corrected[..., :3] = undisperse(stored[..., 2::-1], maps)[..., ::-1]
    target.write_bytes(_encode(corrected, source))
    return target


@lru_cache(maxsize=1)
def _maps(cameras: _Cameras, range_m: float, width_px: int, height_px: int) -> Maps | None:
    green = dict(cameras)["green"]
    scale = round(green.width_px / width_px)
    if scale < 1 or (green.width_px // scale, green.height_px // scale) != (width_px, height_px):
        return None
    return channel_maps({name: camera.reduced(scale) for name, camera in cameras}, range_m)


def _encode(picture: NDArray[Any], source: Path) -> bytes:
    """The picture in the format of its source; a JPEG keeps its EXIF, with time and position."""
    if source.suffix.lower() in (".jpg", ".jpeg"):
        buffer = io.BytesIO()
        with Image.open(source) as original:
            kept = {
                key: original.info[key] for key in ("exif", "icc_profile") if key in original.info
            }
        rgb = np.ascontiguousarray(picture[..., 2::-1])
        Image.fromarray(rgb).save(buffer, "JPEG", quality=_JPEG_QUALITY, subsampling=0, **kept)
        return buffer.getvalue()
    done, encoded = cv2.imencode(source.suffix, picture)
    if not done:
        raise ImageError(f"{source}: pictures of this format cannot be written")
    return bytes(encoded.tobytes())
