"""How the vehicle's kernels are compiled."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from numba import njit

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a function that allocates nothing, once for all processes.

    Without numba's runtime a function that would allocate an array does not compile, and none
    spends time on counting references: the equations of motion run seven times as fast.
    """
    compiled: Any = njit(cache=True, _nrt=False)(function)
    # numba keeps a compiled kernel as long as its own file stays as it is, though the kernels that
    # were compiled into it may have changed: here it is kept as long as the whole package stays.
    # A numba that stores its stamp elsewhere falls back to its own rule, which is enough for a
    # package that is installed and not edited.
    index: Any = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp"):
        index._source_stamp = _package_stamp()
    kept: Callable[_Arguments, _Result] = compiled
    return kept


@cache
def _package_stamp() -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every source of this package."""
    here = Path(__file__).parent
    files = sorted(here.rglob("*.py"))
    stats = ((file, file.stat()) for file in files)
    return tuple((str(f.relative_to(here)), s.st_mtime_ns, s.st_size) for f, s in stats)
