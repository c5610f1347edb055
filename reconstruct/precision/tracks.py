"""What pictures of a planned survey are expected to have in common: a stated model of tracks.

Points lie evenly on the expected sea floor. A picture that shows one has it in its track with a
probability, whatever the others have; a point counts with two such pictures. The rate of points is
such that a picture has as many of them as rendered surveys show. Only a few of them are drawn, each
of which stands for many: sigmas depend on sums over points, and these on how many are drawn only by
chance.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform
from scipy.stats.qmc import Halton

from alice_survey.core.block_solver import Flags, Indices
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from missions.values.footprint import footprint_ne
from reconstruct.adjustment.exact_observations import Pixels, RigState

_MATCHED = 0.45
"""Demo: 0.50, tracks of 4.9 views where 9.7 pictures show a point; Caesarea: 0.40, 4.2 of 10.5."""
_SHARE = 0.7
"""Of the features that a picture may have, those in a track. Demo: 0.84, Caesarea: 0.63."""
_NOISE_PX = 0.15
"""Residuals show 0.033 px in the demo and 0.060 in Caesarea, but errors of one feature or picture
go together. Independent ones of 0.15 px give the errors of both surveys' cameras within a factor of
two: 0.21 and 0.85 mm, where 0.18 and 1.7 mm were found."""
_MAX_OBSERVATIONS, _PER_PICTURE = 80_000, (20, 60)
"""Drawn in all, and least and most of a picture, which two parts of it share."""
_MIN_ANGLE_RAD = math.radians(1.5)
"""Between two rays to a point; COLMAP's least."""

Floor = Callable[[Array], Array]
"""From places (N, 2), north and east, to depths (N,), metres."""


@dataclass(frozen=True, kw_only=True)
class TrackModel:
    """How many points pictures have, and how well."""

    per_picture: float
    """Observations of points in a picture."""
    matched: float = _MATCHED
    """Share of the pictures that show a point in which it is matched."""
    noise_px: float = _NOISE_PX
    """Sigma of one coordinate."""

    @classmethod
    def of(cls, settings: ReconstructConfig) -> "TrackModel":
        """As rendered surveys show for these settings."""
        return cls(per_picture=_SHARE * settings.max_features)


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedBlock:
    """A survey as its last adjustment is expected to have it."""

    state: RigState
    pixels: Pixels
    times: float
    """Observations for which each of these stands."""
    noise_px: float
    ned_from_body: RigidTransform
    """(S,) stations."""
    time_s: Array
    """(S,) times, ascending."""


def waves(height_m: float, length_m: float) -> Floor:
    """Waves of the sea floor about its mean."""
    k = 2.0 * math.pi / length_m
    return lambda places: height_m * np.sin(k * places[:, 0]) * np.cos(k * places[:, 1])


