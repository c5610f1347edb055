"""Work that a page asks for again and again while somebody drags: only the newest counts."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from alice_survey.core.errors import AliceError

T = TypeVar("T")


class SupersededError(AliceError):
    """The same page has sent a newer request."""


@dataclass(eq=False)
class Newest:
    """Work of which only the newest of each page counts: older ones that wait are dropped."""

    _condition: threading.Condition = field(default_factory=threading.Condition)
    tickets: dict[str, int] = field(default_factory=dict)
    """Requests of each page so far."""
    _busy: bool = False

    def run(self, page: str, work: Callable[[], T]) -> T:
        """Do some work when no other is being done.

        Raises:
            SupersededError: newer work came from the same page while this waited.
        """
        with self._condition:
            mine = self.tickets[page] = self.tickets.get(page, 0) + 1
            self._condition.notify_all()
            self._condition.wait_for(lambda: not self._busy or self.tickets[page] != mine)
            if self.tickets[page] != mine:
                raise SupersededError("a newer change is being planned")
            self._busy = True
        try:
            return work()
        finally:
            with self._condition:
                self._busy = False
                self._condition.notify_all()
