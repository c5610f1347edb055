"""Calibrations of every format that is read, pictures and videos of every kind, and targets."""

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.executor import SERIAL
from camera_calib.calibrate.detect_views import detect_views
from camera_calib.calibrate.picture_sets import PictureSet
from camera_calib.camera import Camera
from camera_calib.formats.convert import FORMATS, detect
from camera_calib.formats.rigs import ReadOptions, in_air, only
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.picture_files import without_orientation
from camera_calib.ports.dome import DomePort
from camera_calib.rig import Rig, design_rig, read_rig
from camera_calib.targets.target import parse_target, read_target, write_target
from missions.exposure.gain import read_linear
from reconstruct.pictures.files import bits_used, exif_focal_px, inspect
from reconstruct.pictures.normalise import even_light, finely, read_deep
from reconstruct.pictures.undistorted import read_colour, read_mask
from reconstruct.pictures.videos import read_fixes, video_start
from tests.cameras import flat_port_camera
from tests.fuzz.target import Target
from tests.reconstruct.pictures import gopro
from tests.reconstruct.pictures.test_importing import write_dng

_SIZE = (48, 32)


def small_rig() -> Rig:
    """Two cameras behind ports, as drawn."""
    return design_rig(CameraConfig(), WaterConfig(), scale=4)


def _in_air() -> Rig:
    """Two cameras that formats without ports can hold."""
    lens = flat_port_camera(
        width_px=640, height_px=480, fx_px=500.0, fy_px=501.0, cx_px=320.0, cy_px=240.0,
        k1=-0.1, k2=0.01, p1=1e-3, p2=-1e-3, n_water=1.0,
    )  # fmt: skip
    rig = small_rig()
    return replace(rig, cameras=dict.fromkeys(rig.cameras, lens))


def _domes() -> Rig:
    """Two fisheyes behind domes."""
    lens = FisheyeLens(fx_px=300.0, fy_px=301.0, cx_px=320.0, cy_px=240.0, k1=0.02, k4=0.001)
    port = DomePort(dome_z_m=0.005, outer_radius_m=0.06, glass_thickness_m=0.006)
    camera = Camera(width_px=640, height_px=480, lens=lens, port=port)
    rig = small_rig()
    return replace(rig, cameras=dict.fromkeys(rig.cameras, camera))


def _one() -> Rig:
    """One fisheye in air."""
    return only(in_air(_domes()), "left")


def _write(name: str, rig: Callable[[], Rig], file: str = "") -> Callable[[Path], None]:
    """Writer of a calibration to the path of a file, or where it is in the folder above that."""

    def build(path: Path) -> None:
        FORMATS[name].write(path.parent.parent / file if file else path, rig())

    return build


def read_calibration(path: Path) -> object:
    """As `camera convert` and `calibrate --from`: of whatever format it looks like."""
    return detect(path).read(path, ReadOptions(image_size=(640, 480), camera="1"))


def _read_folder(path: Path) -> object:
    return read_calibration(path.parent)


def _board(path: Path) -> None:
    write_target(path, parse_target("charuco 12x9 40mm 30mm"))


def read_board(path: Path) -> object:
    return read_target(path).points


def _pixels(channels: int, kind: type) -> Any:
    shape = (_SIZE[1], _SIZE[0], channels) if channels > 1 else (_SIZE[1], _SIZE[0])
    maximum = np.iinfo(kind).max
    return np.random.default_rng(3).integers(0, maximum, shape, endpoint=True).astype(kind)


def picture(path: Path, mode: str = "RGB", **more: Any) -> Path:
    """A small picture with the EXIF of a camera that had GPS."""
    bands = len(Image.new(mode, (1, 1)).getbands())
    image = Image.frombytes(mode, _SIZE, _pixels(bands, np.uint8).tobytes())
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2024:05:01 12:00:00", 0x9291: "25", 0xA405: 35})
    exif.get_ifd(0x8825).update(
        {1: "N", 2: (60.0, 6.0, 1.5), 3: "E", 4: (5.0, 15.0, 2.5), 5: b"\x01", 6: 12.5}
    )
    image.save(path, exif=exif, **more)
    return path


def _deep(path: Path) -> None:
    cv2.imwrite(str(path), _pixels(3, np.uint16) >> 4)


def _chessboard(path: Path) -> None:
    """9 x 6 inner corners, 16 px apart, with a white edge."""
    y, x = np.mgrid[0:144, 0:192] // 16
    dark = (x % 2 == y % 2) & (x > 0) & (x < 11) & (y > 0) & (y < 8)
    cv2.imwrite(str(path), np.where(dark, 20, 230).astype(np.uint8))


