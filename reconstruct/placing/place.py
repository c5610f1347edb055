"""The place of a model in the world: by navigation, control points, a scale or the sea floor.

Where the mount of the cameras on the vehicle is unknown, it is found from its attitudes and the
pictures: a model placed by positions alone has attitudes of its own; what is between these and the
measured ones is the mount (the robot-world and hand-eye problem: Zhuang, Roth & Sudhakar 1994, with
the world's part solved first). The fit of the place then has the mount and the lever arm among its
unknowns, so that every sigma counts theirs.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import (
    Level,
    ReconstructionError,
    WorkspaceError,
    collected_by,
    note,
    warn,
)
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import ImageRecord, stored_name
from alice_survey.core.records import MappingRecord, PicturesRecord, ScaleRecord
from alice_survey.core.run import progress
from camera_calib.rig import rig_with_mount
from reconstruct.adjustment.survey_fit import AdjustedSurvey
from reconstruct.adjustment.uncertainty import SoftModes
from reconstruct.pictures.files import list_names
from reconstruct.placing.alignment import Similarity, level
from reconstruct.placing.control import (
    ControlFit,
    real_sigma_factor,
    tie_control,
    warn_of_coarse,
    widen,
    without_wrong_points,
)
from reconstruct.placing.control_points import (
    CONTROL_FILE,
    MARKERS_FILE,
    PICKS_FILE,
    Control,
    Pick,
    RegisteredPicture,
    read_control,
    read_picks,
    triangulate_picks,
)
from reconstruct.placing.fit import (
    LEVERS,
    MOUNTS,
    FoundMount,
    PlacementFit,
    fit_control,
    fit_navigation,
)
from reconstruct.placing.navigation import PLACE, SCALE, Installation, body_from_pinhole
from reconstruct.placing.track import picture_modes
from reconstruct.stages import SCALE_FILE, controls
from reconstruct.views.model import MEAN_PLANE, WorldFrame

_BEAM = np.tan(np.deg2rad(15.0))
"""Radius of what a sonar's beam covers over the altitude: echo sounders' beams are 30 degrees wide,
and a Doppler log's four, about as far apart, are averaged."""
_SIGMA_M = 0.1
"""Used where navigation states no sigma."""
_MIN_POINTS, _MIN_STATIONS = 5, 3


def scale_by_altitudes(
    records: Sequence[ImageRecord], centres: Array, points: Array
) -> tuple[float, float] | None:
    """Metres in a unit of the model, and their relative sigma.

    The sigma holds what all altitudes have wrong together, as large as stated, the relief within
    the beam, of which a sonar may see the nearest point or the mean, and the scatter.

    Args:
        records: pictures.
        centres: (N, 3) their cameras in the levelled model, third axis down.
        points: (P, 3) points of the levelled model.

    Returns:
        Scale and sigma; None with fewer than three stations that have an altitude and points below.
    """
    tree = KDTree(points[:, :2])
    first = {r.station: i for i, r in reversed(list(enumerate(records))) if r.altitude_m > 0}
    logs, reliefs, sigmas, places = [], [], [], []
    for i in sorted(first.values()):
        near = points[tree.query(centres[i, :2], min(_MIN_POINTS, len(points)))[1]]
        reach = _BEAM * float(np.median(near[:, 2]) - centres[i, 2])
        if not reach > 0:
            continue
        below = points[tree.query_ball_point(centres[i, :2], reach), 2] - centres[i, 2]
        below = below[below > 0]
        if len(below) < _MIN_POINTS:
            continue
        middle = float(np.median(below))
        logs.append(np.log(records[i].altitude_m / middle))
        reliefs.append(MAD_TO_SIGMA * float(np.median(np.abs(below - middle))) / middle)
        stated = records[i].sigma_altitude_m
        sigmas.append((stated if stated > 0 else _SIGMA_M) / records[i].altitude_m)
        places.append(np.append(centres[i, :2], middle))
    if len(logs) < _MIN_STATIONS:
        return None
    way, middles = np.array(places)[:, :2], np.array(places)[:, 2]
    length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    # Beams that overlap see the same relief: one beam's width of way counts once.
    count = min(len(logs), 1.0 + length / (2.0 * _BEAM * float(np.median(middles))))
    found = float(np.median(logs))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(np.array(logs) - found))) / np.sqrt(count)
    sigma = np.linalg.norm([np.median(sigmas), np.median(reliefs), scatter])
    return float(np.exp(found)), float(sigma)


