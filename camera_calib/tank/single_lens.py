"""One lens from pictures of a flat target in air; its distortion model is chosen by prediction.

OpenCV's `calibrateCamera` adjusts the lens and the poses of the target. Each model is judged by
views that took no part: one view at a time is left out, its pose alone is then fitted, and what
remains is held-out error. A model that folds back within the frame is no lens and is not taken.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.base.errors import CalibrationError
from alice_survey.base.executor import SERIAL, Executor
from alice_survey.base.frames import Array
from camera_calib.flat_port import PARAMETERS, FlatPortCamera, pose_jacobian
from camera_calib.freedom import LENSES, intrinsics
from camera_calib.lens import COEFFICIENTS

_HALF_PX = 0.5
"""OpenCV counts from the centre of the first pixel."""
_FEWEST_VIEWS = 6
_OUTLYING = 3.0
"""A view whose residual is so many times the median view's is left out (blur, a moving board)."""
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


@dataclass(frozen=True, kw_only=True, eq=False)
class LensView:
    """Points of the target in one picture."""

    name: str
    pixels: Array
    """(N, 2) from the outer corner of the first pixel; NaN rows were not found."""


@dataclass(frozen=True, kw_only=True)
class LensModel:
    """How one distortion model did."""

    name: str
    rms_px: float
    """Root mean square length of the residuals of the views adjusted."""
    held_out_px: float
    """The same of views left out."""
    folds: bool
    """Some pixels of the frame have no ray: the model turns back before the frame's border."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownLens:
    """A lens, and how well it is known."""

    camera: FlatPortCamera
    """In air: without a port, n_water = 1."""
    free: tuple[str, ...] = ()
    """Its parameters that are uncertain, of `flat_port.PARAMETERS`."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """(F, F) of `free`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SingleLens(KnownLens):
    """A lens calibrated from pictures."""

    chosen: LensModel
    tried: tuple[LensModel, ...]
    views: tuple[str, ...]
    rejected: Mapping[str, float]
    """Views left out, with their rms residual in pixels."""


def calibrate_single_lens(
    views: Sequence[LensView],
    target_points: Array,
    size_px: tuple[int, int],
    models: Sequence[str] = tuple(LENSES),
    executor: Executor = SERIAL,
) -> SingleLens:
    """Calibrate one camera in air.

    Args:
        views: pictures of the target.
        target_points: (N, 3) its points, z = 0, metres.
        size_px: width and height of the pictures.
        models: names of `freedom.LENSES` to choose from.
        executor: where tasks run.

    Raises:
        CalibrationError: too few views, an unknown model, or none that fits the frame.
    """
    unknown = [name for name in models if name not in LENSES]
    if unknown or not models:
        raise CalibrationError(
            f"no lens model is called {', '.join(unknown) or '(none)'}; known: {'; '.join(LENSES)}"
        )
    kept, rejected = _without_outlying(views, target_points, size_px, models)
    jobs = [(kept, target_points, size_px, name) for name in models]
    tried = tuple(executor.map(_judge, jobs, label="lens models"))
    sound = [model for model in tried if not model.folds]
    if not sound:
        raise CalibrationError(
            f"every lens model tried ({'; '.join(models)}) folds back within the frame: take views "
            "that reach the borders, or allow other models"
        )
    chosen = min(sound, key=lambda model: model.held_out_px)
    fit = _fit(kept, target_points, size_px, chosen.name)
    free = intrinsics(chosen.name)
    return SingleLens(
        camera=fit.camera,
        free=free,
        covariance=_covariance(fit, kept, target_points, free),
        chosen=chosen,
        tried=tried,
        views=tuple(view.name for view in kept),
        rejected=rejected,
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    camera: FlatPortCamera
    rotations: Array
    """(V, 3) rotation vectors, camera from target."""
    translations: Array
    view_rms_px: Array


def _seen(view: LensView, target_points: Array) -> tuple[Array, Array]:
    found = np.isfinite(view.pixels).all(axis=1)
    return target_points[found], view.pixels[found]


def _fit(
    views: Sequence[LensView], target_points: Array, size_px: tuple[int, int], model: str
) -> _Fit:
    """OpenCV's adjustment with one model."""
    pairs = [_seen(view, target_points) for view in views]
    # OpenCV wants single precision; at a unit of its own size a target loses nothing by it.
    scale = float(np.ptp(target_points, axis=0).max())
    with _one_thread():
        solution = cv2.calibrateCameraExtended(
            [(points / scale).astype(np.float32) for points, _ in pairs],
            [(pixels - _HALF_PX).astype(np.float32) for _, pixels in pairs],
            size_px,
            None,
            None,
            flags=_flags(LENSES[model]),
            criteria=_CRITERIA,
        )
    _, matrix, distortion, rotations, translations, _, _, view_rms = solution
    values = dict(zip(COEFFICIENTS, map(float, distortion.ravel()), strict=False))
    camera = FlatPortCamera(
        width_px=size_px[0],
        height_px=size_px[1],
        fx_px=float(matrix[0, 0]),
        fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]) + _HALF_PX,
        cy_px=float(matrix[1, 2]) + _HALF_PX,
        n_water=1.0,
    ).with_parameters(values)
    return _Fit(
        camera=camera,
        rotations=np.stack(rotations).reshape(-1, 3),
        translations=np.stack(translations).reshape(-1, 3) * scale,
        view_rms_px=np.asarray(view_rms).ravel(),
    )


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV's threads add up in no fixed order; one gives the same bytes every time."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _flags(free: Sequence[str]) -> int:
    """OpenCV's switches for the coefficients to adjust; the others stay 0."""
    flags = sum(getattr(cv2, f"CALIB_FIX_K{i}") for i in range(1, 7) if f"k{i}" not in free)
    if "p1" not in free:
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    if {"k4", "k5", "k6"} & set(free):
        flags |= cv2.CALIB_RATIONAL_MODEL
    if "s1" in free:
        flags |= cv2.CALIB_THIN_PRISM_MODEL
    return int(flags)


