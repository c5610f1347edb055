"""The placing of a model in the world, apart from its mapping.

`mapping/` holds the model in its own gauge, the long work; `sparse/` holds it in world coordinates,
so that a new scale or georeference does not repeat the mapping.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from alice_survey.base.records import (
    ControlRecord,
    GeoreferenceRecord,
    MappingRecord,
    RegistrationRecord,
)
from camera_calib.rig import Rig, read_rig
from reconstruct.mapping.database import as_transform
from reconstruct.mapping.mapper import model_baseline
from reconstruct.mapping.run import read_inputs
from reconstruct.mapping.uncertainty import read_uncertainty
from reconstruct.placing.covariance import (
    PlaceCovariance,
    placed_covariances,
    shape_covariances,
    write_covariances,
)
from reconstruct.placing.find_place import Placed, Placing, find_place
from reconstruct.placing.track import (
    TrackRow,
    read_track_poses,
    track_rows,
    track_sigmas,
    write_track_csv,
    write_track_geojson,
    write_track_tum,
)
from reconstruct.views.model import read_lenses, write_frame
from reconstruct.views.model_files import read_reconstruction

__all__ = ["read_track_poses", "run_sparse"]


def run_sparse(
    workspace: Path, folder: Path, executor: Executor, *, reconstruct: ReconstructConfig
) -> None:
    """Place the model of `mapping/` in the world.

    Raises:
        WorkspaceError: a file of the mapping is missing or damaged.
        ReconstructionError: what is known of the place contradicts itself.
    """
    inputs = read_inputs(workspace)
    mapping = MappingRecord.read(workspace / "mapping" / "mapping.json")
    lenses = read_lenses(workspace / "mapping" / "cameras.json")
    model = read_reconstruction(workspace / "mapping" / "model")
    of_name = {r.image: r for r in inputs.records}
    refined = workspace / "mapping" / "rig.json"  # where the settings ask for it
    rig = read_rig(refined) if refined.is_file() else inputs.rig
    poses = {
        image.name: as_transform(image.cam_from_world()).inv()
        for image in model.images.values()
        if image.has_pose
    }
    names = sorted(poses)
    placed = find_place(
        Placing(
            workspace=workspace,
            model=model,
            records=[of_name[name] for name in names],
            pinholes=[poses[name] for name in names],
            lenses=lenses,
            rig=rig,
            datum=inputs.datum,
            survey=inputs.survey,
            mapping=mapping,
            settings=reconstruct,
        )
    )

    move = placed.world_from_model
    rotation = pycolmap.Rotation3d(move.rotation.as_quat())
    model.transform(pycolmap.Sim3d(move.scale, rotation, move.translation))
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    model.export_PLY(folder / "sparse.ply")
    shutil.copyfile(workspace / "mapping" / "cameras.json", folder / "cameras.json")
    write_frame(folder / "frame.json", placed.frame)
    rows = track_rows(model, of_name, lenses, placed.frame, _mounts(rig))
    covariances = _covariances(workspace, folder, placed, rows)
    sigmas = track_sigmas(rows, covariances)
    write_track_csv(folder / "track.csv", rows, placed.frame, sigmas)
    write_track_tum(folder / "track.tum", rows)
    if placed.frame.datum is not None:
        write_track_geojson(folder / "track.geojson", rows, placed.frame, sigmas)
    if placed.fit is not None:
        GeoreferenceRecord.save(folder / "georeference.json", placed.fit.to_json())
    if placed.control is not None:
        score = placed.control.score(move, located=placed.located)
        ControlRecord.save(folder / "control.json", score)
    _registration(model, mapping, placed, rows).write(folder / "registration.json")


def _mounts(rig: Rig | None) -> dict[str, Rotation]:
    return {} if rig is None else {name: rig.body_from_cam(name).rotation for name in rig.cameras}


def _covariances(
    workspace: Path, partial: Path, placed: Placed, rows: Sequence[TrackRow]
) -> Array | None:
    """Covariances of all poses in the world; written as far as known, None where unknown."""
    poses = RigidTransform.concatenate([row.world_from_cam for row in rows])
    names, parts = [row.image for row in rows], []
    total = np.zeros((len(rows), 6, 6))
    if placed.fit is not None:
        fit = placed.fit
        place = PlaceCovariance(middle=fit.middle_ned, covariance=fit.covariance)
        total = total + placed_covariances(poses, place)
        parts.append("place")
    path = workspace / "mapping" / "covariance.npz"
    if path.is_file():
        found = read_uncertainty(path)
        reference = np.isin(names, found.images)
        stations = np.array([row.station for row in rows], dtype=np.int64)
        total = total + shape_covariances(
            poses, stations, reference, found, placed.world_from_model
        )
        parts.append("shape of the model")
    else:
        parts.append("no model covariance")
    if placed.fit is not None or path.is_file():
        write_covariances(partial / "track_covariance.npz", names, total, "; ".join(parts))
    return None if placed.fit is None else total


def _registration(
    model: pycolmap.Reconstruction,
    mapping: MappingRecord,
    placed: Placed,
    rows: Sequence[TrackRow],
) -> RegistrationRecord:
    baseline = model_baseline(model)
    fit = placed.fit
    return RegistrationRecord(
        registered=mapping.registered,
        total=mapping.total,
        stations=len({row.station for row in rows}),
        models=mapping.models,
        points=int(model.num_points3D()),
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
        mean_track_length=float(model.compute_mean_track_length()),
        baseline=baseline if np.isfinite(baseline) else None,
        rig_factor=mapping.rig_factor,
        scale_source=placed.scale_source,
        world_per_mapping_unit=placed.world_from_model.scale,
        working_range=mapping.distances,
        georeference=None if fit is None else GeoreferenceRecord.model_validate(fit.to_json()),
    )