_UNKNOWN_RAD, _UNKNOWN_LEVER_M = 1.0, 1.0
"""Sigmas of a mount of which nothing is known, about a first value, and of its lever arm."""
_MIN_PICTURES = 3
_MOUNT_STEPS = 8
_SETTLED_DEG = 1e-4
_TRIMS, _TRIMMED = 5, 3.0

Navigate = Callable[[Mapping[str, RigidTransform] | None, Installation], PlacementFit | None]
"""The fit of a model with such mounts of its cameras, known to these sigmas."""


def fit_with_mount(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    cam_from_rig: Mapping[str, RigidTransform],
    navigate: Navigate,
    usual: Installation,
) -> PlacementFit | None:
    """Place a model on a rig whose mount is unknown, and find the mount where attitudes show it.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model, in metres but for the scale.
        cam_from_rig: of the cameras.
        navigate: the fit.
        usual: sigmas of the clock and, where larger than a metre, of the lever arm.

    Returns:
        The fit, with the mount where there are attitudes; None where positions do not place the
        model. Of all fits on the way only this one's notes and warnings are reported.
    """
    fit, messages = _collect_messages(navigate, None, usual)
    first = None if fit is None else _first_mount(records, model_from_cam, cam_from_rig, fit)
    if first is not None:
        known = replace(usual, mount_rad=_UNKNOWN_RAD, lever_m=max(usual.lever_m, _UNKNOWN_LEVER_M))
        mount = RigidTransform.from_rotation(first)
        for _ in range(_MOUNT_STEPS):
            mounts = {name: mount * pose.inv() for name, pose in cam_from_rig.items()}
            found, said = _collect_messages(navigate, mounts, known)
            if found is None:
                break
            own = [found.stated.nuisances[name] for name in (*MOUNTS, *LEVERS)]
            turn_deg, arm_m = np.array([one.value for one in own]).reshape(2, 3)
            turn_sigma_deg, arm_sigma_m = np.array([one.sigma for one in own]).reshape(2, 3)
            mount = RigidTransform.from_components(
                mount.translation - arm_m,
                Rotation.from_rotvec(-turn_deg, degrees=True) * mount.rotation,
            )
            corrected = FoundMount(
                body_from_rig=mount, turn_sigma_deg=turn_sigma_deg, lever_sigma_m=arm_sigma_m
            )
            fit, messages = replace(found, mount=corrected), said
            if np.abs(turn_deg).max() < _SETTLED_DEG:
                break
    for kind, text in messages:
        (warn if kind == "warning" else note)(text)
    return fit


def _first_mount(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    cam_from_rig: Mapping[str, RigidTransform],
    fit: PlacementFit,
) -> Rotation | None:
    """Mean rotation from rig to body by most attitudes at a place; None where they are few."""
    turns = [
        r.ned_from_body.inv()
        * fit.ned_from_model.rotation
        * pose.rotation
        * cam_from_rig[r.camera].rotation
        for r, pose in zip(records, model_from_cam, strict=True)
        if r.has_attitude
    ]
    if len(turns) < _MIN_PICTURES:
        return None
    every = kept = Rotation.concatenate(turns)
    for _ in range(_TRIMS):
        off = (kept.mean().inv() * every).magnitude()
        kept = every[np.flatnonzero(off <= _TRIMMED * np.median(off) + 1e-12)]
    return kept.mean()


def _collect_messages(
    navigate: Navigate, mounts: Mapping[str, RigidTransform] | None, installed: Installation
) -> tuple[PlacementFit | None, list[tuple[Level, str]]]:
    """A fit, and its notes and warnings, which are not reported yet."""
    messages: list[tuple[Level, str]] = []
    with collected_by(lambda *message: messages.append(message)):
        return navigate(mounts, installed), messages


RIG_SCALE_SIGMA = 1e-3
"""Relative, of a scale that a rig gives, where control may correct it: what calibrated rigs reach
(600 ppm in the built-in demo; the baseline's own sigma leaves out the angle between cameras)."""
LENGTH_SCALE_SIGMA = 1e-2
"""Relative sigma of a scale from one length that a person measured."""
_WIDENED_TIMES = 5
_VERTICAL_OF_CONTROL = "WGS 84 ellipsoid, or the level of the control points' depths"
_LOCAL = "placed by control points in their own north, east and depth; no CRS"


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
    adjusted: AdjustedSurvey
    records: Sequence[ImageRecord]
    """Registered pictures."""
    pinholes: Sequence[RigidTransform]
    """`model_from_pinhole` of these."""
    datum: Datum | None
    survey: PicturesRecord
    mapping: MappingRecord
    settings: ReconstructConfig

    @property
    def points(self) -> Array:
        """(P, 3) of the model, by their ids."""
        points = self.adjusted.mapped.model.points3D
        return np.array([p.xyz for _, p in sorted(points.items())]).reshape(-1, 3)


