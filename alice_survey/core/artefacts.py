"""Stages of a workspace: folders that appear whole or not at all, skipped while nothing changed.

A stage folder is written as `NAME.partial`, synced to the disk, and renamed when complete. Its
`stage.json` carries the stage's version, its settings and a digest of every input and output file,
and a later run skips the stage while all of these are unchanged; also the resources used and the
versions of the packages.
"""

import codecs
import contextlib
import csv
import errno
import functools
import hashlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from alice_survey.core.contents import MAX_TEXT, as_line, first_fault, ordinary_file
from alice_survey.core.errors import (
    AliceError,
    NavigationError,
    WorkspaceError,
    file_faults,
    offer,
    warn,
    why,
)
from alice_survey.core.run import progress
from alice_survey.core.run.resources import processor, versions, watch_meter

T = TypeVar("T")

STAGE_FILE = "stage.json"
EXPORTS = "exports"
"""Folder, within a stage's, of what it writes for vehicles and other programs."""
_TEMPORARY = re.compile(r"\..+\.tmp[0-9a-f]+(\..*)?")
"""Names that `atomic_path` gives, and those that libraries derive from them."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step of the loop: its dependencies and the folder it writes."""

    name: str
    version: int
    """Increase it when the stage's code changes its result."""
    settings: Mapping[str, Any]
    """Everything but files that the result depends on, as JSON values."""
    inputs: Sequence[Path] = ()
    """Files and folders that the result depends on; `stage.json` files inside do not count."""
    resumes: bool = False
    """Work can resume from what an interrupted run of the same digest left."""
    command: str = ""
    """The command that makes it."""


class JsonRecord(BaseModel):
    """A JSON file of a workspace: a frozen value that is read and written whole.

    Values that a subclass does not name are kept as they are, so that a file of another version of
    the program is read and written without loss.
    """

    model_config = ConfigDict(frozen=True, extra="allow", populate_by_name=True)
    path: ClassVar[str] = ""
    """Path of the file, from the workspace."""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file.

        Raises:
            WorkspaceError: it is missing, not JSON, or lacks a value.
        """
        try:
            return cls.model_validate(read_json(path))
        except ValidationError as error:
            raise WorkspaceError(
                f"{path}: {first_fault(error, 'its content')}: the file is damaged or was edited; "
                "remove the folder and run the command that makes it again"
            ) from None

    @classmethod
    def read_existing(cls, path: Path) -> Self | None:
        """Read a file; None where it is missing."""
        return cls.read(path) if path.is_file() else None

    def to_json(self) -> dict[str, Any]:
        """The values as JSON holds them."""
        return self.model_dump(mode="json", by_alias=True)

    @classmethod
    def save(cls, path: Path, values: Mapping[str, Any]) -> Self:
        """Write values that make up a file of this type."""
        record = cls.model_validate(values)
        record.write(path)
        return record

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_json(path, self.to_json())


FileEntry = tuple[int, int, str]
"""Size, modification time (ns) and digest of a file."""


class StageRecord(JsonRecord):
    """`stage.json`: inputs of a finished stage, and the resources used."""

    stage: str = ""
    """Name of its folder."""
    version: int = 0
    digest: str = ""
    settings: dict[str, Any] = Field(default_factory=dict)
    command: str = ""
    """The command that made it; empty where an older version of the program did."""
    inputs: dict[str, FileEntry] = Field(default_factory=dict)
    """By their paths from the workspace."""
    outputs: dict[str, FileEntry] = Field(default_factory=dict)
    """All files but this one, by their paths from its folder; empty of an older version."""
    checksum: str = ""
    """Of all other values; none of an older version."""
    took_s: float = 0.0
    cpu_s: float | None = None
    peak_mib: float | None = None
    resumed: bool = False
    """Whether these are of the last run alone, which went on from what an earlier one left."""
    processor: str = ""
    """What it was made on; empty where an older version of the program made it."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Versions of the packages that affect results."""


