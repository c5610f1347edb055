"""Whether a mapping is credible: stations against navigation, lengths against the rig.

Both are reported, not repaired: a station far off navigation may be a jump of navigation as well
as a wrong pose, and a scale that the rig's own stereo contradicts a wrong rig as well as a bent
model.

Navigation shows how bent a model is (`reconstruct.placing.alignment`); and a stereo rig carries its
own yardstick to every station.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.block_solver import CAUCHY_TUNING, MAD_TO_SIGMA
from alice_survey.core.errors import warn
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import (
    AcceptanceRecord,
    BendRecord,
    DomingRecord,
    FarStation,
    ScaleOfPairs,
)
from alice_survey.core.run import progress
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import Observed, first_pictures, observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.working_range import ray_passes
from reconstruct.matching.pairs import positions_ned
from reconstruct.pictures.files import list_names
from reconstruct.placing.alignment import MIN_STATIONS, align_rigid
from reconstruct.placing.navigation import body_from_pinhole
from reconstruct.views.model_files import as_transform

FAR_SIGMAS, FAR_M = 5.0, 0.5
"""A station is off navigation when it misses by more than both."""
SCALE_BOUND = 1e-3
"""Relative error of lengths that a known rig must not exceed."""
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
    positions = positions_ned(records, datum)
    sigmas = np.full((len(records), 3), np.nan)
    for i, record in enumerate(records):
        lever = mounts[record.camera].translation
        turn = np.deg2rad(max(record.sigma_attitude_deg, record.sigma_heading_deg))
        level, depth = record.sigma_horizontal_m, record.sigma_depth_m
        if record.has_attitude and min(level, depth, turn) > 0:
            positions[i] += record.ned_from_body.apply(lever)
            sigmas[i] = np.hypot([level, level, depth], turn * np.linalg.norm(lever))
        else:
            positions[i] = np.nan
    sigmas[np.isnan(positions)] = np.nan
    return positions, sigmas


def ground_pixel(model: pycolmap.Reconstruction, seen: Observed) -> float:
    """Median size of a pixel on the ground, in units of the model; NaN without points."""
    rows = []
    for n, number in enumerate(seen.pictures.tolist()):
        depth = seen.in_cameras[seen.of(n), 2]
        if len(depth):
            rows.append(np.median(depth) / model.images[number].camera.mean_focal_length())
    return float(np.median(rows)) if rows else float("nan")


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
        for row, off_m, over in zip(
            rows.tolist(), off.tolist(), (off / sigma).tolist(), strict=True
        ):
            if off_m > FAR_M and over > FAR_SIGMAS:
                one = records[row]
                far.append(
                    FarStation(station=one.station, image=one.image, off_m=off_m, sigmas=over)
                )
        far.sort(key=lambda f: (-f.off_m, f.station))
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
        usual_m=usual if np.isfinite(usual) else None,
        far=tuple(far),
        rig_error=rig_error if np.isfinite(rig_error) else None,
    )


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
