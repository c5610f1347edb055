"""The model of a cluster against closed forms, and against events that a run writes."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.cluster.engine import max_in_flight
from alice_survey.core.executor import SERIAL
from alice_survey.core.run import progress
from alice_survey.core.run.events import EventFile
from benchmarks.cluster_model import (
    Network,
    RecordedStage,
    RecordedStep,
    Recording,
    makespan,
    recorded,
)

FREE = Network(task_s=0.0, latency_s=0.0, bytes_per_s=1e30)


def step(times: list[float] | np.ndarray, *, bytes_each: float = 0.0) -> RecordedStep:
    return RecordedStep(
        label="step",
        task_s=np.asarray(times, dtype=np.float64),
        sent_bytes=bytes_each,
        received_bytes=bytes_each,
    )


@pytest.mark.parametrize("workers", [1, 2, 5, 16])
def test_equal_tasks_run_in_rounds(workers: int) -> None:
    rounds = -(-40 // workers)
    assert makespan(step([3.0] * 40), workers, FREE) == pytest.approx(3.0 * rounds)


@pytest.mark.parametrize("workers", [1, 3, 64])
def test_a_step_takes_no_less_than_its_bounds_and_no_more_than_grahams(workers: int) -> None:
    """Tasks given to any free worker take at most 2 - 1/W times the optimum (Graham, 1969)."""
    times = np.random.default_rng(3).lognormal(size=max_in_flight(workers))
    minimum = max(times.sum() / workers, times.max())
    found = makespan(step(times), workers, FREE)
    assert minimum <= found * (1 + 1e-12)
    assert found <= (times.sum() - times.max()) / workers + times.max() + 1e-9


def test_sending_is_serial_and_waiting_is_not() -> None:
    network = Network(task_s=0.01, latency_s=0.5, bytes_per_s=100.0)
    quick = step([1e-6] * 1000, bytes_each=0.0)
    assert makespan(quick, 10_000, network) == pytest.approx(1000 * 0.01 + 2 * 0.5, rel=1e-3)
    heavy = step([1e-6] * 10, bytes_each=100.0)  # a second there and a second back
    assert makespan(heavy, 10_000, network) == pytest.approx(10 * 1.01 + 1.0 + 10.0, rel=0.1)


def test_what_a_smaller_survey_has_too_does_not_grow() -> None:
    stage = RecordedStage(name="stage", serial_s=10.0, steps=[step([1.0] * 90)])
    less = RecordedStage(name="stage", serial_s=8.0, steps=[step([1.0] * 50)])
    smaller = Recording(pictures=20, stages=[less])
    larger = stage.scaled(130, 30, smaller)
    assert larger.serial_s == pytest.approx(8.0 + 11 * 2.0)
    assert larger.tasks("step") == 50 + 11 * 40


def _work(number: int) -> int:
    return sum(range(20_000 * (1 + number % 3)))


def test_events_of_a_run_are_read_back(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    run = progress.Run(files=[EventFile(path)], ticks=False)
    with progress.reported_to(run), progress.stage("stage") as finish:
        list(SERIAL.map(_work, range(240), label="work"))
        finish(took_s=9.0, cpu_s=7.0, peak_mib=1.0)

    (stage,) = recorded(path, ["stage"])

    (found,) = stage.steps
    assert (found.label, len(found.task_s)) == ("work", 240)
    assert 0.0 < found.task_s.min() < found.task_s.max()
    assert stage.serial_s + found.task_s.sum() == pytest.approx(7.0)
    with pytest.raises(ValueError, match="other"):
        recorded(path, ["other"])
