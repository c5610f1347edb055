"""What adjusting and placing cost by the size of a survey: synthetic tracks, no pictures.

    python -m benchmarks.block_size --work FOLDER [--stations 500 1000 2000 5000 10000]
        [--points 30] [--quick] [--json FILE]

A calibrated stereo rig flies a lawnmower pattern over a rough plane, and every station adds so many
points. A row has seconds of computing: of one factor of the stations' matrix with a solution, of
the last adjustment, of the covariances of stations and of points, of the soft
modes, of the placement by navigation; and the peak of memory so far. Last come the exponents of
these between the smallest and the largest survey. FOLDER keeps the calibration.
"""

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import minimise
from alice_survey.core.frames import Array, Datum, attitude_from_rotation
from alice_survey.core.manifest import ImageRecord
from benchmarks.bend_survey import NOISE_PX, calibrated_rig
from benchmarks.figures import Figure, Findings, Goal, add_options, hand_over
from benchmarks.machine import heading, machine
from camera_calib.freedom import Prior
from camera_calib.rig import Rig
from reconstruct.adjustment.exact_observations import (
    Pixels,
    RigState,
    calibrated_parameters,
)
from reconstruct.adjustment.normal_equations import Gauge
from reconstruct.adjustment.soft_modes import soft_modes
from reconstruct.adjustment.survey_fit import SurveyProblem
from reconstruct.placing.alignment import level
from reconstruct.placing.fit import fit_navigation

ALTITUDE_M, _STEP_M, _LINES_M, _DEPTH_M, _SPEED_MPS = 2.0, 0.4, 0.8, 10.0, 0.2
_MATCHED = 0.5
"""Share of the pictures that show a point in which it is matched."""
_PLACE_M, _TURN_RAD = 0.002, 0.0005
"""How far off the start is."""
DATUM = Datum(32.8236, 34.9553)
PARTS = ("factor", "adjustment", "stations", "points", "modes", "navigation")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """A survey of synthetic tracks."""

    truth: RigState
    pixels: Pixels


def block(rig: Rig, stations: int, points: int) -> Block:
    """Fly a rig, whose reference camera comes first, over a rough plane.

    Args:
        rig: cameras.
        stations: how many.
        points: on the sea floor, of each station.
    """
    rng = np.random.default_rng(stations)
    names = list(rig.cameras)
    reference = rig.cam_from_rig[names[0]]
    rig = replace(
        rig, cam_from_rig={n: pose * reference.inv() for n, pose in rig.cam_from_rig.items()}
    )
    long = int(np.sqrt(2.0 * stations))
    line, along = np.divmod(np.arange(stations), long)
    odd = line % 2 == 1
    north = _STEP_M * np.where(odd, long - 1 - along, along)
    centres = np.column_stack([north, _LINES_M * line, np.full(stations, _DEPTH_M)])
    leaning = Rotation.from_euler("ZYX", rng.normal(0, 0.03, (stations, 3)))
    ahead = Rotation.from_rotvec(np.pi * odd[:, None] * [0.0, 0.0, 1.0])
    turns = (ahead * leaning * rig.body_from_cam(names[0]).rotation).as_matrix()
    low, high = centres.min(axis=0)[:2] - 1.0, centres.max(axis=0)[:2] + 1.0
    ground = rng.uniform(low, high, (points * stations, 2))
    down = _DEPTH_M + ALTITUDE_M + 0.1 * np.sin(3.0 * ground).sum(axis=1)
    floor = np.column_stack([ground, down])
    near = cKDTree(ground).query_ball_point(centres[:, :2], 0.8 * ALTITUDE_M)
    station = np.repeat(np.arange(stations), [len(row) for row in near])
    point = np.concatenate([np.array(row, dtype=np.int64) for row in near])
    arm = np.einsum("nij,ni->nj", turns[station], floor[point] - centres[station])
    rows = []
    for c, name in enumerate(names):
        camera = rig.cameras[name]
        at = camera.project(rig.cam_from_rig[name].apply(arm))
        inside = np.all((at > 1) & (at < [camera.width_px - 1, camera.height_px - 1]), axis=1)
        seen = np.flatnonzero(inside & (rng.uniform(size=len(at)) < _MATCHED))
        rows.append((point[seen], station[seen], np.full(len(seen), c), at[seen]))
    point, station, camera_of, taken = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    enough = np.bincount(point, minlength=len(floor)) > 2
    order = np.flatnonzero(enough[point])
    order = order[np.argsort(point[order], kind="stable")]
    kept, inverse, counts = np.unique(point[order], return_inverse=True, return_counts=True)
    return Block(
        truth=RigState(rig=rig, turns=turns, centres=centres, points=floor[kept]),
        pixels=Pixels(
            starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            station=station[order],
            camera=camera_of[order],
            taken=taken[order] + rng.normal(0, NOISE_PX, (len(order), 2)),
            point=inverse.astype(np.int64),
        ),
    )


def near_start(truth: RigState) -> RigState:
    """A state a little off the truth."""
    rng, count = np.random.default_rng(1), len(truth.centres)
    off = Rotation.from_rotvec(rng.normal(0, _TURN_RAD, (count, 3))).as_matrix()
    return replace(
        truth,
        turns=off @ truth.turns,
        centres=truth.centres + rng.normal(0, _PLACE_M, (count, 3)),
        points=truth.points + rng.normal(0, _PLACE_M, truth.points.shape),
    )


