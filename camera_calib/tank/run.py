"""Fixed cameras at a tank, from pictures of a board in air and reference points to points in water.

`alice-survey camera tank`: lens, pose and port of each camera, then every detection triangulated,
with figures that say how far the rays miss each other and what is behind it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alice_survey.base.artefacts import (
    Stage,
    read_json,
    read_stage,
    run_stage,
    write_csv,
    write_json,
)
from alice_survey.base.errors import CalibrationError, warn
from alice_survey.base.executor import Executor, local_executor
from alice_survey.base.frames import Array
from camera_calib.freedom import LENSES
from camera_calib.picture_files import is_cut_short, read_pixels
from camera_calib.rig import write_rig
from camera_calib.tank.adjust import (
    Refinement,
    Tank,
    noise_px,
    place_cameras,
    point_covariance,
    refine,
    tank_rig,
)
from camera_calib.tank.clock import Lag, estimate_lags
from camera_calib.tank.files import (
    Detections,
    camera_name,
    read_detections,
    read_reference,
    warn_of_left_out,
)
from camera_calib.tank.plot import draw_tank
from camera_calib.tank.single_lens import LensView, SingleLens, calibrate_single_lens
from camera_calib.tank.text import tank_text
from camera_calib.targets.detect import detect
from camera_calib.targets.target import Target, parse_target
from camera_calib.triangulate import Triangulation

_VERSION = 1
_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
_BLOCKS = 20
"""Held-out detections are every other one of so many stretches of time."""
_TELLING_LAG = 0.5
_STRAINED = 1.5


@dataclass(frozen=True, kw_only=True)
class TankSettings:
    """What to make the points from."""

    boards: tuple[Path, ...]
    """Folders with pictures of the board in air: one for all cameras, or one for each."""
    board: str
    """As `parse_target` reads it."""
    references: tuple[Path, ...]
    """One file for each camera; the first is the rig's reference."""
    detections: Path
    unit: str = "cm"
    """Of the world's coordinates in the reference files."""
    n_water: float = 1.333
    """Fresh water at about 25 C, 589 nm."""
    glass_mm: tuple[float, ...] = ()
    """Wall before each camera; none when empty."""
    n_glass: float = 1.52
    lens: str | None = None
    """One of `LENSES`; chosen by held-out error when None."""
    frame_offsets: tuple[str, ...] = ()
    """Such as `cam1=-2`: added to a camera's frame numbers."""
    refine: bool = True
    """Poses from the detections too; reference points alone are as good as they were clicked."""

    def __post_init__(self) -> None:
        count = len(self.references)
        if count < 2:
            raise CalibrationError(f"{count} reference file: two cameras or more are needed")
        for what, given in (("--boards", len(self.boards)), ("--glass", len(self.glass_mm))):
            if given not in (0, 1, count):
                raise CalibrationError(
                    f"{given} x {what} for {count} cameras: give one for all or one for each"
                )
        names = [camera_name(path) for path in self.references]
        if len(set(names)) != count:
            raise CalibrationError(
                f"reference files of {', '.join(names)}: each camera needs a name of its own before"
                " the first underscore, as in cam1_references.json"
            )
        if not 1.0 <= self.n_water <= 2.0 or not 1.0 <= self.n_glass <= 3.0:
            raise CalibrationError(f"indices {self.n_water} and {self.n_glass} are of no tank")
        if any(not 0.0 <= thickness <= 500.0 for thickness in self.glass_mm):
            raise CalibrationError(f"glass of {self.glass_mm} mm: 0 to 500 mm are allowed")
        if self.lens is not None and self.lens not in LENSES:
            raise CalibrationError(f"no lens model is called {self.lens!r}: {', '.join(LENSES)}")

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, from the reference files."""
        return tuple(camera_name(path) for path in self.references)

    @property
    def offsets(self) -> dict[str, int]:
        """By camera, what to add to its frame numbers."""
        offsets: dict[str, int] = {}
        for text in self.frame_offsets:
            camera, _, frames = text.partition("=")
            try:
                offsets[camera] = int(frames)
            except ValueError:
                raise CalibrationError(
                    f"--frame-offset {text}: write CAMERA=FRAMES, such as cam1=-2"
                ) from None
        return offsets


@dataclass(frozen=True, kw_only=True)
class Misses:
    """Reprojection errors, px: lengths of residuals, and their sum over the cameras."""

    median: dict[str, float]
    mean: dict[str, float]
    sum_median: float
    sum_mean: float
    points: int
    """How many the means are over; medians count points without a solution as infinite."""


def misses(cameras: Sequence[str], residuals_px: Array) -> Misses:
    """Figures of residuals, (C, N, 2), of points that at least two cameras see."""
    lengths = np.linalg.norm(residuals_px, axis=-1)
    solved = np.isfinite(lengths).any(axis=0)
    if not solved.any():
        raise CalibrationError("no detection gives a point in the water: check the reference files")
    sums = np.where(solved, np.nansum(lengths, axis=0), np.inf)
    worst = np.where(solved, lengths, np.inf)
    return Misses(
        median={c: _median(row) for c, row in zip(cameras, worst, strict=True)},
        mean={c: float(np.nanmean(row)) for c, row in zip(cameras, lengths, strict=True)},
        sum_median=_median(sums),
        sum_mean=float(sums[solved].mean()),
        points=int(solved.sum()),
    )


def _median(values: Array) -> float:
    """Median of values that are not NaN, of which less than half may be infinite."""
    return float(np.sort(values[~np.isnan(values)])[np.count_nonzero(~np.isnan(values)) // 2])


def run_tank(
    settings: TankSettings, out: Path, executor: Executor | None = None
) -> tuple[str, dict[str, Any]]:
    """Calibrate the cameras of a tank, triangulate its detections and write the folder `out`.

    It holds `rig.json`, `points.csv`, `tank.json` and `tank.png`; see docs/formats.md.

    Returns:
        A summary to print, and the content of `tank.json`.

    Raises:
        CalibrationError: something given is missing, wrong or does not fit together.
    """
    out = out.absolute()
    if out.exists() and read_stage(out) is None and (not out.is_dir() or any(out.iterdir())):
        raise CalibrationError(f"{out}: is there and was not written by this command; name another")
    if out.is_dir() and read_stage(out) is None:
        out.rmdir()
    names = ("boards", "references", "detections")
    stage = Stage(
        name=out.name,
        version=_VERSION,
        settings={k: v for k, v in asdict(settings).items() if k not in names}
        | {"cameras": settings.cameras},
        inputs=[*settings.boards, *settings.references, settings.detections],
    )
    run_stage(out.parent, stage, lambda folder: _work(settings, folder, executor))
    summary: dict[str, Any] = read_json(out / "tank.json")
    return tank_text(summary), summary


def _work(settings: TankSettings, folder: Path, executor: Executor | None) -> None:
    executor = executor or local_executor()
    references = [read_reference(path, settings.unit) for path in settings.references]
    detections = read_detections(settings.detections, settings.cameras, settings.offsets)
    warn_of_left_out(settings.detections, detections)
    target = parse_target(settings.board)
    by_folder = {
        path: _lens(path, target, settings.lens, executor)
        for path in dict.fromkeys(settings.boards)
    }
    count = len(references)
    lenses = [by_folder[path] for path in settings.boards] * (count // len(settings.boards))
    walls = list(settings.glass_mm or (0.0,)) * (count // max(len(settings.glass_mm), 1))
    placed = place_cameras(
        lenses,
        references,
        n_water=settings.n_water,
        glass_thickness_m=[1e-3 * wall for wall in walls],
        n_glass=settings.n_glass,
    )
    tank, refined = placed, None
    if settings.refine:
        refined = refine(placed, detections.pixels)
        tank = refined.tank
        _warn_of_strain(tank)
    found = tank.triangulate(detections.pixels)
    sigma_px = noise_px(found)
    found = tank.triangulate(detections.pixels, sigma_px)
    lags = estimate_lags(tank, detections, found)
    _warn_of(lags, settings.offsets, found)
    covariance = point_covariance(tank, found)
    write_rig(folder / "rig.json", tank_rig(tank, _source(settings)))
    _write_points(folder / "points.csv", settings.cameras, detections, found, covariance)
    lens_names = {path.name: lens for path, lens in by_folder.items()}
    summary: dict[str, Any] = {
        "format": "alice-survey tank",
        "version": 1,
        "lenses": {name: _lens_json(lens) for name, lens in lens_names.items()},
        "cameras": {camera.name: _camera_json(tank, i) for i, camera in enumerate(tank.cameras)},
        "reference_sigma_px": tank.reference_sigma_px,
        "detections": {
            "points": len(detections.frames),
            "in_water": int(np.isfinite(found.points_world).all(axis=1).sum()),
            "without_partner": detections.alone,
            "not_numbers": detections.not_numbers,
            "repeated": detections.doubled,
            "sigma_px": sigma_px,
        },
        "error_px": _errors(settings, placed, detections, found, refined),
        "lags": [asdict(lag) for lag in lags],
        "sigma_mm": _median_sigmas_mm(found, covariance),
    }
    write_json(folder / "tank.json", summary)
    draw_tank(folder / "tank.png", tank, detections, found)


def _errors(
    settings: TankSettings,
    placed: Tank,
    detections: Detections,
    found: Triangulation,
    refined: Refinement | None,
) -> dict[str, Any]:
    """Reprojection errors with poses from reference points, and of the refinement, held out too."""
    first = found if refined is None else placed.triangulate(detections.pixels)
    errors = {"poses_from_reference_points": _both(settings, first)}
    if refined is not None:
        errors["poses_refined"] = _both(settings, found)
        moments = np.unique(detections.frames)
        block = np.searchsorted(moments, detections.frames) * _BLOCKS // len(moments)
        odd = block % 2 == 1
        half = refine(placed, detections.pixels[:, ~odd]).tank
        held_out = half.triangulate(detections.pixels[:, odd])
        errors["poses_refined_on_other_half"] = _both(settings, held_out)
    return errors


def _both(settings: TankSettings, found: Triangulation) -> dict[str, Any]:
    return {
        "least_squares": asdict(misses(settings.cameras, found.residuals_px)),
        "midpoint": asdict(misses(settings.cameras, found.nearest_residuals_px)),
    }


def _lens(folder: Path, target: Target, model: str | None, executor: Executor) -> SingleLens:
    """Find the board in every picture of a folder and calibrate the lens."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder of pictures")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _PICTURES)
    if not paths:
        raise CalibrationError(f"{folder}: no pictures ({' '.join(_PICTURES)})")
    jobs = [(path, target) for path in paths]
    looked = list(executor.map(_look, jobs, label="board corners"))
    sizes = {size for size, _ in looked}
    if len(sizes) > 1:
        several = ", ".join(f"{width} x {height}" for width, height in sorted(sizes))
        raise CalibrationError(f"{folder}: pictures of several sizes ({several} px): part them")
    found = [(path, pixels) for path, (_, pixels) in zip(paths, looked, strict=True)]
    views = [LensView(name=p.stem, pixels=pixels) for p, pixels in found if pixels is not None]
    if not views:
        raise CalibrationError(
            f"{folder}: the board was found in none of {len(paths)} pictures; check --board"
        )
    if len(views) < len(paths):
        lacking = ", ".join(path.stem for path, pixels in found if pixels is None)
        warn(f"{folder}: no board found in {len(paths) - len(views)} pictures: {lacking}")
    models = tuple(LENSES) if model is None else (model,)
    lens = calibrate_single_lens(views, target.points, sizes.pop(), models, executor)
    if lens.rejected:
        told = ", ".join(f"{name} ({rms:.2f} px rms)" for name, rms in lens.rejected.items())
        warn(f"{folder}: pictures left out that fit far worse than the others: {told}")
    return lens


