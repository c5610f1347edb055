"""Finding a model's place: by navigation, by control, by both, or level where there is neither."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError, WorkspaceError, warn
from alice_survey.base.frames import Datum
from alice_survey.base.manifest import ImageRecord
from alice_survey.base.records import MappingRecord, PicturesRecord, ScaleRecord
from alice_survey.base.run import progress
from alice_survey.stages import SCALE_FILE
from camera_calib.rig import Rig
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.control import ControlFit, tie_control
from reconstruct.placing.control_file import (
    CONTROL_FILE,
    MARKERS_FILE,
    PICKS_FILE,
    Control,
    read_control,
    read_picks,
)
from reconstruct.placing.georeference import PlacementFit, fit_control, fit_navigation, level
from reconstruct.placing.picked_points import Camera, find_spots
from reconstruct.views.lens import Lens
from reconstruct.views.model import WorldFrame

RIG_SCALE_SIGMA = 1e-3
"""Relative, of a scale that a rig gives, where control may correct it: what calibrated rigs reach
(600 ppm in the built-in demo; the baseline's own sigma leaves out the angle between cameras)."""
LENGTH_SCALE_SIGMA = 1e-2
"""Relative sigma of a scale from one length that a person measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A model's place in the world."""

    world_from_model: Similarity
    frame: WorldFrame
    fit: PlacementFit | None
    scale_source: str
    control: ControlFit | None
    """What is known of the site, where something is."""
    located: bool
    """Whether the world is that in which control points are known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placing:
    """What a place is found from."""

    workspace: Path
    model: pycolmap.Reconstruction
    records: Sequence[ImageRecord]
    """Registered pictures."""
    pinholes: Sequence[RigidTransform]
    """`model_from_pinhole` of these."""
    lenses: Mapping[str, Lens]
    rig: Rig | None
    datum: Datum | None
    survey: PicturesRecord
    mapping: MappingRecord
    settings: ReconstructConfig


@progress.step("place the model")
def find_place(task: Placing) -> Placed:
    """Place a model.

    Raises:
        ReconstructionError: the model is too small, or `scale.json` is of another model.
        WorkspaceError: a file of control is wrong.
    """
    points = np.array([p.xyz for _, p in sorted(task.model.points3D.items())]).reshape(-1, 3)
    if len(points) < 3:
        raise ReconstructionError(f"the model has {len(points)} points only")
    centres = np.stack([p.translation for p in _by_station(task.records, task.pinholes)])
    levelled = level(points, centres)
    known = _known_scale(task.workspace, task.mapping)
    scale = None if known is None else known.scale
    control = _read_control(task.workspace)
    datum = task.datum or control.datum()
    ties = _tie(task, control, datum)
    fit = _fit(task, levelled, scale, known, ties, datum)
    notes = [*task.survey.notes, *task.mapping.notes]
    shown = ties if control.points or control.lengths else None
    if fit is not None:
        source = _scale_source(known, ties)
        vertical = str(task.survey.vertical_datum) if task.datum else _VERTICAL_OF_CONTROL
        frame = WorldFrame(
            name="model" if datum is None else "ned",
            datum=datum,
            scaled=True,
            vertical_datum=vertical,
            notes=(*notes, source, *([_LOCAL] if datum is None else [])),
        )
        return Placed(
            world_from_model=fit.ned_from_model,
            frame=frame,
            fit=fit,
            scale_source=source,
            control=shown,
            located=True,
        )
    found = ties.bar_scale(scale, 0.0 if known is None else known.sigma)
    factor = 1.0 if scale is None else scale
    source = "unscaled" if known is None else known.source
    if found is not None:
        factor, source = found[0], _scale_source(known, ties)
    scaled = known is not None or found is not None
    notes.append(f"{source}; no CRS" if scaled else "unscaled, no CRS")
    frame = WorldFrame(
        name="model",
        datum=None,
        scaled=scaled,
        vertical_datum="mean plane of the sea floor in the pictures",
        notes=tuple(notes),
    )
    place = replace(levelled, scale=factor, translation=factor * levelled.translation)
    return Placed(
        world_from_model=place,
        frame=frame,
        fit=None,
        scale_source=source,
        control=shown if scaled else None,
        located=False,
    )


_VERTICAL_OF_CONTROL = "WGS 84 ellipsoid, or the level of the control points' depths"
_LOCAL = "placed by control points in their own north, east and depth; no CRS"


@dataclass(frozen=True, kw_only=True)
class _KnownScale:
    scale: float
    """Metres in a unit of the mapped model."""
    source: str
    sigma: float
    """Relative sigma of the scale."""


def body_from_pinhole(rig: Rig | None, lenses: Mapping[str, Lens]) -> dict[str, RigidTransform]:
    """Lever arms of the pinholes, metres; the identity without a rig, when navigation is theirs."""
    if rig is None:
        return dict.fromkeys(lenses, RigidTransform.identity())
    return {
        name: rig.body_from_cam(name) * lens.pinhole_from_cam.inv() for name, lens in lenses.items()
    }


def _fit(
    task: Placing,
    levelled: Similarity,
    scale: float | None,
    known: _KnownScale | None,
    ties: ControlFit,
    datum: Datum | None,
) -> PlacementFit | None:
    """The fit to navigation and control, to one of them, or None where nothing places it."""
    # Control corrects a known scale within its sigma; without control it is held.
    sigma = known.sigma if known is not None and ties.informs_scale else 0.0
    fit = None
    if task.datum is not None:
        fit = fit_navigation(
            task.records,
            task.pinholes,
            body_from_pinhole(task.rig, task.lenses),
            task.datum,
            levelled,
            known_scale=scale,
            mount_sigma_deg=task.settings.mount_sigma_deg,
            scale_sigma=sigma,
            control=ties.equations if ties.informs else None,
        )
    if fit is not None:
        return fit
    start = ties.start(scale)
    if start is None:
        if ties.used_points:
            warn(
                f"{len(ties.used_points)} control points do not place the model without "
                "navigation: three that are not on one line do"
            )
        return None
    return fit_control(
        task.records, task.pinholes, start, ties.equations, known_scale=scale, scale_sigma=sigma
    )


def _read_control(workspace: Path) -> Control:
    path = workspace / CONTROL_FILE
    return read_control(path) if path.is_file() else Control()


def _tie(task: Placing, control: Control, datum: Datum | None) -> ControlFit:
    """Find the known points in the pictures."""
    if not (control.points or control.lengths):
        return ControlFit(ties=(), bars=(), lost={})
    files = [task.workspace / name for name in (PICKS_FILE, MARKERS_FILE)]
    picks = [pick for path in files if path.is_file() for pick in read_picks(path)]
    if not picks:
        warn(
            f"{CONTROL_FILE} is not used: no point is picked in {PICKS_FILE} or {MARKERS_FILE}; "
            "'alice-survey control' finds markers and prepares picking"
        )
    strange = {p.image for p in picks} - {r.image for r in task.records}
    known = {r.image for r in task.records}
    if picks and strange and not known & {p.image for p in picks}:
        raise WorkspaceError(f"no picture of the model is picked; {min(strange)} is not in it")
    cameras = {
        record.image: Camera(lens=task.lenses[record.camera], model_from_pinhole=pose)
        for record, pose in zip(task.records, task.pinholes, strict=True)
    }
    spots, lost = find_spots(picks, cameras)
    wanted = {p.name for p in control.points} | {
        end for length in control.lengths for end in length.ends or ()
    }
    lost = {name: why for name, why in lost.items() if name in wanted}
    return tie_control(control, spots, lost, datum)


def _scale_source(known: _KnownScale | None, ties: ControlFit) -> str:
    source = "scale from navigation" if known is None else known.source
    if not ties.informs_scale:
        return source
    bars, points = len(ties.used_bars), len(ties.used_points)
    found = " and ".join(
        [
            *([f"{points} control points"] if points > 1 else []),
            *([f"{bars} known length{'s' * (bars > 1)}"] if bars else []),
        ]
    )
    return f"scale from {found}" if known is None else f"{source}, corrected by {found}"


def _known_scale(workspace: Path, mapping: MappingRecord) -> _KnownScale | None:
    """The known scale; None where nothing but navigation or control gives it."""
    if mapping.scaled:
        return _KnownScale(scale=1.0, source="scale from the calibrated rig", sigma=RIG_SCALE_SIGMA)
    path = workspace / SCALE_FILE
    measured = ScaleRecord.made(path)
    if measured is None:
        return None
    if measured.gauge != mapping.gauge:
        raise ReconstructionError(
            f"{path} measures an earlier model: remove it, run 'alice-survey reconstruct', and "
            "measure the known length again with 'alice-survey scale'"
        )
    return _KnownScale(
        scale=measured.metres_per_unit,
        source="scaled by one known length",
        sigma=LENGTH_SCALE_SIGMA,
    )


def _by_station(
    records: Sequence[ImageRecord], poses: Sequence[RigidTransform]
) -> list[RigidTransform]:
    order = sorted(range(len(records)), key=lambda i: (records[i].station, records[i].image))
    return [poses[i] for i in order]
