"""Large values that many tasks take: written once where all machines see them, not sent each time.

A value is pickled with its large arrays left out: each is a file, named by its content, that a
worker reads once and keeps.
"""

import hashlib
import io
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import zict

from alice_survey.core.artefacts import atomic_path

LARGE_BYTES = 1 << 15
"""Arrays from this size on are files, and so is a function whose pickle is larger."""
_KEPT_BYTES = 1 << 28
"""Arrays that a worker keeps."""


def pack(value: Any, folder: Path) -> bytes:
    """Pickle a value; its large arrays go into the folder."""
    data = io.BytesIO()
    _Pickler(data, folder).dump(value)
    return data.getvalue()


def pack_once(value: Any, folder: Path) -> bytes | str:
    """Pickle a value that many tasks take; a long pickle goes into the folder, and has a name."""
    data = pack(value, folder)
    if len(data) < LARGE_BYTES:
        return data
    name = f"{hashlib.blake2b(data, digest_size=16).hexdigest()}.pickle"
    with atomic_path(folder / name) as temporary:
        temporary.write_bytes(data)
    return name


def unpack(data: bytes | str, folder: Path) -> Any:
    """The value again, which shares nothing with other tasks."""
    content = data if isinstance(data, bytes) else _content(folder / data)
    return _Unpickler(io.BytesIO(content), folder).load()


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, folder: Path) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._folder = folder

    def persistent_id(self, value: Any) -> str | None:
        if type(value) is not np.ndarray or value.dtype.hasobject or value.nbytes < LARGE_BYTES:
            return None
        array = np.asarray(value, order="F" if value.flags.fnc else "C")
        digest = hashlib.blake2b(array.tobytes("A"), digest_size=16)
        digest.update(repr((array.dtype.descr, array.shape, array.flags.fnc)).encode())
        path = self._folder / f"{digest.hexdigest()}.npy"
        if not path.exists():
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                np.save(file, array)
        return path.name


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, folder: Path) -> None:
        super().__init__(file)
        self._folder = folder

    def persistent_load(self, name: Any) -> Any:
        path = self._folder / name
        found = _arrays.get(path)
        if found is None:
            found = _arrays[path] = np.load(path)
        return found.copy(order="K")


_arrays: Any = zict.LRU(_KEPT_BYTES, {}, weight=lambda _, array: array.nbytes)


@lru_cache(maxsize=8)
def _content(path: Path) -> bytes:
    return path.read_bytes()