def expected_block(
    rig: Rig,
    ned_from_body: RigidTransform,
    time_s: Array,
    floor: Floor,
    tracks: TrackModel,
    *,
    drawn: float | None = None,
    seed: int = 0,
) -> ExpectedBlock:
    """Draw the points that the pictures of stations are expected to share.

    Args:
        rig: cameras.
        ned_from_body: (S,) stations.
        time_s: (S,) their times.
        floor: the sea floor.
        tracks: of its points.
        drawn: observations of a picture that are drawn; None as many as many stations allow.
        seed: of the draw.

    Raises:
        PlanError: pictures do not show the sea floor, or share none of it.
    """
    count, reference = len(ned_from_body), rig.cam_from_rig[rig.reference]
    pictures = count * len(rig.cameras)
    if drawn is None:
        drawn = float(np.clip(_MAX_OBSERVATIONS / pictures, *_PER_PICTURE))
    drawn = min(drawn, tracks.per_picture)
    rng = np.random.default_rng(seed)
    points, reach_m = _points(rig, ned_from_body, floor, drawn / tracks.matched, rng)
    tree = cKDTree(points[:, :2])
    seen, centres = [], []
    for station, body in enumerate(ned_from_body):
        near = np.sort(np.array(tree.query_ball_point(body.translation[:2], reach_m), dtype=int))
        for c, (name, camera) in enumerate(rig.cameras.items()):
            pose = body * rig.body_from_cam(name)
            centres.append(pose.translation)
            at = camera.project(pose.inv().apply(points[near]))
            inside = np.all((at > 0) & (at < [camera.width_px, camera.height_px]), axis=1)
            kept = np.flatnonzero(inside & (rng.uniform(size=len(near)) < tracks.matched))
            seen.append(
                np.column_stack([near[kept], np.full((len(kept), 2), [station, c]), at[kept]])
            )
    rows = np.concatenate(seen)
    rays = points[rows[:, 0].astype(int)] - np.repeat(centres, [len(part) for part in seen], axis=0)
    wide = _is_wide(rows[:, 0].astype(int), rays / np.linalg.norm(rays, axis=1)[:, None])
    rows = rows[wide]
    if not len(rows):
        raise PlanError("pictures of this plan share no point: raise forward_overlap")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    given, which = np.unique(rows[:, 0].astype(int), return_inverse=True)
    pixels = Pixels(
        starts=np.concatenate([[0], np.cumsum(np.bincount(which))]).astype(np.int64),
        station=rows[:, 1].astype(np.int64),
        camera=rows[:, 2].astype(np.int64),
        taken=np.ascontiguousarray(rows[:, 3:]),
        point=which.astype(np.int64),
    )
    origins = ned_from_body * rig.body_from_cam(rig.reference)
    state = RigState(
        rig=replace(
            rig, cam_from_rig={n: pose * reference.inv() for n, pose in rig.cam_from_rig.items()}
        ),
        turns=origins.rotation.as_matrix(),
        centres=origins.translation,
        points=points[given],
    )
    return ExpectedBlock(
        state=state, pixels=pixels, times=tracks.per_picture * pictures / len(rows),
        noise_px=tracks.noise_px, ned_from_body=ned_from_body, time_s=time_s,
    )  # fmt: skip


def _is_wide(point: Indices, rays: Array) -> Flags:
    """Which unit rays (O, 3) belong to points that are seen from directions wide enough apart."""
    count = np.bincount(point)
    sums = np.column_stack([np.bincount(point, weights=axis) for axis in rays.T])
    mean = np.linalg.norm(sums, axis=1) / np.maximum(count, 1)
    return np.asarray((mean < math.cos(_MIN_ANGLE_RAD / 2.0))[point])


def _points(
    rig: Rig, ned_from_body: RigidTransform, floor: Floor, shown: float, rng: np.random.Generator
) -> tuple[Array, float]:
    """Points below stations, so many in a picture, and how far from its station it shows some."""
    first = ned_from_body[0] * rig.body_from_cam(rig.reference)
    places = ned_from_body.translation[:, :2]
    depth_m = float(floor(places[:1])[0])
    borders = np.concatenate(
        [
            footprint_ne(camera, ned_from_body[0] * rig.body_from_cam(name), depth_m)
            for name, camera in rig.cameras.items()
        ]
    )
    if not np.isfinite(borders).all() or depth_m <= first.translation[2]:
        raise PlanError("a picture looks past the sea floor: precision needs cameras that see it")
    own = footprint_ne(rig.cameras[rig.reference], first, depth_m) - places[0]
    north, east = own.T
    area_m2 = 0.5 * abs(float(north @ np.roll(east, -1) - east @ np.roll(north, -1)))
    reach_m = 1.3 * float(np.linalg.norm(borders - places[0], axis=1).max())
    low, high = places.min(axis=0) - reach_m, places.max(axis=0) + reach_m
    count = math.ceil(shown / area_m2 * float(np.prod(high - low)))
    level = low + Halton(2, rng=rng).random(count) * (high - low)
    level = level[cKDTree(places).query(level)[0] < reach_m]
    return np.column_stack([level, floor(level)]), reach_m
