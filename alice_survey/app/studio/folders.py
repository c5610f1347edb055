"""Folders of this machine, for a person to choose the one that holds their pictures.

What may be listed lies in the person's home, or in a folder whose path they have typed. Links are
not followed, and hidden folders are not shown.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from alice_survey.core.errors import AliceError, why
from reconstruct.pictures.files import VIDEO, kind_of

_MAX_FOLDERS = 500
_MAX_ENTRIES = 20_000
_CHOSEN = (".csv", ".json")
"""Endings of files that a person may choose next to their pictures."""


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A folder, and what it holds itself."""

    path: str
    name: str
    pictures: int
    videos: int
    folders: int
    more: bool = False
    """Whether it holds more than was counted."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """A folder with those inside."""

    here: Folder
    above: str | None
    """The folder that it lies in, if that may be listed."""
    inside: Sequence[Folder]
    files: Sequence[str]
    """Paths of CSV and JSON files: logs and calibrations."""


class Folders:
    """What may be listed: the home, and what was typed since the studio has started."""

    def __init__(self, home: Path | None = None) -> None:
        """Take the home, this user's if none is given."""
        self._roots = [(Path.home() if home is None else home).resolve()]

    def listed(self, path: str, *, typed: bool) -> Listing:
        """The folders inside one.

        Args:
            path: of it; empty for the home.
            typed: whether a person has typed it, and so allows to list what is below.

        Raises:
            AliceError: it is no folder, cannot be read, or may not be listed.
        """
        place = Path(path).expanduser() if path else self._roots[0]
        if "\0" in path or not place.is_absolute():
            raise AliceError(f"{path}: not a whole path, such as {self._roots[0] / 'dive'}")
        real = place.resolve()
        if not real.is_dir():
            raise AliceError(f"{place}: no such folder")
        if typed:
            self._roots.append(real)
        if not self._may_list(real):
            raise AliceError(f"{place} lies outside of {self._roots[0]}: type its path to list it")
        above = real.parent
        try:
            with os.scandir(real) as entries:
                seen = [entry for entry in islice(entries, _MAX_ENTRIES) if _is_shown(entry)]
        except OSError as error:
            raise AliceError(f"{real}: cannot be listed: {why(error)}") from None
        seen.sort(key=lambda entry: entry.name.lower())
        inside = [Path(e.path) for e in seen if e.is_dir(follow_symlinks=False)]
        files = [e for e in seen if e.is_file(follow_symlinks=False)]
        return Listing(
            here=_counted(real),
            above=str(above) if above != real and self._may_list(above) else None,
            inside=[_counted(one) for one in inside[:_MAX_FOLDERS]],
            files=[e.path for e in files if Path(e.name).suffix.lower() in _CHOSEN],
        )

    def _may_list(self, real: Path) -> bool:
        return any(real.is_relative_to(root) for root in self._roots)


def _is_shown(entry: os.DirEntry[str]) -> bool:
    return not entry.name.startswith(".") and entry.name.isprintable()


def _counted(folder: Path) -> Folder:
    """A folder with the numbers of its pictures, videos and folders; one that cannot be read, 0."""
    pictures = videos = folders = entries_n = 0
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                entries_n += 1
                if entries_n > _MAX_ENTRIES:
                    break
                if not _is_shown(entry):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    folders += 1
                elif kind_of(Path(entry.name)):
                    pictures += 1
                elif Path(entry.name).suffix.lower() in VIDEO:
                    videos += 1
    except OSError:
        pass
    return Folder(
        path=str(folder), name=folder.name or str(folder), pictures=pictures, videos=videos,
        folders=folders, more=entries_n > _MAX_ENTRIES,
    )  # fmt: skip
