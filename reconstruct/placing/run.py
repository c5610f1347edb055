"""The placing of a model in the world, apart from its mapping: the stage `sparse/`.

`mapping/` holds the model in its own gauge, the long work; `sparse/` holds it in world coordinates,
so that a new scale or georeference does not repeat the mapping.

Groups of stations that no point links are put where navigation has them. Pictures do not show where
such groups are relative to each other. Each is placed by its own navigation first, which brings it
near enough for the adjustment's linear motions of groups (see
`reconstruct.adjustment.uncertainty.SoftModes`); the model's place then finds these motions, with
navigation's errors correlated between groups as along the track.

Whether the mapping is credible is reported, not repaired: a station far off navigation may be a
jump of navigation as well as a wrong pose, and a scale that the rig's own stereo contradicts a
wrong rig as well as a bent model. Navigation shows how bent a model is
(`reconstruct.placing.alignment`); and a stereo rig carries its own yardstick to every station.
"""

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import read_csv
from alice_survey.core.block_solver import CAUCHY_TUNING, MAD_TO_SIGMA
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import WorkspaceError, collected_by, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import (
    AcceptanceRecord,
    BendRecord,
    CamerasRecord,
    DomingRecord,
    FarStation,
    GeoreferenceRecord,
    JointRecord,
    MappingRecord,
    RegistrationRecord,
    ScaleOfPairs,
    SimilarityRecord,
)
from alice_survey.core.run import progress
from camera_calib.freedom import knowing_water
from camera_calib.rig import Rig, rig_with_mount, write_rig
from reconstruct.adjustment.exact_observations import Workers
from reconstruct.adjustment.normal_equations import POSE
from reconstruct.adjustment.survey_fit import adjust_survey
from reconstruct.adjustment.uncertainty import SoftModes, write_uncertainty
from reconstruct.mapping.arrays import (
    Observed,
    cross_matrices,
    first_pictures,
    frames_of,
    ground_pixel,
    model_groups,
    observations,
)
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.run import UNREGISTERED, read_inputs, write_reasons
from reconstruct.mapping.working_range import ray_passes
from reconstruct.matching.pairs import positions_ned
from reconstruct.pictures.files import list_names
from reconstruct.placing.alignment import MIN_STATIONS, align_rigid, level
from reconstruct.placing.control import warn_of_contradictions
from reconstruct.placing.fit import PlacementFit, fit_navigation
from reconstruct.placing.navigation import (
    PLACE,
    SCALE,
    USUAL_INSTALLATION,
    Installation,
    body_from_pinhole,
    stated_sigmas,
)
from reconstruct.placing.place import Placing, find_place
from reconstruct.placing.track import (
    POSE_ORDER,
    pose_covariances,
    track_rows,
    track_sigmas,
    write_track_csv,
    write_track_geojson,
)
from reconstruct.views.model import read_warps, write_frame
from reconstruct.views.model_files import as_transform, read_reconstruction, rigid3d

_MAX_TURN_RAD = 0.1
"""Sigma of a group's turn about any axis up to which turns are linear."""


