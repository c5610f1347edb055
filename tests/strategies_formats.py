"""Random cameras and rigs that formats of other tools must carry, and points to look at."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError
from camera_calib.camera import Camera, flat_port_camera
from camera_calib.formats.rigs import ReadOptions
from camera_calib.rig import Covariance, Rig

RNG = np.random.default_rng(11)
POINTS_RIG = RNG.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 3.0], (40, 3))
"""Points that every camera of `rigs` sees, metres."""
SMALL = {
    "k1": 0.2, "k2": 0.1, "p1": 2e-3, "p2": 2e-3, "k3": 0.05, "k4": 0.05, "k5": 0.02, "k6": 0.01,
    "s1": 2e-3, "s2": 1e-3, "s3": 2e-3, "s4": 1e-3,
}  # fmt: skip
RADTAN = ("k1", "k2", "p1", "p2")
PLUMB_BOB = (*RADTAN, "k3")
RATIONAL = (*PLUMB_BOB, "k4", "k5", "k6")
EVERY = tuple(SMALL)


def _number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def cameras(
    draw: st.DrawFn, terms: tuple[str, ...] = EVERY, *, port: bool = False, size: bool = True
) -> Camera:
    """A camera with some of the distortion terms, behind a port when requested, else in air."""
    used = draw(st.sets(st.sampled_from(terms)))
    width, height = (
        draw(st.tuples(st.integers(300, 4000), st.integers(200, 3000))) if size else (1600, 1200)
    )
    lens = {name: draw(_number(-SMALL[name], SMALL[name])) for name in sorted(used)}
    housing: dict[str, object] = {"n_water": 1.0}
    if port:
        x, y = draw(_number(-0.1, 0.1)), draw(_number(-0.1, 0.1))
        housing = {
            "port_distance_m": draw(_number(0.0, 0.1)),
            "glass_thickness_m": draw(_number(0.0, 0.03)),
            "n_glass": draw(_number(1.3, 1.6)),
            "n_water": draw(_number(1.3, 1.36)),
            "normal": (x, y, (1.0 - x * x - y * y) ** 0.5),
        }
    return flat_port_camera(
        width_px=width,
        height_px=height,
        fx_px=draw(_number(500, 4000)),
        fy_px=draw(_number(500, 4000)),
        cx_px=width / 2 + draw(_number(-30, 30)),
        cy_px=height / 2 + draw(_number(-30, 30)),
        **lens,
        **housing,  # type: ignore[arg-type]
    )


@st.composite
def poses(draw: st.DrawFn) -> RigidTransform:
    """A pose of a camera next to another."""
    turn = [draw(_number(-0.2, 0.2)) for _ in range(3)]
    sideways = draw(_number(-0.3, -0.02))
    shift = [sideways, draw(_number(-0.01, 0.01)), draw(_number(-0.01, 0.01))]
    return RigidTransform.from_components(shift, Rotation.from_rotvec(turn))


@st.composite
def rigs(
    draw: st.DrawFn,
    terms: tuple[str, ...] = EVERY,
    *,
    port: bool = False,
    most: int = 2,
    one_size: bool = False,
) -> Rig:
    """A rig of up to `most` cameras."""
    count = draw(st.integers(1, most))
    names = ["left", "right", "third"][:count]
    each = [draw(cameras(terms, port=port, size=not one_size)) for _ in names]
    rest = [draw(poses()) for _ in names[1:]]
    mount = RigidTransform.from_components(
        [draw(_number(-1, 1)) for _ in range(3)],
        Rotation.from_rotvec([draw(_number(-1.5, 1.5)) for _ in range(3)]),
    )
    return Rig(
        cameras=dict(zip(names, each, strict=True)),
        cam_from_rig=dict(zip(names, [RigidTransform.identity(), *rest], strict=True)),
        body_from_rig=mount,
        source="drawn",
    )


def covariance_of(rig: Rig, rng: np.random.Generator) -> Covariance:
    """A full covariance of some of a rig's parameters."""
    names = tuple(f"{name}.{what}" for name in rig.cameras for what in ("fx_px", "k1", "n_water"))
    if len(rig.cameras) > 1:
        names = (*names, "right.rx_rad", "right.x_m")
    root = rng.normal(0, 1e-3, (len(names), len(names)))
    return Covariance(parameters=names, matrix=root @ root.T)


def assert_same_geometry(after: Rig, before: Rig, *, pixels: float = 1e-9) -> None:
    """Both rigs put the same points at the same pixels, and have the same sizes and names."""
    assert list(after.cameras) == list(before.cameras)
    for name, camera in before.cameras.items():
        other = after.cameras[name]
        assert (other.width_px, other.height_px) == (camera.width_px, camera.height_px)
        points = before.cam_from_rig[name].apply(POINTS_RIG)
        points_after = after.cam_from_rig[name].apply(POINTS_RIG)
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
