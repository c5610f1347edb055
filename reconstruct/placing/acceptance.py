"""Whether a mapping is credible: stations against navigation, lengths against the rig.

Both are reported, not repaired: a station far off navigation may be a jump of navigation as well
as a wrong pose, and a scale that the rig's own stereo contradicts a wrong rig as well as a bent
model.

Navigation shows how bent a model is (`reconstruct.placing.alignment`); and a stereo rig carries its
own yardstick to every station.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import warn
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.robust import CAUCHY_TUNING, MAD_TO_SIGMA
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import Observed, first_pictures, observed
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.working_range import ray_passes
from reconstruct.matching.pairs import positions_ned
from reconstruct.pictures.files import list_names
from reconstruct.placing.alignment import MIN_STATIONS, Bend, quadratic
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


@dataclass(frozen=True, kw_only=True)
class ScaleTrend:
    """How the model's scale, against the rig's baseline, varies over a block."""

    mean: float
    """Lengths of the model over those of its stations' own stereo; 1 when they agree."""
    mean_sigma: float
    range: float
    """Largest minus smallest value of the fitted paraboloid over the stations."""
    range_sigma: float

    @property
    def significant(self) -> bool:
        """Whether it is beyond its noise."""
        return self.range > _SIGMAS * self.range_sigma

    def off_by_more_than(self, bound: float) -> bool:
        """Whether the mean is off by this much and beyond its noise."""
        return abs(self.mean - 1.0) > max(bound, _SIGMAS * self.mean_sigma)


@dataclass(frozen=True, kw_only=True)
class Doming:
    """Evidence of a bent model; what could not be measured is None."""

    along: Bend | None
    across: Bend | None
    """Perpendicular to the block's longest axis; None for a single line."""
    scale: ScaleTrend | None
    pixel_m: float
    """Ground pixel, metres."""

    def to_json(self) -> dict[str, object]:
        """Figures for `mapping.json`."""
        bends: dict[str, object] = {
            name: None
            if bend is None
            else {**vars(bend), "sag_m": bend.sag_m, "sag_sigma_m": bend.sag_sigma_m}
            for name, bend in (("along", self.along), ("across", self.across))
        }
        scale = None if self.scale is None else vars(self.scale)
        return {
            **bends,
            "scale": scale,
            "pixel_m": self.pixel_m if np.isfinite(self.pixel_m) else None,
            "notes": self.notes(),
        }

    def notes(self) -> list[str]:
        """A line for every significant bend."""
        return [
            f"the model is bent {name} the block: {1e3 * bend.sag_m:+.1f} +/- "
            f"{1e3 * bend.sag_sigma_m:.1f} mm over {bend.length_m:.1f} m against navigation's "
            "depth and attitude, which the calibration does not allow for: calibrate again, or fly "
            "cross lines"
            for name, bend in (("along", self.along), ("across", self.across))
            if bend is not None and bend.significant(self.pixel_m)
        ]


def measure_doming(
    model: pycolmap.Reconstruction, rotations: Mapping[int, Rotation], bends: Sequence[Bend]
) -> Doming:
    """Bring together how bent a model is, and warn where that is significant.

    Args:
        model: in metres; picture i has the id i + 1.
        rotations: `ned_from_pinhole` by picture's index, as navigation has it.
        bends: along and across, as navigation shows them.
    """
    seen = observed(model)
    along, across = (*bends, None, None)[:2]
    found = Doming(
        along=along,
        across=across,
        scale=scale_trend(model, seen, first_pictures(model), down_of(model, rotations)),
        pixel_m=ground_pixel(model, seen),
    )
    for note in found.notes():
        warn(note)
    return found


def scale_trend(
    model: pycolmap.Reconstruction, seen: Observed, reference: Mapping[int, int], down: Array
) -> ScaleTrend | None:
    """The model's scale at every station against that station's stereo, as a trend over the block.

    Args:
        model: on one rig.
        seen: its observations.
        reference: picture by frame.
        down: (3,) unit vector in the model's frame.

    Returns:
        None where too few stations have points that two of their cameras show.
    """
    local = [
        (model.images[reference[frame]].projection_center(), *given)
        for frame in sorted(reference)
        if (given := _station_scale(model, seen, frame)) is not None
    ]
    if len(local) < MIN_STATIONS:
        return None
    centres = np.array([row[0] for row in local])
    scale, sigma = np.array([row[1:] for row in local]).T
    design = _quadratic(centres, down)
    if not np.linalg.matrix_rank(design) == design.shape[1] < len(design):
        return None
    fitted, covariance = _robust_fit(design, scale, sigma)
    values = design @ fitted
    between = design[np.argmax(values)] - design[np.argmin(values)]
    mean, mean_cov = _robust_fit(np.ones((len(scale), 1)), scale, sigma)
    return ScaleTrend(
        mean=float(mean[0]),
        mean_sigma=float(np.sqrt(mean_cov[0, 0])),
        range=float(np.ptp(values)),
        range_sigma=float(np.sqrt(between @ covariance @ between)),
    )


