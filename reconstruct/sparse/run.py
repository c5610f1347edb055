"""The sparse stage: a model of all pictures, and its place in the world.

Two folders are written. `mapping/` holds the model in its own gauge, the long work; `sparse/` holds
it in world coordinates, so that a new scale or georeference does not repeat the mapping.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.artefacts import Stage, need_stage, read_json, run_stage, write_json
from alice_survey.config import SurveyConfig
from alice_survey.errors import ImageError, ReconstructionError
from alice_survey.frames import Datum
from alice_survey.manifest import ImageRecord, read_manifest
from camera_calib.rig import Rig, read_rig
from reconstruct.lenses.lens import Lens, lens_from_json
from reconstruct.mapping.mapper import as_transform, model_baseline
from reconstruct.mapping.run import Inputs, check_sizes, run_mapping
from reconstruct.model import WorldFrame, write_frame
from reconstruct.sparse.alignment import Similarity
from reconstruct.sparse.covariance import (
    PlaceCovariance,
    placed_covariances,
    write_covariances,
)
from reconstruct.sparse.georeference import Fit, fit_navigation, level
from reconstruct.sparse.track import (
    TrackRow,
    read_track_poses,
    track_rows,
    track_sigmas,
    write_track_csv,
    write_track_geojson,
    write_track_tum,
)

__all__ = ["read_track_poses", "run_sparse"]

SCALE_FILE = "scale.json"
"""In the workspace: one known length, as `scale_model` writes it."""
_PLACE_ONLY = "place; no model covariance"
"""What the covariances of poses consist of."""


def run_sparse(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Write `mapping/` and `sparse/`.

    Args:
        workspace: folder of the survey, with finished `images/`; the rig is looked for in
            `calibration/rig.json`, then in `images/rig.json`.
        config: settings.
        threads: how many processes.

    Returns:
        Whether there was anything to do.

    Raises:
        WorkspaceError: there are no pictures, or the rig is not that of the pictures.
        ReconstructionError: the pictures give no model.
    """
    inputs, survey, files = read_inputs(workspace)
    mapped = run_mapping(workspace, inputs, files, config, threads)
    mapping = workspace / "mapping"
    if not mapping.is_dir():  # only checking
        return True
    scale_file = workspace / SCALE_FILE
    described = [f for f in files if f.suffix in (".csv", ".json")]
    stage = Stage(
        name="sparse",
        version=2,
        settings={},
        inputs=[mapping, *described, *([scale_file] if scale_file.is_file() else [])],
    )

    def work(partial: Path) -> None:
        _place(workspace, partial, inputs, survey)

    return run_stage(workspace, stage, work) or mapped


def read_inputs(workspace: Path) -> tuple[Inputs, dict[str, Any], list[Path]]:
    """Pictures, rig and datum of a workspace; `survey.json`; and all files these were read from."""
    images = need_stage(workspace, "images", "import-images")
    manifest, survey_file = images / "manifest.csv", images / "survey.json"
    records = read_manifest(manifest)
    if len(records) < 2:
        raise ImageError(f"{manifest}: {len(records)} pictures; 2 or more make a model")
    survey = read_json(survey_file)
    candidates = (workspace / "calibration" / "rig.json", images / "rig.json")
    rig_file = next((path for path in candidates if path.is_file()), None)
    inputs = Inputs(
        images=images,
        records=tuple(records),
        rig=None if rig_file is None else read_rig(rig_file),
        datum=None if survey.get("datum") is None else Datum(**survey["datum"]),
    )
    check_sizes(inputs)
    files = [manifest, survey_file, *([] if rig_file is None else [rig_file])]
    files += [images / r.image for r in records] + [images / r.mask for r in records if r.mask]
    return inputs, survey, files


@dataclass(frozen=True, kw_only=True, eq=False)
class _Placed:
    """A model's place in the world."""

    world_from_model: Similarity
    frame: WorldFrame
    fit: Fit | None
    scale_source: str