def join_groups(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig | None,
    datum: Datum | None,
    installed: Installation = USUAL_INSTALLATION,
) -> Mapped:
    """Move groups of linked stations to where navigation has them, seen from the largest.

    Args:
        mapped: its groups may be anywhere.
        records: pictures.
        rig: as calibrated; None where it is unknown.
        datum: origin of the local frame; None where no latitude and longitude are known.
        installed: how well it is known where the cameras are on the vehicle, and their clock.

    Returns:
        The model without those groups that navigation does not place or whose scale nothing gives,
        which are reported.
    """
    frames, groups = frames_of(mapped.model), model_groups(mapped.model)
    if not groups.any():
        return mapped
    model, notes = pycolmap.Reconstruction(mapped.model), []
    of_name = {record.image: record for record in records}
    members = [frames[groups == group].tolist() for group in range(int(groups.max()) + 1)]
    rig = rig_with_mount(rig)
    mounts = None if rig is None else body_from_pinhole(rig, mapped.warps)
    fits = [
        _place_group(model, of_frames, of_name, mounts, datum if mapped.scaled else None, installed)
        for of_frames in members
    ]
    for of_frames, fit in list(zip(members, fits, strict=True))[1:]:
        if fit is None or fits[0] is None:
            names = sorted(model.images[n].name for n in _pictures(model, of_frames))
            for frame in of_frames:
                model.deregister_frame(frame)
            notes.append(
                f"{len(names)} pictures make a separate model that neither points nor navigation "
                f"join to the largest: {list_names(names)}"
            )
            warn(notes[-1])
        else:
            first, own = (
                RigidTransform.from_components(
                    f.ned_from_model.translation, f.ned_from_model.rotation
                )
                for f in (fits[0], fit)
            )
            _move(model, of_frames, first.inv() * own)
            notes.append(f"{len(of_frames)} stations joined to the others by navigation alone")
    model.tear_down()  # what is left out is no longer in it at all
    model.update_point_3d_errors()
    return replace(mapped, model=model, notes=(*mapped.notes, *notes))


def joints_of(fit: PlacementFit, modes: SoftModes) -> tuple[JointRecord, ...]:
    """How well the place of each group after the first is known relative to the first.

    Args:
        fit: of the place and the modes.
        modes: of the model before they were found.
    """
    if modes.groups is None:
        return ()
    place, found = fit.ned_from_model, []
    turn, middles = place.rotation.as_matrix(), place.apply(modes.groups.middles)
    each = modes.joints // (len(middles) - 1)
    for group in range(1, len(middles)):
        away = middles[group] - middles[0]
        first = len(fit.joint) - each * (len(middles) - group)
        slopes = np.zeros((POSE, len(fit.joint)))
        slopes[:3, :3], slopes[:3, SCALE] = -cross_matrices(away[None])[0], away
        slopes[:3, first + 3 : first + 6] = place.scale * turn
        slopes[3:, first : first + 3] = turn
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", slopes, fit.joint, slopes))
        north, east, down = sigmas[:3].tolist()
        found.append(
            JointRecord(
                stations=int((modes.groups.station == group).sum()),
                sigma_north_m=north,
                sigma_east_m=east,
                sigma_depth_m=down,
                sigma_tilt_deg=float(np.rad2deg(np.sqrt((sigmas[3:5] ** 2).mean()))),
                sigma_heading_deg=float(np.rad2deg(sigmas[5])),
            )
        )
    return tuple(found)


def _place_group(
    model: pycolmap.Reconstruction,
    frames: Sequence[int],
    records: Mapping[str, ImageRecord],
    mounts: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
    installed: Installation,
) -> PlacementFit | None:
    """The place of a group by its own navigation; None where that leaves it loose."""
    numbers = _pictures(model, frames)
    poses = [as_transform(model.images[n].cam_from_world()).inv() for n in numbers]
    points = np.array([model.points3D[p].xyz for p in _points(model, numbers)]).reshape(-1, 3)
    if datum is None or len(points) < 3:
        return None
    centres = np.stack([pose.translation for pose in poses])
    with collected_by(lambda *_: None):  # of the whole model it is reported later
        fit = fit_navigation(
            [records[model.images[n].name] for n in numbers], poses, mounts, datum,
            level(points, centres), known_scale=1.0, installed=installed,
        )  # fmt: skip
    if fit is None:
        return None
    sigmas = np.sqrt(np.diag(fit.covariance)[:6])
    return fit if np.all(sigmas > 0) and sigmas[:3].max() <= _MAX_TURN_RAD else None


def _pictures(model: pycolmap.Reconstruction, frames: Sequence[int]) -> list[int]:
    inside = set(frames)
    posed = [n for n, image in model.images.items() if image.has_pose]
    return sorted(n for n in posed if model.images[n].frame_id in inside)


def _points(model: pycolmap.Reconstruction, pictures: Sequence[int]) -> list[int]:
    inside = set(pictures)
    return [
        number
        for number, point in sorted(model.points3D.items())
        if point.track.elements[0].image_id in inside
    ]


