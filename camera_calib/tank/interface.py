"""Fixed cameras in air that look into water through a flat surface or the wall of a tank.

The pose of each camera comes from points on its interface whose places in the world are known (the
corners of a tank, the waterline). Light from them reaches the camera through air alone, so that
this is a plain pose from a plane; the interface then is the camera's port: its normal and distance
follow from the pose. Points lie on the air's side of the interface; glass, if any, is behind them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError, warn
from alice_survey.base.frames import Array
from camera_calib.flat_port import PARAMETERS, FlatPortCamera, pose_jacobian

_FEWEST_POINTS = 4
_FLAT = 0.01
"""Points may leave their plane, and reach beyond an interface, by this share of their extent."""
_SLENDER = 0.02
_MISFIT = 0.03
"""A pose that misses its points by more than this share of the frame's diagonal is no pose."""
_AMBIGUOUS = 1.5
_STEPS = 100
_SETTLED_PX = 1e-9
"""A step that moves the pixels by less ends the search."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Points of an interface, in the world and in one camera's picture."""

    camera: str
    pixels: Array
    """(P, 2) from the outer corner of the first pixel."""
    points_world: Array
    """(P, 3) metres, on the air's side of the interface."""
    source: str = "reference"
    """What to call it in messages, such as its file."""

    def __post_init__(self) -> None:
        count = len(self.pixels)
        if self.pixels.shape != (count, 2) or self.points_world.shape != (count, 3):
            raise CalibrationError(
                f"{self.source}: pixels {self.pixels.shape}, points {self.points_world.shape}; "
                "(P, 2) and (P, 3) wanted"
            )
        if count < _FEWEST_POINTS:
            raise CalibrationError(
                f"{self.source}: {count} reference points; at least {_FEWEST_POINTS} on the "
                "interface are needed"
            )
        if not (np.isfinite(self.pixels).all() and np.isfinite(self.points_world).all()):
            raise CalibrationError(f"{self.source}: a coordinate is not a number")


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """A plane in the world."""

    point_world: Array
    normal_world: Array
    """(3,) unit vector."""
    extent_m: float
    """Largest distance of the points it was fitted to from their middle."""
    flatness_m: float
    """Largest distance of these points from the plane."""

    def heights_m(self, points_world: Array) -> Array:
        """(...) signed distances of points (..., 3), positive on the normal's side."""
        heights: Array = (points_world - self.point_world) @ self.normal_world
        return heights


def plane_through(reference: Reference) -> Plane:
    """The plane nearest to reference points; which way its normal points is arbitrary.

    Raises:
        CalibrationError: they are not on one plane, or nearly on one line.
    """
    middle = reference.points_world.mean(axis=0)
    offsets = reference.points_world - middle
    _, spread, axes = np.linalg.svd(offsets)
    extent = float(np.linalg.norm(offsets, axis=1).max())
    if not spread[1] > _SLENDER * spread[0]:
        raise CalibrationError(
            f"{reference.source}: the {len(offsets)} reference points lie on one line; they must "
            "span the interface"
        )
    normal = np.cross(axes[0], axes[1])
    flatness = float(np.abs(offsets @ normal).max())
    if flatness > _FLAT * extent:
        raise CalibrationError(
            f"{reference.source}: reference points lie up to {flatness * 1e3:.1f} mm off one plane "
            f"({_FLAT * extent * 1e3:.1f} mm are allowed): give points of one flat interface only"
        )
    return Plane(point_world=middle, normal_world=normal, extent_m=extent, flatness_m=flatness)


