"""Options of `calibrate`: pictures, target, and prior knowledge of lens, port and water."""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from alice_survey.core.errors import CalibrationError
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
    dome_radius_mm: str | None = None
    """Outer radius of a dome; this and the next ones by camera, as `by_camera` reads them."""
    port_distance_mm: str | None = None
    """First value; it is estimated."""
    glass_mm: str | None = None
    """Thickness of the glass."""
    n_glass: str | None = None
    n_glass_sigma: float | None = None
    glass_sigma_mm: float | None = None
    """Prior sigma of the thickness, which is then estimated; the indices in the same way."""
    n_water: float | None = None
    n_water_sigma: float | None = None
    carry_to_n: float | None = None
    """Also write the rig in water of this index."""
    mount: str | None = None
    """How the rig sits on the vehicle, as `with_mount` reads it; None: as of the start."""
    lever_m: tuple[float, float, float] | None = None
    """Place of the reference camera's front glass on the vehicle."""

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

    def port_values(self, cameras: Collection[str]) -> dict[str, dict[str, float]]:
        """Parameters of the port of each camera that are given, in metres.

        Raises:
            CalibrationError: one is not a number in its range, or for no camera.
        """
        water = {} if self.n_water is None else {"n_water": self.n_water}
        found: dict[str, dict[str, float]] = {camera: {**water} for camera in cameras}
        for option, text, parameter, unit, (minimum, maximum) in (
            ("--dome-radius", self.dome_radius_mm, "outer_radius_m", 1e3, (5.0, 1000.0)),
            ("--port-distance", self.port_distance_mm, "port_distance_m", 1e3, (0.0, 500.0)),
            ("--glass", self.glass_mm, "glass_thickness_m", 1e3, (0.0, 500.0)),
            ("--n-glass", self.n_glass, "n_glass", 1.0, (1.0, 2.0)),
        ):
            for camera, word in by_camera(text or "", cameras, option).items():
                try:
                    value = float(word) if word else minimum
                except ValueError:
                    value = math.nan
                if not minimum <= value <= maximum:
                    raise CalibrationError(
                        f"{option} {text}: {word!r} for {camera} is not a number from "
                        f"{minimum:g} to {maximum:g}"
                    )
                if word:
                    found[camera][parameter] = value / unit
        return found


def by_camera(text: str, cameras: Iterable[str], option: str) -> dict[str, str]:
    """One word for all cameras, and others for some: `flat`, or `flat,bow=dome,side=none`.

    Args:
        text: the option.
        cameras: names of all cameras.
        option: its own name, for messages.

    Returns:
        The word of each camera, empty where there is none.

    Raises:
        CalibrationError: a camera is unknown, or two words are for all.
    """
    parts = [part.strip().rpartition("=")[::2] for part in text.split(",")]
    usual = [kind for camera, kind in parts if not camera]
    own = {camera.strip(): kind.strip() for camera, kind in parts if camera}
    chosen = {**dict.fromkeys(cameras, usual[0] if usual else ""), **own}
    wrong = sorted(set(own) - set(cameras))
    if wrong or len(usual) > 1:
        which = f"no camera is called {', '.join(wrong)}" if wrong else "two are for all cameras"
        raise CalibrationError(f"{option} {text}: {which}; cameras are {', '.join(cameras)}")
    return chosen


def kinds_by_camera(
    text: str, cameras: Iterable[str], option: str, known: Collection[str]
) -> dict[str, str]:
    """What `by_camera` reads, of known names.

    Raises:
        CalibrationError: a camera has none, or a name is unknown.
    """
    chosen = by_camera(text, cameras, option)
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
    given_of = settings.port_values(names)
    kinds = {}
    if settings.port is not None:
        kinds = kinds_by_camera(settings.port, names, "--port", PORT_KINDS)
    old = {} if start is None else start.cameras
    domes = {n for n, c in old.items() if c.port.shape == DomePort.shape}
    thick = {
        n
        for n, c in old.items()
        if "glass_thickness_m" in c.parameters and c.parameter("glass_thickness_m") > 0.0
    }
    for name in names:
        kind, given_here = kinds.get(name), given_of[name]
        if kind == DomePort.shape and name not in domes and "outer_radius_m" not in given_here:
            raise CalibrationError(
                f"--port dome needs --dome-radius, of the outer surface of {name} in mm"
            )
        if kind != NoPort.shape and name not in thick and "glass_thickness_m" not in given_here:
            raise CalibrationError(
                f"--water needs --glass, the thickness of the port of {name} in mm (0 for a thin "
                "film)"
            )
