"""Calibrate from pictures of a target: `alice-survey calibrate --left ... --right ...`, or pool.

Where the lens or the housing is to be found, each is calibrated in turn, and the noise that each
leaves is compared, with a price for every parameter (G. Schwarz 1978, "Estimating the dimension of
a model").
"""

import contextlib
import math
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import (
    read_json,
    refuse_links,
    replace_folder,
    restore_folder,
    sync_folder,
)
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError, CalibrationError, offer
from alice_survey.core.executor import Executor, local_executor
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import BoardRecord
from camera_calib.calibrate.adjust import UnsettledError
from camera_calib.calibrate.detect_views import Detections, Size, detect_views
from camera_calib.calibrate.options import AUTO, CalibrateOptions, CalibrationTask, read_task
from camera_calib.calibrate.picture_sets import PictureSet, check_own, find_pictures, pair_pictures
from camera_calib.calibrate.results import calibration_text, warn_of_unseen, write_results
from camera_calib.calibrate.solve import (
    OUTLIER,
    Intrinsics,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
)
from camera_calib.calibration import Calibration, HousingTrial
from camera_calib.freedom import USUAL_LENS
from camera_calib.mount import mount_line, with_mount
from camera_calib.optics import PORTS
from camera_calib.rig import Rig, design_rig
from camera_calib.stages import calibration_shortfall
from camera_calib.targets.target import Target

_UNUSUAL = 2.0 * math.log(1000.0)
"""Criterion of a lens other than the usual one: it must be a thousand times likelier."""
_MIN_FITTING = 0.5
"""Share of a camera's pictures that must fit those of the others."""


def calibrate_pictures(
    options: CalibrateOptions, executor: Executor | None = None
) -> tuple[str, dict[str, Any]]:
    """Calibrate from pictures and write a folder of results.

    Returns:
        What was found, as text and as JSON values.

    Raises:
        CalibrationError: the pictures, the target or the options do not give a calibration.
    """
    task, output = read_task(options)
    lists = {camera: find_pictures(place) for camera, place in task.places.items()}
    check_own(lists)
    with _replacing(output) as partial:
        found = detect_views(pair_pictures(lists), task.target, executor or local_executor())
        warn_of_unseen(found)
        # In the order of the options: the first camera is the reference.
        found = replace(found, sizes={name: found.sizes[name] for name in lists})
        calibration = calibrate_task(task, found)
        if options.mount is not None:
            rig = with_mount(calibration.rig, options.mount, options.lever_m)
            calibration = replace(calibration, rig=rig)
        calibration = write_results(partial, calibration, found)
    _check_useful(calibration, found, output)
    verdicts = read_json(output / "report.json")["verdicts"]
    text = calibration_text(calibration, task.target, verdicts)
    text = "\n".join([text, *_next(calibration, task, output)])
    found_json = read_json(output / "calibration.json")
    return text, {**found_json, "shortfall": calibration_shortfall(output)}


def _next(calibration: Calibration, task: CalibrationTask, output: Path) -> Iterator[str]:
    """Location of the results, and what to do with them."""
    rig = output / "rig.json"
    yield f"rig in {rig}; read {output / 'report.html'}"
    yield mount_line(calibration.rig)
    if calibration.rig.body_from_rig is None:
        mounted = ("--mount", "nadir-bow-up", "--lever", 0.55, -0.05, 0.08, "--overwrite")
        command = offer("camera convert", rig, rig, *mounted)
        yield f"  state it with {command}, or let a survey with navigation find it"
    if not task.options.water:
        more = shlex.join(["--water", "--glass", "MM", "--start", str(rig)])
        yield f"next, under water through the ports: add {more}"


def _check_useful(calibration: Calibration, found: Detections, output: Path) -> None:
    """Reject a result that is no calibration, after its files are written for a look.

    Raises:
        CalibrationError: most pictures of a camera do not fit those of the others.
    """
    for name in calibration.rig.cameras:
        seen = sum(name in view.pixels for view in found.views)
        fits = sum(name in view.pixels for view in calibration.views)
        if fits < _MIN_FITTING * seen:
            raise CalibrationError(
                f"only {fits} of {seen} pictures of {name} fit those of the other cameras: are "
                "pictures of one number, or of one place in the lists, of one moment, and did the "
                f"cameras stay as they were to each other? ({output} shows more; do not use its "
                "rig.json)"
            )