@dataclass(frozen=True, kw_only=True, eq=False)
class FixedCamera:
    """A camera before an interface; its port is derived, so that it follows when the pose moves."""

    name: str
    lens: FlatPortCamera
    """As in air: no port, n_water = 1."""
    cam_from_world: RigidTransform
    plane: Plane
    """The interface on the air's side; the normal points into the water."""
    reference: Reference
    n_water: float
    glass_thickness_m: float = 0.0
    n_glass: float = 1.52

    @property
    def position_world(self) -> Array:
        """(3,) the entrance pupil."""
        return np.asarray(self.cam_from_world.inv().translation)

    @cached_property
    def camera(self) -> FlatPortCamera:
        """The camera with the interface as its port.

        Raises:
            CalibrationError: the camera looks away from the interface.
        """
        normal = self.cam_from_world.rotation.apply(self.plane.normal_world)
        if not normal[2] > 0.0:
            raise CalibrationError(
                f"{self.name}: the camera's axis is "
                f"{math.degrees(math.acos(max(-1.0, normal[2]))):.0f} deg off the interface's "
                "normal, so that it does not look through it: check the reference points"
            )
        return replace(
            self.lens,
            port_distance_m=-float(self.plane.heights_m(self.position_world)),
            glass_thickness_m=self.glass_thickness_m,
            n_glass=self.n_glass,
            n_water=self.n_water,
        ).with_parameters({"normal_x": float(normal[0]), "normal_y": float(normal[1])})

    @cached_property
    def reference_residuals_px(self) -> Array:
        """(P, 2) projected less measured, through air."""
        points_cam = self.cam_from_world.apply(self.reference.points_world)
        residuals: Array = self.lens.project(points_cam) - self.reference.pixels
        return residuals

    @property
    def reference_rms_px(self) -> float:
        """Root mean square length of these residuals."""
        return float(np.sqrt((self.reference_residuals_px**2).sum(axis=1).mean()))

    def moved(self, step: Array) -> "FixedCamera":
        """After a small motion, (6,): points in its frame become exp(step[:3]) p + step[3:]."""
        motion = RigidTransform.from_components(step[3:], Rotation.from_rotvec(step[:3]))
        return replace(self, cam_from_world=motion * self.cam_from_world)

    def reference_slopes(self) -> tuple[Array, Array]:
        """Slopes of the reference pixels by a motion, (2P, 6), and by the lens, (2P, 22)."""
        points_cam = self.cam_from_world.apply(self.reference.points_world)
        _, by_point, by_lens = self.lens.project_jacobian(points_cam)
        return (
            pose_jacobian(by_point, points_cam).reshape(-1, 6),
            by_lens.reshape(-1, len(PARAMETERS)),
        )

    def slopes(self, points_world: Array) -> tuple[Array, Array, Array]:
        """Slopes of pixels through the interface, which stays where it is in the world.

        Args:
            points_world: (N, 3) in the water.

        Returns:
            By the point in the world, (N, 2, 3); by a motion of the camera, (N, 2, 6), see `moved`;
            by `PARAMETERS`, (N, 2, 22).
        """
        points_cam = self.cam_from_world.apply(points_world)
        _, by_point, by_parameter = self.camera.project_jacobian(points_cam)
        by_motion = pose_jacobian(by_point, points_cam)
        # In the camera's frame the plane n . p = d moves too: n by step[:3] x n, d by n . step[3:].
        n = np.asarray(self.camera.normal)
        turn = np.array([[0.0, n[2], -n[1]], [-n[2], 0.0, n[0]]])
        normals = [PARAMETERS.index("normal_x"), PARAMETERS.index("normal_y")]
        by_motion[..., :3] += by_parameter[..., normals] @ turn
        distance = by_parameter[..., PARAMETERS.index("port_distance_m")]
        by_motion[..., 3:] += distance[..., None] * n
        return by_point @ self.cam_from_world.rotation.as_matrix(), by_motion, by_parameter


def place_camera(
    lens: FlatPortCamera,
    reference: Reference,
    *,
    n_water: float,
    glass_thickness_m: float = 0.0,
    n_glass: float = 1.52,
) -> FixedCamera:
    """Find where a camera stands from points of the interface before it.

    Args:
        lens: the camera as in air.
        reference: the points.
        n_water: index of the water.
        glass_thickness_m: of the wall; 0 for a water surface.
        n_glass: its index.

    Raises:
        CalibrationError: points that are not on one plane, that the camera's lens cannot see, or
            that no pose explains.
    """
    plane = plane_through(reference)
    in_air = replace(lens, port_distance_m=0.0, glass_thickness_m=0.0, n_water=1.0)
    air = replace(in_air, normal=(0.0, 0.0, 1.0))
    starts = _poses(air, reference, plane)
    found = []
    for start in starts:
        fixed = FixedCamera(
            name=reference.camera,
            lens=air,
            cam_from_world=start,
            plane=plane,
            reference=reference,
            n_water=n_water,
            glass_thickness_m=glass_thickness_m,
            n_glass=n_glass,
        )
        if _cost(fixed) < math.inf:
            found.append(_settle(fixed))
    found.sort(key=lambda camera: camera.reference_rms_px)
    limit = _MISFIT * math.hypot(lens.width_px, lens.height_px)
    if not found or not found[0].reference_rms_px < limit:
        missed = f" by {found[0].reference_rms_px:.0f} px rms" if found else ""
        raise CalibrationError(
            f"{reference.source}: the best pose misses the reference points{missed} "
            f"({limit:.0f} px are allowed): check their order, their units and that pixels and "
            "lens are of the same camera"
        )
    best = found[0]
    _warn_if_ambiguous(found)
    if plane.heights_m(best.position_world) > 0.0:
        flipped = replace(plane, normal_world=-plane.normal_world)
        best = replace(best, plane=flipped)
    return best


