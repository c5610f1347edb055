"""Time, memory and disk that imaging and reconstruction will take: one table, and what ran here.

The computing of a stage is a start, a time per picture and a time per megapixel (`COSTS`), measured
on an Intel Xeon at 2 GHz. The part that runs as tasks is shared out among workers. What stages of a
survey have taken here corrects what is left.
"""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import StageRecord, read_json
from alice_survey.core.config import CameraConfig, ImagingConfig, ReconstructConfig
from alice_survey.core.contents import taken_from
from alice_survey.core.errors import AliceError
from alice_survey.core.executor import default_threads
from alice_survey.core.manifest import read_manifest
from alice_survey.core.run.resources import processor
from alice_survey.kit.words import count, digits, duration

OTHER_CORES = 16
_CAMERAS = 2


class _Cost(NamedTuple):
    """What a stage takes: seconds of processor time, MiB of memory and MB of disk."""

    start_s: float
    picture_s: float
    mpx_s: float
    """For each picture, and each megapixel of all pictures as the stage works on them."""
    serial: float
    """Share of these two that is not divided among workers."""
    process_mib: float
    picture_mib: float
    """Of the process, and more for each picture."""
    worker_mib: float
    worker_mpx_mib: float
    """Of a worker, and more for each megapixel of a picture."""
    product_mb: float
    scratch_mb: float
    """For each megapixel: what stays, and what is removed at the end."""


COSTS = {
    #                 start pic.s   Mpx s  ser. process MiB worker MiB  MB kept, scratch
    "pool": _Cost(0.4, 0.0, 1.08, 0.0, 70, 0.0, 273, 208, 1.05, 0.0),
    "image": _Cost(3.1, 0.0076, 2.56, 0.002, 242, 0.0, 396, 160, 1.93, 0.0),
    "calibrate": _Cost(9.8, 0.0, 0.142, 0.04, 620, 0.0, 0, 159, 0.05, 0.0),
    "mapping": _Cost(3.4, 0.92, 0.02, 0.2, 811, 3.9, 0, 26.8, 0.33, 1.94),
    "placing": _Cost(1.7, 0.305, 0.0, 0.44, 798, 1.91, 0, 45.4, 0.3, 0.0),
    "dense": _Cost(1.5, 0.44, 2.52, 0.03, 414, 0.0, 189, 158, 1.28, 9.09),
    "mosaic": _Cost(6.9, 0.0027, 0.333, 0.13, 600, 0.0, 158, 50.6, 0.54, 0.56),
    "mesh": _Cost(3.2, 0.0, 1.08, 0.08, 198, 0.0, 398, 176, 1.13, 0.99),
}
"""Measured on surveys of 0.25 to 9 megapixels a picture; within a factor of 1.7 of each stage."""
PREDICTED = tuple(COSTS)
"""Stages whose cost is known; the others take little."""
GROUPS = {"image": PREDICTED[:2], "calibrate and reconstruct": PREDICTED[2:]}
"""What a plan shows, and the stages of it."""
_OF_BOARD = ("pool", "calibrate")
_OF_SURFACE = ("dense", "mesh")


@dataclass(frozen=True, kw_only=True)
class SurveySize:
    """What drives the cost of a survey."""

    pictures: int
    mpx: float
    """Megapixels of a picture as taken."""
    refined_mpx: float
    """Those at which its depth is found."""
    board_pictures: int = 0


def size_of(
    pictures: int,
    mpx: float,
    settings: ReconstructConfig,
    *,
    board_pictures: int = 0,
    pixel_m: float | None = None,
) -> SurveySize:
    """The size of a survey.

    Args:
        pictures: their number.
        mpx: megapixels of each.
        settings: of the surface.
        board_pictures: those of a board, to calibrate from.
        pixel_m: side of a pixel on the ground, if known.
    """
    scale = settings.dense_scale
    if scale is None:
        scale = 1.0
        if pixel_m is not None and settings.dem_cell_m is not None:
            from reconstruct.dense.matching_trial import scale_for_cell

            scale = scale_for_cell(settings.dem_cell_m, pixel_m)
    return SurveySize(
        pictures=pictures, mpx=mpx, refined_mpx=mpx * scale**2, board_pictures=board_pictures
    )


def workspace_size(
    workspace: Path, camera: CameraConfig, imaging: ImagingConfig, settings: ReconstructConfig
) -> SurveySize | None:
    """The size of a workspace's survey; None while it has no plan and no pictures to be read.

    Args:
        workspace: folder of the survey.
        camera: its pictures as designed.
        imaging: their scale, which counts until there are pictures.
        settings: of the surface.
    """
    with contextlib.suppress(AliceError, OSError):  # of damage, which the stages report
        return _size_of_files(workspace, camera, imaging, settings)
    return None


