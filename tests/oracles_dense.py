"""Slow, obvious twins of the dense kernels, and small scenes whose truth is known."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import rasterio
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import write_json
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, Datum
from camera_calib.approximation.pinhole_warp import Pinhole, PinholeWarp, best_warp
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import design_rig
from reconstruct.raster import DemGrid
from reconstruct.views.model import SparseModel, View, WorldFrame, write_frame
from reconstruct.views.model_files import colmap_pinhole, rigid3d
from reconstruct.views.range_shift import RangeShift, no_shift, range_shift
from tests.cameras import changed

DATUM = Datum(32.8236, 34.9553)
FRAME = WorldFrame(
    name="ned", datum=DATUM, scaled=True, vertical_datum="sea surface", notes=("a test",)
)
WIDTH, HEIGHT, FOCAL = 320, 256, 430.0
PINHOLE = Pinhole(
    width_px=WIDTH, height_px=HEIGHT, fx_px=FOCAL, fy_px=FOCAL,
    cx_px=WIDTH / 2 + 2.0, cy_px=HEIGHT / 2 - 1.5,
)  # fmt: skip
ALTITUDE_M, DEPTH_M = 2.0, 12.0


def merged(depths: NDArray[Any], sigmas: NDArray[Any], gate: float) -> tuple[float, float, int]:
    """One pixel of `merge_depths`."""
    known = ~np.isnan(depths)
    z, s = depths[known].astype(float), sigmas[known].astype(float)
    near = (z[:, None] - z) ** 2 <= gate**2 * (s[:, None] ** 2 + s**2)
    if not len(z) or near.sum(axis=1).max() < min(2, len(z)):
        return math.nan, math.nan, 0
    weights = max(near / s**2, key=lambda row: (np.count_nonzero(row), row.sum()))
    total = weights.sum()
    return weights @ z / total, total**-0.5, int(np.count_nonzero(weights))


def fused(
    heights: Array, sigmas: Array, views: Array, stations: NDArray[np.intp], shared: float
) -> tuple[float, float, int, int]:
    """`robust_height` of some points."""
    weights = 1.0 / np.asarray(sigmas, dtype=np.float64) ** 2
    order = np.argsort(heights, kind="stable")
    reached = np.cumsum(weights[order]) >= weights.sum() / 2
    at = order[np.argmax(reached)]
    median = heights[at]
    scatter = 1.4826 * np.median(np.abs(heights - median))
    near = np.abs(heights - median) <= 3.0 * max(scatter, sigmas[at])
    h, w, v = heights[near], weights[near], views[near]
    mean = np.average(h, weights=w)
    variance = np.average((h - mean) ** 2, weights=w)
    used = np.unique(v)
    formal = sum(w[v == view].mean() for view in used)
    sigma = math.sqrt((shared if len(used) > 1 else 1) / formal + variance / len(used))
    return float(mean), sigma, len(used), len(set(stations[used]))


def surfaces(
    heights: Array, sigmas: Array, places: Any, steepness: Array, cell: float
) -> list[list[int]]:
    """The points of each surface of a cell from above, as `surfaces_of` tells them apart."""
    ranks = np.argsort(heights, kind="stable")
    h, s = heights[ranks].astype(float), sigmas[ranks].astype(float)
    gap = np.diff(h) - 5.0 * np.hypot(s[:-1], s[1:])
    starts = np.flatnonzero(gap > cell) + 1
    slopes = []
    for part in np.split(ranks, starts):
        known = np.sort(steepness[part][~np.isnan(steepness[part])])
        slopes.append(float(known[len(known) // 2]) if len(known) else math.nan)
    steeper = np.fmax(slopes[:-1], slopes[1:])  # unknown divides nothing
    starts = starts[gap[starts - 1] > math.sqrt(2) * cell * steeper]
    shown = [p for p in np.split(ranks, starts) if len(p) >= 3 and len(set(places[p])) >= 2]
    return [part.tolist() for part in (shown[::-1] if len(shown) > 1 else [ranks])]


def projected(grid: DemGrid, points: np.ndarray, row: int, column: int) -> dict[str, float]:
    """One cell of `cells_over` in which no wall rises above what is known."""
    nothing = dict.fromkeys(("height", "sigma", "lower"), math.nan)
    nothing |= dict.fromkeys(("count", "stations", "surfaces"), 0)
    middle = (grid.west + (column + 0.5) * grid.cell, grid.north - (row + 0.5) * grid.cell)
    edge_on = math.cos(math.radians(80.0))
    away, normal = (points["enu"][:, :2] - middle) / grid.cell, points["normal"].astype(float)
    share = np.maximum(1 - np.abs(away), 0.0).prod(axis=1)
    wall = (np.abs(normal[:, 2]) < edge_on) & (np.abs(away).max(axis=1) <= 0.5)
    near = (normal[:, 2] >= edge_on) & (share > 1e-3)
    foot = points["enu"][wall, 2].min(initial=math.inf)
    if not near.any():
        return nothing
    p, share, rise = points[near], share[near], normal[near, :2] / normal[near, 2:]
    height = p["enu"][:, 2] + grid.cell * (away[near] * rise).sum(axis=1)
    sigma, shared = p["sigma"] / normal[near, 2], p["shared"] / normal[near, 2]
    steep, order = np.hypot(*rise.T), np.argsort(-height, kind="stable")
    below, above = order[1:], order[:-1]
    gaps = 5 * np.hypot(sigma[above], sigma[below])
    gaps += grid.cell * (1 + math.sqrt(2) * np.maximum(steep[above], steep[below]))
    layers = [
        layer
        for layer in np.split(order, np.flatnonzero(height[above] - height[below] > gaps) + 1)
        if share[layer].sum() >= 0.25 and p["stations"][layer].max() >= min(2, p["stations"].max())
    ]
    if not layers:
        return nothing

    def mean(layer: NDArray[np.intp], values: Array) -> float:
        return float(np.average(values[layer], weights=(share / sigma**2)[layer]))

    top = layers[0]
    highest = mean(top, height)
    scatter = mean(top, (height - highest) ** 2)
    nearest = p[top[np.argmax(share[top])]]
    variance = mean(top, sigma) ** 2 + scatter + mean(top, shared) ** 2
    reach = max(highest - foot, 0.0)
    return {
        "height": highest,
        "sigma": math.sqrt(variance + reach**2 / math.sqrt(24.0 * math.pi)),
        "count": int(nearest["views"]),
        "stations": int(nearest["stations"]),
        "surfaces": max(len(layers), 2 if reach > 0 else 1),
        "lower": mean(layers[-1], height) if len(layers) > 1 else math.nan,
    }


def sees(height: Array, camera: Array, cell: float, row: int, column: int) -> float:
    """How far the DEM rises at most over the line from a cell to the camera (negative: free).

    The DEM's first row and column have their outer edges at north 0 and west 0.
    """
    start = np.array([(column + 0.5) * cell, -(row + 0.5) * cell, height[row, column]])
    spots = start + np.linspace(0, 1, 4001)[1:, None] * (camera - start)
    at = np.floor(spots[:, [1, 0]] / [-cell, cell]).astype(int)
    over = np.logical_and.accumulate(((at >= 0) & (at < height.shape)).all(axis=1))
    over &= (at != [row, column]).any(axis=1)
    return float((height[tuple(at[over].T)] - spots[over, 2]).max(initial=-math.inf))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A sea floor given by its depth, and what it is painted with."""

    depth_of: Callable[[Array, Array], Array]
    """Depth from north and east, metres."""
    paint: Callable[[Array, Array], Array]
    """BGR levels (..., 3) from north and east."""
    cast: Callable[[Array, Array], Array] | None = None
    """How far rays (..., 3) from places (..., 3) go, in their lengths, where that is not known by
    depths: paint is then drawn through such a scene along one slant, so that sides have some."""


