"""Stages appear whole, are skipped while nothing changed, and survive a kill."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from alice_survey.core.artefacts import (
    Stage,
    atomic_path,
    need_stage,
    run_stage,
    why_stale,
    write_csv,
)
from alice_survey.core.errors import WorkspaceError


def stage(inputs: list[Path], value: int = 1, version: int = 1, resumes: bool = False) -> Stage:
    return Stage(
        name="made", version=version, settings={"value": value}, inputs=inputs, resumes=resumes
    )


class Work:
    """Counts how often it was done."""

    def __init__(self) -> None:
        self.done = 0

    def __call__(self, folder: Path) -> None:
        self.done += 1
        (folder / "result.txt").write_text("result")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source" / "a.txt"
    path.parent.mkdir()
    path.write_text("one")
    return path


def test_unchanged_stage_is_skipped(tmp_path: Path, source: Path) -> None:
    work = Work()
    assert run_stage(tmp_path, stage([source]), work)
    assert not run_stage(tmp_path, stage([source]), work)
    os.utime(source)  # touched, not changed
    assert not run_stage(tmp_path, stage([source.parent]), work)
    assert work.done == 1
    assert (tmp_path / "made" / "result.txt").read_text() == "result"


@pytest.mark.parametrize("change", ["content", "settings", "version", "new file", "removed file"])
def test_changed_stage_is_redone(tmp_path: Path, source: Path, change: str) -> None:
    extra = source.parent / "b.txt"
    if change == "removed file":
        extra.write_text("extra")
    work, folder = Work(), source.parent
    run_stage(tmp_path, stage([folder]), work)
    if change == "content":
        source.write_text("two")
    elif change == "new file":
        extra.write_text("extra")
    elif change == "removed file":
        extra.unlink()
    changed = stage([folder], 2 if change == "settings" else 1, 2 if change == "version" else 1)

    named = {"settings": "value", "version": "version 1"}.get(change, "source/")
    assert named in str(why_stale(tmp_path, changed))
    assert work.done == 1
    assert run_stage(tmp_path, changed, work)
    assert work.done == 2


def test_failed_work_keeps_the_old_result(tmp_path: Path, source: Path) -> None:
    run_stage(tmp_path, stage([source]), Work())

    def fail(folder: Path) -> None:
        (folder / "half.txt").write_text("half")
        raise RuntimeError("broke")

    with pytest.raises(RuntimeError):
        run_stage(tmp_path, stage([source], value=2), fail)
    assert [p.name for p in sorted((tmp_path / "made").iterdir())] == ["result.txt", "stage.json"]


@pytest.mark.parametrize("change", ["changed", "gone", "touched"])
def test_an_input_that_changes_under_the_work_is_named_and_nothing_is_lost(
    tmp_path: Path, source: Path, change: str
) -> None:
    run_stage(tmp_path, stage([source]), Work())

    def work(folder: Path) -> None:
        (folder / "result.txt").write_text("made of two inputs")
        if change == "gone":
            source.unlink()
        else:
            source.write_text("two" if change == "changed" else "one")

    if change == "touched":
        assert run_stage(tmp_path, stage([source], value=2), work)
        return
    with pytest.raises(WorkspaceError, match=r"a\.txt"):
        run_stage(tmp_path, stage([source], value=2), work)
    assert (tmp_path / "made" / "result.txt").read_text() == "result"
    source.write_text("two")
    again = Work()
    assert run_stage(tmp_path, stage([source], value=2), again)
    assert again.done == 1


def test_resumed_work_finds_what_it_left_only_under_the_same_digest(
    tmp_path: Path, source: Path
) -> None:
    seen: list[bool] = []

    def work(folder: Path) -> None:
        seen.append((folder / "first.txt").exists())
        (folder / "first.txt").write_text("first")
        if len(seen) < 4:
            raise RuntimeError("broke")

    for value in (1, 1, 2, 2):
        attempt = stage([source], value=value, resumes=True)
        if len(seen) < 3:
            with pytest.raises(RuntimeError):
                run_stage(tmp_path, attempt, work)
        else:
            run_stage(tmp_path, attempt, work)
    assert seen == [False, True, False, True]


def test_resumed_work_leaves_nothing_of_files_that_a_kill_cut(tmp_path: Path, source: Path) -> None:
    """A kill runs no `finally`: what `atomic_path` was writing to still lies there."""
    cut: list[Path] = []
    kept = ("deep/.hidden.png", "deep/.a.tmp.png", "deep/a.tmp12.png", "deep/.a.tmp12/b.txt")

    def killed(folder: Path) -> None:
        for name in ("picture.png", "deep/table.tar.gz", "deep/.dotted", "bare"):
            with atomic_path(folder / name) as temporary:
                temporary.write_text("whole")
            temporary.write_text("half")
            cut.extend((temporary, temporary.with_name(f"{temporary.name}.ovr.tmp")))
            cut[-1].write_text("half")
        for name in kept:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("whole")
        raise RuntimeError("killed")

    made = stage([source], resumes=True)
    with pytest.raises(RuntimeError):
        run_stage(tmp_path, made, killed)
    assert all(path.exists() for path in cut)
    run_stage(tmp_path, made, Work())
    files = {str(p.relative_to(tmp_path / "made")) for p in (tmp_path / "made").rglob("*")}
    whole = {"picture.png", "deep/table.tar.gz", "deep/.dotted", "bare", *kept}
    assert files == {*whole, "deep", "deep/.a.tmp12", "result.txt", "stage.json"}


METERED = """
import sys, time
from pathlib import Path
from alice_survey.core.artefacts import Stage, run_stage
def work(folder):
    started = time.process_time()
    while time.process_time() - started < float(sys.argv[2]):
        pass
