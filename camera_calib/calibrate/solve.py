"""Calibrate cameras and ports from views of a target: in air, through the ports, or both.

Every mode ends in one adjustment of all cameras over all views (`adjust`); modes differ in what is
free and where the first values come from. Points that the robust solution misses by a clear
multiple of the noise are then left out, and named.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.block_solver import Flags
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from camera_calib.calibrate.adjust import Adjustment, adjust
from camera_calib.calibrate.corner_noise import spread_of
from camera_calib.calibrate.normal_equations import CalibrationProblem
from camera_calib.calibrate.observability import advice, unobservable
from camera_calib.calibrate.start import first_cam_from_rig, first_focal_px, locate_all, spans
from camera_calib.calibration import Calibration, TargetView, residuals_px, stack_views
from camera_calib.camera import Camera
from camera_calib.freedom import (
    PINHOLE,
    Freedom,
    LensNames,
    Prior,
    intrinsics,
    lens_kind,
    lens_of,
    of_cameras,
    of_lenses,
    of_ports,
    pose_names,
)
from camera_calib.ports.none import NO_PORT
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig
from camera_calib.target_shape import TargetShape, usual_shape
from camera_calib.targets.target import Rejection

Intrinsics = Literal["held", "prior", "free"]

_MIN_VIEWS = 4
OUTLIER = 6.0
"""Length of a residual, in sigmas of a coordinate, beyond which a point takes no part: of normal
noise one in 65 million is longer."""
_DULLEST = 3.0
"""Largest noise of one picture, over that of all, that is still noise."""
_BY_CHANCE = 2.0
"""Mean square difference of the pictures' noise, relative to chance for equal noise."""
_DRAWN = 16.0
"""Coordinates by which a picture's noise is drawn towards that of all."""
_SAME_BLUR = 0.1
_MIN_LIMIT_PX = 1e-4
_ROUNDS = 6
_STEPS = 40
"""Step limit of an adjustment that may still include views which do not fit at all."""
_MIN_FITTING = 0.5
"""Share of a picture's points; with fewer the whole picture is left out."""
_ROUGHLY = 0.1
"""Convergence limit, in sigmas, of values that only serve as a start."""
_LOOSEST_FOCAL = 0.1
"""Largest sigma of a focal length, as a share of it, that still is a calibration."""


def calibrate(
    views: Sequence[TargetView],
    points: Array,
    start: Rig,
    freedom: Freedom,
    *,
    source: str = "calibration",
    shape: TargetShape | None = None,
) -> Calibration:
    """Adjust a rig over all views, from a rig near the truth.

    Args:
        views: where the cameras saw the target.
        points: (N, 3) the target's points as drawn, in its own frame, metres.
        start: near the truth, such as the design; what is not adjusted is taken from it.
        freedom: what is adjusted.
        source: how, for the rig's `source`.
        shape: how the target may differ from its drawing; None for that of a flat sheet, and
            `AS_DRAWN` for points that are known better.

    Raises:
        CalibrationError: too few views, or they do not determine what is free.
    """
    usable, rejections = _usable(views, points)
    _check_served(usable, start)
    shape = usual_shape(points) if shape is None else shape
    found = locate_all(start, usable, points + shape.offsets_m)
    for view, pose in zip(usable, found, strict=True):
        if pose is None:
            reason = "no pose of the target was found"
            rejections += [_whole_picture(view.name, camera, reason) for camera in view.pixels]
    alive = [i for i, pose in enumerate(found) if pose is not None]
    usable = [usable[i] for i in alive]
    _check_enough(len(usable), len(views))
    pixels = stack_views(usable, start, len(points))
    poses = RigidTransform.concatenate([pose for pose in found if pose is not None])
    adjusted, kept, alive_views = _adjust_without_outliers(
        usable, pixels, points, start, poses, freedom, shape
    )
    rejections += _rejections(usable, pixels, kept, start, adjusted)
    _check_focal(adjusted.rig, adjusted.rig_from_target)
    fitting = np.where(kept[..., None], pixels, np.nan)
    used = fitting[alive_views]
    left_out = np.where(kept[..., None], np.nan, pixels)[alive_views]
    final = tuple(_views_of(usable, fitting, alive_views, start))
    spread = spread_of(CalibrationProblem(used, points, start, freedom, shape), adjusted)
    if freedom.prior.parameters:  # the views weigh as much against it as their correlated noise
        excess, prior = spread.excess, freedom.prior
        firm = replace(freedom, prior=replace(prior, covariance=prior.covariance / excess))
        adjusted = adjust(
            final, points, adjusted.rig, adjusted.rig_from_target, firm, blur=adjusted.blur,
            shape=adjusted.shape,
        )  # fmt: skip
        spread = spread_of(CalibrationProblem(used, points, start, firm, shape), adjusted, excess)
    rig = replace(
        adjusted.rig,
        source=f"{source} from {len(final)} views",
        covariance=spread.covariance.marginal(freedom.names(start)),
    )
    of_shape = spread.covariance.marginal(shape.parameters).matrix
    found_shape = adjusted.shape.with_values(adjusted.shape.values, of_shape)
    return Calibration(
        rig=rig,
        target_points=points + found_shape.offsets_m,
        views=final,
        rig_from_target=adjusted.rig_from_target,
        residuals_px=adjusted.residuals_px,
        weights=adjusted.weights,
        noise_px=adjusted.noise_px,
        rejections=tuple(rejections),
        warnings=tuple(advice(rig, used, adjusted.rig_from_target)),
        freedom=freedom,
        rejected=left_out,
        blur=adjusted.blur,
        shape=found_shape,
        spread=spread,
    )