@dataclass(frozen=True, kw_only=True)
class _KnownScale:
    scale: float | None = None
    """Metres in a unit of the mapped model; None where nothing but navigation or control says."""
    source: str = "scale from navigation"
    sigma: float = 0.0
    """Relative sigma of the scale."""
    held: bool = True
    """Whether the scale changes by control alone."""


@progress.step("place the model")
def find_place(task: Placing) -> Placed:
    """Place a model.

    Raises:
        ReconstructionError: the model is too small, or `scale.json` is of another model.
        WorkspaceError: a file of control is wrong.
    """
    points = task.points
    if len(points) < 3:
        raise ReconstructionError(f"the model has {len(points)} points only")
    order = sorted(
        range(len(task.records)), key=lambda i: (task.records[i].station, task.records[i].image)
    )
    levelled = level(points, np.stack([task.pinholes[i].translation for i in order]))
    known = _known_scale(task.workspace, task.mapping)
    if known.scale is None and task.datum is None:
        stations = levelled.apply(np.stack([pose.translation for pose in task.pinholes]))
        found = scale_by_altitudes(task.records, stations, levelled.apply(points))
        if found is not None:
            source = f"scale from altitudes, sigma {found[1]:.1%}"
            known = _KnownScale(scale=found[0], source=source, sigma=found[1], held=False)
    path = task.workspace / CONTROL_FILE
    control = read_control(path) if path.is_file() else Control()
    datum = task.datum or control.datum()
    ties = without_wrong_points(_tie(task, control, datum), known.scale)
    fit, local = _fit(task, levelled, known, ties)
    # Points that count for more than they are worth bend the model, and so hide what they miss by.
    for _ in range(_WIDENED_TIMES):
        if fit is None or local is not None:
            break
        freely = PLACE if fit.sigma_scale > 0 else SCALE
        factor = real_sigma_factor(ties.deform(fit.modes), fit.ned_from_model, freely)
        if factor == 1.0:
            break
        ties = widen(ties, factor)
        fit, local = _fit(task, levelled, known, ties)
    warn_of_coarse(ties)
    notes = [*task.survey.notes, *task.mapping.notes]
    if fit is not None:
        place = fit.ned_from_model
        source = _scale_source(known, ties)
        if not ties.informs_scale and known.held:
            source += f", sigma {_sigma_of(task, known, fit):.2g}"
        scaled, vertical = True, _VERTICAL_OF_CONTROL
        if local is not None:
            datum = None
        if local is not None or task.datum is not None:
            if any(record.readings["depth"] for record in task.records):
                vertical = str(task.survey.vertical_datum)
            elif local is not None or not ties.used_points:
                vertical = MEAN_PLANE
        notes += [source] if datum is not None else [source, local or _LOCAL]
    else:
        found = ties.bar_scale(known.scale, known.sigma)
        factor, source = 1.0, "unscaled"
        if known.scale is not None:
            factor, source = known.scale, known.source
        if found is not None:
            factor, source = found[0], _scale_source(known, ties)
        place = replace(levelled, scale=factor, translation=factor * levelled.translation)
        scaled, vertical = source != "unscaled", MEAN_PLANE
        turned = None if scaled else _turn_by_attitudes(task, levelled)
        if turned is not None:
            place, note = turned
            notes.append(f"unscaled; {note}")
        else:
            notes.append(f"{source}; no CRS" if scaled else "unscaled, no CRS")
        datum = None
    frame = WorldFrame(
        name="model" if datum is None else "ned",
        datum=datum,
        scaled=scaled,
        vertical_datum=vertical,
        notes=tuple(notes),
    )
    if fit is not None:
        ties = ties.deform(fit.modes)
    return Placed(
        world_from_model=place,
        frame=frame,
        fit=fit,
        scale_source=source,
        control=ties if (control.points or control.lengths) and scaled else None,
        located=fit is not None and local is None,
    )