def flat(north: Array, east: Array) -> Array:
    return np.full(np.broadcast(north, east).shape, DEPTH_M)


def sloped_with_step(north: Array, east: Array) -> Array:
    """A gentle slope with a block, 0.1 m high, 0.4 m square, over the middle."""
    block = (np.abs(north - 0.3) < 0.2) & (np.abs(east - 0.35) < 0.2)
    return DEPTH_M + 0.08 * north - 0.05 * east - 0.1 * block


def texture(
    rng: np.random.Generator, half_m: float, step_m: float, details_m: tuple[float, ...]
) -> NDArray[np.float32]:
    """Random levels of a square with a sigma of one for each of the lengths of detail."""
    size = int(2 * half_m / step_m)
    picture = np.zeros((size, size), np.float32)
    for detail_m in details_m:
        coarse = int(2 * half_m / detail_m)
        noise = rng.normal(size=(coarse, coarse)).astype(np.float32)
        picture += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return picture


def speckle(seed: int = 3) -> Callable[[Array, Array], Array]:
    """Random grey texture with detail from 5 to 80 mm."""
    rng = np.random.default_rng(seed)
    step, half = 0.0025, 2.5
    picture = np.clip(110 + 22 * texture(rng, half, step, (0.005, 0.01, 0.03, 0.08)), 5, 245)

    def paint(north: Array, east: Array) -> Array:
        x = ((east + half) / step - 0.5).astype(np.float32)
        y = ((north + half) / step - 0.5).astype(np.float32)
        grey = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.stack([grey, 0.9 * grey, 0.8 * grey], axis=-1)

    return paint


