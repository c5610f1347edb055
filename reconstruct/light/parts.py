"""Work on what is too large for memory, part by part, and exact percentiles of it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import repeat
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array

Item = TypeVar("Item")
Loaded = TypeVar("Loaded")
Result = TypeVar("Result")
_BIN_BITS = 43
"""Bits of a float64 that do not count in a histogram: bins are 0.2 % wide."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts(Generic[Item, Loaded]):
    """Parts that are loaded where they are worked on; a single one is loaded once, and here."""

    items: Sequence[Item]
    """From which parts are loaded, such as the paths of files; at least one."""
    load: Callable[[Item], Loaded]
    """A task."""
    label: str
    """What is done, for the progress bar."""
    executor: Executor = SERIAL
    _kept: list[Loaded] = field(default_factory=list, init=False)

    @property
    def is_one(self) -> bool:
        """Whether they are one part."""
        return len(self.items) == 1

    def map(
        self, function: Callable[[Loaded, Any], Result], values: Iterable[Any] | None = None
    ) -> Iterator[Result]:
        """Yield `function(part, value)` of every part, in order.

        Args:
            function: a task of a part and its value.
            values: one for each part; None where tasks need none.
        """
        values = repeat(None, len(self.items)) if values is None else values
        if self.is_one:
            if not self._kept:
                self._kept.append(self.load(self.items[0]))
            return (function(self._kept[0], value) for value in values)
        tasks = zip(self.items, values, strict=True)
        run = partial(_run, self.load, function)
        return self.executor.map(run, tasks, label=self.label, total=len(self.items))


def _run(
    load: Callable[[Item], Loaded],
    function: Callable[[Loaded, Any], Result],
    task: tuple[Item, Any],
) -> Result:
    item, value = task
    return function(load(item), value)


@dataclass(frozen=True, kw_only=True, eq=False)
class Histogram:
    """How many positive values are in narrow bins."""

    bins: NDArray[np.int64]
    """(B,) ascending."""
    counts: NDArray[np.int64]
    """(B,) of values in each."""

    @classmethod
    def of(cls, values: Array) -> "Histogram":
        """Count values (N,)."""
        bins, counts = np.unique(_bins(values), return_counts=True)
        return cls(bins=bins, counts=counts)


def _bins(values: Array) -> NDArray[np.int64]:
    """(N,) bins of positive values: their bits rise with them."""
    found: NDArray[np.int64] = np.ascontiguousarray(values, np.float64).view(np.int64) >> _BIN_BITS
    return found


def values_in(values: Array, bins: NDArray[np.int64]) -> Array:
    """Those of values (N,) that are in one of the bins."""
    chosen: Array = values[np.isin(_bins(values), bins)]
    return chosen


def percentiles(
    percents: Sequence[float],
    counted: Iterable[Histogram],
    gather: Callable[[NDArray[np.int64]], Iterable[Array]],
) -> list[float]:
    """Percentiles of positive values in parts, interpolated as by `np.percentile`.

    Args:
        percents: which.
        counted: histograms of the parts.
        gather: from bins to the values in them, part by part.
    """
    every = list(counted)
    bins, at = np.unique(np.concatenate([one.bins for one in every]), return_inverse=True)
    total = np.bincount(at, np.concatenate([one.counts for one in every])).astype(np.int64)
    ends = np.cumsum(total)
    ranks = np.array(percents) / 100.0 * (ends[-1] - 1)
    pair = np.stack([np.floor(ranks), np.ceil(ranks)]).astype(np.int64)
    which = np.searchsorted(ends, pair, side="right")
    wanted = np.unique(which)
    gathered = np.sort(np.concatenate(list(gather(bins[wanted]))))
    before = np.zeros(len(bins), np.int64)
    before[wanted] = np.cumsum(total[wanted]) - total[wanted]
    low, high = gathered[before[which] + pair - (ends - total)[which]]
    found: list[float] = (low + (high - low) * (ranks - pair[0])).tolist()
    return found