def run_stage(workspace: Path, stage: Stage, work: Callable[[Path], object]) -> bool:
    """Do a stage's work unless its folder exists and nothing it depends on has changed.

    Args:
        workspace: folder that holds the stage folders; made when missing.
        stage: the stage to run.
        work: writes its files into the folder it is given (`NAME.partial`).

    Returns:
        True when the work was done, False when it was skipped.

    Raises:
        WorkspaceError: an input does not exist, or the folder is or holds a link.
    """
    final, partial = workspace / stage.name, workspace / f"{stage.name}.partial"
    replaced = workspace / f"{stage.name}.replaced"
    refuse_links(workspace, final, partial, replaced)
    restore_folder(final)
    previous = read_stage(final)
    with progress.step(f"check what {stage.name} depends on"):
        if previous is not None and why_stale(workspace, stage) is None:
            if partial.exists():
                shutil.rmtree(partial)
            progress.current().report("stage_skipped", stage=stage.name)
            return False
        inputs = _intact_inputs(stage.inputs, workspace)
    if previous is not None and (damaged := damage(final, previous)) is not None:
        warn(f"{final} is made again: {damaged}")
    digest = _digest_stage(stage, inputs)

    marker = partial / ".digest"
    resumed = stage.resumes and _text(marker) == digest
    if partial.exists() and not resumed:
        shutil.rmtree(partial)
    partial.mkdir(parents=True, exist_ok=True)
    _drop_cut_files(partial)
    with atomic_path(marker) as path:
        path.write_text(digest)
    how = {"resumed": True} if resumed else {}
    with progress.stage(stage.name, **how) as finish:
        with watch_meter() as meter:
            work(partial)
            spent = meter.look()
        _check_unchanged(inputs, workspace, stage.name)
        marker.unlink()
        record = {
            "stage": stage.name,
            "version": stage.version,
            "digest": digest,
            "settings": stage.settings,
            "command": stage.command,
            "inputs": inputs,
            "outputs": sync_folder(partial),
            **spent,
            **how,
            "processor": processor(),
            "versions": versions(),
        }
        write_json(partial / STAGE_FILE, record | {"checksum": _checksum(record)})
        replace_folder(final, partial)
        finish(**spent, **how)
    return True


def replace_folder(final: Path, partial: Path) -> None:
    """Put a folder, all of which is on the disk, in the place of another."""
    replaced = final.with_name(f"{final.name}.replaced")
    if final.exists():
        final.rename(replaced)
    partial.rename(final)
    sync(final.parent)
    if replaced.exists():
        shutil.rmtree(replaced)


def restore_folder(final: Path) -> None:
    """Undo what `replace_folder` had begun when a kill came between its renames."""
    replaced = final.with_name(f"{final.name}.replaced")
    if replaced.exists():
        if final.exists():
            shutil.rmtree(replaced)
        else:
            replaced.rename(final)


def refuse_links(root: Path, *paths: Path) -> None:
    """Refuse links below a folder, through which writing and deleting would leave it.

    Args:
        root: such as a workspace; it may be a link itself.
        paths: files and folders that are to be written or removed; what lies outside of the root,
            as a person has named it, is not looked at.

    Raises:
        WorkspaceError: one of them, a folder above it, or something inside it is a link.
    """
    for path in paths:
        if path.is_relative_to(root) and (link := _first_link(root, path)) is not None:
            raise WorkspaceError(
                f"{link} is a link, and a survey is not written through links: remove it, or "
                "replace it by what it points to"
            )


def _first_link(root: Path, path: Path) -> Path | None:
    above = itertools.takewhile(lambda one: one != root, (path, *path.parents))
    inside = (Path(folder, name) for folder, *both in os.walk(path) for name in chain(*both))
    return next((one for one in chain(above, inside) if one.is_symlink()), None)


