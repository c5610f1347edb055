"""The calibration that options ask for: in air, under water, through which ports."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial

from alice_survey.core.errors import CalibrationError
from camera_calib.calibrate.detect_views import Detections, Size
from camera_calib.calibrate.housing import compare_housings, focal_ratios
from camera_calib.calibrate.options import AUTO, PORT_KINDS, CalibrateOptions, kinds_by_camera
from camera_calib.calibrate.solve import (
    blank_camera,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
    first_cameras,
)
from camera_calib.calibrate.start import same_numbering
from camera_calib.calibration import Calibration, TargetView
from camera_calib.camera import Camera
from camera_calib.freedom import LENSES, USUAL_LENS, LensNames, part_of_rig
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.optics import PORTS, likely_port
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.none import NO_PORT, NoPort
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig
from camera_calib.target_shape import shape_of
from camera_calib.targets.target import Target


def calibrated(
    settings: CalibrateOptions, found: Detections, target: Target, start: Rig | None
) -> Calibration:
    """The calibration that the settings ask for.

    Args:
        settings: of the command.
        found: views of the target.
        target: what they show.
        start: a rig calibrated in air, or an earlier one.

    Raises:
        CalibrationError: the views do not determine it.
    """
    points = target.points
    start = None if start is None else matching(start, found.sizes)
    lens = lens_names(settings, found.sizes, start)
    if not settings.water:
        bare = start_cameras(settings, found.sizes, start)
        start = None if start is None else replace(start, cameras=bare)
        views = _numbered(found, target, bare, lens, known=start is not None)
        shape = shape_of(target, settings.target_shape)
        return calibrate_in_air(views, points, found.sizes, lens, start, shape)
    ratios: dict[str, float] = {}
    if start is not None:
        views = _numbered(found, target, start.cameras, lens, known=True)
        ratios = focal_ratios(views, points, start, lens)
    kinds = port_kinds(settings, found.sizes, start)
    if AUTO in kinds.values():
        trials = {kind: dict.fromkeys(found.sizes, kind) for kind in PORTS}
        found_by = {
            k: partial(_through, settings, found, target, start, t) for k, t in trials.items()
        }
        calibration = compare_housings(found_by)
    else:
        try:
            calibration = _through(settings, found, target, start, kinds)
        except CalibrationError as error:
            raise CalibrationError(f"{error}{_other_housing(ratios, kinds)}") from None
    return replace(calibration, housing=replace(calibration.housing, focal_ratios=ratios))


def _other_housing(ratios: Mapping[str, float], kinds: Mapping[str, str]) -> str:
    """What focal lengths say against the ports, for the end of a message."""
    likely = {name: likely_port(ratio) for name, ratio in ratios.items()}
    against = [
        name
        for name, port in likely.items()
        if (port == FlatPort.shape) != (kinds[name] == FlatPort.shape)
    ]
    if not against:
        return ""
    name = against[0]
    return (
        f"; focal lengths of {name} under water are {ratios[name]:.3f} times those in air, which "
        f"says --port {likely[name]}"
    )


def _numbered(
    found: Detections,
    target: Target,
    cameras: Mapping[str, Camera],
    lens: LensNames,
    *,
    known: bool,
) -> tuple[TargetView, ...]:
    """Views whose points all cameras number alike."""
    if not target.is_ambiguous or len(cameras) < 2:
        return found.views
    views, points = found.views, target.points
    near = cameras if known else first_cameras(views, points, cameras, lens)
    return tuple(same_numbering(near, views, points, target.symmetries))


def _through(
    settings: CalibrateOptions,
    found: Detections,
    target: Target,
    start: Rig | None,
    kinds: Mapping[str, str],
) -> Calibration:
    """The calibration under water through ports of the named kinds."""
    points, lens = target.points, lens_names(settings, found.sizes, start)
    shape = shape_of(target, settings.target_shape)
    cameras = start_cameras(settings, found.sizes, start, kinds)
    views = _numbered(found, target, cameras, lens, known=start is not None)
    glass_mm = settings.glass_sigma_mm
    known_to = {
        "glass_thickness_m": None if glass_mm is None else glass_mm / 1e3,
        "n_glass": settings.n_glass_sigma,
        "n_water": settings.n_water_sigma,
    }
    sigmas = {
        f"{name}.{parameter}": sigma
        for name, camera in cameras.items()
        for parameter, sigma in known_to.items()
        if sigma is not None and parameter in camera.parameters
    }
    if start is None:
        return calibrate_in_water_alone(views, points, cameras, lens, sigmas, shape)
    known = settings.known or ("held" if start.covariance is None else "prior")
    start = replace(start, cameras=cameras)
    return calibrate_through_ports(views, points, start, known, lens, sigmas, shape)


def lens_names(
    settings: CalibrateOptions, cameras: Collection[str], start: Rig | None
) -> dict[str, str]:
    """The lens model of each camera: as named, or the usual one of the start's lens."""
    if settings.lens is not None:
        return kinds_by_camera(settings.lens, cameras, "--lens", LENSES)
    kinds = {} if start is None else {n: one.lens.model for n, one in start.cameras.items()}
    return {name: USUAL_LENS[kinds.get(name, OpenCVLens.model)] for name in cameras}


