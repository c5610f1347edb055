"""A survey's observations in parts, each of neighbouring stations, on as many workers as there are.

A part holds whole points and knows its own stations alone, so that what it says of the survey is a
small sum. Sums are added in the order of the parts: the result does not depend on the workers. What
does not change lies in files, of which a task has the paths.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import repeat
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array
from reconstruct.adjustment.exact_observations import (
    Pixels,
    RigState,
    exact_observations,
    exact_residuals,
)
from reconstruct.adjustment.normal_equations import (
    BlockPattern,
    LinearObservations,
    joined_pattern,
    pattern_of,
)
from reconstruct.mapping.arrays import Indices
from reconstruct.mapping.bundle import cauchy_weights

Value = TypeVar("Value")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where parts are worked on."""

    executor: Executor = SERIAL
    folder: Path | None = None
    """For what all workers read; None where they are this process."""

    def __post_init__(self) -> None:
        if self.folder is None and (self.executor.workers > 1 or self.executor.pool is not None):
            raise ValueError("workers of other processes need a folder")

    def apart(self, name: str) -> "Workers":
        """The same, with a folder of its own in that of these."""
        return replace(self, folder=None if self.folder is None else self.folder / name)


ALONE = Workers()
"""This process."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _PixelPart(Generic[Value]):
    """A part for a worker."""

    pixels: Pixels | Path
    """Of its own stations and points."""
    state: RigState
    """Of the same."""
    value: Value

    def run(self, function: Callable[[Pixels, RigState, Value], Result]) -> Result:
        """What a function makes of it."""
        pixels = _load(self.pixels) if isinstance(self.pixels, Path) else self.pixels
        return function(pixels, self.state, self.value)


def _run(function: Callable[[Pixels, RigState, Any], Result], part: _PixelPart[Any]) -> Result:
    return part.run(function)


def _load(path: Path) -> Pixels:
    with np.load(path) as arrays:
        return Pixels(**arrays)


class PixelParts:
    """Observations in parts of about `PART`; one alone is the survey as it is."""

    def __init__(self, pixels: Pixels, stations: int, workers: Workers = ALONE) -> None:
        self.pixels, self.count, self.workers = pixels, stations, workers
        self.runs = pixels.parts()
        self.points = [end - first for first, end in self.runs]
        self.kept: dict[int, Pixels | Path] = {}
        self.stations: Sequence[Indices] = [np.arange(stations)]
        if not self.is_one:
            self.stations = [np.unique(pixels.run(*run).station) for run in self.runs]

    @property
    def is_one(self) -> bool:
        """Whether they are one part."""
        return len(self.runs) == 1

    @cached_property
    def pattern(self) -> BlockPattern:
        """Which stations see points in common."""
        if self.is_one:
            return pattern_of(self.pixels.starts, self.pixels.station, self.count)
        found = self._map(_pattern_of_part, [None] * len(self.runs), self.stations)
        return joined_pattern(zip(self.stations, found, strict=True), self.count)

    def map(
        self,
        function: Callable[[Pixels, RigState, Value], Result],
        state: RigState,
        values: Iterable[Value],
    ) -> Iterator[Result]:
        """Yield `function(pixels, state, value)` of every part, in order.

        Args:
            function: a task of the part's pixels, of the state of its stations and points, and of a
                value.
            state: of the survey.
            values: one for each part.
        """
        return self._map(function, self._states(state), values)

    def _map(
        self, function: Callable[..., Result], states: Iterable[Any], values: Iterable[Any]
    ) -> Iterator[Result]:
        tasks = (
            _PixelPart(pixels=self._of(k), state=state, value=value)
            for k, state, value in zip(range(len(self.runs)), states, values, strict=True)
        )
        run, executor = partial(_run, function), self.workers.executor
        if self.is_one or self.workers.folder is None:
            return map(run, tasks)
        return executor.map(run, tasks, label="parts of the survey", total=len(self.runs))

    def _states(self, state: RigState) -> Iterator[RigState]:
        if self.is_one:
            yield state
            return
        for run, own in zip(self.runs, self.stations, strict=True):
            yield replace(
                state, turns=state.turns[own], centres=state.centres[own],
                points=state.points[slice(*run)],
            )  # fmt: skip

    def _of(self, number: int) -> Pixels | Path:
        """Pixels of a part, counting in its stations and points, or the file of these."""
        if self.is_one:
            return self.pixels
        if number not in self.kept:
            run = self.pixels.run(*self.runs[number])
            own: Pixels | Path = replace(
                run, station=np.searchsorted(self.stations[number], run.station),
                point=run.point - self.runs[number][0],
            )  # fmt: skip
            if self.workers.folder is None:
                return own
            self.workers.folder.mkdir(parents=True, exist_ok=True)
            path = self.workers.folder / f"part-{number:05d}.npz"
            np.savez(path, **vars(own))
            self.kept[number] = path
        return self.kept[number]

    def residuals(self, state: RigState) -> Array:
        """(O, 2) computed pixels minus observed ones; NaN where no ray explains one."""
        return np.concatenate(
            list(self.map(_residuals_of_part, state, repeat(None, len(self.runs))))
        )


def _pattern_of_part(pixels: Pixels, _: None, own: Indices) -> BlockPattern:
    return pattern_of(pixels.starts, pixels.station, len(own))


def _residuals_of_part(pixels: Pixels, state: RigState, _: None) -> Array:
    return exact_residuals(state, pixels)


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearised:
    """Weighted observations from one guess, part by part; a single part is computed once only."""

    pixels: PixelParts
    state: RigState
    fields: Sequence[str]
    """Parameters of the rig that are not held."""
    noise: tuple[float, float]
    """Sigma of a keypoint's coordinate for the weights, and variance that scales them."""
    kept: list[LinearObservations] = field(default_factory=list)

    @property
    def stations(self) -> Sequence[Indices]:
        """Of each part, its stations."""
        return self.pixels.stations

    @property
    def points(self) -> Sequence[int]:
        """How many points each part has."""
        return self.pixels.points

    @property
    def pattern(self) -> BlockPattern:
        """Which of all stations see points in common."""
        return self.pixels.pattern

    def map(
        self, function: Callable[[LinearObservations, Any], Result], values: Iterable[Any]
    ) -> Iterator[Result]:
        """Yield `function(part, value)` of every part with its value, in order."""
        how = _How(fields=tuple(self.fields), noise=self.noise)
        if self.pixels.is_one:
            if not self.kept:
                self.kept.append(how.linear(self.pixels.pixels, self.state))
            return (function(self.kept[0], value) for value in values)
        return self.pixels.map(partial(_on_linear, function, how), self.state, values)


@dataclass(frozen=True, kw_only=True)
class _How:
    """How observations are linearised."""

    fields: tuple[str, ...]
    noise: tuple[float, float]

    def linear(self, pixels: Pixels, state: RigState) -> LinearObservations:
        sigma, variance = self.noise
        found = exact_observations(state, pixels, self.fields)
        return found.weigh(cauchy_weights(found.miss, sigma) / variance)


def _on_linear(
    function: Callable[[LinearObservations, Any], Result],
    how: _How,
    pixels: Pixels,
    state: RigState,
    value: Any,
) -> Result:
    return function(how.linear(pixels, state), value)
