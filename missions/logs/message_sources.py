"""Quantities of a dive from a log of named messages: for each, the best message that is there.

Libraries read the messages. What they are given is checked here first, and what they print or raise
on a damaged log ends in one line.
"""

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import one_line
from alice_survey.core.errors import NavigationError, why
from alice_survey.core.frames import Array
from missions.logs.dive import ROLES, LoggedDive, Signal, clean_signal, usable_positions

MAX_LOG_BYTES = 4_000_000_000

_INSTANCE = ("C", "I", "Instance", "id")
"""Fields that identify one of several cores or sensors."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class LogTable:
    """All messages of one name."""

    name: str
    columns: dict[str, Array]
    """(N,) numbers by field."""
    texts: dict[str, list[str]] = field(default_factory=dict)
    """Fields of text."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def has(self, *names: str) -> bool:
        """Whether all of these columns are there."""
        return all(name in self.columns for name in names)

    def rows(self, keep: Mask) -> "LogTable":
        """The rows of numbers where a mask, (N,), holds."""
        columns = {name: column[keep] for name, column in self.columns.items()}
        return LogTable(name=self.name, columns=columns)

    def stack(self, *names: str) -> Array:
        """Columns side by side, (N, k)."""
        return np.stack([self.columns[name] for name in names], axis=1)


Tables = Mapping[str, LogTable]
Reader = Callable[[LogTable, Tables], tuple[Array, Array] | str]
"""Takes the table of a message, and all tables, to times and values, or to what is missing."""


@dataclass(frozen=True)
class Source:
    """One way to get a quantity."""

    message: str
    read: Reader
    note: str = ""
    """What to know of it when it is used."""


@dataclass(frozen=True)
class Keep:
    """Which rows of a message to use."""

    fields: tuple[str, ...]
    """What `rows` needs."""
    rows: Callable[[LogTable], Mask]


FIX_3D = 3
"""Least type of a GPS fix with a place."""
DOWN = 25
"""ROTATION_PITCH_270: a range finder that looks down."""
AT_SURFACE = "positions are GPS: they hold at the surface only"


def hears_bottom(table: LogTable) -> Mask:
    """Rows of a distance sensor that looks down and is within what it measures."""
    distance = table.columns["current_distance"]
    good: Mask = (
        (table.columns["orientation"] == DOWN)
        & (distance >= table.columns["min_distance"])
        & (distance < table.columns["max_distance"])
    )
    return good


HEARD_BY = ("orientation", "min_distance", "max_distance")
"""Fields that `hears_bottom` needs."""


def take(
    *fields: str, scale: float = 1.0, keep: Keep | None = None, absent: float | None = None
) -> Reader:
    """Read fields of a message, times a scale; `keep` marks rows to use, `absent` what is NaN."""

    def read(table: LogTable, _: Tables) -> tuple[Array, Array] | str:
        needed = (*fields, *(keep.fields if keep is not None else ()))
        if not table.has(*needed):
            return f"it lacks {', '.join(name for name in needed if not table.has(name))}"
        if keep is not None:
            table = table.rows(keep.rows(table))
        values = table.stack(*fields)
        if absent is not None:
            values = np.where(values == absent, np.nan, values)
        return table.columns["time_s"], values * scale

    return read


def dive_from(
    path: Path,
    sources: Mapping[str, tuple[Source, ...]],
    requested: Mapping[str, str],
    tables: Tables,
    present: Sequence[str],
    lost: Counter[str],
    *,
    kind: str,
    clock: str,
    dated: bool,
    declination_in_log_deg: float | None,
) -> LoggedDive:
    """A dive of the best source that is there for each role.

    Args:
        path: of the log, for messages.
        sources: of each role, the best first.
        requested: the message to use for a role, `NAME` or `NAME[instance]`.
        tables: by message, with `time_s`.
        present: names of all messages in the log.
        lost: counts what is left out; is added to.
        kind: of the log, this and what follows as in `LoggedDive`.
        clock: whose times are.
        dated: whether they are dates.
        declination_in_log_deg: what the vehicle added.

    Raises:
        NavigationError: there is no source, or not the requested one.
    """
    notes: list[str] = []
    counted: set[str] = set()

    def signal(role: str) -> Signal | None:
        own: Counter[str] = Counter()
        found, note = _signal(path, role, sources[role], requested.get(role), tables, present, own)
        # What the times of a message cost is counted once, though it serves several roles.
        if found is not None and found.source not in counted:
            counted.add(found.source)
            lost.update(own)
        if note and note not in notes:
            notes.append(note)
        return found

    found = {role: signal(role) for role in sources}
    if not any(found[role] for role in ROLES):
        names = ", ".join(dict.fromkeys(s.message for role in ROLES for s in sources[role]))
        raise NavigationError(f"{path}: none of {names}; it has {', '.join(present)}")
    return LoggedDive(
        kind=kind,
        clock=clock,
        dated=dated,
        position=usable_positions(found["navigation"], lost),
        depth=found["depth"],
        attitude=found["attitude"],
        altitude=found["altitude"],
        altitude_slant=True,
        velocity_ned=found["velocity"],
        rates=found["rates"],
        pwm=found["pwm"],
        declination_in_log_deg=declination_in_log_deg,
        lost=dict(lost),
        notes=tuple(notes),
    )