def recalibrate(calibration: Calibration, views: Sequence[TargetView]) -> Calibration:
    """The same calibration from other views, such as a part of those it used."""
    found = calibration
    return calibrate(views, found.drawn_points, found.rig, found.freedom, shape=found.shape)


@progress.step("find cameras")
def calibrate_in_air(
    views: Sequence[TargetView],
    points: Array,
    sizes: Mapping[str, tuple[int, int]],
    lens: LensNames = "opencv5",
    start: Rig | None = None,
    shape: TargetShape | None = None,
) -> Calibration:
    """Intrinsics of each camera alone, then of all with the rig, in air, without a start.

    Args:
        views: where the cameras saw the target.
        points: (N, 3) of the target, metres.
        sizes: width and height of each camera's pictures; the first is the reference.
        lens: name of a lens model (`freedom.LENSES`), of all cameras or by camera.
        start: a rig near the truth, where one is known.
        shape: as of `calibrate`.

    Raises:
        CalibrationError: too few views, or they do not determine the cameras.
    """
    if start is None:
        blank = {name: blank_camera(size, lens_of(lens, name)) for name, size in sizes.items()}
        start = first_rig(views, points, blank, lens)
    free = (*of_lenses(start, lens), *pose_names(start))
    freedom = Freedom(free=free)
    return calibrate(views, points, start, freedom, source="calibration in air", shape=shape)


@progress.step("find cameras and ports")
def calibrate_through_ports(
    views: Sequence[TargetView],
    points: Array,
    start: Rig,
    known: Intrinsics,
    lens: LensNames = "opencv5",
    sigmas: Mapping[str, float] | None = None,
    shape: TargetShape | None = None,
) -> Calibration:
    """Rig and housings in one adjustment: distance and normal of each port, pose of each camera.

    Args:
        views: where the cameras saw the target, under water.
        points: (N, 3) of the target, metres.
        start: cameras calibrated in air, or a design; with glass, water and a guess of the ports.
        known: whether the cameras' intrinsics are held at the start's, taken with their
            covariance as a prior, or found again.
        lens: as of `calibrate_in_air`: the lens model that is found again.
        sigmas: more parameters that are known about as the start has them, such as
            `left.glass_thickness_m`, with their standard deviations.
        shape: as of `calibrate`.

    Raises:
        CalibrationError: too few views, they do not determine what is free, or the start has no
            covariance to serve as a prior.
    """
    extra = Prior.around(start, sigmas or {})
    free = [*of_ports(start), *pose_names(start)]
    if known == "free":
        free += of_lenses(start, lens)
    if known == "prior":
        extra = Prior.of_rig(start, of_cameras(start, intrinsics("full"))).and_also(extra)
    freedom = Freedom(
        free=tuple(name for name in free if name not in extra.parameters), prior=extra
    )
    source = f"calibration through the ports, intrinsics {known},"
    return calibrate(views, points, start, freedom, source=source, shape=shape)