def why_stale(workspace: Path, stage: Stage) -> str | None:
    """Changes since a stage was made, in a few words; None while it is up to date.

    Raises:
        WorkspaceError: an input does not exist.
    """
    record = read_stage(workspace / stage.name)
    if record is None:
        return "missing"
    damaged = damage(workspace / stage.name, record)
    if damaged is not None:
        return f"damaged: {damaged}"
    inputs = digest_inputs(stage.inputs, workspace, record)
    if record.digest == _digest_stage(stage, inputs):
        return None
    if record.version != stage.version:
        return f"made by version {record.version} of the stage, now {stage.version}"
    settings = json.loads(json.dumps(stage.settings))
    changed = list(_different(record.settings, settings))
    if changed:
        return f"changed: {_first(changed)}"
    content = {name: entry[2] for name, entry in record.inputs.items()}
    return f"changed: {_first(list(_different(content, {n: e[2] for n, e in inputs.items()})))}"


def _different(old: object, new: object, name: str = "") -> Iterator[str]:
    """Dotted names of the values in which two JSON values differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            yield from _different(old.get(key), new.get(key), f"{name}.{key}" if name else str(key))
    elif old != new:
        yield name


def _first(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def need_stage(workspace: Path, name: str, command: str) -> Path:
    """The folder of a finished stage.

    Raises:
        WorkspaceError: it is not there, or a file of it is not as it was written; the message names
            the command that makes it.
    """
    folder = workspace / name
    record = read_stage(folder)
    if record is None:
        first = stage_command(command, workspace)
        raise WorkspaceError(f"{folder} is not there yet; run {first!r} first")
    refuse_damage(folder, record)
    return folder


def stage_command(command: str, workspace: Path) -> str:
    """The command that makes a stage of a workspace, as a shell takes it."""
    given = {"import-images": ("PICTURES",), "join": ("DIVE", "DIVE")}.get(command, ())
    return offer(command, *given, "-w", workspace)


def refuse_damage(folder: Path, record: StageRecord | None) -> None:
    """Refuse a stage whose files, missions for vehicles apart, are not as it wrote them.

    Raises:
        WorkspaceError: the message names the file, and the command that makes it.
    """
    damaged = None if record is None else damage(folder, record, exports=False)
    if record is not None and damaged is not None:
        raise _damage_error(folder, record, damaged)


def read_stage(folder: Path) -> StageRecord | None:
    """Contents of a stage's `stage.json`, or None where there is no complete stage.

    That of a damaged file is None too.
    """
    try:
        content = (folder / STAGE_FILE).read_bytes()
        record = StageRecord.model_validate_json(content)
        if not record.checksum and not record.outputs:
            return record  # of an older version of the program
        values = json.loads(content)
        return record if values.pop("checksum", "") == _checksum(values) else None
    except (OSError, ValueError):
        return None


def damage(
    folder: Path, record: StageRecord, *, exports: bool = True, entirely: bool = False
) -> str | None:
    """What is not as a stage wrote it, in a few words; None where all is.

    Args:
        folder: of the stage.
        record: its `stage.json`.
        exports: look at missions for vehicles too, which other stages do not read.
        entirely: read all files; else only those of another size or modification time.
    """
    for name, entry in record.outputs.items():
        if not exports and _is_export(name):
            continue
        path = folder / name
        try:
            if not _is_entry(path, _entry(path, None if entirely else entry), entry):
                return f"{name} has changed since it was written"
        except FileNotFoundError:
            return f"{name} is missing"
        except OSError as error:
            return f"{name} cannot be read ({why(error)})"
    return None


def renew_outputs(folder: Path, written: Iterable[Path]) -> None:
    """Record files that a command has written again into a finished stage's folder.

    Exports that it has removed are no longer asked for.
    """
    record = read_stage(folder)
    if record is None or not record.outputs:
        return
    outputs = {
        name: entry
        for name, entry in record.outputs.items()
        if not _is_export(name) or (folder / name).exists()
    }
    outputs |= {path.relative_to(folder).as_posix(): _entry(path, None) for path in written}
    values = record.to_json() | {"outputs": outputs}
    values.pop("checksum")
    write_json(folder / STAGE_FILE, values | {"checksum": _checksum(values)})


def _is_export(name: str) -> bool:
    return name.startswith(f"{EXPORTS}/")


def _is_entry(path: Path, now: FileEntry, written: FileEntry) -> bool:
    """Whether a file holds what was written.

    Where neither size nor time tells that it does not, its time does from now on, so that all see
    it who do not read it.
    """
    if now[2] != written[2] and now[:2] == written[:2]:
        with contextlib.suppress(OSError):  # of a workspace that cannot be written
            os.utime(path)
    return now[2] == written[2]


def _damage_error(folder: Path, record: StageRecord, damaged: str) -> WorkspaceError:
    by = record.command
    again = repr(stage_command(by, folder.parent)) if by else "the command that wrote it"
    return WorkspaceError(f"{folder}: {damaged}; run {again} again, which makes it")


def _checksum(record: Mapping[str, Any]) -> str:
    text = json.dumps(record, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def sync_folder(folder: Path) -> dict[str, FileEntry]:
    """Sync all that a folder holds, and take the digests of its files."""
    found = {}
    for path in sorted(folder.rglob("*")):
        sync(path)
        if path.is_file():
            found[path.relative_to(folder).as_posix()] = _entry(path, None)
    sync(folder)
    return found


def _intact_inputs(inputs: Sequence[Path], workspace: Path) -> dict[str, FileEntry]:
    """Read and digest every file of the inputs; those of stages as their stages wrote them.

    Raises:
        WorkspaceError: one does not exist, or is damaged.
    """
    given, makers = set(inputs), {}
    for folder in {workspace / Path(os.path.relpath(path, workspace)).parts[0] for path in inputs}:
        if (record := read_stage(folder)) is not None:
            makers[folder] = record
            for name in record.outputs:
                path = folder / name
                if not path.exists() and not given.isdisjoint((path, *path.parents)):
                    raise _damage_error(folder, record, f"{name} is missing")
    found = digest_inputs(inputs, workspace, None)
    for folder, record in makers.items():
        for name, entry in record.outputs.items():
            now = found.get(os.path.relpath(folder / name, workspace), entry)
            if not _is_export(name) and not _is_entry(folder / name, now, entry):
                raise _damage_error(folder, record, f"{name} has changed since it was written")
    return found


def digest_inputs(
    inputs: Sequence[Path], workspace: Path, previous: StageRecord | None
) -> dict[str, FileEntry]:
    """Digest every file of the inputs, as `{path: (size, mtime_ns, digest)}`.

    A file whose size and modification time match `previous` is not read again.

    Raises:
        WorkspaceError: an input does not exist.
    """
    known = {} if previous is None else previous.inputs
    digests = {}
    for path in _files(inputs):
        name = os.path.relpath(path, workspace)
        digests[name] = _entry(path, known.get(name))
    return digests


def _check_unchanged(inputs: Mapping[str, FileEntry], workspace: Path, stage: str) -> None:
    """Check that files are unchanged since their digests were taken.

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


