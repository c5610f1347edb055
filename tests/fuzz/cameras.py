"""Calibrations of every format that is read, pictures of every kind, and targets."""

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.executor import SERIAL
from camera_calib.rig import Rig, design_rig
from tests.cameras import flat_port_camera
from tests.fuzz.target import Target

_SIZE = (48, 32)


def small_rig() -> Rig:
    """Two cameras behind ports, as drawn."""
    return design_rig(CameraConfig(), WaterConfig(), scale=4)


def _in_air() -> Rig:
    """Two cameras that formats without ports can hold."""
    from dataclasses import replace

    lens = flat_port_camera(
        width_px=640, height_px=480, fx_px=500.0, fy_px=501.0, cx_px=320.0, cy_px=240.0,
        k1=-0.1, k2=0.01, p1=1e-3, p2=-1e-3, n_water=1.0,
    )  # fmt: skip
    rig = small_rig()
    return replace(rig, cameras=dict.fromkeys(rig.cameras, lens))


def _domes() -> Rig:
    """Two fisheyes behind domes."""
    from dataclasses import replace

    from camera_calib.camera import Camera
    from camera_calib.lenses.fisheye import FisheyeLens
    from camera_calib.ports.dome import DomePort

    lens = FisheyeLens(fx_px=300.0, fy_px=301.0, cx_px=320.0, cy_px=240.0, k1=0.02, k4=0.001)
    port = DomePort(dome_z_m=0.005, outer_radius_m=0.06, glass_thickness_m=0.006)
    camera = Camera(width_px=640, height_px=480, lens=lens, port=port)
    rig = small_rig()
    return replace(rig, cameras=dict.fromkeys(rig.cameras, camera))


def _one() -> Rig:
    """One fisheye in air."""
    from camera_calib.formats.rigs import in_air, only

    return only(in_air(_domes()), "left")


def _write(name: str, file: str, rig: Callable[[], Rig]) -> Callable[[Path], None]:
    def build(folder: Path) -> None:
        from camera_calib.formats.convert import FORMATS

        FORMATS[name].write(folder / file, rig())

    return build


def read_calibration(path: Path) -> object:
    """As `camera convert` and `calibrate --from`: of whatever format it looks like."""
    from camera_calib.formats.convert import detect
    from camera_calib.formats.rigs import ReadOptions

    return detect(path).read(path, ReadOptions(image_size=(640, 480), camera="1"))


def _read_folder(path: Path) -> object:
    return read_calibration(path.parent)


def _rig_json(folder: Path) -> None:
    from camera_calib.rig import write_rig

    write_rig(folder / "rig.json", small_rig())


def read_rig(path: Path) -> object:
    from camera_calib.rig import read_rig

    return read_rig(path)


def _board(folder: Path) -> None:
    from camera_calib.targets.target import parse_target, write_target

    write_target(folder / "board.json", parse_target("charuco 12x9 40mm 30mm"))


def read_board(path: Path) -> object:
    from camera_calib.targets.target import read_target

    return read_target(path).points


def _pixels(channels: int, kind: type) -> Any:
    shape = (_SIZE[1], _SIZE[0], channels) if channels > 1 else (_SIZE[1], _SIZE[0])
    maximum = np.iinfo(kind).max
    return np.random.default_rng(3).integers(0, maximum, shape, endpoint=True).astype(kind)


def picture(path: Path, mode: str = "RGB", **more: Any) -> Path:
    """A small picture with the EXIF of a camera that had GPS."""
    from PIL import Image

    bands = len(Image.new(mode, (1, 1)).getbands())
    image = Image.frombytes(mode, _SIZE, _pixels(bands, np.uint8).tobytes())
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2024:05:01 12:00:00", 0x9291: "25", 0xA405: 35})
    exif.get_ifd(0x8825).update(
        {1: "N", 2: (60.0, 6.0, 1.5), 3: "E", 4: (5.0, 15.0, 2.5), 5: b"\x01", 6: 12.5}
    )
    image.save(path, exif=exif, **more)
    return path


def _picture(folder: Path, name: str, mode: str, **more: Any) -> None:
    picture(folder / name, mode, **more)


def _deep(folder: Path, name: str) -> None:
    import cv2

    cv2.imwrite(str(folder / name), _pixels(3, np.uint16) >> 4)


def _chessboard(folder: Path) -> None:
    """9 x 6 inner corners, 16 px apart, with a white edge."""
    import cv2

    y, x = np.mgrid[0:144, 0:192] // 16
    dark = (x % 2 == y % 2) & (x > 0) & (x < 11) & (y > 0) & (y < 8)
    cv2.imwrite(str(folder / "a.png"), np.where(dark, 20, 230).astype(np.uint8))


