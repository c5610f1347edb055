"""What all tests share."""

import hashlib
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from tests.small_survey import SMALL, TINY, settings_in, start

# As the command line does, and before numpy is loaded: several threads for small matrices wait for
# each other by spinning, which made a fit to a log take eight times the processor's time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Containers often forbid bytecode, which each program that a test starts would compile again.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A shell that starts the suite in the background lets it ignore Ctrl-C, which programs inherit.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Work is so little here that programs which start workers would load libraries more than they save.
if hasattr(os, "sched_setaffinity") and (worker := os.environ.get("PYTEST_XDIST_WORKER")):
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(worker[2:]) % len(cores)]})

# How long an example takes depends on what else the machine does, kernels to compile included.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

ROOT = Path(__file__).parents[1]
PACKAGES = ("alice_survey", "camera_calib", "missions", "reconstruct")
CACHE = ROOT / ".pytest_cache" / "surveys"
DAILY_EXAMPLES = 15
"""Of hypothesis in `make test`; in `make test-all` as many as each test states."""
MAX_CPU_S = 5.0
"""Processor's time of a test that is not `slow`, without its fixtures; on a machine with other work
it may be three times as much, where threads share a core."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with what takes long: at the end short tests leave no worker without work.

    One worker runs all tests of a file, so that fixtures are made and kernels loaded once.
    """
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(str(item.path.relative_to(ROOT / "tests"))))
    for item in items if config.option.markexpr == "not slow" else ():
        function = getattr(item, "obj", None)
        stated = getattr(function, "_hypothesis_internal_use_settings", None)
        if stated is not None and stated.max_examples > DAILY_EXAMPLES:
            few = settings(stated, max_examples=DAILY_EXAMPLES)
            getattr(function, "__func__", function)._hypothesis_internal_use_settings = few


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Fail a daily test that takes too long, unless it compiled kernels, as in a fresh clone."""
    began_s, before_s = time.time(), _cpu_s()
    yield
    spent_s = _cpu_s() - before_s
    is_slow = item.get_closest_marker("slow") is not None
    if spent_s > 3 * MAX_CPU_S and not is_slow and not _has_compiled(began_s):
        pytest.fail(f"{spent_s:.1f} CPU s, more than {MAX_CPU_S:g}: shorten it or mark it slow")


def _cpu_s() -> float:
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def _has_compiled(since_s: float) -> bool:
    """Whether a kernel was kept since then, by this process or another."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    kept = Path(folder).rglob("*.nbi") if folder else ROOT.glob("[acmrt]*/**/*.nbi")
    return any(file.stat().st_mtime >= since_s - 1.0 for file in kept)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data next to the checkout; without it the test is skipped, never in CI."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"CI needs the real data at {folder}")
        pytest.skip(f"no real data at {folder}")
    return folder


def _state() -> str:
    """Digest of all that the surveys depend on."""
    digest = hashlib.blake2b(f"{SMALL}{TINY}{sys.version}".encode(), digest_size=8)
    for one in sorted(distributions(), key=lambda one: one.name):
        digest.update(f"{one.name} {one.version}".encode())
    for path in sorted(file for name in PACKAGES for file in (ROOT / name).rglob("*.[pt]*")):
        if path.suffix in (".py", ".toml"):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _survey(name: str, text: str) -> Path:
    """A finished workspace, made once while code and libraries stay."""
    CACHE.mkdir(parents=True, exist_ok=True)
    with FileLock(CACHE / f"{name}.lock"):
        state = _state()
        folder = CACHE / state / name
        if not (folder / "done").exists():
            for older in {*CACHE.iterdir()} - {CACHE / state}:
                shutil.rmtree(older, ignore_errors=True)
            shutil.rmtree(folder, ignore_errors=True)
            assert start(settings_in(folder / "survey", text), threads=1).wait() == 0
            if _state() == state:  # nobody edited meanwhile
                (folder / "done").touch()
    return folder / "survey"


@pytest.fixture(scope="session")
def small_survey() -> Path:
    """A survey whose results were compared with the truth; copy it to write into it."""
    return _survey("small", SMALL)


@pytest.fixture(scope="session")
def tiny_survey() -> Path:
    """A smaller one, to be compared with itself."""
    return _survey("tiny", TINY)
