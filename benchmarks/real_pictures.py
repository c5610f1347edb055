"""Real pictures through the two commands a user types, and how the result compares.

    .venv/bin/python -m benchmarks.real_pictures --data FOLDER --work FOLDER [--quick] [--json FILE]

For the drone block the surface is compared with another tool's cloud (`model.laz`) after a
similarity alignment, since neither has a measured scale. Workspaces of the same names are made
again, so that times are those of the whole. `--quick` reconstructs a few pictures of a third set.
"""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
from pyproj import Transformer
from scipy.spatial import cKDTree

from alice_survey.core.frames import Array
from benchmarks.figures import Figure, Findings, Parser, hand_over
from reconstruct.placing.alignment import align_similarity
from reconstruct.views.model import read_frame

_POINTS = 40_000
_ROUNDS = 40
_QUICK_PICTURES = 6
_PACKAGES = ("numpy", "numba", "opencv-contrib-python-headless", "pycolmap")


def reconstruct(name: str, arguments: list[str], workspaces: Path) -> Findings:
    """Import and reconstruct; prints what was registered and how long it took."""
    workspace = workspaces / name
    if workspace.exists():
        shutil.rmtree(workspace)
    command = [sys.executable, "-m", "alice_survey"]
    started = time.perf_counter()
    for work in (["import-images", *arguments], ["reconstruct"]):
        code = subprocess.run([*command, *work, "-w", str(workspace)]).returncode
        if code:
            return Findings(failed=(f"{name}: {work[0]} ended with exit code {code}",))
    took_s = time.perf_counter() - started
    found = json.loads((workspace / "sparse" / "registration.json").read_text())
    print(
        f"{name}: {found['registered']} of {found['total']} pictures registered, "
        f"{found['mean_reprojection_px']:.3f} px, {found['scale_source']}, {took_s:.0f} s"
    )
    registered, total = found["registered"], found["total"]
    error_px = found["mean_reprojection_px"]
    return Findings(
        figures=(
            Figure(name=f"{name}: registered of {total}", value=registered, unit="pictures"),
            Figure(name=f"{name}: mean reprojection error", value=error_px, unit="px"),
            Figure(name=f"{name}: time to mosaic and mesh", value=took_s, unit="s"),
        )
    )


def cloud_utm(workspace: Path, epsg: int) -> Array:
    """Our cloud's points, (N, 3) easting, northing, height."""
    local = laspy.read(workspace / "dense" / "cloud.copc.laz").xyz
    datum = read_frame(workspace / "sparse" / "frame.json").datum
    if datum is None:
        raise SystemExit(f"{workspace} is not georeferenced")
    crs = f"+proj=aeqd +lat_0={datum.latitude_deg} +lon_0={datum.longitude_deg} +datum=WGS84"
    east, north = Transformer.from_crs(crs, epsg, always_xy=True).transform(*local[:, :2].T)
    return np.column_stack([east, north, local[:, 2]])


def compare(ours: Array, theirs: Array, rng: np.random.Generator) -> dict[str, float]:
    """Align by iterated closest points with a free scale, then measure distances to the surface.

    The distance is to the plane through the 12 nearest points of the reference, so that the
    reference's own spacing does not count.
    """
    sample = ours[rng.choice(len(ours), min(_POINTS, len(ours)), replace=False)]
    tree = cKDTree(theirs)
    moved = sample + np.median(theirs, axis=0) * [0, 0, 1] - np.median(sample, axis=0) * [0, 0, 1]
    for _ in range(_ROUNDS):
        distance, index = tree.query(moved, workers=-1)
        near = distance < np.percentile(distance, 80)
        similarity = align_similarity(sample[near], theirs[index][near])
        moved = similarity.apply(sample)
    _, neighbours = tree.query(moved, k=12, workers=-1)
    around = theirs[neighbours]
    centre = around.mean(axis=1)
    _, _, axes = np.linalg.svd(around - centre[:, None])
    plane_m = np.abs(np.einsum("nj,nj->n", moved - centre, axes[:, 2]))
    shift = similarity.apply(sample).mean(axis=0) - sample.mean(axis=0)
    return {
        "median_m": float(np.median(plane_m)),
        "median_nearest_point_m": float(np.median(tree.query(moved, workers=-1)[0])),
        "scale": similarity.scale,
        "shift_east_m": float(shift[0]),
        "shift_north_m": float(shift[1]),
        "shift_up_m": float(shift[2]),
    }


def against_cloud(drone: Path, workspace: Path) -> Findings:
    """Distance from the other tool's cloud; prints it."""
    with laspy.open(drone / "model.laz") as file:
        reference = file.read()
        crs = reference.header.parse_crs()
    theirs = np.column_stack([reference.x, reference.y, reference.z])
    epsg = crs.to_epsg() if crs is not None else read_frame_epsg(workspace)
    found = compare(cloud_utm(workspace, epsg), theirs, np.random.default_rng(1))
    print(f"{drone.name} against model.laz:", json.dumps(found, indent=2))
    return Findings(
        figures=tuple(
            Figure(
                name=f"{drone.name}, against another tool's cloud: {key.removesuffix('_m')}",
                value=value,
                unit="m" if key.endswith("_m") else "1",
            )
            for key, value in found.items()
        )
    )


def main() -> int:
    """Run the sets that are there and print the figures."""
    parser = Parser(
        __doc__, quick=f"{_QUICK_PICTURES} pictures of the smallest set", work="folder to work in"
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the sets")
    options, about = parser.begin(*_PACKAGES)
    sets = {"caliterra": run_few} if options.quick else {
        "haltbrekken": run_stereo, "brighton_beach": run_drone,
    }  # fmt: skip
    findings = Findings()
    for name, run in sets.items():
        if (options.data / name).is_dir():
            findings += run(options.data / name, options.work)
        else:
            findings += Findings(left_out=(f"{name}: no pictures in {options.data}",))
    return hand_over(options, about, findings)


def run_stereo(source: Path, workspaces: Path) -> Findings:
    """Underwater stereo, nothing known."""
    pair = ["--left", str(source / "left"), "--right", str(source / "right")]
    return reconstruct(source.name, pair, workspaces)


def run_drone(source: Path, workspaces: Path) -> Findings:
    """A drone's block, next to another tool's cloud of it."""
    findings = reconstruct(source.name, [str(source / "images")], workspaces)
    if findings.failed:
        return findings
    return findings + against_cloud(source, workspaces / source.name)


def run_few(source: Path, workspaces: Path) -> Findings:
    """The first pictures of a drone's block."""
    folder = workspaces / f"{source.name}_pictures"
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for picture in sorted((source / "images").iterdir())[:_QUICK_PICTURES]:
        (folder / picture.name).symlink_to(picture.resolve())
    return reconstruct(source.name, [str(folder)], workspaces)


def read_frame_epsg(workspace: Path) -> int:
    """UTM zone of a workspace's datum."""
    datum = read_frame(workspace / "sparse" / "frame.json").datum
    if datum is None:
        raise SystemExit(f"{workspace} is not georeferenced")
    return datum.utm_epsg


if __name__ == "__main__":
    sys.exit(main())