run_stage(Path(sys.argv[1]), Stage(name="made", version=1, settings={"value": 1}), work)
"""


def test_a_stage_records_what_it_took_outside_of_its_digest(tmp_path: Path) -> None:
    records = []
    for spent_s in ("0.3", "0"):
        folder = tmp_path / spent_s
        subprocess.run([sys.executable, "-c", METERED, str(folder), spent_s], check=True)
        records.append(json.loads((folder / "made" / "stage.json").read_text()))
    one, two = records
    assert one["digest"] == two["digest"]
    assert 0.25 < one["cpu_s"] < 5.0, "ticks of 10 ms"
    assert one["took_s"] >= 0.3
    assert 10 < one["peak_mib"] < 1000
    assert one["versions"].keys() >= {"alice-survey", "numpy", "opencv", "pycolmap", "numba"}
    assert "resumed" not in one


KILLED = """
import os, signal, sys
from pathlib import Path
from alice_survey.core import artefacts
target, call = Path(sys.argv[1]), int(sys.argv[2])
calls = 0
def step(original):
    def counted(*args, **kwargs):
        global calls
        calls += 1
        if calls == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **kwargs)
    return counted
for owner, name in [(Path, "rename"), (Path, "replace"), (Path, "write_text"), (Path, "mkdir"),
                    (Path, "unlink"), (artefacts.shutil, "rmtree")]:
    setattr(owner, name, step(getattr(owner, name)))
made = artefacts.Stage(name="made", version=1, settings={"value": int(sys.argv[3])})
artefacts.run_stage(target, made, lambda folder: (folder / "result.txt").write_text(sys.argv[3]))
"""


@pytest.mark.slow
def test_a_kill_at_any_step_loses_nothing(tmp_path: Path) -> None:
    """Whatever call the kill falls on, the next run ends with the right, whole stage."""
    killed = 0
    for call in range(1, 40):
        folder = tmp_path / str(call)
        folder.mkdir()
        run_stage(folder, stage([], value=1), lambda f: (f / "result.txt").write_text("1") and None)
        command = [sys.executable, "-c", KILLED, str(folder), str(call), "2"]
        died = subprocess.run(command, check=False).returncode == -signal.SIGKILL
        run_stage(folder, stage([], value=2), lambda f: (f / "result.txt").write_text("2") and None)
        assert (folder / "made" / "result.txt").read_text() == "2"
        assert [p.name for p in sorted(folder.iterdir())] == ["made"]
        assert json.loads((folder / "made" / "stage.json").read_text())["settings"] == {"value": 2}
        killed += died
        if not died:
            break
    assert killed >= 8


def test_missing_input_and_missing_stage_are_known_faults(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="absent"):
        run_stage(tmp_path, stage([tmp_path / "absent"]), Work())
    with pytest.raises(WorkspaceError, match="alice-survey plan"):
        need_stage(tmp_path, "plan", "plan")


def test_atomic_path_leaves_nothing_behind_on_failure(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(target) as path:
        path.write_text("half")
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert target.read_text() == "old"
    # Writers of the same file do not mix: each writes a whole one, and the last is kept.
    with atomic_path(target) as first:
        first.write_text("a long text")
        with atomic_path(target) as second:
            second.write_text("short")
        assert target.read_text() == "short"
    assert target.read_text() == "a long text"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(("lasting", "synced"), [(True, 2), (False, 0)])
def test_scratch_does_not_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lasting: bool, synced: int
) -> None:
    calls: list[int] = []
    monkeypatch.setattr(os, "fsync", calls.append)
    with atomic_path(tmp_path / "a.txt", lasting=lasting) as path:
        path.write_text("whole")
    assert len(calls) == synced and (tmp_path / "a.txt").read_text() == "whole"


def test_csv_writes_unknown_values_as_empty_cells(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", ["x", "y"], [[1.5, float("nan")], [None, "t"]])
    assert (tmp_path / "a.csv").read_text() == "x,y\n1.5,\n,t\n"


@pytest.mark.parametrize("content", ['{"inputs": [1, 2]}', "[]", "\x00\xff"])
def test_a_damaged_stage_file_only_means_that_the_stage_is_made_again(
    tmp_path: Path, source: Path, content: str
) -> None:
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "stage.json").write_text(content, encoding="latin-1")
    assert run_stage(tmp_path, stage([source]), Work())
    assert (tmp_path / "made" / "result.txt").exists()
    assert not run_stage(tmp_path, stage([source]), Work())


def test_a_fault_cannot_write_to_the_terminal() -> None:
    assert str(WorkspaceError("a\x1b[2Jb\u200f.png: missing")) == "a\ufffd[2Jb\ufffd.png: missing"