def calibrate_in_water_alone(
    views: Sequence[TargetView],
    points: Array,
    cameras: Mapping[str, Camera],
    lens: LensNames = "opencv5",
    sigmas: Mapping[str, float] | None = None,
    shape: TargetShape | None = None,
) -> Calibration:
    """Rig, housings and intrinsics from views under water, where nothing else exists.

    Args:
        views: where the cameras saw the target, under water.
        points: (N, 3) of the target, metres.
        cameras: blank ones (`blank_camera`) with glass, water and a guess of the port distance.
        lens: as of `calibrate_in_air`.
        sigmas: as of `calibrate_through_ports`.
        shape: as of `calibrate`.

    Raises:
        CalibrationError: too few views, or they do not determine what is free.
    """
    start = first_rig(views, points, cameras, lens)
    found = calibrate_through_ports(views, points, start, "free", lens, sigmas, shape)
    return replace(found, warnings=(*found.warnings, *unobservable(found)))


def blank_camera(size: tuple[int, int], lens: str, port: PortValues = NO_PORT) -> Camera:
    """A camera of which only its port and the size of its pictures are known.

    Args:
        size: width and height of its pictures.
        lens: name of a lens model (`freedom.LENSES`).
        port: as far as it is known.
    """
    width, height = size
    middle = {"cx_px": width / 2.0, "cy_px": height / 2.0}
    first = lens_kind(lens)(fx_px=float(width), fy_px=float(width), **middle)
    return Camera(width_px=width, height_px=height, lens=first, port=port)


def first_rig(
    views: Sequence[TargetView], points: Array, blank: Mapping[str, Camera], lens: LensNames
) -> Rig:
    """A rig near the truth from views alone: each camera, then their relative poses.

    Raises:
        CalibrationError: a camera has too few views, or no view joins it to the others.
    """
    cameras = first_cameras(views, points, blank, lens)
    usable, _ = _usable(views, points)
    return Rig(
        cameras=cameras,
        cam_from_rig=first_cam_from_rig(cameras, usable, points),
        body_from_rig=None,
        source="first values",
    )


def first_cameras(
    views: Sequence[TargetView], points: Array, blank: Mapping[str, Camera], lens: LensNames
) -> dict[str, Camera]:
    """Each camera near the truth from its own views, its port held.

    Raises:
        CalibrationError: a camera has too few views.
    """
    usable, _ = _usable(views, points)
    for name in blank:
        count = sum(name in view.pixels for view in usable)
        _check_enough(count, len(views), f" from {name}")
    return {
        name: _alone(name, camera, usable, points, lens_of(lens, name))
        for name, camera in blank.items()
    }


def _alone(
    name: str, blank: Camera, views: Sequence[TargetView], points: Array, lens: str
) -> Camera:
    """One camera's intrinsics, its port held: first its focal length and k1, then all."""
    mine = [
        TargetView(name=v.name, pixels={name: v.pixels[name]}) for v in views if name in v.pixels
    ]
    size = (blank.width_px, blank.height_px)
    focal_px = (
        first_focal_px([v.pixels[name] for v in mine], points, size) / blank.port.magnification
    )
    rig = Rig(
        cameras={name: blank.with_parameters({"fx_px": focal_px, "fy_px": focal_px})},
        cam_from_rig={name: RigidTransform.identity()},
        body_from_rig=None,
        source="first values",
    )
    terms = intrinsics(lens)
    for fields in (PINHOLE, [*PINHOLE, "k1"], terms):
        found = zip(mine, locate_all(rig, mine, points), strict=True)
        located = [(view, pose) for view, pose in found if pose is not None]
        poses = RigidTransform.concatenate([pose for _, pose in located])
        freedom = Freedom(free=of_cameras(rig, [f for f in fields if f in terms]))
        rig = adjust(
            [v for v, _ in located], points, rig, poses, freedom, _ROUGHLY, at_most=_STEPS
        ).rig
    return rig.cameras[name]