def _place(workspace: Path, partial: Path, inputs: Inputs, survey: Mapping[str, Any]) -> None:
    mapping = read_json(workspace / "mapping" / "mapping.json")
    cameras = read_json(workspace / "mapping" / "cameras.json")
    lenses = {name: lens_from_json(lens) for name, lens in cameras["cameras"].items()}
    model = pycolmap.Reconstruction(workspace / "mapping" / "model")
    of_name = {r.image: r for r in inputs.records}
    poses = {
        image.name: as_transform(image.cam_from_world()).inv()
        for image in model.images.values()
        if image.has_pose
    }
    names = sorted(poses)
    records = [of_name[name] for name in names]
    pinholes = [poses[name] for name in names]
    levers = body_from_pinhole(inputs.rig, lenses)
    placed = _find_place(workspace, model, records, pinholes, levers, inputs, survey, mapping)

    move = placed.world_from_model
    rotation = pycolmap.Rotation3d(move.rotation.as_quat())
    model.transform(pycolmap.Sim3d(move.scale, rotation, move.translation))
    (partial / "model").mkdir()
    model.write_binary(partial / "model")
    model.export_PLY(partial / "sparse.ply")
    shutil.copyfile(workspace / "mapping" / "cameras.json", partial / "cameras.json")
    write_frame(partial / "frame.json", placed.frame)
    rig = inputs.rig
    mounts = {} if rig is None else {n: rig.body_from_cam(n).rotation for n in rig.cameras}
    rows = track_rows(model, of_name, lenses, placed.frame, mounts)
    covariances = None
    if placed.fit is not None:
        where = RigidTransform.concatenate([row.world_from_cam for row in rows])
        place = PlaceCovariance(middle=placed.fit.middle_ned, covariance=placed.fit.covariance)
        covariances = placed_covariances(where, place)
        names = [row.image for row in rows]
        write_covariances(partial / "track_covariance.npz", names, covariances, _PLACE_ONLY)
        write_json(partial / "georeference.json", placed.fit.to_json())
    sigmas = track_sigmas(rows, covariances)
    write_track_csv(partial / "track.csv", rows, placed.frame, sigmas)
    write_track_tum(partial / "track.tum", rows)
    if placed.frame.datum is not None:
        write_track_geojson(partial / "track.geojson", rows, placed.frame, sigmas)
    write_json(partial / "registration.json", _registration(model, mapping, placed, rows))


def body_from_pinhole(rig: Rig | None, lenses: Mapping[str, Lens]) -> dict[str, RigidTransform]:
    """Lever arms of the pinholes, metres; the identity without a rig, when navigation is theirs."""
    if rig is None:
        return dict.fromkeys(lenses, RigidTransform.identity())
    return {
        name: rig.body_from_cam(name) * lens.pinhole_from_cam.inv() for name, lens in lenses.items()
    }


def _find_place(
    workspace: Path,
    model: pycolmap.Reconstruction,
    records: Sequence[ImageRecord],
    pinholes: Sequence[RigidTransform],
    levers: Mapping[str, RigidTransform],
    inputs: Inputs,
    survey: Mapping[str, Any],
    mapping: Mapping[str, Any],
) -> _Placed:
    points = np.array([p.xyz for _, p in sorted(model.points3D.items())]).reshape(-1, 3)
    if len(points) < 3:
        raise ReconstructionError(f"the model has {len(points)} points only")
    centres = np.stack([p.translation for p in _by_station(records, pinholes)])
    levelled = level(points, centres)
    known = _known_scale(workspace, mapping)
    notes = [*survey.get("notes", []), *mapping["notes"]]
    fit = None
    if inputs.datum is not None:
        fit = fit_navigation(
            records,
            pinholes,
            levers,
            inputs.datum,
            levelled,
            known_scale=None if known is None else known[0],
        )
    if fit is not None and inputs.datum is not None:
        source = "scale from navigation" if known is None else known[1]
        frame = WorldFrame(
            name="ned",
            datum=inputs.datum,
            scaled=True,
            vertical_datum=str(survey["vertical_datum"]),
            notes=(*notes, source),
        )
        return _Placed(
            world_from_model=fit.ned_from_model, frame=frame, fit=fit, scale_source=source
        )
    factor, source = (1.0, "unscaled") if known is None else known
    notes.append("unscaled, no CRS" if known is None else f"{source}; no CRS")
    frame = WorldFrame(
        name="model",
        datum=None,
        scaled=known is not None,
        vertical_datum="mean plane of the sea floor in the pictures",
        notes=tuple(notes),
    )
    place = replace(levelled, scale=factor, translation=factor * levelled.translation)
    return _Placed(world_from_model=place, frame=frame, fit=None, scale_source=source)


def _known_scale(workspace: Path, mapping: Mapping[str, Any]) -> tuple[float, str] | None:
    """Metres in a unit of the mapped model and how they are known; None where they are not."""
    if mapping["scaled"]:
        return 1.0, "scale from the calibrated rig"
    path = workspace / SCALE_FILE
    if not path.is_file():
        return None
    scale = read_json(path)
    if scale.get("gauge") != mapping["gauge"]:
        raise ReconstructionError(
            f"{path} measures an earlier model: remove it, run 'alice-survey reconstruct', and "
            "measure the known length again with 'alice-survey scale'"
        )
    return float(scale["metres_per_unit"]), "scaled by one known length"


def _by_station(
    records: Sequence[ImageRecord], poses: Sequence[RigidTransform]
) -> list[RigidTransform]:
    order = sorted(range(len(records)), key=lambda i: (records[i].station, records[i].image))
    return [poses[i] for i in order]


def _registration(
    model: pycolmap.Reconstruction,
    mapping: Mapping[str, Any],
    placed: _Placed,
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
