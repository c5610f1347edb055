"""The placing of a model in the world, apart from its mapping.

`mapping/` holds the model in its own gauge, the long work; `sparse/` holds it in world coordinates,
so that a new scale or georeference does not repeat the mapping.
"""

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import (
    AcceptanceRecord,
    CamerasRecord,
    ControlRecord,
    DomingRecord,
    GeoreferenceRecord,
    JointRecord,
    MappingRecord,
    PortRecord,
    RegistrationRecord,
    SimilarityRecord,
)
from camera_calib.freedom import knowing_water
from camera_calib.rig import Rig, mounted, write_rig
from reconstruct.adjustment.adjusted import adjust_survey
from reconstruct.adjustment.pixel_parts import Workers
from reconstruct.adjustment.uncertainty import Uncertainty, write_uncertainty
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.run import read_inputs
from reconstruct.mapping.unregistered import UNREGISTERED
from reconstruct.placing.acceptance import Acceptance, Doming, judge_model
from reconstruct.placing.control import warn_of_contradictions
from reconstruct.placing.groups import join_groups, joints_of
from reconstruct.placing.navigation_equations import PLACE, Installation
from reconstruct.placing.place import Placed, Placing, find_place
from reconstruct.placing.track import (
    TrackRow,
    pose_covariances,
    track_rows,
    track_sigmas,
    write_covariances,
    write_track_csv,
    write_track_geojson,
    write_track_tum,
)
from reconstruct.placing.unregistered import navigation_places, read_reasons, write_unregistered
from reconstruct.views.model import read_warps, write_frame
from reconstruct.views.model_files import as_transform, read_reconstruction

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
    known = join_groups(
        _mapped(workspace, mapping), inputs.records, inputs.rig, inputs.datum,
        Installation.of(reconstruct),
    )  # fmt: skip
    left = sum(image.has_pose for image in known.model.images.values())
    mapping = mapping.model_copy(update={"registered": left, "notes": known.notes})
    rig = inputs.rig
    if rig is not None and not reconstruct.refine_port:  # that finds the index from far off
        rig = knowing_water(rig, index_sigma)
    with executor.started() as started:
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
        adjusted = adjusted.deformed(placed.fit.modes, placed.fit.joint[PLACE:, PLACE:])
    model, warps = pycolmap.Reconstruction(adjusted.mapped.model), adjusted.mapped.warps
    move = placed.world_from_model
    rotation = pycolmap.Rotation3d(move.rotation.as_quat())
    model.transform(pycolmap.Sim3d(move.scale, rotation, move.translation))
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    model.export_PLY(folder / "sparse.ply")
    cameras = CamerasRecord.read(workspace / "mapping" / "cameras.json").to_json()
    cameras["cameras"] = {name: warp.to_json() for name, warp in warps.items()}
    cameras["images"] = {name: of for name, of in cameras["images"].items() if name in poses}
    CamerasRecord.save(folder / "cameras.json", cameras)
    if adjusted.exact is not None and adjusted.exact.fit.parameters:
        PortRecord.save(folder / "port.json", adjusted.exact.fit.to_json())
        if adjusted.exact.fit.contradiction is not None:
            warn(adjusted.exact.fit.contradiction.words)
        write_rig(folder / "rig.json", adjusted.exact.fit.rig)
    write_frame(folder / "frame.json", placed.frame)
    rig = adjusted.rig
    if rig is not None and placed.fit is not None and placed.fit.mount is not None:
        rig = replace(rig, body_from_rig=placed.fit.mount.body_from_rig)
        write_rig(folder / "rig.json", rig)
    known_mount = mounted(rig)
    mounts = (
        {}
        if known_mount is None
        else {n: known_mount.body_from_cam(n).rotation for n in known_mount.cameras}
    )
    rows = track_rows(model, of_name, warps, placed.frame, mounts)
    covariances = _covariances(folder, placed, rows, shape)
    if adjusted.shape is not None:
        write_uncertainty(
            folder / "covariance.npz",
            adjusted.shape.moved(move.scale, move.rotation, move.translation),
        )
    sigmas = track_sigmas(rows, covariances)
    write_track_csv(folder / "track.csv", rows, placed.frame, sigmas)
    write_track_tum(folder / "track.tum", rows)
    if placed.frame.datum is not None:
        write_track_geojson(folder / "track.geojson", rows, placed.frame, sigmas)
    if placed.fit is not None:
        GeoreferenceRecord.save(folder / "georeference.json", placed.fit.to_json())
    if placed.control is not None:
        score = placed.control.score(move, located=placed.located)
        warn_of_contradictions(score)
        ControlRecord.save(folder / "control.json", score)
    doming = accepted = None
    if rig is not None and adjusted.mapped.scaled:
        bends = () if placed.fit is None else placed.fit.bends
        doming, accepted = judge_model(adjusted.mapped, inputs.records, rig, inputs.datum, bends)
    joints = () if shape is None or placed.fit is None else joints_of(placed.fit, shape.modes)
    _unregistered(workspace, folder, inputs.records, rows, known_mount, placed)
    _registration(model, mapping, placed, rows, doming, accepted, joints).write(
        folder / "registration.json"
    )


