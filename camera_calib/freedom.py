"""Parameters of a rig that an adjustment may change, and their priors.

A rig's parameters are called `<camera>.<name>`. Names of a camera are its
`parameters`; every camera but the reference also has its pose `cam_from_rig`: a rotation
vector (`rx_rad, ry_rad, rz_rad`) and the translation (`x_m, y_m, z_m`). Small changes, and so
sigmas, of the rotation are turns about the camera's own axes: R becomes exp(r) R.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import Flags, Indices, inverse_of
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import pose_jacobian
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.rig import Covariance, Rig

POSE = ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m")
"""Pose parameters of a camera that is not the reference; its rotation first."""
_TURN, _SHIFT = POSE[:3], POSE[3:]
PINHOLE = ("fx_px", "fy_px", "cx_px", "cy_px")
_ONE_WATER = ".n_water"
_SAME = 1.0 - 0.5e-6
"""Correlation of two priors of one number: both differ by 0.001 sigma."""
_OPENCV4 = ("k1", "k2", "p1", "p2")
LENSES: Mapping[str, tuple[str, ...]] = {
    "pinhole": (),
    "k1": ("k1",),
    "k2": ("k1", "k2"),
    "opencv4": _OPENCV4,
    "opencv5": (*_OPENCV4, "k3"),
    "rational": (*_OPENCV4, "k3", "k4", "k5", "k6"),
    "prism": (*_OPENCV4, "k3", "s1", "s2", "s3", "s4"),
    "full": (*_OPENCV4, "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Distortion terms by the name of a lens model; only those of the fisheye are not OpenCV's."""


USUAL_LENS: Mapping[str, str] = {OpenCVLens.model: "opencv5", FisheyeLens.model: "fisheye"}
"""The lens model to calibrate, by the kind of lens."""
LensNames = str | Mapping[str, str]
"""The lens model of all cameras, or that of each by the camera's name."""


def lens_of(lens: LensNames, camera: str) -> str:
    """The lens model of one camera."""
    return lens if isinstance(lens, str) else lens[camera]


def lens_kind(lens: str) -> type[LensValues]:
    """The kind of lens behind the name of a lens model."""
    return FisheyeLens if lens == FisheyeLens.model else OpenCVLens


def intrinsics(lens: str) -> tuple[str, ...]:
    """Focal lengths, centre and distortion terms of a lens model.

    Raises:
        CalibrationError: no lens model has this name.
    """
    if lens not in LENSES:
        raise CalibrationError(f"no lens model is called {lens!r}: choose {', '.join(LENSES)}")
    return (*PINHOLE, *LENSES[lens])


def all_names(rig: Rig) -> tuple[str, ...]:
    """Every parameter of a rig, camera by camera, then the poses."""
    cameras = [f"{camera}.{name}" for camera, one in rig.cameras.items() for name in one.parameters]
    return (*cameras, *pose_names(rig))


def pose_names(rig: Rig) -> tuple[str, ...]:
    """Parameters of the poses of all cameras but the reference."""
    return tuple(f"{c}.{name}" for c in rig.cameras if c != rig.reference for name in POSE)


def value(rig: Rig, name: str) -> float:
    """The value of one parameter of a rig."""
    camera, field = name.split(".")
    if field in rig.cameras[camera].parameters:
        return rig.cameras[camera].parameter(field)
    pose = rig.cam_from_rig[camera]
    if field in _SHIFT:
        return float(pose.translation[_SHIFT.index(field)])
    return float(pose.rotation.as_rotvec()[_TURN.index(field)])


def slope_columns(rig: Rig, names: Sequence[str], camera: str) -> tuple[Indices, Indices]:
    """Which slopes of a camera's pixels are by one of the names, ascending, and which name that is.

    The slopes are those by the camera's own parameters, then by its pose on the rig.
    """
    fields = (*rig.cameras[camera].parameters, *POSE)
    slopes = {f"{camera}.{field}": i for i, field in enumerate(fields)}
    pairs = sorted((slopes[name], i) for i, name in enumerate(names) if name in slopes)
    columns, at = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return columns, at


def select_slopes(columns: Indices, by_camera: Array, by_point: Array, turned: Array) -> Array:
    """Slopes (..., 2, K) of a camera's pixels by what `slope_columns` lists.

    Args:
        columns: (K,).
        by_camera: (..., 2, P) slopes by the camera's own parameters.
        by_point: (..., 2, 3) slopes by the point.
        turned: (..., 3) the point along the camera's axes, from the rig's origin.
    """
    own = columns[columns < by_camera.shape[-1]]
    if len(own) == len(columns):
        return by_camera[..., own]
    by_pose = pose_jacobian(by_point, turned)[..., columns[len(own) :] - by_camera.shape[-1]]
    return np.concatenate([by_camera[..., own], by_pose], axis=-1)


