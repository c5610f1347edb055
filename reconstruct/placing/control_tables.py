"""Rows of `picks.csv` and `control.csv` put in, replaced and taken out; all else stays as it is.

Rows that are not meant, comments, columns of the user's own and their order are kept byte by byte.
A change states the token of the content that it is made to, so that of two writers the second is
told; a change that would leave a file that cannot be read is refused.
"""

import csv
import io
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alice_survey.core.edited_files import check_token, content_of, content_token, replaced
from alice_survey.core.errors import WorkspaceError, why
from reconstruct.placing.control_file import Pick, read_control, read_picks

PICKS_HEADER = ("image", "point", "x", "y", "sigma_px", "matched_to")
CONTROL_HEADER = (
    "kind", "name", "use", "north_m", "east_m", "depth_m", "from", "to", "length_m", "sigma_m",
    "sigma_vertical_m",
)  # fmt: skip
_LONGEST = 64 << 20
"""Bytes of a table that is read whole."""


def table_token(path: Path) -> str:
    """Token of a table's content; empty where there is no file."""
    return content_token(content_of(path, _LONGEST))


def save_picks(path: Path, token: str, picks: Sequence[Pick], points: Collection[str]) -> str:
    """Replace all picks of some points.

    Args:
        path: `picks.csv`.
        token: of the content that the picks were made to.
        picks: of these points.
        points: names.

    Returns:
        Token of the new content.

    Raises:
        StaleError: the file has changed.
        WorkspaceError: it cannot be read or written, or a pick is not one.
    """
    twice = {(p.image, p.point) for p in picks if p.point not in points}
    if twice or len({(p.image, p.point) for p in picks}) < len(picks):
        raise WorkspaceError("picks: one is of another point, or a picture shows a point twice")
    rows = {
        (p.image, p.point): {
            "image": p.image, "point": p.point, "x": f"{p.x_px - 0.5:.4f}",
            "y": f"{p.y_px - 0.5:.4f}", "sigma_px": f"{p.sigma_px:.4f}",
            "matched_to": p.matched_to,
        }
        for p in picks
    }  # fmt: skip

    def meant(row: Mapping[str, str]) -> bool:
        return row.get("point", "") in points and bool(row.get("x") or row.get("y"))

    return _save(path, token, PICKS_HEADER, ("image", "point"), rows, meant, read_picks)


def save_control(
    path: Path, token: str, rows: Sequence[Mapping[str, str]], names: Collection[tuple[str, str]]
) -> str:
    """Replace the rows of some points, bars or markers.

    Args:
        path: `control.csv`.
        token: of the content that the rows were made to.
        rows: cells by column; see `reconstruct.placing.control_file`.
        names: kind and name of each row to replace; one that `rows` lacks is taken out.

    Returns:
        Token of the new content.

    Raises:
        StaleError: the file has changed.
        WorkspaceError: it cannot be read or written, or a row is wrong.
    """
    keyed = {(row.get("kind", ""), row.get("name", "")): row for row in rows}
    if len(keyed) < len(rows):
        raise WorkspaceError("control: a name is there twice")
    meant = {*names, *keyed}
    return _save(
        path, token, CONTROL_HEADER, ("kind", "name"), keyed,
        lambda row: (row.get("kind", ""), row.get("name", "")) in meant, read_control,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _TableRow:
    text: str
    """As it stands in the file, with the end of its line."""
    cells: list[str]


def _save(
    path: Path,
    token: str,
    header: Sequence[str],
    key: tuple[str, str],
    rows: Mapping[tuple[str, str], Mapping[str, str]],
    meant: Callable[[Mapping[str, str]], bool],
    read: Callable[[Path], Any],
) -> str:
    now = content_of(path, _LONGEST)
    check_token(path.name, now, token)
    before = now or b""
    if before:
        read(path)  # a file that is wrong is the user's to mend, with the line named
    mark, records, end = _records(path, before)
    names = [cell.strip() for cell in records[0].cells] if records else []
    wanted = {name for row in rows.values() for name, cell in row.items() if cell}
    more = [name for name in header if name not in names and (not names or name in wanted)]
    more += sorted(wanted - {*names, *more})
    first = records[0].text.rstrip("\r\n") if records else ""
    lines = [
        mark + (",".join(([first] if first else []) + more) + end if more else records[0].text)
    ]
    left = dict(rows)
    names = [*names, *more]
    for record in records[1:]:
        if not record.text.endswith(("\n", "\r")):
            record = _TableRow(text=record.text + end, cells=record.cells)
        cells = dict(zip(names, (cell.strip() for cell in record.cells), strict=False))
        new = left.pop((cells.get(key[0], ""), cells.get(key[1], "")), None)
        if new is not None:
            lines.append(_line({**cells, **new}, names, end))
        elif not meant(cells):
            lines.append(record.text)
    lines += [_line(row, names, end) for row in left.values()]
    return replaced(path, "".join(lines).encode("utf-8"), read)


def _line(cells: Mapping[str, str], names: Sequence[str], end: str) -> str:
    for cell in cells.values():
        if any(ord(character) < 32 for character in cell):
            raise WorkspaceError(f"{cell!r}: a cell holds a character that cannot be printed")
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow([cells.get(name, "") for name in names])
    return text.getvalue() + end


def _records(path: Path, content: bytes) -> tuple[str, list[_TableRow], str]:
    """The byte order mark, the records with the header first, and how lines end."""
    try:
        text = content.decode("utf-8")
        mark = "\ufeff" if text.startswith("\ufeff") else ""
        lines = io.StringIO(text.removeprefix(mark), newline="").readlines()
        reader, records, at = csv.reader(lines, skipinitialspace=True), [], 0
        for cells in reader:
            records.append(_TableRow(text="".join(lines[at : reader.line_num]), cells=cells))
            at = reader.line_num
    except (UnicodeDecodeError, csv.Error) as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    return mark, records, "\r\n" if records and records[0].text.endswith("\r\n") else "\n"
