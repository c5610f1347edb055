"""A rendered survey whose every reflectance is known, with a grey card in it.

The left camera of the project's rig, its strobes and its sensor (which has no white balance) look
down on lines 0.75 m apart. Model and surface are the truth, so that errors of colour are the
mosaic's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import write_csv, write_json
from alice_survey.core.config import (
    CameraConfig,
    ImagingConfig,
    Jerlov,
    SeafloorConfig,
    WaterConfig,
)
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.sim.seafloor.as_built import true_rig
from alice_survey.sim.seafloor.light import (
    CameraLight,
    Sensor,
    camera_light,
    develop,
    expose,
    make_sensor,
    nominal_gain,
)
from alice_survey.sim.seafloor.renderer import Scene, flat_floor_radiance, render
from alice_survey.sim.seafloor.terrain import Terrain, build_terrain
from alice_survey.sim.seafloor.texture import SAND_ALBEDO, Texture, survey_texture
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.rig import Rig
from camera_calib.water import water_optics
from reconstruct.dense.cloud import VERTEX, write_cloud, write_cloud_json
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import WorldFrame, write_frame
from reconstruct.views.model_files import colmap_pinhole, rigid3d
from tests.cameras import range_map

Floats = NDArray[np.float32]

SEED, DEPTH_M, ALTITUDE_M = 23, 15.0, 2.0
LINE_M, STEP_M = 0.75, 0.45
CELL_M = 0.01
_MARGIN_M = 2.5
_MIDDLE_E = 8000.0
"""Electrons of a middling pixel: a hundredth of noise."""
CARD_M = 0.16
"""Side of a patch of the card."""
CARD = ((0.0, 0.40), (CARD_M, 0.12))
"""East of the first patch's middle, and reflectance, of the patches of the card."""
FRAME = WorldFrame(
    name="ned", datum=Datum(32.8236, 34.9553), scaled=True, vertical_datum="sea surface"
)


@dataclass(frozen=True, kw_only=True)
class Floor(Texture):
    """The sea floor's texture with a grey card on it."""

    card_ne: tuple[float, float]
    """Middle of the card's first patch."""

    def on_card(self, points_ned: Array) -> NDArray[np.intp]:
        """(N,) which patch of the card, -1 beside it."""
        local = np.abs(points_ned[:, None, :2] - card_centres(self.card_ne))
        inside = np.all(local <= CARD_M / 2, axis=2)
        return np.where(inside.any(axis=1), inside.argmax(axis=1), -1)

    def albedo(self, points_ned: Array, material: Floats, footprint_m: Floats) -> Floats:
        """See `Texture.albedo`."""
        found = super().albedo(points_ned, material, footprint_m)
        patch = self.on_card(points_ned)
        grey = np.array([reflectance for _, reflectance in CARD], np.float32)
        found[patch >= 0] = grey[patch[patch >= 0], None]
        return found


def card_centres(card_ne: tuple[float, float]) -> Array:
    """(P, 2) north and east of the middles of the card's patches."""
    return np.array([(card_ne[0], card_ne[1] + east) for east, _ in CARD])