def at_bound(rig: Rig, names: Sequence[str]) -> Flags:
    """Which parameters of a rig have their least value; those of something else have none."""

    def bound(name: str) -> bool:
        camera, _, field = name.partition(".")
        minimum = rig.cameras[camera].port.minimum(field) if camera in rig.cameras else -np.inf
        return minimum > -np.inf and value(rig, name) <= minimum

    return np.array([bound(name) for name in names], dtype=np.bool_)


def move_rig(rig: Rig, names: Sequence[str], step: Array) -> Rig:
    """A rig after a step of some parameters; bounded ones stop at their bound.

    Raises:
        CalibrationError: a parameter leaves the range of a real camera.
    """
    cameras, poses = {}, {}
    for name, camera in rig.cameras.items():
        parts = [(n.partition("."), change) for n, change in zip(names, step, strict=True)]
        mine = {field: float(change) for (owner, _, field), change in parts if owner == name}
        turn, shift = ([mine.pop(axis, 0.0) for axis in axes] for axes in (_TURN, _SHIFT))
        changed = {
            field: max(camera.parameter(field) + change, camera.port.minimum(field))
            for field, change in mine.items()
        }
        cameras[name] = camera.with_parameters(changed) if changed else camera
        pose = rig.cam_from_rig[name]
        if any(turn + shift):
            pose = RigidTransform.from_components(
                pose.translation + shift, Rotation.from_rotvec(turn) * pose.rotation
            )
        poses[name] = pose
    return replace(rig, cameras=cameras, cam_from_rig=poses)


def part_of_rig(rig: Rig, names: Sequence[str]) -> Rig:
    """Some cameras as a rig of their own, the first its reference, with their joint covariance.

    A pose relative to the new reference moves with the camera's own and against the reference's:
    with R and t of it and t0 of the reference, `r' = r - R r0` and
    `x' = x - R x0 + (R t0) x (r - R r0)`.
    """
    first = rig.cam_from_rig[names[0]]
    part = replace(
        rig,
        cameras={name: rig.cameras[name] for name in names},
        cam_from_rig={name: rig.cam_from_rig[name] * first.inv() for name in names},
        body_from_rig=None if rig.body_from_rig is None else rig.body_from_cam(names[0]),
    )
    if rig.covariance is None:
        return part
    known = rig.covariance.parameters
    at = {name: np.eye(len(known))[i] for i, name in enumerate(known)}
    slopes = {n: at[n] for n in known if n.split(".")[0] in names and n.split(".")[1] not in POSE}

    def pose_rows(name: str) -> Array:
        return np.array([at.get(f"{name}.{axis}", np.zeros(len(known))) for axis in POSE])

    for name in names[1:]:
        turn = part.cam_from_rig[name].rotation.as_matrix()
        own, base = pose_rows(name), pose_rows(names[0])
        rows = own - np.vstack([turn @ base[:3], turn @ base[3:]])
        rows[3:] += np.cross(turn @ first.translation, rows[:3], axisb=0, axisc=0)
        if rows.any():
            slopes |= {f"{name}.{axis}": row for axis, row in zip(POSE, rows, strict=True)}
    matrix = np.array(list(slopes.values())).reshape(len(slopes), len(known))
    covariance = matrix @ rig.covariance.matrix @ matrix.T
    return replace(part, covariance=Covariance(parameters=tuple(slopes), matrix=covariance))


def knowing_water(rig: Rig, sigma: float) -> Rig:
    """The rig with its water's index known to a sigma, apart from all else that is calibrated.

    A covariance that holds the index already stays: the calibration was in the same water. So does
    a rig that has none, because its cameras do not refract.
    """
    wet = [f"{name}{_ONE_WATER}" for name, camera in rig.cameras.items() if camera.refracts]
    if not wet or sigma == 0.0 or not rig.sigmas.keys().isdisjoint(wet):
        return rig
    water = Prior.around(rig, dict.fromkeys(wet, sigma))
    known = rig.covariance or Covariance(parameters=(), matrix=np.zeros((0, 0)))
    both = Covariance(
        parameters=(*known.parameters, *water.parameters),
        matrix=block_diag(known.matrix, water.covariance),
    )
    return replace(rig, covariance=both)


