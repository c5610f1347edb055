"""Several fixed cameras at one tank: their joint uncertainty, and their poses from what they see.

What is uncertain is one vector: the free parameters of each lens, then a small motion of each
camera (`FixedCamera.moved`). Poses come from the reference points, and on request from the detected
points as well: wherever two rays in water miss each other, they tell of the poses. Each point is
eliminated (Schur complement), and points that fit badly weigh less (Cauchy's weights).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib.flat_port import PARAMETERS
from camera_calib.freedom import PORT, POSE
from camera_calib.rig import Covariance, Rig
from camera_calib.tank.interface import FixedCamera, Reference, check_sides, place_camera
from camera_calib.tank.single_lens import KnownLens
from camera_calib.triangulate import Triangulation, triangulate

CAUCHY = 2.385
"""Tuning of Cauchy's weights: 95 % of the efficiency of least squares for normal errors."""
_ROUNDS = 60
_SETTLED_PX = 1e-6
_CHUNK = 20_000
_FEWEST_POINTS = 50
_STEP = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Tank:
    """Fixed cameras that look into one body of water."""

    cameras: tuple[FixedCamera, ...]
    lenses: tuple[KnownLens, ...]
    """One for each camera; cameras may share one."""
    reference_sigma_px: float
    """Standard deviation of one coordinate of a reference point in a picture."""
    covariance: Array
    """(U, U) of the free parameters of each lens, then of the motion of each camera."""

    @cached_property
    def distinct_lenses(self) -> tuple[KnownLens, ...]:
        """The lenses, each once."""
        return tuple({id(lens): lens for lens in self.lenses}.values())

    @property
    def uncertain(self) -> int:
        """How many uncertain values there are, U."""
        return sum(len(lens.free) for lens in self.distinct_lenses) + 6 * len(self.cameras)

    @property
    def motions(self) -> slice:
        """Where the motions of the cameras stand among the uncertain values."""
        return slice(self.uncertain - 6 * len(self.cameras), self.uncertain)

    def lens_block(self, camera: int) -> tuple[slice, list[int]]:
        """Where a camera's lens stands, and the columns of its parameters in `PARAMETERS`."""
        start = 0
        for lens in self.distinct_lenses:
            if lens is self.lenses[camera]:
                break
            start += len(lens.free)
        free = self.lenses[camera].free
        return slice(start, start + len(free)), [PARAMETERS.index(name) for name in free]

    def motion_block(self, camera: int) -> slice:
        """Where a camera's motion stands."""
        start = self.motions.start + 6 * camera
        return slice(start, start + 6)

    def triangulate(self, pixels: Array, sigma_px: float = 1.0) -> Triangulation:
        """Points, in the world, of pixels (C, N, 2)."""
        return triangulate(
            [camera.camera for camera in self.cameras],
            [camera.cam_from_world for camera in self.cameras],
            pixels,
            sigma_px,
        )


