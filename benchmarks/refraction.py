"""What refraction through a flat port costs, by how it is taken: tracks whose truth is known.

    python -m benchmarks.refraction [--stations 48] [--points 6000] [--quick]
        [--json FILE]

For port distances of 20 and 50 mm and tilts of 0 and 2 degrees it states the rms of points and
cameras after rigid alignment: ours, the warp to one working depth alone, COLMAP's self-calibrated
OPENCV model of the pixels as taken, and, where requested, an exact refractive adjustment as plain
as can be (10 minutes a row with 48 stations and 1000 points).
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from alice_survey.core.frames import Array
from benchmarks.figures import Figure, Findings, Parser, hand_over
from reconstruct.mapping.bundle import all_pictures, held_options
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.refraction import adjust_freely, refract
from reconstruct.mapping.self_calibration import self_calibrated_warp
from reconstruct.placing.alignment import align_rigid
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import near_truth, pupils_and_points, warped_scene

NOISE_PX, RELIEF_M = 0.3, 0.3
_QUICK_STATIONS, _QUICK_POINTS = 12, 800


def main() -> None:
    """Print the table."""
    parser = Parser(__doc__, quick=f"{_QUICK_STATIONS} stations and {_QUICK_POINTS} points")
    parser.add_argument("--stations", type=int, default=48)
    parser.add_argument("--points", type=int, default=6000)
    asked, about = parser.begin("numpy", "scipy", "pycolmap")
    stations = _QUICK_STATIONS if asked.quick else asked.stations
    figures = list[Figure]()
    for port_m in (0.02, 0.05):
        for tilt_deg in (0.0, 2.0):
            lines = 4
            scene = make_scene(
                lines=lines,
                stations=stations // lines,
                points=_QUICK_POINTS if asked.quick else asked.points,
                noise_px=NOISE_PX,
                port_distance_m=port_m,
                port_tilt_deg=(tilt_deg, 0.0),
                scale=1,
                relief_m=RELIEF_M,
            )
            found = rows(scene)
            figures += _figures(f"port at {1e3 * port_m:g} mm, tilt {tilt_deg:g} deg", found)
    sys.exit(hand_over(asked, about, Findings(figures=tuple(figures))))


def _figures(where: str, found: Sequence[tuple[str, float, float, float]]) -> list[Figure]:
    """Ours, the first row, next to each of the others."""
    (_, *own), *others = found
    whats = (("rms of points", "mm", 1e3), ("rms of cameras", "mm", 1e3), ("time", "s", 1.0))
    return [
        Figure(
            name=f"{where}: {what}", value=scale * ours, unit=unit, peer=peer,
            peer_value=scale * theirs,
        )
        for peer, *values in others
        for (what, unit, scale), ours, theirs in zip(whats, own, values, strict=True)
    ]  # fmt: skip


def rows(scene: Scene) -> Sequence[tuple[str, float, float, float]]:
    """Method, rms of points and of cameras, metres, and seconds."""
    seen, warps = warped_scene(scene)
    start = near_truth(scene, seen, warps, np.random.default_rng(1))
    found = []
    began = time.monotonic()
    with TemporaryDirectory() as folder:
        ours, _ = refract(start, seen, Path(folder))
    found.append(_row("ours", ours, scene, began))
    began = time.monotonic()
    found.append(_row("warp only", adjust_freely(start), scene, began))
    began = time.monotonic()
    found.append(_row("OPENCV", self_calibrated_opencv(scene), scene, began))
    return found


def self_calibrated_opencv(scene: Scene) -> Mapped:
    """COLMAP's adjustment of the pixels as taken, with OPENCV lenses freed and the true rig."""
    seen, warps = warped_scene(scene)
    rig = scene.rig
    cameras = {
        name: pycolmap.Camera(
            model="OPENCV",
            width=camera.width_px,
            height=camera.height_px,
            params=[
                camera.fx_px * camera.n_water,
                camera.fy_px * camera.n_water,
                camera.cx_px,
                camera.cy_px,
                0.0,
                0.0,
                0.0,
                0.0,
            ],
        )
        for name, camera in rig.cameras.items()
    }
    plain = replace(seen, cameras=cameras, warps={})
    start = near_truth(scene, plain, warps, np.random.default_rng(1))
    model = start.model
    options = held_options(NOISE_PX)
    options.refine_focal_length = options.refine_extra_params = True
    config = all_pictures(model)
    config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    shifted = {
        name: self_calibrated_warp(model.cameras[number]) for number, name in enumerate(cameras, 1)
    }
    return replace(start, warps=shifted)


def _row(name: str, mapped: Mapped, scene: Scene, began: float) -> tuple[str, float, float, float]:
    seconds = time.monotonic() - began
    pupils, true_pupils, points, true_points = pupils_and_points(mapped, scene)
    return name, rigid_rms(points, true_points), rigid_rms(pupils, true_pupils), seconds


def rigid_rms(found: Array, true: Array) -> float:
    """Root mean square distance after rigid alignment."""
    return float(np.sqrt(((align_rigid(found, true).apply(found) - true) ** 2).sum(axis=1).mean()))


if __name__ == "__main__":
    main()
