"""Measure what stages cost, and write the coefficients of `alice_survey/computing.toml`.

    python -m benchmarks.costs --work FOLDER [--survey WORKSPACE EVENTS ...]
        [--held WORKSPACE WORKERS ...] [--done] [--compare]

Runs small rendered surveys in FOLDER (those that are done are not run again; half an hour of
computing), reads them and any finished workspaces with the events of their run (`alice-survey run
--events EVENTS`, any number of `--survey`), and fits: computing to those of one worker and those
given, the start of workers to those of several, memory to all. `--held` are surveys
that the fit must not see, with the workers that made them: for these, predicted and measured costs
are printed. To fit again after code has changed, with a survey of full resolution among the others:

    alice-survey run -w full --events full.jsonl
    python -m benchmarks.costs --work FOLDER --survey full full.jsonl

Coefficients are non-negative, and fit logarithms, so that small and large surveys count alike.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from alice_survey.app import computing
from alice_survey.app.computing import PREDICTED, SurveyCost, SurveySize, weighed, workspace_size
from alice_survey.app.pipeline import settings
from alice_survey.core.artefacts import read_stage
from alice_survey.core.executor import default_threads
from alice_survey.core.run.resources import processor
from alice_survey.core.stages import is_imported, spec
from benchmarks.cluster_model import recorded

DATA = Path(computing.__file__).with_suffix(".toml")
_WATCH_S = 1.0
_ROUNDS, _STEP = 50, 0.9
"""Of fits, and the largest residual of a logarithm that counts in full (Huber)."""
_MATCHING = ("try matching", "compare partners", "match")
_COMPUTING: dict[str, Sequence[str]] = {
    "pool": ("once", "board_pictures", "board_rays", "board_rays_large"),
    "image": ("once", "floor_cells", "pictures", "rendered_mpx"),
    "calibrate": ("once", "board_pictures", "board_mpx"),
    "mapping": (
        "once", "pictures", "feature_mpx", "kilofeatures", "compared", "uncalibrated_pictures"
    ),
    "placing": ("once", "pictures", "kilofeatures"),
    "dense": ("once", "pictures", "refined_mpx", "cells"),
    "mosaic": ("once", "pictures", "taken_mpx", "mosaic_mpx"),
    "mesh": ("once", "pictures", "taken_mpx", "cells"),
}  # fmt: skip
"""What may drive the computing of a stage."""
_PROCESS = dict.fromkeys(PREDICTED, ("once",)) | dict.fromkeys(
    ("mapping", "placing"), ("once", "kilofeatures")
)
_WORKER = dict.fromkeys(PREDICTED, ("once", "picture_mpx")) | {
    "dense": ("once", "refined_picture_mpx")
}
_PRODUCT: dict[str, Sequence[str]] = {
    "pool": ("board_pictures", "board_mpx"),
    "image": ("pictures", "taken_mpx", "floor_cells"),
    "calibrate": ("once", "board_pictures"),
    "mapping": ("kilofeatures",),
    "placing": ("kilofeatures",),
    "dense": ("refined_mpx", "cells"),
    "mosaic": ("pictures", "mosaic_mpx"),
    "mesh": ("taken_mpx", "cells"),
}
_SCRATCH: dict[str, Sequence[str]] = {
    "mapping": ("kilofeatures", "taken_mpx"),
    "dense": ("refined_mpx",),
    "mosaic": ("taken_mpx", "mosaic_mpx"),
    "mesh": ("taken_mpx", "cells"),
}


@dataclass(frozen=True, kw_only=True)
class Survey:
    """A small rendered survey to measure."""

    name: str
    sides_m: tuple[float, float]
    scale: int
    """By which the camera's resolution is divided."""
    seed: int
    features: int = 8000
    relief_m: float = 0.3
    cross: bool = True
    workers: int = 1
    pictures_of: str = ""
    """Name of another one, whose pictures it takes as they are, without rig and navigation."""

    @property
    def text(self) -> str:
        """Its settings."""
        lines = "" if self.cross else "cross_lines = 0\nclosing_line = false\n"
        return (
            f'name = "{self.name}"\nseed = {self.seed}\n'
            f"[area]\nlength_m = {self.sides_m[0]}\nwidth_m = {self.sides_m[1]}\n"
            f"[plan]\nside_overlap = 0.3\n{lines}"
            f"[seafloor]\nrelief_m = {self.relief_m}\n"
            f"[imaging]\nscale = {self.scale}\npool_views = 12\n"
            f"[reconstruct]\nmax_features = {self.features}\n"
        )