def _move(model: pycolmap.Reconstruction, frames: Sequence[int], motion: RigidTransform) -> None:
    """Move a group, in place."""
    points = _points(model, _pictures(model, frames))
    for frame in frames:
        pose = as_transform(model.frames[frame].rig_from_world)
        model.frames[frame].rig_from_world = rigid3d(pose * motion.inv())
    for number in points:
        model.points3D[number].xyz = motion.apply(model.points3D[number].xyz)


FAR_SIGMAS, FAR_M = 5.0, 0.5
"""A station is off navigation when it misses by more than both."""
SCALE_BOUND = 1e-3
"""Relative error of lengths that a known rig must not exceed."""
_MAX_LEFT_OUT = 0.25
"""Share of stations whose readings may be left out before that is worth a warning."""
_MIN_STATIONS = 5
_ROUNDS = 20
_MEDIAN_SIGMAS = 1.5382
"""Median length of a vector of three independent unit normal numbers."""
_SIGMAS = 3.0
_FIT_ROUNDS = 10
_MIN_STEREO_POINTS = 20


def measure_doming(model: pycolmap.Reconstruction, bends: Sequence[BendRecord]) -> DomingRecord:
    """Bring together how bent a model is, and warn where that is significant.

    Args:
        model: in metres; picture i has the id i + 1.
        bends: along and across, as navigation shows them.
    """
    seen = observations(model)
    along, across = (*bends, None, None)[:2]
    pixel_m = ground_pixel(model, seen)
    notes = [
        f"the model is bent {name} the block: {1e3 * bend.sag_m:+.1f} +/- "
        f"{1e3 * bend.sag_sigma_m:.1f} mm over {bend.length_m:.1f} m against navigation's "
        "depth and attitude, which the calibration does not allow for: calibrate again, or fly "
        "cross lines"
        for name, bend in (("along", along), ("across", across))
        if bend is not None and bend.is_significant(pixel_m)
    ]
    for note in notes:
        warn(note)
    return DomingRecord(
        along=along,
        across=across,
        scale=scale_of_pairs(model, seen),
        notes=tuple(notes),
        pixel_m=pixel_m if np.isfinite(pixel_m) else None,
    )


def scale_of_pairs(model: pycolmap.Reconstruction, seen: Observed) -> ScaleOfPairs | None:
    """The model's scale against the stereo of each station, as a mean over all.

    Args:
        model: on one rig.
        seen: its observations.

    Returns:
        None where too few stations have points that two of their cameras show.
    """
    frames = sorted(first_pictures(model))
    local = [given for f in frames if (given := _station_scale(model, seen, f)) is not None]
    if len(local) < MIN_STATIONS:
        return None
    mean, sigma = _robust_mean(*np.array(local).T)
    return ScaleOfPairs(mean=mean, mean_sigma=sigma)


def pinhole_positions(
    records: Sequence[ImageRecord], mounts: Mapping[str, RigidTransform], datum: Datum
) -> tuple[Array, Array]:
    """The pinholes' centres by navigation.

    Args:
        records: pictures.
        mounts: `body_from_pinhole` by camera.
        datum: of the positions.

    Returns:
        (N, 3) positions in NED and their sigmas, both metres; NaN where position, attitude or a
        sigma is unknown.
    """
    positions, sigmas = np.full((2, len(records), 3), np.nan)
    for i, (record, place) in enumerate(zip(records, positions_ned(records, datum), strict=True)):
        lever = mounts[record.camera].translation
        turn = np.deg2rad(max(record.sigma_attitude_deg, record.sigma_heading_deg))
        level, depth = record.sigma_horizontal_m, record.sigma_depth_m
        if record.has_attitude and min(level, depth, turn) > 0:
            positions[i] = place + record.ned_from_body.apply(lever)
            sigmas[i] = np.hypot([level, level, depth], turn * np.linalg.norm(lever))
    sigmas[np.isnan(positions)] = np.nan
    return positions, sigmas