def seconds(rig: Rig, of: Block) -> dict[str, float]:
    """Seconds of computing of every part."""
    spent: dict[str, float] = {}

    def timed(part: str, what: Callable[[], Result]) -> Result:
        began = time.process_time()
        found = what()
        spent[part] = time.process_time() - began
        return found

    truth, names = of.truth, list(rig.cameras)
    start, count = near_start(truth), len(truth.centres)
    problem = SurveyProblem(of.pixels, start, Prior.of_rig(rig, calibrated_parameters(rig, names)))
    found = timed(
        "adjustment", lambda: minimise(problem, problem.start, settled=0.05, max_steps=20)
    )
    if not found.is_settled:
        raise RuntimeError(f"{count} stations: the adjustment did not settle")
    state = found.guess.state
    equations = problem.reduced(found.guess, found.noise, ())
    gauge = Gauge(state.centres, ALTITUDE_M, False)
    equations = replace(equations, free=~gauge.held)
    timed("factor", lambda: equations.factor().solve(gauge.weighed[..., :1]))
    blocks = timed("stations", lambda: gauge.shape_blocks(equations))
    timed("points", lambda: equations.point_covariances(blocks))
    one = np.zeros(len(state.points), np.int64)
    modes = timed("modes", lambda: soft_modes(equations, gauge, None, state.points, one))
    poses = RigidTransform.from_components(state.centres, Rotation.from_matrix(state.turns))
    timed(
        "navigation",
        lambda: fit_navigation(
            records_of(rig, truth),
            list(poses),
            {names[0]: rig.body_from_cam(names[0])},
            DATUM,
            level(state.points, state.centres),
            known_scale=1.0,
            modes=modes.stations[:, [3, 4, 5, 0, 1, 2]],
        ),
    )
    return spent


def records_of(rig: Rig, truth: RigState) -> list[ImageRecord]:
    """A log with a constant and a white error of depth and white errors of the rest."""
    name, rng = next(iter(rig.cameras)), np.random.default_rng(2)
    poses = RigidTransform.from_components(truth.centres, Rotation.from_matrix(truth.turns))
    bodies = poses * rig.body_from_cam(name).inv()
    ned = bodies.translation + rng.normal(0, [0.03, 0.03, 0.002], (len(poses), 3)) + [0, 0, 0.05]
    places = DATUM.geodetic_from_ned(ned)
    angles = np.rad2deg(attitude_from_rotation(bodies.rotation))
    angles = angles + rng.normal(0, 0.02, angles.shape)
    return [
        ImageRecord(
            image=f"{name}/{i:06d}.png", camera=name, station=i,
            time_s=i * _STEP_M / _SPEED_MPS, latitude_deg=float(place[0]),
            longitude_deg=float(place[1]), depth_m=float(place[2]), roll_deg=float(angle[0]),
            pitch_deg=float(angle[1]), heading_deg=float(angle[2] % 360.0),
            altitude_m=ALTITUDE_M, sigma_horizontal_m=0.03, sigma_depth_m=0.05,
            sigma_attitude_deg=0.02, sigma_heading_deg=0.02,
        )
        for i, (place, angle) in enumerate(zip(places, angles, strict=True))
    ]  # fmt: skip


def main() -> None:
    """Print the table."""
    options = _options()
    about = machine(("numpy", "scipy"))
    print(f"{heading(about)}\n", flush=True)
    options.work.mkdir(parents=True, exist_ok=True)
    rig = calibrated_rig(options.work, "demo" if options.quick else "caesarea", 4, 8)
    print(f"{'stations':>8}{'observations':>14}" + "".join(f"{p:>12}" for p in PARTS) + "  s; GB")
    figures: list[Figure] = []
    rows: list[Array] = []
    for count in options.stations:
        made = block(rig, count, options.points)
        spent = seconds(rig, made)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        rows.append(np.array([spent[part] for part in PARTS]))
        cells = "".join(f"{spent[part]:12.2f}" for part in PARTS)
        print(f"{count:>8}{len(made.pixels.station):>14}{cells}  {peak:.2f}", flush=True)
        name = f"{count} stations"
        figures += [Figure(name=f"{name}: {p}", value=spent[p], unit="s") for p in PARTS]
        figures.append(Figure(name=f"{name}: peak of memory", value=peak, unit="GiB"))
    if len(rows) > 1:
        wide = np.log(options.stations[-1] / options.stations[0])
        powers = np.log(rows[-1] / rows[0]) / wide
        print(f"{'exponent':>22}" + "".join(f"{power:12.2f}" for power in powers))
        figures += [
            Figure(name=f"exponent of {p}", value=float(power), unit="")
            for p, power in zip(PARTS, powers, strict=True)
        ]
        whole = float(np.log(rows[-1].sum() / rows[0].sum()) / wide)
        print(f"exponent of all {whole:.2f}")
        figures.append(Figure(name="exponent of all", value=whole, unit="", goal=Goal(maximum=1.3)))
    factor, covariance = rows[-1][0], rows[-1][2]
    figures.append(
        Figure(
            name="covariance of stations over one factor",
            value=float(covariance / factor), unit="", goal=Goal(maximum=20.0),
        )
    )  # fmt: skip
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures))))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="keeps the calibration")
    parser.add_argument(
        "--stations", type=int, nargs="+", default=[500, 1000, 2000, 5000, 10000], metavar="N"
    )
    parser.add_argument("--points", type=int, default=30, help="of each station")
    add_options(parser, quick="200 stations of the demo's rig")
    options = parser.parse_args()
    if options.quick:
        options.stations = [200]
    return options


if __name__ == "__main__":
    main()