@cache
def block_scene() -> Scene:
    """The slope with a block under speckle."""
    return Scene(depth_of=sloped_with_step, paint=speckle())


def boulder_scene(seed: int) -> Scene:
    """Three boulders and a thin ledge that leans over the floor, as triangles traced by open3d."""
    import open3d as o3d

    mesh, parts = o3d.geometry.TriangleMesh, []
    for size, middle, turn_deg in (
        ((5, 5, 0.1), (0.4, 0.4, 0.05), (20, 2, -3)),
        ((0.3, 0.3, 0.03), (0.6, 0.0, -0.2), (15 + 20 * seed, 4, 3)),
    ):
        box = mesh.create_box(*size).translate(np.array(middle), relative=False)
        turn = Rotation.from_euler("ZYX", turn_deg, degrees=True).as_matrix()
        parts.append(box.rotate(turn, center=np.array(middle)))
    for radius, place in ((0.17, (0.15, 0.2)), (0.12, (0.6, 0.45)), (0.09, (0.2, 0.72))):
        ball = mesh.create_sphere(radius, 40)
        corners = np.asarray(ball.vertices)
        bumps = 1 + 0.12 * np.sin((corners + 0.03 * seed) @ [[2.0], [3.0], [1.0]] / radius)
        ball.vertices = o3d.utility.Vector3dVector(corners * bumps * [1, 1, 0.8] + [*place, -0.06])
        parts.append(ball)
    solid = o3d.t.geometry.RaycastingScene()
    for part in parts:
        part.translate(DEPTH_M * _DOWN)
        solid.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(part))

    def cast(starts: Array, rays: Array) -> Array:
        found = solid.cast_rays(np.concatenate([starts, rays], axis=-1).astype(np.float32))
        return np.asarray(found["t_hit"].numpy(), np.float64)

    def depth_of(north: Array, east: Array) -> Array:
        top = np.stack([north, east, np.full(np.shape(north), DEPTH_M - 1.0)], axis=-1)
        return DEPTH_M - 1.0 + cast(top, np.broadcast_to(_DOWN, top.shape))

    return Scene(depth_of=depth_of, paint=speckle(), cast=cast)


_DOWN = np.array([0.0, 0.0, 1.0])
PERIOD_M = 0.3


def position_code(north: Array, east: Array) -> Array:
    """Blue encodes east and green encodes north, periodic, 2 levels a millimetre at most."""
    wave = 2 * np.pi / PERIOD_M
    blue, green = 128 + 100 * np.sin(wave * east), 128 + 100 * np.sin(wave * north)
    return np.stack([blue, green, np.full_like(blue, 128)], axis=-1)


CODED = Scene(depth_of=flat, paint=position_code)


def stereo_views(norths: Array, easts: Array, heading_deg: float = 20.0) -> list[View]:
    """Nadir stereo pairs, 0.1 m apart, over points of the sea floor."""
    ned_from_body = Rotation.from_euler("ZYX", [heading_deg, 1.0, -1.5], degrees=True)
    views = []
    for station, (north, east) in enumerate(zip(norths, easts, strict=True)):
        for camera, side in (("left", -0.05), ("right", 0.05)):
            over = np.array([north, east, DEPTH_M - ALTITUDE_M])
            centre = over + ned_from_body.apply([0, side, 0])
            pose = RigidTransform.from_components(centre, ned_from_body * BODY_FROM_NADIR_CAM)
            views.append(
                View(
                    image=f"{camera}/{station:03d}.png", camera=camera, station=station,
                    pinhole=PINHOLE, world_from_cam=pose, shift=no_shift(WIDTH, HEIGHT),
                )
            )  # fmt: skip
    return sorted(views, key=lambda view: view.image)


