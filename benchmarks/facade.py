"""A facade photographed by hand, rendered by Mitsuba 3: reconstruct it, judge surface and mosaic.

    .venv/bin/python -m benchmarks.facade --work FOLDER --mitsuba PYTHON [--quick] [--json FILE]
        [--judge]

Twenty-two pictures of one camera of which nothing is known, by a renderer that shares no code with
this project: windows and a door in recesses, a cornice, a balcony, two columns, the ground before
them. They go the way of a user: `import-images`, `reconstruct --plane auto`, `scale` by one known
length, `reconstruct` again. Cloud, mesh and the mosaic of the plane that was chosen are compared
with the facade's closed form. PYTHON has Mitsuba (`pip install mitsuba`, BSD-3-Clause); pictures
that are in FOLDER/photos are not rendered again. `--judge` only judges what is there.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import read_json
from alice_survey.core.frames import Array
from benchmarks import facade_scene as scene
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over, plain
from benchmarks.harbour_judge import face_points, spread
from benchmarks.harbour_mosaic import PATCH_PX, plane_points_ned, shift_px, windows_in
from benchmarks.harbour_survey import command
from benchmarks.measured import measured
from reconstruct.evaluate.scores import read_mesh
from reconstruct.placing.alignment import Similarity, align_similarity
from reconstruct.placing.track import read_track_poses

_LENGTH_BETWEEN = ((-1.95, 0.0, 2.45), (1.95, 0.0, 2.45))
_LENGTH_IN = 4
"""The known length, and the picture in which its ends are picked."""
_NEAR_PX = 3.0
_SAMPLES = 10_000
_MIN_PICTURES = 3


def main() -> None:
    """Render, reconstruct, judge; the exit code is 1 when a goal is missed."""
    parser = Parser(
        __doc__,
        quick="every second picture of the upper row is left out",
        work="keeps pictures and workspace",
    )
    parser.add_argument("--mitsuba", help="a Python that has Mitsuba")
    parser.add_argument("--judge", action="store_true", help="judge the workspace that is there")
    options, about = parser.begin("numpy")
    cameras = scene.cameras()
    if options.quick:
        cameras = [c for n, c in enumerate(cameras) if n < 9 or n % 2]
    names = [f"{n:02d}.png" for n in range(len(cameras))]
    workspace = options.work / "survey"
    findings = Findings()
    if not options.judge:
        render(options.work, cameras, names, options.mitsuba)
        findings += _reconstruct(options.work, cameras, workspace)
    found: dict[str, Any] = {}
    if not findings.failed:
        found = judge(workspace, cameras, names)
        findings += Findings(figures=figures(found, quick=options.quick))
        print(json.dumps(plain(found), indent=1))
    sys.exit(hand_over(options, about, findings, {"facade": found}))


def render(work: Path, cameras: list[dict[str, Any]], names: list[str], python: str | None) -> None:
    """Write the scene, and let Mitsuba render what is missing."""
    work.mkdir(parents=True, exist_ok=True)
    corners, triangles, places = scene.mesh()
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in places]
    lines += ["f " + " ".join(f"{k}/{k}" for k in one) for one in triangles + 1]
    (work / "facade.obj").write_text("\n".join(lines) + "\n")
    cv2.imwrite(str(work / "stones.png"), scene.texture()[..., ::-1])
    asked = {
        "mesh": "facade.obj",
        "texture": "stones.png",
        "size_px": scene.SIZE_PX,
        "fov_deg": scene.FOV_DEG,
        "cameras": [{"name": n, **c} for n, c in zip(names, cameras, strict=True)],
    }
    (work / "scene.json").write_text(json.dumps(asked, indent=1) + "\n")
    if all((work / "photos" / name).exists() for name in names):
        return
    if python is None:
        raise SystemExit("pictures are missing: name a Python that has Mitsuba with --mitsuba")
    script = Path(__file__).with_name("facade_render.py")
    subprocess.run([python, str(script), str(work)], check=True)


def _reconstruct(work: Path, cameras: list[dict[str, Any]], workspace: Path) -> Findings:
    shutil.rmtree(workspace, ignore_errors=True)
    print(command("import-images", str(work / "photos"), "-w", str(workspace)))
    line = [sys.executable, "-m", "alice_survey", "reconstruct", "-w", str(workspace)]
    cost = measured([*line, "--plane", "auto"], work / "reconstruct.log")
    if not cost.ok:
        return Findings(failed=(f"reconstruct: {cost.last_line()}",))
    ends = np.array(_LENGTH_BETWEEN)
    image = sorted(read_track_poses(workspace / "sparse" / "track.csv"))[_LENGTH_IN]
    spots = projected(ends, cameras[_LENGTH_IN])
    picks = " ".join(f"{image}:{x:.2f},{y:.2f}" for x, y in spots)
    length = f"{np.linalg.norm(ends[1] - ends[0]):.4f}"
    print(command("scale", "--points", picks, "--length", length, "-w", str(workspace)))
    scaled = measured([*line, "--plane", "auto"], work / "reconstruct-scaled.log")
    took = (
        Figure(name="reconstruct, computing", value=cost.cpu_s, unit="s"),
        Figure(name="with the scale, computing", value=scaled.cpu_s, unit="s"),
        Figure(name="memory", value=max(cost.peak_mib, scaled.peak_mib), unit="MiB"),
    )
    failed = () if scaled.ok else (f"reconstruct: {scaled.last_line()}",)
    return Findings(figures=took, failed=failed)


def looks(camera: dict[str, Any]) -> tuple[Array, Array]:
    """Rotation (3, 3) from the scene to right, down, forward, and the eye."""
    eye, target, up = (np.array(camera[name]) for name in ("eye", "target", "up"))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]), eye


def projected(points: Array, camera: dict[str, Any]) -> Array:
    """Pixels (N, 2) of points (N, 3), from the outer corner of the first; NaN behind the eye."""
    turn, eye = looks(camera)
    x, y, z = ((points - eye) @ turn.T).T
    z = np.where(z > 0, z, np.nan)
    width, height = scene.SIZE_PX
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * scene.FOV_DEG))
    return np.column_stack([0.5 * width + focal * x / z, 0.5 * height + focal * y / z])


def surface_samples() -> tuple[Array, Array]:
    """Points (N, 3) spread over the surface that a visitor may see, and normals."""
    rng = np.random.default_rng(6)
    points = rng.uniform([-4.0, -1.5, -0.02], [4.0, 0.4, 5.0], (15 * _SAMPLES, 3))
    points = points[np.abs(scene.distance(points)) < 0.02]
    for _ in range(3):
        points = points - scene.distance(points)[:, None] * scene.normals(points)
    points = points[np.abs(scene.distance(points)) < 1e-6]
    points = points[rng.permutation(len(points))[:_SAMPLES]]
    away = scene.normals(points)
    # Neither the back of the wall nor where two solids touch.
    facing = (away[:, 1] < 0.99) & (scene.distance(points + 1e-3 * away) > 0.9e-3)
    return points[facing], away[facing]


def pictures_that_see(points: Array, away: Array, cameras: list[dict[str, Any]]) -> NDArray[Any]:
    """(N,) pictures that see each point within 75 degrees of its normal."""
    seen = np.zeros(len(points), np.int64)
    for camera in cameras:
        pixels = projected(points, camera)
        eye = looks(camera)[1]
        way = eye - points
        cosine = (way * away).sum(axis=1) / np.linalg.norm(way, axis=1)
        shown = ((pixels > 0) & (pixels < scene.SIZE_PX)).all(axis=1) & (cosine > 0.26)
        start = points[shown] + 2e-3 * away[shown]
        seen[shown] += scene.reached(start, np.broadcast_to(eye, start.shape))
    return seen


def judge(workspace: Path, cameras: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Cameras, cloud, mesh and mosaic against the truth; lengths after a similarity alignment."""
    poses = read_track_poses(workspace / "sparse" / "track.csv")
    order = [names.index(Path(image).name) for image in sorted(poses)]
    source = np.stack([poses[image].translation for image in sorted(poses)])
    target = np.stack([looks(cameras[n])[1] for n in order])
    moved = align_similarity(source, target)
    misses = moved.apply(source) - target
    turns = [
        Rotation.from_matrix(looks(cameras[n])[0].T @ poses[image].rotation.as_matrix().T)
        * moved.rotation.inv()
        for n, image in zip(order, sorted(poses), strict=True)
    ]
    pixel_m = 2.0 * 5.0 * np.tan(np.deg2rad(0.5 * scene.FOV_DEG)) / scene.SIZE_PX[0]
    dense = workspace / "dense"
    points = laspy.read(dense / "cloud.copc.laz")
    cloud, sigma = _scene(points.xyz, moved), np.asarray(points["sigma"]) * moved.scale
    samples, away = surface_samples()
    seen = pictures_that_see(samples, away, cameras) >= _MIN_PICTURES
    gap = cKDTree(cloud).query(samples[seen], distance_upper_bound=_NEAR_PX * pixel_m)[0]
    vertices, triangles = read_mesh(workspace / "mesh")
    faces = face_points(moved.apply(vertices), triangles, _SAMPLES)
    pick = np.random.default_rng(0).permutation(len(cloud))[:_SAMPLES]
    axes = read_json(dense / "plane.json")
    out = _scene(np.array([axes["out_enu"]]), moved)[0] - _scene(np.zeros((1, 3)), moved)[0]
    return {
        "pixel_mm": 1e3 * pixel_m,
        "registered": len(poses),
        "pictures": len(names),
        "cameras_mm": 1e3 * float(np.sqrt((misses**2).sum(axis=1).mean())),
        "attitude_deg": float(np.rad2deg(np.sqrt(np.mean([t.magnitude() ** 2 for t in turns])))),
        "scale_error": 1.0 / moved.scale - 1.0,
        "cloud": spread(scene.distance(cloud[pick]), sigma[pick]),
        "complete": float(np.isfinite(gap).mean()),
        "mesh": spread(scene.distance(faces)),
        "plane_off_deg": float(np.rad2deg(np.arccos(-out[1] / np.linalg.norm(out)))),
        "mosaic": score_mosaic(dense, workspace / "mosaic", moved),
    }


