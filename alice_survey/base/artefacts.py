"""Stages of a workspace: folders that appear whole or not at all, skipped while nothing changed.

A stage folder is written as `NAME.partial` and renamed when complete. Its `stage.json` carries the
stage's version, its settings and a digest of every input file, and a later run skips the stage
while all of these still hold; also what the work took and the versions of the packages it used.
"""

import contextlib
import csv
import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alice_survey.base.errors import WorkspaceError
from alice_survey.base.run import progress
from alice_survey.base.run.resources import Meter, Spent, versions, watched

STAGE_FILE = "stage.json"
_SPENT_FILE = ".spent"
"""In an unfinished stage: what it has taken so far."""
_TEMPORARY = re.compile(r"\..+\.tmp\d+(\..*)?")
"""Names that `atomic_path` gives, and those that libraries make of them."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step of the loop: what it depends on and the folder it writes."""

    name: str
    version: int
    """Raise it when the stage's code changes its result."""
    settings: Mapping[str, Any]
    """Everything but files that the result depends on, as JSON values."""
    inputs: Sequence[Path] = ()
    """Files and folders that the result depends on; `stage.json` files inside do not count."""
    resumes: bool = False
    """Work can go on in what an interrupted run of the same digest left."""


_checking: ContextVar[bool] = ContextVar("checking", default=False)


@contextlib.contextmanager
def only_checking() -> Iterator[None]:
    """Within this block `run_stage` works nothing; it tells whether there would be work."""
    token = _checking.set(True)
    try:
        yield
    finally:
        _checking.reset(token)


def run_stage(workspace: Path, stage: Stage, work: Callable[[Path], None]) -> bool:
    """Do a stage's work unless its folder is there and nothing it depends on has changed.

    Args:
        workspace: folder that holds the stage folders; made when missing.
        stage: what to do it for.
        work: writes its files into the folder it is given (`NAME.partial`).

    Returns:
        True when the work was done, False when it was skipped.
    """
    if _checking.get():
        return not is_current(workspace, stage)
    final, partial = workspace / stage.name, workspace / f"{stage.name}.partial"
    replaced = workspace / f"{stage.name}.replaced"
    if replaced.exists():  # a kill fell between the two renames below
        if final.exists():
            shutil.rmtree(replaced)
        else:
            replaced.rename(final)
    previous = read_stage(final)
    with progress.step(f"check what {stage.name} depends on"):
        inputs = digest_inputs(stage.inputs, workspace, previous)
    digest = _digest_stage(stage, inputs)
    if previous is not None and previous.get("digest") == digest:
        if partial.exists():
            shutil.rmtree(partial)
        progress.skipped(stage.name)
        return False

    marker = partial / ".digest"
    resumed = stage.resumes and _text(marker) == digest
    if partial.exists() and not resumed:
        shutil.rmtree(partial)
    partial.mkdir(parents=True, exist_ok=True)
    _drop_cut_files(partial)
    with atomic_path(marker) as path:
        path.write_text(digest)
    told = {"resumed": True} if resumed else {}
    with progress.stage(stage.name, **told) as finish:
        spent = _measured(partial, work).to_json()
        _check_unchanged(inputs, workspace, stage.name)
        record = {
            "stage": stage.name,
            "version": stage.version,
            "digest": digest,
            "settings": stage.settings,
            "inputs": inputs,
            **spent,
            **told,
            "versions": versions(),
        }
        write_json(partial / STAGE_FILE, record)
        (partial / _SPENT_FILE).unlink(missing_ok=True)
        marker.unlink()
        if final.exists():
            final.rename(replaced)
        partial.rename(final)
        if replaced.exists():
            shutil.rmtree(replaced)
        finish(**spent, **told)
    return True


