"""Compile kernels once for all processes, and again when any code they use changes.

numba keeps a compiled kernel as long as its file stays unchanged, although the kernels
and constants that were compiled into it may be in other files. Here a kernel is kept as long as
its call closure stays unchanged: its own code and options, and those of every kernel and constant
that it reaches.

All are compiled for x86-64-v3, whatever processor this is, so that a wheel can bring its kernels
along and computes what a clone computes. They are read from the folder `_kernels` next to their
module, which nobody needs to write to; what it lacks is compiled, and kept where numba keeps it.
"""

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import cache, cached_property
from pathlib import Path
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, ParamSpec, TypeVar, cast, overload

import numpy as np
from filelock import Timeout
from numba import njit
from numba.core import caching, config
from numba.core.codegen import get_host_cpu_features, ll
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher, cpu_target

from alice_survey.core.errors import note
from alice_survey.core.run import progress
from alice_survey.core.run.resources import user_folder, user_lock

_MAX_WAIT_S = 120.0
"""For another process that compiles the same kernel."""
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_KERNELS: dict[str, Any] = {}
"""By module and name."""
_kept: set[str] = set()
"""Names of those that this machine has compiled."""
TABLE = Path(__file__).with_name("kernels.json")
_CONSTANTS = (bool, int, float, complex, str, bytes, tuple, np.ndarray, np.generic)
PROCESSOR = "x86-64-v3"
_FEATURES = {"+avx2", "+bmi", "+bmi2", "+f16c", "+fma", "+lzcnt", "+movbe"}
"""Of that processor: Intel's since 2013, AMD's since 2015."""


def _choose_processor() -> str:
    """Have kernels compiled for `PROCESSOR`, in this process and in those that it starts.

    Returns:
        Why they are compiled for the processor of this machine; empty where they are not, or
        where the environment says what they are for.
    """
    name, features, why = PROCESSOR, "", ""
    if os.environ.get("NUMBA_CPU_NAME", name) != name:
        return ""
    if lacking := _FEATURES.difference(get_host_cpu_features().split(",")):
        why = f"it lacks {', '.join(sorted(lacking)).replace('+', '')}"
    elif "_toplevel_target_context" in vars(cpu_target):
        why = "numba was in use before alice_survey was imported"
    if why:
        name, features = ll.get_host_cpu_name(), get_host_cpu_features()
    os.environ.update(NUMBA_CPU_NAME=name, NUMBA_CPU_FEATURES=features)
    config.reload_config()
    return why


_WHY_THIS_PROCESSOR = _choose_processor()


@overload
def compiled(function: Callable[..., _Result]) -> Callable[..., _Result]: ...
@overload
def compiled(**options: Any) -> Callable[[Callable[..., _Result]], Callable[..., _Result]]: ...
def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function of plain loops, and keep the result on disk.

    Args:
        function: what to compile; left out when options are given.
        options: of `numba.njit`, such as `nogil=True` or `error_model="numpy"`.

    Returns:
        The kernel. numba compiles it again for each combination of types that it is given, so
        that its annotations do not limit what it takes.
    """

    def decorate(plain: Callable[..., Any]) -> Any:
        # A copy of such a kernel in the code of its caller may round in another way than its own
        # code, and whichever is loaded first is called: results would depend on what was compiled
        # before. What is inlined is always that of the caller.
        if options.get("fastmath"):
            return _compile_and_keep(plain, {"forceinline": True, **options})
        kernel = _compile_and_keep(plain, {**options, **_INNER})
        if isinstance(kernel, CPUDispatcher):
            kernel.__class__ = _Kernel
            kernel._cache._impl.rebuild = _load_inner
        return kernel

    return decorate if function is None else decorate(function)


def _compile_and_keep(plain: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compile a function, and keep the result on disk as long as its call closure is the same."""
    kernel = njit(**options)(plain)
    if isinstance(kernel, CPUDispatcher):
        kernel._cache = _Cache(plain)
        kernel._cache._cache_file = _Index(kernel)
        kernel.compile = _once_a_machine(kernel)
        _KERNELS[f"{plain.__module__}.{plain.__qualname__}"] = kernel
    return kernel


class _TemporaryFolder(caching.UserWideCacheLocator):  # type: ignore[misc]
    """Where neither the folder of the code nor the user's own may be written to."""

    def __init__(self, plain: Callable[..., Any], source: str) -> None:
        super().__init__(plain, source)
        name = self.get_suitable_cache_subpath(source)
        self._cache_path = str(user_folder("kernels") / name)


