"""The mosaic's memory and time on surveys of growing area, up to a gigapixel.

    .venv/bin/python -m benchmarks.mosaic --work FOLDER [--megapixels 50 200 1000] [--threads N]
        [--quick] [--json FILE]

The survey is synthetic: a few pictures of random texture under many names (hard links), a camera
without port on straight lines 2 m over waves of 0.1 m, a ground pixel of 1 mm, 60 % and 30 % of
overlap; sparse model and DEM are written as the earlier stages would. Only the mosaic is timed.
Memory is the largest sum over the process and all its children (proportional set size). `--quick`
makes 50 megapixels alone.
"""

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import write_csv, write_json
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, Datum
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from benchmarks.measured import Cost, measured, python
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from reconstruct.raster import DemGrid, tiled_raster, tiles_of
from reconstruct.views.model import WorldFrame, write_frame

PIXEL_M, CELL_M = 0.001, 0.0025
WIDTH, HEIGHT, FOCAL = 2448, 2048, 2000.0
ALTITUDE_M, DEPTH_M, WAVES_M = 2.0, 12.0, 0.1
FORWARD_OVERLAP, SIDE_OVERLAP = 0.6, 0.3
_FILES = 5
_PACKAGES = ("numpy", "numba", "opencv-contrib-python-headless", "rasterio")
_POINTS = 20
"""Of the sparse model, seen by each picture."""
_MAX_MIB = 1536.0
_RUN = (
    "import sys; from pathlib import Path; from alice_survey.core.config import ReconstructConfig, "
    "SurveyConfig; from alice_survey.app.stages import spec; "
    "from alice_survey.core.executor import local_executor; "
    "spec('mosaic').make(Path(sys.argv[1]), SurveyConfig(reconstruct=ReconstructConfig("
    f"mosaic_pixel_m={PIXEL_M})), local_executor(int(sys.argv[2])))"
)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """One area."""

    megapixels: float
    pictures: int
    cost: Cost

    def findings(self) -> Findings:
        """Time and memory, or why there are none."""
        where, cost = f"{self.megapixels:g} Mpx", self.cost
        if not cost.ok:
            return Findings(failed=(f"{where}: {cost.last_line()}",))
        rows = (
            ("time", cost.wall_s, "s", None),
            ("processor time", cost.cpu_s, "s", None),
            ("processor time a megapixel", cost.cpu_s / self.megapixels, "s", None),
            ("peak memory", cost.peak_mib, "MiB", Goal(maximum=_MAX_MIB)),
        )
        return Findings(
            figures=tuple(
                Figure(name=f"{where}: {what}", value=value, unit=unit, goal=goal)
                for what, value, unit, goal in rows
            )
        )


def depth_of(north: Array, east: Array) -> Array:
    """Of the sea floor."""
    waves: Array = DEPTH_M + 0.5 * WAVES_M * (np.sin(1.7 * north) + np.cos(2.3 * east))
    return waves


def write_survey(workspace: Path, megapixels: float, seed: int = 1) -> int:
    """Write all that the mosaic is made of; return the number of pictures."""
    side_m = float(np.sqrt(megapixels * 1e6)) * PIXEL_M
    along = HEIGHT / FOCAL * ALTITUDE_M * (1.0 - FORWARD_OVERLAP)
    across = WIDTH / FOCAL * ALTITUDE_M * (1.0 - SIDE_OVERLAP)
    norths = np.arange(0.0, side_m + along, along)
    easts = np.arange(0.0, side_m + across, across)
    centres = np.array([(north, east) for east in easts for north in norths])
    names = [f"left/{n:06d}.jpg" for n in range(len(centres))]
    _write_pictures(workspace / "images", names, seed)
    _write_sparse(workspace / "sparse", names, centres)
    _write_dem(workspace / "dense", side_m)
    return len(names)