def _entry(path: Path, old: FileEntry | None) -> FileEntry:
    """Size, modification time and digest of a file, which is read only if these differ from old."""
    stat = path.stat()
    if old is not None and old[:2] == (stat.st_size, stat.st_mtime_ns):
        return old
    with path.open("rb") as file:
        content = hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    return stat.st_size, stat.st_mtime_ns, content


def _files(inputs: Sequence[Path]) -> Iterator[Path]:
    for path in inputs:
        if path.is_dir():
            inside = (p for p in sorted(path.rglob("*")) if p.is_file())
            yield from (p for p in inside if p.name != STAGE_FILE)
        elif path.is_file():
            yield path
        elif path.exists():
            raise WorkspaceError(f"{path} is neither a file nor a folder (a pipe?): replace it")
        else:
            raise WorkspaceError(f"{path}: no such file or folder")


def _digest_stage(stage: Stage, inputs: Mapping[str, FileEntry]) -> str:
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
def atomic_path(path: Path, *, lasting: bool = True) -> Iterator[Path]:
    """A path to write to, next to `path`, that replaces it when all went well and is on the disk.

    Threads, processes and machines that write the same file each get a path of their own: the last
    one that finishes is kept, whole. What is not `lasting` a power cut may leave empty or in part.

    Raises:
        WorkspaceError: there is a folder of that name.
    """
    if path.is_dir():
        raise WorkspaceError(f"{path} is a folder: give the name of a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp{os.urandom(6).hex()}{path.suffix}")
    try:
        yield temporary
        if lasting:
            sync(temporary)
        temporary.replace(path)
        if lasting:
            sync(path.parent)
    except OSError as error:
        if error.filename is None:  # of a write to a file that is open
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until the disk holds a file's content, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # of file systems that cannot sync folders
            raise
    finally:
        os.close(handle)


