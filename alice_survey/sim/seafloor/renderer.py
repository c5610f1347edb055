"""Render what a flat-port camera sees of a terrain, exactly: ray by ray through glass and water.

Every pixel is a mean over its area (`samples` x `samples` rays) and over the exposure (every ray
has its own moment, so that motion blurs). Rays come from `Camera.unproject`, hits from
Open3D's `RaycastingScene` on the part of the terrain in sight, about an origin close by.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import ImageError
from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.light import (
    CameraLight,
    add_direct,
    backscatter_at,
    backscatter_of_row,
)
from alice_survey.sim.seafloor.terrain import Patch, Terrain
from alice_survey.sim.seafloor.texture import Texture, mix
from camera_calib.camera import Camera

Floats = NDArray[np.float32]

_BAND_RAYS = 250_000
"""Rays worked on at once, about; bounds the memory at any picture size."""
_SHADOW_BLUR_PX = 3
_PAD_M = 0.4
"""Distance beyond the frame from which terrain can cast a shadow into it, about."""
_LEVEL = 0.05
"""Descent of a ray, as a share of its length, below which it counts as looking to the horizon."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Objects in front of the camera."""

    terrain: Terrain
    texture: Texture


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Rays of a band of rows, in the camera's frame; those of one pixel follow each other."""

    origins: Floats
    """(N, 3) on the outer glass, metres."""
    directions: Floats
    """(N, 3) unit vectors in water."""
    vignetting: Floats
    """(N,) cos^4 of the angle between ray and axis in air."""


def render(
    scene: Scene, camera: Camera, light: CameraLight, ned_from_cam: RigidTransform, samples: int
) -> Floats:
    """Radiance that reaches the pixels of a picture, times the lens's fall-off.

    Args:
        scene: what is there.
        camera: who looks.
        light: the strobes in this camera's frame. Terrain beyond its reach may be left out; a ray
            that meets none shows the backscatter up to there.
        ned_from_cam: (T,) poses of the camera at moments spread evenly over the exposure.
        samples: rays along a side of a pixel.

    Returns:
        (H, W, 3) red, green and blue, W / (m^2 sr).

    Raises:
        ImageError: the camera is in the sea floor.
    """
    patch = _patch_in_sight(scene.terrain, camera, ned_from_cam, light.reach_m)
    rotations = ned_from_cam.rotation.as_matrix().reshape(-1, 3, 3)
    places = ned_from_cam.translation.reshape(-1, 3) - patch.origin_ned
    picture = np.empty((camera.height_px, camera.width_px, 3), dtype=np.float32)
    pixel_rad = 1.0 / camera.focal_in_water_px
    table = (light.attenuation_per_m, light.backscatter, light.reach_m)
    rest = np.empty((0, 3), np.float32) if patch.to_rest is None else patch.to_rest
    for first, last in ray_bands(camera, samples):
        rays = camera_rays(camera, samples, first, last)
        moments = _moments(last - first, camera.width_px, samples, len(places), first)
        world = _to_world(rays.origins, rays.directions, moments, rotations, places)
        path, triangle, uv = _cast(patch, world)
        shape = (last - first, camera.width_px)
        lit = _visible_strobes(
            patch, light, world, path, moments, rotations, places, samples, shape
        )
        points, normals, material, footprint = _surface(
            world, path, triangle, uv, patch.triangles, patch.normals, patch.material, rest,
            np.float32(pixel_rad / samples),
        )  # fmt: skip
        albedo = scene.texture.albedo(points + patch.origin_ned, material, footprint)
        _shade(
            rays.origins, rays.directions, rays.vignetting, path, normals, albedo, lit, moments,
            rotations, light.positions_cam, light.axis_cam, light.beam_rad, light.peak_w_per_sr,
            *table, samples, first, camera.height_px, picture[first:last],
        )  # fmt: skip
    return picture