@contextlib.contextmanager
def _replacing(output: Path) -> Iterator[Path]:
    """A folder to write to that replaces `output` on success."""
    partial = output.with_name(f"{output.name}.partial")
    refuse_links(output.parent, output, partial)
    restore_folder(output)
    shutil.rmtree(partial, ignore_errors=True)  # of a run that was killed
    partial.mkdir(parents=True)
    try:
        yield partial
        sync_folder(partial)
        replace_folder(output, partial)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def calibrate_task(task: CalibrationTask, found: Detections) -> Calibration:
    """The calibration that options ask for.

    Args:
        task: what is known before.
        found: views of its target.

    Raises:
        CalibrationError: the views do not determine it, or are not of the start's cameras.
    """
    _check_sizes(task, found)
    calibration = _likeliest(task, found)
    opposite = _opposite(calibration.rig, task.start)
    return replace(calibration, warnings=(*calibration.warnings, *opposite))


def _opposite(rig: Rig, start: Rig | None) -> Iterator[str]:
    """A warning of each camera that lies opposite to where the start, or its name, places it."""
    first, *others = rig.cameras
    for name in others:
        place = rig.cam_from_rig[name].inv().translation
        expected = np.array([1.0, 0.0, 0.0]) * ((first, name) == ("left", "right"))
        if start is not None:
            expected = start.cam_from_rig[name].inv().translation
        if place @ expected < -0.5 * np.linalg.norm(place) * np.linalg.norm(expected):
            yield (
                f"{name} lies opposite to where {'its name' if start is None else '--start'} has "
                f"it from {first}: exchange their pictures, unless both are upside down"
            )


def _check_sizes(task: CalibrationTask, found: Detections) -> None:
    """Check that pictures are as large as those that the start was calibrated from.

    Raises:
        CalibrationError: they are not.
    """
    for name, camera in ({} if task.start is None else task.start.cameras).items():
        if (camera.width_px, camera.height_px) != found.sizes[name]:
            size = " x ".join(map(str, found.sizes[name]))
            raise CalibrationError(
                f"pictures of {name} have {size} px, the start's camera "
                f"{camera.width_px} x {camera.height_px}"
            )


def _calibrate(task: CalibrationTask, found: Detections) -> Calibration:
    """The calibration with the lenses and through the ports of a task."""
    points, views, shape = task.target.points, found.views, task.shape
    cameras = task.cameras(found.sizes)
    start = None if task.start is None else replace(task.start, cameras=cameras)
    if not task.options.water:
        return calibrate_in_air(views, points, found.sizes, task.lenses, start, shape)
    sigmas = task.sigmas_of(cameras)
    if start is None:
        return calibrate_in_water_alone(views, points, cameras, task.lenses, sigmas, shape)
    return calibrate_through_ports(views, points, start, task.known, task.lenses, sigmas, shape)


def _likeliest(task: CalibrationTask, found: Detections) -> Calibration:
    """The calibration with the likeliest lens and housing, with how the others did.

    Raises:
        CalibrationError: none fits, or one of them did not settle and cannot be compared.
    """
    kinds = [
        replace(task, ports=ports, lenses=lenses)
        for ports in _kinds(task.ports, PORTS)
        for lenses in _kinds(task.lenses, USUAL_LENS.values())
    ]
    if len(kinds) == 1:
        return _calibrate(task, found)
    trials, calibrations, unlikely = [], [], []
    for one in kinds:
        port, lens = next(iter(one.ports.values())), next(iter(one.lenses.values()))
        try:
            fit = _calibrate(one, found)
        except UnsettledError:
            raise
        except AliceError as error:
            trials.append(HousingTrial(port=port, lens=lens, why=str(error)))
            continue
        calibrations.append(fit)
        unlikely.append(0.0 if one.lenses == kinds[0].lenses else _UNUSUAL)
        trials.append(HousingTrial(port=port, lens=lens, noise_px=fit.noise_px))
    if not calibrations:
        reasons = dict.fromkeys(f"{one.port} with {one.lens}: {one.why}" for one in trials)
        raise CalibrationError(f"no kind of camera fits the views: {'; '.join(reasons)}")
    criteria = np.add(_criteria(calibrations), unlikely).tolist()
    best = calibrations[int(np.argmin(criteria))]
    values = iter(criteria)
    scored = [one if one.why else replace(one, criterion=next(values)) for one in trials]
    return replace(best, housing_trials=tuple(scored))


