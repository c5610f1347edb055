"""Options of `calibrate`: parsed once, here, into the values that a calibration takes."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Literal

from alice_survey.core.errors import CalibrationError, WorkspaceError
from camera_calib.calibrate.solve import Intrinsics, blank_camera
from camera_calib.camera import Camera
from camera_calib.freedom import LENSES, USUAL_LENS, part_of_rig
from camera_calib.mount import MOUNTS, mount_pose
from camera_calib.optics import PORTS
from camera_calib.picture_files import places_of_cameras
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.none import NO_PORT, NoPort
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig, read_rig
from camera_calib.target_shape import AS_DRAWN, TargetShape, usual_shape
from camera_calib.targets.target import Target, parse_target

AUTO = "auto"
"""The port, or the lens, that is found by trying all."""
WRITTEN = (
    "rig.json", "rig_carried.json", "calibration.json", "corners.csv", "report.html", "report.json",
)  # fmt: skip
"""Files of this command, also of earlier versions; a folder with other files is not replaced."""
_GLASS = "glass_thickness_m"
_PORT_OPTIONS: Mapping[str, tuple[str, str, float, tuple[float, float]]] = {
    "outer_radius_m": ("dome_radius_mm", "--dome-radius", 1e3, (5.0, 1000.0)),
    "port_distance_m": ("port_distance_mm", "--port-distance", 1e3, (0.5, 500.0)),
    _GLASS: ("glass_mm", "--glass", 1e3, (0.5, 500.0)),
    "n_glass": ("n_glass", "--n-glass", 1.0, (1.0, 2.0)),
    "n_water": ("n_water", "--n-water", 1.0, (1.0, 1.4)),
}
"""Options that give parameters of ports: field, name, units in one metre or index, range. Lengths
whose range begins below 1 mm may be 0, but not 0.006: that is one in metres."""


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Options as typed; `read_task` makes values of them.

    Lenses, ports and numbers of ports are texts as `words_by_camera` reads them.
    """

    cameras: tuple[str, ...] = ()
    """`NAME=PLACE` of each, the reference first."""
    target: str | None = None
    target_shape: Literal["sheet", "flat"] = "sheet"
    output: Path | None = None
    lens: str | None = None
    water: bool = False
    start: Path | None = None
    known: Intrinsics | None = None
    port: str | None = None
    dome_radius_mm: str | None = None
    port_distance_mm: str | None = None
    glass_mm: str | None = None
    n_glass: str | None = None
    n_water: str | None = None
    mount: str | None = None
    lever_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationTask:
    """Pictures to calibrate from, and prior knowledge."""

    options: CalibrateOptions
    places: Mapping[str, str]
    """Folder or pattern of pictures by camera; the first is the reference."""
    target: Target
    lenses: Mapping[str, str]
    """Lens model by camera, of `freedom.LENSES`, or `AUTO` for all."""
    ports: Mapping[str, str]
    """Kind of port by camera, of `optics.PORTS`, or `AUTO` for all; in air none has a port."""
    port_values: Mapping[str, Mapping[str, float]]
    """Known parameters of the ports by camera; of those that are found, first values."""
    port_sigmas: Mapping[str, Mapping[str, float]]
    """Prior sigmas of parameters that are known and found again, by camera."""
    start: Rig | None = None
    """These cameras as calibrated in air, or earlier."""
    known: Intrinsics = "free"
    """Treatment of the start's intrinsics."""

    @property
    def shape(self) -> TargetShape:
        """How the target may differ from its drawing."""
        is_flat = self.options.target_shape == "flat"
        return AS_DRAWN if is_flat else usual_shape(self.target.points)

    def cameras(self, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Camera]:
        """Cameras of the start, or blank ones of pictures of some sizes, behind their ports."""
        if self.start is None:
            return {
                name: blank_camera(size, self.lenses[name], self._port(name, NO_PORT))
                for name, size in sizes.items()
            }
        return {
            name: replace(camera, port=self._port(name, camera.port))
            for name, camera in self.start.cameras.items()
        }

    def _port(self, name: str, old: PortValues) -> PortValues:
        """First values of a port: those of the start, or usual ones, or as given."""
        kind = self.ports[name]
        port = old if old.shape == kind else PORTS[kind].guess()
        given = self.port_values[name].items()
        return port.with_parameters({k: v for k, v in given if k in port.parameters})

    def sigmas_of(self, cameras: Mapping[str, Camera]) -> dict[str, float]:
        """Prior sigmas of parameters that the cameras have, such as `left.n_glass`."""
        return {
            f"{name}.{parameter}": sigma
            for name, camera in cameras.items()
            for parameter, sigma in self.port_sigmas[name].items()
            if parameter in camera.parameters
        }