_adapter: Callable[[Any], TypeAdapter[Any]] = functools.cache(TypeAdapter)


def check_type(kind: type[T], data: Any) -> T:
    """A value of a type from JSON values, which its fields must match.

    Raises:
        ValueError: names the first value that is wrong or missing.
    """
    try:
        value: T = _adapter(kind).validate_json(json.dumps(data))
        return value
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"])) or "the content"
        given = "" if isinstance(first["input"], dict) else f" = {first['input']!r:.60}"
        raise ValueError(f"{where}{given}: {first['msg']}") from None


def json_values(data: Any) -> Any:
    """Values, dataclasses and arrays as JSON holds them; NaN and infinity become None."""
    return to_jsonable_python(data, inf_nan_mode="null", fallback=lambda array: array.tolist())


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON atomically, without NaN (which JSON lacks)."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        WorkspaceError: the file is missing or not JSON.
    """
    try:
        with file_faults(path, WorkspaceError):
            return json.loads(ordinary_file(path).read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise WorkspaceError(f"{path}: not valid JSON: {error}") from None


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file atomically; None and NaN become empty cells."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for row in rows:
            writer.writerow(["" if cell is None or cell != cell else cell for cell in row])


def read_csv(
    path: Path,
    required: Iterable[str] = (),
    *,
    exact: bool = False,
    known: Collection[str] = (),
    fault: type[AliceError] = NavigationError,
) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Read a CSV file with a header.

    Args:
        path: the file, in UTF-8, UTF-16 with its mark or Windows-1252; cells are separated by
            commas, or by semicolons or tabs, and numbers may then have decimal commas.
        required: columns that must be there.
        exact: keep spaces at the ends of cells, which names of files may have; UTF-8 only.
        known: columns that are read: a warning names others. None are named if it is empty.
        fault: type of the error.

    Returns:
        Names of the columns, and rows by column with the number of their line; a cell that a row
        lacks is empty.

    Raises:
        AliceError: of type `fault`: the file cannot be read, is empty, lacks a column or has it
            twice, or has a row with more cells than the header.
    """
    names, rows = stream_csv(path, required, exact=exact, known=known, fault=fault)
    return names, list(rows)


