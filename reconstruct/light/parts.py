"""Work on what is too large for memory, part by part."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import repeat
from typing import Any, Generic, TypeVar

from alice_survey.core.executor import SERIAL, Executor

Item = TypeVar("Item")
Loaded = TypeVar("Loaded")
Result = TypeVar("Result")


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