def read_task(options: CalibrateOptions) -> tuple[CalibrationTask, Path]:
    """The values that options state, checked before the work starts, and the folder to write.

    Raises:
        CalibrationError: options are missing, wrong, or do not go together.
        WorkspaceError: the output cannot be written or would take something with it.
    """
    places = places_of_cameras(options.cameras)
    if not places:
        raise CalibrationError(
            "these options are for pictures: give --left and --right, --pictures, or --camera; "
            "the pool of a survey takes none of them"
        )
    if options.target is None:
        raise CalibrationError("--target is missing: what is seen, such as 'chessboard 9x6 25mm'")
    if options.output is None:
        raise CalibrationError("-o is missing: the folder to write the calibration into")
    _check_output(options.output, options.start)
    start = None if options.start is None else read_rig(options.start)
    return task_of(options, places, parse_target(options.target), start), options.output


def task_of(
    options: CalibrateOptions, places: Mapping[str, str], target: Target, start: Rig | None
) -> CalibrationTask:
    """As `read_task`, of what options name.

    Raises:
        CalibrationError: options are wrong or do not go together.
    """
    start = None if start is None else _part(start, places)
    values, sigmas = _port_numbers(options, places)
    if not options.water:
        _check_in_air(options)
    if options.known in ("held", "prior") and start is None:
        raise CalibrationError(
            f"--intrinsics {options.known} needs --start, the rig.json of a calibration in air"
        )
    usual: Intrinsics = "prior"
    if start is None or start.covariance is None:
        usual = "free" if start is None else "held"
    ports = _ports(options, places, start)
    _check_ports(ports, values, start)
    if options.mount is not None:
        mount_pose(options.mount)
    elif options.lever_m is not None:
        raise CalibrationError(f"--lever goes with --mount: {MOUNTS}, or a file")
    return CalibrationTask(
        options=options, places=places, target=target, lenses=_lenses(options, places, start),
        ports=ports, port_values=values, port_sigmas=sigmas, start=start,
        known=options.known or usual,
    )  # fmt: skip


def _part(rig: Rig, places: Collection[str]) -> Rig:
    if not set(places) <= set(rig.cameras):
        raise CalibrationError(
            f"the start has cameras {', '.join(rig.cameras)}; pictures are of {', '.join(places)}"
        )
    return part_of_rig(rig, list(places))


def words_by_camera(text: str, cameras: Iterable[str], option: str) -> dict[str, str]:
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


def _auto_or_kinds(
    text: str, cameras: Iterable[str], option: str, kinds: Collection[str]
) -> dict[str, str]:
    """Words by camera that are names of some kind, or `AUTO` for all."""
    chosen, known = words_by_camera(text, cameras, option), (*kinds, AUTO)
    if AUTO in chosen.values() and len(set(chosen.values())) > 1:
        raise CalibrationError(f"{option} {text}: auto is for all cameras alike")
    for camera, kind in chosen.items():
        if kind not in known:
            wrong_kind = f"{kind!r} for {camera}" if kind else f"there is none for {camera}"
            raise CalibrationError(f"{option} {text}: {wrong_kind}; choose {', '.join(known)}")
    return chosen


