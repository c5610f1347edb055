"""Random cameras and rigs that formats of other tools must carry, and points to look at."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats.rigs import ReadOptions
from camera_calib.optics import LENSES
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.none import NO_PORT
from camera_calib.ports.values import PortValues
from camera_calib.rig import Covariance, Rig

DATA = Path(__file__).parent / "data" / "calibrations"
"""Calibrations as other tools write them."""
RNG = np.random.default_rng(11)
POINTS_RIG = RNG.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 3.0], (40, 3))
"""Points that every camera of `rigs` sees, metres."""
WIDE_RIG = np.concatenate([POINTS_RIG, RNG.uniform([-3, -3, 0.3], [3, 3, 3.0], (40, 3))])
"""Points that show what a fisheye does."""
SMALL = {
    "k1": 0.2, "k2": 0.1, "p1": 2e-3, "p2": 2e-3, "k3": 0.05, "k4": 0.05, "k5": 0.02, "k6": 0.01,
    "s1": 2e-3, "s2": 1e-3, "s3": 2e-3, "s4": 1e-3,
}  # fmt: skip
RADTAN = ("k1", "k2", "p1", "p2")
PLUMB_BOB = (*RADTAN, "k3")
RATIONAL = (*PLUMB_BOB, "k4", "k5", "k6")
EVERY = tuple(SMALL)
_FISHEYE = {"k1": 0.05, "k2": 0.02, "k3": 0.01, "k4": 0.005}
BOTH_LENSES = ("opencv", "fisheye")


def _number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def cameras(
    draw: st.DrawFn,
    terms: tuple[str, ...] = EVERY,
    *,
    lenses: tuple[str, ...] = ("opencv",),
    ports: tuple[str, ...] = ("none",),
    size: bool = True,
) -> Camera:
    """A camera of one of the lenses, with some of the distortion terms, and one of the ports."""
    width, height = (
        draw(st.tuples(st.integers(300, 4000), st.integers(200, 3000))) if size else (1600, 1200)
    )
    lens = {
        "fx_px": draw(_number(500, 4000)),
        "fy_px": draw(_number(500, 4000)),
        "cx_px": width / 2 + draw(_number(-30, 30)),
        "cy_px": height / 2 + draw(_number(-30, 30)),
    }
    kind = draw(st.sampled_from(lenses))
    maximum = _FISHEYE if kind == "fisheye" else {name: SMALL[name] for name in terms}
    used = draw(st.sets(st.sampled_from(sorted(maximum)))) if maximum else set()
    lens |= {name: draw(_number(-maximum[name], maximum[name])) for name in sorted(used)}
    return Camera(
        width_px=width,
        height_px=height,
        lens=LENSES[kind](**lens),
        port=_port(draw, draw(st.sampled_from(ports))),
    )


def _port(draw: st.DrawFn, shape: str) -> PortValues:
    if shape == "none":
        return NO_PORT
    glass = {
        "glass_thickness_m": draw(_number(0.0, 0.03)),
        "n_glass": draw(_number(1.3, 1.6)),
        "n_water": draw(_number(1.3, 1.36)),
    }
    x, y = draw(_number(-0.1, 0.1)), draw(_number(-0.1, 0.1))
    if shape == "flat":
        normal = (x, y, (1.0 - x * x - y * y) ** 0.5)
        return FlatPort(port_distance_m=draw(_number(0.0, 0.1)), normal=normal, **glass)
    z = draw(_number(-0.02, 0.02))
    radius = draw(_number(0.07, 0.15))
    return DomePort(dome_x_m=x / 10, dome_y_m=y / 10, dome_z_m=z, outer_radius_m=radius, **glass)


def _pose(
    x_m: tuple[float, float], aside_m: float, turn: float
) -> st.SearchStrategy[RigidTransform]:
    """Poses of a camera next to another, or of a rig; turns in radians about each axis."""
    axes = [_number(-turn, turn)] * 3
    place = st.tuples(_number(*x_m), *[_number(-aside_m, aside_m)] * 2)
    return st.builds(
        RigidTransform.from_components, place, st.tuples(*axes).map(Rotation.from_rotvec)
    )


@st.composite
def rigs(
    draw: st.DrawFn,
    terms: tuple[str, ...] = EVERY,
    *,
    lenses: tuple[str, ...] = ("opencv",),
    ports: tuple[str, ...] = ("none",),
    maximum: int = 2,
    one_size: bool = False,
) -> Rig:
    """A rig of up to `maximum` cameras."""
    count = draw(st.integers(1, maximum))
    names = ["left", "right", "third"][:count]
    kinds = {"lenses": lenses, "ports": ports, "size": not one_size}
    each = [draw(cameras(terms, **kinds)) for _ in names]  # type: ignore[arg-type]
    rest = [draw(_pose((-0.3, -0.02), 0.01, 0.2)) for _ in names[1:]]
    return Rig(
        cameras=dict(zip(names, each, strict=True)),
        cam_from_rig=dict(zip(names, [RigidTransform.identity(), *rest], strict=True)),
        body_from_rig=draw(_pose((-1, 1), 1, 1.5)),
        source="drawn",
    )


def covariance_of(rig: Rig, rng: np.random.Generator) -> Covariance:
    """A full covariance of some of a rig's parameters."""
    names = tuple(f"{name}.{what}" for name in rig.cameras for what in ("fx_px", "k1", "n_water"))
    if len(rig.cameras) > 1:
        names = (*names, "right.rx_rad", "right.x_m")
    root = rng.normal(0, 1e-3, (len(names), len(names)))
    return Covariance(parameters=names, matrix=root @ root.T)


def points_for(camera: Camera) -> Array:
    """Points of the rig's frame, (N, 3), that show what its lens does."""
    return WIDE_RIG if camera.lens.model == "fisheye" else POINTS_RIG


def opencv_pixels(points: Array, rvec: Array, tvec: Array, k: Array, d: Array) -> Array:
    """(N, 2) pixels by OpenCV, of its fisheye when there are four coefficients."""
    project = cv2.fisheye.projectPoints if d.size == 4 else cv2.projectPoints
    seen, _ = project(np.ascontiguousarray(points)[:, None], rvec, tvec, k, d)
    return np.asarray(seen).reshape(-1, 2)


def assert_same_pixels(ours: Array, theirs: Array, least: int = 1) -> None:
    """Another tool sees points where we do, as far as we see them."""
    known = np.isfinite(ours[:, 0])
    assert known.sum() >= least
    np.testing.assert_allclose(theirs[known], ours[known], atol=1e-8, rtol=0)


def assert_same_geometry(after: Rig, before: Rig, *, pixels: float = 1e-9) -> None:
    """Both rigs put the same points at the same pixels, and have the same sizes and names."""
    assert list(after.cameras) == list(before.cameras)
    for name, camera in before.cameras.items():
        other = after.cameras[name]
        assert (other.width_px, other.height_px) == (camera.width_px, camera.height_px)
        seen = points_for(camera)
        points = before.cam_from_rig[name].apply(seen)
        points_after = after.cam_from_rig[name].apply(seen)
        expected = camera.project(points)
        assert np.isfinite(expected).mean() > 0.2
        np.testing.assert_allclose(other.project(points_after), expected, atol=pixels, rtol=0)


def fault_of(
    read: Callable[[Path, ReadOptions], Rig],
    path: Path,
    text: str | None = None,
    reading: ReadOptions | None = None,
) -> str:
    """The one line, which names the file, with which a reader refuses a file of this text."""
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError) as error:
        read(path, reading or ReadOptions())
    shown = str(error.value)
    assert str(path) in shown
    assert "\n" not in shown
    return shown
