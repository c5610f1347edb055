"""The placing of a model in the world, apart from its mapping: the stage `sparse/`.

`mapping/` holds the model in its own gauge, the long work; `sparse/` holds it in world coordinates,
so that a new scale or georeference does not repeat the mapping.

Groups of stations that no point links are put where navigation has them. Pictures do not show where
such groups are relative to each other. Each is placed by its own navigation first, which brings it
near enough for the adjustment's linear motions of groups (see
`reconstruct.adjustment.uncertainty.SoftModes`); the model's place then finds these motions, with
navigation's errors correlated between groups as along the track.
"""

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import read_csv
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import WorkspaceError, collected_by, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import (
    CamerasRecord,
    JointRecord,
    MappingRecord,
    RegistrationRecord,
    SimilarityRecord,
)
from camera_calib.freedom import knowing_water
from camera_calib.rig import Rig, rig_with_mount, write_rig
from reconstruct.adjustment.exact_observations import Workers
from reconstruct.adjustment.normal_equations import POSE
from reconstruct.adjustment.survey_fit import adjust_survey
from reconstruct.adjustment.uncertainty import SoftModes, write_uncertainty
from reconstruct.mapping.arrays import cross_matrices, frames_of, model_groups
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.run import UNREGISTERED, read_inputs, write_reasons
from reconstruct.pictures.files import list_names
from reconstruct.placing.acceptance import judge_model
from reconstruct.placing.alignment import level
from reconstruct.placing.control import warn_of_contradictions
from reconstruct.placing.fit import PlacementFit, fit_navigation
from reconstruct.placing.navigation import (
    PLACE,
    SCALE,
    USUAL_INSTALLATION,
    Installation,
    body_from_pinhole,
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
            notes.append(_leave_out(model, of_frames))
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


def _leave_out(model: pycolmap.Reconstruction, frames: Sequence[int]) -> str:
    """Take a group out of a model, in place; a line that says so."""
    names = sorted(model.images[n].name for n in _pictures(model, frames))
    for frame in frames:
        model.deregister_frame(frame)
    text = (
        f"{len(names)} pictures make a separate model that neither points nor navigation join to "
        f"the largest: {list_names(names)}"
    )
    warn(text)
    return text


def _move(model: pycolmap.Reconstruction, frames: Sequence[int], motion: RigidTransform) -> None:
    """Move a group, in place."""
    points = _points(model, _pictures(model, frames))
    for frame in frames:
        pose = as_transform(model.frames[frame].rig_from_world)
        model.frames[frame].rig_from_world = rigid3d(pose * motion.inv())
    for number in points:
        model.points3D[number].xyz = motion.apply(model.points3D[number].xyz)


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
            model=adjusted.mapped.model,
            records=[of_name[name] for name in names],
            pinholes=[poses[name] for name in names],
            warps=adjusted.mapped.warps,
            rig=adjusted.rig,
            datum=inputs.datum,
            survey=inputs.survey,
            mapping=mapping,
            settings=reconstruct,
            shape=adjusted.shape,
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
    known_mount = rig_with_mount(rig)
    mounts = (
        {}
        if known_mount is None
        else {n: known_mount.body_from_cam(n).rotation for n in known_mount.cameras}
    )
    rows = track_rows(model, of_name, warps, placed.frame, mounts)
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