def flat_floor_radiance(
    camera: Camera, light: CameraLight, range_m: float, albedo: Array, step_px: int
) -> Floats:
    """Radiance of every `step_px`-th pixel over a flat, even floor square to the camera's axis.

    Args:
        camera: who looks.
        light: the strobes in its frame.
        range_m: from the entrance pupil to the floor along the axis.
        albedo: (3,) of the floor.
        step_px: between pixels.

    Returns:
        (rows, columns, 3) as `render` gives.
    """
    pixels = camera.pixel_centres(step_px)
    origins, directions = camera.unproject(pixels)
    path = (range_m - origins[..., 2]) / directions[..., 2]
    vignetting = _vignetting(camera, pixels)
    points = np.moveaxis(origins + path[..., None] * directions, -1, 0).reshape(3, -1)
    normals, lit = np.zeros(points.shape), np.ones((len(light.positions_cam), path.size))
    normals[2] = -1.0
    direct, veil = np.zeros((3, *path.shape)), np.empty((*path.shape, 3))
    add_direct(
        points, normals, path.ravel(), lit, light.positions_cam, light.axis_cam, light.beam_rad,
        light.peak_w_per_sr, light.attenuation_per_m, direct.reshape(3, -1),
    )  # fmt: skip
    last = np.array(light.backscatter.shape[1::-1]) - 1
    of_row = np.empty(light.backscatter.shape[1:])
    for index in np.ndindex(*path.shape):
        column, row = pixels[index] / (camera.width_px, camera.height_px) * last
        backscatter_of_row(light.backscatter, row, of_row)
        backscatter_at(of_row, light.reach_m, column, path[index], veil[index])
    received = albedo / math.pi * np.moveaxis(direct, 0, -1) + veil
    return (vignetting[..., None] * received).astype(np.float32)


@lru_cache(maxsize=48)  # about 340 MB; both cameras at a quarter of the full resolution fit
def camera_rays(camera: Camera, samples: int, first_row: int, last_row: int) -> Rays:
    """Rays of the pixels of some rows: `samples` x `samples` of each, evenly over its area.

    Raises:
        ImageError: the lens model has no inverse somewhere in the frame.
    """
    # One sample in each of samples^2 cells, and at samples^2 different x and y: an edge along a row
    # of pixels is placed as finely as one across them (multi-jittered arrangement, unjittered).
    i, j = np.mgrid[:samples, :samples]
    inside_x = ((i + (j + 0.5) / samples) / samples).ravel()
    inside_y = ((j + (i + 0.5) / samples) / samples).ravel()
    x = np.arange(camera.width_px)[None, :, None] + inside_x
    y = np.arange(first_row, last_row)[:, None, None] + inside_y
    pixels = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(-1, 2)
    origins, directions = camera.unproject(pixels)
    if not np.all(np.isfinite(directions)):
        raise ImageError(
            "the camera's lens distortion or port has no ray for some pixels of the frame; "
            "check k1, k2, p1, p2 and the port's normal"
        )
    return Rays(
        origins=origins.astype(np.float32),
        directions=directions.astype(np.float32),
        vignetting=_vignetting(camera, pixels).astype(np.float32),
    )


def _vignetting(camera: Camera, pixels: Array) -> Array:
    """Fall of light off the axis, by a power of the cosine in air, for pixels (..., 2)."""
    in_air = camera.in_air().unproject(pixels)[1]
    return in_air[..., 2] ** camera.lens.falloff