def pinhole_positions(
    records: Sequence[ImageRecord], rig: Rig, warps: Mapping[str, PinholeWarp], datum: Datum
) -> tuple[Array, Array]:
    """The pinholes' centres by navigation.

    Returns:
        (N, 3) positions in NED and their sigmas, both metres; NaN where position, attitude or a
        sigma is unknown.
    """
    bodies = positions_ned(records, datum)
    positions, sigmas = np.full((len(records), 3), np.nan), np.full((len(records), 3), np.nan)
    for i, record in enumerate(records):
        sigma = np.array(
            [record.sigma_horizontal_m, record.sigma_horizontal_m, record.sigma_depth_m]
        )
        turn = np.deg2rad(max(record.sigma_attitude_deg, record.sigma_heading_deg))
        if not (record.has_position and record.has_attitude and np.all(sigma > 0) and turn > 0):
            continue
        attitude = np.deg2rad([record.roll_deg, record.pitch_deg, record.heading_deg])
        body_from_pinhole = (
            rig.body_from_cam(record.camera) * warps[record.camera].pinhole_from_cam.inv()
        )
        lever = body_from_pinhole.translation
        positions[i] = bodies[i] + rotation_from_attitude(*attitude).apply(lever)
        sigmas[i] = np.hypot(sigma, turn * np.linalg.norm(lever))
    return positions, sigmas


def navigation_rotations(
    records: Sequence[ImageRecord], rig: Rig, warps: Mapping[str, PinholeWarp]
) -> dict[int, Rotation]:
    """`ned_from_pinhole` by picture's index, where navigation has attitudes."""
    return {
        i: rotation_from_attitude(*np.deg2rad([r.roll_deg, r.pitch_deg, r.heading_deg]))
        * (rig.body_from_cam(r.camera) * warps[r.camera].pinhole_from_cam.inv()).rotation
        for i, r in enumerate(records)
        if r.has_attitude
    }


def down_of(model: pycolmap.Reconstruction, rotations: Mapping[int, Rotation]) -> Array:
    """Down in the model's frame: by navigation's attitudes, else the mean way that cameras look."""
    posed = [n for n in sorted(model.images) if model.images[n].has_pose]
    given = [n for n in posed if n - 1 in rotations]
    rows = [
        model.images[n].cam_from_world().matrix()[:, :3].T
        @ (rotations[n - 1].inv().apply([0.0, 0.0, 1.0]) if given else [0.0, 0.0, 1.0])
        for n in given or posed
    ]
    mean = np.median(np.array(rows), axis=0)
    unit: Array = mean / np.linalg.norm(mean)
    return unit


def ground_pixel(model: pycolmap.Reconstruction, seen: Observed) -> float:
    """Median size of a pixel on the ground, in units of the model; NaN without points."""
    rows = []
    for n, number in enumerate(seen.pictures.tolist()):
        depth = seen.in_cameras[seen.of(n), 2]
        if len(depth):
            rows.append(np.median(depth) / model.images[number].camera.mean_focal_length())
    return float(np.median(rows)) if rows else float("nan")


def _quadratic(centres: Array, down: Array) -> Array:
    """Columns of a paraboloid over places (N, 3) in the plane across `down`."""
    side = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    side /= np.linalg.norm(side)
    return quadratic(centres @ np.column_stack([side, np.cross(down, side)]))[0]


def _robust_fit(design: Array, values: Array, sigmas: Array) -> tuple[Array, Array]:
    """Coefficients and their covariance."""
    weight = np.ones(len(values))
    for _ in range(_FIT_ROUNDS):
        root = np.sqrt(weight) / sigmas
        fitted = np.linalg.lstsq(root[:, None] * design, root * values, rcond=None)[0]
        left = (values - design @ fitted) / sigmas
        spread = max(MAD_TO_SIGMA * float(np.median(np.abs(left))), 1e-12)
        weight = np.asarray(1.0 / (1.0 + (left / (CAUCHY_TUNING * spread)) ** 2), np.float64)
    free = len(values) - design.shape[1]
    root = np.sqrt(weight) / sigmas
    variance = float((weight * left**2).sum() / max(weight.sum() * free / len(values), 1e-12))
    normal = (root[:, None] * design).T @ (root[:, None] * design)
    covariance = np.asarray(np.linalg.inv(normal) * max(1.0, variance), np.float64)
    return np.asarray(fitted, np.float64), covariance


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


@dataclass(frozen=True, kw_only=True)
class FarStation:
    """A station that is not where navigation places it."""

    station: int
    image: str
    off_m: float
    sigmas: float
    """Its distance over the usual one."""