LEARNED_FROM = (
    Survey(name="s8small", sides_m=(1.0, 1.0), scale=8, seed=11),
    Survey(name="s6mid", sides_m=(2.5, 2.4), scale=6, seed=6, features=2000, relief_m=0.2),
    Survey(name="s4small", sides_m=(1.2, 1.0), scale=4, seed=8, features=3000),
    Survey(name="s3small", sides_m=(1.2, 1.6), scale=3, seed=10, relief_m=0.35),
    Survey(name="bare", sides_m=(1.2, 1.0), scale=4, seed=8, pictures_of="s4small"),
    Survey(name="s2tiny", sides_m=(1.6, 0.8), scale=2, seed=9, cross=False),
    Survey(name="s8two", sides_m=(1.0, 1.0), scale=8, seed=12, workers=2),
    Survey(name="s3three", sides_m=(1.6, 0.6), scale=3, seed=13, cross=False, workers=3),
)


@dataclass(frozen=True, kw_only=True)
class StageRun:
    """What a stage has cost."""

    size: SurveySize
    workers: int
    cpu_s: float
    tasks_s: Mapping[str, float]
    """Of each step."""
    peak_mib: float
    product_mb: float
    scratch_mb: float | None
    """None where nobody looked."""

    @property
    def serial_s(self) -> float:
        """Computing outside of tasks."""
        return max(0.0, self.cpu_s - sum(self.tasks_s.values()))


def is_done(workspace: Path) -> bool:
    """Whether a workspace has all stages whose cost is predicted."""
    return read_stage(workspace / spec(PREDICTED[-1]).folder) is not None


def run_survey(survey: Survey, work: Path) -> tuple[Path, Path]:
    """Run a survey unless it is done; return its workspace and its events.

    Raises:
        CalledProcessError: it failed.
    """
    workspace, events = work / survey.name, work / f"{survey.name}.jsonl"
    if is_done(workspace):
        return workspace, events
    shutil.rmtree(workspace, ignore_errors=True)
    events.unlink(missing_ok=True)
    program = [sys.executable, "-m", "alice_survey"]
    stages = "run"
    if survey.pictures_of:
        stages = "reconstruct"
        images = work / survey.pictures_of / "images"
        folders = ["--left", str(images / "left"), "--right", str(images / "right")]
        subprocess.run([*program, "import-images", *folders, "-w", str(workspace)], check=True)
    else:
        workspace.mkdir(parents=True)
        (workspace / "survey.toml").write_text(survey.text, encoding="utf-8")
    command = [*program, stages, "-w", str(workspace), "--threads", str(survey.workers)]
    command += ["--events", str(events), "--quiet"]
    max_mb: dict[str, float] = {}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            for folder in workspace.glob("*.partial"):
                max_mb[folder.stem] = max(max_mb.get(folder.stem, 0.0), folder_mb(folder))
            time.sleep(_WATCH_S)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    events.with_suffix(".scratch.json").write_text(json.dumps(max_mb))
    return workspace, events


def stage_runs(workspace: Path, events: Path) -> dict[str, StageRun]:
    """What the finished stages of a workspace have cost, by name."""
    size = _size(workspace)
    text = events.read_text(encoding="utf-8")
    finished = set(re.findall(r'"stage_finished", "stage": "(\w+)"', text))
    looked = events.with_suffix(".scratch.json")
    scratch = json.loads(looked.read_text()) if looked.is_file() else {}
    found: dict[str, StageRun] = {}
    for name in PREDICTED:
        folder = spec(name).folder
        record = read_stage(workspace / folder)
        if record is None or folder not in finished:  # imported pictures have no such event
            continue
        (stage,) = recorded(events, [folder])
        tasks_s: dict[str, float] = {}
        for step in stage.steps:
            tasks_s[step.label] = tasks_s.get(step.label, 0.0) + float(step.task_s.sum())
        product_mb = folder_mb(workspace / folder)
        found[name] = StageRun(
            size=size,
            workers=_workers(text),
            cpu_s=stage.serial_s + sum(tasks_s.values()),
            tasks_s=tasks_s,
            peak_mib=record.peak_mib or 0.0,
            product_mb=product_mb,
            scratch_mb=max(0.0, scratch[folder] - product_mb) if folder in scratch else None,
        )
    return found


