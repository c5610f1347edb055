"""Time, memory and disk that imaging and reconstruction will take, from settings and pictures.

The computing of a stage is a sum of non-negative coefficients times what drives it: pictures,
megapixels as taken and as matched, cells of the surface. The part that runs as tasks is shared out
among workers, the rest is serial; memory and disk are sums of the same kind. `computing.toml` holds
the coefficients, which `python -m benchmarks.costs` measures on one machine; a short probe compares
this one with it, and what stages of a survey have taken here corrects what is left.
"""

import contextlib
import json
import math
import os
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import StageRecord, read_json, write_json
from alice_survey.core.config import (
    CameraConfig,
    ImagingConfig,
    ReconstructConfig,
    SeafloorConfig,
    SurveyConfig,
)
from alice_survey.core.executor import default_threads
from alice_survey.core.manifest import read_manifest
from alice_survey.core.run.resources import processor
from alice_survey.kit.words import count, duration
from reconstruct.dense.scales import CELL_PIXELS, matching_scale, scale_for_cell

PREDICTED = ("pool", "image", "calibrate", "mapping", "placing", "dense", "mosaic", "mesh")
"""Stages whose cost is known; the others take little."""
GROUPS = {"image": PREDICTED[:2], "calibrate and reconstruct": PREDICTED[2:]}
"""What a plan shows, and the stages of it."""
BOARD_STAGES = ("pool", "calibrate")
"""Those whose tasks are pictures of a board."""
OTHER_CORES = 16
FEATURE_MPX, PIXELS_PER_FEATURE = 1.5, 100.0
"""Most megapixels in which features are sought, and pixels for each that is wanted, if a rig is
known."""
_FOUND_PER_MPX = 28_000
"""Features of a picture of rich texture: one for 36 pixels, on rendered sand."""
_LOOKS = 6.0
"""Pictures in which a place is seen, where no plan says so."""
_CAMERAS = 2
_COMPILE_S = 60
"""Computing of the first run after an installation, which compiles kernels."""


@dataclass(frozen=True, kw_only=True)
class SurveySize:
    """What drives the cost of a survey; areas in millions of cells or pixels."""

    pictures: int
    mpx: float
    """Megapixels of a picture as taken."""
    feature_mpx: float
    features: float
    """To expect in a picture."""
    matched_mpx: float
    refined_mpx: float
    """Megapixels at which dense matching runs, and at which its depth is refined and kept."""
    partners: int = 4
    """Pictures that each is densely matched with."""
    cells: float
    mosaic_mpx: float
    floor_cells: float = 0.0
    """Of a sea floor to render."""
    rig_known: bool = True
    """Whether the cameras are calibrated."""
    board_pictures: int = 0
    samples: int = 2
    board_samples: int = 3
    """Rays for a pixel rendered of the sea floor and of a board, along each side."""
    pixel_m: float | None = None
    cell_m: float | None = None
    """Sides of a pixel on the ground and of a cell, where they are known."""

    @property
    def drivers(self) -> dict[str, float]:
        """What coefficients are multiplied by, by name."""
        rays, board_rays = (self.samples / 2) ** 2, (self.board_samples / 3) ** 2
        return {
            "once": 1.0,
            "picture_mpx": self.mpx,
            "refined_picture_mpx": self.refined_mpx,
            "board_pictures": self.board_pictures,
            "board_mpx": self.board_pictures * self.mpx,
            "board_rays": self.board_pictures * self.mpx * board_rays,
            "board_rays_large": self.board_pictures * self.mpx**1.5 * board_rays,
            "floor_cells": self.floor_cells,
            "pictures": self.pictures,
            "uncalibrated_pictures": 0 if self.rig_known else self.pictures,
            "rendered_mpx": self.pictures * self.mpx * rays,
            "taken_mpx": self.pictures * self.mpx,
            "feature_mpx": self.pictures * self.feature_mpx,
            "kilofeatures": self.pictures * self.features / 1e3,
            "compared": self.pictures * (self.features / 1e3) ** 2,
            "matched_mpx": self.pictures * self.matched_mpx * self.partners / 4,
            "refined_mpx": self.pictures * self.refined_mpx,
            "cells": self.cells,
            "mosaic_mpx": self.mosaic_mpx,
        }