def _without_outlying(
    views: Sequence[LensView],
    target_points: Array,
    size_px: tuple[int, int],
    models: Sequence[str],
) -> tuple[list[LensView], dict[str, float]]:
    """Leave out, one by one, views that no model fits as it fits the others."""
    kept, rejected = list(views), dict[str, float]()
    richest = max(models, key=lambda name: len(LENSES[name]))
    while True:
        if len(kept) < _FEWEST_VIEWS:
            raise CalibrationError(
                f"{len(kept)} usable pictures of the target in air; at least {_FEWEST_VIEWS} are "
                "needed: take more, at more angles and in all parts of the frame"
            )
        rms = _fit(kept, target_points, size_px, richest).view_rms_px
        worst = int(np.argmax(rms))
        if rms[worst] <= _OUTLYING * np.median(rms) + 1e-6:
            return kept, rejected
        rejected[kept.pop(worst).name] = float(rms[worst])


def _judge(job: tuple[list[LensView], Array, tuple[int, int], str]) -> LensModel:
    """Fit one model to all views, and to all but each one."""
    views, target_points, size_px, model = job
    fit = _fit(views, target_points, size_px, model)
    counts = np.array([np.isfinite(view.pixels).all(axis=1).sum() for view in views])
    squares, held_out = float(counts @ fit.view_rms_px**2), 0.0
    for i, view in enumerate(views):
        others = _fit([*views[:i], *views[i + 1 :]], target_points, size_px, model)
        held_out += float((_pose_residuals(others.camera, *_seen(view, target_points)) ** 2).sum())
    _, rays = fit.camera.unproject(fit.camera.border())
    return LensModel(
        name=model,
        rms_px=float(np.sqrt(squares / counts.sum())),
        held_out_px=float(np.sqrt(held_out / counts.sum())),
        folds=bool(np.isnan(rays).any()),
    )


def _pose_residuals(camera: FlatPortCamera, points: Array, pixels: Array) -> Array:
    """Residuals, (N, 2), of a view whose pose alone is fitted."""
    matrix = np.array(
        [
            [camera.fx_px, 0.0, camera.cx_px - _HALF_PX],
            [0.0, camera.fy_px, camera.cy_px - _HALF_PX],
            [0.0, 0.0, 1.0],
        ]
    )
    distortion = np.array([getattr(camera, name) for name in COEFFICIENTS])
    image = pixels - _HALF_PX
    _, rotation, translation = cv2.solvePnP(points, image, matrix, distortion)
    rotation, translation = cv2.solvePnPRefineLM(
        points, image, matrix, distortion, rotation, translation
    )
    seen, _ = cv2.projectPoints(points, rotation, translation, matrix, distortion)
    residuals: Array = seen.reshape(-1, 2) - image
    return residuals


def _covariance(
    fit: _Fit, views: Sequence[LensView], target_points: Array, free: Sequence[str]
) -> Array:
    """Covariance of the lens with all poses marginalised, scaled to the residuals."""
    columns = [PARAMETERS.index(name) for name in free]
    normal = np.zeros((len(free), len(free)))
    squares, freedom = 0.0, -len(free)
    for view, rotation, translation in zip(views, fit.rotations, fit.translations, strict=True):
        points, pixels = _seen(view, target_points)
        points_cam = Rotation.from_rotvec(rotation).apply(points) + translation
        seen, by_point, by_parameter = fit.camera.project_jacobian(points_cam)
        by_pose = pose_jacobian(by_point, points_cam).reshape(-1, 6)
        by_lens = by_parameter[..., columns].reshape(-1, len(free))
        unexplained = by_lens - by_pose @ np.linalg.lstsq(by_pose, by_lens, rcond=None)[0]
        normal += unexplained.T @ unexplained
        squares += float(((seen - pixels) ** 2).sum())
        freedom += by_pose.shape[0] - 6
    scale = 1.0 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * np.outer(scale, scale))
    covariance: Array = squares / freedom * inverse * np.outer(scale, scale)
    return covariance