def _usable(views: Sequence[TargetView], points: Array) -> tuple[list[TargetView], list[Rejection]]:
    """Views without the pictures that show too little of the target for a pose."""
    usable, rejections = [], []
    for view in views:
        enough = {name: seen for name, seen in view.pixels.items() if spans(seen, points)}
        rejections += [
            _whole_picture(view.name, name, "shows too little of the target for a pose")
            for name in view.pixels
            if name not in enough
        ]
        if enough:
            usable.append(replace(view, pixels=enough))
    return usable, rejections


def _check_served(views: Sequence[TargetView], rig: Rig) -> None:
    for name in rig.cameras:
        if views and not any(name in view.pixels for view in views):
            raise CalibrationError(f"no view shows the target to the camera {name}")


def _check_focal(rig: Rig, poses: RigidTransform) -> None:
    """Reject views that face the same way: they leave the focal length open."""
    for name, sigma in rig.sigmas.items():
        camera, field = name.split(".")
        if field not in ("fx_px", "fy_px"):
            continue
        share = sigma / rig.cameras[camera].parameter(field)
        if share > _LOOSEST_FOCAL:
            normals = poses.rotation.apply([0.0, 0.0, 1.0]).reshape(-1, 3)
            widest = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))
            raise CalibrationError(
                f"{name} is known to {share:.0%} only: the {len(normals)} poses of the target "
                f"differ by {widest:.1f} deg at most: tilt it by 20 to 40 deg about both axes"
            )


def _adjust_without_outliers(
    views: Sequence[TargetView],
    pixels: Array,
    points: Array,
    rig: Rig,
    poses: RigidTransform,
    freedom: Freedom,
    shape: TargetShape,
) -> tuple[Adjustment, Flags, Flags]:
    """Adjust and leave out gross outliers, until that set stays the same.

    Returns:
        The adjustment; which points (V, cameras, N) took part; which views (V,) did.
    """
    measured = np.asarray(np.isfinite(pixels).all(axis=-1))
    kept, alive = measured, np.ones(len(views), dtype=bool)
    blur = np.ones(measured.shape[:2])

    def trim(kept: Flags, alive: Flags) -> list[TargetView]:
        return _views_of(views, np.where(kept[..., None], pixels, np.nan), alive, rig)

    for _ in range(_ROUNDS):
        adjusted = adjust(
            trim(kept, alive), points, rig, poses, freedom, at_most=_STEPS, blur=blur[alive],
            shape=shape,
        )  # fmt: skip
        shaped = points + adjusted.shape.offsets_m
        off = residuals_px(adjusted.rig, adjusted.rig_from_target, shaped, pixels[alive])
        lengths = np.full(measured.shape, np.inf)
        lengths[alive] = np.nan_to_num(np.linalg.norm(off, axis=-1), nan=np.inf)
        found = np.ones_like(blur)
        found[alive] = _blur(adjusted)
        limits = np.maximum(OUTLIER * adjusted.noise_px * found, _MIN_LIMIT_PX)
        fitting = _fitting(measured, kept, measured & (lengths <= limits[..., None]))
        same = np.array_equal(fitting, kept) and np.allclose(found, blur, rtol=_SAME_BLUR)
        if same and adjusted.is_settled:
            return adjusted, kept, alive
        still = alive & fitting.any(axis=(1, 2))
        _check_enough(int(still.sum()), len(views))
        poses = adjusted.rig_from_target[np.flatnonzero(still[alive])]
        rig, kept, alive, blur, shape = adjusted.rig, fitting, still, found, adjusted.shape
    last = adjust(trim(kept, alive), points, rig, poses, freedom, blur=blur[alive], shape=shape)
    return last, kept, alive


