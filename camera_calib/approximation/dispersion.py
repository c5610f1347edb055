"""Colour through a flat port: cameras per channel, and blue and red warped onto green.

Water and glass bend blue light more than red, so that a flat port shows each colour at its own
scale. A camera is calibrated for its green channel; the other channels see with the same lens and
port and with other indices. At one working range the channels differ by a warp, which
`channel_maps` computes and `undisperse` undoes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from alice_survey.core.artefacts import json_values
from alice_survey.core.errors import CalibrationError, ConfigError, ImageError
from alice_survey.core.frames import Array
from alice_survey.core.seawater import n_water
from alice_survey.core.text_table import text_table
from camera_calib.camera import Camera
from camera_calib.water import CHANNELS, WAVELENGTH_NM

_REFERENCE = "green"
_NODES_PX = 64
"""Spacing of exact nodes of a warp; between them a cubic spline, exact to 1e-4 px."""
_NEARER = 0.25
"""Relief, as a share of the range, for which the residual of a correction is stated."""

Floats = NDArray[np.float32]
Maps = Mapping[str, tuple[Floats, Floats]]
Pixel = TypeVar("Pixel", np.uint8, np.uint16, np.float32)
_SELLMEIER: dict[str, tuple[tuple[float, float], ...]] = {
    "bk7": (
        (1.03961212, 6.00069867e-3),
        (0.231792344, 2.00179144e-2),
        (1.01046945, 103.560653),
    ),
    "fused-silica": (
        (0.6961663, 0.0684043**2),
        (0.4079426, 0.1162414**2),
        (0.8974794, 9.896161**2),
    ),
    "sapphire": (
        (1.4313493, 0.0726631**2),
        (0.65054713, 0.1193242**2),
        (5.3414021, 18.028251**2),
    ),
    "pmma": ((1.1819, 0.011313),),
    "polycarbonate": ((1.4182, 0.021304),),
}
"""B and C (square micrometres) of n^2 - 1 = sum B l^2 / (l^2 - C), relative to air at 20 C: SCHOTT
N-BK7 data sheet; Malitson (1965); Malitson and Dodge (1972), ordinary ray, as of a window cut
across its axis; Sultanova, Kasarova and Nikolov (2009) for both plastics."""
GLASSES = tuple(_SELLMEIER)
"""Materials of ports whose dispersion is known."""


def channel_cameras(
    camera: Camera,
    *,
    temperature_c: float,
    salinity_psu: float,
    depth_m: float,
    glass: str = "bk7",
    wavelengths_nm: Sequence[float] | Array = WAVELENGTH_NM,
) -> dict[str, Camera]:
    """The camera as its red, green and blue channels see.

    The camera's own indices, mostly calibrated, apply to green; for red and blue they change by as
    much as those of the water and the material do.

    Args:
        camera: as calibrated; green.
        temperature_c: temperature of the water.
        salinity_psu: salinity of the water.
        depth_m: below the surface.
        glass: material of the port, one of `glass.GLASSES`.
        wavelengths_nm: wavelengths of red, green and blue.

    Raises:
        ConfigError: water, material or wavelengths are out of range or not three.
    """
    nm = np.asarray(wavelengths_nm, dtype=np.float64)
    if nm.shape != (3,) or not np.all(np.diff(nm) < 0):
        raise ConfigError(f"wavelengths {nm} nm: give three, of red, green and blue, falling")
    water = n_water(temperature_c, salinity_psu, depth_m, nm)
    port = n_glass(glass, nm)
    green = CHANNELS.index(_REFERENCE)
    return {
        name: camera.with_parameters(
            {
                "n_water": camera.n_water + float(water[i] - water[green]),
                "n_glass": camera.parameter("n_glass") + float(port[i] - port[green]),
            }
        )
        if i != green and camera.port.parameters
        else camera
        for i, name in enumerate(CHANNELS)
    }


def shift_px(green: Camera, channel: Camera, pixels: Array, range_m: float) -> Array:
    """Shift of a channel against green at each pixel.

    Args:
        green: camera of the green channel.
        channel: camera of another one.
        pixels: (..., 2) of green.
        range_m: from the entrance pupil to the scene, along the axis.

    Returns:
        (..., 2) pixels; NaN where either sees nothing.
    """
    shift: Array = channel.project(green.at_depth(pixels, range_m)) - pixels
    return shift


@dataclass(frozen=True, kw_only=True)
class ChannelShift:
    """Shift of one channel by dispersion, against green, over the frame."""

    channel: str
    n_water: float
    n_glass: float
    shift_1000_px: float
    """Outward shift 1000 pixels from the principal point, mean of both sides; NaN in a narrower
    picture."""
    corner_px: float
    """Outward shift in the corners, their mean."""
    rms_px: float
    """Length of the shift over the frame."""
    max_px: float
    rest_px: float
    """Largest residual of a correction at this range where the scene is a quarter nearer or
    farther."""


def frame_shifts(cameras: Mapping[str, Camera], range_m: float) -> list[ChannelShift]:
    """The size of dispersion over the frame, for red and blue.

    Args:
        cameras: from `channel_cameras`.
        range_m: from the entrance pupil to the scene, along the axis.

    Raises:
        CalibrationError: a part of the frame sees nothing at that range.
    """
    green = cameras[_REFERENCE]
    grid = green.frame_grid(15, 15)
    centre = np.array([green.cx_px, green.cy_px])
    off_centre = centre + np.array([[-1000.0, 0.0], [1000.0, 0.0]])
    inside = bool(np.all((off_centre[:, 0] >= 0) & (off_centre[:, 0] <= green.width_px)))
    corners = grid[::14, ::14].reshape(4, 2)
    rows = []
    for name in _others(cameras):
        camera = cameras[name]
        nearer, shift, farther = (
            _checked_shift(green, camera, grid, factor * range_m, name)
            for factor in (1.0 - _NEARER, 1.0, 1.0 + _NEARER)
        )
        length = np.linalg.norm(shift, axis=-1)
        rest = np.linalg.norm(np.stack([nearer, farther]) - shift, axis=-1)
        outward = [
            _outward(green, camera, spots, centre, range_m) for spots in (off_centre, corners)
        ]
        rows.append(
            ChannelShift(
                channel=name,
                n_water=camera.n_water,
                n_glass=camera.parameter("n_glass"),
                shift_1000_px=outward[0] if inside else float("nan"),
                corner_px=outward[1],
                rms_px=float(np.sqrt(np.mean(length**2))),
                max_px=float(length.max()),
                rest_px=float(rest.max()),
            )
        )
    return rows


def channel_maps(cameras: Mapping[str, Camera], range_m: float) -> Maps:
    """Position of each pixel of green in the red and the blue channel.

    Args:
        cameras: from `channel_cameras`.
        range_m: from the entrance pupil to the scene, along the axis.

    Returns:
        By channel, x and y for `cv2.remap` (origin at the first pixel's centre), float32.

    Raises:
        CalibrationError: a part of the frame sees nothing at that range.
    """
    green = cameras[_REFERENCE]
    across = _nodes(green.width_px)
    down = _nodes(green.height_px)
    nodes = np.stack(np.meshgrid(across, down), axis=-1)
    x = np.arange(green.width_px) + 0.5
    y = np.arange(green.height_px) + 0.5
    maps = {}
    for name in _others(cameras):
        shift = _checked_shift(green, cameras[name], nodes, range_m, name)
        by_axis = [RectBivariateSpline(down, across, shift[..., i])(y, x) for i in range(2)]
        maps[name] = (
            (by_axis[0] + (x - 0.5)).astype(np.float32),
            (by_axis[1] + (y - 0.5)[:, None]).astype(np.float32),
        )
    return maps


def undisperse(picture: NDArray[Pixel], maps: Maps) -> NDArray[Pixel]:
    """Warp red and blue onto green.

    Args:
        picture: (rows, columns, 3) red, green, blue.
        maps: from `channel_maps`, for the same size.

    Raises:
        ImageError: the picture has another size or no colour.
    """
    size: tuple[int, ...] = next(iter(maps.values()))[0].shape
    if picture.shape != (*size, len(CHANNELS)):
        raise ImageError(
            f"a picture of {' x '.join(map(str, picture.shape))} values cannot be corrected by a "
            f"camera of {size[0]} rows and {size[1]} columns in 3 colours"
        )
    corrected = picture.copy()
    for name, (x, y) in maps.items():
        channel = np.ascontiguousarray(picture[..., CHANNELS.index(name)])
        # OpenCV's cubic kernel misplaces fine texture by up to 0.045 px, Lanczos' by 0.008.
        corrected[..., CHANNELS.index(name)] = cv2.remap(
            channel, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
        )
    return corrected


def shifts_report(shifts: Sequence[ChannelShift], range_m: float) -> tuple[str, dict[str, Any]]:
    """`frame_shifts` as text and as JSON values."""
    rows = [
        (
            s.channel,
            f"{s.n_water:.5f}",
            f"{s.n_glass:.5f}",
            "-" if math.isnan(s.shift_1000_px) else f"{s.shift_1000_px:+.2f} px",
            f"{s.corner_px:+.2f} px",
            f"{s.rms_px:.2f} px",
            f"{s.max_px:.2f} px",
            f"{s.rest_px:.3f} px",
        )
        for s in shifts
    ]
    header = ("channel", "n_water", "n_glass", "at 1000 px", "corners", "rms", "max", "rest")
    note = (
        f"shift against green at {range_m:g} m, outward; rest: what a correction leaves at most "
        "where the scene is a quarter nearer or farther"
    )
    data = {"range_m": range_m, "channels": json_values(shifts)}
    return "\n".join([text_table(header, rows), note]), data


def _others(cameras: Mapping[str, Camera]) -> list[str]:
    return [name for name in CHANNELS if name != _REFERENCE and name in cameras]


def _nodes(size_px: int) -> Array:
    count = max(4, -(-size_px // _NODES_PX) + 1)
    return np.linspace(0.0, size_px, count)


def _outward(green: Camera, channel: Camera, pixels: Array, centre: Array, range_m: float) -> float:
    away = pixels - centre
    away = away / np.linalg.norm(away, axis=-1, keepdims=True)
    return float(np.mean(np.sum(shift_px(green, channel, pixels, range_m) * away, axis=-1)))


def _checked_shift(
    green: Camera, channel: Camera, pixels: Array, range_m: float, name: str
) -> Array:
    closest = float(green.front_cam[2])
    if not range_m > closest:
        raise CalibrationError(
            f"range {range_m:g} m ends before the port's outer glass, {closest:g} m from the "
            "entrance pupil: give a longer range"
        )
    shift = shift_px(green, channel, pixels, range_m)
    if not np.all(np.isfinite(shift)):
        raise CalibrationError(
            f"{name} sees nothing in a part of the frame at {range_m:g} m: the lens model or the "
            "port does not reach the corners"
        )
    return shift


def n_glass(material: str, wavelength_nm: ArrayLike) -> Array:
    """Index of refraction of a port's material, relative to air, by Sellmeier's equation.

    Args:
        material: one of `GLASSES`.
        wavelength_nm: any shape, 380 to 1050.

    Raises:
        ConfigError: the material is unknown or a wavelength out of range.
    """
    if material not in _SELLMEIER:
        raise ConfigError(f"no glass {material!r}: known are {', '.join(GLASSES)}")
    nm = np.asarray(wavelength_nm, dtype=np.float64)
    if not np.all((nm >= 380.0) & (nm <= 1050.0)):
        raise ConfigError(f"wavelength {nm} nm: glasses are known from 380 to 1050 nm")
    square_um = (nm * 1e-3) ** 2
    terms = (b * square_um / (square_um - c) for b, c in _SELLMEIER[material])
    index: Array = np.sqrt(1.0 + sum(terms, start=np.zeros_like(square_um)))
    return index
