"""A power cut at any moment: what was not synced is lost, and the next run notices it."""

import shutil
from pathlib import Path

import pytest

from alice_survey.app.pipeline import stage_states
from alice_survey.app.stages import STAGES
from alice_survey.core.artefacts import Stage, atomic_path, read_stage, run_stage, why_stale
from alice_survey.core.config import load_config
from alice_survey.core.executor import SERIAL
from tests.disk import Disk
from tests.small_survey import settings_in
from tests.test_loop import results


def _work(folder: Path) -> None:
    """By this program's own writer, and by a library's; the first is not done twice."""
    for name in ("a.txt", "b.txt"):
        if not (folder / "deep" / name).exists():
            with atomic_path(folder / "deep" / name) as path:
                path.write_text(name * 9)
    (folder / "whole.bin").write_bytes(b"whole")


def test_a_cut_at_any_call_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = Stage(name="made", version=1, settings={}, resumes=True)
    new = Stage(name="made", version=2, settings={}, resumes=True)
    run_stage(tmp_path / "work", old, _work)
    before = read_stage(tmp_path / "work" / "made")
    with monkeypatch.context() as patch:
        disk = Disk(patch, lambda disk, n: disk.after_cut(tmp_path / "work", tmp_path / str(n)))
        run_stage(tmp_path / "work", new, _work)
    assert disk.calls > 20 and before is not None
    seen = set()
    for folder in [tmp_path / str(n) for n in range(1, disk.calls + 1)]:
        states = why_stale(folder, old), why_stale(folder, new)
        seen.add(states)
        run_stage(folder, new, _work)
        record = read_stage(folder / "made")
        assert record is not None
        assert {name: entry[2] for name, entry in record.outputs.items()} == {
            name: entry[2] for name, entry in before.outputs.items()
        }
        assert [path.name for path in folder.iterdir()] == ["made"]
    made = "made by version 1 of the stage, now 2"
    assert {
        ("missing", "missing"),
        (made.replace("1", "2").replace("now 2", "now 1"), None),
    } <= seen


@pytest.mark.slow
def test_every_stage_survives_a_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At each call finished stages are on the disk; after one cut each ends with the same bytes."""
    work, cut_at = settings_in(tmp_path / "work"), 0
    config = load_config(work / "survey.toml")
    made: list[str] = []

    def check(disk: Disk, number: int) -> None:
        folder = work / made[-1]
        for path in folder.rglob("*") if number % 5 == 0 else ():
            assert disk.is_synced(path) or path.is_dir(), path
        if not (tmp_path / made[-1]).exists() and number >= cut_at:
            disk.after_cut(work, tmp_path / made[-1])

    with monkeypatch.context() as patch:
        disk = Disk(patch, check)
        for one in STAGES[:-1]:
            made.append(one.folder)
            cut_at = disk.calls + (120 if one.name == "dense" else 12)
            one.make(work, config, SERIAL)
    assert disk.calls > 500, disk.calls
    for one, folder in zip(STAGES, made, strict=False):
        cut = tmp_path / folder
        assert stage_states(cut, config)[one.name] in ("interrupted", "missing"), folder
        one.make(cut, config, SERIAL)
        for name, content in results(cut).items():
            assert (work / name).read_bytes() == content, name
        shutil.rmtree(cut)
