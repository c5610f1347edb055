"""Scaling of a reconstruction on a cluster, measured with one and two workers and modelled beyond.

    python -m benchmarks.cluster --work FOLDER [--survey WORKSPACE] [--events FILE]
        [--pictures N] [--smaller WORKSPACE EVENTS] [--quick] [--json FILE]

The survey (a small one of its own, if none is given) is reconstructed on a cluster of one local
worker and of two. The events of the first give the computing and the transfers of every task, and
the serial rest; replayed through `cluster_model`, they must give the times of both runs within a
tenth. Then the model says how long N times as many pictures take on up to 128 workers, what share
of these works (efficiency), and which steps hold the others up. `--events` skips the runs and takes
the events of a reconstruction that was made before, by whatever executor.

Tasks and serial work grow with the pictures. `--smaller` names a recorded survey of another size:
what is the same in both (a sum over the survey, a start, a cap) then does not grow.
"""

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from alice_survey.app.stages import names, spec
from alice_survey.core.artefacts import read_json
from alice_survey.core.manifest import read_manifest
from benchmarks.cluster_model import Network, RecordedStage, Recording, makespan, recorded
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over

_WORKERS = (1, 2, 4, 8, 16, 32, 64, 128)
_MEASURED = (1, 2)
_STAGES = tuple(spec(name).folder for name in names("reconstruct"))


def command(*arguments: str) -> None:
    """Run alice-survey."""
    subprocess.run([sys.executable, "-m", "alice_survey", *arguments], check=True)


def pictures_in(work: Path, survey: Path | None) -> Path:
    """A workspace with calibrated pictures, nothing of which is reconstructed."""
    made = work / "survey"
    if made.exists():
        shutil.rmtree(made)
    if survey is None:
        command("init", str(made), "--example", "demo")
        for stage in ("plan", "fly", "image", "calibrate"):
            command(stage, "-w", str(made))
        return made
    shutil.copytree(survey, made, ignore=shutil.ignore_patterns(*_STAGES, "*.partial", ".lock"))
    return made


def pictures_of(survey: Path) -> int:
    """How many a workspace has."""
    return len(read_manifest(survey / "images" / "manifest.csv"))


