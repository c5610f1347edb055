"""How kernels are compiled: once for all processes, and anew when any source of their room changes.

numba keeps a compiled kernel as long as its own file stays as it is, though the kernels that were
compiled into it may have changed: here it is kept as long as the whole room stays. A numba that
stores its stamp elsewhere falls back to its own rule, which is enough for a package that is
installed and not edited.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from numba import njit

from alice_survey.base.errors import note

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def compiled(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a function of plain loops, for a room such as `missions`."""
    kept: Callable[_Arguments, _Result] = stamped(njit(cache=True)(function), _room(function))
    return kept


def compiled_ieee(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The same, where a division by zero gives infinity or NaN as numpy has it, without a check."""
    compiled = njit(cache=True, error_model="numpy")(function)
    kept: Callable[_Arguments, _Result] = stamped(compiled, _room(function))
    return kept


def stamped(kernel: Any, room: Path) -> Any:
    """A kernel of numba's that is kept as long as no source of a room changes."""
    index: Any = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp"):
        index._source_stamp = _stamp(room)
    return kernel


def tell_of_compiling(kernel: Any, what: str) -> None:
    """Say, in one line on standard error, that the first call after an installation waits.

    Args:
        kernel: one that is compiled last, by `compiled`.
        what: that is compiled, and how long it takes.
    """
    stats = kernel.stats
    kept = Path(stats.cache_path).glob(f"*{kernel.__name__}*.nbi")
    if not stats.cache_hits and not stats.cache_misses and not any(kept):
        note(f"compiling {what}")


def _room(function: Callable[..., Any]) -> Path:
    """The top-level package of a function."""
    return Path(function.__code__.co_filename).parents[function.__module__.count(".") - 1]


@cache
def _stamp(room: Path) -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every source of a room."""
    stats = ((file, file.stat()) for file in sorted(room.rglob("*.py")))
    return tuple((str(f.relative_to(room)), s.st_mtime_ns, s.st_size) for f, s in stats)