def _look(job: tuple[Path, Target]) -> tuple[tuple[int, int], Array | None]:
    path, target = job
    picture = None if is_cut_short(path) else read_pixels(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CalibrationError(f"{path}: cannot be decoded to its end: leave it out")
    height, width = picture.shape
    return (int(width), int(height)), detect(target, picture)


def _warn_of(lags: Sequence[Lag], offsets: Mapping[str, int], found: Triangulation) -> None:
    for lag in lags:
        if abs(lag.frames) > max(_TELLING_LAG, 3 * lag.sigma):
            late = "later" if lag.frames > 0 else "earlier"
            offset = offsets.get(lag.camera, 0) + round(lag.frames)
            warn(
                f"{lag.camera} took its pictures {abs(lag.frames):.1f} frames {late} than the first"
                f" camera: pair equal moments with --frame-offset {lag.camera}={offset}"
            )
    lost = int(np.isnan(found.points_world).any(axis=1).sum())
    if lost:
        warn(f"{lost} detections meet nowhere in the water; their rows are empty")


def _warn_of_strain(tank: Tank) -> None:
    """Tell where the refinement left the reference points farther than their sigma allows."""
    usual = float(np.sqrt(2.0)) * tank.reference_sigma_px
    for camera in tank.cameras:
        if camera.reference_rms_px > _STRAINED * usual:
            warn(
                f"{camera.name}: the refined pose misses the reference points by "
                f"{camera.reference_rms_px:.1f} px rms, where {usual:.1f} would be usual: they and "
                "the detections disagree, as when clocks are apart"
            )


def _source(settings: TankSettings) -> str:
    poses = "reference points and detections" if settings.refine else "reference points"
    return f"board in air, poses from {poses} on the interface; the body is the reference's world"


def _lens_json(lens: SingleLens) -> dict[str, Any]:
    return {
        "model": lens.chosen.name,
        "views": len(lens.views),
        "rejected": dict(lens.rejected),
        "models": [asdict(model) for model in lens.tried],
    }


def _camera_json(tank: Tank, i: int) -> dict[str, Any]:
    camera = tank.cameras[i]
    return {
        "lens": tank.distinct_lenses.index(tank.lenses[i]),
        "position_world_m": camera.position_world.tolist(),
        "port_distance_m": camera.camera.port_distance_m,
        "tilt_deg": float(np.degrees(np.arccos(camera.camera.normal[2]))),
        "reference_rms_px": camera.reference_rms_px,
        "reference_residuals_px": camera.reference_residuals_px.tolist(),
    }


def _median_sigmas_mm(found: Triangulation, covariance: Array) -> Mapping[str, list[float]]:
    solved = np.isfinite(found.points_world).all(axis=1)
    whole = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return {
        "of_pixels": (1e3 * np.median(found.sigmas_m[solved], axis=0)).tolist(),
        "with_cameras": (1e3 * np.median(whole[solved], axis=0)).tolist(),
    }


def _write_points(
    path: Path,
    cameras: Sequence[str],
    detections: Detections,
    found: Triangulation,
    covariance: Array,
) -> None:
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    lengths = np.linalg.norm(found.residuals_px, axis=-1)
    nearest = np.linalg.norm(found.nearest_residuals_px, axis=-1)
    header = ["frame", "id", "candidates", "x_m", "y_m", "z_m"]
    header += ["sigma_x_m", "sigma_y_m", "sigma_z_m"]
    for name in cameras:
        header += [f"{name}_x_px", f"{name}_y_px", f"{name}_error_px", f"{name}_midpoint_error_px"]

    def row(i: int) -> list[Any]:
        cells: list[Any] = [detections.frames[i], detections.ids[i], detections.candidates[i]]
        cells += [round(float(x), 7) for x in (*found.points_world[i], *sigmas[i])]
        for c in range(len(cameras)):
            values = (*detections.pixels[c, i], lengths[c, i], nearest[c, i])
            cells += [round(float(value), 4) for value in values]
        return cells

    write_csv(path, header, (row(i) for i in range(len(detections.frames))))