def _workers(events: str) -> int:
    """How many workers the command of an events file had: as given, else all cores here."""
    given = re.search(r"--threads (\d+)", events)
    return int(given[1]) if given else default_threads()


def folder_mb(folder: Path) -> float:
    """Size of all files of a folder that may change meanwhile."""
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.lstat().st_size if path.is_file() else 0
        except OSError:
            continue
    return total / 1e6


def fitted(rows: Sequence[Mapping[str, float]], values: Sequence[float]) -> dict[str, float]:
    """Non-negative coefficients that fit values in least squares of their logarithms.

    Squares of relative errors would favour predictions that are too small. Gauss-Newton: for values
    v predicted as p, log(p / v) is linear in p / p0 about an earlier prediction p0.

    Args:
        rows: what may drive each value, by the same names.
        values: measured; those of 0 do not count.
    """
    used = [n for n, value in enumerate(values) if value > 0]
    if not used or not rows[0]:
        return {}
    names = list(rows[0])
    matrix = np.array([[rows[n][name] for name in names] for n in used])
    scale = np.maximum(matrix.max(axis=0), 1e-12)
    measured = np.array([values[n] for n in used])
    earlier = measured
    for _ in range(_ROUNDS):
        wanted = 1.0 + np.clip(np.log(measured / earlier), -_STEP, _STEP)
        found, _ = nnls(matrix / scale / earlier[:, None], wanted)
        earlier = np.maximum(matrix / scale @ found, 1e-9 * measured)
    return {name: float(x) for name, x in zip(names, found / scale, strict=True) if x > 0}


def coefficients(
    computed: Sequence[Mapping[str, StageRun]], every: Sequence[Mapping[str, StageRun]]
) -> dict[str, dict[str, Any]]:
    """Coefficients of all stages, as `computing.toml` holds them.

    Args:
        computed: what the stages of surveys have cost, for computing and disk.
        every: the same with any number of workers, for memory and the start of workers.
    """
    return {
        name: _of_stage(
            name,
            [run[name] for run in computed if name in run],
            [run[name] for run in every if name in run],
        )
        for name in PREDICTED
    }


def _of_stage(
    name: str, runs: Sequence[StageRun], every: Sequence[StageRun]
) -> dict[str, dict[str, float]]:
    def rows(names: Sequence[str]) -> list[dict[str, float]]:
        return [{key: run.size.drivers[key] for key in names} for run in runs]

    def matching(run: StageRun) -> float:
        return sum(run.tasks_s.get(step, 0.0) for step in _MATCHING if name == "dense")

    usual = rows(_COMPUTING[name])
    growing = rows([key for key in _COMPUTING[name] if key != "once"])
    tasks_s = fitted(growing, [sum(run.tasks_s.values()) - matching(run) for run in runs])
    matched = fitted(rows(("pictures", "matched_mpx")), [matching(run) for run in runs])
    for key, value in matched.items():
        tasks_s[key] = tasks_s.get(key, 0.0) + value
    memory_rows = [
        {f"process {key}": run.size.drivers[key] for key in _PROCESS[name]}
        | {
            f"worker {key}": min(run.workers, run.size.pictures) * run.size.drivers[key]
            for key in _WORKER[name]
        }
        for run in every
    ]
    memory = fitted(memory_rows, [run.peak_mib for run in every])
    shared = [run for run in every if run.workers > 1]
    serial_s = fitted(usual, [run.serial_s for run in runs])
    more_s = [run.serial_s - weighed(serial_s, run.size.drivers) for run in shared]
    looked = [n for n, run in enumerate(runs) if run.scratch_mb is not None]
    scratch_rows = rows(_SCRATCH.get(name, ()))
    return {
        "serial_s": serial_s,
        "start_s": fitted([{"once": float(run.workers)} for run in shared], more_s),
        "tasks_s": tasks_s,
        "process_mib": _part(memory, "process"),
        "worker_mib": _part(memory, "worker"),
        "product_mb": fitted(rows(_PRODUCT[name]), [run.product_mb for run in runs]),
        "scratch_mb": fitted(
            [scratch_rows[n] for n in looked], [runs[n].scratch_mb or 0.0 for n in looked]
        ),
    }


def _part(values: Mapping[str, float], prefix: str) -> dict[str, float]:
    return {
        key.removeprefix(f"{prefix} "): value
        for key, value in values.items()
        if key.startswith(prefix)
    }