class _Place(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (*caching.CacheImpl._locator_classes, _TemporaryFolder)


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    _impl_class = _Place


class _Index(caching.IndexDataCacheFile):  # type: ignore[misc]
    """Files of a kernel's versions by their types: those kept here, and those of the package."""

    def __init__(self, kernel: Any) -> None:
        base, stamp = kernel._cache._impl.filename_base, _Stamp(kernel)
        super().__init__(kernel._cache.cache_path, base, stamp)
        folder = Path(kernel.py_func.__code__.co_filename).with_name("_kernels")
        self._shipped = caching.IndexDataCacheFile(str(folder), base, stamp)

    def _load_index(self) -> dict[Any, str]:
        files = {}
        # It holds the classes of arguments by their names, which an older version may have had.
        with suppress(AttributeError, ImportError):
            files.update(super()._load_index())
        for key, name in self._shipped._load_index().items():
            files[key] = self._shipped._data_path(name)
        return files

    def _save_index(self, files: dict[Any, str]) -> None:
        super()._save_index(
            {key: file for key, file in files.items() if not Path(file).is_absolute()}
        )


class _InnerCompiler(Compiler):  # type: ignore[misc]
    """Compiles a kernel for its callers alone, within which an entry makes machine code of it."""

    def __init__(self, typing: Any, target: Any, library: Any, *settings: Any) -> None:
        inner = target.subtarget(get_executable=_name_version)
        super().__init__(typing, inner, _code_to_link(target), *settings)


def _name_version(library: Any, description: Any, environment: Any) -> object:
    """What numba knows a version of a kernel by, in the place of its machine code."""
    return object()


def _code_to_link(target: Any) -> Any:
    """Code of a kernel that is kept as it was written, for its callers to link and to optimise."""
    code = target.codegen().create_library("kernel")
    code.enable_object_caching()

    def finalize() -> None:
        code._finalize_dynamic_globals()
        code._finalized = True

    code._optimize_final_module, code._finalize_final_module = lambda: None, finalize
    code.serialize_using_object_code = code.serialize_using_bitcode
    return code


def _load_inner(target: Any, kept: Any) -> Any:
    """A kernel that is kept for its callers."""
    (_, _, bitcode), *values, environments = kept
    code = _code_to_link(target)
    code._final_module, code._environments = ll.parse_bitcode(bitcode), environments
    code._finalize_final_module()
    inner = target.subtarget(get_executable=_name_version)
    inner.codegen = lambda: SimpleNamespace(unserialize_library=lambda _: code)
    return CompileResult._rebuild(inner, bitcode, *values, ())._replace(target_context=target)


class _Kernel(CPUDispatcher):  # type: ignore[misc]
    """A kernel as other kernels call it; Python calls `entry`, compiled when it does so.

    The code that unpacks arguments from Python objects is longer than most kernels: only those
    have it that are called from there.
    """

    def add_overload(self, result: Any) -> None:
        self.overloads[tuple(result.signature.args)] = result  # not where Python looks

    @cached_property
    def entry(self) -> Any:
        """The same kernel with that code."""
        plain = self.py_func
        outer = FunctionType(
            plain.__code__, plain.__globals__, plain.__name__, plain.__defaults__, plain.__closure__
        )
        outer.__kwdefaults__, outer.__module__ = plain.__kwdefaults__, plain.__module__
        outer.__qualname__ = f"{plain.__qualname__}.entry"
        options = self.targetoptions.items()
        return _compile_and_keep(
            outer, {key: value for key, value in options if key not in _NOT_OF_ENTRY}
        )

    @property
    def stats(self) -> Any:
        """What was loaded and compiled, for Python and for other kernels."""
        own, calls = super().stats, self.entry.stats
        return calls._replace(
            cache_hits=own.cache_hits + calls.cache_hits,
            cache_misses=own.cache_misses + calls.cache_misses,
        )

    def _compile_for_args(self, *args: Any, **named: Any) -> Any:
        called = self.entry._compile_for_args(*args, **named)
        for kinds, version in self.entry.overloads.items():
            if kinds not in self._inserted:
                self._inserted.add(kinds)
                for environment in version._find_referenced_environments():  # of inner kernels
                    version.codegen.set_env(environment.env_name, environment)
                self._insert([kind._code for kind in kinds], version.entry_point, False)
        return called

    @cached_property
    def _inserted(self) -> set[tuple[Any, ...]]:
        """Types of arguments with which Python calls the entry at once from now on."""
        return set()


_INNER: dict[str, Any] = {
    "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": _InnerCompiler,
}  # fmt: skip
_NOT_OF_ENTRY = {*_INNER, "nopython", "boundscheck"}


def compiled_ieee(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The same, where a division by zero gives infinity or NaN as in numpy, without a check.

    Other threads run meanwhile.
    """
    return compiled(error_model="numpy", nogil=True)(function)


def kernel(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compile a function that allocates nothing.

    Without numba's runtime a function that would allocate an array does not compile, and none
    spends time on counting references: equations of motion run seven times as fast.
    """
    return compiled(_nrt=False, error_model="numpy")(function)


def columns(count: int) -> tuple[int, ...]:
    """Places in an array for kernels that take one as an argument.

    A constant that is a Python integer has a type of its own, and its kernel a version for each.
    """
    return tuple(cast(int, np.int64(place)) for place in range(count))


def closure_digest(kernel: Any) -> str:
    """Digest of all the code in a compiled kernel.

    Args:
        kernel: a function decorated by `compiled` or `numba.njit`.

    Returns:
        32 hexadecimal digits, which change with the kernel's code (not with its comments, its
        docstring or its place in the file), its options, and those of all it calls, as well as
        with the global constants that any of these reads.
    """
    digest = hashlib.blake2b(digest_size=16)
    for part in _closure(kernel, set()):
        digest.update(part.encode(errors="surrogatepass"))
        digest.update(b"\0")
    return digest.hexdigest()


def left_to_compile(stage: str = "") -> dict[str, float]:
    """Kernels of a stage that this machine is still to compile, and how long each takes.

    Args:
        stage: name of its folder; of all stages without, and for work that is none of them.

    Returns:
        Seconds on the machine of `python -m tests.test_kernels`, for kernels that are
        imported by now.
    """
    table = _seconds()
    of_all = {name: seconds for part in table.values() for name, seconds in part.items()}
    return {name: s for name, s in table.get(stage, of_all).items() if _is_missing(name)}


@cache
def _seconds() -> dict[str, dict[str, float]]:
    """Seconds that kernels take to compile, by stage and name."""
    found: dict[str, dict[str, float]] = json.loads(TABLE.read_text(encoding="utf-8"))
    return found


def _is_missing(name: str) -> bool:
    """Whether a kernel that is imported has no version that is kept."""
    kernel: Any = _KERNELS.get(name.removesuffix(".entry"))
    if kernel is None or name in _kept:
        return False
    # What it calls may not be defined yet, and its digest is kept.
    if getattr(sys.modules[kernel.__module__].__spec__, "_initializing", False):
        return False
    part = kernel.entry if name.endswith(".entry") else kernel
    if part._cache._cache_file._load_index():
        _kept.add(name)
    return name not in _kept


def _once_a_machine(kernel: Any) -> Callable[[Any], Any]:
    """What compiles a kernel for a signature, or loads what is kept.

    It does so while no other process of this machine compiles that kernel, so that of processes
    that start together one compiles and the others load.
    """
    compile_it, cache = kernel.compile, kernel._cache
    index = cache._cache_file
    name = hashlib.blake2b(index._index_path.encode(), digest_size=16).hexdigest()

    def compiled_once(signature: Any) -> Any:
        if cache._index_key(signature, kernel.targetctx.codegen()) in index._load_index():
            return compile_it(signature)
        _say_once()
        with ExitStack() as held:
            held.enter_context(global_compiler_lock)  # first: other threads may hold it
            with suppress(OSError, Timeout):  # then it is compiled once more
                held.enter_context(user_lock(f"kernel-{name}", _MAX_WAIT_S))
            return compile_it(signature)

    return compiled_once


@cache
def _say_once() -> None:
    if _WHY_THIS_PROCESSOR:
        note(f"kernels are compiled for this processor, and kept: {_WHY_THIS_PROCESSOR}")


class _Stamp:
    """A kernel's digest, computed when first compared: all that it calls is defined by then.

    It is stored as plain text, so that a cache can be read without this class.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._digest: str | None = None

    def _value(self) -> str:
        if self._digest is None:
            self._digest = closure_digest(self._kernel)
        return self._digest

    def __eq__(self, other: object) -> bool:
        return self._value() == other

    def __hash__(self) -> int:
        return hash(self._value())

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        return str, (self._value(),)


def _closure(kernel: Any, seen: set[int]) -> Iterator[str]:
    """All code that a kernel uses, itself first; each kernel once."""
    if id(kernel) in seen:
        return
    seen.add(id(kernel))
    plain = kernel.py_func
    yield f"{plain.__module__}.{plain.__qualname__}"
    yield repr(sorted((name, _text(value)) for name, value in kernel.targetoptions.items()))
    yield repr((plain.__defaults__, plain.__kwdefaults__))
    yield from _code(plain.__code__, plain.__doc__)
    for name, value in _references(plain):
        if hasattr(value, "py_func"):
            yield from _closure(value, seen)
        elif isinstance(value, _CONSTANTS):
            yield f"{name}={_text(value)}"


def _code(code: CodeType, doc: str | None) -> Iterator[str]:
    """A function's code without file, line numbers and docstring."""
    yield code.co_code.hex()
    yield repr((code.co_names, code.co_varnames, code.co_freevars, code.co_argcount))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant, None)
        elif constant is None or constant != doc:
            yield _text(constant)


def _references(plain: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """Global and enclosed values that a function names, and those it names within modules."""
    code, known = plain.__code__, plain.__globals__
    for name, cell in zip(code.co_freevars, plain.__closure__ or (), strict=True):
        yield name, cell.cell_contents
    names = sorted(_names(code))
    for name in names:
        value = known.get(name)
        if isinstance(value, ModuleType):
            inside = vars(value)
            yield from ((f"{name}.{other}", inside[other]) for other in names if other in inside)
        elif name in known:
            yield name, value


def _names(code: CodeType) -> set[str]:
    inside = (_names(part) for part in code.co_consts if isinstance(part, CodeType))
    return set(code.co_names).union(*inside)


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str}{value.shape}{np.ascontiguousarray(value).tobytes().hex()}"
    if isinstance(value, (set, frozenset)):
        return repr(sorted(map(repr, value)))
    return repr(value)


progress.left_to_compile = left_to_compile