def _fit(
    task: Placing, levelled: Similarity, known: _KnownScale, ties: ControlFit
) -> tuple[PlacementFit | None, str | None]:
    """The fit to navigation and control, to one of them, or None where nothing places it.

    Also, of a fit to navigation without positions, what of the place is the model's own.
    """
    # Control corrects a known scale within its sigma; without control it is held.
    sigma = known.sigma if ties.informs_scale or not known.held else 0.0
    fit, modes, joints = None, None, 0
    shape, warps = task.adjusted.shape, task.adjusted.mapped.warps
    if shape is not None:
        joints = shape.modes.joints
        modes = picture_modes(shape, task.records, task.pinholes)
        if shape.modes.calibration.size:  # the rig's scale is one of them
            sigma = 0.0
    rig, installed = rig_with_mount(task.adjusted.rig), Installation.of(task.settings)
    fit_to = partial(
        fit_navigation,
        task.records,
        task.pinholes,
        levelled=levelled,
        known_scale=known.scale,
        scale_sigma=sigma,
        modes=modes,
        joints=joints,
    )
    mounts = None if rig is None else body_from_pinhole(rig, warps)
    navigate = partial(fit_to, mounts, installed=installed)
    if task.datum is not None:
        control = ties.equations if ties.used_points or ties.used_bars else None
        pinhole_from_rig = _pinhole_from_rig(task)
        if rig is not None or pinhole_from_rig is None:
            fit = navigate(task.datum, control=control)
        else:
            fit = fit_with_mount(
                task.records,
                task.pinholes,
                pinhole_from_rig,
                lambda mounts, known: fit_to(mounts, task.datum, installed=known, control=control),
                installed,
            )
    attitudes = any(_is_turned(record) for record in task.records)
    if attitudes and rig is None and (fit is None or fit.mount is None):
        warn(
            "attitudes of the navigation are not used: how the cameras are mounted is unknown; "
            "state it with 'alice-survey camera convert --mount', and import with that --rig"
        )
    if fit is not None:
        return fit, None
    start = ties.start(known.scale)
    if start is None:
        if ties.used_points:
            warn(
                f"{len(ties.used_points)} control points do not place the model without "
                "navigation: three that are not on one line do"
            )
        bars = ties.bar_scale(known.scale, known.sigma) or (known.scale, sigma)
        fit = navigate(None, known_scale=bars[0], scale_sigma=bars[1])
        note = None if fit is None else _local_note(task.records, headed=rig is not None)
        return fit, note
    fit = fit_control(
        task.records, task.pinholes, start, ties.equations, known_scale=known.scale,
        scale_sigma=sigma, modes=modes, joints=joints,
    )  # fmt: skip
    return fit, None


def _turn_by_attitudes(task: Placing, levelled: Similarity) -> tuple[Similarity, str] | None:
    """Where attitudes turn a model that has no scale, and a note; None where none is of use."""
    nan = math.nan
    records = [
        replace(record, latitude_deg=nan, longitude_deg=nan, depth_m=nan) for record in task.records
    ]
    rig = rig_with_mount(task.adjusted.rig)
    if rig is None or not any(_is_turned(record) for record in records):
        return None
    mounts = body_from_pinhole(rig, task.adjusted.mapped.warps)
    fit = fit_navigation(
        records, task.pinholes, mounts, None, levelled=levelled, known_scale=1.0,
        installed=Installation.of(task.settings),
    )  # fmt: skip
    return None if fit is None else (fit.ned_from_model, _local_note(records, headed=True))


def _is_turned(record: ImageRecord) -> bool:
    return record.readings["roll and pitch"] or record.readings["heading"]


def _pinhole_from_rig(task: Placing) -> dict[str, RigidTransform] | None:
    """Poses of the pinholes on the rig; None where several cameras are no rig."""
    rig, warps = task.adjusted.rig, task.adjusted.mapped.warps
    if rig is not None:
        return {n: w.pinhole_from_cam * rig.cam_from_rig[n] for n, w in warps.items()}
    names = {record.camera for record in task.records}
    return {name: RigidTransform.identity() for name in names} if len(names) == 1 else None


def _local_note(records: Sequence[ImageRecord], *, headed: bool) -> str:
    """What of a place without positions is measured, and what is the model's own."""
    known = {name for record in records for name, known in record.readings.items() if known}
    axes = {
        "level": bool(known & {"depth", "roll and pitch"}),
        "depth": "depth" in known,
        "heading": headed and "heading" in known,
    }
    measured = " and ".join(name for name, has in axes.items() if has)
    own = " and ".join(["origin", *(name for name, has in axes.items() if not has)])
    return f"no latitude and longitude: {measured} by navigation, {own} the model's own; no CRS"


