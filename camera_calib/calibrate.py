"""Calibrate the stereo rig through its ports from pictures of a chessboard under water.

One least-squares problem over all views of both cameras: intrinsics, lens distortion, the distance
of each port, the pose of the right camera and the pose of the board in every view. Thickness and
index of the glass, index of the water and the port's normal are taken as known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.artefacts import Stage, need_stage, read_json, run_stage, write_json
from alice_survey.config import CameraConfig, SurveyConfig
from alice_survey.errors import CalibrationError, warn
from alice_survey.executor import parallel_map
from alice_survey.frames import Array
from alice_survey.manifest import read_manifest
from camera_calib.corners import find_chessboard
from camera_calib.flat_port import FlatPortCamera
from camera_calib.rig import Covariance, Rig, design_rig, write_rig

_FREE = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "port_distance_m")
_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-7, 1e-7, 1e-6, 1e-6])
_SCALES = np.array([10.0, 10.0, 10.0, 10.0, 0.1, 0.1, 0.01, 0.01, 0.1, 0.01])
_POSE_STEP, _POSE_SCALE = 1e-7, 0.1
_FEWEST_VIEWS = 6
_NEAREST_PORT_M = 1e-5
"""Above the step of its derivative, so that the glass never passes the pupil."""


@dataclass(frozen=True, kw_only=True)
class Board:
    """A chessboard."""

    columns: int
    rows: int
    """Inner corners along x and along y."""
    square_m: float

    @property
    def points(self) -> Array:
        """(rows * columns, 3) corners in the board's frame, row by row, z = 0."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * self.square_m


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoView:
    """The corners that both cameras see in one view of the board."""

    name: str
    left: Array
    """(C, 2) pixels; a row is NaN where a corner was not found."""
    right: Array
    """(C, 2)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A calibrated rig and how well it fits."""

    rig: Rig
    residuals_px: Array
    """(views, 2 cameras, corners, 2)."""
    correlation: Array
    """(20, 20) correlation of the parameters of left then right, in the order of `parameters`."""
    parameters: tuple[str, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals."""
        return float(np.sqrt(np.nanmean((self.residuals_px**2).sum(axis=-1))))


def calibrate(views: Sequence[StereoView], board: Board, start: Rig) -> Calibration:
    """Adjust the rig and all board poses together, with a robust (soft L1) loss.

    Args:
        views: what both cameras saw.
        board: the board.
        start: a rig near the truth, such as the design; what is not adjusted is taken from it.

    Raises:
        CalibrationError: too few views, or the solution leaves the range of a real camera.
    """
    if len(views) < _FEWEST_VIEWS:
        raise CalibrationError(
            f"{len(views)} views with the whole board in both pictures; at least {_FEWEST_VIEWS} "
            "are needed: take more, nearer and at more angles"
        )
    problem = _Problem(views, board, start)
    x = problem.start
    for adjusted, loss_px, tolerance in ((problem.poses, 20.0, 1e-3), (slice(None), 0.5, 1e-11)):
        x = problem.adjust(x, adjusted, loss_px, tolerance)
    return problem.solution(x)


class _Problem:
    """Residuals of all views as a function of one vector: cameras, rig, board poses."""

    def __init__(self, views: Sequence[StereoView], board: Board, start: Rig) -> None:
        self.rig, self.names, self.points = start, tuple(start.cameras), board.points
        self.pixels = np.stack([[v.left, v.right] for v in views])
        self.observed: NDArray[np.bool_] = np.asarray(np.isfinite(self.pixels).all(axis=-1))
        right = start.cam_from_rig[self.names[1]]
        boards = [_locate(self.points, v.left, start.cameras[self.names[0]], v.name) for v in views]
        cameras = [[getattr(start.cameras[n], f) for f in _FREE] for n in self.names]
        poses = [_vector(right), *(_vector(pose) for pose in boards)]
        self.start = np.concatenate([*cameras, *poses])
        rest = np.full(6 * len(poses), _POSE_SCALE)
        self.scales = np.concatenate([_SCALES, _SCALES, rest])
        self.steps = np.concatenate([_STEPS, _STEPS, np.full(6 * len(poses), _POSE_STEP)])
        self.fixed = 2 * len(_FREE) + 6
        self.poses = slice(2 * len(_FREE), None)
        free = np.full(6 * len(poses), np.inf)
        f, w, h = start.cameras[self.names[0]].fx_px, self.pixels[..., 0], self.pixels[..., 1]
        low = [f / 2, f / 2, 0.0, 0.0, -2.0, -2.0, -0.5, -0.5, -2.0, _NEAREST_PORT_M]
        high = [2 * f, 2 * f, np.nanmax(w), np.nanmax(h), 2.0, 2.0, 0.5, 0.5, 2.0, 0.5]
        self.low = np.concatenate([low, low, -free])
        self.high = np.concatenate([high, high, free])
        self.start = np.clip(self.start, self.low + 1e-9, self.high - 1e-9)

    def adjust(self, x: Array, adjusted: slice, loss_px: float, tolerance: float) -> Array:
        """Adjust a part of the parameters to the least robust loss, from x.

        Raises:
            CalibrationError: no convergence, or a parameter ran to the bound of what is real.
        """

        def whole(part: Array) -> Array:
            moved = x.copy()
            moved[adjusted] = part
            return moved

        def slopes(part: Array) -> Array:
            return self.jacobian(whole(part))[:, adjusted]

        def misses(part: Array) -> Array:
            return self.residuals(whole(part))

        result = least_squares(
            misses,
            x[adjusted],
            jac=slopes,
            bounds=(self.low[adjusted], self.high[adjusted]),
            loss="soft_l1",
            f_scale=loss_px,
            x_scale=self.scales[adjusted],
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
            max_nfev=200,
        )
        if not result.success:
            raise CalibrationError(f"the adjustment did not converge: {result.message}")
        return whole(result.x)

    def cameras(self, x: Array) -> tuple[FlatPortCamera, FlatPortCamera, RigidTransform]:
        """Both cameras and `right_from_left`."""
        count = len(_FREE)
        models = []
        for i, name in enumerate(self.names):
            values: dict[str, Any] = dict(zip(_FREE, map(float, x[i * count :]), strict=False))
            models.append(replace(self.rig.cameras[name], **values))
        return models[0], models[1], _pose(x[2 * count : self.fixed])

    def predict(self, x: Array) -> Array:
        """Pixels, (views, 2, corners, 2)."""
        left, right, right_from_left = self.cameras(x)
        poses = x[self.fixed :].reshape(-1, 6)
        rotations = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        in_left = np.einsum("vij,cj->vci", rotations, self.points) + poses[:, None, 3:]
        in_right = right_from_left.apply(in_left.reshape(-1, 3)).reshape(in_left.shape)
        return np.stack([left.project(in_left), right.project(in_right)], axis=1)

    def residuals(self, x: Array) -> Array:
        """Misses in x and y, view by view; 0 where no corner was found."""
        misses = np.where(self.observed[..., None], self.predict(x) - self.pixels, 0.0)
        return misses.ravel()

    def jacobian(self, x: Array) -> Array:
        """Central differences; a board's pose moves its own view only."""

        def slope(step: Array) -> Array:
            change = self.predict(x + step) - self.predict(x - step)
            seen: Array = np.where(self.observed[..., None], change, 0.0)
            return seen / (2 * float(step.max()))

        views = len(self.pixels)
        jacobian = np.zeros((views, self.pixels[0].size, x.size))
        for i in range(self.fixed):
            step = np.zeros_like(x)
            step[i] = self.steps[i]
            jacobian[:, :, i] = slope(step).reshape(views, -1)
        each = np.arange(views)
        for i in range(self.fixed, self.fixed + 6):
            step = np.zeros_like(x)
            step[i::6] = self.steps[i]
            jacobian[each, :, i + 6 * each] = slope(step).reshape(views, -1)
        flat: Array = jacobian.reshape(-1, x.size)
        return flat

    def solution(self, x: Array) -> Calibration:
        """The calibrated rig, with the covariance at the solution."""
        covariance = _covariance(self.jacobian(x), self.residuals(x), self.observed)
        left, right, right_from_left = self.cameras(x)
        sigma = np.sqrt(np.diag(covariance))
        cameras = tuple(f"{name}.{field}" for name in self.names for field in _FREE)
        pose = [f"{self.names[1]}.{p}" for p in ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m")]
        names = (*cameras, *pose)
        rig = replace(
            self.rig,
            cameras={self.names[0]: left, self.names[1]: right},
            cam_from_rig={
                self.names[0]: RigidTransform.identity(),
                self.names[1]: right_from_left,
            },
            source=f"calibration through the ports from {len(self.pixels)} stereo views of a board",
            covariance=Covariance(parameters=names, matrix=covariance),
        )
        misses = np.where(self.observed[..., None], self.predict(x) - self.pixels, np.nan)
        correlation = covariance / np.outer(sigma, sigma)
        return Calibration(rig=rig, residuals_px=misses, correlation=correlation, parameters=names)


def _covariance(jacobian: Array, residuals: Array, observed: NDArray[np.bool_]) -> Array:
    """Covariance of cameras and rig with the board poses marginalised, scaled to the residuals."""
    fixed = 2 * len(_FREE) + 6
    normal = jacobian.T @ jacobian
    cc, cb, bb = normal[:fixed, :fixed], normal[:fixed, fixed:], normal[fixed:, fixed:]
    schur = cc - cb @ np.linalg.solve(bb, cb.T)
    freedom = 2 * int(observed.sum()) - jacobian.shape[1]
    variance = float(residuals @ residuals) / freedom
    scale = 1.0 / np.sqrt(np.diag(schur))
    covariance: Array = variance * np.linalg.inv(schur * np.outer(scale, scale))
    return covariance * np.outer(scale, scale)


def _locate(points: Array, pixels: Array, camera: FlatPortCamera, name: str) -> RigidTransform:
    """A first pose of the board, `cam_from_board`, taking the camera for a pinhole in water."""
    focal = camera.n_water * np.array([camera.fx_px, camera.fy_px])
    matrix = np.diag([*focal, 1.0])
    matrix[:2, 2] = camera.cx_px, camera.cy_px
    seen = np.isfinite(pixels).all(axis=1)
    found, rotation, translation = cv2.solvePnP(
        points[seen], pixels[seen], matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found:
        raise CalibrationError(f"view {name}: the board's pose cannot be found")
    return RigidTransform.from_components(
        translation.ravel(), Rotation.from_rotvec(rotation.ravel())
    )


def _vector(pose: RigidTransform) -> Array:
    return np.concatenate([pose.rotation.as_rotvec(), pose.translation])


def _pose(vector: Array) -> RigidTransform:
    return RigidTransform.from_components(vector[3:], Rotation.from_rotvec(vector[:3]))


def run_calibrate(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Calibrate the rig from `pool/` and write `calibration/`.

    Returns:
        True when done, False when nothing had changed.

    Raises:
        CalibrationError: too few usable views.
    """
    pool = need_stage(workspace, "pool", "image")
    stage = Stage(
        name="calibration",
        version=2,
        settings={
            "camera": config.camera.model_dump(mode="json"),
            "water": config.water.model_dump(mode="json"),
        },
        inputs=[pool / "manifest.csv", pool / "board.json", pool / "left", pool / "right"],
    )

    def work(folder: Path) -> None:
        board = Board(**read_json(pool / "board.json"))
        start = design_rig(config.camera, config.water, _scale(pool, config.camera))
        calibration = calibrate(read_views(pool, board, threads), board, start)
        write_rig(folder / "rig.json", calibration.rig)
        write_json(folder / "calibration.json", _summary(calibration))

    return run_stage(workspace, stage, work)


def _scale(pool: Path, camera: CameraConfig) -> int:
    """How many times larger than designed the pixels of a pool's pictures are."""
    first = pool / read_manifest(pool / "manifest.csv")[0].image
    picture = cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CalibrationError(f"{first} cannot be decoded")
    height, width = map(int, picture.shape)
    scale = round(camera.width_px / width)
    if (camera.width_px // scale, camera.height_px // scale) != (width, height):
        raise CalibrationError(
            f"{first} has {width} x {height} px, which is no whole fraction of the camera's "
            f"{camera.width_px} x {camera.height_px}: set [camera] width_px and height_px"
        )
    return scale


def read_views(pool: Path, board: Board, threads: int) -> list[StereoView]:
    """Find the board in all pictures of a pool; views that lack it are named and left out."""
    records = read_manifest(pool / "manifest.csv")
    jobs = [(pool / record.image, board) for record in records]
    corners = dict(
        zip(
            ((r.station, r.camera) for r in records),
            parallel_map(_corners_of, jobs, threads=threads, label="board corners"),
            strict=True,
        )
    )
    views = []
    for station in sorted({record.station for record in records}):
        left, right = corners.get((station, "left")), corners.get((station, "right"))
        if left is None or right is None:
            warn(f"view {station}: the whole board was not found in both pictures; left out")
            continue
        views.append(StereoView(name=str(station), left=left, right=right))
    return views


def _corners_of(job: tuple[Path, Board]) -> Array | None:
    path, board = job
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        warn(f"{path} cannot be decoded; left out")
        return None
    return find_chessboard(picture, board.columns, board.rows)


def _summary(calibration: Calibration) -> dict[str, object]:
    lengths = np.sqrt((calibration.residuals_px**2).sum(axis=-1))
    return {
        "rms_px": round(calibration.rms_px, 6),
        "worst_px": round(float(np.nanmax(lengths)), 6),
        "views": len(lengths),
        "rms_px_by_view": [round(float(np.sqrt(np.nanmean(v**2))), 6) for v in lengths],
        "parameters": list(calibration.parameters),
        "correlation": np.round(calibration.correlation, 6).tolist(),
    }
