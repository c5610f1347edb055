"""Files that several edit: a change states what it is made to, and of two the second is refused."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import AliceError, WorkspaceError

_MAX_LENGTH = 512 << 20
"""Bytes of a file that is read whole."""


class StaleError(AliceError):
    """What is to be changed is no longer what was seen."""


def content_of(path: Path, maximum: int = _MAX_LENGTH) -> bytes | None:
    """The content of a file; None where there is none.

    Raises:
        WorkspaceError: it cannot be read, or is larger than so many bytes.
    """
    try:
        if path.stat().st_size > maximum:
            raise WorkspaceError(f"{path}: is larger than {maximum >> 20} MiB")
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {error.strerror}") from None


def content_token(content: bytes | None) -> str:
    """A token of a file's content; empty where there is no file."""
    return "" if content is None else hashlib.blake2b(content, digest_size=16).hexdigest()


def check_token(name: str, content: bytes | None, token: str | None) -> None:
    """Check that a change is made to what a file holds.

    Args:
        name: of the file.
        content: that it has now.
        token: of what the change is made to; None for whatever is there.

    Raises:
        StaleError: that was something else.
    """
    if token is not None and token != content_token(content):
        raise StaleError(
            f"{name} was changed meanwhile, by another page, a command or by hand: load it again; "
            "what you changed is not written"
        )


def replace_file(path: Path, content: bytes, check: Callable[[Path], object]) -> str:
    """Replace the content of a file if what it will hold can be read, and return its token.

    Raises:
        WorkspaceError: it cannot be written, or `check` refuses it.
    """
    try:
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
            try:
                check(temporary)
            except WorkspaceError as error:
                raise WorkspaceError(str(error).replace(str(temporary), path.name)) from None
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be written: {error.strerror}") from None
    return content_token(content)