def _kinds(chosen: Mapping[str, str], known: Iterable[str]) -> list[dict[str, str]]:
    """What is chosen by camera, or each of all kinds for all cameras."""
    if AUTO not in chosen.values():
        return [dict(chosen)]
    return [dict.fromkeys(chosen, kind) for kind in known]


def _criteria(calibrations: Sequence[Calibration]) -> list[float]:
    """Schwarz's criterion of each; correlated corners count as so many fewer.

    Pulls on the priors of lens and target add to it, as to the evidence by Laplace's method: else
    the housing that strains them most fits best at no charge. A point that one leaves out and
    another does not counts as the outlier that it is, and a port unlike those that are built as
    unlikely: a dome whose glass is at the pupil passes for flat.
    """
    coordinates = [2 * int(np.isfinite(one.residuals_px[..., 0]).sum()) for one in calibrations]
    least = min(calibrations, key=lambda one: one.noise_px)
    excess = 1.0 if least.spread is None else max(least.spread.excess, 1.0)
    most, criteria = max(coordinates), []
    for one, count in zip(calibrations, coordinates, strict=True):
        parameters = 0 if one.rig.covariance is None else len(one.rig.covariance.parameters)
        cost = 2.0 * most * math.log(one.noise_px) + 0.5 * OUTLIER**2 * (most - count)
        unusual = sum(
            ((port.parameter(name) - port.guess().parameter(name)) / port.spreads[name]) ** 2
            for port in (camera.port for camera in one.rig.cameras.values())
            for name in port.spreads.keys() & {*port.estimated}
        )
        off, bent = one.freedom.prior.misfit(one.rig), one.shape.values / one.shape.prior_sigmas
        pull = off @ one.freedom.prior.information @ off + bent @ bent
        criteria.append(
            cost / excess + parameters * math.log(most / excess) + unusual + float(pull)
        )
    return criteria


def run_calibrate(
    workspace: Path, folder: Path, executor: Executor, *, camera: CameraConfig, water: WaterConfig
) -> None:
    """Calibrate the rig from `pool/`.

    Intrinsics, ports (with their normals) and the pose of the right camera are found together,
    from the design, or from the pictures in air where there are some.

    Raises:
        CalibrationError: too few usable views.
    """
    pool = workspace / "pool"
    board = BoardRecord.read(pool / "board.json")
    target = Target(
        kind="chessboard", columns=board.columns, rows=board.rows, size_m=board.square_m
    )
    found = detect_views(_pool_pictures(pool), target, executor)
    warn_of_unseen(found)
    start = design_rig(camera, water, _scale(found.sizes["left"], camera))
    lens = USUAL_LENS[camera.lens]
    known: Intrinsics = "free"
    if (pool / "air").is_dir():
        seen = detect_views(_pool_pictures(pool / "air"), target, executor)
        dry = calibrate_in_air(seen.views, target.points, seen.sizes, lens).rig
        cameras = {
            name: replace(one, port=start.cameras[name].port) for name, one in dry.cameras.items()
        }
        start, known = replace(dry, cameras=cameras, body_from_rig=start.body_from_rig), "prior"
    calibration = calibrate_through_ports(found.views, target.points, start, known, lens)
    write_results(folder, calibration, found)


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
            f"the pool's pictures have {width} x {height} px, which is not a whole fraction of the "
            f"camera's {camera.width_px} x {camera.height_px}: set [camera] width_px and height_px"
        )
    return scale
