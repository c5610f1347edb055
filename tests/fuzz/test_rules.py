"""Rules that every reader of a table keeps (CONTRIBUTING.md), over all targets of the fuzzing."""

import csv
import io
import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from alice_survey.core.errors import keep_warnings
from tests.fuzz.target import Trial
from tests.fuzz.targets import TARGETS

TABLES = [name for name, target in TARGETS.items() if target.syntax == "csv"]
CARRIED = {
    "vehicle log": "columns that are not known are carried along",
    "bathymetry CSV": "GDAL takes x, y and z of a table",
}
"""Readers that no rule of columns holds for, and why."""
NAMED = [name for name in TABLES if name not in CARRIED]
Rows = list[list[str]]


def tried(name: str, folder: Path, change: Callable[[Rows], Rows], encoding: str = "utf-8") -> str:
    """All that a reader says of a changed table: its refusal, or its warnings."""
    trial = Trial(TARGETS[name], folder)
    rows = list(csv.reader(io.StringIO(trial.good.decode())))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(change(rows))
    with keep_warnings() as warnings:
        verdict = trial.verdict(text.getvalue().encode(encoding))
    assert verdict.outcome != "fault", f"{verdict.message}\n{verdict.trace}"
    return "\n".join([verdict.message, *warnings])


def with_column(rows: Rows, name: str, value: str) -> Rows:
    return [[*row, name if number == 0 else value] for number, row in enumerate(rows)]


@pytest.mark.parametrize("name", NAMED)
def test_columns_that_are_not_read_are_named(name: str, tmp_path: Path) -> None:
    said = tried(name, tmp_path, lambda rows: with_column(rows, "wibble_m", "7.25"))
    assert "wibble_m" in said


@pytest.mark.parametrize("name", [name for name in TABLES if name != "bathymetry CSV"])
def test_a_column_that_occurs_twice_is_refused(name: str, tmp_path: Path) -> None:
    trial = Trial(TARGETS[name], tmp_path)
    first, second, *_ = csv.reader(io.StringIO(trial.good.decode()))
    twice = partial(with_column, name=first[0], value=second[0])
    assert first[0] in tried(name, tmp_path / "twice", twice)


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_short_tables_give_a_value_or_one_line(name: str, count: int, tmp_path: Path) -> None:
    """Empty, a header alone, one row."""
    tried(name, tmp_path, lambda rows: rows[:count])


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("encoding", ["utf-16", "cp1252", "utf-8-sig"])
def test_other_encodings_give_a_value_or_one_line(name: str, encoding: str, tmp_path: Path) -> None:
    tried(name, tmp_path, lambda rows: with_column(rows, "été", "1"), encoding)


TEXTS = [name for name, target in TARGETS.items() if target.syntax != "binary"]


@pytest.mark.parametrize("name", TEXTS)
def test_empty_files_and_other_encodings_give_a_value_or_one_line(
    name: str, tmp_path: Path
) -> None:
    trial = Trial(TARGETS[name], tmp_path)
    text = trial.good.decode()
    for data in (b"", b"\n", text.encode("utf-16"), f"{text}\n\xe9".encode("cp1252", "replace")):
        verdict = trial.verdict(data)
        assert verdict.outcome != "fault", f"{verdict.message}\n{verdict.trace}"


OPEN = {
    "GeoJSON": "RFC 7946 has foreign members", "GeoJSON zones": "the same",
    "reports of a DVL": "lines of which each has keys of its own",
}  # fmt: skip
"""Files that may hold more than their reader knows, and why."""
KEYED = [name for name in TEXTS if TARGETS[name].syntax in ("json", "toml") and name not in OPEN]


@pytest.mark.parametrize("name", KEYED)
def test_keys_that_are_not_read_are_named(name: str, tmp_path: Path) -> None:
    trial = Trial(TARGETS[name], tmp_path)
    text = trial.good.decode()
    if TARGETS[name].syntax == "toml":
        more = f"wibble_m = 7.25\n{text}"
    else:
        values = json.loads(text)
        (values[0] if isinstance(values, list) else values)["wibble_m"] = 7.25
        more = json.dumps(values)
    with keep_warnings() as warnings:
        verdict = trial.verdict(more.encode())
    assert verdict.outcome != "fault", f"{verdict.message}\n{verdict.trace}"
    assert "wibble_m" in "\n".join([verdict.message, *warnings])


@pytest.mark.parametrize("unknown", ["-9999", "-32768", "nan"])
@pytest.mark.parametrize("name", TABLES)
def test_numbers_that_stand_for_unknown_are_no_values(
    name: str, unknown: str, tmp_path: Path
) -> None:
    """Of any column of numbers: the row or value is left out, or the table is refused."""

    def spoilt(rows: Rows) -> Rows:
        return [
            [unknown if number == 3 and is_number(cell) else cell for cell in row]
            for number, row in enumerate(rows)
        ]

    assert tried(name, tmp_path, spoilt)


def is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


OWN = {
    "alice_survey.app.studio.endpoints.pictures", "alice_survey.core.artefacts",
    "alice_survey.core.manifest", "alice_survey.core.trajectory", "missions.acquire.run",
    "reconstruct.evaluate.truth", "reconstruct.measure.surface",
    "reconstruct.mosaic.picture_measures", "reconstruct.placing.run", "reconstruct.placing.track",
    "reconstruct.stages",
}  # fmt: skip
"""Modules that read tables of the program's own, or for those below."""
DOORS = {
    "alice_survey.sim.vehicle.identification.two_step": "bollard pull",
    "alice_survey.sim.vehicle.log": "foreign log", "alice_survey.sim.vehicle.sea": "current",
    "missions.areas.files": "corners CSV", "missions.coverage.dive_record": "triggers",
    "missions.logs.import_log": "tide", "missions.logs.navigation_csv": "navigation CSV",
    "reconstruct.pictures.incoming": "trigger log of pictures",
    "reconstruct.placing.control_points": "control.csv",
}  # fmt: skip
"""Modules that read tables of others, and a target of each."""


def test_every_module_that_reads_tables_of_others_is_tried() -> None:
    """A new one is added here, and to the targets, or to those that read our own."""
    call = re.compile(r"\b(read_csv|stream_csv|read_columns|read_number_columns|csv\.reader)\(")
    root = Path(__file__).parents[2]
    found = {
        ".".join(path.relative_to(root).with_suffix("").parts)
        for package in ("alice_survey", "camera_calib", "missions", "reconstruct")
        for path in (root / package).rglob("*.py")
        if call.search(path.read_text(encoding="utf-8"))
    }
    assert found == OWN | set(DOORS)
    assert set(DOORS.values()) <= set(TABLES)