def check_sides(cameras: Sequence[FixedCamera]) -> None:
    """Check that all interfaces bound one body of water.

    Raises:
        CalibrationError: reference points of one camera are on another camera's air side.
    """
    for camera in cameras:
        for other in cameras:
            heights = camera.plane.heights_m(other.reference.points_world)
            deepest = float(heights.min())
            if deepest < -_FLAT * (camera.plane.extent_m + other.plane.extent_m):
                place = ", ".join(f"{x:.3f}" for x in camera.position_world)
                raise CalibrationError(
                    f"{camera.name}: reference points of {other.name} lie {-deepest * 1e3:.0f} mm "
                    f"before its interface, on the air's side, where the camera stands at ({place})"
                    " m: an axis of the world is mirrored or corners are swapped in "
                    f"{camera.reference.source}"
                )


def _poses(lens: FlatPortCamera, reference: Reference, plane: Plane) -> list[RigidTransform]:
    """Both poses that a plane can have (IPPE, Collins and Bartoli 2014), camera from world."""
    _, rays = lens.unproject(reference.pixels)
    if np.isnan(rays).any():
        raise CalibrationError(
            f"{reference.source}: the lens has no ray for {int(np.isnan(rays).any(axis=1).sum())} "
            "of the reference pixels: they lie beyond where its distortion model holds"
        )
    first = np.linalg.svd(reference.points_world - plane.point_world)[2][0]
    axes = np.stack([first, np.cross(plane.normal_world, first), plane.normal_world])
    flat = (reference.points_world - plane.point_world) @ axes.T
    flat[:, 2] = 0.0
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        flat, rays[:, :2] / rays[:, 2:], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    plane_from_world = RigidTransform.from_components(
        -axes @ plane.point_world, Rotation.from_matrix(axes)
    )
    return [
        RigidTransform.from_components(t.ravel(), Rotation.from_rotvec(r.ravel()))
        * plane_from_world
        for r, t in zip(rotations, translations, strict=True)
    ]


def _settle(camera: FixedCamera) -> FixedCamera:
    """Least squares over the pose, from where it is (Levenberg-Marquardt)."""
    cost, damping = _cost(camera), 1e-3
    for _ in range(_STEPS):
        by_motion, _ = camera.reference_slopes()
        normal = by_motion.T @ by_motion
        gradient = by_motion.T @ camera.reference_residuals_px.ravel()
        damped = normal + damping * np.diag(np.diag(normal))
        step = np.asarray(-np.linalg.solve(damped, gradient), dtype=np.float64)
        tried = camera.moved(step)
        new_cost = _cost(tried)
        if float(np.abs(by_motion @ step).max()) < _SETTLED_PX:
            return tried if math.isfinite(new_cost) else camera
        if new_cost <= cost:
            camera, cost, damping = tried, new_cost, 0.1 * damping
        else:
            damping = max(10.0 * damping, 1e-9)
    return camera


def _cost(camera: FixedCamera) -> float:
    squares = float((camera.reference_residuals_px**2).sum())
    return squares if math.isfinite(squares) else math.inf


def _warn_if_ambiguous(found: Sequence[FixedCamera]) -> None:
    """A plane seen from afar has two poses that explain it about as well."""
    if len(found) < 2:
        return
    best, second = found[0], found[1]
    turn = (best.cam_from_world * second.cam_from_world.inv()).rotation.magnitude()
    close = second.reference_rms_px < _AMBIGUOUS * best.reference_rms_px
    if math.degrees(turn) > 1.0 and close:
        warn(
            f"{best.name}: two poses {math.degrees(turn):.0f} deg apart explain the reference "
            f"points ({best.reference_rms_px:.2f} and {second.reference_rms_px:.2f} px rms); the "
            "first is taken: give more points, or stand nearer and more oblique"
        )
