"""Compiled kernels are kept between processes, and dropped when what they are made of changes."""

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from alice_survey.core.compiled import closure_digest, kernel
from tests import structure

ASK = "import inner, outer; print(outer.twice(3.0), sum(outer.twice.stats.cache_hits.values()))"
INNER = '''
from alice_survey.core.compiled import compiled
{above}
OFFSET = {offset}

@compiled
def once(x):
    """{doc}"""
    return x + OFFSET
'''
OUTER = """
from alice_survey.core.compiled import compiled
import numbers_used
from inner import once

@compiled
def twice(x):
    return once(x) * numbers_used.FACTOR
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path)
    (tmp_path / "outer.py").write_text(OUTER)
    assert ask(tmp_path) == (8.0, 0)
    return tmp_path


def write(
    folder: Path, offset: float = 1.0, factor: float = 2.0, above: str = "", doc: str = ""
) -> None:
    (folder / "inner.py").write_text(INNER.format(offset=offset, above=above, doc=doc))
    (folder / "numbers_used.py").write_text(f"FACTOR = {factor}\nUNUSED = 1\n")


def asking(folder: Path) -> dict[str, str]:
    """Environment of a process that imports from a folder and keeps its kernels there."""
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(folder), str(Path(__file__).parents[3])]),
        "NUMBA_CACHE_DIR": str(folder / "kept"),
        "PYTHONDONTWRITEBYTECODE": "1",  # which an edit in the same second would leave
    }


def ask(folder: Path, code: str = ASK, **places: str) -> tuple[float, int]:
    environment = asking(folder) | places
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    value, hits = done.stdout.split()
    return float(value), int(hits)


def test_a_kernel_is_kept_between_processes(folder: Path) -> None:
    assert ask(folder) == (8.0, 1)


def test_only_what_python_calls_unpacks_arguments_from_objects(folder: Path) -> None:
    kept = {path.name.partition("-")[0] for path in (folder / "kept").rglob("*.nbi")}
    assert kept == {"inner.once", "outer.twice.entry"}
    inside = "import inner, pickle; kernel = pickle.loads(pickle.dumps(inner.once))"
    assert ask(folder, f"{inside}; print(kernel(x=3), 0)") == (4.0, 0)


def test_kernels_left_to_compile_are_those_imported_and_not_kept(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "outer.py").write_text(OUTER)
    code = """
from alice_survey.core import compiled
once, twice = {"inner.once": 1.0}, {"outer.twice.entry": 2.0}
compiled._seconds = lambda: {"plan": {**once, "nowhere.at_all": 3.0}, "fly": twice}
import outer
left = lambda: [compiled.left_to_compile(stage) for stage in ("plan", "fly", "")]
assert left() == [once, twice, {**once, **twice}]
outer.twice(3.0)
print(0.0, sum(map(len, left())))
"""
    assert ask(tmp_path, code) == (0.0, 0)
    write(tmp_path, offset=2.0)  # what is kept is of no use any more
    assert ask(tmp_path, code) == (0.0, 0)


def test_a_kernel_is_kept_when_files_change_that_it_does_not_use(folder: Path) -> None:
    (folder / "other.py").write_text("FACTOR = 7.0\n")
    write(folder, above="# more lines\nUNUSED = 3.0\n", doc="Other words.")
    (folder / "numbers_used.py").write_text("UNUSED = 2\nFACTOR = 2.0\n")
    assert ask(folder) == (8.0, 1)


@pytest.mark.slow
def test_constants_and_code_of_a_called_kernel_count(folder: Path) -> None:
    write(folder, offset=10.0)
    assert ask(folder) == (26.0, 0)
    write(folder, factor=3.0)  # named through a module
    assert ask(folder) == (12.0, 0)
    write(folder)
    inner = (folder / "inner.py").read_text()
    (folder / "inner.py").write_text(inner.replace("x + OFFSET", "x - OFFSET"))
    assert ask(folder) == (4.0, 0)


@pytest.mark.slow
def test_a_kernel_whose_argument_has_a_new_class_name_is_compiled_again(tmp_path: Path) -> None:
    """The kept index names the old class, which is not there any more."""
    text = """
from typing import NamedTuple
from alice_survey.core.compiled import compiled

class {name}(NamedTuple):
    length: float

@compiled
def twice(x):
    return 2.0 * x.length + 2.0

def run(x):
    return twice({name}(x))