def _size_of_files(
    workspace: Path, camera: CameraConfig, imaging: ImagingConfig, settings: ReconstructConfig
) -> SurveySize | None:
    manifest, plan_file = workspace / "images" / "manifest.csv", workspace / "plan" / "plan.json"
    rows = read_manifest(manifest) if manifest.is_file() else []
    width, height = (side // imaging.scale for side in (camera.width_px, camera.height_px))
    if rows:
        from PIL import Image

        with Image.open(manifest.parent / rows[0].image) as picture:
            width, height = picture.size
    if plan_file.is_file():
        plan = read_json(plan_file)
        scale = max(1, round(camera.width_px / width))
        with taken_from(plan_file):
            return size_of(
                len(rows) or _CAMERAS * plan["stations"], width * height / 1e6, settings,
                board_pictures=_CAMERAS * imaging.pool_views,
                pixel_m=scale * plan["details"]["imaging"]["pixel_m"],
            )  # fmt: skip
    return size_of(len(rows), width * height / 1e6, settings) if rows else None


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """What a stage takes; times on the machine at hand."""

    serial_s: float
    tasks_s: float
    """Computing outside of tasks, and in all of them."""
    tasks: int
    """How many there are at least: more workers have nothing to do."""
    process_mib: float
    worker_mib: float
    """Most memory of the process, and of each worker next to it."""
    product_mb: float
    scratch_mb: float
    """Disk for good, and what is removed at its end."""

    @property
    def cpu_s(self) -> float:
        """All computing."""
        return self.serial_s + self.tasks_s

    def time_s(self, workers: int) -> float:
        """How long it takes with some workers, each on a core of its own."""
        return self.serial_s + self.tasks_s / min(workers, self.tasks)

    def memory_mib(self, workers: int) -> float:
        """Most memory at once; a single worker is the process itself."""
        return self.process_mib + min(workers, self.tasks) * self.worker_mib

    def scale(self, factor: float) -> "StageCost":
        """The same with more computing."""
        return replace(self, serial_s=factor * self.serial_s, tasks_s=factor * self.tasks_s)


def stage_costs(size: SurveySize) -> dict[str, StageCost]:
    """What each stage takes of a survey of some size."""
    found = {}
    for stage, cost in COSTS.items():
        pictures = size.board_pictures if stage in _OF_BOARD else size.pictures
        mpx = pictures * (size.refined_mpx if stage in _OF_SURFACE else size.mpx)
        work_s = cost.picture_s * pictures + cost.mpx_s * mpx
        found[stage] = StageCost(
            serial_s=cost.start_s + cost.serial * work_s,
            tasks_s=(1.0 - cost.serial) * work_s,
            tasks=max(1, pictures),
            process_mib=cost.process_mib + cost.picture_mib * size.pictures,
            worker_mib=cost.worker_mib + cost.worker_mpx_mib * size.mpx,
            product_mb=cost.product_mb * mpx,
            scratch_mb=cost.scratch_mb * mpx,
        )
    return found


def task_memory_mib(stage: str, *survey: Any) -> float:
    """What a process that runs tasks of a stage takes, of a survey as `workspace_size` has it.

    0 where it is not known.
    """
    size = workspace_size(*survey) if stage in PREDICTED else None
    return 0.0 if size is None else stage_costs(size)[stage].worker_mib


def total_cost(costs: Iterable[StageCost], workers: int) -> dict[str, float]:
    """Time of stages one after the other, the most memory that one takes, and their disk.

    The disk holds all products, with the most that a stage removes at its end.
    """
    costs = list(costs)
    return {
        "time_s": sum(cost.time_s(workers) for cost in costs),
        "memory_mib": max(cost.memory_mib(workers) for cost in costs),
        "disk_mb": sum(cost.product_mb for cost in costs) + max(cost.scratch_mb for cost in costs),
    }


def correction(
    costs: Mapping[str, StageCost], records: Mapping[str, StageRecord], here: str
) -> tuple[float, float, list[str]]:
    """How much more computing to expect than predicted, from stages that ran on a processor.

    What is wrong with a prediction is in part common to all stages (the machine, the sea floor) and
    in part each stage's own. Of equal variances, on logarithms, n stages show n / (n + 1) of the
    common part.

    Args:
        costs: as predicted.
        records: of finished stages, by their names.
        here: name of the processor.

    Returns:
        Measured over predicted computing of these stages, the factor to expect of others, and
        their names; 1 and 1 where none has run.
    """
    ran = {
        name: record.cpu_s
        for name, record in records.items()
        if name in costs and record.command == spec(name).command  # an import only copies
        and record.processor == here and record.cpu_s and not record.resumed
    }  # fmt: skip
    if not ran:
        return 1.0, 1.0, []
    ratio = sum(ran.values()) / sum(costs[name].cpu_s for name in ran)
    return ratio, ratio ** (len(ran) / (len(ran) + 1)), list(ran)


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
    costs = stage_costs(size)
    ratio, factor, ran = correction(costs, records or {}, processor())
    found: dict[str, Any] = {}
    lines = []
    many = workers or default_threads()
    for name, stages in groups.items():
        chosen = [costs[stage].scale(factor) for stage in stages]
        all_of = {n: total_cost(chosen, n) for n in sorted({many, OTHER_CORES})}
        found[name] = {
            "stages": list(stages),
            "workers": many,
            "cpu_s": round(sum(cost.cpu_s for cost in chosen)),
            "time_s": {str(n): round(one["time_s"]) for n, one in all_of.items()},
            "memory_mib": {str(n): round(one["memory_mib"]) for n, one in all_of.items()},
            "disk_mb": round(all_of[many]["disk_mb"]),
        }
        here, others = all_of[many], duration(all_of[OTHER_CORES]["time_s"])
        whose = count(many, "worker" if workers else "core")
        lines.append(
            f"{name}: about {duration(here['time_s'])} on {whose} "
            f"({others} on {OTHER_CORES}), {digits(here['memory_mib'] / 1024, 2)} GiB of memory, "
            f"{digits(here['disk_mb'] / 1e3, 2)} GB of disk"
        )
    if lines and ran:
        lines[-1] += f"; corrected by {factor:.2f}, since {', '.join(ran)} took {ratio:.2f} of it"
    return "\n".join(lines), found