def _signal(
    path: Path,
    role: str,
    sources: Sequence[Source],
    requested: str | None,
    tables: Tables,
    present: Sequence[str],
    lost: Counter[str],
) -> tuple[Signal | None, str]:
    """The best source that the log holds, or the requested one, and its note."""
    name, _, instance = (requested or "").removesuffix("]").partition("[")
    known = [source.message for source in sources]
    if name and name not in known:
        raise NavigationError(f"{path}: {role} can come from {', '.join(known)}, not {name}")
    why = f"the log has {', '.join(present)}"
    for source in sources:
        if name and source.message != name:
            continue
        table = tables.get(source.message)
        if table is None:
            continue
        one, others = _one_instance(path, role, table, instance, bool(name))
        if one is None:
            continue
        read = source.read(one, tables)
        if isinstance(read, str):
            why = read
            continue
        found = clean_signal(source.message, *read, lost) if len(read[0]) else None
        if found is not None:
            return found, f"{source.note}{others}".strip("; ")
        why = "none of its rows can be used"
    if name:
        raise NavigationError(f"{path}: {requested} gives no {role}: {why}")
    return None, ""


def _one_instance(
    path: Path, role: str, table: LogTable, requested: str, named: bool
) -> tuple[LogTable | None, str]:
    """The rows of one core or sensor, and a note on the others.

    Cores and GPS receivers count from the one that is used. Which barometer is the depth sensor
    is not identified by its number, so that one of several must be requested.
    """
    field = next((name for name in _INSTANCE if name in table.columns), None)
    if field is None:
        return table, ""
    known = table.columns[field][np.isfinite(table.columns[field])]
    numbers = np.unique(known).astype(int).tolist()
    if requested:
        if not requested.isdigit() or int(requested) not in numbers:
            raise NavigationError(
                f"{path}: {table.name} has {', '.join(map(str, numbers))}, not {requested}"
            )
        return table.rows(table.columns[field] == int(requested)), ""
    if len(numbers) < 2:
        return table, ""
    if table.name == "BARO":
        if not named:
            return None, ""
        raise NavigationError(
            f"{path}: BARO has {', '.join(map(str, numbers))}: choose the depth sensor with "
            f"--topic {role}=BARO[{numbers[-1]}]"
        )
    if table.name.upper() in ("RFND", "DISTANCE_SENSOR"):
        return table, ""
    note = f"; {table.name} {numbers[0]} of {', '.join(map(str, numbers))} is used"
    return table.rows(table.columns[field] == numbers[0]), note


def with_time(table: LogTable, time_s: Array) -> LogTable:
    """A table whose rows have times, (N,) seconds."""
    return replace(table, columns={**table.columns, "time_s": time_s})


def first_bytes(path: Path, count: int) -> bytes:
    """The first bytes of a log.

    Raises:
        NavigationError: it cannot be read, or is too large for one.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            start = file.read(count)
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {why(error)}") from None
    if size > MAX_LOG_BYTES:
        raise NavigationError(f"{path}: is larger than {MAX_LOG_BYTES // 10**9} GB: cut it")
    return start


@contextlib.contextmanager
def read_by(library: str, path: Path) -> Iterator[None]:
    """Silence a library that reads a log, and turn what it raises into one line.

    Raises:
        NavigationError: it has raised something; the message says what.
    """
    with (
        open(os.devnull, "w") as nowhere,  # noqa: PTH123  it is no path
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        try:
            yield
        except (NavigationError, MemoryError):
            raise
        except ImportError:
            raise NavigationError(
                f"{path}: {library} is needed to read it: pip install 'alice-survey[mavlink]'"
            ) from None
        except Exception as error:  # damaged logs raise all kinds
            raise NavigationError(
                f"{path}: cannot be read by {library}: {one_line(error)}"
            ) from None