def ray_bands(camera: Camera, samples: int) -> list[tuple[int, int]]:
    """First and last (not included) rows of bands of a picture that hold about as many rays."""
    rows = max(_BAND_RAYS // (camera.width_px * samples**2), 1)
    return [(r, min(r + rows, camera.height_px)) for r in range(0, camera.height_px, rows)]


def _patch_in_sight(
    terrain: Terrain, camera: Camera, poses: RigidTransform, reach_m: float
) -> Patch:
    """The part of a terrain that the camera can see from any of the poses, and some around it.

    Rays down end below the deepest floor; where some look level or up, all end at `reach_m`
    at the latest.
    """
    origins, directions = camera.unproject(camera.border(8))
    deepest = float(terrain.depths.max()) + terrain.offset_ned[2] + _PAD_M
    level = bool(min(p.rotation.apply(directions)[:, 2].min() for p in poses) < _LEVEL)
    if level:  # then rays within the frame can end farther out than those of its border
        inner = camera.pixel_centres(max(camera.width_px // 16, 1)).reshape(-1, 2)
        origins, directions = camera.unproject(np.concatenate([camera.border(8), inner]))
    corners = []
    for pose in poses:
        from_ned, along = pose.apply(origins), pose.rotation.apply(directions)
        down = deepest - from_ned[:, 2]
        if down.min() <= 0.0:
            raise ImageError(
                f"the camera at {float(from_ned[:, 2].mean()):.2f} m depth is not above a sea "
                f"floor of {deepest:.2f} m; check depth and altitude"
            )
        path = down / np.maximum(along[:, 2], _LEVEL)
        path = np.minimum(path, reach_m) if level else path
        corners += [from_ned[:, :2], (from_ned + path[:, None] * along)[:, :2]]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    (south, west), (north, east) = (low - _PAD_M).tolist(), (high + _PAD_M).tolist()
    return terrain.patch((south, north, west, east))


def _cast(patch: Patch, world: Floats) -> tuple[Floats, NDArray[np.uint32], Floats]:
    """Path to the first hit (inf where there is none), its triangle, its place in the triangle."""
    import open3d as o3d

    hits: dict[str, Any] = patch.scene.cast_rays(o3d.core.Tensor.from_numpy(world), nthreads=1)
    return hits["t_hit"].numpy(), hits["primitive_ids"].numpy(), hits["primitive_uvs"].numpy()


def _visible_strobes(
    patch: Patch,
    light: CameraLight,
    world: Floats,
    path: Floats,
    moments: NDArray[np.uint8],
    rotations: Array,
    places: Array,
    samples: int,
    shape: tuple[int, int],
) -> Floats:
    """How much of each strobe a pixel's place on the ground sees, (pixels, S).

    One ray to each strobe from one sample of each pixel; a small blur stands for the strobe's size.
    """
    import cv2
    import open3d as o3d

    count = shape[0] * shape[1]
    lit = np.ones((count, len(light.positions_cam)), dtype=np.float32)
    rays, slope = np.empty((count, 6), np.float32), np.empty(count, np.float32)
    cell = np.empty((count, 2), np.intp)
    low = patch.vertices.min(axis=0)
    steepest, cell_m = patch.steepest
    for k, strobe in enumerate(light.positions_cam):
        aims = sum((rotations[..., axis] * strobe[axis] for axis in range(3)), start=places)
        within_m = _aim(world, path, moments, samples**2, aims, low, cell_m, rays, slope, cell)
        # Ground that is nowhere as steep as the way to the strobe hides it from none of its
        # places, up to where the way is above all there is.
        size = 2 * min(int(within_m / cell_m) + 2, max(steepest.shape)) + 1
        around = cv2.dilate(steepest, np.ones((size, size), np.uint8))
        doubtful = np.flatnonzero(slope <= 1.01 * around[cell[:, 0], cell[:, 1]])
        dark = patch.scene.test_occlusions(
            o3d.core.Tensor.from_numpy(rays[doubtful]), 0.002, 1.0 - 1e-4, nthreads=1
        )
        lit[doubtful, k] = ~dark.numpy()
        lit[:, k] = cv2.blur(lit[:, k].reshape(shape), (_SHADOW_BLUR_PX, _SHADOW_BLUR_PX)).ravel()
    return lit


@compiled(error_model="numpy")
def _aim(
    world: Array,
    path: Array,
    moments: Array,
    step: int,
    aims: Array,
    low: Array,
    cell_m: float,
    rays: Array,
    slope: Array,
    cell: Array,
) -> float:
    """Aim at a strobe from what each `step`-th ray hits.

    Args:
        world: see `_surface`, like path.
        path: see world.
        moments: (N,) of the rays.
        step: samples of a pixel.
        aims: (T, 3) where the strobe is.
        low: (3,) least north, east and depth of the patch.
        cell_m: of the grid of `Patch.steepest`.
        rays: (N / step, 6) filled, with the distance to the strobe as the unit of length.
        slope: (N / step,) filled: of that way; NaN where nothing is hit.
        cell: (N / step, 2) filled: row and column in the grid.

    Returns:
        Greatest distance from a hit, to the side, within which the way can be hidden.
    """
    within_m = 0.0
    for ray in range(len(rays)):
        i = ray * step
        slope[ray], cell[ray] = np.nan, 0
        if path[i] < np.inf:
            for a in range(3):
                rays[ray, a] = world[i, a] + path[i] * world[i, 3 + a]
                rays[ray, 3 + a] = aims[moments[i], a] - rays[ray, a]
            rise, aside = -rays[ray, 5], math.hypot(rays[ray, 3], rays[ray, 4])
            slope[ray] = rise / aside
            within_m = max(within_m, aside * (rays[ray, 2] - low[2]) / max(rise, 0.01))
            for a in range(2):
                cell[ray, a] = int((rays[ray, a] - low[a]) / cell_m)
    return within_m


@compiled
def _moments(
    rows: int, columns: int, samples: int, poses: int, first_row: int
) -> NDArray[np.uint8]:
    """Which pose each ray uses: all of a pixel's are spread over the exposure, in random order."""
    count = samples * samples
    moments = np.empty(rows * columns * count, np.uint8)
    for pixel in range(rows * columns):
        h = mix(np.uint32(pixel + first_row * columns) ^ np.uint32(0x5BD1E995))
        for k in range(count):
            part = (k * 7 + h % np.uint32(count)) % count if count % 7 else (k + h) % count
            h2 = mix(np.uint32(h + np.uint32(k * 977 + 1)))
            moments[pixel * count + k] = int(
                (part + (h2 & np.uint32(0xFFFF)) / 65536.0) * poses / count
            )
    return moments


@compiled
def _to_world(
    origins: Array, directions: Array, moments: Array, rotations: Array, places: Array
) -> Floats:
    """Rays in Open3D's layout, (N, 6) float32, about the origin that `places` count from."""
    world = np.empty((len(origins), 6), np.float32)
    for i in range(len(origins)):
        rotation, place = rotations[moments[i]], places[moments[i]]
        for a in range(3):
            p, d = place[a], 0.0
            for b in range(3):
                p += rotation[a, b] * origins[i, b]
                d += rotation[a, b] * directions[i, b]
            world[i, a], world[i, 3 + a] = p, d
    return world


@compiled
def _surface(
    world: Array,
    path: Array,
    triangle: Array,
    uv: Array,
    triangles: Array,
    vertex_normals: Array,
    vertex_material: Array,
    to_rest: Array,
    sample_rad: float,
) -> tuple[Array, Floats, Floats, Floats]:
    """What each ray hits; a ray that hits nothing keeps zeros.

    Args:
        world: (N, 6) rays.
        path: (N,) along them; not finite where nothing is hit.
        triangle: (N,) that is hit.
        uv: (N, 2) place in it.
        triangles: (T, 3) corners.
        vertex_normals: (V, 3).
        vertex_material: (V,).
        to_rest: (V, 3) to where the texture is; without rows where nothing moves.
        sample_rad: between neighbouring rays.

    Returns:
        Place of the texture, (N, 3); smooth unit normal, (N, 3); material, (N,); and distance
        between neighbouring samples on the surface, (N,) metres.
    """
    points = np.zeros((len(world), 3))
    normals = np.zeros((len(world), 3), np.float32)
    material = np.zeros(len(world), np.float32)
    footprint = np.ones(len(world), np.float32)
    for i in range(len(world)):
        if not path[i] < np.inf:
            continue
        a, b, c = triangles[triangle[i]]
        u, v = uv[i, 0], uv[i, 1]
        w = np.float32(1.0) - u - v
        length, slant = 0.0, 0.0
        for axis in range(3):
            points[i, axis] = world[i, axis] + np.float64(path[i]) * world[i, 3 + axis]
            if len(to_rest):
                points[i, axis] += (
                    (1.0 - u - v) * to_rest[a, axis] + u * to_rest[b, axis] + v * to_rest[c, axis]
                )
            n = (
                w * vertex_normals[a, axis]
                + u * vertex_normals[b, axis]
                + v * vertex_normals[c, axis]
            )
            normals[i, axis] = n
            length += n * n
        length = math.sqrt(length)
        for axis in range(3):
            normals[i, axis] /= length
            slant -= normals[i, axis] * world[i, 3 + axis]
        material[i] = w * vertex_material[a] + u * vertex_material[b] + v * vertex_material[c]
        footprint[i] = path[i] * sample_rad / math.sqrt(max(slant, 0.1))
    return points, normals, material, footprint


@compiled(error_model="numpy")
def _shade(
    origins: Array,
    directions: Array,
    vignetting: Array,
    path: Array,
    normals: Array,
    albedo: Array,
    lit: Array,
    moments: Array,
    rotations: Array,
    strobes: Array,
    axis: Array,
    beam_rad: float,
    peak: float,
    attenuation: Array,
    table: Array,
    reach_m: float,
    samples: int,
    first_row: int,
    frame_rows: int,
    picture: Array,
) -> None:
    """Light of every ray, averaged over each pixel: direct from the strobes, and backscatter."""
    rows, columns, _ = picture.shape
    count = samples * samples
    rays, veil = columns * count, np.empty(3)
    points, turned = np.empty((3, rays)), np.empty((3, rays))
    along, seen = np.empty(rays), np.empty((len(strobes), rays))
    grid_x, grid_y = (table.shape[1] - 1) / columns, (table.shape[0] - 1) / frame_rows
    of_row = np.empty(table.shape[1:])
    for row in range(rows):
        backscatter_of_row(table, (row + first_row + 0.5) * grid_y, of_row)
        for ray in range(rays):
            i = row * rays + ray
            along[ray] = path[i] if path[i] < np.inf else reach_m
            m = moments[i]
            for a in range(3):
                points[a, ray] = origins[i, a] + along[ray] * directions[i, a]
                turned[a, ray] = (
                    rotations[m, 0, a] * normals[i, 0]
                    + rotations[m, 1, a] * normals[i, 1]
                    + rotations[m, 2, a] * normals[i, 2]
                )
            for k in range(len(strobes)):
                seen[k, ray] = lit[i // count, k]
        direct = np.zeros((3, rays))
        add_direct(points, turned, along, seen, strobes, axis, beam_rad, peak, attenuation, direct)
        for column in range(columns):
            red, green, blue = 0.0, 0.0, 0.0
            for ray in range(column * count, (column + 1) * count):
                i = row * rays + ray
                backscatter_at(of_row, reach_m, (column + 0.5) * grid_x, along[ray], veil)
                weight = vignetting[i] / count
                red += weight * (albedo[i, 0] / math.pi * direct[0, ray] + veil[0])
                green += weight * (albedo[i, 1] / math.pi * direct[1, ray] + veil[1])
                blue += weight * (albedo[i, 2] / math.pi * direct[2, ray] + veil[2])
            picture[row, column, 0] = red
            picture[row, column, 1] = green
            picture[row, column, 2] = blue
