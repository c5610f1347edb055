"""A model of a cluster in discrete events: how long a recorded run takes with any workers.

A run is a row of steps. The tasks of a step leave the command's machine one after the other, each
with its arguments, wait for a free worker, and come back with their results; a few for each worker
are in flight, and results are taken in order, as the executor does. What a stage computes besides
its tasks is serial. Steps follow each other, although a step that consumes what another makes
overlaps with it in truth.
"""

import heapq
import json
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from alice_survey.core.cluster.engine import max_in_flight
from alice_survey.core.frames import Array


@dataclass(frozen=True, kw_only=True)
class Network:
    """What a task costs besides its computing."""

    task_s: float = 0.002
    """For the command and the scheduler, which do one after the other."""
    latency_s: float = 0.001
    """On the way, each way."""
    bytes_per_s: float = 1e9 / 8
    """In and out of the command's machine."""


@dataclass(frozen=True, kw_only=True)
class RecordedStep:
    """Tasks of one kind."""

    label: str
    task_s: Array
    """(N,) computing of each, in order."""
    sent_bytes: float
    """With each task."""
    received_bytes: float


@dataclass(frozen=True, kw_only=True)
class RecordedStage:
    """A stage of a run."""

    name: str
    serial_s: float
    """Computing that is in no task."""
    steps: list[RecordedStep] = field(default_factory=list)

    def times(self, workers: int, network: Network) -> float:
        """How long it takes."""
        return self.serial_s + sum(makespan(step, workers, network) for step in self.steps)

    def scaled(self, pictures: float, known: float, smaller: "Recording | None") -> "RecordedStage":
        """The stage of a survey with so many pictures.

        Args:
            pictures: wanted.
            known: of this stage.
            smaller: a survey of another size, which tells what does not grow; without it all grows
                with the pictures.
        """
        before = smaller.stage(self.name) if smaller else RecordedStage(name=self.name, serial_s=0)
        share = (pictures - known) / (known - (smaller.pictures if smaller else 0))
        steps = []
        for step in self.steps:
            fewer = before.tasks(step.label)
            count = round(len(step.task_s) + share * max(0, len(step.task_s) - fewer))
            steps.append(replace(step, task_s=np.resize(step.task_s, max(1, count))))
        grown = max(0.0, self.serial_s - before.serial_s)
        serial_s = self.serial_s + share * grown
        return RecordedStage(name=self.name, serial_s=serial_s, steps=steps)

    def tasks(self, label: str) -> int:
        """How many tasks a step has, 0 of one that was not made."""
        return sum(len(step.task_s) for step in self.steps if step.label == label)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recorded reconstruction."""

    pictures: int
    stages: list[RecordedStage]

    def stage(self, name: str) -> RecordedStage:
        """One of its stages."""
        return next(stage for stage in self.stages if stage.name == name)


def makespan(step: RecordedStep, workers: int, network: Network) -> float:
    """Time from the first task that is sent to the last result that is taken.

    Args:
        step: its tasks.
        workers: how many, each for one task at a time.
        network: costs of sending.
    """
    sending_s = network.task_s + step.sent_bytes / network.bytes_per_s
    taking_s = step.received_bytes / network.bytes_per_s
    here_s = 0.0
    free = [0.0] * workers
    waiting: deque[float] = deque()
    for task_s in step.task_s.tolist():
        if len(waiting) >= max_in_flight(workers):
            here_s = max(here_s, waiting.popleft()) + taking_s
        here_s += sending_s
        end_s = max(heapq.heappop(free), here_s + network.latency_s) + task_s
        heapq.heappush(free, end_s)
        waiting.append(end_s + network.latency_s)
    for end_s in waiting:
        here_s = max(here_s, end_s) + taking_s
    return here_s


def recorded(events: Path, stages: Sequence[str]) -> list[RecordedStage]:
    """Stages of a run from its events file; of one that ran twice, the last.

    Tasks whose times are given as quantiles get times between these, in an order that is random
    and the same each time.

    Raises:
        ValueError: a stage is missing.
    """
    rng = np.random.default_rng(0)
    found: dict[str, RecordedStage] = {}
    steps: dict[str, list[RecordedStep]] = {}
    for line in events.read_text(encoding="utf-8").splitlines():
        event = json.loads(line)
        name = event.get("stage")
        if event["event"] == "stage_started":
            steps[name] = []
        elif event["event"] == "step_finished" and "tasks" in event and name in steps:
            count = event["tasks"]
            known = np.array(event["task_cpu_s"])
            places = np.linspace(0.0, len(known) - 1.0, count)
            times = rng.permutation(np.interp(places, np.arange(len(known)), known))
            times *= event["cpu_s"] / max(times.sum(), 1e-9)  # rounded quantiles
            steps[name].append(
                RecordedStep(
                    label=event["step"],
                    task_s=times,
                    sent_bytes=event.get("sent_bytes", 0) / count,
                    received_bytes=event.get("received_bytes", 0) / count,
                )
            )
        elif event["event"] == "stage_finished":
            tasks_s = sum(float(step.task_s.sum()) for step in steps[name])
            serial_s = max(0.0, event["cpu_s"] - tasks_s)
            found[name] = RecordedStage(name=name, serial_s=serial_s, steps=steps[name])
    missing = [name for name in stages if name not in found]
    if missing:
        raise ValueError(f"{events}: stage {missing[0]} did not finish in it")
    return [found[name] for name in stages]
