"""The long part of the sparse stage: features, matches and the model, in its own gauge.

It writes `mapping/`: `model/` (COLMAP, ideal pinholes), `cameras.json`, `mapping.json`. An
interrupted run goes on with the features it has.
"""

import hashlib
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from alice_survey.core.artefacts import atomic_path, write_csv
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import ImageError, WorkspaceError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord, read_manifest
from alice_survey.core.records import (
    CamerasRecord,
    MappingRecord,
    PictureCamera,
    PicturesRecord,
    RangeRecord,
    RefractionRecord,
)
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.rig import Rig, read_rig, rig_with_mount
from reconstruct.mapping.database import Observations, VerifiedPair
from reconstruct.mapping.mapper import Mapped, map_calibrated
from reconstruct.mapping.refraction import refract
from reconstruct.mapping.self_calibration import SIMPLE, map_self_calibrated
from reconstruct.mapping.working_range import (
    ANY_DISTANCE,
    find_distances,
    first_stations,
    refuse_exchanged,
    warn_of_warps,
    warp_record,
)
from reconstruct.matching.features import find_features, load_features, save_features
from reconstruct.matching.learned import Taken, all_pixels, quarter_turns, with_learned
from reconstruct.matching.matches import PairTask, coarse_matches, match_pair
from reconstruct.matching.pairs import SMALL_SET, Pair, alike_pairs, choose_pairs, placed_pictures
from reconstruct.matching.refinement import refine_tracks
from reconstruct.pictures.files import exif_focal_px, list_names
from reconstruct.pictures.normalise import even_light, finely, normalise, read_deep
from reconstruct.pictures.undistorted import read_colour, read_mask
from reconstruct.stages import rig_file
from reconstruct.views.model import datum_of
from reconstruct.views.model_files import colmap_pinhole

UNREGISTERED = "unregistered.csv"
"""In `mapping` and in `sparse`."""
FEW_FEATURES = 100
"""Features of a picture below which that is why it has no matches."""


def reasons(
    images: Sequence[str],
    registered: Collection[str],
    features: Sequence[int],
    pairs: Sequence[VerifiedPair],
) -> dict[str, str]:
    """What kept each picture out of the model, in words.

    Args:
        images: names of all pictures.
        registered: those in the model.
        features: how many each has.
        pairs: verified matches between pictures, by their numbers.

    Returns:
        By name, of those that are not in the model.
    """
    inside = np.array([image in registered for image in images])
    joined = np.array([(i, j) for i, j, _ in pairs], dtype=np.int64).reshape(-1, 2)
    tied = np.bincount(joined.ravel(), minlength=len(images))
    links = coo_matrix((np.ones(len(joined)), joined.T), shape=(len(images),) * 2)
    part = connected_components(links, directed=False)[1]
    size, kept = np.bincount(part), np.bincount(part, weights=inside)
    words = {}
    for n in np.flatnonzero(~inside).tolist():
        if features[n] < FEW_FEATURES:
            why = f"{features[n]} features: too dark, too blurred or without texture"
        elif not tied[n]:
            why = (
                f"{features[n]} features, but no other picture matches it: no overlap, or the "
                "water hides what they share"
            )
        elif kept[part[n]] == 0:
            why = (
                f"one of {size[part[n]]} pictures that match each other and no picture of the "
                "model: pictures between them and the model are missing"
            )
        else:
            why = (
                f"matches {tied[n]} pictures, but what they share is too little or contradicts "
                "the model"
            )
        words[images[n]] = why
    return words


def write_reasons(path: Path, records: Sequence[ImageRecord], words: dict[str, str]) -> None:
    """Write a table of pictures that are not in the model; none where all are."""
    rows = [(r.image, r.camera, r.station, words[r.image]) for r in records if r.image in words]
    if rows:
        write_csv(path, ("image", "camera", "station", "reason"), rows)


