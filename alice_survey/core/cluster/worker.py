"""What a worker of a cluster does: check that it sees the files and has the code, run a task."""

import contextlib
import hashlib
import os
import pickle
import platform
import socket
import sys
import traceback
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from alice_survey.core.run.resources import user_folder, versions

_PACKAGES = ("alice_survey", "camera_calib", "missions", "reconstruct")


@dataclass(frozen=True)
class RunSite:
    """Where the tasks of a run find their files, and the code that they need."""

    folder: str
    """Current folder of the run, which relative paths start from."""
    store: Path
    """Absolute folder of the workspace for values that tasks share; each run has its own."""
    host: str
    """Machine of the run."""
    process: int
    """Its process there."""
    code: tuple[tuple[str, str], ...]
    """As `code_and_versions` gives it."""

    @property
    def mark(self) -> Path:
        """A file whose content is the name of its folder."""
        return self.store / "mark"


@dataclass(frozen=True)
class Answer:
    """What a worker sends back."""

    worker: str
    """Its address."""
    data: bytes = b""
    """Pickle of the result, or of the error."""
    failed: bool = False
    unfit: str = ""
    """Why the worker cannot do it."""
    is_below: bool = False
    """Whether the worker is a process below that of the run, whose computing counts as its own."""


@cache
def code_and_versions() -> tuple[tuple[str, str], ...]:
    """Names and versions of all that results depend on; that of alice-survey is a digest."""
    digest = hashlib.blake2b(digest_size=6)
    for package in _PACKAGES:
        spec = find_spec(package)
        root = Path(str(None if spec is None else spec.origin)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{path.relative_to(root)}".encode() + path.read_bytes())
    code = f"{versions().get('alice-survey', '')} ({digest.hexdigest()})"
    found = {**versions(), "alice-survey": code, "python": platform.python_version()}
    return tuple(sorted(found.items()))


def run_task(site: RunSite, function: bytes | str, arguments: bytes) -> Answer:
    """Run a task on this worker; whatever it raises is part of the answer."""
    from distributed import get_worker

    worker = get_worker()
    unfit = why_unfit(site, worker)
    if unfit:
        return Answer(worker.address, unfit=unfit)
    from alice_survey.core.cluster.shared_values import unpack

    failed = False
    try:
        with contextlib.chdir(site.folder):
            result = unpack(function, site.store)(*unpack(arguments, site.store))
    except Exception as error:  # whatever the task raises is for the run to handle
        error.add_note("".join(traceback.format_exception(error)))
        error.__cause__ = error.__context__ = None
        failed, result = True, error
        unfit = why_unfit(site, worker)  # it may have lost the files meanwhile
    return Answer(
        worker.address,
        data=_pickle(result),
        failed=failed,
        unfit=unfit,
        is_below=_is_below(site.host, site.process),
    )


def why_unfit(site: RunSite, dask_worker: Any) -> str:
    """Why this worker cannot run the tasks of a run; empty where it can."""
    _prepare(site.host)
    threads = dask_worker.state.nthreads
    if threads != 1:
        return (
            f"it runs {threads} tasks in one process, which share libraries that need one each: "
            "start it with --nthreads 1 (and --nworkers for its cores; threads_per_worker or "
            "processes in a cluster file)"
        )
    try:
        seen = site.mark.read_text()
        with contextlib.chdir(site.folder):
            pass
    except OSError as error:
        return (
            f"it does not see {error.filename or site.store} ({error.strerror}): the workspace "
            "must be on a file system that all machines have at the same path"
        )
    if seen != site.store.name:
        return f"{site.store} is another folder there"
    if not os.access(site.store, os.W_OK):
        return f"it cannot write in {site.store}"
    here, requested = dict(code_and_versions()), dict(site.code)
    for name in sorted(here.keys() | requested.keys()):
        if here.get(name) != requested.get(name):
            return (
                f"it has {name} {here.get(name, 'not at all')}, this machine has "
                f"{requested.get(name, 'none')}: install the same on both"
            )
    return ""


def _pickle(value: Any) -> bytes:
    try:
        return pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # an error of a library may not be picklable
        if not isinstance(value, BaseException):
            raise
        return pickle.dumps(RuntimeError(f"{type(value).__name__}: {value} ({error})"))


@cache
def _is_below(host: str, process: int) -> bool:
    import psutil

    above = [parent.pid for parent in psutil.Process().parents()]
    return socket.gethostname() == host and process in above


@cache
def _prepare(host: str) -> None:
    """Use one core; where this is another machine, compile kernels into a local folder of it.

    The folder may be read again by this user alone, since what is in it is run.
    """
    import cv2

    cv2.setNumThreads(1)
    if socket.gethostname() == host or "NUMBA_CACHE_DIR" in os.environ:
        return
    with contextlib.suppress(PermissionError):
        folder = os.environ["NUMBA_CACHE_DIR"] = str(user_folder("kernels"))
        if "numba" in sys.modules:
            sys.modules["numba"].config.CACHE_DIR = folder
