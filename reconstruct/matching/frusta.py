"""Pictures that may show the same surface, wherever they look: by what their frusta share.

Where the surface is along a picture's rays is not known before matching, only how far it is about.
A picture's points at these distances are looked for in other pictures: what shows few of them at
every distance shows another surface, or the same one from another side.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform

from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from camera_calib.camera import Camera
from camera_calib.rig import Rig

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
        found: Array = self.points[:, self.points.shape[1] // 2].mean(axis=1)
        return found

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
        angles = np.deg2rad([record.roll_deg, record.pitch_deg, record.heading_deg])
        body = RigidTransform.from_components(place, rotation_from_attitude(*angles))
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


def shared(
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
    found = {}
    middle = _DISTANCES // 2
    for i, j in pairs:
        wide = float(np.hypot(slack_m[i], slack_m[j]))
        sure = 0.5 * (_seen(frusta, i, j, 0.0) + _seen(frusta, j, i, 0.0))
        likely = (
            sure if wide == 0 else 0.5 * (_seen(frusta, i, j, wide) + _seen(frusta, j, i, wide))
        )
        found[i, j] = float(sure[middle]), float(likely.max())
    return found


def _seen(frusta: Frusta, i: int, j: int, wide_m: float) -> Array:
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
        size = np.array([camera.width_px, camera.height_px])
        with np.errstate(invalid="ignore"):
            inside[facing] = ((pixels > -margin[:, None]) & (pixels < size + margin[:, None])).all(
                axis=1
            )
    share: Array = inside.mean(axis=1)
    return share


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


def all_round(frusta: Frusta, overlaps: Mapping[Pair, float], sectors: int) -> set[Pair]:
    """Two partners of every picture in all directions across its view, as it is turned.

    In each direction, and among those turned by over 45 degrees about the axis, one that is best by
    its overlap times its distance, which sees depth under a wide angle, and one by its overlap
    times the cosine between the axes, to which a surface that bends looks most alike.

    Args:
        frusta: of the pictures.
        overlaps: by pair.
        sectors: directions.
    """
    middles = frusta.middles
    chosen = set()
    for i, found in partners_of(overlaps):
        kept: set[int] = set()
        cells: dict[tuple[int, bool], list[tuple[float, float, int]]] = {}
        here = frusta.ned_from_cam[i].rotation.inv()
        for j, overlap in found:
            right, down, _ = here.apply(middles[j] - middles[i])
            sector = round(np.arctan2(down, right) / (2 * np.pi / sectors)) % sectors
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