run.stats = twice.stats
"""
    (tmp_path / "inner.py").write_text("")
    ask_run = ASK.replace("outer.twice(3.0)", "outer.run(3.0)")
    for name in ("Old", "New"):
        (tmp_path / "outer.py").write_text(text.format(name=name))
        assert ask(tmp_path, ask_run) == (8.0, 0)
    assert ask(tmp_path, ask_run) == (8.0, 1)


@pytest.mark.slow
def test_kernels_of_the_package_are_loaded_from_a_folder_that_nobody_writes_to(folder):
    shipped = folder / "_kernels"
    shipped.mkdir()
    for file in list((folder / "kept").rglob("*.nb[ic]")):
        file.rename(shipped / file.name)
    before = {file: file.read_bytes() for file in shipped.iterdir()}
    assert ask(folder) == (8.0, 1)
    assert not list((folder / "kept").rglob("*.nb[ic]"))
    complex_too = ASK.replace("outer.twice(3.0)", "outer.twice(3.0) + abs(outer.twice(3.0j - 1))")
    assert [ask(folder, complex_too) for _ in range(2)] == [(14.0, 1), (14.0, 2)]
    assert {file: file.read_bytes() for file in shipped.iterdir()} == before
    shutil.rmtree(shipped)  # what was kept next to it does not lead there
    assert ask(folder, complex_too) == (14.0, 1)
    assert ask(folder) == (8.0, 1)


def test_kernels_are_kept_where_neither_package_nor_home_can_be_written_to(tmp_path):
    write(tmp_path)
    (tmp_path / "outer.py").write_text(OUTER)
    (tmp_path / "__pycache__").touch()
    (tmp_path / "temporary").mkdir()
    places = {"NUMBA_CACHE_DIR": "", "HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null",
              "TMPDIR": str(tmp_path / "temporary")}  # fmt: skip
    assert [ask(tmp_path, **places) for _ in range(2)] == [(8.0, 0), (8.0, 1)]


USED = "import numba; numba.njit(lambda x: x)(1)"
OLD = "import numba.core.codegen as c; c.get_host_cpu_features = lambda: '+sse2,-avx2,+bmi'"
HOST = llvm.get_host_cpu_name()


@pytest.mark.parametrize(
    ("before", "given", "name", "notes"),
    [
        ("import numba", "", "x86-64-v3", 0),
        pytest.param(USED, "", HOST, 1, marks=pytest.mark.slow),
        pytest.param(OLD, "x86-64-v3", HOST, 1, marks=pytest.mark.slow),  # by another machine
        ("", "nehalem", "nehalem", 0),
    ],
)
def test_kernels_are_for_one_processor_where_this_one_has_it(folder, before, given, name, notes):
    code = f"""
{before}
import os, outer
outer.twice(3.0); outer.twice(3)
print(outer.twice.targetctx.codegen().magic_tuple()[1], os.environ["NUMBA_CPU_NAME"])
"""
    environment = {k: v for k, v in asking(folder).items() if not k.startswith("NUMBA_CPU")}
    environment |= {"NUMBA_CPU_NAME": given} if given else {}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [name, name]  # processes that it starts load the same kernels
    assert len(done.stderr.splitlines()) == notes


def scaled(table: np.ndarray, unit: float = 1.0) -> Callable[[int], float]:
    def value(i: int) -> float:
        return float(table[i] * unit)

    return value


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (njit(scaled(np.array([1.0, 2.0]))), njit(scaled(np.array([1.0, 2.0]))), True),
        (njit(scaled(np.array([1.0, 2.0]))), njit(scaled(np.array([1.0, 2.5]))), False),
        (njit(scaled(np.ones(2), 1.0)), njit(scaled(np.ones(2), 2.0)), False),
        (njit(scaled(np.ones(2))), njit(error_model="numpy")(scaled(np.ones(2))), False),
    ],
)
def test_enclosed_values_and_options_count(first: object, second: object, same: bool) -> None:
    assert (closure_digest(first) == closure_digest(second)) is same


def test_recursion_ends() -> None:
    @njit
    def down(n: int) -> int:
        if n <= 0:
            return 0
        return int(down(n - 1) + 1)

    assert closure_digest(down) == closure_digest(down)


@pytest.mark.slow
def test_processes_that_start_together_compile_a_kernel_once(tmp_path):
    write(tmp_path)
    (tmp_path / "outer.py").write_text(OUTER)
    code = (
        "import pathlib, time, outer\n"
        "from inner import once\n"
        f"pathlib.Path({str(tmp_path / 'ready')!r} + str(__import__('os').getpid())).touch()\n"
        f"while len(list(pathlib.Path({str(tmp_path)!r}).glob('ready*'))) < 3: time.sleep(0.01)\n"
        "kernels = outer.twice, once\n"
        "print(outer.twice(3.0), *[sum(k.stats.cache_misses.values()) for k in kernels])"
    )
    environment = asking(tmp_path)
    started = [
        subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE)
        for _ in range(3)
    ]
    found = [process.communicate(timeout=120)[0].split() for process in started]
    assert [float(answer) for answer, *_ in found] == [8.0] * 3
    assert [sum(int(row[k]) for row in found) for k in (1, 2)] == [1, 1]


def test_a_kernel_cannot_allocate() -> None:
    def allocates(x: float) -> float:
        return float(np.zeros(3)[0] + x)

    with pytest.raises(TypingError):
        kernel(allocates)(1.0)


@pytest.mark.slow
def test_kernels_leave_numpys_library_alone() -> None:
    """numba compiles solvers, sorts and differences again for each kernel that calls them."""
    slow = re.compile(r"np\.(linalg\.\w+|diff|unique|argsort|sort|flatnonzero|take)$")
    found = []
    for package in structure.PACKAGES:
        for path in (structure.ROOT / package).rglob("*.py"):
            for part in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                marks = getattr(part, "decorator_list", ())
                if any(re.match(r"compiled|kernel", ast.unparse(mark)) for mark in marks):
                    calls = (ast.unparse(n.func) for n in ast.walk(part) if isinstance(n, ast.Call))
                    found += [f"{path}: {call}" for call in calls if slow.match(call)]
    assert not found