def _port_numbers(
    options: CalibrateOptions, cameras: Collection[str]
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Parameters of the ports that are given, and their sigmas, by camera: `10`, or `10+-0.2`."""
    values: dict[str, dict[str, float]] = {camera: {} for camera in cameras}
    sigmas: dict[str, dict[str, float]] = {camera: {} for camera in cameras}
    for parameter, (field, option, unit, (minimum, maximum)) in _PORT_OPTIONS.items():
        text = getattr(options, field) or ""
        if parameter == "n_water" and "=" in text:
            raise CalibrationError(f"{option} {text}: all cameras look into one water")
        for camera, word in words_by_camera(text, cameras, option).items():
            number, is_known_to, sigma = word.partition("+-")
            try:
                value, spread = (float(part or "nan") for part in (number, sigma))
            except ValueError:
                value = spread = -1.0
            is_inside = minimum <= value <= maximum or (value == 0.0 and minimum < 1.0)
            if (number and not is_inside) or (is_known_to and not spread > 0.0):
                raise CalibrationError(
                    f"{option} {text}: {word!r} for {camera} is not a number from {minimum:g} to "
                    f"{maximum:g}{' mm' * (unit > 1.0)}, or one with its sigma, such as "
                    f"{maximum / 2:g}+-0.1"
                )
            if number:
                values[camera][parameter] = value / unit
            if is_known_to:
                sigmas[camera][parameter] = spread / unit
    return values, sigmas


def _check_in_air(options: CalibrateOptions) -> None:
    given = {option: getattr(options, field) for field, option, *_ in _PORT_OPTIONS.values()}
    given |= {"--port": options.port, "--intrinsics": options.known}
    names = [name for name, value in given.items() if value is not None]
    if names:
        raise CalibrationError(f"{', '.join(names)} need --water: pictures in air see no port")


def _lenses(
    options: CalibrateOptions, cameras: Collection[str], start: Rig | None
) -> dict[str, str]:
    """The lens model of each camera: as named, or the usual one of the start's lens."""
    if start is None or options.lens not in (None, AUTO):
        return _auto_or_kinds(options.lens or AUTO, cameras, "--lens", LENSES)
    return {name: USUAL_LENS[one.lens.model] for name, one in start.cameras.items()}


def _ports(
    options: CalibrateOptions, cameras: Collection[str], start: Rig | None
) -> dict[str, str]:
    """The kind of port of each camera: as named, or that of the start, or flat; none in air."""
    if not options.water:
        return dict.fromkeys(cameras, NoPort.shape)
    if options.port is not None:
        return _auto_or_kinds(options.port, cameras, "--port", PORTS)
    old = {} if start is None else start.cameras
    known = {name: one.port.shape for name, one in old.items() if one.port.parameters}
    return dict.fromkeys(cameras, FlatPort.shape) | known


def _check_ports(
    ports: Mapping[str, str], values: Mapping[str, Mapping[str, float]], start: Rig | None
) -> None:
    """Reject ports of which something is neither given nor known from the start."""
    for name, kind in ports.items():
        port = PORTS[FlatPort.shape if kind == AUTO else kind]
        if start is not None and start.cameras[name].port.shape == port.shape:
            continue
        needed = {field.name for field in fields(port) if field.default is MISSING}
        for parameter in sorted({*needed, _GLASS} & set(port.parameters) - set(values[name])):
            raise CalibrationError(
                f"--water with --port {kind} needs {_PORT_OPTIONS[parameter][1]} of {name}, in mm"
                + (" (0 for a thin film)" if parameter == _GLASS else "")
            )


def _check_output(output: Path, start: Path | None) -> None:
    """Reject a folder that is not of this command."""
    if not output.name or output.name == "..":
        raise WorkspaceError(f"-o {output}: name a new folder, such as -o air")
    if not output.exists():
        return
    if not output.is_dir():
        raise WorkspaceError(f"{output} is a file: name a folder with -o")
    others = sorted(path.name for path in output.iterdir() if path.name not in WRITTEN)
    if others:
        raise WorkspaceError(
            f"{output} holds other files (such as {others[0]}): choose another folder with -o"
        )
    if start is not None and start.resolve().parent == output.resolve():
        raise WorkspaceError(
            f"{output} holds the rig of --start, which would be replaced: choose another folder "
            "with -o"
        )
