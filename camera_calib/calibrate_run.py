"""The stage `calibration`, and calibration of any pictures of a target."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from alice_survey.artefacts import Stage, need_stage, read_json, run_stage
from alice_survey.config import CameraConfig, SurveyConfig
from alice_survey.errors import CalibrationError, WorkspaceError, warn
from alice_survey.manifest import read_manifest
from camera_calib.calibrate import (
    Intrinsics,
    blank_camera,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
)
from camera_calib.calibration import Calibration
from camera_calib.calibration_files import summary, write_calibration
from camera_calib.detect_views import Detections, Size, detect_views
from camera_calib.flat_port import FlatPortCamera
from camera_calib.freedom import intrinsics
from camera_calib.picture_sets import PictureSet, find_pictures, pair_pictures
from camera_calib.rig import Rig, design_rig, read_rig, write_rig
from camera_calib.target import Target, parse_target

_GUESSED_PORT_M = 0.02


def run_calibrate(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Calibrate the rig from `pool/` and write `calibration/`.

    Intrinsics, ports (with their normals) and the pose of the right camera are found together,
    from the design.

    Returns:
        True when done, False when nothing had changed.

    Raises:
        CalibrationError: too few usable views.
    """
    pool = need_stage(workspace, "pool", "image")
    stage = Stage(
        name="calibration",
        version=3,
        settings={
            "camera": config.camera.model_dump(mode="json"),
            "water": config.water.model_dump(mode="json"),
        },
        inputs=[pool / "manifest.csv", pool / "board.json", pool / "left", pool / "right"],
    )

    def work(folder: Path) -> None:
        board = read_json(pool / "board.json")
        target = Target(
            kind="chessboard",
            columns=board["columns"],
            rows=board["rows"],
            size_m=board["square_m"],
        )
        found = detect_views(_pool_pictures(pool), target, threads)
        _tell(found)
        start = design_rig(config.camera, config.water, _scale(found.sizes["left"], config.camera))
        calibration = calibrate_through_ports(found.views, target.points, start, "free")
        _finish(folder, calibration, found)

    return run_stage(workspace, stage, work)


def _pool_pictures(pool: Path) -> list[PictureSet]:
    stations: dict[int, dict[str, Path]] = {}
    for record in read_manifest(pool / "manifest.csv"):
        stations.setdefault(record.station, {})[record.camera] = pool / record.image
    return [PictureSet(name=str(n), paths=stations[n]) for n in sorted(stations)]