def written(stages: Mapping[str, Any], probe_s: float, machine: str, surveys: Sequence[str]) -> str:
    """The text of `computing.toml`."""
    lines = [
        "# What stages cost, measured by `python -m benchmarks.costs`; computing.py says what the",
        "# coefficients are multiplied by.",
        "",
        f"surveys = {json.dumps(list(surveys))}",
        f"processor = {json.dumps(machine)}",
        f"probe_s = {probe_s:.4f}",
    ]
    for stage, parts in stages.items():
        lines += ["", f"[stages.{stage}]"]
        for part, values in parts.items():
            inner = ", ".join(f"{name} = {value:.4g}" for name, value in values.items())
            lines.append(f"{part} = {{ {inner} }}" if inner else f"{part} = {{}}")
    return "\n".join(lines) + "\n"


def comparison(workspace: Path, workers: int, measured: Mapping[str, Any]) -> list[str]:
    """Rows of a table: predicted and measured cost of a survey, by stage and together.

    Args:
        workspace: of the survey, made on the machine of the coefficients.
        workers: how many it was made with.
        measured: the coefficients.
    """
    size = _size(workspace)
    rows = []
    for group, stages in computing.GROUPS.items():
        folders = {
            name: workspace / spec(name).folder
            for name in stages
            if not (spec(name).simulated and is_imported(workspace))
        }
        known = {name: read_stage(folder) for name, folder in folders.items()}
        records = {name: record for name, record in known.items() if record is not None}
        if not records:
            continue
        costs = computing.stage_costs(size, 1.0, measured)
        found = SurveyCost(stages={name: costs[name] for name in records}, workers=workers)
        cpu_s = {name: record.cpu_s or 0.0 for name, record in records.items()}
        peak_mib = max(record.peak_mib or 0.0 for record in records.values())
        product_mb = sum(folder_mb(folders[name]) for name in records)
        ours_mb = sum(cost.product_mb for cost in found.stages.values())
        rows += [
            _row(workspace.name, name, "computing, s", costs[name].cpu_s(workers), cpu_s[name])
            for name in records
        ]
        rows += [
            _row(
                workspace.name,
                f"**{group}**",
                "computing, s",
                found.cpu_s(workers),
                sum(cpu_s.values()),
            ),
            _row(
                workspace.name, f"**{group}**", "memory, MiB", found.memory_mib(workers), peak_mib
            ),
            _row(workspace.name, f"**{group}**", "products, MB", ours_mb, product_mb),
        ]
    return rows


def _row(survey: str, part: str, what: str, ours: float, true: float) -> str:
    return f"| {survey} | {part} | {what} | {ours:.0f} | {true:.0f} | {ours / true:.2f} |"


def _size(workspace: Path) -> SurveySize:
    config = settings(workspace, None, needed=False)
    size = workspace_size(
        workspace, config.camera, config.imaging, config.seafloor, config.reconstruct
    )
    if size is None:
        raise SystemExit(f"{workspace}: neither a plan nor pictures")
    return size


def main() -> None:
    """Measure, fit, write, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--work", type=Path, required=True, help="folder for the small surveys")
    parser.add_argument(
        "--survey", type=Path, nargs=2, action="append", default=[],
        metavar=("WORKSPACE", "EVENTS"), help="a finished survey to learn from",
    )  # fmt: skip
    parser.add_argument(
        "--held", nargs=2, action="append", default=[],
        metavar=("WORKSPACE", "WORKERS"), help="a finished survey to compare with",
    )  # fmt: skip
    parser.add_argument("--done", action="store_true", help="run nothing, take what is done")
    parser.add_argument("--compare", action="store_true", help="fit nothing, compare alone")
    options = parser.parse_args()
    if not options.compare:
        made = [one for one in LEARNED_FROM if not options.done or is_done(options.work / one.name)]
        small = {one.name: stage_runs(*run_survey(one, options.work)) for one in made}
        given = [stage_runs(*one) for one in options.survey]
        alone = [small[one.name] for one in made if one.workers == 1]
        found = coefficients([*alone, *given], [*small.values(), *given])
        names = [*small, *(one[0].name for one in options.survey)]
        text = written(found, computing.probe_s(), processor(), names)
        DATA.write_text(text, encoding="utf-8")
        print(f"wrote {DATA}")
    print("| survey | of | what | predicted | measured | ratio |\n|---|---|---|---|---|---|")
    for workspace, workers in options.held:
        print("\n".join(comparison(Path(workspace), int(workers), computing.model())))


if __name__ == "__main__":
    main()