def _robust_mean(values: Array, sigmas: Array) -> tuple[float, float]:
    """Mean of values (N,) of such sigmas by Cauchy's weights, and its sigma."""
    weight, mean, left = np.ones(len(values)), 0.0, values
    for _ in range(_FIT_ROUNDS):
        mean = float(np.average(values, weights=weight / sigmas**2))
        left = (values - mean) / sigmas
        spread = max(MAD_TO_SIGMA * float(np.median(np.abs(left))), 1e-12)
        weight = np.asarray(1.0 / (1.0 + (left / (CAUCHY_TUNING * spread)) ** 2), np.float64)
    free = weight.sum() * (len(values) - 1) / len(values)
    variance = float((weight * left**2).sum() / max(free, 1e-12))
    return mean, float(np.sqrt(max(1.0, variance) / (weight / sigmas**2).sum()))


def _station_scale(
    model: pycolmap.Reconstruction, seen: Observed, frame: int
) -> tuple[float, float] | None:
    """Depths of a frame's points over their depths by two of its cameras alone, and sigma.

    The two are those that share most points.
    """
    numbers = sorted(d.id for d in model.frames[frame].image_ids if model.images[d.id].has_pose)
    of = {n: seen.of(seen.row(n)) for n in numbers}
    shared = {
        (a, b): np.intersect1d(seen.point[of[a]], seen.point[of[b]], return_indices=True)
        for a, b in combinations(numbers, 2)
    }
    pair = max(shared, key=lambda found: len(shared[found][0]), default=None)
    if pair is None or len(shared[pair][0]) < _MIN_STEREO_POINTS:
        return None
    both, *at = shared[pair]
    first, second = (model.images[n] for n in pair)
    theirs = [of[n] for n in pair]
    poses = [as_transform(i.cam_from_world()) for i in (first, second)]
    first_from_second = poses[0] * poses[1].inv()
    starts, rays = [], []
    for image, pixels, pose in (
        (first, seen.pixels[theirs[0]][at[0]], RigidTransform.identity()),
        (second, seen.pixels[theirs[1]][at[1]], first_from_second),
    ):
        at_one = image.camera.cam_from_img(pixels)
        ray = np.column_stack([at_one, np.ones(len(both))])
        ray = pose.rotation.apply(ray / np.linalg.norm(ray, axis=1, keepdims=True))
        starts.append(np.broadcast_to(pose.translation, ray.shape))
        rays.append(ray)
    along, _ = ray_passes(starts[0], rays[0], starts[1], rays[1])
    # Noise of pixels is that of 1 / depth: its mean, unlike that of depths, is not pulled away.
    ratio = seen.in_cameras[theirs[0]][at[0], 2] / (along * rays[0][:, 2])
    ratio = ratio[np.isfinite(ratio)]
    spread = MAD_TO_SIGMA * float(np.median(np.abs(ratio - np.median(ratio))))
    return float(np.median(ratio)), max(1.2533 * spread / np.sqrt(len(ratio)), 1e-9)


@progress.step("judge the model")
def judge_model(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig,
    datum: Datum | None,
    bends: Sequence[BendRecord] = (),
) -> tuple[DomingRecord, AcceptanceRecord]:
    """How bent a model on a known rig is, and whether it is credible, by all that is known of it.

    Args:
        mapped: scaled by its rig; picture i of `records` has the id i + 1.
        records: pictures.
        rig: on which it was mapped.
        datum: of navigation's positions; None without.
        bends: along and across, as navigation shows them.
    """
    positions = sigmas = np.full((len(records), 3), np.nan)
    if rig.body_from_rig is not None and datum is not None:
        mounts = body_from_pinhole(rig, mapped.warps)
        positions, sigmas = pinhole_positions(records, mounts, datum)
    doming = measure_doming(mapped.model, bends)
    # What adjustments made of the rig, before its size was put back.
    rig_error = model_baseline(mapped.model) / (mapped.baseline * mapped.rig_factor) - 1.0
    accepted = check_mapping(mapped.model, records, positions, sigmas, rig_error, doming.scale)
    return doming, accepted


