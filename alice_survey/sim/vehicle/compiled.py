"""How the vehicle's kernels are compiled."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from alice_survey.core.compiled import compiled

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a function that allocates nothing, once for all processes.

    Without numba's runtime a function that would allocate an array does not compile, and none
    spends time on counting references: the equations of motion run seven times as fast.
    """
    kept: Callable[_Arguments, _Result] = compiled(_nrt=False)(function)
    return kept
