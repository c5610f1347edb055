"""Calibrate from pictures of a target: `alice-survey calibrate --left ... --right ...`."""

import contextlib
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import read_json
from alice_survey.core.errors import CalibrationError, WorkspaceError
from alice_survey.core.executor import Executor, local_executor
from alice_survey.core.records import CalibrationRecord
from alice_survey.kit.words import with_sigma
from camera_calib.calibrate.by_options import (
    calibrated,
    lens_names,
    matching,
    start_cameras,
)
from camera_calib.calibrate.detect_views import Detections, detect_views
from camera_calib.calibrate.files import finish, summary, warn_of_unseen
from camera_calib.calibrate.moments import ClockOffset, clock_offset, track_of, views_at_moments
from camera_calib.calibrate.options import CalibrateOptions, check_settings
from camera_calib.calibrate.picture_sets import (
    PictureSet,
    check_own,
    find_pictures,
    pair_pictures,
    picture_times_s,
)
from camera_calib.calibrate.solve import (
    first_cameras,
)
from camera_calib.calibrate.text import calibration_text
from camera_calib.calibration import Calibration, TargetView
from camera_calib.mount import MOUNTS, check_mount, mount_line, with_mount
from camera_calib.rig import Rig, read_rig, write_rig
from camera_calib.targets.target import Target, parse_target

_WRITTEN = (
    "rig.json", "rig_carried.json", "calibration.json", "corners.csv", "report.html", "report.json",
)  # fmt: skip
"""Files of this command; a folder with other files is not replaced."""
_MAX_FIRST_VIEWS = 30
_MIN_FITTING = 0.5
"""Share of a camera's pictures that must fit those of the others."""


def calibrate_pictures(
    settings: CalibrateOptions, executor: Executor | None = None
) -> tuple[str, dict[str, Any]]:
    """Calibrate from pictures and write a folder of results.

    Returns:
        What was found, as text and as JSON values.

    Raises:
        CalibrationError: the pictures, the target or the settings do not give a calibration.
    """
    places, output = settings.places(), settings.output
    if settings.target is None:
        raise CalibrationError("--target is missing: what is seen, such as 'chessboard 9x6 25mm'")
    if output is None:
        raise CalibrationError("-o is missing: the folder to write the calibration into")
    _check_output(output, settings.start)
    target = parse_target(settings.target)
    lens_names(settings, places, start=None)
    start = None if settings.start is None else read_rig(settings.start)
    check_settings(settings, start)
    if settings.mount is not None:
        check_mount(settings.mount)
    elif settings.lever_m is not None:
        raise CalibrationError(f"--lever goes with --mount: {MOUNTS}, or a file")
    lists = {camera: find_pictures(place) for camera, place in places.items()}
    check_own(lists)
    clocks: Mapping[str, ClockOffset] = {}
    with _replacing(output) as partial:
        if settings.own_clocks:
            found, clocks = _on_one_clock(settings, lists, target, start, executor)
        else:
            found = detect_views(pair_pictures(lists), target, executor or local_executor())
            warn_of_unseen(found)
        # In the order of the options: the first camera is the reference.
        found = replace(found, sizes={name: found.sizes[name] for name in lists})
        calibration = calibrated(settings, found, target, start)
        rig = calibration.rig
        source = "; ".join([rig.source, *_clock_lines(clocks, rig.reference)])
        rig = replace(rig, source=source)
        if settings.mount is not None:
            rig = with_mount(rig, settings.mount, settings.lever_m)
        calibration = finish(partial, replace(calibration, rig=rig), found)
        CalibrationRecord.save(
            partial / "calibration.json",
            {
                **summary(calibration),
                "clocks": {name: asdict(offset) for name, offset in clocks.items()},
            },
        )
        if settings.carry_to_n is not None:
            write_rig(partial / "rig_carried.json", carried(calibration.rig, settings.carry_to_n))
    _check_useful(calibration, found, output)
    verdicts = read_json(output / "report.json")["verdicts"]
    text = calibration_text(calibration, target, verdicts)
    clock_lines = _clock_lines(clocks, calibration.rig.reference)
    text = "\n".join([text, *clock_lines, *_next(calibration, output, settings)])
    return text, read_json(output / "calibration.json")


