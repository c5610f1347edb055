"""What is missing or changed in a file of ours ends in one line that names it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import cho_factor
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from alice_survey.core.contents import as_line, one_line, read_arrays, taken_from
from alice_survey.core.errors import PlanError, WorkspaceError, known_fault
from tests.refusals import refused

FILE = Path("frame.json")


@pytest.mark.parametrize(
    "take",
    [
        lambda data: data["b"], lambda data: data["a"]["c"], lambda data: float("x\ny"),
        lambda data: float(10**400), lambda data: data.items[0],
    ],
)  # fmt: skip
def test_a_missing_value_names_the_file(take: Callable[[Any], object]) -> None:
    with refused(WorkspaceError, "frame.json: "), taken_from(FILE):
        take({"a": [1, 2]})


def test_known_faults_pass() -> None:
    with pytest.raises(PlanError), taken_from(FILE):
        raise PlanError


@pytest.mark.parametrize(
    "solve",
    [
        lambda a: splu(csc_array(a)), lambda a: np.linalg.solve(a, a[0]), np.linalg.cholesky,
        cho_factor,
    ],
)  # fmt: skip
def test_a_singular_factor_is_a_known_fault(solve: Callable[[Any], object]) -> None:
    with pytest.raises(Exception, match=r"(?i)singular|definite|minor") as raised:
        solve(np.zeros((3, 3)))
    line = known_fault(raised.value)
    assert line is not None and "\n" not in line
    assert known_fault(ValueError("operands could not be broadcast")) is None


def test_text_of_others_is_shown_on_one_line() -> None:
    assert as_line("a\x1b[31m\n b\u202e") == "a [31m b"
    assert len(as_line("x" * 10_000)) == 200
    assert one_line(EOFError()) == "EOFError"


def test_arrays_that_are_missing_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with refused(WorkspaceError, path):
        read_arrays(path, "x")
    np.savez(path, x=np.arange(5), y=np.array([{}], dtype=object))
    np.testing.assert_array_equal(read_arrays(path, "x")["x"], np.arange(5))
    for names in (("x", "z"), ("y",)):  # an object would be unpickled
        with refused(WorkspaceError, path):
            read_arrays(path, *names)
    whole = path.read_bytes()
    for end in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:end])
        with refused(WorkspaceError, path):
            read_arrays(path, "x")