@dataclass(frozen=True, kw_only=True)
class ColourSurvey:
    """What is rendered."""

    jerlov: Jerlov
    relief_m: float
    lines: int
    stations: int
    scale: int = 8

    @cached_property
    def rig(self) -> Rig:
        """As built."""
        return true_rig(CameraConfig(), WaterConfig(), scale=self.scale, seed=SEED)

    @cached_property
    def poses(self) -> list[RigidTransform]:
        """`ned_from_cam` of all pictures."""
        rng = np.random.default_rng([SEED, 1])
        found = []
        for line in range(self.lines):
            for step in range(self.stations):
                place = np.array([STEP_M * step, LINE_M * line, DEPTH_M - ALTITUDE_M])
                place += rng.normal(0.0, 0.05, 3)
                attitude = np.deg2rad(rng.normal([0.0, 0.0, 180.0 * (line % 2)], 2.0))
                body = RigidTransform.from_components(place, rotation_from_attitude(*attitude))
                # the camera, not the body, is over the lines
                cam = body * self.rig.body_from_cam("left")
                found.append(
                    RigidTransform.from_components(
                        np.append(place[:2], cam.translation[2]), cam.rotation
                    )
                )
        return found

    @property
    def images(self) -> list[str]:
        """Names of the pictures."""
        return [f"left/{n:04d}.png" for n in range(len(self.poses))]

    @property
    def card_ne(self) -> tuple[float, float]:
        """Middle of the card's first patch: about the middle of the survey."""
        return STEP_M * (self.stations - 1) / 2, LINE_M * (self.lines - 1) / 2 - CARD_M / 2

    @property
    def texture(self) -> Floor:
        """Of the sea floor and of the card on it."""
        return Floor(seed=survey_texture(SEED).seed, card_ne=self.card_ne)

    @cached_property
    def scene(self) -> Scene:
        """Sea floor with the card lying level on it."""
        reach = (
            -_MARGIN_M, STEP_M * self.stations + _MARGIN_M,
            -_MARGIN_M, LINE_M * self.lines + _MARGIN_M,
        )  # fmt: skip
        seafloor = SeafloorConfig(relief_m=self.relief_m, rocks_per_m2=1.0, largest_rock_m=0.6)
        terrain = build_terrain(seafloor, reach, DEPTH_M, np.random.default_rng([SEED, 2]))
        terrain = _with_card(terrain, card_centres(self.card_ne))
        return Scene(terrain=terrain, texture=self.texture)

    @cached_property
    def light(self) -> CameraLight:
        """The strobes and the water before the camera."""
        camera = self.rig.cameras["left"]
        water = water_optics(self.jerlov)
        return camera_light(camera, self.rig.body_from_cam("left"), ImagingConfig(), water, 5.0)

    @cached_property
    def exposure(self) -> tuple[Sensor, float]:
        """Sensor and gain, so that sand at the nominal altitude is middling."""
        camera = self.rig.cameras["left"]
        radiance = flat_floor_radiance(camera, self.light, ALTITUDE_M, SAND_ALBEDO, 16)
        one = make_sensor(CameraConfig(), camera.n_water, 1.0, self.scale)
        per_s = np.median((radiance * np.array(one.electrons_per_radiance)).mean(axis=-1))
        exposure_s = _MIDDLE_E / float(per_s)
        sensor = make_sensor(CameraConfig(), camera.n_water, exposure_s, self.scale)
        return sensor, nominal_gain(radiance * np.array(sensor.electrons_per_radiance), sensor)


def _with_card(terrain: Terrain, centres: Array) -> Terrain:
    """The floor made level under the card."""
    rows, columns = np.indices(terrain.depths.shape)
    corner = terrain.corner_ne + terrain.offset_ned[:2]
    north, east = corner[0] + rows * terrain.grid_m, corner[1] + columns * terrain.grid_m
    reach = CARD_M / 2 + 2 * terrain.grid_m
    under = (np.abs(north - centres[0, 0]) < reach) & (east > centres[0, 1] - reach)
    under &= east < centres[-1, 1] + reach
    depths = terrain.depths.copy()
    depths[under] = np.median(depths[under])
    return replace(terrain, depths=depths)


@lru_cache(maxsize=1)
def _studio(survey: ColourSurvey) -> ColourSurvey:
    """The one survey whose scene a process keeps."""
    return survey


def _take(task: tuple[Path, ColourSurvey, int]) -> None:
    folder, asked, number = task
    path = folder / "images" / asked.images[number]
    if path.exists():
        return
    survey = _studio(asked)
    camera, (sensor, gain) = survey.rig.cameras["left"], survey.exposure
    rng, pose = np.random.default_rng([SEED, 3, number]), survey.poses[number]
    seen = RigidTransform.from_matrix(pose.as_matrix()[None])
    radiance = render(survey.scene, camera, survey.light, seen, samples=2)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"range{number:04d}.npy", range_map(survey.scene, camera, pose))
    cv2.imwrite(str(path), develop(expose(radiance, sensor, rng), gain))


