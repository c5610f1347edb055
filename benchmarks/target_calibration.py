"""Calibrations from a real target: bent, badly printed, with corners whose errors go together.

Nothing here uses the calibration's own model: the board is bent on a circle, sags as a plate and
ripples; OpenCV projects it; corner errors are random waves over every picture, offsets of places on
the board, and noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL, Executor
from benchmarks.figures import Figure, Goal
from camera_calib.calibrate.solve import blank_camera, calibrate
from camera_calib.calibration import Calibration, TargetView
from camera_calib.freedom import Freedom, intrinsics, of_cameras, value
from camera_calib.rig import Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape

Array = NDArray[np.float64]
Projection = Callable[[Array], Array]
"""Points before a camera, (N, 3), to pixels."""

GOAL_OF_SIGMA = (0.8, 1.25)
MAX_GROWTH = 1.3
SIZE = (1600, 1200)
_LENS = {
    "fx_px": 1702.0, "fy_px": 1699.0, "cx_px": 805.0, "cy_px": 593.0,
    "k1": -0.11, "k2": 0.07, "p1": 3e-4, "p2": -4e-4, "k3": -0.01,
}  # fmt: skip
NAMES = tuple(f"camera.{field}" for field in _LENS)
_COLUMNS, _ROWS, _SQUARE_M = 9, 7, 0.03
_VIEWS = 25
_WAVES = 12


@dataclass(frozen=True, kw_only=True)
class Board:
    """What is wrong with a board and its corners."""

    bow_m: float = 0.0
    """Depth of the middle behind the ends, along a random direction."""
    alone_px: float = 0.15
    """Noise of a coordinate that is independent."""
    together_px: float = 0.0
    """Noise of a coordinate that goes together in a picture."""
    reach: float = 0.33
    """How far it goes together, over the diagonal of the board."""
    place_m: float = 0.0
    """Noise of the places of corners on the board, along each axis of its plane."""
    stretch: float = 0.0
    """Its length along x over that along y, minus 1."""


SOUND = Board()
_REAL = Board(together_px=0.12, place_m=2e-5)
TARGETS = {
    "sound": SOUND,
    "correlated": _REAL,
    "correlated, bow 0.25 mm": replace(_REAL, bow_m=2.5e-4),
    "correlated, bow 0.5 mm": replace(_REAL, bow_m=5e-4),
    "correlated far, bow 0.25 mm": replace(_REAL, bow_m=2.5e-4, reach=1.0),
    "correlated near, bow 0.25 mm": replace(_REAL, bow_m=2.5e-4, reach=0.15),
    "stretched 0.1 %": replace(_REAL, bow_m=2.5e-4, stretch=1e-3),
}
"""Boards 240 x 180 mm: what a plate may be, and what photographs of one show."""


def drawn() -> Array:
    """(N, 3) the board as drawn."""
    y, x = np.mgrid[:_ROWS, :_COLUMNS]
    points: Array = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * _SQUARE_M
    return points


def bent(target: Board, rng: np.random.Generator) -> Array:
    """(N, 3) the board as it is: bent on a cylinder, sagging between its edges, misprinted.

    The paper keeps its lengths on the cylinder. Four fifths of the bow are the cylinder's.
    """
    points = drawn()
    middle = points.mean(axis=0)
    flat = (points - middle)[:, :2]
    half_m = np.linalg.norm(flat, axis=1).max()
    out = np.column_stack([flat, np.zeros(len(flat))])
    if target.bow_m:
        sign = rng.choice([-1.0, 1.0])
        angle = rng.uniform(0, np.pi)
        axis = np.array([np.cos(angle), np.sin(angle)])
        along = flat @ axis
        radius_m = half_m**2 / (2.0 * 0.8 * target.bow_m)
        across = flat - along[:, None] * axis
        out[:, :2] = across + (radius_m * np.sin(along / radius_m))[:, None] * axis
        out[:, 2] = sign * radius_m * (1.0 - np.cos(along / radius_m))
        size = np.ptp(flat, axis=0)
        sag = np.cos(np.pi * flat[:, 0] / size[0]) * np.cos(np.pi * flat[:, 1] / size[1])
        out[:, 2] += 0.2 * target.bow_m * rng.choice([-1.0, 1.0]) * sag
    out[:, :2] *= [1.0 + target.stretch / 2.0, 1.0 - target.stretch / 2.0]
    out[:, :2] += rng.normal(0.0, target.place_m or 1e-12, (len(out), 2))
    return np.asarray(out + middle)


def _waves(points: Array, reach: float, rng: np.random.Generator) -> Array:
    """(N, 2) a field of unit variance over the board."""
    reach_m = reach * np.linalg.norm(np.ptp(points, axis=0))
    waves = rng.normal(0.0, 1.0 / reach_m, (_WAVES, 2))
    phase = points[:, :2] @ waves.T
    amplitude = rng.normal(0.0, np.sqrt(1.0 / _WAVES), (2, 2, _WAVES))
    field: Array = (np.cos(phase) @ amplitude[0].T) + (np.sin(phase) @ amplitude[1].T)
    return field


def project(points: Array) -> Array:
    """Pixels of points before the camera."""
    matrix = np.array(
        [
            [_LENS["fx_px"], 0.0, _LENS["cx_px"] - 0.5],
            [0.0, _LENS["fy_px"], _LENS["cy_px"] - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    lens = np.array([_LENS[name] for name in ("k1", "k2", "p1", "p2", "k3")])
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
    return np.asarray(pixels + 0.5)


def views_of(
    target: Board,
    rng: np.random.Generator,
    count: int = _VIEWS,
    projection: Projection = project,
    aside: float = 0.35 * SIZE[0] / _LENS["fx_px"],
) -> list[TargetView]:
    """Views of one board, all of it in the frame, aimed aside by a slope at most."""
    board, plain = bent(target, rng), drawn()
    views: list[TargetView] = []
    while len(views) < count:
        turn = Rotation.from_rotvec(np.deg2rad([*rng.uniform(-35, 35, 2), rng.uniform(-20, 20)]))
        depth_m = rng.uniform(0.35, 1.0)
        aim = np.append(rng.uniform(-aside, aside, 2) * np.array(SIZE) / SIZE[0], 1.0)
        place = depth_m * aim - turn.apply(plain.mean(axis=0))
        pixels = projection(turn.apply(board) + place)
        if not np.all((pixels >= 5) & (pixels <= np.array(SIZE) - 5)):
            continue
        pixels = pixels + rng.normal(0.0, target.alone_px, pixels.shape)
        if target.together_px:
            pixels += target.together_px * _waves(plain, target.reach, rng)
        views.append(TargetView(name=f"{len(views):02d}", pixels={"camera": pixels}))
    return views


def true_rig() -> Rig:
    """One camera in air."""
    camera = blank_camera(SIZE, "opencv5").with_parameters(_LENS)
    return Rig(
        cameras={"camera": camera},
        cam_from_rig={"camera": RigidTransform.identity()},
        body_from_rig=None,
        source="synthetic",
    )


def run_trial(seed: int, target: Board, shape: TargetShape | None = None) -> Calibration:
    """Calibrate once; `shape` as of `calibrate`."""
    views = views_of(target, np.random.default_rng([seed, 17]))
    rig = true_rig()
    freedom = Freedom(free=of_cameras(rig, intrinsics("opencv5")))
    return calibrate(views, drawn(), rig, freedom, shape=shape)


def scores(found: Calibration) -> Array:
    """(P,) errors over their sigmas, of `NAMES`."""
    truth, sigmas = true_rig(), found.rig.sigmas
    return np.array([(value(found.rig, n) - value(truth, n)) / sigmas[n] for n in NAMES])


@dataclass(frozen=True, kw_only=True)
class Trials:
    """Calibrations from boards with the same faults."""

    name: str
    trials: int
    by_sigma: tuple[float, ...]
    """Root mean square of error over sigma, of `NAMES`."""
    sigma_fx_px: float
    sigma_growth: float
    """Sigma of fx over that of a calibration that takes the board as drawn."""
    fx_rms_px: float
    fx_as_drawn_rms_px: float
    """The same of calibrations that take the board as drawn."""

    def figures(self, *, judged: bool) -> list[Figure]:
        """Errors over sigmas, and what unknown shapes cost where the board is sound."""
        low, high = GOAL_OF_SIGMA
        goal = Goal(minimum=low, maximum=high) if judged else None
        ends = (("least", min(self.by_sigma)), ("most", max(self.by_sigma)))
        found = [
            Figure(
                name=f"board {self.name}: error over sigma, rms, {which} of {len(NAMES)}",
                value=end, unit="sigmas", goal=goal,
            )
            for which, end in ends
        ]  # fmt: skip
        if self.name == "sound":
            maximum = Goal(maximum=MAX_GROWTH) if judged else None
            name = "board sound: sigma of fx over that of a board known as flat"
            found.append(Figure(name=name, value=self.sigma_growth, unit="1", goal=maximum))
        return found


def _row(seed: int, target: Board) -> tuple[Array, Array]:
    """Scores of one trial; fx's sigma, error, and both with the board as drawn."""
    rows = [run_trial(seed, target, shape) for shape in (None, AS_DRAWN)]
    numbers = [(c.rig.sigmas[NAMES[0]], value(c.rig, NAMES[0]) - _LENS["fx_px"]) for c in rows]
    return scores(rows[0]), np.ravel(numbers)


def run_case(name: str, seeds: Sequence[int], executor: Executor = SERIAL) -> Trials:
    """All trials of one of `TARGETS`."""
    work = partial(_row, target=TARGETS[name])
    rows = list(executor.map(work, seeds, label=f"calibrations, board {name}"))
    by_sigma = np.sqrt(np.mean([row[0] ** 2 for row in rows], axis=0))
    sigma, error, sigma_drawn, error_drawn = np.array([row[1] for row in rows]).T
    return Trials(
        name=name,
        trials=len(rows),
        by_sigma=tuple(by_sigma.tolist()),
        sigma_fx_px=float(sigma.mean()),
        sigma_growth=float((sigma / sigma_drawn).mean()),
        fx_rms_px=float(np.sqrt(np.mean(error**2))),
        fx_as_drawn_rms_px=float(np.sqrt(np.mean(error_drawn**2))),
    )