@dataclass(frozen=True, kw_only=True)
class Acceptance:
    """Signs that a mapping is wrong."""

    checked: int
    """Stations with a position."""
    usual_m: float
    """Usual distance from navigation, one standard deviation by axis, robustly; NaN without."""
    far: tuple[FarStation, ...]
    """Stations off navigation, the farthest first."""
    rig_error: float
    """Relative error of the rig in the finished model; NaN where there is no known rig."""
    scale: ScaleTrend | None
    """Scale of the model against its stations' own stereo."""

    def notes(self) -> list[str]:
        """A line for every fault."""
        notes = []
        if self.far:
            names = list_names([f"{f.image} ({f.off_m:.2f} m)" for f in self.far])
            notes.append(
                f"{len(self.far)} of {self.checked} stations lie more than {FAR_SIGMAS:.0f} sigmas "
                f"and {FAR_M} m from where navigation has them, which others miss by "
                f"{self.usual_m:.2f} m: {names}; look at "
                "these pictures and at navigation's log"
            )
        if abs(self.rig_error) > SCALE_BOUND:
            notes.append(
                f"the rig's baseline came out {100 * self.rig_error:+.2f} % off the calibrated "
                "one: lengths are not to be trusted"
            )
        scale = self.scale
        if scale is not None and scale.off_by_more_than(SCALE_BOUND):
            notes.append(
                f"lengths are {100 * (scale.mean - 1):+.2f} +/- {100 * scale.mean_sigma:.2f} % off "
                "what every station's own stereo says: check the rig's calibration"
            )
        return notes

    def to_json(self) -> dict[str, object]:
        """Figures for `mapping.json`."""
        return {
            "checked": self.checked,
            "usual_m": self.usual_m if np.isfinite(self.usual_m) else None,
            "far": [vars(f) for f in self.far],
            "rig_error": self.rig_error if np.isfinite(self.rig_error) else None,
            "notes": self.notes(),
        }


@progress.step("judge the model")
def judge_model(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig,
    datum: Datum | None,
    bends: Sequence[Bend] = (),
) -> tuple[Doming, Acceptance]:
    """How bent a model on a known rig is, and whether it is credible, by all that is known of it.

    Args:
        mapped: scaled by its rig; picture i of `records` has the id i + 1.
        records: pictures.
        rig: on which it was mapped.
        datum: of navigation's positions; None without.
        bends: along and across, as navigation shows them.
    """
    positions = sigmas = np.full((len(records), 3), np.nan)
    rotations: dict[int, Rotation] = {}
    if rig.body_from_rig is not None:
        rotations = navigation_rotations(records, rig, mapped.warps)
        if datum is not None:
            positions, sigmas = pinhole_positions(records, rig, mapped.warps, datum)
    doming = measure_doming(mapped.model, rotations, bends)
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
    scale: ScaleTrend | None,
) -> Acceptance:
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
    checked, usual, far = _far_stations(model, records, positions, sigmas)
    found = Acceptance(checked=checked, usual_m=usual, far=far, rig_error=rig_error, scale=scale)
    for note in found.notes():
        warn(note)
    return found


def _far_stations(
    model: pycolmap.Reconstruction, records: Sequence[ImageRecord], positions: Array, sigmas: Array
) -> tuple[int, float, tuple[FarStation, ...]]:
    numbers = sorted(first_pictures(model, positions + sigmas).values())
    if len(numbers) < _MIN_STATIONS:
        return len(numbers), float("nan"), ()
    rows = np.array(numbers) - 1
    centres = np.array(
        [as_transform(model.images[n].cam_from_world()).inv().translation for n in numbers]
    )
    off, sigma = misses(centres, positions[rows], sigmas[rows])
    over = off / sigma
    found = [
        FarStation(
            station=records[row].station,
            image=records[row].image,
            off_m=float(off[k]),
            sigmas=float(over[k]),
        )
        for k, row in enumerate(rows.tolist())
        if off[k] > FAR_M and over[k] > FAR_SIGMAS
    ]
    ordered = tuple(sorted(found, key=lambda f: (-f.off_m, f.station)))
    return len(numbers), float(np.median(off) / _MEDIAN_SIGMAS), ordered


def misses(centres: Array, given: Array, sigmas: Array) -> tuple[Array, Array]:
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
        off = np.linalg.norm(_align_weighted(centres, given, weight / stated**2) - given, axis=1)
        spread = max(float(np.median(off / stated)) / _MEDIAN_SIGMAS, 1e-9)
        weight = 1.0 / (1.0 + (off / (CAUCHY_TUNING * spread * stated)) ** 2)
    return off, stated * max(spread, 1.0)


def _align_weighted(source: Array, target: Array, weight: Array) -> Array:
    """The source where a rigid motion brings it nearest to the target (Kabsch 1976)."""
    share = weight / weight.sum()
    from_middle, to_middle = share @ source, share @ target
    u, _, vt = np.linalg.svd((target - to_middle).T @ (share[:, None] * (source - from_middle)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = Rotation.from_matrix(u @ flip @ vt)
    move = RigidTransform.from_components(to_middle - turn.apply(from_middle), turn)
    return np.asarray(move.apply(source), np.float64)