def _scene(enu: Array, moved: Similarity) -> Array:
    return moved.apply(enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0])


def score_mosaic(dense: Path, mosaic: Path, moved: Similarity) -> dict[str, float]:
    """Shifts of the mosaic's patches on the wall against the stones painted on it."""
    axes = read_json(dense / "plane.json")
    with rasterio.open(dense / "dem.tif") as raster:
        heights, to_cell = raster.read(1).astype(np.float64), ~raster.transform
    with rasterio.open(mosaic / "mosaic.tif") as raster:
        picture, at = raster.read(), raster.transform
    stones = scene.texture().mean(axis=2)[::-1]
    per_m = scene.TEXTURE_PX / scene.TEXTURE_M
    shifts, looked = [], 0
    for window, rows, columns in windows_in(picture):
        x, y = at.c + columns * at.a, at.f + rows * at.e
        column, row = to_cell * (x.ravel(), y.ravel())
        height = map_coordinates(heights, [row - 0.5, column - 0.5], order=1, cval=np.nan)
        places = moved.apply(plane_points_ned(axes, x.ravel(), y.ravel(), height))
        if not np.isfinite(places).all() or np.abs(places[:, 1]).max() > 0.03:
            continue  # another part than the wall itself
        if np.abs(scene.distance(places)).max() > 0.03:
            continue
        looked += 1
        pixels = np.mod(places[:, [2, 0]] * per_m - 0.5, scene.TEXTURE_PX)
        fine = cv2.GaussianBlur(stones, (0, 0), 0.5 * moved.scale * at.a * per_m)
        true = map_coordinates(fine, pixels.T, order=1, mode="grid-wrap")
        shift = shift_px(window[:-1].mean(axis=0), true.reshape(PATCH_PX, PATCH_PX))
        if shift is not None:
            shifts.append(np.linalg.norm(shift))
    return {
        "patches": looked,
        "clear": len(shifts),
        "rms_px": float(np.sqrt(np.mean(np.square(shifts)))) if shifts else float("nan"),
        "pixel_mm": 1e3 * at.a * moved.scale,
    }


