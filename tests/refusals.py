"""How faults are reported."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from alice_survey.core.errors import AliceError


@contextmanager
def refused(kind: type[AliceError], *words: object) -> Iterator[pytest.ExceptionInfo[AliceError]]:
    """What is done is refused in one line that has all the words."""
    with pytest.raises(kind) as fault:
        yield fault
    text = str(fault.value)
    assert len(text.splitlines()) == 1
    for word in words:
        assert str(word) in text