def size_of(
    pictures: int,
    mpx: float,
    reconstruct: ReconstructConfig,
    *,
    rig_known: bool = True,
    pixel_m: float | None = None,
    area_m2: float | None = None,
    **others: Any,
) -> SurveySize:
    """The size of a survey, from its pictures and settings.

    Args:
        pictures: their number.
        mpx: megapixels of each.
        reconstruct: settings.
        rig_known: whether the cameras are calibrated; features are sought in more pixels if not.
        pixel_m: side of a pixel on the ground, if known.
        area_m2: area in the pictures, if known; else each place is taken to be in six of them.
        others: further fields of `SurveySize`.
    """
    maximum = reconstruct.max_features
    wanted = PIXELS_PER_FEATURE / 1e6 * maximum if rig_known else math.inf
    feature_mpx = min(mpx, FEATURE_MPX, wanted)
    if reconstruct.feature_scale is not None:
        feature_mpx = mpx * reconstruct.feature_scale**2
    cell_m, scale = reconstruct.dem_cell_m, reconstruct.dense_scale
    if scale is None:
        scale = 1.0 if pixel_m is None else scale_for_cell(cell_m, pixel_m)
    refined_mpx = mpx * scale**2
    matched_mpx = mpx * matching_scale(1e6 * mpx, scale) ** 2
    cells = pictures * refined_mpx / (_LOOKS * CELL_PIXELS**2)
    mosaic_mpx = pictures * mpx / _LOOKS
    if pixel_m is not None:
        cell_m = cell_m or CELL_PIXELS * pixel_m * math.sqrt(mpx / refined_mpx)
        area_m2 = pictures * mpx * 1e6 * pixel_m**2 / _LOOKS if area_m2 is None else area_m2
        cells = area_m2 / cell_m**2 / 1e6
        mosaic_mpx = area_m2 / (reconstruct.mosaic_pixel_m or pixel_m) ** 2 / 1e6
    return SurveySize(
        pictures=pictures, mpx=mpx, rig_known=rig_known, feature_mpx=feature_mpx,
        features=min(maximum, _FOUND_PER_MPX * feature_mpx),
        matched_mpx=matched_mpx, refined_mpx=refined_mpx, partners=reconstruct.dense_partners,
        cells=cells, mosaic_mpx=mosaic_mpx, pixel_m=pixel_m, cell_m=cell_m, **others,
    )  # fmt: skip