def figures(found: dict[str, Any], *, quick: bool) -> tuple[Figure, ...]:
    """With goals for the whole set."""

    def figure(name: str, value: float, unit: str, goal: Goal) -> Figure:
        return Figure(name=name, value=value, unit=unit, goal=None if quick else goal)

    pixel = found["pixel_mm"]
    return (
        figure("registered", found["registered"] / found["pictures"], "", Goal(minimum=1.0)),
        figure("cameras, rms", found["cameras_mm"] / pixel, "px", Goal(maximum=2.0)),
        figure("scale error", abs(found["scale_error"]), "", Goal(maximum=0.004)),
        figure("cloud, rms", found["cloud"]["rms_mm"] / pixel, "px", Goal(maximum=1.0)),
        figure("cloud, error over sigma", found["cloud"]["over_sigma_rms"], "",
               Goal(minimum=0.5, maximum=1.5)),
        figure("cloud, complete", found["complete"], "", Goal(minimum=0.95)),
        figure("mesh, rms", found["mesh"]["rms_mm"] / pixel, "px", Goal(maximum=2.0)),
        figure("plane, off the wall", found["plane_off_deg"], "deg", Goal(maximum=5.0)),
        figure("mosaic: shift, rms", found["mosaic"]["rms_px"], "px", Goal(maximum=1.5)),
    )  # fmt: skip


if __name__ == "__main__":
    main()
