"""Real pictures through the two commands a user types, and how the result compares.

    .venv/bin/python -m benchmarks.real_pictures ../shared/data WORKSPACES

For the drone block the surface is compared with another tool's cloud (`model.laz`) after a
similarity alignment, since neither has a measured scale.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
from pyproj import Transformer
from scipy.spatial import cKDTree

from alice_survey.frames import Array
from reconstruct.model import read_frame
from reconstruct.sparse.alignment import align_similarity

_POINTS = 40_000
_ROUNDS = 40


def reconstruct(name: str, arguments: list[str], workspaces: Path) -> Path:
    """Import and reconstruct; prints what was registered and how long it took."""
    workspace = workspaces / name
    command = [sys.executable, "-m", "alice_survey"]
    started = time.perf_counter()
    subprocess.run([*command, "import-images", *arguments, "-w", str(workspace)], check=True)
    subprocess.run([*command, "reconstruct", "-w", str(workspace)], check=True)
    took_s = time.perf_counter() - started
    found = json.loads((workspace / "sparse" / "registration.json").read_text())
    print(
        f"{name}: {found['registered']} of {found['total']} pictures registered, "
        f"{found['mean_reprojection_px']:.3f} px, {found['scale_source']}, {took_s:.0f} s"
    )
    return workspace


def cloud_utm(workspace: Path, epsg: int) -> Array:
    """Our cloud's points, (N, 3) easting, northing, height."""
    import open3d as o3d

    offset = json.loads((workspace / "dense" / "cloud.json").read_text())["offset_east_north_up"]
    cloud = o3d.io.read_point_cloud(str(workspace / "dense" / "cloud.ply"))
    local = np.asarray(cloud.points) + np.asarray(offset)
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
        similarity = align_similarity(sample[near], theirs[index[near]])
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


def main() -> None:
    """Run both sets and print the figures."""
    data, workspaces = Path(sys.argv[1]), Path(sys.argv[2])
    stereo = data / "haltbrekken"
    pair = ["--left", str(stereo / "left"), "--right", str(stereo / "right")]
    reconstruct("haltbrekken", pair, workspaces)
    drone = data / "brighton_beach"
    workspace = reconstruct("brighton_beach", [str(drone / "images")], workspaces)
    with laspy.open(drone / "model.laz") as file:
        reference = file.read()
        crs = reference.header.parse_crs()
    theirs = np.column_stack([reference.x, reference.y, reference.z])
    epsg = crs.to_epsg() if crs is not None else read_frame_epsg(workspace)
    figures = compare(cloud_utm(workspace, epsg), theirs, np.random.default_rng(1))
    print("brighton_beach against model.laz:", json.dumps(figures, indent=2))


def read_frame_epsg(workspace: Path) -> int:
    """UTM zone of a workspace's datum."""
    datum = read_frame(workspace / "sparse" / "frame.json").datum
    if datum is None:
        raise SystemExit(f"{workspace} is not georeferenced")
    return datum.utm_epsg


if __name__ == "__main__":
    main()