def planned_size(
    plan: Mapping[str, Any],
    camera: CameraConfig,
    imaging: ImagingConfig,
    seafloor: SeafloorConfig,
    reconstruct: ReconstructConfig,
    *,
    pictures: int | None = None,
) -> SurveySize:
    """The size of a planned survey.

    Args:
        plan: the contents of `plan.json`.
        camera: settings, as the other sections.
        imaging: its scale is that of the pictures.
        seafloor: to render.
        reconstruct: how.
        pictures: their number, once they are taken; None for as many as are planned.
    """
    import shapely

    strips = [shapely.LineString([line["start_ne_m"], line["end_ne_m"]]) for line in plan["lines"]]
    reach_m = plan["footprint_m"][0] / 2
    seen = shapely.union_all(shapely.buffer(strips, reach_m, cap_style="square"))
    south, west, north, east = shapely.geometry.shape(plan["area"]["allowed"]).bounds
    margin_m = 2 * plan["altitude_m"]
    floor_m2 = (north - south + margin_m) * (east - west + margin_m)
    return size_of(
        pictures or _CAMERAS * plan["stations"],
        (camera.width_px // imaging.scale) * (camera.height_px // imaging.scale) / 1e6,
        reconstruct,
        pixel_m=imaging.scale * plan["details"]["imaging"]["pixel_m"],
        area_m2=seen.area,
        floor_cells=floor_m2 / seafloor.grid_m**2 / 1e6,
        board_pictures=_CAMERAS * imaging.pool_views,
        samples=imaging.samples,
        board_samples=imaging.samples + (imaging.scale > 1),
    )


def workspace_size(
    workspace: Path,
    camera: CameraConfig,
    imaging: ImagingConfig,
    seafloor: SeafloorConfig,
    reconstruct: ReconstructConfig,
) -> SurveySize | None:
    """The size of the survey of a workspace; None while it has neither a plan nor pictures.

    Args:
        workspace: folder of the survey.
        camera: settings, as the other sections.
        imaging: its scale counts until there are pictures.
        seafloor: to render.
        reconstruct: how.
    """
    manifest, plan = workspace / "images" / "manifest.csv", workspace / "plan" / "plan.json"
    rows = read_manifest(manifest) if manifest.is_file() else []
    width, height = camera.width_px // imaging.scale, camera.height_px // imaging.scale
    if rows:
        from PIL import Image

        with Image.open(manifest.parent / rows[0].image) as picture:
            width, height = picture.size
    if plan.is_file():
        scale = max(1, round(camera.width_px / width))
        return planned_size(
            read_json(plan), camera, imaging.model_copy(update={"scale": scale}), seafloor,
            reconstruct, pictures=len(rows) or None,
        )  # fmt: skip
    if not rows:
        return None
    rigs = (workspace / folder / "rig.json" for folder in ("calibration", "images"))
    known = any(rig.is_file() for rig in rigs)
    return size_of(len(rows), width * height / 1e6, reconstruct, rig_known=known)


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """What a stage takes; times on the machine at hand."""

    serial_s: float
    tasks_s: float
    """Computing outside of tasks, and in all of them."""
    start_s: float = 0.0
    """For the start of each worker, all at once, where there is more than one."""
    tasks: int
    """How many there are at least: more workers have nothing to do."""
    process_mib: float
    worker_mib: float
    """Most memory of the process, and of each worker next to it."""
    product_mb: float
    scratch_mb: float
    """Disk for good, and what is removed at its end."""

    def cpu_s(self, workers: int) -> float:
        """All computing."""
        busy = min(workers, self.tasks)
        return self.serial_s + self.tasks_s + (busy * self.start_s if busy > 1 else 0.0)

    def time_s(self, workers: int) -> float:
        """How long it takes with some workers, each on a core of its own."""
        busy = min(workers, self.tasks)
        return self.serial_s + self.tasks_s / busy + (self.start_s if busy > 1 else 0.0)

    def memory_mib(self, workers: int) -> float:
        """Most memory at once; a single worker is the process itself."""
        return self.process_mib + min(workers, self.tasks) * self.worker_mib

    def scaled(self, factor: float) -> "StageCost":
        """The same with more computing."""
        return replace(
            self,
            serial_s=factor * self.serial_s,
            tasks_s=factor * self.tasks_s,
            start_s=factor * self.start_s,
        )


def model() -> dict[str, Any]:
    """The measured coefficients."""
    text = (resources.files("alice_survey") / "computing.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def weighed(coefficients: Mapping[str, float], drivers: Mapping[str, float]) -> float:
    """Sum of coefficients times drivers."""
    return sum(value * drivers[name] for name, value in coefficients.items())


def stage_costs(
    size: SurveySize, slowness: float = 1.0, measured: Mapping[str, Any] | None = None
) -> dict[str, StageCost]:
    """What each stage takes.

    Args:
        size: of the survey.
        slowness: time that this machine takes for what the machine of the coefficients does in 1.
        measured: the coefficients; None for those of the package.
    """
    drivers = size.drivers
    found = {}
    for stage, part in (model() if measured is None else measured)["stages"].items():
        sums = {name: weighed(values, drivers) for name, values in part.items()}
        found[stage] = StageCost(
            serial_s=slowness * sums["serial_s"],
            tasks_s=slowness * sums["tasks_s"],
            start_s=slowness * sums["start_s"],
            tasks=max(1, size.board_pictures if stage in BOARD_STAGES else size.pictures),
            process_mib=sums["process_mib"],
            worker_mib=sums["worker_mib"],
            product_mb=sums["product_mb"],
            scratch_mb=sums["scratch_mb"],
        )
    return found


def task_memory_mib(stage: str, workspace: Path, config: SurveyConfig) -> float:
    """What a process that runs tasks of a stage takes; 0 where it is not known."""
    if stage not in PREDICTED:
        return 0.0
    try:
        size = workspace_size(
            workspace, config.camera, config.imaging, config.seafloor, config.reconstruct
        )
    except OSError:  # of a picture, which the stage reports
        return 0.0
    return 0.0 if size is None else stage_costs(size)[stage].worker_mib


@dataclass(frozen=True, kw_only=True)
class SurveyCost:
    """What some stages of a survey take together."""

    stages: Mapping[str, StageCost]
    workers: int
    """Cores at hand, or workers of a cluster."""

    def time_s(self, workers: int) -> float:
        """How long they take, one after the other."""
        return sum(cost.time_s(workers) for cost in self.stages.values())

    def memory_mib(self, workers: int) -> float:
        """The most that one of them takes."""
        return max(cost.memory_mib(workers) for cost in self.stages.values())

    def cpu_s(self, workers: int) -> float:
        """All computing."""
        return sum(cost.cpu_s(workers) for cost in self.stages.values())

    @property
    def disk_mb(self) -> float:
        """All products, with the most that a stage removes at its end."""
        kept = sum(cost.product_mb for cost in self.stages.values())
        return kept + max(cost.scratch_mb for cost in self.stages.values())

    def text(self, unit: str = "core") -> str:
        """In a line, by the name of what works."""
        many = self.workers
        other = f" ({duration(self.time_s(OTHER_CORES))} on {OTHER_CORES})"
        return (
            f"about {duration(self.time_s(many))} on {count(many, unit)}"
            f"{'' if many == OTHER_CORES else other}, "
            f"{_rounded(self.memory_mib(many) / 1024)} GiB of memory"
            f"{' in all' if unit == 'worker' else ''}, "
            f"{_rounded(self.disk_mb / 1e3)} GB of disk"
        )

    def to_json(self) -> dict[str, Any]:
        """As commands print it."""
        workers = sorted({self.workers, OTHER_CORES})
        return {
            "stages": list(self.stages),
            "workers": self.workers,
            "cpu_s": round(self.cpu_s(self.workers)),
            "time_s": {str(n): round(self.time_s(n)) for n in workers},
            "memory_mib": {str(n): round(self.memory_mib(n)) for n in workers},
            "disk_mb": round(self.disk_mb),
        }


def correction(
    costs: Mapping[str, StageCost], records: Mapping[str, StageRecord], here: str, workers: int
) -> tuple[float, float, list[str]]:
    """How much more computing to expect than predicted, from stages that ran on a processor.

    What is wrong with a prediction is in part common to all stages (the machine, the sea floor) and
    in part each stage's own. Of equal variances, on logarithms, n stages show n / (n + 1) of the
    common part.

    Args:
        costs: as predicted.
        records: of finished stages, by their names.
        here: name of the processor.
        workers: how many they are taken to have had.

    Returns:
        Measured over predicted computing of these stages, the factor to expect of others, and
        their names; 1 and 1 where none has run.
    """
    ran = {
        name: record.cpu_s
        for name, record in records.items()
        if name in costs and record.processor == here and record.cpu_s
    }
    if not ran:
        return 1.0, 1.0, []
    ratio = sum(ran.values()) / sum(costs[name].cpu_s(workers) for name in ran)
    return ratio, ratio ** (len(ran) / (len(ran) + 1)), list(ran)


def slowness() -> float:
    """Time that a core of this machine takes for what that of the coefficients does in 1.

    Measured once for each kind of processor, in about a second, and kept in the user's cache.
    """
    file, here = _cache_folder() / "speed.json", processor()
    known: dict[str, float] = {}
    with contextlib.suppress(OSError, ValueError):
        known = json.loads(file.read_text(encoding="utf-8"))
    if here not in known:
        known[here] = round(probe_s(), 4)
        with contextlib.suppress(OSError):  # next time it is measured again
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, known)
    return known[here] / float(model()["probe_s"])


def probe_s() -> float:
    """Processor time of a little work of the kinds that stages do, s: the least of two runs."""
    import cv2
    import numpy as np

    rng = np.random.default_rng(0)
    grey = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), np.uint8), (0, 0), 2.0)
    grey = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX)
    rows = rng.random((1500, 128), np.float32)
    grid = rng.random((700, 700))
    matcher = cv2.StereoSGBM.create(0, 64, 5)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        times = []
        for _ in range(2):
            began_s = time.thread_time()
            cv2.SIFT.create().detectAndCompute(grey, None)
            matcher.compute(grey, np.roll(grey, -9, axis=1))
            (rows @ rows.T).argmax(axis=1)
            np.sort(np.sqrt(grid * grid + 1.0), axis=1)
            times.append(time.thread_time() - began_s)
    finally:
        cv2.setNumThreads(threads)
    return min(times)