def _write_pictures(images: Path, names: list[str], seed: int) -> None:
    rng = np.random.default_rng(seed)
    (images / "left").mkdir(parents=True)
    files = []
    for number in range(_FILES):
        light = np.zeros((HEIGHT, WIDTH), np.float32)
        for size in (8, 32, 128, 512, 1224):
            noise = rng.normal(size=(size * HEIGHT // WIDTH, size)).astype(np.float32)
            light += cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        grey = np.clip(110 + 22 * light, 5, 245)[..., None] * [0.9, 1.0, 0.8]
        files.append(images / f"texture{number}.jpg")
        cv2.imwrite(str(files[-1]), grey.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    for n, name in enumerate(names):
        os.link(files[n % _FILES], images / name)
    write_json(images / "survey.json", {"source": "synthetic"})
    write_json(images / "stage.json", {})


def _write_sparse(sparse: Path, names: list[str], centres: Array) -> None:
    frame = WorldFrame(
        name="ned", datum=Datum(32.8236, 34.9553), scaled=True, vertical_datum="sea surface"
    )
    (sparse / "model").mkdir(parents=True)
    lens = OpenCVLens(fx_px=FOCAL, fy_px=FOCAL, cx_px=WIDTH / 2, cy_px=HEIGHT / 2)
    camera = Camera(width_px=WIDTH, height_px=HEIGHT, lens=lens)
    warp = best_warp(camera, 1.0, 1.0)
    images = {name: {"camera": "left", "station": n, "mask": ""} for n, name in enumerate(names)}
    write_json(sparse / "cameras.json", {"cameras": {"left": warp.to_json()}, "images": images})
    write_frame(sparse / "frame.json", frame)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=warp.pinhole.numbers
        )
    )
    rng = np.random.default_rng(2)
    rows, tracks = [], []
    for n, (name, (north, east)) in enumerate(zip(names, centres, strict=True)):
        turned = Rotation.from_euler("ZYX", rng.normal(0, [2.0, 1.0, 1.0]), degrees=True)
        centre = np.array([north, east, DEPTH_M - ALTITUDE_M])
        pose = RigidTransform.from_components(centre, turned * BODY_FROM_NADIR_CAM)
        rows.append((name, n, float(n), *centre, *pose.rotation.as_quat()))
        places = centre[:2] + rng.uniform(-0.6, 0.6, (_POINTS, 2))
        points = np.column_stack([places, depth_of(places[:, 0], places[:, 1])])
        back = pose.inv()
        seen = back.apply(points)
        pixels = FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        image = pycolmap.Image(name=name, camera_id=1, image_id=n + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(back.rotation.as_quat()), back.translation)
        )
        tracks += [(point, n + 1, place) for place, point in enumerate(points)]
    for point, image_id, place in tracks:
        model.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(image_id, place)]))
    model.write(str(sparse / "model"))
    header = ("image", "station", "time_s", "north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    write_csv(sparse / "track.csv", header, rows)
    write_json(sparse / "stage.json", {})


def _write_dem(dense: Path, side_m: float) -> None:
    dense.mkdir()
    cells = int(np.ceil(side_m / CELL_M))
    grid = DemGrid(west=0.0, north=cells * CELL_M, cell=CELL_M, rows=cells, columns=cells)
    frame = WorldFrame(
        name="ned", datum=Datum(32.8236, 34.9553), scaled=True, vertical_datum="sea surface"
    )
    with tiled_raster(dense / "dem.tif", grid, frame, "float32", np.nan, "height") as raster:
        for window in tiles_of(grid, 2048):
            part = grid.window(window.row_off, window.col_off, window.height, window.width)
            north = part.north_of(np.arange(part.rows) + 0.5)[:, None]
            east = part.east_of(np.arange(part.columns) + 0.5)[None]
            raster.write((-depth_of(north, east)).astype(np.float32), 1, window=window)
    write_json(dense / "stage.json", {})


def measure(work: Path, megapixels: float, threads: int) -> Measured:
    """Write a survey, paint it and take it away again; its log stays."""
    workspace = work / f"mosaic_{megapixels:.0f}"
    if workspace.exists():
        shutil.rmtree(workspace)
    pictures = write_survey(workspace, megapixels)
    log = work / f"mosaic_{megapixels:.0f}.log"
    cost = measured([*python("-c", _RUN), str(workspace), str(threads)], log)
    if cost.ok:
        shutil.copy(workspace / "mosaic" / "mosaic.png", log.with_suffix(".png"))
        shutil.rmtree(workspace)
    return Measured(megapixels=megapixels, pictures=pictures, cost=cost)


def main() -> int:
    """Print a line for each area; fail where memory is above the promise."""
    parser = Parser(__doc__, quick="50 megapixels alone", work="folder for the surveys")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[50.0, 200.0, 1000.0])
    parser.add_argument("--threads", type=int, default=2, help="each takes up to 400 MiB")
    options, about = parser.begin(*_PACKAGES)
    findings = Findings()
    for megapixels in [50.0] if options.quick else options.megapixels:
        found = measure(options.work, megapixels, options.threads)
        findings += found.findings()
        if not found.cost.ok:
            break
    return hand_over(options, about, findings)


if __name__ == "__main__":
    sys.exit(main())
