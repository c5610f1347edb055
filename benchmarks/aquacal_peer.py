"""AquaCal's batch projection, timed from outside: it needs an environment of its own.

AquaCal pins `opencv-python`, whose files overwrite those of this project's OpenCV. `camera.py`
therefore runs this file with another interpreter, and requests one run at a time, so that both
programs are measured in turns. This file imports nothing of the project.

    PYTHON aquacal_peer.py CASE.npz

Answers each line on standard input with the seconds of one run; before the first it prints the
versions and writes the pixels to CASE.pixels.npy.
"""

import sys
import time
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from aquacal.config.schema import CameraExtrinsics, CameraIntrinsics
from aquacal.core.camera import Camera
from aquacal.core.interface_model import Interface
from aquacal.core.refractive_geometry import refractive_project_batch


def main() -> None:
    """Load the case, then run it once per line."""
    path = Path(sys.argv[1])
    case = np.load(path)
    cv2.setNumThreads(1)
    camera = Camera(
        "camera",
        CameraIntrinsics(
            K=case["matrix"],
            dist_coeffs=case["distortion"],
            image_size=tuple(case["size"].tolist()),
        ),
        CameraExtrinsics(R=np.eye(3), t=np.zeros(3)),
    )
    interface = Interface(
        normal=np.array([0.0, 0.0, -1.0]),
        camera_distances={"camera": float(case["port_distance_m"])},
        n_air=1.0,
        n_water=float(case["n_water"]),
    )
    points = case["points"]
    np.save(path.with_suffix(".pixels.npy"), refractive_project_batch(camera, interface, points))
    print(f"aquacal {version('aquacal')}, opencv {cv2.__version__}", flush=True)
    for _ in sys.stdin:
        started = time.perf_counter()
        refractive_project_batch(camera, interface, points)
        print(time.perf_counter() - started, flush=True)


if __name__ == "__main__":
    main()