def _cache_folder() -> Path:
    """Where this program keeps what it can find again."""
    name = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
    return Path(os.environ.get(name) or Path.home() / ".cache") / "alice-survey"


def kernels_are_compiled() -> bool:
    """Whether there are kept kernels of the reconstruction; True where that is not known."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or str(resources.files("reconstruct")))
    return not os.access(folder, os.W_OK) or any(folder.rglob("*.nbi"))


def summary(
    size: SurveySize,
    groups: Mapping[str, Sequence[str]],
    *,
    workers: int | None = None,
    records: Mapping[str, StageRecord] | None = None,
) -> tuple[str, dict[str, Any]]:
    """What stages of a survey will take here, as lines of text and as JSON values.

    Args:
        size: of the survey.
        groups: names of stages, by what a line calls them.
        workers: of a cluster; None for the cores at hand.
        records: of finished stages of this survey, whose measured cost corrects the rest.
    """
    costs = stage_costs(size, slowness())
    cores = default_threads()
    ratio, factor, ran = correction(costs, records or {}, processor(), cores)
    found: dict[str, Any] = {}
    lines = []
    for name, stages in groups.items():
        chosen = {stage: costs[stage].scaled(factor) for stage in stages}
        group = SurveyCost(stages=chosen, workers=workers or cores)
        found[name] = group.to_json()
        lines.append(f"{name}: {group.text('worker' if workers else 'core')}")
    if lines and size.pixel_m is not None and size.cell_m is not None:
        lines[-1] += f"; {1e3 * size.pixel_m:.2g} mm pixels, {1e3 * size.cell_m:.2g} mm surface"
    if lines and ran:
        found |= {"measured_over_predicted": round(ratio, 3), "corrected_by": round(factor, 3)}
        lines[-1] += (
            f"; {', '.join(ran)} took {ratio:.2f} of what was predicted: corrected by {factor:.2f}"
        )
    if lines and not kernels_are_compiled():
        found["compile_s"] = _COMPILE_S
        lines[-1] += f"; the first run also compiles for about {_COMPILE_S} s"
    return "\n".join(lines), found


def _rounded(value: float) -> str:
    """Two significant digits, without an exponent."""
    digits = 1 - math.floor(math.log10(max(value, 0.01)))
    return f"{round(value, digits):.{max(0, digits)}f}"