def dng(folder: Path) -> None:
    """A negative of one strip, as small as LibRaw takes them."""
    width, height = 64, 48
    values = np.random.default_rng(3).integers(0, 4096, width * height).astype("<u2").tobytes()
    matrix = struct.pack("<18i", *(v for x in (1, 0, 0, 0, 1, 0, 0, 0, 1) for v in (x, 1)))
    tags: list[tuple[int, int, int, bytes]] = [
        (254, 4, 1, struct.pack("<I", 0)), (256, 4, 1, struct.pack("<I", width)),
        (257, 4, 1, struct.pack("<I", height)), (258, 3, 1, struct.pack("<H", 16)),
        (259, 3, 1, struct.pack("<H", 1)), (262, 3, 1, struct.pack("<H", 32803)),
        (271, 2, 6, b"Maker\0"), (272, 2, 6, b"Model\0"),
        (273, 4, 1, b"DATA"), (277, 3, 1, struct.pack("<H", 1)),
        (278, 4, 1, struct.pack("<I", height)), (279, 4, 1, struct.pack("<I", len(values))),
        (33421, 3, 2, struct.pack("<2H", 2, 2)), (33422, 1, 4, bytes([0, 1, 1, 2])),
        (50706, 1, 4, bytes([1, 4, 0, 0])), (50708, 2, 6, b"Model\0"),
        (50717, 4, 1, struct.pack("<I", 4095)), (50721, 10, 9, matrix),
        (50728, 5, 3, struct.pack("<6I", 1, 1, 1, 1, 1, 1)),
        (50778, 3, 1, struct.pack("<H", 21)),
    ]  # fmt: skip
    start = 8 + 2 + 12 * len(tags) + 4
    extra, entries = b"", b""
    data_at = start + sum(len(t[3]) for t in tags if len(t[3]) > 4)
    for number, kind, count, value in tags:
        content = struct.pack("<I", data_at) if value == b"DATA" else value
        if len(content) > 4:
            entries += struct.pack("<HHII", number, kind, count, start + len(extra))
            extra += content
        else:
            entries += struct.pack("<HHI", number, kind, count) + content.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags))
    (folder / "a.dng").write_bytes(head + entries + b"\0" * 4 + extra + values)


def read_picture(path: Path) -> object:
    """As `import-images` does: looked at, decoded, and copied in memory."""
    from reconstruct.pictures.files import bits_used, exif_focal_px, inspect

    facts = inspect(path)
    return facts, bits_used(facts.highest), exif_focal_px(path, 48, 32)


def read_for_matching(path: Path) -> object:
    from missions.exposure.gain import read_linear
    from reconstruct.pictures.normalise import even_light, finely, read_deep
    from reconstruct.pictures.undistorted import read_colour

    return finely(even_light(read_deep(path))), read_colour(path), read_linear(path, linear=False)


def read_mask(path: Path) -> object:
    from reconstruct.pictures.undistorted import read_mask

    return read_mask(path, _SIZE)


def look_for_board(path: Path) -> object:
    """As `calibrate` does with each picture."""
    from camera_calib.calibrate.detect_views import detect_views
    from camera_calib.calibrate.picture_sets import PictureSet
    from camera_calib.targets.target import parse_target

    sets = [PictureSet(name="v", paths={path.name: path})]
    return detect_views(sets, parse_target("chessboard 9x6 25mm"), SERIAL)


def _calibration(
    name: str, syntax: str, file: str, build: Callable[[Path], None], **more: Any
) -> Target:
    read = more.get("read", read_calibration)
    return Target(name=name, syntax=syntax, file=file, build=build, read=read)  # type: ignore[arg-type]


def _image(name: str, file: str, build: Callable[[Path], None], **more: Any) -> Target:
    settings = {"read": read_picture} | more
    return Target(name=name, syntax="binary", file=file, build=build, **settings)


TARGETS = (
    _calibration("rig.json", "json", "rig.json", _rig_json, read=read_rig),
    _calibration("OpenCV YAML", "text", "a.yaml", _write("opencv", "a.yaml", _in_air)),
    _calibration("OpenCV XML", "text", "a.xml", _write("opencv", "a.xml", _in_air)),
    _calibration("Kalibr camchain", "text", "a.yaml", _write("kalibr", "a.yaml", _in_air)),
    _calibration(
        "ROS camera_info", "text", "ros/left.yaml", _write("ros", "ros", _in_air),
        read=_read_folder,
    ),
    _calibration(
        "COLMAP cameras.txt", "text", "m/cameras.txt", _write("colmap", "m", _in_air),
        read=_read_folder,
    ),
    _calibration(
        "COLMAP cameras.bin", "binary", "m/cameras.bin",
        _write("colmap", "m/cameras.bin", _in_air), read=_read_folder,
    ),
    _calibration(
        "COLMAP rig_config.json", "json", "m/rig_config.json", _write("colmap", "m", _in_air),
        read=_read_folder,
    ),
    _calibration(
        "FLATPORT cameras.txt", "text", "m/cameras.txt", _write("refractive", "m", small_rig),
        read=_read_folder,
    ),
    _calibration(
        "DOMEPORT cameras.bin", "binary", "m/cameras.bin",
        _write("refractive", "m/cameras.bin", _domes), read=_read_folder,
    ),
    _calibration("Metashape XML", "text", "a.xml", _write("metashape", "a.xml", _one)),
    _calibration("target JSON", "json", "board.json", _board, read=read_board),
    _image("JPEG", "a.jpg", partial(_picture, name="a.jpg", mode="RGB")),
    _image("PNG, 8 bits", "a.png", partial(_picture, name="a.png", mode="RGBA")),
    _image("PNG, 16 bits", "a.png", partial(_deep, name="a.png")),
    _image(
        "TIFF, LZW", "a.tif",
        partial(_picture, name="a.tif", mode="RGB", compression="tiff_lzw"),
    ),
    _image("DNG", "a.dng", dng),
    _image(
        "picture to match, JPEG", "a.jpg", partial(_picture, name="a.jpg", mode="RGB"),
        read=read_for_matching,
    ),
    _image("mask", "a.png", partial(_picture, name="a.png", mode="L"), read=read_mask),
    _image("picture of a board", "a.png", _chessboard, read=look_for_board, examples=2),
)  # fmt: skip