@dataclass(frozen=True, kw_only=True, eq=False)
class Prior:
    """Normally distributed prior of some parameters, not from the views."""

    parameters: tuple[str, ...]
    mean: Array
    """(K,) in the parameters' units."""
    covariance: Array
    """(K, K)."""

    def __post_init__(self) -> None:
        count = len(self.parameters)
        if self.mean.shape != (count,) or self.covariance.shape != (count, count):
            raise CalibrationError(
                f"prior: {self.mean.shape} means and {self.covariance.shape} covariances for "
                f"{count} parameters"
            )
        sigma = np.sqrt(np.diag(self.covariance))
        if not (np.all(sigma > 0) and np.all(np.isfinite(self.mean))):
            raise CalibrationError("prior: a mean is not finite or a sigma not positive")
        scaled = self.covariance / np.outer(sigma, sigma)
        if count and np.linalg.eigvalsh(scaled)[0] < 1e-13:
            raise CalibrationError("prior: its covariance is not positive definite")
        turns = {name for name in self.parameters if name.endswith(_TURN)}
        for camera in {name.split(".")[0] for name in turns}:
            if not {f"{camera}.{axis}" for axis in _TURN} <= turns:
                raise CalibrationError(f"prior: {camera} needs all of {', '.join(_TURN)}")

    @property
    def information(self) -> Array:
        """(K, K) inverse of the covariance."""
        return inverse_of(self.covariance)

    def misfit(self, rig: Rig) -> Array:
        """(K,) a rig's parameters minus the mean; a turn counts from the mean's rotation."""
        found = np.array([n.endswith(_TURN) or value(rig, n) for n in self.parameters]) - self.mean
        for camera in {n.split(".")[0] for n in self.parameters if n.endswith(_TURN)}:
            at = [self.parameters.index(f"{camera}.{axis}") for axis in _TURN]
            turn = rig.cam_from_rig[camera].rotation * Rotation.from_rotvec(self.mean[at]).inv()
            found[at] = turn.as_rotvec()
        return found

    @classmethod
    def around(cls, rig: Rig, sigmas: Mapping[str, float]) -> "Prior":
        """Prior at the rig's values with the given sigmas, independent of each other.

        Only the indices of the water are one number: all cameras look into the same.
        """
        spread = np.array(list(sigmas.values()))
        water = np.array([name.endswith(_ONE_WATER) for name in sigmas], dtype=bool)
        alike = np.where(np.outer(water, water), _SAME, 0.0)
        np.fill_diagonal(alike, 1.0)
        return cls(
            parameters=tuple(sigmas),
            mean=np.array([value(rig, name) for name in sigmas]),
            covariance=alike * np.outer(spread, spread),
        )

    @classmethod
    def of_rig(cls, rig: Rig, names: Iterable[str]) -> "Prior":
        """Prior from an earlier calibration, with its correlations, of the names it estimated."""
        if rig.covariance is None:
            raise CalibrationError(
                f"the rig ({rig.source}) has no covariance to serve as a prior: calibrate it, or "
                "hold its parameters or leave them free"
            )
        kept = tuple(name for name in names if name in rig.covariance.parameters)
        return cls(
            parameters=kept,
            mean=np.array([value(rig, name) for name in kept]),
            covariance=rig.covariance.marginal(kept).matrix,
        )

    def and_also(self, other: "Prior") -> "Prior":
        """Both, taken as independent of each other."""
        twice = set(self.parameters) & set(other.parameters)
        if twice:
            raise CalibrationError(f"prior: two are given for {', '.join(sorted(twice))}")
        return Prior(
            parameters=(*self.parameters, *other.parameters),
            mean=np.concatenate([self.mean, other.mean]),
            covariance=block_diag(self.covariance, other.covariance),
        )


NO_PRIOR = Prior(parameters=(), mean=np.zeros(0), covariance=np.zeros((0, 0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Freedom:
    """Parameters that an adjustment may change; all others are held."""

    free: tuple[str, ...] = ()
    """Parameters known from the views alone. Those of the prior are adjusted too."""
    prior: Prior = NO_PRIOR

    def names(self, rig: Rig) -> tuple[str, ...]:
        """Adjusted parameters, in the order of `all_names`.

        Raises:
            CalibrationError: a name is not a parameter of the rig.
        """
        adjusted = {*self.free, *self.prior.parameters}
        known = all_names(rig)
        if adjusted - set(known):
            raise CalibrationError(
                f"the rig has no parameter {', '.join(sorted(adjusted - set(known)))}"
            )
        return tuple(name for name in known if name in adjusted)


HELD = Freedom()


def of_ports(rig: Rig) -> tuple[str, ...]:
    """Parameters of the ports that a calibration finds."""
    return tuple(
        f"{name}.{p}" for name, camera in rig.cameras.items() for p in camera.port.estimated
    )


def of_lenses(rig: Rig, lens: LensNames) -> tuple[str, ...]:
    """Intrinsics of every camera of a rig."""
    return tuple(f"{c}.{name}" for c in rig.cameras for name in intrinsics(lens_of(lens, c)))


def of_cameras(rig: Rig, names: Iterable[str]) -> tuple[str, ...]:
    """The same parameters of every camera of a rig."""
    fields = tuple(names)
    return tuple(f"{camera}.{name}" for camera in rig.cameras for name in fields)