@contextlib.contextmanager
def workers_of(work: Path, count: int) -> Iterator[Path]:
    """A scheduler and workers that are no part of the command; yields the scheduler's file."""
    file = work / "scheduler.json"
    file.unlink(missing_ok=True)
    scheduler = ["scheduler", "--scheduler-file", str(file), "--port", "0", "--no-dashboard"]
    worker = ["worker", "--scheduler-file", str(file), "--nthreads", "1", "--nworkers", str(count)]
    dask = [sys.executable, "-m", "dask"]
    with contextlib.ExitStack() as stack:
        for part in (scheduler, worker):
            process = subprocess.Popen(
                [*dask, *part, "--host", "127.0.0.1"],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            while not file.exists():
                time.sleep(0.1)
        yield file


def measured_s(work: Path, survey: Path, workers: int) -> float:
    """Reconstruct a copy of a survey on local workers; how long its stages took."""
    copy, events = work / f"on-{workers}", work / f"on-{workers}.jsonl"
    shutil.rmtree(copy, ignore_errors=True)
    events.unlink(missing_ok=True)
    shutil.copytree(survey, copy)
    with workers_of(work, workers) as file:
        command(
            "reconstruct", "-w", str(copy), "--quiet", "--cluster", str(file),
            "--log-file", str(events),
        )  # fmt: skip
    return float(sum(read_json(copy / stage / "stage.json")["took_s"] for stage in _STAGES))


def task_cost_s(work: Path, tasks: int = 300) -> float:
    """What an empty task costs the command and the scheduler on this machine."""
    from alice_survey.core.cluster.engine import cluster_executor

    with workers_of(work, 1) as file, cluster_executor(work, None, file) as executor:
        list(executor.map(abs, range(20), label="first"))
        began_s = time.perf_counter()
        list(executor.map(abs, range(tasks), label="empty"))
        return (time.perf_counter() - began_s) / tasks


def report_scaling(stages: Sequence[RecordedStage], network: Network) -> list[Figure]:
    """Print time and efficiency by workers, and what holds 64 of them up."""
    alone_s = sum(stage.times(1, network) for stage in stages)
    serial_s = sum(stage.serial_s for stage in stages)
    print(f"\n{'workers':>8}{'time, min':>12}{'efficiency':>12}")
    figures = []
    for workers in _WORKERS:
        took_s = sum(stage.times(workers, network) for stage in stages)
        share = alone_s / (workers * took_s)
        print(f"{workers:>8}{took_s / 60:12.1f}{share:12.0%}")
        goal = Goal(minimum=0.7) if workers == 64 else None
        figures += [
            Figure(name=f"efficiency at {workers}", value=share, unit="", goal=goal),
            Figure(name=f"time at {workers}", value=took_s / 60, unit="min"),
        ]
    print(f"\nserial: {serial_s / 60:.1f} min, {serial_s / alone_s:.1%} of all computing")
    for stage in sorted(stages, key=lambda stage: -stage.serial_s):
        print(f"  {stage.name}: {stage.serial_s:.1f} s")
    print("\nsteps that keep 64 workers waiting most: time, and that of full use")
    waits = [
        (makespan(step, 64, network), float(step.task_s.sum()) / 64, stage.name, step.label)
        for stage in stages
        for step in stage.steps
    ]
    for took_s, full_s, name, label in sorted(waits, key=lambda row: row[1] - row[0])[:8]:
        print(f"  {name}, {label}: {took_s:.1f} s, {full_s:.1f} s")
    return figures


def main() -> None:
    """Measure, replay, report."""
    parser = Parser(
        __doc__, quick="nothing: the demo is the smallest survey", work="keeps surveys and events"
    )
    parser.add_argument("--survey", type=Path, help="a workspace with calibrated pictures")
    parser.add_argument("--events", type=Path, help="of a reconstruction that was made before")
    parser.add_argument("--pictures", type=int, help="of the survey that is modelled")
    parser.add_argument(
        "--smaller", type=Path, nargs=2, metavar=("WORKSPACE", "EVENTS"),
        help="a reconstruction of another size",
    )  # fmt: skip
    options, about = parser.begin("alice-survey", "distributed")
    if options.events is not None and options.pictures is not None and options.survey is None:
        parser.error("--pictures with --events needs the --survey that they are of")
    network = Network(task_s=task_cost_s(options.work))
    print(f"an empty task: {1e3 * network.task_s:.2f} ms")
    figures = [Figure(name="an empty task", value=1e3 * network.task_s, unit="ms")]
    events, survey = options.events, options.survey
    if events is None:
        survey = pictures_in(options.work, survey)
        found = {workers: measured_s(options.work, survey, workers) for workers in _MEASURED}
        events = options.work / "on-1.jsonl"
        stages = recorded(events, _STAGES)
        for workers, took_s in found.items():
            modelled_s = sum(stage.times(workers, network) for stage in stages)
            print(f"{workers} workers: {took_s:.1f} s, by the model {modelled_s:.1f} s")
            figures.append(
                Figure(
                    name=f"time with {workers} by the model", value=modelled_s, unit="s",
                    peer="measured", peer_value=took_s,
                    goal=Goal(minimum=0.9, maximum=1.1, of="ratio"),
                )
            )  # fmt: skip
    stages = recorded(events, _STAGES)
    if options.pictures is not None:
        known, smaller = pictures_of(survey), None
        if options.smaller is not None:
            other, file = options.smaller
            smaller = Recording(pictures=pictures_of(other), stages=recorded(file, _STAGES))
        stages = [stage.scaled(options.pictures, known, smaller) for stage in stages]
        print(f"{known} pictures recorded, {options.pictures} modelled")
    figures += report_scaling(stages, network)
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures))))


if __name__ == "__main__":
    main()
