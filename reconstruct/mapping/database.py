"""The COLMAP database that the mapper reads: cameras, rig, stations, keypoints and matches."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import RigidTransform

from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.matching.matches import PairMatches, as_seen
from reconstruct.views.model_files import rigid3d

VerifiedPair = tuple[int, int, PairMatches]
"""Indices of two pictures and what they share."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """What the mapper is given."""

    images: Sequence[ImageRecord]
    cameras: Mapping[str, pycolmap.Camera]
    """Cameras by name; the first is the reference of the rig."""
    taken: Sequence[Array]
    """Keypoints of every picture, (N, 2) pixels as taken."""
    pairs: Sequence[VerifiedPair]
    warps: Mapping[str, PinholeWarp] = field(default_factory=dict)
    """Warps to the pinholes `cameras`; none where cameras calibrate themselves."""

    @cached_property
    def pixels(self) -> Sequence[Array]:
        """Keypoints as `cameras` see them, (N, 2); see `as_seen`."""
        return [
            as_seen(rows, self.warps.get(record.camera))
            for record, rows in zip(self.images, self.taken, strict=True)
        ]

    @cached_property
    def connected(self) -> int:
        """Pictures of the largest group that matches hold together, and the rig where it is known.

        No mapper can register more in one model: pictures of blue water have no matches.
        """
        ends = [(i, j) for i, j, _ in self.pairs]
        if self.warps:
            first: dict[int, int] = {}
            ends += [(first.setdefault(r.station, i), i) for i, r in enumerate(self.images)]
        where = tuple(np.array(ends, dtype=np.intp).reshape(-1, 2).T)
        graph = coo_array((np.ones(len(ends)), where), shape=(len(self.images),) * 2)
        return int(np.bincount(connected_components(graph, directed=False)[1]).max())


def new_folder(path: Path) -> Path:
    """Make an empty folder for scratch files, in place of what is there."""
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    return path


@contextmanager
def scratch_database(
    folder: Path, seen: Observations, cam_from_rig: Mapping[str, RigidTransform] | None
) -> Iterator[Path]:
    """A new folder with `database.db` (see `write_database`), removed at the end."""
    new_folder(folder)
    write_database(folder / "database.db", seen, cam_from_rig)
    yield folder
    shutil.rmtree(folder)


@progress.step("hand pictures to the mapper")
def write_database(
    path: Path, seen: Observations, cam_from_rig: Mapping[str, RigidTransform] | None
) -> None:
    """Write a new database; picture i of `seen` gets the id i + 1.

    Args:
        path: must not exist.
        seen: pictures, keypoints and matches.
        cam_from_rig: poses of all cameras on one rig, or None: then every camera moves by itself.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        sensors = {}
        for number, (name, camera) in enumerate(seen.cameras.items(), 1):
            camera.camera_id = number
            database.write_camera(camera, use_camera_id=True)
            sensors[name] = camera.sensor_id
        rig_of = _write_rigs(database, sensors, cam_from_rig)
        for number, record in enumerate(seen.images, 1):
            image = pycolmap.Image(
                name=record.image, camera_id=sensors[record.camera].id, image_id=number
            )
            database.write_image(image, use_image_id=True)
            database.write_keypoints(number, seen.pixels[number - 1].astype(np.float32))
        stations: dict[int, list[int]] = {}
        for i, record in enumerate(seen.images):
            stations.setdefault(i if cam_from_rig is None else record.station, []).append(i)
        for number, (_, members) in enumerate(sorted(stations.items()), 1):
            frame = pycolmap.Frame(frame_id=number, rig_id=rig_of[seen.images[members[0]].camera])
            for member in members:
                sensor = sensors[seen.images[member].camera]
                frame.add_data_id(pycolmap.data_t(sensor, member + 1))
            database.write_frame(frame, use_frame_id=True)
        for i, j, pair in seen.pairs:
            matrices = {k: v for k, v in (pair.geometry or {}).items() if v is not None}
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration(matrices.pop("config")),
                inlier_matches=pair.matches,
                **matrices,
            )
            database.write_matches(i + 1, j + 1, pair.matches)
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def _write_rigs(
    database: pycolmap.Database,
    sensors: Mapping[str, pycolmap.sensor_t],
    cam_from_rig: Mapping[str, RigidTransform] | None,
) -> dict[str, int]:
    if cam_from_rig is None:
        for number, sensor in enumerate(sensors.values(), 1):
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(sensor)
            database.write_rig(rig, use_rig_id=True)
        return {name: number for number, name in enumerate(sensors, 1)}
    rig = pycolmap.Rig(rig_id=1)
    reference = next(iter(sensors))
    rig_from_reference = cam_from_rig[reference].inv()
    for name, sensor in sensors.items():
        if name == reference:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, rigid3d(cam_from_rig[name] * rig_from_reference))
    database.write_rig(rig, use_rig_id=True)
    return dict.fromkeys(sensors, 1)