def port_kinds(
    settings: CalibrateOptions, cameras: Collection[str], start: Rig | None
) -> dict[str, str]:
    """The kind of port of each camera: as named, or that of the start, or flat; none in air.

    Raises:
        CalibrationError: a name is unknown, or auto is for some of the cameras only.
    """
    if not settings.water:
        return dict.fromkeys(cameras, NoPort.shape)
    if settings.port is not None:
        kinds = kinds_by_camera(settings.port, cameras, "--port", PORT_KINDS)
        if AUTO in kinds.values() and len(set(kinds.values())) > 1:
            raise CalibrationError(f"--port {settings.port}: auto is for all cameras alike")
        return kinds
    old = {} if start is None else {name: one.port for name, one in start.cameras.items()}
    return {
        name: old[name].shape if name in old and old[name].parameters else FlatPort.shape
        for name in cameras
    }


def start_cameras(
    settings: CalibrateOptions,
    sizes: Mapping[str, Size],
    start: Rig | None,
    kinds: Mapping[str, str] | None = None,
) -> dict[str, Camera]:
    """Cameras of the start, or blank ones, behind ports of some kinds, or of `port_kinds`."""
    kinds = port_kinds(settings, sizes, start) if kinds is None else kinds
    given = settings.port_values(sizes)
    if start is None:
        lens = lens_names(settings, sizes, None)
        return {
            name: blank_camera(size, lens[name], _port(kinds[name], NO_PORT, given[name]))
            for name, size in sizes.items()
        }
    return {
        name: replace(camera, port=_port(kinds[name], camera.port, given[name]))
        for name, camera in start.cameras.items()
    }


def _port(kind: str, old: PortValues, given: Mapping[str, float]) -> PortValues:
    """First values of a port of some kind: those of the start, or usual ones, or as given."""
    port = old if old.shape == kind else PORTS[kind].guess()
    return port.with_parameters({k: v for k, v in given.items() if k in port.parameters})


def matching(start: Rig, sizes: Mapping[str, Size]) -> Rig:
    """The cameras of a start that are calibrated, if its pictures have the same size."""
    if not set(sizes) <= set(start.cameras):
        raise CalibrationError(
            f"the start has cameras {', '.join(start.cameras)}; pictures are of {', '.join(sizes)}"
        )
    for name, size in sizes.items():
        camera = start.cameras[name]
        if (camera.width_px, camera.height_px) != size:
            raise CalibrationError(
                f"pictures of {name} have {size[0]} x {size[1]} px, the start's camera "
                f"{camera.width_px} x {camera.height_px}"
            )
    return part_of_rig(start, list(sizes))