def _measured(partial: Path, work: Callable[[Path], None]) -> Spent:
    """Do a stage's work; what it took, with what was spent on it before it was interrupted."""
    try:
        earlier = Spent.from_json(json.loads((partial / _SPENT_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, KeyError):  # a kill may have come before the first
        earlier = Spent()
    meter = Meter(time.monotonic)

    def keep(spent: Spent) -> None:
        with contextlib.suppress(OSError):  # on a full disk the work itself will say so
            write_json(partial / _SPENT_FILE, spent.after(earlier).to_json())

    with watched(meter, keep):
        work(partial)
        return meter.look().after(earlier)


def is_current(workspace: Path, stage: Stage) -> bool:
    """Whether the stage's folder is there and nothing it depends on has changed."""
    previous = read_stage(workspace / stage.name)
    if previous is None:
        return False
    inputs = digest_inputs(stage.inputs, workspace, previous)
    return bool(previous.get("digest") == _digest_stage(stage, inputs))


def need_stage(workspace: Path, name: str, command: str) -> Path:
    """The folder of a finished stage.

    Raises:
        WorkspaceError: it is not there; the message names the command that makes it.
    """
    folder = workspace / name
    if read_stage(folder) is None:
        raise WorkspaceError(f"{folder} is not there yet; run 'alice-survey {command}' first")
    return folder


def read_stage(folder: Path) -> dict[str, Any] | None:
    """The content of a stage's `stage.json`, or None where no whole stage is."""
    try:
        record = json.loads((folder / STAGE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def digest_inputs(
    inputs: Sequence[Path], workspace: Path, previous: Mapping[str, Any] | None
) -> dict[str, list[Any]]:
    """Digest every file of the inputs, as `{path: [size, mtime_ns, digest]}`.

    A file whose size and modification time stand in `previous` is not read again.

    Raises:
        WorkspaceError: an input does not exist.
    """
    told = (previous or {}).get("inputs")
    known = told if isinstance(told, dict) else {}
    digests: dict[str, list[Any]] = {}
    for path in _files(inputs):
        name = os.path.relpath(path, workspace)
        digests[name] = _entry(path, known.get(name))
    return digests


def _check_unchanged(inputs: Mapping[str, Sequence[Any]], workspace: Path, stage: str) -> None:
    """Check that files are as they were when their digests were taken.

    Raises:
        WorkspaceError: one has changed or is gone.
    """
    for name, before in inputs.items():
        path, what = workspace / name, "has changed"
        try:
            same = _entry(path, before)[2] == before[2]
        except OSError:
            same, what = False, "has gone"
        if not same:
            raise WorkspaceError(
                f"{path} {what} while {stage} was worked on: what was made of it is not kept; run "
                "the same command again"
            )


def _entry(path: Path, old: object) -> list[Any]:
    """Size, modification time and digest of a file, which is read only if these differ from old."""
    stat = path.stat()
    if isinstance(old, list) and len(old) == 3 and old[:2] == [stat.st_size, stat.st_mtime_ns]:
        return old
    with path.open("rb") as file:
        content = hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    return [stat.st_size, stat.st_mtime_ns, content]


def _files(inputs: Sequence[Path]) -> Iterator[Path]:
    for path in inputs:
        if path.is_dir():
            inside = (p for p in sorted(path.rglob("*")) if p.is_file())
            yield from (p for p in inside if p.name != STAGE_FILE)
        elif path.is_file():
            yield path
        else:
            raise WorkspaceError(f"{path}: no such file or folder")


def _digest_stage(stage: Stage, inputs: Mapping[str, Sequence[Any]]) -> str:
    content = {name: entry[2] for name, entry in inputs.items()}
    text = json.dumps([stage.name, stage.version, stage.settings, content], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _text(path: Path) -> str | None:
    try:
        return path.read_text()
    except OSError:
        return None


def _drop_cut_files(folder: Path) -> None:
    """Remove what `atomic_path` was writing to when a kill came."""
    for path in folder.rglob(".*.tmp*"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file():
            path.unlink()


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A path to write to, beside `path`, that replaces it when all went well.

    Raises:
        WorkspaceError: there is a folder of that name.
    """
    if path.is_dir():
        raise WorkspaceError(f"{path} is a folder: give the name of a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp{os.getpid()}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON atomically, without NaN (which JSON lacks)."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        WorkspaceError: the file is missing or no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise WorkspaceError(f"{path}: no such file") from None
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise WorkspaceError(f"{path}: not valid JSON: {error}") from None


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file atomically; None and NaN become empty cells."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for row in rows:
            writer.writerow(["" if cell is None or cell != cell else cell for cell in row])