def two_lines(*along_m: float) -> list[View]:
    """Two lines, half a metre apart, of stereo stations at these places along each."""
    along, aside = np.meshgrid(along_m, [0.1, 0.6])
    return stereo_views(along.ravel(), aside.ravel(), heading_deg=0.0)


def view_at(pose: RigidTransform, pinhole: Pinhole, shift: RangeShift | None = None) -> View:
    """A view from a pose, `world_from_cam`; without a port where no shift is given."""
    return View(
        image="a",
        camera="left",
        station=0,
        pinhole=pinhole,
        world_from_cam=pose,
        shift=no_shift(*pinhole.size_px) if shift is None else shift,
    )


def port_view(centre: list[float], rpy_deg: list[float]) -> View:
    """A nadir camera 100 mm behind a port that is tilted by 2 degrees."""
    rig = design_rig(CameraConfig(port_distance_m=0.1), WaterConfig(), scale=8)
    tilt = np.deg2rad(2.0)
    camera = changed(rig.cameras[rig.reference], normal=(np.sin(tilt), 0.0, np.cos(tilt)))
    warp = best_warp(camera, 1.5, 2.5)
    turn = Rotation.from_euler("xyz", rpy_deg, degrees=True)
    pose = RigidTransform.from_components(centre, turn * BODY_FROM_NADIR_CAM)
    return view_at(pose, warp.pinhole, range_shift(warp))


def pixels_of(view: View) -> Array:
    """(N, 2) middles of all pixels, row by row."""
    rows, columns = np.mgrid[: view.pinhole.height_px, : view.pinhole.width_px] + 0.5
    return np.column_stack([columns.ravel(), rows.ravel()])


def plane_depth(view: View, down: float) -> np.ndarray:
    """Depth (H, W) at which a view's pixels meet the level plane so far down."""
    pixels = pixels_of(view)
    depth = np.full(len(pixels), down)
    for _ in range(30):
        points = view.at_depth(pixels, depth)
        depth = depth + (down - points[:, 2])
    return depth.reshape(view.pinhole.size_px[::-1]).astype(np.float32)


def hits(view: View, scene: Scene, oversample: int = 1) -> Array:
    """World points (H, W, 3) that a view's pixels see, approached from above (within 1e-9 m)."""
    step = 1.0 / oversample
    x = (np.arange(view.pinhole.width_px * oversample) + 0.5) * step
    y = (np.arange(view.pinhole.height_px * oversample) + 0.5) * step
    grid_x, grid_y = np.meshgrid(
        (x - view.pinhole.cx_px) / view.pinhole.fx_px, (y - view.pinhole.cy_px) / view.pinhole.fy_px
    )
    rays = np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1)
    world = view.world_from_cam.rotation.apply(rays.reshape(-1, 3)).reshape(rays.shape)
    centre = view.world_from_cam.translation
    if scene.cast is not None:
        return centre + scene.cast(np.broadcast_to(centre, world.shape), world)[..., None] * world
    reach = np.full(grid_x.shape, 0.9 * ALTITUDE_M)
    for _ in range(45):  # down in small steps while above the surface, so that edges hide
        points = centre + reach[..., None] * world
        above = scene.depth_of(points[..., 0], points[..., 1]) - points[..., 2]
        reach = reach + np.where(above > 0, 0.35 * above, 0.0)
    return centre + reach[..., None] * world


def render(view: View, scene: Scene) -> np.ndarray:
    """A picture (H, W, 3), each pixel the mean of 2 x 2 samples, without noise."""
    points = hits(view, scene, oversample=2)
    slant = (points[..., 2] - DEPTH_M) * (scene.cast is not None)
    fine = scene.paint(points[..., 0] + 0.45 * slant, points[..., 1] + 0.7 * slant)
    mean = fine.reshape(view.pinhole.height_px, 2, view.pinhole.width_px, 2, 3).mean(axis=(1, 3))
    return np.rint(np.clip(mean, 0, 255)).astype(np.uint8)