def check_mapping(
    model: pycolmap.Reconstruction,
    records: Sequence[ImageRecord],
    positions: Array,
    sigmas: Array,
    rig_error: float,
    scale: ScaleOfPairs | None,
) -> AcceptanceRecord:
    """Check a finished model on a known rig, and warn of what is wrong.

    Args:
        model: in metres; picture i of `records` has the id i + 1.
        records: pictures.
        positions: (N, 3) of the pinholes' centres in NED, as navigation has them; NaN where
            unknown.
        sigmas: (N, 3); the same for these.
        rig_error: relative error of the rig's baseline in the model; NaN without one.
        scale: of the model against its stations' own stereo.
    """
    numbers = sorted(first_pictures(model, positions + sigmas).values())
    usual, far = float("nan"), []
    if len(numbers) >= _MIN_STATIONS:
        rows = np.array(numbers) - 1
        poses = [as_transform(model.images[n].cam_from_world()).inv() for n in numbers]
        centres = np.array([pose.translation for pose in poses])
        off, sigma = navigation_residuals(centres, positions[rows], sigmas[rows])
        usual = float(np.median(off) / _MEDIAN_SIGMAS)
        over = off / sigma
        jumped = np.flatnonzero((off > FAR_M) & (over > FAR_SIGMAS))
        for k in jumped[np.argsort(-off[jumped], kind="stable")]:
            one = records[rows[k]]
            far.append(
                FarStation(station=one.station, image=one.image, off_m=off[k], sigmas=over[k])
            )
    notes = []
    if far:
        names = list_names([f"{f.image} ({f.off_m:.2f} m)" for f in far])
        notes.append(
            f"{len(far)} of {len(numbers)} stations lie more than {FAR_SIGMAS:.0f} sigmas and "
            f"{FAR_M} m from where navigation has them, which others miss by {usual:.2f} m: "
            f"{names}; look at these pictures and at navigation's log"
        )
    if abs(rig_error) > SCALE_BOUND:
        notes.append(
            f"the rig's baseline came out {100 * rig_error:+.2f} % off the calibrated one: lengths "
            "are not to be trusted"
        )
    if scale is not None and abs(scale.mean - 1) > max(SCALE_BOUND, _SIGMAS * scale.mean_sigma):
        notes.append(
            f"lengths are {100 * (scale.mean - 1):+.2f} +/- {100 * scale.mean_sigma:.2f} % off "
            "what every station's own stereo says: check the rig's calibration"
        )
    for note in notes:
        warn(note)
    return AcceptanceRecord(
        notes=tuple(notes),
        checked=len(numbers),
        far=tuple(far),
        rig_error=rig_error if np.isfinite(rig_error) else None,
    )


def warn_of_navigation(
    found: GeoreferenceRecord, records: Sequence[ImageRecord], *, controlled: bool
) -> None:
    """Warn where the placed model is many sigmas off navigation, and of the usual cause.

    Args:
        found: residuals of navigation, and what of it is left out.
        records: pictures, with the sigmas that navigation states.
        controlled: whether control took part.
    """
    sigmas = np.median(stated_sigmas(records)[:, :3], axis=0)
    said = [
        f"{off_m:.1f} m in {name}, of sigma {sigma:.2g} m"
        for name, sigma in zip(("north", "east", "depth"), sigmas, strict=True)
        if (off_m := getattr(found, f"rms_{name}_m") or 0.0) > max(FAR_SIGMAS * sigma, FAR_M)
    ]
    stations = len({record.station for record in records})
    said += [
        f"beyond use in {name} of {count} of {stations} stations"
        for name, count in found.left_out.items()
        if count > _MAX_LEFT_OUT * stations
    ]
    cause = "is a sign, a clock or a sigma wrong, or are pictures of two zooms one camera?"
    if controlled:
        cause = "does control contradict it by a sign, a zone or coordinates exchanged?"
    if said:
        warn(f"the model is off navigation by (rms) {'; '.join(said)}: {cause}")


