"""A disk that loses, at a power cut, the content of files that were not synced."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

_CALLS = ((Path, "rename"), (Path, "replace"), (Path, "unlink"), (os, "fsync"), (shutil, "rmtree"))


class Disk:
    """Watches syncs of this process, and calls that change names, and shows what a cut leaves."""

    def __init__(self, patch: pytest.MonkeyPatch, after: Callable[["Disk", int], object]) -> None:
        """Begin to watch.

        Args:
            patch: undoes the watching.
            after: is called after each of the calls, with their number.
        """
        self.calls = 0
        self._synced: dict[int, tuple[int, int]] = {}
        """Size and time of files when they were synced last, by their inode."""
        self._after, self._is_busy = after, False
        for owner, name in _CALLS:
            patch.setattr(owner, name, self._watched(name, getattr(owner, name)))

    def _watched(self, name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*args: Any, **kwargs: Any) -> Any:
            result = original(*args, **kwargs)
            if name == "fsync":
                status = os.fstat(args[0])
                self._synced[status.st_ino] = (status.st_size, status.st_mtime_ns)
            if not self._is_busy:
                self.calls, self._is_busy = self.calls + 1, True
                self._after(self, self.calls)
                self._is_busy = False
            return result

        return watched

    def is_synced(self, path: Path) -> bool:
        """Whether a cut leaves the file whole."""
        status = path.stat()
        return self._synced.get(status.st_ino) == (status.st_size, status.st_mtime_ns)

    def after_cut(self, folder: Path, copy: Path) -> None:
        """Copy a folder as a cut would leave it; content that was not synced is lost."""
        shutil.copytree(folder, copy)
        for path in folder.rglob("*"):
            if path.is_file() and not self.is_synced(path):
                os.truncate(copy / path.relative_to(folder), 0)
