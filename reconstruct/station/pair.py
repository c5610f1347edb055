"""One stereo station by itself: depth, cloud, mesh and lengths from a single pair of pictures.

What the paper's stereo system delivers of one animal: the rig's calibration carries the scale, the
exact rays through both flat ports the geometry.
"""

import contextlib
import shutil
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from alice_survey.core.artefacts import write_json
from alice_survey.core.errors import CalibrationError, ImageError, ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.robust import MAD_TO_SIGMA
from alice_survey.core.run import progress
from alice_survey.kit.figure import colour_bar, figure_style, new_figure, save_figure
from camera_calib.rig import Rig, read_rig, write_rig
from reconstruct.dense.cloud import VERTEX, write_cloud
from reconstruct.dense.depth import MATCH_SIGMA_PX, pair_depth
from reconstruct.dense.matching_trial import pixels_of, shrunk
from reconstruct.dense.scales import matching_scale
from reconstruct.matching.features import find_features
from reconstruct.matching.matches import match_descriptors
from reconstruct.mesh.atlas import Wedges
from reconstruct.mesh.decimate import decimate
from reconstruct.mesh.formats import GLB_AXES, write_mesh
from reconstruct.mesh.surface import TriangleMesh
from reconstruct.mesh.texture import Textured, remapped, write_jpeg
from reconstruct.mesh.topology import clean, split_fans, without_folds
from reconstruct.pictures.normalise import normalise
from reconstruct.pictures.undistorted import Pictures, read_colour
from reconstruct.station.precise import Sampler, inflation, precise_depth, sampler
from reconstruct.station.solve import PairOptics, matched_points, optics_for, stereo_rig
from reconstruct.views.model import View, WorldFrame, scaled_view

Float32 = NDArray[np.float32]

AXES = ("right", "up", "back")
"""Axes of clouds and meshes: of the left picture, the third towards the camera."""
_FEATURES = 6000
_RATIO = 0.8
_AGREE_SIGMAS = 3.0
"""Depths of left and right differ by at most this many standard deviations."""
_MIN_SHARE = 0.02
_MAX_VERTICES = 600_000
_STEEPEST = 8.0
"""Change of depth over the length of a side across the picture beyond which a side is a jump."""
_ERROR_SIGMAS = 0.3
_GROWTH = 1.4
_BARS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Lengths of the scale bar to choose from."""
_SAMPLE = 400
"""Pixels at which the precision of the pair is measured."""
_FRAME = WorldFrame(
    name="model", datum=None, scaled=True, vertical_datum="the left camera's entrance pupil"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PairDepth:
    """Depth of the left view, arrays of (H, W) at the scale of matching."""

    view: View
    depth: Float32
    """Depth before the left pinhole's centre, metres; NaN where unknown."""
    sigma: Float32
    """Sigma of matching alone."""
    colour: NDArray[np.uint8]
    """(H, W, 3) BGR, without refraction and distortion."""
    match_sigma_px: float
    """Standard deviation of a match, in pixels of the shrunk picture."""
    inflation: float
    """Factor by which the sigmas of precise matches of this pair are too small."""