_MIN_COARSE = 10
"""Coarse matches from which a pair is matched fully."""
_ALIKE = 12
"""Pictures that look most like one that navigation does not place, which get a coarse look."""


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What a workspace gives to the mapping."""

    images: Path
    """Folder of the pictures."""
    records: tuple[ImageRecord, ...]
    rig: Rig | None
    survey: PicturesRecord

    @property
    def datum(self) -> Datum | None:
        """Origin of the local frame; None where pictures have no positions."""
        place = self.survey.datum
        return None if place is None else datum_of(place)


def run_mapping(
    workspace: Path, folder: Path, executor: Executor, *, reconstruct: ReconstructConfig, seed: int
) -> None:
    """Map the pictures of `images/`, with the rig of `calibration/` or `images/` if there is one.

    Raises:
        ImageError: there are too few pictures, or they are not those of the rig.
        ReconstructionError: the pictures give no model.
    """
    inputs = read_inputs(workspace)
    (folder / "features").mkdir(parents=True, exist_ok=True)
    mounted = rig_with_mount(inputs.rig)
    pictures = [
        Taken(
            picture=inputs.images / record.image,
            mask=inputs.images / record.mask if record.mask else None,
            features=folder / "features" / f"{i:06d}.npz",
            maximum=reconstruct.max_features,
            turns=quarter_turns(record, mounted),
            thrifty=inputs.rig is not None,
        )
        for i, record in enumerate(inputs.records)
    ]
    features = [picture.features for picture in pictures]
    if inputs.rig is not None:
        first = first_stations(inputs.records)
        list(executor.map(extract, [pictures[i] for i in first], label="features"))
        few = [inputs.records[i] for i in first]
        refuse_exchanged(few, [features[i] for i in first], inputs.rig, executor=executor)
    counts = list(executor.map(extract, pictures, label="features"))
    poor = [r.image for r, n in zip(inputs.records, counts, strict=True) if n < FEW_FEATURES]
    if poor:
        warn(f"{len(poor)} pictures have fewer than {FEW_FEATURES} features: {list_names(poor)}")
    warps, distances = _warps(inputs, features, executor)
    cameras, exif_focal = _cameras(inputs, warps)
    planned = _plan_pairs(inputs, features, distances, seed, executor)
    tasks = _pair_tasks(inputs, features, cameras, warps, planned, seed)
    found = list(executor.map(match_pair, tasks, label="matching"))
    if reconstruct.learned_features:
        found = with_learned(pictures, tasks, found, executor)
    pairs = [(i, j, m) for (i, j), m in zip(planned, found, strict=True) if m.geometry is not None]
    refined = refine_tracks(
        all_pixels(features),
        [_grey_file(path) for path in features],
        [(i, j, pair.matches) for i, j, pair in pairs],
        [warps[record.camera] for record in inputs.records] if warps else [],
        executor=executor,
    )
    seen = Observations(
        images=inputs.records, cameras=cameras, taken=refined, pairs=pairs, warps=warps
    )
    if inputs.rig is not None:
        poses = {name: inputs.rig.cam_from_rig[name] for name in cameras}
        mapped = map_calibrated(seen, poses, folder, seed, executor=executor)
        mapped, refracted = refract(mapped, seen, folder, poses, settle=not mapped.scaled)
    else:
        mapped, refracted = map_self_calibrated(seen, exif_focal, folder, seed), None
    registered = {image.name for image in mapped.model.images.values() if image.has_pose}
    images = [record.image for record in inputs.records]
    words = reasons(images, registered, counts, pairs)
    write_reasons(folder / UNREGISTERED, inputs.records, words)
    if words:
        warn(
            f"{len(words)} of {len(images)} pictures are not in the model, "
            f"mapping/{UNREGISTERED} says why: {list_names(list(words))}"
        )
    _write(folder, inputs, mapped, registered, distances, refracted)
    shutil.rmtree(folder / "features")


def extract(task: Taken) -> int:
    """Find and save the features of one picture, unless they are there; how many there are."""
    if not task.features.exists():
        picture = read_deep(task.picture)
        grey = normalise(picture)
        mask = None if task.mask is None else read_mask(task.mask, (grey.shape[1], grey.shape[0]))
        found = find_features(grey, mask, maximum=task.maximum, thrifty=task.thrifty)
        with atomic_path(_grey_file(task.features)) as temporary, temporary.open("wb") as file:
            np.save(file, finely(even_light(picture)))
        save_features(task.features, found)
    return len(load_features(task.features).pixels)


def _grey_file(features: Path) -> Path:
    """Where the evened picture lies next to its features."""
    return features.with_suffix(".npy")


def _warps(
    inputs: Inputs, features: Sequence[Path], executor: Executor
) -> tuple[dict[str, PinholeWarp], RangeRecord | None]:
    """The pinholes that stand in for calibrated cameras; none without a rig."""
    if inputs.rig is None:
        return {}, None
    distances = find_distances(inputs.records, features, inputs.rig, executor=executor)
    warps = {
        name: best_warp(inputs.rig.cameras[name], distances.near_m, distances.far_m)
        for name in _camera_names(inputs)
    }
    warn_of_warps(warps, distances)
    return warps, distances


def _cameras(
    inputs: Inputs, warps: Mapping[str, PinholeWarp]
) -> tuple[dict[str, pycolmap.Camera], set[str]]:
    """COLMAP's cameras: pinholes of a rig, else first guesses to calibrate from.

    Also the names of those whose focal length EXIF states.
    """
    cameras, stated = {}, set()
    for name in _camera_names(inputs):
        if name in warps:
            cameras[name] = colmap_pinhole(warps[name].pinhole)
            continue
        first = _first_of(inputs, name)
        height, width = read_colour(first).shape[:2]
        focal = exif_focal_px(first, width, height)
        if np.isfinite(focal):
            stated.add(name)
        else:  # from COLMAP's table of cameras, else 1.2 times the longer side
            focal = pycolmap.infer_camera_from_image(first).mean_focal_length()
        cameras[name] = pycolmap.Camera(
            model=SIMPLE,
            width=width,
            height=height,
            params=[focal, width / 2, height / 2, 0.0, 0.0],
            # EXIF does not know of water and crops: pairs are verified without it.
            has_prior_focal_length=False,
        )
    return cameras, stated


def _camera_names(inputs: Inputs) -> list[str]:
    """Names of the cameras that took pictures, the rig's reference (or the first) first."""
    taken = dict.fromkeys(sorted({r.camera for r in inputs.records}))
    if inputs.rig is None:
        return list(taken)
    strange = [name for name in taken if name not in inputs.rig.cameras]
    if strange:
        raise WorkspaceError(
            f"camera {strange[0]!r} of the pictures is not in the rig, which has "
            f"{', '.join(inputs.rig.cameras)}"
        )
    return [name for name in inputs.rig.cameras if name in taken]