def stream_csv(
    path: Path,
    required: Iterable[str] = (),
    *,
    exact: bool = False,
    known: Collection[str] = (),
    fault: type[AliceError] = NavigationError,
) -> tuple[list[str], Iterator[tuple[int, dict[str, str]]]]:
    """As `read_csv`; rows are read, and what is wrong with them is found, one by one."""
    lines = _cells(path, exact=exact, fault=fault)
    names = [name.strip() for name in next(lines, (1, []))[1]]
    missing = [name for name in required if name not in names]
    twice = [name for name in names if name and names.count(name) > 1]
    if not names:
        raise fault(f"{path}: is empty")
    if missing:
        raise fault(f"{path}: column {missing[0]} is missing; it has {as_line(', '.join(names))}")
    if twice:
        raise fault(f"{path}: column {as_line(twice[0])} occurs twice")
    if known and (lost := [name for name in names if name and name not in known]):
        warn(f"{path}: not read: columns {as_line(', '.join(lost))}")

    def rows() -> Iterator[tuple[int, dict[str, str]]]:
        for line, cells in lines:
            if any(map(str.strip, cells[len(names) :])):
                raise fault(
                    f"{path} line {line}: it has more cells than the header: decimal commas "
                    "between commas? Save numbers with points"
                )
            if cells:
                kept = itertools.zip_longest(names, cells[: len(names)], fillvalue="")
                yield line, {n: cell if exact else cell.strip() for n, cell in kept}

    return names, rows()


_DECIMAL_COMMA = re.compile(r"\s*([+-]?\d+),(\d+)\s*")
_LOOKED_AT = 1 << 16


def _cells(path: Path, *, exact: bool, fault: type[AliceError]) -> Iterator[tuple[int, list[str]]]:
    """Numbers of lines and their cells, in any encoding and with any separator that tables have."""
    with file_faults(path, fault):
        with ordinary_file(path).open("rb") as raw:
            encoding = "utf-8-sig" if exact else _encoding_of(raw.read(_LOOKED_AT))
        with path.open(newline="", encoding=encoding) as file:
            start, first, skipped = 0, file.readline(), 0
            while first.startswith("#"):  # comments, and a header may begin with "#"
                at, after = file.tell(), file.readline()
                if not after.startswith("#"):
                    break
                warn(f"{path}: not read: {as_line(first.strip())}")
                start, first, skipped = at, after, skipped + 1
            named = re.fullmatch(r"sep=(.)\s*", first, re.IGNORECASE)
            found = [mark for mark in ";\t" if mark in first and "," not in first]
            separator = named[1] if named else (*found, ",")[0]
            file.seek(start)
            reader = csv.reader(file, delimiter=separator, skipinitialspace=not exact)
            for cells in itertools.islice(reader, 1 if named else 0, None):
                if separator != ",":
                    cells = [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]
                yield skipped + reader.line_num, cells


def _encoding_of(start: bytes) -> str:
    """The encoding of a text that begins like this, by its mark, else UTF-8 where it can be."""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


class StaleError(AliceError):
    """What is to be changed is no longer what was seen."""


def content_of(path: Path, maximum: int = MAX_TEXT) -> bytes | None:
    """The content of a file; None where there is none.

    Raises:
        WorkspaceError: it cannot be read, or is larger than so many bytes.
    """
    with file_faults(path, WorkspaceError):
        return ordinary_file(path, maximum).read_bytes() if path.exists() else None


def content_token(content: bytes | None) -> str:
    """A token of a file's content; empty where there is no file."""
    return "" if content is None else hashlib.blake2b(content, digest_size=16).hexdigest()


def check_token(name: str, content: bytes | None, token: str | None) -> None:
    """Check that a change is made to what a file holds.

    Args:
        name: of the file.
        content: that it has now.
        token: of what the change is made to; None for whatever is there.

    Raises:
        StaleError: that was something else.
    """
    if token is not None and token != content_token(content):
        raise StaleError(
            f"{name} was changed meanwhile, by another page, a command or by hand: load it again; "
            "what you changed is not written"
        )


def replace_file(path: Path, content: bytes, check: Callable[[Path], object]) -> str:
    """Replace the content of a file if what it will hold can be read, and return its token.

    Raises:
        WorkspaceError: it cannot be written, or `check` refuses it.
    """
    with file_faults(path, WorkspaceError, "written"), atomic_path(path) as temporary:
        temporary.write_bytes(content)
        try:
            check(temporary)
        except WorkspaceError as error:
            raise WorkspaceError(str(error).replace(str(temporary), path.name)) from None
    return content_token(content)