def _fitting(measured: Flags, kept: Flags, fits: Flags) -> Flags:
    """Which points take part next, (V, cameras, N).

    Where a picture does not fit, the pose of its view is not a measure for the others yet: of the
    pictures of one view only the worst is left out at a time.
    """
    share = fits.sum(axis=2) / np.maximum(measured.sum(axis=2), 1)
    fitting = np.asarray(fits & (share >= _MIN_FITTING)[..., None])
    served = np.asarray(kept.any(axis=2))
    for v in np.flatnonzero((served & (share < _MIN_FITTING)).any(axis=1)):
        worst = int(np.argmin(np.where(served[v], share[v], np.inf)))
        others = served[v] & (np.arange(len(share[v])) != worst)
        fitting[v] = kept[v] & others[:, None]
    return fitting


def _blur(adjusted: Adjustment) -> Array:
    """Noise of each picture over that of all, (V, cameras); 1 where all are alike by chance.

    Distant targets and moving water blur some pictures more than others; weighted by their noise
    they count more. Noise is the mean square of residuals after Huber's weights, drawn a little
    towards that of all, so that a picture of few points gets no weight by luck.
    """
    pull = (adjusted.weights[..., None] * adjusted.residuals_px) ** 2
    count = 2.0 * np.isfinite(adjusted.weights).sum(axis=2)
    square = np.nansum(pull, axis=(2, 3))
    # Each view's pose takes up six of its coordinates.
    free = count * (1.0 - np.minimum(6.0 / count.sum(axis=1, keepdims=True), 0.9))
    share = np.divide(square, free, out=np.ones_like(square), where=count > 0)
    share[count > 0] /= square.sum() / free.sum()
    seen = count > 0
    chance = np.mean((share[seen] - 1.0) ** 2 * count[seen] / 2.0)
    if chance < _BY_CHANCE:
        return np.ones_like(share)
    drawn = (count * share + _DRAWN) / (count + _DRAWN)
    return np.asarray(np.clip(np.sqrt(drawn), 1.0 / _DULLEST, _DULLEST))


def _views_of(
    views: Sequence[TargetView], pixels: Array, alive: Flags, rig: Rig
) -> list[TargetView]:
    """Some of the views, with pixels (V, cameras, N, 2); cameras that see nothing are absent."""
    seen = np.asarray(np.isfinite(pixels).any(axis=(2, 3)))
    return [
        replace(
            views[v],
            pixels={name: pixels[v, c] for c, name in enumerate(rig.cameras) if seen[v, c]},
        )
        for v in np.flatnonzero(alive).tolist()
    ]


def _rejections(
    views: Sequence[TargetView], pixels: Array, kept: Flags, rig: Rig, adjusted: Adjustment
) -> list[Rejection]:
    """Pictures and points that the adjustment left out."""
    limit = f"{OUTLIER:.0f} sigmas (of {adjusted.noise_px:.2g} px, or of the picture's own noise)"
    rejections, names = [], list(rig.cameras)
    measured = np.isfinite(pixels[..., 0]).sum(axis=2)
    lost = measured - kept.sum(axis=2)
    for v, c in np.argwhere(lost > 0).tolist():
        points, reason = int(lost[v, c]), f"missed by more than {limit}"
        if points == measured[v, c]:
            points, reason = 0, f"fits badly: most of its points miss by more than {limit}"
        rejections.append(
            Rejection(view=views[v].name, camera=names[c], points=points, reason=reason)
        )
    return rejections


def _whole_picture(view: str, camera: str, reason: str) -> Rejection:
    """A picture that takes no part."""
    return Rejection(view=view, camera=camera, points=0, reason=reason)


def _check_enough(usable: int, given: int, camera: str = "") -> None:
    """Refuse too few views.

    Raises:
        CalibrationError: they are fewer than `_MIN_VIEWS`.
    """
    if usable < _MIN_VIEWS:
        of = f" of {given}" if given > usable else ""
        raise CalibrationError(
            f"{usable}{of} views of the target{camera} can be used; at least {_MIN_VIEWS} are "
            "needed: take more, nearer and at more angles"
        )
