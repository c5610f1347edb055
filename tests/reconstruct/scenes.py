"""A synthetic survey whose every ray is known: stereo stations over relief, through flat ports."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from camera_calib.freedom import part_of_rig
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig, design_rig
from reconstruct.matching.matches import PairMatches

DATUM = Datum(32.8236, 34.9553)
SEAFLOOR_M = 15.0
ALTITUDE_M = 2.0
_FAR_M = 4.0
"""What lies farther from a camera is in no picture, and cameras so far apart share none."""
CALIBRATED = 2
"""COLMAP's number of a pair of calibrated pictures."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Truth, and what cameras and navigation say of it."""

    rig: Rig
    records: list[ImageRecord]
    ned_from_cam: list[RigidTransform]
    points_ned: Array
    pixels: list[Array]
    """As the flat-port cameras see them."""
    ids: list[NDArray[np.int64]]
    """Which point every pixel shows."""
    pairs: list[tuple[int, int, PairMatches]]

    @property
    def bodies(self) -> list[RigidTransform]:
        """`ned_from_body` of every picture."""
        return [
            pose * self.rig.body_from_cam(record.camera).inv()
            for pose, record in zip(self.ned_from_cam, self.records, strict=True)
        ]

    @property
    def left(self) -> "Scene":
        """The pictures of the left camera, alone."""
        mono = [k for k, record in enumerate(self.records) if record.camera == "left"]
        return replace(
            self, rig=part_of_rig(self.rig, ["left"]), records=[self.records[k] for k in mono],
            ned_from_cam=[self.ned_from_cam[k] for k in mono],
            pixels=[self.pixels[k] for k in mono], ids=[self.ids[k] for k in mono], pairs=[],
        )  # fmt: skip


def stating(records: Sequence[ImageRecord], places_ned: Array, **more: Any) -> list[ImageRecord]:
    """Pictures whose navigation says these places, (N, 3), and more."""
    return [
        replace(record, latitude_deg=a, longitude_deg=b, depth_m=d, **more)
        for record, (a, b, d) in zip(records, DATUM.geodetic_from_ned(places_ned), strict=True)
    ]


def make_scene(
    *,
    lines: int = 3,
    stations: int = 7,
    points: int = 1500,
    noise_px: float = 0.0,
    bias_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    port_distance_m: float = 0.02,
    port_tilt_deg: tuple[float, float] = (0.0, 0.0),
    port: PortValues | None = None,
    rig: Rig | None = None,
    scale: int = 4,
    relief_m: float = 0.16,
    seed: int = 5,
) -> Scene:
    """Fly lawnmower lines 1 m apart over sines of relief and look at random points.

    Relief reaches `relief_m` above and below the mean; pixels are `scale` times those of the
    camera, which noise in pixels refers to.

    `port` stands in for the flat one of the design, `rig` for all of it. Navigation is the truth
    plus a constant bias and 0.1 degrees of attitude noise.
    """
    rng = np.random.default_rng(seed)
    camera = CameraConfig(port_distance_m=port_distance_m, port_tilt_deg=port_tilt_deg)
    rig = rig or design_rig(camera, WaterConfig(), scale=scale)
    if port is not None:
        rig = replace(rig, cameras={n: replace(c, port=port) for n, c in rig.cameras.items()})
    length = 0.55 * stations
    north = rng.uniform(-1.5, length + 1.5, points)
    east = rng.uniform(-1.5, lines + 0.5, points)
    relief = 0.1 * np.sin(2.1 * north) + 0.06 * np.cos(3.3 * east + north)
    points_ned = np.stack([north, east, SEAFLOOR_M + relief * relief_m / 0.16], axis=1)
    records, poses, pixels, ids = [], [], [], []
    tree = cKDTree(points_ned)
    for station in range(lines * stations):
        line, step = divmod(station, stations)
        place = step if line % 2 == 0 else stations - 1 - step
        heading = 0.0 if line % 2 == 0 else np.pi
        body = np.array([0.55 * place, float(line), SEAFLOOR_M - ALTITUDE_M])
        body += rng.normal(0, 0.03, 3)
        attitude = np.array([0, 0, heading]) + rng.normal(0, np.deg2rad(1.5), 3)
        ned_from_body = RigidTransform.from_components(body, rotation_from_attitude(*attitude))
        stated = np.rad2deg(attitude + rng.normal(0, np.deg2rad(0.1), 3))
        latitude, longitude, depth = DATUM.geodetic_from_ned(body[None] + bias_m)[0]
        for name, cam in rig.cameras.items():
            pose = ned_from_body * rig.body_from_cam(name)
            near = np.sort(np.array(tree.query_ball_point(pose.translation, _FAR_M), dtype=int))
            seen = cam.project(pose.inv().apply(points_ned[near]))
            inside = np.all((seen > 1) & (seen < [cam.width_px - 1, cam.height_px - 1]), axis=1)
            ids.append(near[inside])
            pixels.append(seen[inside] + rng.normal(0, noise_px, (int(inside.sum()), 2)))
            poses.append(pose)
            records.append(
                ImageRecord(
                    image=f"{name}/{station:06d}.png",
                    camera=name,
                    station=station,
                    time_s=2.0 * station,
                    latitude_deg=latitude,
                    longitude_deg=longitude,
                    depth_m=depth,
                    roll_deg=stated[0],
                    pitch_deg=stated[1],
                    heading_deg=stated[2] % 360.0,
                    altitude_m=ALTITUDE_M,
                    sigma_horizontal_m=0.3,
                    sigma_depth_m=0.02,
                    sigma_attitude_deg=0.3,
                    sigma_heading_deg=1.0,
                )
            )
    around = cKDTree([pose.translation for pose in poses])
    return Scene(
        rig=rig,
        records=records,
        ned_from_cam=poses,
        points_ned=points_ned,
        pixels=pixels,
        ids=ids,
        pairs=match_pictures(ids, sorted(around.query_pairs(_FAR_M))),
    )


def match_pictures(
    ids: Sequence[NDArray[np.int64]],
    near: Iterable[tuple[int, int]],
    minimum: int = 15,
    config: int = CALIBRATED,
) -> list[tuple[int, int, PairMatches]]:
    """True matches of pairs of pictures that share enough points."""
    pairs = []
    for i, j in near:
        _, a, b = np.intersect1d(ids[i], ids[j], return_indices=True)
        if len(a) >= minimum:
            matches = np.stack([a, b], axis=1).astype(np.uint32)
            geometry = {"config": config, "E": None, "F": None, "H": None}
            pairs.append((i, j, PairMatches(matches=matches, geometry=geometry)))
    return pairs
