"""Files of a workspace by the names that a request gives; nothing else can be reached.

A path is walked folder by folder from the workspace, each opened below the one before, so that no
name leads out of it whatever happens to the folders meanwhile. Links are not followed.
"""

import errno
import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote_to_bytes

from alice_survey.base.artefacts import STAGE_FILE
from alice_survey.stages import LOOSE_FOLDERS, STAGES

PRODUCTS = (*(stage.folder for stage in STAGES), *LOOSE_FOLDERS, "check")
"""Folders that are shown."""
_LOOSE_FILES = ("survey.toml",)
_LONGEST_PATH = 2000
_LONGEST_NAME = 255
_MOST_LISTED = 20_000
_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2})")
_NOT_THERE = {
    errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.EACCES, errno.ENXIO, errno.ENAMETOOLONG,
}  # fmt: skip
"""Errors that count as missing for a reader: also a link, a socket and unreadable files."""
_UNFINISHED = (".partial", ".replaced")


class RefusedError(Exception):
    """A path that no file of a workspace can have."""


@dataclass(frozen=True, kw_only=True)
class OpenedFile:
    """A file, as it was when it was opened."""

    descriptor: int
    size: int
    modified_ns: int
    token: str
    """Token of this content: another file, or the same file changed, has another."""

    @property
    def path(self) -> str:
        """Path by which libraries open the same file, even after another took its name."""
        return f"/proc/self/fd/{self.descriptor}"

    def is_unchanged(self) -> bool:
        """Whether it is unchanged since it was opened."""
        return _token(os.fstat(self.descriptor)) == self.token

    def close(self) -> None:
        """Close it."""
        os.close(self.descriptor)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of a listing."""

    name: str
    is_folder: bool
    size: int


def names_of(path: str) -> tuple[str, ...]:
    """The names along the path of a request.

    Args:
        path: as it stands in the request, percent-encoded, below the folder of files.

    Raises:
        RefusedError: it climbs, is absolute, or has a name that no product has.
    """
    if len(path) > _LONGEST_PATH:
        raise RefusedError(f"a path of {len(path)} characters: at most {_LONGEST_PATH} are taken")
    if _ESCAPE.search(path):
        raise RefusedError("a percent sign without two digits of base 16")
    try:
        text = unquote_to_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise RefusedError("a path that is not UTF-8") from None
    names = tuple(text.removesuffix("/").split("/")) if text else ()
    for name in names:
        if not _may_be_named(name):
            raise RefusedError(
                "a path with an empty, hidden, unfinished or overlong name, a backslash or a "
                "character that cannot be printed"
            )
    if names and names[0] not in PRODUCTS and names != _LOOSE_FILES:
        raise RefusedError("not a product of a survey")
    return names


class Workspace:
    """A folder, of which files are opened to read."""

    def __init__(self, folder: Path) -> None:
        """Take a folder; it need not hold anything yet."""
        self.folder = folder.resolve()

    @contextmanager
    def opened(self, names: Sequence[str]) -> Iterator[OpenedFile]:
        """A file, closed at the end.

        Args:
            names: along its path, as `names_of` gives them.

        Raises:
            FileNotFoundError: there is no such file, or it is a link or a folder.
        """
        file = self.open(names)
        try:
            yield file
        finally:
            file.close()

    def open(self, names: Sequence[str]) -> OpenedFile:
        """A file that the caller closes; see `opened`."""
        if not names:
            raise FileNotFoundError
        with self._folder(names[:-1]) as folder:
            descriptor = _open(names[-1], os.O_RDONLY | os.O_NONBLOCK, folder)
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            os.close(descriptor)
            raise FileNotFoundError
        return OpenedFile(
            descriptor=descriptor,
            size=status.st_size,
            modified_ns=status.st_mtime_ns,
            token=_token(status),
        )

    def is_folder(self, names: Sequence[str]) -> bool:
        """Whether a folder, not a link to one, is there."""
        try:
            with self._folder(names):
                return True
        except FileNotFoundError:
            return False

    def listed(self, names: Sequence[str]) -> tuple[Sequence[Entry], int]:
        """Visible contents of a folder, folders first, and the number of further entries.

        Raises:
            FileNotFoundError: there is no such folder.
        """
        with self._folder(names) as folder, os.scandir(folder) as entries:
            found = sorted(
                (
                    Entry(
                        name=entry.name,
                        is_folder=entry.is_dir(follow_symlinks=False),
                        size=entry.stat(follow_symlinks=False).st_size,
                    )
                    for entry in entries
                    if _is_seen(entry, top=not names)
                ),
                key=lambda entry: (not entry.is_folder, entry.name),
            )
        return found[:_MOST_LISTED], max(0, len(found) - _MOST_LISTED)

    def token(self, *paths: str) -> str:
        """Token of the state of all finished stages and of some files; any change gives another.

        Args:
            paths: paths of the files.
        """
        tokens = []
        for path in (*(f"{name}/{STAGE_FILE}" for name in PRODUCTS), *paths):
            try:
                with self.opened(path.split("/")) as file:
                    tokens.append(file.token)
            except FileNotFoundError:
                tokens.append("")
        return " ".join(tokens)

    @contextmanager
    def _folder(self, names: Sequence[str]) -> Iterator[int]:
        descriptor = _open(str(self.folder), os.O_RDONLY | os.O_DIRECTORY, None)
        try:
            for name in names:
                below = _open(name, os.O_RDONLY | os.O_DIRECTORY, descriptor)
                os.close(descriptor)
                descriptor = below
            yield descriptor
        finally:
            os.close(descriptor)


def _open(name: str, flags: int, folder: int | None) -> int:
    try:
        return os.open(name, flags | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    except OSError as error:
        if error.errno not in _NOT_THERE:
            raise
        raise FileNotFoundError(error.errno, error.strerror) from None


def _is_seen(entry: os.DirEntry[str], *, top: bool) -> bool:
    name = entry.name
    if not _may_be_named(name):
        return False
    if top:
        is_product = name in PRODUCTS and entry.is_dir(follow_symlinks=False)
        return is_product or (name in _LOOSE_FILES and entry.is_file(follow_symlinks=False))
    return entry.is_dir(follow_symlinks=False) or entry.is_file(follow_symlinks=False)


def _may_be_named(name: str) -> bool:
    return (
        name.isprintable()  # neither NUL nor bytes that are not UTF-8
        and "\\" not in name
        and not name.startswith(".")
        and not name.endswith(_UNFINISHED)
        and 0 < len(name.encode()) <= _LONGEST_NAME
    )


def _token(status: os.stat_result) -> str:
    return f"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}"