def picks_of_model(workspace: Path, images: Collection[str], known: Collection[str]) -> list[Pick]:
    """Picks of known points in the pictures of a model; what else of them is picked is named.

    Args:
        workspace: with `picks.csv` and `markers.csv`, or without.
        images: names of the pictures.
        known: names of the points and markers.

    Raises:
        WorkspaceError: a file is wrong, or nothing is picked in the model.
    """
    files = [workspace / name for name in (PICKS_FILE, MARKERS_FILE)]
    read = (pick for path in files if path.is_file() for pick in read_picks(path))
    own = (pick for pick in read if controls(pick.point, known))
    picks = [replace(pick, image=stored_name(pick.image, images)) for pick in own]
    if not picks:
        warn(
            f"{CONTROL_FILE} is not used: no point is picked in {PICKS_FILE} or {MARKERS_FILE}: "
            "mark them in the studio's tab Pictures, or find markers with 'alice-survey control'"
        )
    strange = sorted({pick.image for pick in picks} - set(images))
    found = [pick for pick in picks if pick.image in images]
    if strange:
        like = f"not in the model, whose pictures have names such as {min(images)}"
        if not found:
            raise WorkspaceError(f"no picture of the model is picked; {strange[0]} is {like}")
        warn(f"picks in {len(strange)} pictures are left out: {list_names(strange)}: {like}")
    return found


def _tie(task: Placing, control: Control, datum: Datum | None) -> ControlFit:
    """Find the known points in the pictures."""
    if not (control.points or control.lengths):
        return ControlFit(ties=(), bars=(), lost={})
    requested = {p.name for p in control.points} | {
        end for length in control.lengths for end in length.ends or ()
    }
    known = requested | {length.name for length in control.lengths}
    picks = picks_of_model(task.workspace, {record.image for record in task.records}, known)
    warps = task.adjusted.mapped.warps
    cameras = {
        record.image: RegisteredPicture(warp=warps[record.camera], model_from_pinhole=pose)
        for record, pose in zip(task.records, task.pinholes, strict=True)
    }
    picked, lost = triangulate_picks(picks, cameras)
    lost = {name: why for name, why in lost.items() if name in requested}
    found = tie_control(control, picked, lost, datum)
    shape = task.adjusted.shape
    if shape is None:
        return found
    return replace(found, motion_at=partial(_motions_near, KDTree(task.points), shape.modes))


def _motions_near(tree: KDTree, modes: SoftModes, places: Array) -> Array:
    """Motions (N, 3, K) of places (N, 3): those of the nearest points of the model."""
    return modes.points[np.asarray(tree.query(places)[1])].astype(np.float64)


def _scale_source(known: _KnownScale, ties: ControlFit) -> str:
    if not ties.informs_scale:
        return known.source
    return f"{known.source}, corrected by control" if known.scale else "scale from control"


def _sigma_of(task: Placing, known: _KnownScale, fit: PlacementFit) -> float:
    """Relative sigma of a model's scale: of a rig, what its errors do to the stations."""
    shape = task.adjusted.shape
    if known.scale is None or shape is None or not shape.modes.calibration.size:
        return fit.sigma_scale or known.sigma
    arms = np.stack([pose.translation for pose in task.pinholes])
    arms = arms - arms.mean(axis=0)
    soft = picture_modes(shape, task.records, task.pinholes)[:, :3] * shape.modes.known
    return float(np.linalg.norm(np.einsum("ni,nik->k", arms / (arms**2).sum(), soft)))


def _known_scale(workspace: Path, mapping: MappingRecord) -> _KnownScale:
    if mapping.scaled:
        return _KnownScale(scale=1.0, source="scale from the calibrated rig", sigma=RIG_SCALE_SIGMA)
    path = workspace / SCALE_FILE
    measured = ScaleRecord.read_existing(path)
    if measured is None:
        return _KnownScale()
    if measured.gauge != mapping.gauge:
        raise ReconstructionError(
            f"{path} measures an earlier model: remove it, run 'alice-survey reconstruct', and "
            "measure the known length again with 'alice-survey control'"
        )
    source = "scaled by one known length"
    return _KnownScale(scale=measured.metres_per_unit, source=source, sigma=LENGTH_SCALE_SIGMA)