def write_survey(folder: Path, survey: ColourSurvey, executor: Executor) -> None:
    """Write a workspace with pictures, true model and true surface, and the pictures' ranges."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    tasks = [(folder, survey, number) for number in range(len(survey.poses))]
    list(executor.map(_take, tasks, label="pictures"))
    write_json(folder / "images" / "survey.json", {"source": "simulated"})
    write_json(folder / "images" / "stage.json", {})
    _write_sparse(folder / "sparse", survey)
    _write_dem(folder / "dense", survey)


def _write_sparse(sparse: Path, survey: ColourSurvey) -> None:
    (sparse / "model").mkdir(parents=True, exist_ok=True)
    warp = best_warp(survey.rig.cameras["left"], ALTITUDE_M - 0.7, ALTITUDE_M + 0.7)
    images = {
        name: {"camera": "left", "station": n, "mask": ""} for n, name in enumerate(survey.images)
    }
    write_json(sparse / "cameras.json", {"cameras": {"left": warp.to_json()}, "images": images})
    write_frame(sparse / "frame.json", FRAME)
    model = pycolmap.Reconstruction()
    camera = colmap_pinhole(warp.pinhole)
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    rng = np.random.default_rng(2)
    rows = []
    for n, (name, pose) in enumerate(zip(survey.images, survey.poses, strict=True)):
        places = pose.translation[:2] + rng.uniform(-0.4, 0.4, (20, 2))
        points = np.column_stack([places, survey.scene.terrain.depth_at(places)])
        back = warp.pinhole_from_cam * pose.inv()
        pixels = warp.pinhole.project(back.apply(points))
        image = pycolmap.Image(name=name, camera_id=1, image_id=n + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        model.add_image_with_trivial_frame(image, rigid3d(back))
        for place, point in enumerate(points):
            model.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(n + 1, place)]))
        placed = back.inv()
        rows.append((name, n, float(n), *placed.translation, *placed.rotation.as_quat()))
    model.write(str(sparse / "model"))
    header = ("image", "station", "time_s", "north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    write_csv(sparse / "track.csv", header, rows)
    write_json(sparse / "stage.json", {})


def _write_dem(dense: Path, survey: ColourSurvey) -> None:
    """Heights, and a cloud of the same points."""
    dense.mkdir(exist_ok=True)
    south, west = -0.8, -0.9
    rows = int((STEP_M * (survey.stations - 1) + 1.6) / CELL_M)
    columns = int((LINE_M * (survey.lines - 1) + 1.8) / CELL_M)
    grid = DemGrid(west=west, north=south + rows * CELL_M, cell=CELL_M, rows=rows, columns=columns)
    north = grid.north_of(np.arange(rows) + 0.5)
    east = grid.east_of(np.arange(columns) + 0.5)
    points, _ = from_above(survey.scene.terrain, *np.meshgrid(north, east, indexing="ij"))
    with tiled_raster(dense / "dem.tif", grid, FRAME, "float32", np.nan, "height") as raster:
        raster.write(-points[..., 2].astype(np.float32), 1)
    cloud = np.zeros(points.shape[0] * points.shape[1], VERTEX)
    for axis, values in zip("yxz", (points * [1.0, 1.0, -1.0]).reshape(-1, 3).T, strict=True):
        cloud[axis] = values
    write_cloud(dense / "cloud.ply", [cloud], (0.0, 0.0, 0.0), FRAME)
    write_cloud_json(dense / "cloud.json", len(cloud), (0.0, 0.0, 0.0), CELL_M, FRAME)
    write_json(dense / "stage.json", {})


def from_above(terrain: Terrain, north: Array, east: Array) -> tuple[Array, Floats]:
    """Points (..., 3), NED, that are seen straight from above, and their material (...)."""
    import open3d as o3d

    patch = terrain.patch()
    start = np.stack([north, east, np.zeros_like(north)], axis=-1) - patch.origin_ned
    start[..., 2] = -5.0
    rays = np.concatenate([start, np.broadcast_to([0.0, 0.0, 1.0], start.shape)], axis=-1)
    hit = patch.scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    depth = start[..., 2] + hit["t_hit"].numpy()
    points = np.concatenate([start[..., :2], depth[..., None]], axis=-1) + patch.origin_ned
    corners = patch.material[patch.triangles[hit["primitive_ids"].numpy()]]
    uv = hit["primitive_uvs"].numpy()
    weights = np.stack([1.0 - uv.sum(axis=-1), uv[..., 0], uv[..., 1]], axis=-1)
    return points, (corners * weights).sum(axis=-1).astype(np.float32)


def card_rows(survey: ColourSurvey, maximum: int = 4) -> Sequence[tuple[str | float, ...]]:
    """Rows of `colour_reference.csv`: the card in the pictures that show it whole and nearest."""
    camera = survey.rig.cameras["left"]
    centres = card_centres(survey.card_ne)
    points = np.column_stack([centres, survey.scene.terrain.depth_at(centres)])
    found = []
    for name, pose in zip(survey.images, survey.poses, strict=True):
        seen = pose.inv().apply(points)
        pixels = camera.project(seen)
        size = np.array([camera.width_px, camera.height_px])
        margin = 0.1 * size
        if ((pixels > margin) & (pixels < size - margin)).all():
            radius = 0.3 * CARD_M * camera.focal_in_water_px / seen[:, 2].max()
            off = np.linalg.norm(pixels.mean(axis=0) - size / 2)
            found.append((off, name, pixels, radius))
    return [
        (name, float(x) - 0.5, float(y) - 0.5, float(radius), grey, grey, grey)
        for _, name, pixels, radius in sorted(found, key=lambda one: one[0])[:maximum]
        for (x, y), (_, grey) in zip(pixels, CARD, strict=True)
    ]