def _unregistered(
    workspace: Path,
    folder: Path,
    records: Sequence[ImageRecord],
    rows: Sequence[TrackRow],
    rig: Rig | None,
    placed: Placed,
) -> None:
    """Say why pictures are not in the model, and place them by navigation where there is any."""
    registered = {row.image for row in rows}
    lost = [record for record in records if record.image not in registered]
    if not lost:
        return
    words = read_reasons(workspace / "mapping")
    mapped = CamerasRecord.read(workspace / "mapping" / "cameras.json").images
    words = {
        r.image: _LEFT_OUT if r.image in mapped else words.get(r.image, _UNKNOWN) for r in lost
    }
    datum, places = placed.frame.datum, None
    if datum is not None and placed.fit is not None:
        of_name = {record.image: record for record in records}
        places = navigation_places(lost, of_name, rows, rig, datum)
        if places.images:
            warn(
                f"{len(places.images)} of {len(lost)} pictures that are not in the model are "
                f"placed by navigation alone: sparse/{UNREGISTERED}"
            )
    write_unregistered(folder / UNREGISTERED, lost, words, places, datum)


def _mapped(workspace: Path, mapping: MappingRecord) -> Mapped:
    """The model of the mapping."""
    return Mapped(
        model=read_reconstruction(workspace / "mapping" / "model"),
        warps=read_warps(workspace / "mapping" / "cameras.json"),
        models=mapping.models,
        scaled=mapping.scaled,
        baseline=math.nan if mapping.baseline is None else mapping.baseline,
        rig_factor=1.0 if mapping.rig_factor is None else mapping.rig_factor,
        notes=mapping.notes,
    )


def _covariances(
    folder: Path, placed: Placed, rows: Sequence[TrackRow], shape: Uncertainty | None
) -> Array | None:
    """Covariances of all poses in the world; written as far as known, None where unknown.

    Args:
        folder: to write into.
        placed: place of the model.
        rows: the track.
        shape: of the model before its soft modes were found.
    """
    if placed.fit is None and shape is None:
        return None
    total = pose_covariances(rows, placed.fit, shape, placed.world_from_model)
    parts = [
        *(["place"] if placed.fit is not None else []),
        "no model covariance" if shape is None else "shape of the model",
    ]
    names = [row.image for row in rows]
    write_covariances(folder / "track_covariance.npz", names, total, "; ".join(parts))
    return None if placed.fit is None else total


def _registration(
    model: pycolmap.Reconstruction,
    mapping: MappingRecord,
    placed: Placed,
    rows: Sequence[TrackRow],
    doming: Doming | None,
    accepted: Acceptance | None,
    joints: tuple[JointRecord, ...],
) -> RegistrationRecord:
    baseline = model_baseline(model)
    fit = placed.fit
    return RegistrationRecord(
        registered=mapping.registered,
        total=mapping.total,
        stations=len({row.station for row in rows}),
        models=mapping.models,
        joints=joints,
        points=int(model.num_points3D()),
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
        mean_track_length=float(model.compute_mean_track_length()),
        baseline=baseline if np.isfinite(baseline) else None,
        rig_factor=mapping.rig_factor,
        scale_source=placed.scale_source,
        gauge=mapping.gauge,
        world_from_mapping=SimilarityRecord(
            scale=placed.world_from_model.scale,
            quaternion_xyzw=tuple(placed.world_from_model.rotation.as_quat().tolist()),
            translation=tuple(placed.world_from_model.translation.tolist()),
        ),
        working_range=mapping.distances,
        doming=None if doming is None else DomingRecord.model_validate(doming.to_json()),
        acceptance=None
        if accepted is None
        else AcceptanceRecord.model_validate(accepted.to_json()),
        georeference=None if fit is None else GeoreferenceRecord.model_validate(fit.to_json()),
    )