def png_of(width: int, height: int, depth: int = 8, colour: int = 2, body: bytes = b"") -> bytes:
    """A PNG that states a size, whatever it holds."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", body or zlib.compress(bytes(1000)))
    return b"\x89PNG\r\n\x1a\n" + parts + chunk(b"IEND", b"")


def dng(path: Path) -> None:
    """A negative of one strip, as small as LibRaw takes them."""
    write_dng(path, np.random.default_rng(3).integers(0, 4096, (48, 64)))


def read_picture(path: Path) -> object:
    """As `import-images` does: looked at, decoded, and copied in memory."""
    facts = inspect(path)
    return facts, bits_used(facts.highest), exif_focal_px(path, 48, 32)


def read_for_matching(path: Path) -> object:
    return finely(even_light(read_deep(path))), read_colour(path), read_linear(path, linear=False)


def look_for_board(path: Path) -> object:
    """As `calibrate` does with each picture."""
    sets = [PictureSet(name="v", paths={path.name: path})]
    return detect_views(sets, parse_target("chessboard 9x6 25mm"), SERIAL)


def read_video(path: Path) -> object:
    """As `import-images` does next to the decoder of its frames."""
    fixes = read_fixes(path, 3.0)
    return video_start(path), fixes.start_utc(), fixes.at(0.5)


_WHEN = datetime(2024, 7, 1, 12, tzinfo=UTC)


def _film(path: Path, telemetry: Callable[..., bytes]) -> None:
    """A short film of a GoPro."""
    frames = [np.full((16, 16, 3), level, np.uint8) for level in range(3)]
    payloads = [telemetry([(60.0, 5.0, 1.0)] * 3, _WHEN)] * 3
    gopro.film(path, frames, 1.0, created=_WHEN, payloads=payloads)


def _turned(path: Path) -> None:
    exif = Image.Exif()
    exif[0x112] = 6
    Image.new("RGB", (16, 16)).save(path, exif=exif)


def take_orientation_off(path: Path) -> object:
    return without_orientation(path.read_bytes())


read_small_mask = partial(read_mask, size=_SIZE)
_FILES = (
    ("rig.json", "json", "rig.json", _write("rig", small_rig), read_rig),
    ("target JSON", "json", "board.json", _board, read_board),
    ("OpenCV YAML", "text", "a.yaml", _write("opencv", _in_air), read_calibration),
    ("OpenCV XML", "text", "a.xml", _write("opencv", _in_air), read_calibration),
    ("Kalibr camchain", "text", "a.yaml", _write("kalibr", _in_air), read_calibration),
    ("Metashape XML", "text", "a.xml", _write("metashape", _one), read_calibration),
)
_IN_FOLDERS = (
    ("ROS camera_info", "text", "ros/left.yaml", "ros", _one, "ros/left.yaml"),
    ("COLMAP cameras.txt", "text", "m/cameras.txt", "colmap", _in_air, "m"),
    ("COLMAP cameras.bin", "binary", "m/cameras.bin", "colmap", _in_air, "m/cameras.bin"),
    ("COLMAP rig_config.json", "json", "m/rig_config.json", "colmap", _in_air, "m"),
    ("FLATPORT cameras.txt", "text", "m/cameras.txt", "refractive", small_rig, "m"),
    ("DOMEPORT cameras.bin", "binary", "m/cameras.bin", "refractive", _domes, "m/cameras.bin"),
)
_IMAGES = (
    ("JPEG", "a.jpg", picture, read_picture),
    ("PNG, 8 bits", "a.png", partial(picture, mode="RGBA"), read_picture),
    ("PNG, 16 bits", "a.png", _deep, read_picture),
    ("TIFF, LZW", "a.tif", partial(picture, compression="tiff_lzw"), read_picture),
    ("DNG", "a.dng", dng, read_picture),
    ("picture to match, JPEG", "a.jpg", picture, read_for_matching),
    ("mask", "a.png", partial(picture, mode="L"), read_small_mask),
    ("JPEG with an orientation", "a.jpg", _turned, take_orientation_off),
    ("TIFF with an orientation", "a.tif", _turned, take_orientation_off),
    ("picture of a board", "a.png", _chessboard, look_for_board, 2),
    ("MP4 with GPS5", "GX010042.MP4", partial(_film, telemetry=gopro.gps5), read_video, 60),
    ("MP4 with GPS9", "GX010042.MP4", partial(_film, telemetry=gopro.gps9), read_video, 60),
)
TARGETS = (
    *(Target(*row) for row in _FILES),  # type: ignore[arg-type]
    *(
        Target(name, syntax, file, _write(kind, rig, to), _read_folder)  # type: ignore[arg-type]
        for name, syntax, file, kind, rig, to in _IN_FOLDERS
    ),
    *(Target(name, "binary", *row) for name, *row in _IMAGES),  # type: ignore[arg-type]
)
