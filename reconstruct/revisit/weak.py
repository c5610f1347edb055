"""The weak places of a reconstructed survey, measured against what its plan asked for."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.sparse as sp
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import MultiPolygon

from alice_survey.core.artefacts import need_stage
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array, Datum, attitude_from_rotation, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord, read_manifest
from alice_survey.core.records import RegistrationRecord
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import assign_lines
from missions.coverage.holes import Hole, find_holes
from missions.coverage.stations import Stations, plan_pattern, stations_of_plan
from missions.values.area import multipolygon
from missions.values.footprint import footprint_size_m
from missions.values.pattern import Pattern
from missions.values.plan_file import Plan, read_plan
from reconstruct.adjustment.uncertainty import read_uncertainty
from reconstruct.elevation import Elevation, elevation_in
from reconstruct.pictures.quality import judge, measure_file
from reconstruct.placing.track import read_track_poses
from reconstruct.revisit.links import cut_around, footprints, links, pieces, views_of_floor
from reconstruct.views.model import read_model

LOOSE_SHARE = 0.5
"""A part is loose below this share of the tracks that hold the least tied picture of the plan."""
_LATTICE = 12.0
"""Points of the lattice to the side of a footprint."""


@dataclass(frozen=True, kw_only=True)
class WeakPlace:
    """A connected part of a survey that is short of what was asked for."""

    cause: str
    """overlap, surface or loose."""
    reason: str
    """What is lacking, and why where that is known."""
    outline: MultiPolygon
    """x = north, y = east of the plan's datum, metres."""
    area_m2: float
    severity_m2: float
    """Area times the share that is lacking: how weak places are ranked."""
    stations: tuple[int, ...] = ()
    """Which of the good stations are loose."""

    @property
    def place_ne(self) -> tuple[float, float]:
        """A place inside of it."""
        inside = self.outline.representative_point()
        return float(inside.x), float(inside.y)

    def to_json(self) -> dict[str, Any]:
        """Its figures, without the outline."""
        return {
            "cause": self.cause,
            "reason": self.reason,
            "area_m2": round(self.area_m2, 6),
            "severity_m2": round(self.severity_m2, 6),
            "north_m": round(self.place_ne[0], 3),
            "east_m": round(self.place_ne[1], 3),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictured:
    """Stations of a survey that are of use to its model, and those that are not."""

    good: Stations
    numbers: NDArray[np.int64]
    """(S,) numbers of the good ones in the manifest."""
    spoilt: Stations
    faults: tuple[str, ...]
    """What is wrong with each of the others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """A survey as it was reconstructed, next to what was asked for."""

    plan: Plan
    rig: Rig
    pattern: Pattern
    pictured: Pictured
    seen: Certificate
    """What the good stations see."""
    linked: sp.csr_array
    """(S, S) tracks between good stations."""
    tracks_per_point: float
    """Tracks of the model for each point of the lattice that its stations share."""
    step_m: float
    """Of the lattice."""
    least_tracks: float
    """A cut below it makes a part of the survey loose."""
    piece: NDArray[np.int64]
    """(S,) of the good stations; the largest, 0, is what the others are loose from."""
    sigma_goal_m: float
    record: RegistrationRecord
    places: tuple[WeakPlace, ...]
    """Worst first."""


def find_weak(
    workspace: Path, rig: Rig, *, sigma_goal_m: float | None, executor: Executor
) -> Found:
    """Find the weak places of a reconstructed survey.

    Args:
        workspace: with plan, pictures, model and surface.
        rig: its cameras in its water.
        sigma_goal_m: largest sigma of heights that is good enough; left out, that of one pair of
            pictures matched to a pixel.
        executor: where pictures are measured.

    Raises:
        WorkspaceError: a stage is missing.
        ReconstructionError: the model has no place in the world.
    """
    plan = read_plan(need_stage(workspace, "plan", "plan") / "plan.json")
    sparse = need_stage(workspace, "sparse", "reconstruct")
    dense = need_stage(workspace, "dense", "reconstruct")
    images = workspace / "images"
    model = read_model(sparse)
    if model.frame.datum is None:
        raise ReconstructionError(
            f"{sparse}: the model has no place in the world, so that no line can be planned over "
            "it: give navigation with positions (import-images --navigation) or control points"
        )
    shift_ne = plan.datum.ned_from_geodetic(model.frame.datum.geodetic_from_ned(np.zeros((1, 3))))
    records = read_manifest(images / "manifest.csv")
    taken = [name for name in rig.cameras if any(r.camera == name for r in records)]
    elevation = elevation_in(dense)
    poses = read_track_poses(sparse / "track.csv")
    measure = partial(measure_file, images)
    judged = judge(list(executor.map(measure, records, label="picture quality")))
    # Pale is bare sand as well as haze; another dive may change nothing.
    faults = {q.image: [reason.split(":")[0] for reason in q.reasons] for q in judged}
    flaws = {name: words[0] for name, words in faults.items() if words and words[0] != "pale"}
    pictured = sort_stations(records, poses, flaws, taken, rig, plan, elevation, shift_ne[0, :2])
    number_of = {int(number): row for row, number in enumerate(pictured.numbers)}
    station = np.array([number_of.get(view.station, -1) for view in model.views])
    tracks = model.observations[station[model.observations[:, 1]] >= 0]
    views = sp.csr_array(
        (np.ones(len(tracks)), (station[tracks[:, 1]], tracks[:, 0])),
        shape=(len(pictured.good), len(model.points_world)),
    )
    views.data[:] = 1.0  # two cameras of a station may see a point
    found = measure_survey(
        plan, rig, pictured, views, sigma_goal_m or pair_sigma_m(plan, rig),
        RegistrationRecord.read(sparse / "registration.json"), executor,
    )  # fmt: skip
    sigmas = _station_sigmas(sparse, pictured.numbers)
    return replace(found, places=weak_places(found, elevation, shift_ne[0, :2], sigmas))


def weak_places(
    found: Found, elevation: Elevation, shift_ne: Array, sigmas: Array
) -> tuple[WeakPlace, ...]:
    """The weak places of a survey, worst first.

    Args:
        found: the survey as measured.
        elevation: its surface.
        shift_ne: (2,) from the surface's origin to the plan's.
        sigmas: (S,) of the places of good stations in the model's shape, metres; NaN if unknown.
    """
    places = [
        *_short_places(found),
        *_surface_places(found, elevation, shift_ne),
        *_loose_places(found, sigmas),
    ]
    return tuple(sorted(places, key=lambda place: -place.severity_m2))


def measure_survey(
    plan: Plan,
    rig: Rig,
    pictured: Pictured,
    views: sp.csr_array,
    sigma_goal_m: float,
    record: RegistrationRecord,
    executor: Executor = SERIAL,
) -> Found:
    """What the stations of a survey see, and how they hang together next to those of its plan.

    Args:
        plan: what was asked for.
        rig: its cameras.
        pictured: its stations.
        views: (S, P) which good stations see each track.
        sigma_goal_m: largest sigma of heights that is good enough.
        record: of the model.
        executor: where what is seen is counted.
    """
    pattern = plan_pattern(plan, rig)
    camera = rig.cameras[rig.reference]
    step_m = min(footprint_size_m(camera, plan.altitude_m)) / _LATTICE
    linked = links(views)
    shown = links(views_of_floor(footprints(rig, pictured.good), step_m)).sum(axis=0)
    tied = shown > 0
    if not tied.any():
        raise ReconstructionError(
            "no two pictures of the model show the same sea floor: reconstruct more pictures first"
        )
    per_point = float(np.median(linked.sum(axis=0)[tied] / shown[tied]))
    ideal = links(views_of_floor(footprints(rig, stations_of_plan(plan)), step_m)).sum(axis=0)
    minimum = LOOSE_SHARE * per_point * float(ideal.min())
    return Found(
        plan=plan, rig=rig, pattern=pattern, pictured=pictured, linked=linked, record=record,
        seen=certificate(plan.area, rig, pictured.good, pattern, executor=executor),
        tracks_per_point=per_point, step_m=step_m, least_tracks=minimum,
        piece=pieces(linked, minimum), sigma_goal_m=sigma_goal_m, places=(),
    )  # fmt: skip


def pair_sigma_m(plan: Plan, rig: Rig) -> float:
    """Sigma of a height from one pair of pictures that are matched to a pixel."""
    camera = rig.cameras[rig.reference]
    pixel_m = footprint_size_m(camera, plan.altitude_m)[0] / camera.width_px
    centres = [pose.inv().translation for pose in rig.cam_from_rig.values()]
    base_m = max(float(np.linalg.norm(one - centres[0])) for one in centres)
    return pixel_m * plan.altitude_m / (base_m or plan.station_spacing_m)


def sort_stations(
    records: Sequence[ImageRecord],
    poses: Mapping[str, RigidTransform],
    flaws: Mapping[str, str],
    cameras: Sequence[str],
    rig: Rig,
    plan: Plan,
    elevation: Elevation,
    shift_ne: Array,
) -> Pictured:
    """Part a survey's stations into those that are of use and the others.

    A station is of use if every camera's picture is in the model and none is flawed.

    Args:
        records: the manifest.
        poses: `world_from_cam` of registered pictures.
        flaws: pictures that are bad by themselves, and why.
        cameras: those that took pictures.
        rig: all cameras on the vehicle.
        plan: of the survey.
        elevation: the surface of the model.
        shift_ne: (2,) from the model's origin to the plan's.
    """
    of_station: dict[int, list[ImageRecord]] = {}
    for record in records:
        of_station.setdefault(record.station, []).append(record)
    glass_body = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    rows, faults, numbers = [], [], []
    for number, own in sorted(of_station.items()):
        lost = [record.image not in poses for record in own]
        flawed = Counter(flaws[record.image] for record in own if record.image in flaws)
        fault = ", ".join(flawed) or ("" if not any(lost) else "for an unknown cause")
        fault = f"not in the model ({fault})" if any(lost) else fault
        if not fault and {record.camera for record in own} < set(cameras):
            fault = "without a picture of each camera"
        if all(lost):
            body = _logged_pose(own[0], plan.datum)
        else:
            first = own[lost.index(False)]
            body = poses[first.image] * rig.body_from_cam(first.camera).inv()
            body = RigidTransform.from_translation([*shift_ne, 0.0]) * body
        if body is None:
            continue
        glass = body.apply(glass_body)
        height = elevation.at(elevation.height, glass[None, [1, 0]] - shift_ne[None, ::-1])[0]
        altitude = -height - glass[2]
        if not np.isfinite(altitude):
            altitude = own[0].altitude_m
        if not np.isfinite(altitude):
            altitude = plan.seafloor_depth_m - glass[2]
        rows.append([*glass[:2], altitude, *attitude_from_rotation(body.rotation), own[0].time_s])
        faults.append(fault)
        numbers.append(number)
    values = np.array(rows).reshape(-1, 7)
    every = Stations(
        glass_ne=values[:, :2], altitude_m=values[:, 2], attitude_rad=values[:, 3:6],
        line=np.full(len(values), -1), time_s=values[:, 6],
    )  # fmt: skip
    every = replace(every, line=assign_lines(every, plan))
    good = np.array([not fault for fault in faults])
    if not good.any():
        raise ReconstructionError("no station is in the model with a sound picture of each camera")
    return Pictured(
        good=every.some(good),
        numbers=np.array(numbers)[good],
        spoilt=every.some(~good),
        faults=tuple(fault for fault in faults if fault),
    )


def _logged_pose(record: ImageRecord, datum: Datum) -> RigidTransform | None:
    """`ned_from_body` by navigation; None where it does not know the place or the heading."""
    if not record.has_position or not np.isfinite(record.heading_deg):
        return None
    place = [[record.latitude_deg, record.longitude_deg, record.depth_m]]
    tilt = np.nan_to_num([record.roll_deg, record.pitch_deg])
    turn: Rotation = rotation_from_attitude(*np.deg2rad([*tilt, record.heading_deg]))
    return RigidTransform.from_components(datum.ned_from_geodetic(np.array(place))[0], turn)


def _short_places(found: Found) -> list[WeakPlace]:
    """Where good pictures are fewer than asked for."""
    requested = found.pattern.passes * found.pattern.pictures
    shapes = footprints(found.rig, found.pictured.spoilt)
    places = []
    seen = found.seen
    short = seen.inside & ~seen.at_overlap
    reached = np.minimum(seen.least_pictures / requested, seen.least_lines / found.pattern.passes)
    lacking_m2 = (1 - np.minimum(reached, 1.0)) * seen.grid.cell_m**2
    for hole in find_holes(seen, max_of_patches(found, short)):
        spoilt = Counter(
            fault
            for fault, shape in zip(found.pictured.faults, shapes, strict=True)
            if shape.intersects(hole.outline)
        )
        why = ", ".join(f"{count} stations {fault}" for fault, count in spoilt.most_common())
        some = f"{hole.fewest_pictures} of {requested} pictures of each camera at its thinnest"
        minimum = "in no good picture" if hole.unseen_m2 == hole.area_m2 else some
        reason = f"{minimum}; {why or 'no picture was taken'}"
        places.append(_place_of(found, hole, "overlap", reason, lacking_m2))
    return places


def _place_of(found: Found, hole: Hole, cause: str, reason: str, lacking_m2: Array) -> WeakPlace:
    """A weak place of which each cell (rows, columns) lacks so much."""
    inside = cells_in(found.seen, hole.outline)
    return WeakPlace(
        cause=cause, reason=reason, outline=hole.outline, area_m2=hole.area_m2,
        severity_m2=float(lacking_m2[inside].sum()),
    )  # fmt: skip


def cells_in(seen: Certificate, outline: MultiPolygon) -> NDArray[np.bool_]:
    """Which cells of a certificate, (rows, columns), have their middle in a part of the area."""
    within = shapely.contains_xy(outline, *np.moveaxis(seen.grid.middles_ne, -1, 0))
    return np.asarray(within) & seen.inside


def max_of_patches(found: Found, lacking: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where most of a patch lacks something, (rows, columns): single cells are noise.

    Patches are as large as planned lines distinguish; parts smaller than one do not count.
    """
    patch_m = min(found.pattern.half_across_m, found.pattern.half_along_m) / 4
    size = max(1, round(patch_m / found.seen.grid.cell_m))
    inside = found.seen.inside.astype(np.float64)
    here = cv2.blur(lacking * inside, (size, size), borderType=cv2.BORDER_REPLICATE)
    maximum = here > 0.5 * cv2.blur(inside, (size, size), borderType=cv2.BORDER_REPLICATE)
    maximum &= found.seen.inside
    _, labels, figures, _ = cv2.connectedComponentsWithStats(
        maximum.astype(np.uint8), connectivity=8
    )
    return np.asarray(maximum & (figures[labels, cv2.CC_STAT_AREA] >= size**2))


def _surface_places(found: Found, elevation: Elevation, shift_ne: Array) -> list[WeakPlace]:
    """Where enough pictures see the sea floor, but most of its surface is missing or unsure."""
    seen = found.seen
    places_en = (seen.grid.middles_ne - shift_ne).reshape(-1, 2)[:, ::-1]
    sigma = elevation.at(elevation.sigma, places_en).reshape(seen.grid.shape)
    unsure = ~(sigma <= found.sigma_goal_m)
    weak = max_of_patches(found, unsure & seen.at_overlap)
    lacking = np.where(np.isfinite(sigma), np.maximum(0.0, 1 - found.sigma_goal_m / sigma), 1.0)
    lacking_m2 = lacking * seen.grid.cell_m**2
    places = []
    for hole in find_holes(seen, weak):
        here = cells_in(seen, hole.outline)
        known = here & np.isfinite(sigma)
        reason = "no surface"
        if 2 * known.sum() > here.sum():
            reason = (
                f"sigma of heights {1e3 * np.median(sigma[known]):.1f} mm where "
                f"{1e3 * found.sigma_goal_m:.1f} mm are asked for"
            )
        places.append(_place_of(found, hole, "surface", reason, lacking_m2))
    return places


def _station_sigmas(sparse: Path, numbers: NDArray[np.int64]) -> Array:
    """Sigma of the place of each station in the model's shape, (S,) metres; NaN if unknown."""
    if not (sparse / "covariance.npz").is_file():
        return np.full(len(numbers), np.nan)
    known = read_uncertainty(sparse / "covariance.npz")
    sigma = np.sqrt(np.trace(known.frame_cov[:, 3:, 3:], axis1=1, axis2=2) / 3)
    of = dict(zip(known.stations.tolist(), sigma.tolist(), strict=True))
    return np.array([of.get(number, np.nan) for number in numbers.tolist()])


def _loose_places(found: Found, sigmas: Array) -> list[WeakPlace]:
    """Parts of the model that hang on few tracks, or whose place in it is unsure."""
    shapes = footprints(found.rig, found.pictured.good)
    groups = [
        (found.piece == number, "") for number in range(1, int(found.piece.max(initial=0)) + 1)
    ]
    usual_m = float(np.nanmedian(sigmas)) if np.isfinite(sigmas).any() else np.nan
    limit_m = math.hypot(usual_m, found.sigma_goal_m)
    unsure = np.flatnonzero((sigmas > limit_m) & (found.piece == 0))
    parts = connected_components(found.linked[unsure][:, unsure], directed=False)[1]
    for part in range(int(parts.max(initial=-1)) + 1):
        group = np.isin(np.arange(len(sigmas)), unsure[parts == part])
        worst_m = float(sigmas[group].max())
        why = f"sigma of their places {1e3 * worst_m:.1f} mm, the median is {1e3 * usual_m:.1f}"
        groups.append((group, why))
    places = []
    for group, why in groups:
        outline = multipolygon(
            shapely.union_all(shapes[group]).intersection(found.plan.area.survey)
        )
        cut = cut_around(found.linked, group)
        short = max(0.0, 1 - cut / found.least_tracks)
        if why:
            short = 1 - limit_m / float(sigmas[group].max())
        if outline.area:
            usual = f"{found.least_tracks:.0f} is half of what the plan's weakest picture has"
            places.append(
                WeakPlace(
                    cause="loose",
                    reason=f"{int(group.sum())} stations: "
                    + (why or f"{cut:.0f} tracks hold them, {usual}"),
                    outline=outline,
                    area_m2=float(outline.area),
                    severity_m2=float(outline.area) * short,
                    stations=tuple(np.flatnonzero(group).tolist()),
                )
            )
    return places