def _scale(size: Size, camera: CameraConfig) -> int:
    """How many times larger than designed the pixels of a pool's pictures are."""
    width, height = size
    scale = max(round(camera.width_px / width), 1)
    if (camera.width_px // scale, camera.height_px // scale) != (width, height):
        raise CalibrationError(
            f"the pool's pictures have {width} x {height} px, which is no whole fraction of the "
            f"camera's {camera.width_px} x {camera.height_px}: set [camera] width_px and height_px"
        )
    return scale


def _tell(found: Detections) -> None:
    """Warn of each picture in which the target was not found."""
    for rejection in found.rejections:
        if rejection.points == 0:
            warn(f"view {rejection.view}, {rejection.camera}: {rejection.reason}; left out")


def _finish(folder: Path, calibration: Calibration, found: Detections) -> Calibration:
    for rejection in calibration.rejections:
        what = f"{rejection.points} points" if rejection.points else "the picture"
        warn(f"view {rejection.view}, {rejection.camera}: {what} left out: {rejection.reason}")
    for line in calibration.warnings:
        warn(line)
    whole = replace(calibration, rejections=(*found.rejections, *calibration.rejections))
    write_calibration(folder, whole, found.views)
    return whole


@dataclass(frozen=True, kw_only=True)
class PictureCalibration:
    """What the user says of pictures to calibrate from."""

    pictures: Mapping[str, str]
    """Folder or pattern by camera; the first is the reference."""
    target: str
    """As `parse_target` reads it."""
    lens: str = "opencv5"
    water: bool = False
    """The pictures were taken under water, through the ports."""
    start: Path | None = None
    """rig.json of a calibration in air, or an earlier one."""
    known: Intrinsics | None = None
    """What is done with the intrinsics of `start`; None: prior if it has a covariance, or held."""
    port_distance_m: float | None = None
    """First value; it is found."""
    glass_thickness_m: float | None = None
    glass_sigma_m: float | None = None
    """The thickness is found too, known this well."""
    n_glass: float | None = None
    n_water: float | None = None
    carry_to_n: float | None = None
    """Also write the rig in water of this index."""


def calibrate_pictures(
    settings: PictureCalibration, output: Path, threads: int
) -> tuple[str, dict[str, Any]]:
    """Calibrate from pictures and write a folder of results.

    Returns:
        What was found, as text and as JSON values.

    Raises:
        CalibrationError: the pictures, the target or the settings do not give a calibration.
    """
    if output.exists() and not (output / "calibration.json").is_file() and any(output.iterdir()):
        raise WorkspaceError(f"{output} holds other files: choose another folder with -o")
    target = parse_target(settings.target)
    intrinsics(settings.lens)
    start = None if settings.start is None else read_rig(settings.start)
    _check_settings(settings, start)
    lists = {camera: find_pictures(place) for camera, place in settings.pictures.items()}
    found = detect_views(pair_pictures(lists), target, threads)
    _tell(found)
    calibration = _calibrated(settings, found, target, start)
    partial = output.with_name(f"{output.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    calibration = _finish(partial, calibration, found)
    if settings.carry_to_n is not None:
        write_rig(partial / "rig_carried.json", carried(calibration.rig, settings.carry_to_n))
    if output.exists():
        shutil.rmtree(output)
    partial.rename(output)
    data = summary(calibration)
    return _text(calibration, output, settings), data


def carried(rig: Rig, n_water: float) -> Rig:
    """The rig in other water, which says so."""
    old = next(iter(rig.cameras.values())).n_water
    return replace(
        rig.in_water(n_water),
        source=f"{rig.source}, carried from water of index {old:g} to {n_water:g}",
    )


def _check_settings(settings: PictureCalibration, start: Rig | None) -> None:
    ports = {
        "--port-distance": settings.port_distance_m,
        "--glass": settings.glass_thickness_m,
        "--glass-sigma": settings.glass_sigma_m,
        "--n-glass": settings.n_glass,
        "--n-water": settings.n_water,
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
    if settings.glass_thickness_m is None:
        thin = start is None or all(c.glass_thickness_m == 0.0 for c in start.cameras.values())
        if thin:
            raise CalibrationError(
                "--water needs --glass, the thickness of the port in metres (0 for a thin film)"
            )


def _calibrated(
    settings: PictureCalibration, found: Detections, target: Target, start: Rig | None
) -> Calibration:
    if start is not None:
        start = _matching(start, found.sizes)
    if not settings.water:
        return calibrate_in_air(found.views, target.points, found.sizes, settings.lens, start)
    sigmas = {}
    if settings.glass_sigma_m is not None:
        sigmas = {f"{name}.glass_thickness_m": settings.glass_sigma_m for name in found.sizes}
    if start is None:
        thickness_m = settings.glass_thickness_m
        port_m = settings.port_distance_m
        blank = {
            name: blank_camera(
                size,
                n_water=1.34 if settings.n_water is None else settings.n_water,
                n_glass=1.52 if settings.n_glass is None else settings.n_glass,
                port_distance_m=_GUESSED_PORT_M if port_m is None else port_m,
                glass_thickness_m=0.0 if thickness_m is None else thickness_m,
            )
            for name, size in found.sizes.items()
        }
        return calibrate_in_water_alone(found.views, target.points, blank, settings.lens, sigmas)
    start = replace(
        start, cameras={name: _behind_port(c, settings) for name, c in start.cameras.items()}
    )
    known = settings.known or ("held" if start.covariance is None else "prior")
    return calibrate_through_ports(found.views, target.points, start, known, settings.lens, sigmas)


def _behind_port(camera: FlatPortCamera, settings: PictureCalibration) -> FlatPortCamera:
    """A camera of the start behind the port and in the water that the user names."""
    given = {
        "glass_thickness_m": settings.glass_thickness_m,
        "n_glass": settings.n_glass,
        "n_water": settings.n_water,
        "port_distance_m": settings.port_distance_m,
    }
    if settings.n_water is None and camera.n_water == 1.0:
        given["n_water"] = 1.34
    if settings.port_distance_m is None and camera.port_distance_m == 0.0:
        given["port_distance_m"] = _GUESSED_PORT_M
    return camera.with_parameters({k: v for k, v in given.items() if v is not None})


def _matching(start: Rig, sizes: Mapping[str, Size]) -> Rig:
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
    names = list(sizes)
    to_first = start.cam_from_rig[names[0]].inv()
    return replace(
        start,
        cameras={name: start.cameras[name] for name in names},
        cam_from_rig={name: start.cam_from_rig[name] * to_first for name in names},
        body_from_rig=start.body_from_cam(names[0]),
    )


def _text(calibration: Calibration, output: Path, settings: PictureCalibration) -> str:
    rig, square = calibration.rig, (calibration.residuals_px**2).sum(axis=-1)
    points = int((square == square).sum())
    rows = [
        f"{len(calibration.views)} views, {points} points, {calibration.rms_px:.3f} px rms "
        f"(noise {calibration.noise_px:.3f} px); {len(calibration.warnings)} warnings",
    ]
    if len(rig.cameras) > 1:
        rows.append(f"baseline {rig.baseline_m:.6g} m")
    for name, sigma in rig.sigmas.items():
        if name.endswith(("fx_px", "port_distance_m", "normal_x", "normal_y")):
            camera, field = name.split(".")
            rows.append(f"{name:24} {rig.cameras[camera].parameter(field):12.6g} +- {sigma:.2g}")
    rows.append(f"rig in {output / 'rig.json'}; report in {output / 'report.html'}")
    if settings.carry_to_n is not None:
        rows.append(f"in water of index {settings.carry_to_n:g}: {output / 'rig_carried.json'}")
    return "\n".join(rows)