def place_cameras(
    lenses: Sequence[KnownLens],
    references: Sequence[Reference],
    *,
    n_water: float,
    glass_thickness_m: Sequence[float] | None = None,
    n_glass: float = 1.52,
    reference_sigma_px: float | None = None,
) -> Tank:
    """Pose all cameras from the points of their interfaces.

    Args:
        lenses: one for each camera.
        references: one for each camera.
        n_water: index of the water.
        glass_thickness_m: wall before each camera; none when not given.
        n_glass: index of the walls.
        reference_sigma_px: of one coordinate of a reference point; from the residuals of all
            cameras when not given.

    Raises:
        CalibrationError: a camera cannot be placed, or their interfaces do not fit together.
    """
    walls = glass_thickness_m or [0.0] * len(references)
    cameras = tuple(
        place_camera(
            lens.camera, reference, n_water=n_water, glass_thickness_m=wall, n_glass=n_glass
        )
        for lens, reference, wall in zip(lenses, references, walls, strict=True)
    )
    check_sides(cameras)
    if reference_sigma_px is None:
        squares = sum(float((camera.reference_residuals_px**2).sum()) for camera in cameras)
        freedom = sum(camera.reference_residuals_px.size - 6 for camera in cameras)
        reference_sigma_px = float(np.sqrt(squares / freedom))
    tank = Tank(
        cameras=cameras,
        lenses=tuple(lenses),
        reference_sigma_px=reference_sigma_px,
        covariance=np.zeros((0, 0)),
    )
    return replace(tank, covariance=_joint_covariance(tank, _reference_equations(tank)[0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Poses adjusted to the detections."""

    tank: Tank
    sigma_px: float
    """Robust standard deviation of one coordinate of a detection, after the adjustment."""
    rounds: int


def refine(tank: Tank, pixels: Array) -> Refinement:
    """Adjust the poses of all cameras to detections and reference points together.

    Reference points weigh by their sigma, detections by a robust one of their own. Detections of
    slow things are correlated in time, so that the covariance that comes out is too small by about
    the root of how many pictures say the same.

    Args:
        tank: where the cameras stand by their reference points alone.
        pixels: (C, N, 2) detections; NaN where unseen.

    Raises:
        CalibrationError: too few points, or no convergence.
    """
    sigma_px = noise_px(tank.triangulate(pixels))
    for count in range(1, _ROUNDS + 1):
        found = tank.triangulate(pixels)
        usable = int(np.isfinite(found.points_world).all(axis=1).sum())
        if usable < _FEWEST_POINTS:
            raise CalibrationError(
                f"{usable} detections give a point in the water; at least {_FEWEST_POINTS} are "
                "needed to refine the poses: use --no-refine"
            )
        if count <= _ROUNDS // 2:  # then the scale is held, so that the search can settle
            sigma_px = noise_px(found)
        normal, gradient = _reference_equations(tank)
        for part in _parts(found):
            _, _, reduced, residuals = _eliminated(tank, part)
            freedom = np.maximum(2 * (residuals != 0).any(axis=-1).sum(axis=1) - 3, 1)
            miss2 = (residuals**2).sum(axis=(1, 2)) / freedom
            weights = 1.0 / (1.0 + miss2 / (CAUCHY * sigma_px) ** 2) / sigma_px**2
            weighted = reduced * weights[:, None, None, None]
            flat = reduced.reshape(-1, tank.uncertain)
            normal += weighted.reshape(-1, tank.uncertain).T @ flat
            gradient += weighted.reshape(-1, tank.uncertain).T @ residuals.ravel()
        inside = normal[tank.motions, tank.motions]
        step = np.asarray(-np.linalg.solve(inside, gradient[tank.motions]), dtype=np.float64)
        moved = tuple(
            camera.moved(step[6 * i : 6 * i + 6]) for i, camera in enumerate(tank.cameras)
        )
        tank = replace(tank, cameras=moved)
        # How far the step moves anything, in standard deviations of what was measured.
        if float(np.sqrt(step @ inside @ step)) * sigma_px < _SETTLED_PX:
            check_sides(tank.cameras)
            covariance = _joint_covariance(tank, normal)
            return Refinement(
                tank=replace(tank, covariance=covariance), sigma_px=sigma_px, rounds=count
            )
    raise CalibrationError(
        f"the refinement of the poses did not settle in {_ROUNDS} rounds: use --no-refine, or "
        "check that detections of all cameras are of the same moments"
    )


def noise_px(found: Triangulation) -> float:
    """Robust standard deviation of one coordinate of a pixel, from how well rays meet.

    Two cameras leave one residual a point, so that this sees the part of the noise, and of wrong
    poses and clocks, that keeps rays from meeting.

    Raises:
        CalibrationError: no point was found.
    """
    squares = np.nansum(found.residuals_px**2, axis=(0, 2))
    freedom = 2 * np.isfinite(found.residuals_px[..., 0]).sum(axis=0) - 3
    usable = np.isfinite(found.points_world).all(axis=1) & (freedom > 0)
    if not usable.any():
        raise CalibrationError("no detection gives a point in the water: check the cameras' order")
    typical = squares[usable] / chi2.ppf(0.5, freedom[usable])
    return float(np.sqrt(np.median(typical)))


def point_covariance(tank: Tank, found: Triangulation) -> Array:
    """Covariance of points, (N, 3, 3), m^2, from their pixels and from the cameras together.

    Args:
        tank: where the cameras stand, and how well that is known.
        found: its points, triangulated with the pixels' sigma.
    """
    whole = np.array(found.covariance)
    done = 0
    for part in _parts(found):
        _, by_uncertain, _, _ = _eliminated(tank, part)
        spread = by_uncertain @ tank.covariance @ by_uncertain.transpose(0, 2, 1)
        whole[done : done + len(spread)] += spread
        done += len(spread)
    return whole


def tank_rig(tank: Tank, source: str) -> Rig:
    """The cameras as a rig: the first is its reference, and the world takes the body's place.

    `body_from_rig` is the first camera's pose in the world of the reference points.
    """
    first = tank.cameras[0].cam_from_world
    return Rig(
        cameras={camera.name: camera.camera for camera in tank.cameras},
        cam_from_rig={c.name: c.cam_from_world * first.inv() for c in tank.cameras},
        body_from_rig=first.inv(),
        source=source,
        covariance=_rig_covariance(tank),
    )


def _reference_equations(tank: Tank) -> tuple[Array, Array]:
    """Normal matrix, (U, U), and gradient, (U,), of the reference points, in sigmas."""
    normal = np.zeros((tank.uncertain, tank.uncertain))
    gradient = np.zeros(tank.uncertain)
    for i, camera in enumerate(tank.cameras):
        by_motion, by_lens = camera.reference_slopes()
        block, columns = tank.lens_block(i)
        slopes = np.zeros((len(by_motion), tank.uncertain))
        slopes[:, block] = by_lens[:, columns]
        slopes[:, tank.motion_block(i)] = by_motion
        normal += slopes.T @ slopes / tank.reference_sigma_px**2
        gradient += slopes.T @ camera.reference_residuals_px.ravel() / tank.reference_sigma_px**2
    return normal, gradient


def _joint_covariance(tank: Tank, normal: Array) -> Array:
    """Covariance of lenses and motions when the motions were adjusted and the lenses held.

    The lenses' own covariance stays what it was; an error of a lens moves the poses with it.
    """
    motions, lenses = tank.motions, slice(0, tank.motions.start)
    covariance = np.zeros_like(normal)
    start = 0
    for lens in tank.distinct_lenses:
        block = slice(start, start + len(lens.free))
        covariance[block, block] = lens.covariance
        start = block.stop
    inverse = np.linalg.inv(normal[motions, motions])
    follows = -inverse @ normal[motions, lenses]
    covariance[motions, lenses] = follows @ covariance[lenses, lenses]
    covariance[lenses, motions] = covariance[motions, lenses].T
    covariance[motions, motions] = inverse + follows @ covariance[lenses, motions]
    return covariance


@dataclass(frozen=True, eq=False)
class _Part:
    points: Array
    residuals: Array
    """(C, n, 2)."""


def _parts(found: Triangulation) -> list[_Part]:
    """Some thousand points at a time, so that memory stays bounded."""
    return [
        _Part(
            found.points_world[start : start + _CHUNK],
            found.residuals_px[:, start : start + _CHUNK],
        )
        for start in range(0, len(found.points_world), _CHUNK)
    ]


def _eliminated(tank: Tank, part: _Part) -> tuple[Array, Array, Array, Array]:
    """Eliminate each point from its own equations.

    Returns:
        The inverse normal matrix of each point, (n, 3, 3); the slopes of the point by the uncertain
        values, (n, 3, U); those of its residuals when the point follows, (n, C, 2, U), and the
        residuals, (n, C, 2), both 0 where a camera does not see the point. The first two are NaN
        for a point without a solution.
    """
    count = len(part.points)
    by_point = np.zeros((count, len(tank.cameras), 2, 3))
    by_uncertain = np.zeros((count, len(tank.cameras), 2, tank.uncertain))
    residuals = part.residuals.transpose(1, 0, 2)
    seen = np.isfinite(residuals[..., 0])
    for i, camera in enumerate(tank.cameras):
        rows = seen[:, i]
        by_world, by_motion, by_parameter = camera.slopes(part.points[rows])
        block, columns = tank.lens_block(i)
        by_point[rows, i] = by_world
        by_uncertain[rows, i, :, block] = by_parameter[..., columns]
        by_uncertain[rows, i, :, tank.motion_block(i)] = by_motion
    solved = np.isfinite(part.points).all(axis=1)
    flat_point = by_point.reshape(count, -1, 3)
    flat_uncertain = by_uncertain.reshape(count, -1, tank.uncertain)
    normal = flat_point.transpose(0, 2, 1) @ flat_point
    normal[~solved] = np.eye(3)
    inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    follows = -inverse @ (flat_point.transpose(0, 2, 1) @ flat_uncertain)
    reduced = (flat_uncertain + flat_point @ follows).reshape(by_uncertain.shape)
    inverse[~solved], follows[~solved] = np.nan, np.nan
    return inverse, follows, reduced, np.where(seen[..., None], residuals, 0.0)


def _rig_covariance(tank: Tank) -> Covariance:
    """Covariance of the rig's parameters, carried over from lenses and motions."""
    names: list[str] = []
    rows: list[Array] = []
    for i, camera in enumerate(tank.cameras):
        block, _ = tank.lens_block(i)
        lens_rows = np.zeros((block.stop - block.start, tank.uncertain))
        lens_rows[:, block] = np.eye(block.stop - block.start)
        rows.append(lens_rows)
        names += [f"{camera.name}.{name}" for name in tank.lenses[i].free]
        derived = PORT if i == 0 else (*PORT, *POSE)
        names += [f"{camera.name}.{name}" for name in derived]
        rows.append(_derived_slopes(tank, i))
    carried = np.concatenate(rows)
    matrix = carried @ tank.covariance @ carried.T
    return Covariance(parameters=tuple(names), matrix=(matrix + matrix.T) / 2)


def _derived_slopes(tank: Tank, i: int) -> Array:
    """Slopes of a camera's port and of its pose in the first camera's frame, (3 or 9, U)."""
    slopes = np.zeros((3 if i == 0 else 9, tank.uncertain))
    for j in sorted({0, i}):
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = _STEP
            ends = []
            for sign in (1.0, -1.0):
                moved = list(tank.cameras)
                moved[j] = moved[j].moved(sign * step)
                port = np.array([moved[i].camera.parameter(name) for name in PORT])
                pose = _pose_change(tank, moved[0], moved[i], i)
                ends.append(port if i == 0 else np.concatenate([port, pose]))
            slopes[:, tank.motion_block(j).start + axis] = (ends[0] - ends[1]) / (2 * _STEP)
    return slopes


def _pose_change(tank: Tank, first: FixedCamera, camera: FixedCamera, i: int) -> Array:
    """How a camera's pose in the first one's frame differs from the tank's: turn, then shift.

    The turn is about the camera's own axes, as the sigmas of a rig's rotations are meant.
    """
    before = tank.cameras[i].cam_from_world * tank.cameras[0].cam_from_world.inv()
    after: RigidTransform = camera.cam_from_world * first.cam_from_world.inv()
    turn = (after.rotation * before.rotation.inv()).as_rotvec()
    return np.concatenate([turn, after.translation - before.translation])