def _plan_pairs(
    inputs: Inputs,
    features: Sequence[Path],
    distances: RangeRecord | None,
    seed: int,
    executor: Executor,
) -> list[Pair]:
    """Pairs to match fully: those that are sure, and those that a coarse look finds likely."""
    records, rig, datum = inputs.records, rig_with_mount(inputs.rig), inputs.datum
    known = distances is not None and distances.source != ANY_DISTANCE
    range_m = (distances.near_m, distances.far_m) if distances is not None and known else None
    alike: list[Pair] = []
    if len(records) > SMALL_SET:
        aside = sorted({*range(len(records))} - placed_pictures(records, rig, datum))
        alike = alike_pairs(features, aside, _ALIKE, seed=seed, executor=executor)
    sure, maybe = choose_pairs(records, rig, datum, alike, range_m)
    looks = [PairTask(first=features[i], second=features[j]) for i, j in maybe]
    counts = executor.map(coarse_matches, looks, label="choosing pairs")
    likely = [pair for pair, n in zip(maybe, counts, strict=True) if n >= _MIN_COARSE]
    return sorted([*sure, *likely])


def _pair_tasks(
    inputs: Inputs,
    features: Sequence[Path],
    cameras: Mapping[str, pycolmap.Camera],
    warps: Mapping[str, PinholeWarp],
    pairs: Sequence[Pair],
    seed: int,
) -> list[PairTask]:
    fields = {name: camera.todict() for name, camera in cameras.items()}
    names = [record.camera for record in inputs.records]
    return [
        PairTask(
            first=features[i],
            second=features[j],
            cameras=(fields[names[i]], fields[names[j]]),
            warps=(warps.get(names[i]), warps.get(names[j])),
            seed=seed,
        )
        for i, j in pairs
    ]


def _write(
    partial: Path,
    inputs: Inputs,
    mapped: Mapped,
    registered: Collection[str],
    distances: RangeRecord | None,
    refracted: RefractionRecord | None,
) -> None:
    model = mapped.model
    (partial / "model").mkdir(exist_ok=True)
    model.write_binary(partial / "model")
    CamerasRecord(
        cameras={name: warp.to_json() for name, warp in mapped.warps.items()},
        images={
            r.image: PictureCamera(camera=r.camera, station=r.station, mask=r.mask)
            for r in inputs.records
            if r.image in registered
        },
    ).write(partial / "cameras.json")
    content = b"".join(p.read_bytes() for p in sorted((partial / "model").iterdir()))
    MappingRecord(
        registered=len(registered),
        total=len(inputs.records),
        models=mapped.models,
        scaled=mapped.scaled,
        baseline=mapped.baseline if np.isfinite(mapped.baseline) else None,
        rig_factor=mapped.rig_factor,
        distances=distances,
        refraction=refracted,
        warps={name: warp_record(warp, distances) for name, warp in mapped.warps.items()},
        gauge=hashlib.blake2b(content, digest_size=16).hexdigest(),
        notes=mapped.notes,
    ).write(partial / "mapping.json")


def read_inputs(workspace: Path) -> Inputs:
    """Pictures, rig and datum of a workspace.

    Raises:
        ImageError: there are fewer than two pictures, or they are not those of the rig.
        WorkspaceError: a file is missing or damaged.
    """
    images = workspace / "images"
    records = read_manifest(images / "manifest.csv")
    if len(records) < 2:
        raise ImageError(f"{images / 'manifest.csv'}: {len(records)} pictures; a model needs 2")
    rig = rig_file(workspace)
    inputs = Inputs(
        images=images,
        records=tuple(records),
        rig=None if rig is None else read_rig(rig),
        survey=PicturesRecord.read(images / "survey.json"),
    )
    if inputs.rig is None:
        return inputs
    for name in _camera_names(inputs):
        first = _first_of(inputs, name)
        height, width = read_colour(first).shape[:2]
        camera = inputs.rig.cameras[name]
        if (width, height) != (camera.width_px, camera.height_px):
            raise ImageError(
                f"{first}: {width} x {height} pixels, but the rig's camera {name} has "
                f"{camera.width_px} x {camera.height_px}: give the rig file of these pictures"
            )
    return inputs


def _first_of(inputs: Inputs, camera: str) -> Path:
    """The first picture of a camera."""
    return inputs.images / next(r.image for r in inputs.records if r.camera == camera)
