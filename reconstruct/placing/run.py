"""The sparse stage: a model of all pictures, and its place in the world.

Two folders are written. `mapping/` holds the model in its own gauge, the long work; `sparse/` holds
it in world coordinates, so that a new scale or georeference does not repeat the mapping.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.artefacts import Stage, need_stage, read_json, run_stage, write_json
from alice_survey.base.config import ReconstructConfig, SurveyConfig
from alice_survey.base.contents import taken_from
from alice_survey.base.errors import ImageError
from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from alice_survey.base.manifest import read_manifest
from camera_calib.rig import Rig, read_rig
from reconstruct.mapping.database import as_transform
from reconstruct.mapping.mapper import model_baseline
from reconstruct.mapping.run import Inputs, check_sizes, run_mapping
from reconstruct.mapping.uncertainty import read_uncertainty
from reconstruct.placing.control_file import control_files
from reconstruct.placing.covariance import (
    PlaceCovariance,
    placed_covariances,
    shape_covariances,
    write_covariances,
)
from reconstruct.placing.find_place import SCALE_FILE, Placed, Placing, find_place
from reconstruct.placing.track import (
    TrackRow,
    read_track_poses,
    track_rows,
    track_sigmas,
    write_track_csv,
    write_track_geojson,
    write_track_tum,
)
from reconstruct.views.lens import lens_from_json
from reconstruct.views.model import datum_of, write_frame
from reconstruct.views.model_files import read_reconstruction

__all__ = ["SCALE_FILE", "read_track_poses", "run_sparse"]


def run_sparse(workspace: Path, config: SurveyConfig, executor: Executor) -> bool:
    """Write `mapping/` and `sparse/`.

    Args:
        workspace: folder of the survey, with finished `images/`; the rig is looked for in
            `calibration/rig.json`, then in `images/rig.json`.
        config: settings.
        executor: where tasks run.

    Returns:
        Whether there was anything to do.

    Raises:
        WorkspaceError: there are no pictures, or the rig is not that of the pictures.
        ReconstructionError: the pictures give no model.
    """
    inputs, survey, files = read_inputs(workspace)
    mapped = run_mapping(workspace, inputs, files, config.reconstruct, config.seed, executor)
    mapping = workspace / "mapping"
    if not mapping.is_dir():  # only checking
        return True
    scale_file = workspace / SCALE_FILE
    described = [f for f in files if f.suffix in (".csv", ".json")]
    stage = Stage(
        name="sparse",
        version=2,
        settings={"mount_sigma_deg": config.reconstruct.mount_sigma_deg},
        inputs=[
            mapping,
            *described,
            *([scale_file] if scale_file.is_file() else []),
            *control_files(workspace),
        ],
    )

    def work(partial: Path) -> None:
        _place(workspace, partial, inputs, survey, config.reconstruct)

    return run_stage(workspace, stage, work) or mapped


def read_inputs(workspace: Path) -> tuple[Inputs, dict[str, Any], list[Path]]:
    """Pictures, rig and datum of a workspace; `survey.json`; and all files these were read from."""
    images = need_stage(workspace, "images", "import-images")
    manifest, survey_file = images / "manifest.csv", images / "survey.json"
    records = read_manifest(manifest)
    if len(records) < 2:
        raise ImageError(f"{manifest}: {len(records)} pictures; 2 or more make a model")
    survey = read_json(survey_file)
    with taken_from(survey_file):
        datum = None if survey.get("datum") is None else datum_of(survey["datum"])
        texts = [*survey.get("notes", []), *([] if datum is None else [survey["vertical_datum"]])]
        if not all(isinstance(text, str) for text in texts):
            raise ValueError("notes or vertical_datum")
    candidates = (workspace / "calibration" / "rig.json", images / "rig.json")
    rig_file = next((path for path in candidates if path.is_file()), None)
    inputs = Inputs(
        images=images,
        records=tuple(records),
        rig=None if rig_file is None else read_rig(rig_file),
        datum=datum,
    )
    check_sizes(inputs)
    files = [manifest, survey_file, *([] if rig_file is None else [rig_file])]
    files += [images / r.image for r in records] + [images / r.mask for r in records if r.mask]
    return inputs, survey, files


def _place(
    workspace: Path,
    partial: Path,
    inputs: Inputs,
    survey: Mapping[str, Any],
    settings: ReconstructConfig,
) -> None:
    mapping = read_json(workspace / "mapping" / "mapping.json")
    cameras = read_json(workspace / "mapping" / "cameras.json")
    with taken_from(workspace / "mapping" / "cameras.json"):
        lenses = {name: lens_from_json(lens) for name, lens in cameras["cameras"].items()}
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
            survey=survey,
            mapping=mapping,
            settings=settings,
        )
    )

    move = placed.world_from_model
    rotation = pycolmap.Rotation3d(move.rotation.as_quat())
    model.transform(pycolmap.Sim3d(move.scale, rotation, move.translation))
    (partial / "model").mkdir()
    model.write_binary(partial / "model")
    model.export_PLY(partial / "sparse.ply")
    shutil.copyfile(workspace / "mapping" / "cameras.json", partial / "cameras.json")
    write_frame(partial / "frame.json", placed.frame)
    rows = track_rows(model, of_name, lenses, placed.frame, _mounts(rig))
    covariances = _covariances(workspace, partial, placed, rows)
    sigmas = track_sigmas(rows, covariances)
    write_track_csv(partial / "track.csv", rows, placed.frame, sigmas)
    write_track_tum(partial / "track.tum", rows)
    if placed.frame.datum is not None:
        write_track_geojson(partial / "track.geojson", rows, placed.frame, sigmas)
    if placed.fit is not None:
        write_json(partial / "georeference.json", placed.fit.to_json())
    if placed.control is not None:
        score = placed.control.score(move, located=placed.located)
        write_json(partial / "control.json", score)
    write_json(partial / "registration.json", _registration(model, mapping, placed, rows))


def _mounts(rig: Rig | None) -> dict[str, Rotation]:
    return {} if rig is None else {name: rig.body_from_cam(name).rotation for name in rig.cameras}


def _covariances(
    workspace: Path, partial: Path, placed: Placed, rows: Sequence[TrackRow]
) -> Array | None:
    """Of all poses in the world; written as far as known, None where their place is not known."""
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
    mapping: Mapping[str, Any],
    placed: Placed,
    rows: Sequence[TrackRow],
) -> dict[str, Any]:
    baseline = model_baseline(model)
    fit = placed.fit
    return {
        "registered": mapping["registered"],
        "total": mapping["total"],
        "stations": len({row.station for row in rows}),
        "models": mapping["models"],
        "points": int(model.num_points3D()),
        "mean_reprojection_px": float(model.compute_mean_reprojection_error()),
        "mean_track_length": float(model.compute_mean_track_length()),
        "baseline": baseline if np.isfinite(baseline) else None,
        "rig_factor": mapping["rig_factor"],
        "scale_source": placed.scale_source,
        "world_per_mapping_unit": placed.world_from_model.scale,
        "working_range": mapping["distances"],
        "georeference": None if fit is None else fit.to_json(),
    }