def reconstruct_pair(
    left: Path,
    right: Path,
    rig: Path,
    output: Path,
    *,
    near_m: float | None = None,
    far_m: float | None = None,
    scale: float | None = None,
    triangles: int = 200_000,
) -> tuple[str, dict[str, Any]]:
    """Reconstruct what one stereo pair shows, into a folder that `measure` reads.

    Args:
        left: picture of the rig's first camera, as taken.
        right: picture of its second camera, taken at the same time.
        rig: `rig.json`.
        output: folder to write; what it held of an earlier pair is replaced.
        near_m: nearest distance along the axis; from the pair's own matches when None.
        far_m: farthest one.
        scale: factor by which pictures are shrunk for matching; from their size when None.
        triangles: largest number of the mesh.

    Returns:
        Text for the terminal, and its figures.

    Raises:
        CalibrationError: the rig cannot be read, or has one camera.
        ImageError: a picture cannot be read or is not of the rig's size.
        ReconstructionError: hardly any match, or the pictures are swapped.
    """
    calibrated = read_rig(rig)
    check_sizes(calibrated, (left, right))
    optics, matches = find_optics(calibrated, (left, right), near_m, far_m)
    found = dense_pair(optics, (left, right), matches, scale)
    known = np.isfinite(found.depth)
    if known.mean() < _MIN_SHARE:
        raise ReconstructionError(
            f"only {known.mean():.1%} of {left.name} has depth; the pair needs more light, texture "
            "or overlap"
        )
    partial = output.with_name(output.name + ".partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    _write_depth(partial, found)
    for name, path in (("left", left), ("right", right)):
        shutil.copyfile(path, partial / f"{name}{path.suffix.lower()}")
    points = _write_cloud(partial / "cloud.ply", found)
    mesh = depth_mesh(found.view, found.depth, found.sigma, triangles)
    facts: dict[str, Any] = {
        "format": "alice-survey pair",
        "version": 1,
        "left": left.name,
        "right": right.name,
        "pictures": [f"left{left.suffix.lower()}", f"right{right.suffix.lower()}"],
        "cameras": list(optics.rig.names),
        "rig_source": calibrated.source,
        "lenses": [warp.to_json() for warp in optics.warps],
        "scale": found.view.pinhole.width_px / optics.warps[0].pinhole.width_px,
        "match_sigma_px": found.match_sigma_px,
        "inflation": found.inflation,
        "matches": len(matches),
        "depth_share": round(float(known.mean()), 4),
        "distance_m": [round(float(d), 4) for d in np.percentile(found.depth[known], [2, 50, 98])],
        "sigma_m": round(float(np.median(found.sigma[known])), 6),
        "ground_pixel_m": round(
            float(np.median(found.depth[known])) / optics.warps[0].pinhole.fx_px, 6
        ),
        "points": points,
        "triangles": len(mesh.triangles),
        "axes": list(AXES),
        "unit": "m",
    }
    write_station_mesh(partial, mesh, found.view, found.colour, facts)
    write_rig(partial / "rig.json", calibrated)
    write_json(partial / "pair.json", facts)
    plot_pair(partial / "pair.png", found.view, found.colour, found.depth, found.sigma)
    if output.exists():
        if not (output / "pair.json").is_file():
            shutil.rmtree(partial)
            raise ReconstructionError(f"{output} is there and holds no pair: name another folder")
        shutil.rmtree(output)
    partial.rename(output)
    near, middle, far = facts["distance_m"]
    text = (
        f"{left.name} and {right.name}: depth of {facts['depth_share']:.0%} of the picture, "
        f"{near:.2f} to {far:.2f} m away; a pixel is {1e3 * facts['ground_pixel_m']:.2f} mm at "
        f"{middle:.2f} m, and depth known to {1e3 * facts['sigma_m']:.1f} mm (1 sigma)\n"
        f"{points} points and {facts['triangles']} triangles in {output}"
    )
    return text, facts


def check_sizes(rig: Rig, pictures: tuple[Path, Path]) -> None:
    """Check pictures against the cameras of a rig.

    Raises:
        ImageError: one cannot be read or is of another size.
        CalibrationError: the rig has one camera.
    """
    names = list(rig.cameras)
    if len(names) < 2:
        raise CalibrationError(f"the rig has one camera ({names[0]}): a pair needs two")
    for path, name in zip(pictures, names[:2], strict=True):
        camera = rig.cameras[name]
        height, width = read_colour(path).shape[:2]
        if (width, height) != (camera.width_px, camera.height_px):
            raise ImageError(
                f"{path}: {width} x {height} pixels, but camera {name!r} of the rig has "
                f"{camera.width_px} x {camera.height_px}"
            )


@progress.step("match features of the pair")
def find_optics(
    rig: Rig, pictures: tuple[Path, Path], near_m: float | None, far_m: float | None
) -> tuple[PairOptics, Array]:
    """The pinholes for the distances that matches of the pair show, and the matched points.

    Raises:
        ReconstructionError: see `matched_points`; or near is not nearer than far.
    """
    if near_m is not None and far_m is not None and not 0 < near_m < far_m:
        raise ReconstructionError(f"near {near_m} m and far {far_m} m: 0 < near < far is wanted")
    stereo = stereo_rig(rig)
    greys = [normalise(read_colour(path)) for path in pictures]
    scale = min(1.0, 1600.0 / max(greys[0].shape))
    features = [find_features(grey, None, scale=scale, maximum=_FEATURES) for grey in greys]
    matches = match_descriptors(features[0].descriptors, features[1].descriptors, _RATIO)
    points = matched_points(
        stereo, (features[0].pixels[matches[:, 0]], features[1].pixels[matches[:, 1]])
    )
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    near, far = near_m or float(low), far_m or float(high)
    if not near < far:
        raise ReconstructionError(f"near {near:.3g} m and far {far:.3g} m: near < far is wanted")
    inside = (points[:, 2] >= near / 1.1) & (points[:, 2] <= far * 1.1)
    return optics_for(stereo, near, far), points[inside]


@progress.step("find depth")
def dense_pair(
    optics: PairOptics, pictures: tuple[Path, Path], points: Array, scale: float | None
) -> PairDepth:
    """Depth of the left view that the right one confirms.

    Args:
        optics: both cameras.
        pictures: left and right.
        points: (N, 3) that bound the depth.
        scale: of matching; from the pictures' size when None.

    Raises:
        ReconstructionError: the views cannot be rectified.
    """
    wanted = min(scale or matching_scale(pixels_of(optics.views[0])), 1.0)
    views = [scaled_view(view, wanted) for view in optics.views]
    names = [str(path.absolute()) for path in pictures]
    opened = Pictures(
        Path(),
        dict(zip(optics.rig.names, optics.warps, strict=True)),
        dict(zip(names, optics.rig.names, strict=True)),
    )
    colours, looks = [], []
    for name, view in zip(names, views, strict=True):
        colour, valid = shrunk(opened, name, view.pinhole.size_px)
        colours.append(colour)
        looks.append((normalise(colour), valid))
    maps = []
    for a, b in ((0, 1), (1, 0)):
        found = pair_depth((views[a], views[b]), (looks[a], looks[b]), points)
        if found is None:
            angle = np.rad2deg(optics.rig.second_from_first.rotation.magnitude())
            raise ReconstructionError(
                "the cameras of the rig share too little of their view for dense matching: their "
                f"axes are {angle:.0f} degrees apart"
            )
        maps.append((found.depth, found.sigma(MATCH_SIGMA_PX)))
    depth = _agreeing(views[0], views[1], maps)
    samplers = pair_samplers(optics, pictures, (views[0], views[1]))
    match_sigma, factor = _match_sigma((views[0], views[1]), samplers, depth, maps[0][1])
    sigma = np.where(
        np.isfinite(depth), maps[0][1] * np.float32(match_sigma / MATCH_SIGMA_PX), np.nan
    )
    return PairDepth(
        view=views[0],
        depth=depth,
        sigma=sigma.astype(np.float32),
        colour=colours[0],
        match_sigma_px=match_sigma,
        inflation=factor,
    )


def pair_samplers(
    optics: PairOptics, pictures: tuple[Path, Path], views: tuple[View, View]
) -> tuple[Sampler, Sampler]:
    """What both views show, for precise matches."""
    first, second = (
        sampler(read_colour(path), warp, view)
        for path, warp, view in zip(pictures, optics.warps, views, strict=True)
    )
    return first, second


def _match_sigma(
    views: tuple[View, View], greys: tuple[Sampler, Sampler], depth: Float32, sigma: Float32
) -> tuple[float, float]:
    """Sigma of this pair's dense match, px, and the factor by which precise sigmas are too small.

    Dense depths are compared with least-squares matches, which are several times as precise, at
    pixels spread evenly.
    """
    rows, columns = np.nonzero(np.isfinite(depth))
    chosen = np.linspace(0, len(rows) - 1, min(_SAMPLE, len(rows))).astype(np.intp)
    rows, columns = rows[chosen], columns[chosen]
    precise = precise_depth(views, greys, depth, _centres(rows, columns))
    miss = (depth[rows, columns] - precise.depth) / sigma[rows, columns]
    factor = inflation(precise)
    match_sigma_px = MAD_TO_SIGMA * float(np.nanmedian(np.abs(miss))) * MATCH_SIGMA_PX
    return round(match_sigma_px, 4), round(factor, 3)


def _agreeing(left: View, right: View, maps: list[tuple[Float32, Float32]]) -> Float32:
    """Left depths that the right map confirms."""
    (depth, sigma), (other, other_sigma) = maps
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = _centres(rows, columns)
    points = left.at_depth(pixels, depth[rows, columns].astype(np.float64))
    there = right.project(points)
    z = right.world_from_cam.inv().apply(points)[:, 2]
    seen, seen_sigma = (
        remapped(map_, there, cv2.INTER_LINEAR, cv2.BORDER_CONSTANT).astype(np.float64)
        for map_ in (other, other_sigma)
    )
    with np.errstate(invalid="ignore"):
        miss = (seen - z) / np.hypot(seen_sigma, sigma[rows, columns])
        agrees = np.abs(miss) <= _AGREE_SIGMAS
    kept = np.full_like(depth, np.nan)
    kept[rows[agrees], columns[agrees]] = depth[rows[agrees], columns[agrees]]
    return kept


def _centres(rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    return np.column_stack([columns, rows]).astype(np.float64) + 0.5


def _write_depth(folder: Path, found: PairDepth) -> None:
    """`depth.tif`: depth and its sigma as two float32 bands over the left picture as warped."""
    height, width = found.depth.shape
    profile = {
        "driver": "GTiff", "width": width, "height": height, "count": 2, "dtype": "float32",
        "nodata": np.nan, "compress": "deflate", "predictor": 3, "tiled": True,
    }  # fmt: skip
    with _no_map(), rasterio.open(folder / "depth.tif", "w", **profile) as raster:
        raster.write(found.depth, 1)
        raster.write(found.sigma, 2)
        raster.set_band_description(1, "depth before the left pinhole's centre (m)")
        raster.set_band_description(2, "standard deviation of matching (m)")


def read_depth(folder: Path) -> Float32:
    """The depth map (H, W) of a pair's folder."""
    with _no_map(), rasterio.open(folder / "depth.tif") as raster:
        depth: Float32 = raster.read(1)
    return depth


@contextlib.contextmanager
def _no_map() -> Iterator[None]:
    """A picture's raster lies on no map: no warning of that."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


def to_axes(points_world: Array) -> Array:
    """Points (N, 3) of the left camera's frame as right, up, back."""
    flipped: Array = points_world * [1.0, -1.0, -1.0]
    return flipped


def _write_cloud(path: Path, found: PairDepth) -> int:
    rows, columns = np.nonzero(np.isfinite(found.depth))
    pixels = _centres(rows, columns)
    points = to_axes(found.view.at_depth(pixels, found.depth[rows, columns].astype(np.float64)))
    grid = np.full((*found.depth.shape, 3), np.nan)
    grid[rows, columns] = points
    normals = np.full_like(grid, np.nan)
    across = grid[1:-1, 2:] - grid[1:-1, :-2]
    along = grid[2:, 1:-1] - grid[:-2, 1:-1]
    normals[1:-1, 1:-1] = np.cross(along, across)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = normals / length
    flat = normals[rows, columns]
    known = np.isfinite(flat).all(axis=1)
    vertices = np.empty(int(known.sum()), VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = points[known].T
    vertices["nx"], vertices["ny"], vertices["nz"] = flat[known].T
    rgb = found.colour[rows[known], columns[known], ::-1]
    vertices["red"], vertices["green"], vertices["blue"] = rgb.T
    vertices["sigma"] = found.sigma[rows[known], columns[known]]
    return write_cloud(path, [vertices], (0.0, 0.0, 0.0), _FRAME)


@progress.step("make the mesh")
def depth_mesh(
    view: View, depth: NDArray[np.float32], sigma: NDArray[np.float32], maximum: int
) -> TriangleMesh:
    """Triangles between the pixels of a depth map, without those across jumps, decimated.

    Args:
        view: of the depth.
        depth: (H, W), NaN where unknown: holes stay holes.
        sigma: (H, W) of it: the mesh keeps within a share of its median.
        maximum: triangles.

    Raises:
        ReconstructionError: no triangle is left.
    """
    step = max(1, int(np.ceil(np.sqrt(np.isfinite(depth).sum() / _MAX_VERTICES))))
    thinned = depth[::step, ::step].astype(np.float64)
    rows, columns = np.nonzero(np.isfinite(thinned))
    pixels: Array = np.column_stack([columns, rows]) * float(step) + np.array([0.5, 0.5])
    vertices = view.at_depth(pixels, thinned[rows, columns])
    number = np.full(thinned.shape, -1, np.int32)
    number[rows, columns] = np.arange(len(rows), dtype=np.int32)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    # seen from the camera y points down: a, c, b turns left
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    triangles = triangles[(triangles >= 0).all(axis=1)]
    z = thinned[rows, columns][triangles]
    side = z.mean(axis=1) * step / view.pinhole.focal_px
    triangles = triangles[np.ptp(z, axis=1) <= _STEEPEST * side]
    triangles = without_folds(vertices, triangles)
    if not len(triangles):
        raise ReconstructionError("the pair's depths are too scattered to carry a surface")
    vertices, triangles, _ = split_fans(vertices, triangles)
    error = _ERROR_SIGMAS * float(np.nanmedian(sigma))
    while True:
        fewer = decimate(vertices, triangles, np.zeros(len(vertices), np.bool_), error)
        vertices, triangles = fewer.vertices, fewer.triangles
        if len(triangles) <= maximum:
            break
        error *= _GROWTH
    vertices, triangles, _ = clean(vertices, triangles)
    return TriangleMesh(vertices=vertices, triangles=triangles, error=error)


def write_station_mesh(
    folder: Path,
    mesh: TriangleMesh,
    view: View,
    colour: NDArray[np.uint8],
    facts: dict[str, Any],
) -> None:
    """Write `mesh.glb`, `mesh.obj` with `mesh.mtl` and `texture_0.jpg`, and `mesh.ply`."""
    page = folder / "texture_0.jpg"
    write_jpeg(page, colour)
    pixels = view.project(mesh.vertices)
    size = np.array(view.pinhole.size_px, dtype=np.float64)
    uv = np.clip(pixels / size, 0.0, 1.0)
    uv[:, 1] = 1.0 - uv[:, 1]
    count = len(mesh.vertices)
    shown = remapped(colour, pixels, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
    textured = Textured(
        vertices=mesh.vertices * [1.0, -1.0, -1.0],
        wedges=Wedges(
            vertex=np.arange(count), chart=np.zeros(count, np.int32), triangles=mesh.triangles
        ),
        uv=uv,
        page=np.zeros(len(mesh.triangles), np.int32),
        pages=(page,),
        colours=np.ascontiguousarray(shown[:, ::-1]),
        label=np.zeros(len(mesh.triangles), np.int32),
        scale=1.0,
    )
    comments = [
        "origin at the left camera's entrance pupil, m",
        "x right, y up, z towards the camera",
    ]
    axes = GLB_AXES.replace("east", "right").replace("north", "up in the picture")
    about = {"unit": "m", "axes": axes, "left": facts["left"]}
    write_mesh(folder, textured, about, comments)


@figure_style()
def plot_pair(
    path: Path,
    view: View,
    colour: NDArray[np.uint8],
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
) -> None:
    """Draw the left picture and its depth.

    Args:
        path: of the picture.
        view: of the depth.
        colour: (H, W, 3) BGR.
        depth: (H, W) m, NaN where unknown.
        sigma: (H, W) m.
    """
    height, width = depth.shape
    figure = new_figure(1.1 + 5.4 * height / width, 12.0)
    first, second = figure.subplots(1, 2)
    middle = float(np.nanmedian(depth))
    ground = middle / view.pinhole.focal_px
    first.imshow(np.ascontiguousarray(colour[..., ::-1]), interpolation="antialiased")
    bar = max((b for b in _BARS_M if b <= 0.3 * width * ground), default=_BARS_M[0])
    left, low = 0.06 * width, 0.92 * height
    first.plot([left, left + bar / ground], [low, low], color="white", lw=4)
    text = f"{bar:g} m" if bar >= 1 else f"{100 * bar:g} cm"
    first.text(
        left, low - 0.025 * height, f"{text} at {middle:.2f} m",
        color="white", ha="left", va="bottom",
    )  # fmt: skip
    first.set_title("left picture, without refraction and distortion")
    near, far = np.nanpercentile(depth, [1, 99])
    shown = second.imshow(depth, cmap="viridis_r", vmin=near, vmax=far, interpolation="nearest")
    second.set_facecolor("white")
    colour_bar(shown, second, "distance along the axis (m)")
    second.set_title(
        f"depth: {np.isfinite(depth).mean():.0%} of the picture, matching sigma "
        f"{1e3 * float(np.nanmedian(sigma)):.1f} mm",
        fontsize=10,
    )
    for axes in (first, second):
        axes.grid(visible=False)
        axes.set_xticks([])
        axes.set_yticks([])
    save_figure(figure, path, dpi=120)