def _on_one_clock(
    settings: CalibrateOptions,
    lists: Mapping[str, Sequence[Path]],
    target: Target,
    start: Rig | None,
    executor: Executor | None,
) -> tuple[Detections, dict[str, ClockOffset]]:
    """What the cameras saw when the first took its pictures, and the offsets of their clocks.

    Raises:
        CalibrationError: the target or the pictures do not show the clocks.
    """
    if len(lists) == 1 or target.is_ambiguous:
        raise CalibrationError(
            "--own-clocks needs two cameras or more, and a target whose corners have one numbering:"
            " an odd and an even count, such as 'chessboard 9x6 25mm', or markers"
        )
    times_s, sets = {}, []
    for name, paths in lists.items():
        for path, time_s in zip(paths, picture_times_s(name, paths), strict=True):
            sets.append(PictureSet(name=f"{name} {path.name}", paths={name: path}))
            times_s[sets[-1].name] = time_s
    found = detect_views(sets, target, executor or local_executor())
    warn_of_unseen(found)
    points = target.points
    start = None if start is None else matching(start, found.sizes)
    cameras = start_cameras(settings, found.sizes, start)
    if start is None:
        some = [
            view
            for name in cameras
            for view in _spread([v for v in found.views if name in v.pixels])
        ]
        cameras = first_cameras(some, points, cameras, lens_names(settings, found.sizes, None))
    tracks = {
        name: track_of(name, camera, found.views, times_s, points)
        for name, camera in cameras.items()
    }
    first, *others = tracks
    clocks = {
        name: clock_offset((first, name), tracks[first], tracks[name], cameras[name], points)
        for name in others
    }
    return replace(found, views=views_at_moments(tracks, clocks)), clocks


def _spread(views: Sequence[TargetView]) -> list[TargetView]:
    """Some views, evenly: enough for a first camera."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _MAX_FIRST_VIEWS).astype(int))
    return [views[v] for v in chosen]


def _clock_lines(clocks: Mapping[str, ClockOffset], reference: str) -> Iterator[str]:
    for name, offset in clocks.items():
        yield (
            f"clock of {name}: add {with_sigma(offset.seconds, offset.sigma_s)} s to its times to "
            f"get those of {reference} (from {offset.pictures} pictures)"
        )


def carried(rig: Rig, n_water: float) -> Rig:
    """The rig in other water, with a note in its source."""
    old = next(iter(rig.cameras.values())).n_water
    return replace(
        rig.in_water(n_water),
        source=f"{rig.source}, carried from water of index {old:g} to {n_water:g}",
    )


def _next(calibration: Calibration, output: Path, settings: CalibrateOptions) -> list[str]:
    """Location of the results, and what to do with them."""
    rig = shlex.quote(str(output / "rig.json"))
    lines = [f"rig in {output / 'rig.json'}; read {output / 'report.html'}"]
    lines.append(mount_line(calibration.rig))
    if calibration.rig.body_from_rig is None:
        lines.append(
            f"  state it with alice-survey camera mount {rig} nadir-bow-up --lever 0.55 -0.05 0.08 "
            f"-o {rig}, or let a survey with navigation find it"
        )
    if settings.carry_to_n is not None:
        lines.append(f"in water of index {settings.carry_to_n:g}: {output / 'rig_carried.json'}")
    if settings.water:
        lines.append(f"next: alice-survey camera uncertainty {rig}")
    else:
        given = {"pictures": settings.pictures, "left": settings.left, "right": settings.right}
        short = [f"--{option} {option[0].upper()}" for option, place in given.items() if place]
        long = [f"--camera {text.partition('=')[0]}=FOLDER" for text in settings.cameras]
        places = " ".join([*short, *long])
        lines.append(
            f"next, behind ports, with pictures under water: alice-survey calibrate {places} "
            f"--target T --water --glass MM --start {rig} -o DIR"
        )
    return lines


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


def _check_output(output: Path, start: Path | None) -> None:
    """Reject a folder that is not of this command before the work starts.

    Raises:
        WorkspaceError: it cannot be written or would take something with it.
    """
    if not output.name or output.name == "..":
        raise WorkspaceError(f"-o {output}: name a new folder, such as -o air")
    if not output.exists():
        return
    if not output.is_dir():
        raise WorkspaceError(f"{output} is a file: name a folder with -o")
    others = sorted(path.name for path in output.iterdir() if path.name not in _WRITTEN)
    if others:
        raise WorkspaceError(
            f"{output} holds other files (such as {others[0]}): choose another folder with -o"
        )
    if start is not None and start.resolve().parent == output.resolve():
        raise WorkspaceError(
            f"{output} holds the rig of --start, which would be replaced: choose another folder "
            "with -o"
        )


@contextlib.contextmanager
def _replacing(output: Path) -> Iterator[Path]:
    """A folder to write to that replaces `output` on success."""
    partial = output.with_name(f"{output.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    try:
        yield partial
        if output.exists():
            shutil.rmtree(output)
        partial.rename(output)
    finally:
        if partial.exists():
            shutil.rmtree(partial)
