"""Files of a workspace by the names that a request gives; nothing else can be reached."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote_to_bytes

from rasterio.errors import RasterioError

from alice_survey.core.artefacts import STAGE_FILE
from alice_survey.core.edited_files import StaleError
from alice_survey.core.errors import AliceError
from alice_survey.core.stages import LOOSE_FOLDERS, STAGES

PRODUCTS = (*(stage.folder for stage in STAGES), *LOOSE_FOLDERS, "check", "revisit")
"""Folders that are shown."""
_LOOSE_FILES = ("survey.toml",)
_MAX_PATH = 2000
_MAX_NAME = 255
_MAX_LISTED = 20_000
_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2})")
_UNFINISHED = (".partial", ".replaced")


class RefusedError(Exception):
    """A path that no file of a workspace can have."""


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
    if len(path) > _MAX_PATH:
        raise RefusedError(f"a path of {len(path)} characters: at most {_MAX_PATH} are taken")
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


def worked_on() -> StaleError:
    """What a page hears whose files are others by now."""
    return StaleError("the survey was worked on meanwhile: load the page again")


def token_of(status: os.stat_result) -> str:
    """Token of a file's content: another file, or the same file changed, has another."""
    return f"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}"


class Workspace:
    """A folder, of which files are opened to read."""

    def __init__(self, folder: Path) -> None:
        """Take a folder; it need not hold anything yet."""
        self.folder = folder.resolve()

    def file(self, names: Sequence[str]) -> Path:
        """A file, by the names along its path.

        Raises:
            FileNotFoundError: there is no such file, or it is a link or below one.
        """
        path = self._unlinked(names)
        if not path.is_file():
            raise FileNotFoundError(path)
        return path

    def has(self, path: str) -> bool:
        """Whether there is such a file; see `file`."""
        try:
            return bool(self.file(path.split("/")))
        except FileNotFoundError:
            return False

    def token(self, path: str) -> str:
        """Token of a file as it is now; see `file`."""
        return token_of(self.file(path.split("/")).stat())

    def is_folder(self, names: Sequence[str]) -> bool:
        """Whether a folder, not a link to one, is there."""
        try:
            return self._unlinked(names).is_dir()
        except FileNotFoundError:
            return False

    def listed(self, names: Sequence[str]) -> tuple[Sequence[Entry], int]:
        """Visible contents of a folder, folders first, and the number of further entries.

        Raises:
            FileNotFoundError: there is no such folder.
        """
        if not self.is_folder(names):
            raise FileNotFoundError
        with os.scandir(self._unlinked(names)) as entries:
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
        return found[:_MAX_LISTED], max(0, len(found) - _MAX_LISTED)

    def state(self, paths: Sequence[str]) -> tuple[str, ...]:
        """Tokens of all finished stages and of some files, empty where there is none."""
        files = (*(f"{name}/{STAGE_FILE}" for name in PRODUCTS), *paths)
        return tuple(self.token(path) if self.has(path) else "" for path in files)

    @contextmanager
    def unchanged(self, paths: Sequence[str] = ()) -> Iterator[tuple[str, ...]]:
        """The state of finished stages and of some files, which are read within this block.

        Raises:
            StaleError: they are others by now; what reading them raised gives way to that.
        """
        before = self.state(paths)
        try:
            yield before
        except (AliceError, OSError, RasterioError):
            if self.state(paths) != before:
                raise worked_on() from None
            raise
        if self.state(paths) != before:
            raise worked_on()

    def _unlinked(self, names: Sequence[str]) -> Path:
        path = self.folder.joinpath(*names)
        if path.resolve() != path:
            raise FileNotFoundError(path)
        return path


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
        and 0 < len(name.encode()) <= _MAX_NAME
    )
