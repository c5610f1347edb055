"""Options of `calibrate`: pictures, target, and prior knowledge of lens, port and water."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from alice_survey.base.errors import CalibrationError
from camera_calib.calibrate.solve import Intrinsics
from camera_calib.optics import PORTS
from camera_calib.picture_files import places_of_cameras
from camera_calib.ports.dome import DomePort
from camera_calib.ports.none import NoPort
from camera_calib.rig import Rig
from camera_calib.target_shape import (
    ShapeKind,
)

AUTO = "auto"
"""The port that is found by trying all."""
PORT_KINDS = (*PORTS, AUTO)
ONE_CAMERA = "camera"
"""Name of the camera of `--pictures`."""


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Pictures to calibrate from, and prior knowledge."""

    left: str | None = None
    """Folder or pattern; the left camera is the reference."""
    right: str | None = None
    pictures: str | None = None
    """Pictures of a single camera, instead."""
    cameras: tuple[str, ...] = ()
    """`NAME=PLACE` of each camera, the reference first, where left and right do not do."""
    own_clocks: bool = False
    """Whether the cameras took their pictures by clocks of their own, without a common trigger."""
    target: str | None = None
    """Target, as `parse_target` reads it."""
    target_shape: ShapeKind = "sheet"
    """How it may differ from its drawing."""
    output: Path | None = None
    """Folder to write."""
    lens: str | None = None
    """Lens model, of `freedom.LENSES`, and those of some cameras, as `by_camera` reads them; None:
    the usual one of the start's lens, or opencv5."""
    water: bool = False
    """Whether the pictures were taken under water, through the ports."""
    start: Path | None = None
    """rig.json of a calibration in air, or an earlier one."""
    known: Intrinsics | None = None
    """Use of the intrinsics of `start`; None: prior if it has a covariance, or held."""
    port: str | None = None
    """Kind of the port, of `optics.PORTS`, and those of single cameras, as `by_camera` reads them;
    auto: the likeliest; None: that of the start, or flat."""
    dome_radius_mm: float | None = None
    """Outer radius of a dome."""
    port_distance_mm: float | None = None
    """First value; it is estimated."""
    glass_mm: float | None = None
    """Thickness of the glass."""
    glass_sigma_mm: float | None = None
    """Prior sigma of the thickness, which is then estimated; the indices below in the same way."""
    n_glass: float | None = None
    n_glass_sigma: float | None = None
    n_water: float | None = None
    n_water_sigma: float | None = None
    carry_to_n: float | None = None
    """Also write the rig in water of this index."""

    def places(self) -> dict[str, str]:
        """Folder or pattern by camera; the first is the reference.

        Raises:
            CalibrationError: they are missing or do not go together.
        """
        stereo = {"left": self.left, "right": self.right}
        given = {camera: place for camera, place in stereo.items() if place is not None}
        if self.pictures is not None:
            if given or self.cameras:
                raise CalibrationError(
                    "give --left and --right, or --camera, or --pictures, not two of them"
                )
            return {ONE_CAMERA: self.pictures}
        if len(given) == 1:
            raise CalibrationError(
                "give both --left and --right, or --pictures for a single camera"
            )
        named = places_of_cameras(self.cameras)
        if set(given) & set(named):
            raise CalibrationError("--camera names left or right, which is given too")
        given |= named
        if not given:
            raise CalibrationError(
                "these options are for pictures: give --left and --right, --pictures, or --camera; "
                "the pool of a survey takes none of them"
            )
        return given


def by_camera(
    text: str, cameras: Iterable[str], option: str, known: Collection[str]
) -> dict[str, str]:
    """One name for all cameras, and others for some: `flat`, or `flat,bow=dome,side=none`.

    Args:
        text: the option.
        cameras: names of all cameras.
        option: its own name, for messages.
        known: names that may be given.

    Raises:
        CalibrationError: a camera has none, or a name is unknown.
    """
    parts = [part.strip().rpartition("=")[::2] for part in text.split(",")]
    usual = [kind for camera, kind in parts if not camera]
    own = {camera.strip(): kind.strip() for camera, kind in parts if camera}
    chosen = {**dict.fromkeys(cameras, usual[0] if usual else ""), **own}
    wrong = sorted(set(own) - set(cameras))
    if wrong or len(usual) > 1:
        which = f"no camera is called {', '.join(wrong)}" if wrong else "two are for all cameras"
        raise CalibrationError(f"{option} {text}: {which}; cameras are {', '.join(cameras)}")
    for camera, kind in chosen.items():
        if kind not in known:
            wrong_kind = f"{kind!r} for {camera}" if kind else f"there is none for {camera}"
            raise CalibrationError(f"{option} {text}: {wrong_kind}; choose {', '.join(known)}")
    return chosen


def check_settings(settings: CalibrateOptions, start: Rig | None) -> None:
    """Reject options that do not go together, before the work starts.

    Args:
        settings: of the command.
        start: the rig of `--start`.

    Raises:
        CalibrationError: the first fault.
    """
    ports = {
        "--port": settings.port,
        "--dome-radius": settings.dome_radius_mm,
        "--port-distance": settings.port_distance_mm,
        "--glass": settings.glass_mm,
        "--glass-sigma": settings.glass_sigma_mm,
        "--n-glass": settings.n_glass,
        "--n-glass-sigma": settings.n_glass_sigma,
        "--n-water": settings.n_water,
        "--n-water-sigma": settings.n_water_sigma,
        "--carry-to-n": settings.carry_to_n,
        "--intrinsics": settings.known,
    }
    if not settings.water:
        given = [name for name, value in ports.items() if value is not None]
        if given:
            raise CalibrationError(f"{', '.join(given)} need --water: pictures in air see no port")
        return
    if settings.known in ("held", "prior") and start is None:
        raise CalibrationError(
            f"--intrinsics {settings.known} needs --start, the rig.json of a calibration in air"
        )
    names = list(settings.places())
    kinds = {} if settings.port is None else by_camera(settings.port, names, "--port", PORT_KINDS)
    domes = (
        {}
        if start is None
        else {n: c.port.shape == DomePort.shape for n, c in start.cameras.items()}
    )
    unknown = [n for n, kind in kinds.items() if kind == DomePort.shape and not domes.get(n)]
    if unknown and settings.dome_radius_mm is None:
        raise CalibrationError("--port dome needs --dome-radius, of its outer surface in mm")
    if settings.glass_mm is None and set(kinds.values()) != {NoPort.shape}:
        thin = start is None or not any(
            "glass_thickness_m" in c.parameters and c.parameter("glass_thickness_m") > 0.0
            for c in start.cameras.values()
        )
        if thin:
            raise CalibrationError(
                "--water needs --glass, the thickness of the port in mm (0 for a thin film)"
            )