def navigation_residuals(centres: Array, given: Array, sigmas: Array) -> tuple[Array, Array]:
    """Distances between places and where navigation has them, after a robust rigid alignment.

    Args:
        centres: (N, 3) in any frame, metres.
        given: (N, 3) in NED.
        sigmas: (N, 3) of those.

    Returns:
        (N,) distances, and (N,) their usual size by axis: the stated sigma or, where distances are
        usually larger than it says (drift), as large as they are.
    """
    stated = np.sqrt((sigmas**2).mean(axis=1))
    weight = np.ones(len(centres))
    off = np.zeros(len(centres))
    spread = 1.0
    for _ in range(_ROUNDS):
        moved = align_rigid(centres, given, weight / stated**2).apply(centres)
        off = np.linalg.norm(moved - given, axis=1)
        spread = max(float(np.median(off / stated)) / _MEDIAN_SIGMAS, 1e-9)
        weight = 1.0 / (1.0 + (off / (CAUCHY_TUNING * spread * stated)) ** 2)
    return off, stated * max(spread, 1.0)


_LEFT_OUT = "in a part of the model that neither pictures nor navigation tie to the rest"
_UNKNOWN = "not known: the mapping was made by an earlier version"


def run_sparse(
    workspace: Path,
    folder: Path,
    executor: Executor,
    *,
    reconstruct: ReconstructConfig,
    index_sigma: float,
) -> None:
    """Adjust the model of `mapping/` a last time, and place it in the world.

    Args:
        workspace: folder of the survey.
        folder: to write into.
        executor: where tasks run.
        reconstruct: settings.
        index_sigma: of the water's index, where the calibration did not find it in the same water.

    Raises:
        WorkspaceError: a file of the mapping is missing or damaged.
        ReconstructionError: what is known of the place contradicts itself.
    """
    inputs = read_inputs(workspace)
    mapping = MappingRecord.read(workspace / "mapping" / "mapping.json")
    mapped = Mapped(
        model=read_reconstruction(workspace / "mapping" / "model"),
        warps=read_warps(workspace / "mapping" / "cameras.json"),
        models=mapping.models,
        scaled=mapping.scaled,
        baseline=math.nan if mapping.baseline is None else mapping.baseline,
        rig_factor=1.0 if mapping.rig_factor is None else mapping.rig_factor,
        notes=mapping.notes,
    )
    installed = Installation.of(reconstruct)
    known = join_groups(mapped, inputs.records, inputs.rig, inputs.datum, installed)
    left = sum(image.has_pose for image in known.model.images.values())
    mapping = mapping.model_copy(update={"registered": left, "notes": known.notes})
    rig = inputs.rig
    if rig is not None and not reconstruct.refine_port:  # that finds the index from far off
        rig = knowing_water(rig, index_sigma)
    with executor.start() as started:
        workers = Workers(executor=started, folder=folder / "parts")
        adjusted = adjust_survey(
            known, inputs.records, rig, mapping.distances, reconstruct, workers=workers
        )
    shutil.rmtree(folder / "parts", ignore_errors=True)
    poses = {
        image.name: as_transform(image.cam_from_world()).inv()
        for image in adjusted.mapped.model.images.values()
        if image.has_pose
    }
    of_name = {r.image: r for r in inputs.records}
    names = sorted(poses)
    placed = find_place(
        Placing(
            workspace=workspace,
            adjusted=adjusted,
            records=[of_name[name] for name in names],
            pinholes=[poses[name] for name in names],
            datum=inputs.datum,
            survey=inputs.survey,
            mapping=mapping,
            settings=reconstruct,
        )
    )
    shape = adjusted.shape
    if placed.fit is not None and len(placed.fit.modes):
        adjusted = adjusted.deform(placed.fit.modes, placed.fit.joint[PLACE:, PLACE:])
    model, warps = pycolmap.Reconstruction(adjusted.mapped.model), adjusted.mapped.warps
    move, fit = placed.world_from_model, placed.fit
    rotation = pycolmap.Rotation3d(move.rotation.as_quat())
    model.transform(pycolmap.Sim3d(move.scale, rotation, move.translation))
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    model.export_PLY(folder / "sparse.ply")
    cameras = CamerasRecord.read(workspace / "mapping" / "cameras.json").to_json()
    in_mapping = cameras["images"]
    cameras["cameras"] = {name: warp.to_json() for name, warp in warps.items()}
    cameras["images"] = {name: of for name, of in in_mapping.items() if name in poses}
    CamerasRecord.save(folder / "cameras.json", cameras)
    if adjusted.exact is not None and adjusted.exact.fit.parameters:
        adjusted.exact.fit.record.write(folder / "port.json")
        if adjusted.exact.fit.contradiction is not None:
            warn(adjusted.exact.fit.contradiction.words)
        write_rig(folder / "rig.json", adjusted.exact.fit.rig)
    write_frame(folder / "frame.json", placed.frame)
    rig = adjusted.rig
    if rig is not None and fit is not None and fit.mount is not None:
        rig = replace(rig, body_from_rig=fit.mount.body_from_rig)
        write_rig(folder / "rig.json", rig)
    rows = track_rows(model, of_name, warps, placed.frame, rig_with_mount(rig))
    covariances = None
    if fit is not None or shape is not None:
        covariances = pose_covariances(rows, fit, shape, move)
        parts = ["place"] * (fit is not None)
        parts.append("no model covariance" if shape is None else "shape of the model")
        np.savez(
            folder / "track_covariance.npz", image=np.array([row.image for row in rows]),
            covariance=covariances, order=np.array(POSE_ORDER), parts=np.array("; ".join(parts)),
        )  # fmt: skip
    if adjusted.shape is not None:
        write_uncertainty(
            folder / "covariance.npz",
            adjusted.shape.move(move.scale, move.rotation, move.translation),
        )
    sigmas = track_sigmas(rows, None if fit is None else covariances)
    write_track_csv(folder / "track.csv", rows, placed.frame, sigmas)
    if placed.frame.datum is not None:
        write_track_geojson(folder / "track.geojson", rows, placed.frame, sigmas)
    if fit is not None:
        fit.record.write(folder / "georeference.json")
        controlled = placed.control is not None
        warn_of_navigation(fit.record, [of_name[name] for name in names], controlled=controlled)
    if placed.control is not None:
        score = placed.control.score(move, located=placed.located)
        warn_of_contradictions(score)
        score.write(folder / "control.json")
    doming = accepted = None
    if rig is not None and adjusted.mapped.scaled:
        bends = () if fit is None else fit.bends
        doming, accepted = judge_model(adjusted.mapped, inputs.records, rig, inputs.datum, bends)
    words, path = {}, workspace / "mapping" / UNREGISTERED
    if path.exists():
        found = read_csv(path, ("image", "reason"), exact=True, fault=WorkspaceError)[1]
        words = {row["image"]: row["reason"] for _, row in found}
    lost = {
        record.image: _LEFT_OUT if record.image in in_mapping else words.get(record.image, _UNKNOWN)
        for record in inputs.records
        if record.image not in poses
    }
    write_reasons(folder / UNREGISTERED, inputs.records, lost)
    baseline = model_baseline(model)
    RegistrationRecord(
        registered=mapping.registered,
        total=mapping.total,
        stations=len({row.station for row in rows}),
        models=mapping.models,
        joints=() if shape is None or fit is None else joints_of(fit, shape.modes),
        points=int(model.num_points3D()),
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
        mean_track_length=float(model.compute_mean_track_length()),
        baseline=baseline if np.isfinite(baseline) else None,
        rig_factor=mapping.rig_factor,
        scale_source=placed.scale_source,
        gauge=mapping.gauge,
        world_from_mapping=SimilarityRecord(
            scale=move.scale,
            quaternion_xyzw=tuple(move.rotation.as_quat().tolist()),
            translation=tuple(move.translation.tolist()),
        ),
        working_range=mapping.distances,
        doming=doming,
        acceptance=accepted,
        georeference=None if fit is None else fit.record,
    ).write(folder / "registration.json")
