"""Which pictures to match: by their footprints, by their order, or by a first coarse look.

Pictures that look alike are found by one vector of each: its features' distances from the words of
a codebook, summed by word (VLAD, Jegou et al. 2010) with each word's sum normalised (Arandjelovic &
Zisserman 2013). The codebook is made from the survey's own features, so that nothing needs to be
downloaded and words are those of this sea floor. Words that all pictures share count less, since
the mean of the vectors is taken off.

Wherever cameras look, pictures may show the same surface by what their frusta share.
Where the surface is along a picture's rays is not known before matching, only how far it is about.
A picture's points at these distances are looked for in other pictures: what shows few of them at
every distance shows another surface, or the same one from another side.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform
from shapely import STRtree
from shapely.geometry import Polygon

from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import ImageRecord
from camera_calib.camera import Camera
from camera_calib.rig import Rig
from reconstruct.matching.features import load_features

Pair = tuple[int, int]

_LATTICE = 6
"""Rays along the width and along the height of a picture."""
_DISTANCES = 5
"""Distances along each ray, from the nearest to the farthest."""
_WIDEST_COS = float(np.cos(np.deg2rad(70.0)))
"""Rays that meet under a wider angle show a surface that hardly looks the same."""
_BEYOND = 1.25
"""Times the farthest distance at which a picture still shows a point."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frusta:
    """What pictures may show, in north, east, down."""

    cameras: tuple[Camera, ...]
    """Of every picture."""
    ned_from_cam: tuple[RigidTransform, ...]
    points: Array
    """(N, D, R, 3) at D distances along R rays of each picture."""
    rays: Array
    """(N, R, 3) unit vectors."""
    near_m: float
    far_m: float

    @property
    def middles(self) -> Array:
        """(N, 3) the middle of what each may show."""
        return np.asarray(self.points[:, self.points.shape[1] // 2].mean(axis=1))

    @property
    def reach_m(self) -> float:
        """The distance from its middle within which all of a picture's points are."""
        away = self.points - self.middles[:, None, None]
        return float(np.linalg.norm(away, axis=-1).max(initial=0.0))


def frusta_of(
    records: Sequence[ImageRecord], rig: Rig, datum: Datum, near_m: float, far_m: float
) -> Frusta:
    """Frusta of pictures with position and attitude.

    Args:
        records: pictures.
        rig: cameras, mounted.
        datum: origin of local coordinates.
        near_m: distance of the surface along the axes, least.
        far_m: most.
    """
    lattices = {}
    for name, camera in rig.cameras.items():
        x = (np.arange(_LATTICE) + 0.5) / _LATTICE * camera.width_px
        y = (np.arange(_LATTICE) + 0.5) / _LATTICE * camera.height_px
        lattices[name] = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    depths = np.geomspace(near_m, far_m, _DISTANCES)
    geodetic = np.array([[r.latitude_deg, r.longitude_deg, r.depth_m] for r in records])
    poses, points, rays = [], [], []
    for record, place in zip(records, datum.ned_from_geodetic(geodetic), strict=True):
        body = RigidTransform.from_components(place, record.ned_from_body)
        pose = body * rig.body_from_cam(record.camera)
        starts, ways = lattices[record.camera]
        along = (depths[:, None] - starts[:, 2]) / ways[:, 2]
        own = starts + along[..., None] * ways
        poses.append(pose)
        points.append(pose.apply(own.reshape(-1, 3)).reshape(own.shape))
        rays.append(pose.rotation.apply(ways))
    return Frusta(
        cameras=tuple(rig.cameras[r.camera] for r in records),
        ned_from_cam=tuple(poses),
        points=np.array(points).reshape(-1, _DISTANCES, _LATTICE**2, 3),
        rays=np.array(rays).reshape(-1, _LATTICE**2, 3),
        near_m=near_m,
        far_m=far_m,
    )


def overlap_shares(
    frusta: Frusta, pairs: Iterable[Pair], slack_m: Array
) -> dict[Pair, tuple[float, float]]:
    """What pictures share: at the middle distance, and at that at which they share most.

    Args:
        frusta: of the pictures.
        pairs: of numbers.
        slack_m: (N,) how far each picture may be from where it is said to be.

    Returns:
        By pair two shares, each the mean of both directions; of the second the frames are widened
        by the slack.
    """
    found, middle = {}, _DISTANCES // 2
    for i, j in pairs:
        wide = float(np.hypot(slack_m[i], slack_m[j]))
        shares = [
            0.5 * (_seen_by(frusta, i, j, by) + _seen_by(frusta, j, i, by))
            for by in sorted({0.0, wide})
        ]
        found[i, j] = float(shares[0][middle]), float(shares[-1].max())
    return found


def _seen_by(frusta: Frusta, i: int, j: int, wide_m: float) -> Array:
    """(D,) share of a picture's points at each distance that another one has in its frame."""
    camera, points = frusta.cameras[j], frusta.points[i]
    there = frusta.ned_from_cam[j].inv()
    local = there.apply(points.reshape(-1, 3)).reshape(points.shape)
    facing = local[..., 2] > 0.5 * frusta.near_m
    facing &= local[..., 2] < _BEYOND * frusta.far_m
    ways = there.rotation.apply(frusta.rays[i])
    away = np.linalg.norm(local, axis=-1)
    facing &= (local * ways).sum(axis=-1) > _WIDEST_COS * away
    inside = np.zeros(facing.shape, np.bool_)
    if facing.any():
        pixels = camera.project(local[facing])
        margin = wide_m * camera.focal_in_water_px / local[facing][:, 2]
        beyond = np.array([camera.width_px, camera.height_px]) + margin[:, None]
        with np.errstate(invalid="ignore"):
            inside[facing] = ((pixels > -margin[:, None]) & (pixels < beyond)).all(axis=1)
    return np.asarray(inside.mean(axis=1))


def near_pairs(frusta: Frusta, chosen: NDArray[np.bool_], slack_m: Array) -> list[Pair]:
    """Pairs whose middles are near enough to share anything, one of each chosen at least.

    Args:
        frusta: of the pictures.
        chosen: (N,) pictures for which partners are sought.
        slack_m: (N,) how far each picture may be from where it is said to be.
    """
    if not len(frusta.points):
        return []
    reach = 2.0 * frusta.reach_m + 2.0 * float(slack_m.max(initial=0.0))
    pairs = KDTree(frusta.middles).query_pairs(reach, output_type="ndarray")
    pairs = pairs[chosen[pairs].any(axis=1)]
    return sorted((int(min(p)), int(max(p))) for p in pairs)


def all_round(frusta: Frusta, overlaps: Mapping[Pair, float]) -> set[Pair]:
    """Two partners of every picture in all directions across its view, as it is turned.

    In each direction, and among those turned by over 45 degrees about the axis, one that is best by
    its overlap times its distance, which sees depth under a wide angle, and one by its overlap
    times the cosine between the axes, to which a surface that bends looks most alike.

    Args:
        frusta: of the pictures.
        overlaps: by pair.
    """
    middles = frusta.middles
    chosen = set()
    for i, found in partners_of(overlaps):
        kept: set[int] = set()
        cells: dict[tuple[int, bool], list[tuple[float, float, int]]] = {}
        here = frusta.ned_from_cam[i].rotation.inv()
        for j, overlap in found:
            right, down, _ = here.apply(middles[j] - middles[i])
            sector = round(np.arctan2(down, right) / (2 * np.pi / _SECTORS)) % _SECTORS
            turn = (here * frusta.ned_from_cam[j].rotation).as_matrix()
            across = bool(abs(turn[1, 0]) > abs(turn[0, 0]))
            goodness = overlap * float(np.hypot(right, down))
            likeness = overlap * float(turn[2, 2])
            cells.setdefault((sector, across), []).append((goodness, likeness, j))
        for members in cells.values():
            kept |= {max(members)[2], max(members, key=lambda member: member[1:])[2]}
        chosen |= {(min(i, j), max(i, j)) for j in kept}
    return chosen


def partners_of(overlaps: Mapping[Pair, float]) -> list[tuple[int, list[tuple[int, float]]]]:
    """Each picture with its partners and what it shares with them, in the order of pictures."""
    partners: dict[int, list[tuple[int, float]]] = {}
    for (i, j), overlap in overlaps.items():
        partners.setdefault(i, []).append((j, overlap))
        partners.setdefault(j, []).append((i, overlap))
    return sorted(partners.items())


SMALL_SET = 60
"""Up to this many pictures every pair gets at least a coarse look."""
NEIGHBOURS = 4
"""Stations on either side that are matched when nothing else is known."""
_NEAREST = 20
"""Pictures nearest by navigation that get a coarse look when footprints are not known."""
_MIN_OVERLAP = 0.05
_SURE_OVERLAP = 0.3
_SECTORS = 6
"""Directions in which a picture looks for partners, for each side of its survey line and across."""
_PER_SECTOR = 2
_LOOKS = 12
"""Partners of every picture that get a coarse look."""
_SIGMAS = 2.0
"""Standard deviations of the distance of two pictures up to which they get a coarse look."""
_WORDS = 64
_SAMPLE = 30_000
"""Features from which the codebook is made."""
_ROUNDS = 12
_MAX_FEATURES = 1500
"""Features of each picture that are described."""
_BLOCK, _AT_A_TIME = 512, 4096
"""Pictures whose partners are sought at a time, and those they are compared with: 0.3 GiB."""


def choose_pairs(
    records: Sequence[ImageRecord],
    rig: Rig | None,
    datum: Datum | None,
    alike: Sequence[Pair] = (),
    range_m: tuple[float, float] | None = None,
) -> tuple[list[Pair], list[Pair]]:
    """Pairs to match fully, and pairs to match only if a coarse look finds something.

    With a rig, positions, attitudes and altitudes: pairs of one camera whose footprints overlap
    (those across the cameras add nothing that the pairs within the stations do not link already:
    on a simulated survey half the pairs gave the same 0.7 mm), and those across cameras that no
    such link joins: one that looks ahead sees what another that looks astern sees later. Of many,
    every picture chooses the best conditioned in all directions (`well_conditioned`), so that the
    work for a picture does not grow with the survey nor with the times that a place was visited.
    Pictures without a footprint, since they look at a wall or have no altitude, are paired by what
    their frusta share where it is known how far the surface is, and by their looks. With positions
    only: the nearest pictures. Without either: neighbours in order, pictures that look alike, and
    every other pair where the pictures are few. Pictures of one station are always matched.

    Args:
        records: pictures.
        rig: calibrated cameras, when known.
        datum: origin of local coordinates; None without positions.
        alike: pairs that look alike, for pictures without a footprint.
        range_m: least and greatest distance of the surface from the cameras; None if unknown.
    """
    sure = neighbours(records, 0)
    maybe: set[Pair] = set()
    placed = placed_pictures(records, rig, datum, range_m)
    level = placed_pictures(records, rig, datum)
    if datum is not None and rig is not None:
        above = sorted(level)
        groups = [(above, *_overlapping([records[i] for i in above], rig, datum))]
        if range_m is not None and len(level) < len(placed):
            posed = sorted(placed)
            looks_aside = np.array([i not in level for i in posed])
            groups.append(
                (posed, *_sharing([records[i] for i in posed], rig, datum, range_m, looks_aside))
            )
        for members, near, touching in groups:
            sure |= {(members[i], members[j]) for i, j in near}
            maybe |= {(members[i], members[j]) for i, j in touching}
    elif datum is not None and len(records) > SMALL_SET:
        maybe |= _nearest(records, datum)
        sure |= neighbours(records, 1)
    # Frusta end at the working range: views of different parts may link beyond it.
    maybe |= {(i, j) for i, j in alike if i not in level or j not in level}
    if len(placed) < len(records):
        in_order = neighbours(records, NEIGHBOURS)
        sure |= {(i, j) for i, j in in_order if i not in placed or j not in placed}
        if len(records) <= SMALL_SET:
            maybe |= set(itertools.combinations(range(len(records)), 2))
    return sorted(sure), sorted(maybe - sure)


def placed_pictures(
    records: Sequence[ImageRecord],
    rig: Rig | None,
    datum: Datum | None,
    range_m: tuple[float, float] | None = None,
) -> set[int]:
    """Pictures whose partners navigation names.

    One that sees the horizon or has no altitude has no footprint: what it shares with others is not
    known, unless it is known how far the surface is from the cameras.
    """
    if datum is None:
        return set()
    if rig is not None and range_m is not None:
        return {i for i, r in enumerate(records) if r.has_position and r.has_attitude}
    if rig is not None:
        posed = [i for i, r in enumerate(records) if _has_pose(r)]
        ground = footprints([records[i] for i in posed], rig, datum)
        return {i for i, polygon in zip(posed, ground, strict=True) if not polygon.is_empty}
    if len(records) > SMALL_SET:
        return {i for i, r in enumerate(records) if r.has_position}
    return set()


def neighbours(records: Sequence[ImageRecord], reach: int) -> set[Pair]:
    """All pairs of pictures whose stations are at most `reach` places apart in order."""
    order = {s: i for i, s in enumerate(sorted({r.station for r in records}))}
    places = [order[r.station] for r in records]
    by_place = sorted(range(len(records)), key=lambda i: (places[i], i))
    pairs = set()
    for a, i in enumerate(by_place):
        for j in by_place[a + 1 :]:
            if places[j] - places[i] > reach:
                break
            pairs.add((min(i, j), max(i, j)))
    return pairs


def footprints(records: Sequence[ImageRecord], rig: Rig, datum: Datum) -> list[Polygon]:
    """Where the borders of pictures meet the sea floor, taken as level at the altitude measured.

    Args:
        records: pictures with position, attitude and altitude.
        rig: cameras and lever arms.
        datum: origin of local coordinates.

    Returns:
        Polygons in north and east, metres; empty where a ray of the border never descends.
    """
    borders = {name: camera.unproject(camera.border(8)) for name, camera in rig.cameras.items()}
    positions = positions_ned(records, datum)
    reference = rig.cameras[rig.reference]
    polygons = []
    for record, position in zip(records, positions, strict=True):
        ned_from_body = RigidTransform.from_components(position, record.ned_from_body)
        outer_glass = (ned_from_body * rig.body_from_cam(rig.reference)).apply(reference.front_cam)
        floor = outer_glass[2] + record.altitude_m
        ned_from_cam = ned_from_body * rig.body_from_cam(record.camera)
        points, directions = borders[record.camera]
        starts = ned_from_cam.apply(points)
        rays = ned_from_cam.rotation.apply(directions)
        if not np.all(rays[:, 2] > 0.1):
            polygons.append(Polygon())
            continue
        hits = starts + ((floor - starts[:, 2]) / rays[:, 2])[:, None] * rays
        polygons.append(Polygon(hits[:, :2]).buffer(0))
    return polygons


def positions_ned(records: Sequence[ImageRecord], datum: Datum) -> Array:
    """Positions of pictures from navigation, (N, 3) metres; NaN where there are none."""
    rows = np.array([[r.latitude_deg, r.longitude_deg, r.depth_m] for r in records])
    rows = rows.reshape(-1, 3)
    known = np.isfinite(rows).all(axis=1)
    positions = np.full(rows.shape, np.nan)
    positions[known] = datum.ned_from_geodetic(rows[known])
    return positions


def _has_pose(record: ImageRecord) -> bool:
    return record.has_position and record.has_attitude and record.altitude_m > 0


def _overlapping(
    records: Sequence[ImageRecord], rig: Rig, datum: Datum
) -> tuple[set[Pair], set[Pair]]:
    polygons = footprints(records, rig, datum)
    # Two together make up the uncertainty of their distance, the root of two of that of one.
    reach = [_SIGMAS / np.sqrt(2.0) * _sigma_m(r, r.altitude_m) for r in records]
    wider = [p.buffer(float(by)) for p, by in zip(polygons, reach, strict=True)]
    centres = np.array([p.centroid.coords[0] for p in polygons]).reshape(-1, 2)
    group = joined_cameras(records, lambda i, j: _overlap(polygons[i], polygons[j]))
    sure: dict[Pair, float] = {}
    across: dict[Pair, float] = {}
    maybe: dict[Pair, float] = {}
    first, second = STRtree(wider).query(np.array(wider, object))
    once = first < second
    for i, j in sorted(zip(first[once].tolist(), second[once].tolist(), strict=True)):
        cameras = records[i].camera, records[j].camera
        apart = group[cameras[0]] != group[cameras[1]]
        if cameras[0] != cameras[1] and not apart:
            continue
        overlap = _overlap(polygons[i], polygons[j])
        if overlap >= _SURE_OVERLAP:
            (across if apart else sure)[i, j] = overlap
        elif _overlap(wider[i], wider[j]) >= _MIN_OVERLAP:
            maybe[i, j] = overlap
    headings = np.array([r.heading_deg for r in records])
    away = {(i, j): float(np.linalg.norm(centres[i] - centres[j])) for i, j in (*across, *maybe)}
    chosen = well_conditioned(sure, centres, headings)
    return chosen | nearest_each(across, away, _SECTORS), nearest_each(maybe, away, _LOOKS)


def _sharing(
    records: Sequence[ImageRecord],
    rig: Rig,
    datum: Datum,
    range_m: tuple[float, float],
    chosen: NDArray[np.bool_],
) -> tuple[set[Pair], set[Pair]]:
    """Pairs by frusta in which a chosen picture is, as `_overlapping` by footprints."""
    frusta = frusta_of(records, rig, datum, *range_m)
    slack = np.array([_SIGMAS * _sigma_m(r, float(np.mean(range_m))) for r in records])
    sharp = np.zeros(len(records))
    group = joined_cameras(records, lambda i, j: overlap_shares(frusta, [(i, j)], sharp)[i, j][0])

    def linked_within(i: int, j: int) -> bool:
        cameras = records[i].camera, records[j].camera
        return cameras[0] != cameras[1] and group[cameras[0]] == group[cameras[1]]

    pairs = [pair for pair in near_pairs(frusta, chosen, slack) if not linked_within(*pair)]
    sure: dict[Pair, float] = {}
    maybe: dict[Pair, float] = {}
    for pair, (middle, maximum) in overlap_shares(frusta, pairs, slack).items():
        if middle >= _SURE_OVERLAP:
            sure[pair] = middle
        elif maximum >= _MIN_OVERLAP:
            maybe[pair] = maximum
    middles = frusta.middles
    away = {(i, j): float(np.linalg.norm(middles[i] - middles[j])) for i, j in maybe}
    return all_round(frusta, sure), nearest_each(maybe, away, _LOOKS)


def _sigma_m(record: ImageRecord, distance_m: float) -> float:
    """Of the place of what a picture shows, by navigation; 0 where no sigma is known."""
    tilt = np.deg2rad(np.nan_to_num(record.sigma_attitude_deg)) * distance_m
    return float(np.hypot(np.nan_to_num(record.sigma_horizontal_m), tilt))


def joined_cameras(
    records: Sequence[ImageRecord], overlap: Callable[[int, int], float]
) -> dict[str, str]:
    """The cameras that overlap within most stations, one with the next, by a name for all of them.

    Args:
        records: pictures.
        overlap: of two of them.
    """
    stations: dict[int, list[int]] = {}
    for i, record in enumerate(records):
        stations.setdefault(record.station, []).append(i)
    overlaps: dict[tuple[str, str], list[float]] = {}
    for members in stations.values():
        for i, j in itertools.combinations(members, 2):
            cameras = records[i].camera, records[j].camera
            overlaps.setdefault(cameras, []).append(overlap(i, j))
    group = {record.camera: record.camera for record in records}
    for (one, other), shares in sorted(overlaps.items()):
        if np.median(shares) >= _SURE_OVERLAP:
            group = {c: group[one] if g == group[other] else g for c, g in group.items()}
    return group


def _overlap(first: Polygon, second: Polygon) -> float:
    """Share of the smaller footprint that the other covers."""
    smaller = min(first.area, second.area)
    return float(first.intersection(second).area / smaller) if smaller > 0 else 0.0


def well_conditioned(
    overlaps: Mapping[Pair, float], centres: Array, headings_deg: Array
) -> set[Pair]:
    """The best partners of every picture in all directions, on lines along and across its own.

    A partner is good for its overlap times its distance: far ones see heights under a wide angle,
    near ones share many spots, and a picture of the same place from the same place adds nothing
    new. The partner of most overlap is kept too: it carries the track on.

    Args:
        overlaps: share of the footprint in common, by pair.
        centres: (N, 2) of the footprints.
        headings_deg: (N,).
    """
    chosen = set()
    for i, found in partners_of(overlaps):
        kept = {max(found, key=lambda item: (item[1], -item[0]))[0]}
        sectors: dict[tuple[int, bool], list[tuple[float, int]]] = {}
        for j, overlap in found:
            north, east = centres[j] - centres[i]
            bearing = np.rad2deg(np.arctan2(east, north)) - headings_deg[i]
            sector = round(bearing / (360.0 / _SECTORS)) % _SECTORS
            across = abs(np.sin(np.deg2rad(headings_deg[j] - headings_deg[i]))) > np.sqrt(0.5)
            goodness = overlap * float(np.hypot(north, east))
            sectors.setdefault((sector, bool(across)), []).append((-goodness, j))
        for members in sectors.values():
            kept |= {j for _, j in sorted(members)[:_PER_SECTOR]}
        chosen |= {(min(i, j), max(i, j)) for j in kept}
    return chosen


def nearest_each(pairs: Iterable[Pair], apart: Mapping[Pair, float], maximum: int) -> set[Pair]:
    """Pairs that are among the nearest few of either picture."""
    partners: dict[int, list[tuple[float, Pair]]] = {}
    for pair in pairs:
        for i in pair:
            partners.setdefault(i, []).append((apart[pair], pair))
    return {pair for found in partners.values() for _, pair in sorted(found)[:maximum]}


def _nearest(records: Sequence[ImageRecord], datum: Datum) -> set[Pair]:
    positions = positions_ned(records, datum)
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if len(known) < 2:
        return set()
    count = min(_NEAREST + 1, len(known))
    nearest = known[KDTree(positions[known]).query(positions[known], k=count)[1]]
    return {pair for pair in _pairs_of(known, nearest) if pair[0] != pair[1]}


def _pairs_of(pictures: NDArray[np.int64], partners: NDArray[np.int64]) -> set[Pair]:
    """Pairs of pictures (N,) with each of their partners (N, K)."""
    first = np.broadcast_to(pictures[:, None], partners.shape)
    pairs = np.sort(np.stack([first, partners], axis=-1).reshape(-1, 2), axis=1)
    return {(i, j) for i, j in pairs.tolist()}


def alike_pairs(
    features: Sequence[Path],
    requested: Sequence[int],
    partners: int,
    *,
    seed: int,
    executor: Executor,
) -> list[Pair]:
    """Pairs of pictures that look most alike.

    Args:
        features: files of the features of every picture.
        requested: pictures for which partners are sought, among all.
        partners: how many for each.
        seed: of the codebook.
        executor: where tasks run.

    Returns:
        Pairs in rising order.
    """
    if len(features) < 2 or not len(requested):
        return []
    words = make_codebook(features, seed)
    file = features[0].parent / "looks.npy"
    looks = np.lib.format.open_memmap(
        file, mode="w+", dtype=np.float32, shape=(len(features), words.size)
    )
    rows = executor.map(partial(describe, words=words), features, label="looks of pictures")
    for number, row in enumerate(rows):
        looks[number] = row
    find = partial(nearest_looks, file, looks.mean(axis=0), min(partners, len(features) - 1))
    looks.flush()
    blocks = np.split(np.asarray(requested), range(_BLOCK, len(requested), _BLOCK))
    found = list(executor.map(find, blocks, label="pictures that look alike"))
    file.unlink()
    return sorted(_pairs_of(np.asarray(requested), np.concatenate(found)))


def nearest_looks(
    file: Path, mean: NDArray[np.float32], count: int, some: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The pictures (n, count) that look most like some pictures (n,), best first.

    Args:
        file: vectors of all pictures; a part of them is in memory at a time.
        mean: of all.
        count: how many for each.
        some: the pictures.
    """
    looks = np.load(file, mmap_mode="r")
    own = _directions(looks[some], mean)
    best, likeness = np.empty((len(some), 0), np.int64), np.empty((len(some), 0), np.float32)
    for start in range(0, len(looks), _AT_A_TIME):
        others = np.arange(start, min(start + _AT_A_TIME, len(looks)))
        like = own @ _directions(looks[others], mean).T
        like[some[:, None] == others] = -np.inf
        every = np.concatenate([best, np.broadcast_to(others, like.shape)], axis=1)
        likeness = np.concatenate([likeness, like], axis=1)
        order = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
        best = np.take_along_axis(every, order, axis=1)
        likeness = np.take_along_axis(likeness, order, axis=1)
    return best


def _directions(looks: NDArray[np.float32], mean: NDArray[np.float32]) -> NDArray[np.float32]:
    away = looks - mean
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1)[:, None], 1e-9))


def make_codebook(features: Sequence[Path], seed: int) -> NDArray[np.float32]:
    """Centres, (W, 128), of the features of evenly chosen pictures (k-means, Lloyd 1982)."""
    rng = np.random.default_rng(seed)
    step = max(1, len(features) // 100)
    some = features[::step]
    each = max(1, _SAMPLE // len(some))
    sample = np.concatenate([load_features(path).descriptors[:each] for path in some])
    sample = sample.astype(np.float32)
    words = sample[rng.choice(len(sample), min(_WORDS, len(sample)), replace=False)]
    for _ in range(_ROUNDS):
        word = _nearest_words(sample, words)
        count = np.bincount(word, minlength=len(words))
        sums = _sums(sample, word, len(words))
        filled = count > 0
        words[filled] = (sums[filled] / count[filled, None]).astype(np.float32)
    return words


def describe(features: Path, words: NDArray[np.float32]) -> NDArray[np.float32]:
    """The vector of a picture, (W * 128,); zeros without features."""
    descriptors = load_features(features).descriptors[:_MAX_FEATURES].astype(np.float32)
    if not len(descriptors):
        return np.zeros(words.size, np.float32)
    word = _nearest_words(descriptors, words)
    sums = _sums(descriptors - words[word], word, len(words))
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.asarray((sums / np.maximum(norms, 1e-9)).ravel().astype(np.float32))


def _nearest_words(
    descriptors: NDArray[np.float32], words: NDArray[np.float32]
) -> NDArray[np.intp]:
    distances = (words**2).sum(axis=1) - 2 * descriptors @ words.T
    return np.asarray(np.argmin(distances, axis=1))


def _sums(rows: NDArray[np.float32], word: NDArray[np.intp], words: int) -> Array:
    """Sums, (W, D), of rows (N, D) by word."""
    member = csr_array((np.ones(len(word)), (word, np.arange(len(word)))), (words, len(word)))
    return member @ rows.astype(np.float64)