def sparse_model(views: list[View], scene: Scene, points: int = 400, seed: int = 5) -> SparseModel:
    """Points of the surface and the views in whose frames they lie."""
    rng = np.random.default_rng(seed)
    centres = np.array([view.world_from_cam.translation[:2] for view in views])
    low, high = centres.min(axis=0) - 0.8, centres.max(axis=0) + 0.8
    place = rng.uniform(low, high, (points, 2))
    world = np.column_stack([place, scene.depth_of(place[:, 0], place[:, 1])])
    rows = []
    for number, view in enumerate(views):
        pixels = view.project(world)
        inside = ((pixels > 0) & (pixels < view.pinhole.size_px)).all(axis=1)
        rows += [(int(point), number) for point in np.flatnonzero(inside)]
    return SparseModel(
        frame=FRAME,
        views=tuple(views),
        points_world=world,
        observations=np.array(sorted(rows), dtype=np.int64).reshape(-1, 2),
    )


def write_workspace(
    folder: Path, views: list[View], scene: Scene, world_from_scene: RigidTransform | None = None
) -> Path:
    """A workspace with finished `images` and `sparse` stages.

    Args:
        folder: of the workspace.
        views: of the scene.
        scene: what pictures show.
        world_from_scene: where scene and cameras stand in the world, together; None where they are.
    """
    model = sparse_model(views, scene)
    for view in views:
        path = folder / "images" / view.image
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), render(view, scene))
    if world_from_scene is not None:
        model = replace(
            model,
            views=tuple(
                replace(view, world_from_cam=world_from_scene * view.world_from_cam)
                for view in model.views
            ),
            points_world=world_from_scene.apply(model.points_world),
        )
    sparse = folder / "sparse"
    (sparse / "model").mkdir(parents=True)
    _colmap(model).write(str(sparse / "model"))
    write_frame(sparse / "frame.json", model.frame)
    cameras = {view.camera: view for view in model.views}
    write_json(
        sparse / "cameras.json",
        {
            "cameras": {name: _warp(view) for name, view in cameras.items()},
            "images": {
                view.image: {"camera": view.camera, "station": view.station, "mask": ""}
                for view in model.views
            },
        },
    )
    for stage in ("images", "sparse"):
        write_json(folder / stage / "stage.json", {})
    return folder


def read_raster(path: Path, band: int | None = 1) -> tuple[Array, Array, Array]:
    """Values of a band (of all of them for None), and north and east of the cells' centres."""
    with rasterio.open(path) as raster:
        values, t = raster.read(band).astype(np.float64), raster.transform
    rows, columns = np.mgrid[: values.shape[-2], : values.shape[-1]] + 0.5
    return values, t.f + rows * t.e, t.c + columns * t.a


def _warp(view: View) -> dict[str, object]:
    pinhole = asdict(view.pinhole)
    width, height = pinhole.pop("width_px"), pinhole.pop("height_px")
    warp = PinholeWarp(
        camera=Camera(width_px=width, height_px=height, lens=OpenCVLens(**pinhole)),
        pinhole=view.pinhole,
        centre_m=(0.0, 0.0, 0.0),
        working_range_m=1.0,
    )
    return warp.to_json()


def _colmap(model: SparseModel) -> pycolmap.Reconstruction:
    colmap = pycolmap.Reconstruction()
    names = sorted({view.camera for view in model.views})
    for number, name in enumerate(names, 1):
        camera = colmap_pinhole(next(v for v in model.views if v.camera == name).pinhole)
        camera.camera_id = number
        colmap.add_camera_with_trivial_rig(camera)
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    for number, view in enumerate(model.views, 1):
        seen = model.observations[model.observations[:, 1] == number - 1, 0]
        image = pycolmap.Image(
            name=view.image, camera_id=names.index(view.camera) + 1, image_id=number
        )
        pixels = view.project(model.points_world[seen])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        for place, point in enumerate(seen):
            element = pycolmap.TrackElement(number, place)
            tracks.setdefault(int(point), []).append(element)
        colmap.add_image_with_trivial_frame(image, rigid3d(view.world_from_cam.inv()))
    for point in sorted(tracks):
        colmap.add_point3D(model.points_world[point], pycolmap.Track(tracks[point]))
    return colmap
