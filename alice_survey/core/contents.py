"""Read files that this program wrote, and that a user or a disk may have changed since."""

import contextlib
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from alice_survey.core.errors import WorkspaceError, why

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from pydantic import ValidationError

_SHOWN = 200


@contextlib.contextmanager
def taken_from(path: Path) -> Iterator[None]:
    """Within this block values are read from the contents of a file.

    Raises:
        WorkspaceError: a value is missing or of another type.
    """
    try:
        yield
    except KeyError as error:
        raise WorkspaceError(
            f"{path}: lacks {one_line(error)}; it was changed: delete it and run again"
        ) from None
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise WorkspaceError(
            f"{path}: is not as it was written ({one_line(error)}): delete it and run again"
        ) from None


def read_arrays(
    path: Path, *names: str, optional: Sequence[str] = ()
) -> "dict[str, NDArray[np.generic]]":
    """Arrays of an `.npz` file; of optional ones those that are there.

    Raises:
        WorkspaceError: it is missing or damaged, or lacks one.
    """
    import numpy as np

    try:
        with np.load(path) as data:
            there = [name for name in optional if name in data]
            return {name: data[name] for name in (*names, *there)}
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    except (KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise WorkspaceError(
            f"{path}: is damaged ({one_line(error)}): delete it and run again"
        ) from None


def one_line(error: BaseException) -> str:
    """Message of an exception, on one printable line; its type where the message is empty."""
    return as_line(str(error)) or type(error).__name__


def first_fault(error: "ValidationError", whole: str = "") -> str:
    """The first value that a model refuses, and why, on one line.

    Args:
        error: of pydantic.
        whole: what the values are called together, where none of them is named.
    """
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"])) or whole
    text = as_line(first["msg"].removeprefix("Value error, "))
    return f"{where}: {text}" if where else text


def as_line(text: str) -> str:
    """External text made safe for a message: one line, printable, of limited length."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return plain if len(plain) <= _SHOWN else f"{plain[: _SHOWN - 3]}..."
