"""The whole loop on a small survey: its reproducibility, and what a kill does to it."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.app.stages import STAGES
from alice_survey.core.config import load_config
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.executor import SERIAL
from missions.values.plan_file import read_plan
from reconstruct.revisit.run import revisit_report
from tests.small_survey import settings_in, start

pytestmark = pytest.mark.slow

FOLDERS = tuple(stage.folder for stage in STAGES)


def results(workspace: Path) -> dict[str, bytes]:
    """Every file of the finished stages but SQLite files, and those that state how long it took."""
    return {
        str(path.relative_to(workspace)): path.read_bytes()
        for stage in FOLDERS
        if stage != "report"
        for path in sorted((workspace / stage).rglob("*"))
        if path.is_file() and path.name != "stage.json" and path.suffix != ".db"
    }


def test_a_sound_survey_has_no_weak_place_unless_more_is_asked_for(
    small_survey: Path, tmp_path: Path
) -> None:
    config = load_config(small_survey / "survey.toml")

    text, sound = revisit_report(small_survey, config, SERIAL, out=tmp_path / "sound")
    _, asked = revisit_report(small_survey, config, SERIAL, sigma_mm=0.1, out=tmp_path / "asked")

    assert sound["places"] == []
    assert "nothing is weak" in text
    assert "surface" in {place["cause"] for place in asked["places"]} <= {"surface", "loose"}
    assert asked["weak_m2"] > 0.9 * 1.3 * 1.5
    again = read_plan(tmp_path / "asked" / "dive" / "plan" / "plan.json")
    assert asked["dive"]["joining_stations"] == again.stations
    drawn = json.loads((tmp_path / "asked" / "weak.geojson").read_text())
    assert len(drawn["features"]) == len(asked["places"])
    with pytest.raises(WorkspaceError, match="alice-survey plan"):
        revisit_report(tmp_path, config, SERIAL)


def test_every_stage_is_reported(small_survey: Path) -> None:
    lines = small_survey.with_suffix(".jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    run = events[
        : 1 + next(i for i, event in enumerate(events) if event["event"] == "run_finished")
    ]
    assert run[0]["event"] == "run_started"
    assert run[-1]["exit_code"] == 0
    for name in ("stage_started", "stage_finished"):
        assert [e["stage"] for e in run if e["event"] == name] == list(FOLDERS)
    for event in run:
        if event["event"] == "stage_finished":
            record = json.loads((small_survey / event["stage"] / "stage.json").read_text())
            for key in ("took_s", "cpu_s", "peak_mib"):
                assert record[key] == event[key]
            assert 50 < record["peak_mib"] < 8000
            assert 0.02 * record["took_s"] < record["cpu_s"] < 50 * record["took_s"]
            assert record["versions"]["pycolmap"]
    begun = {e["step_number"]: e["step"] for e in run if e["event"] == "step_started"}
    ended = {e["step_number"]: e["step"] for e in run if e["event"] == "step_finished"}
    assert begun == ended and len(begun) > 20
    for event in run:
        if event["event"] == "step_finished":
            assert event["complete"], event
            assert event.get("done", 0) <= event.get("total", event.get("done", 0))


def wait_for(
    run: subprocess.Popen[Any], events: Path, seen: int, max_s: float = math.inf, **facts: str
) -> dict[str, Any] | None:
    """Wait for an event of a run, beyond the bytes seen before; None if it ends or takes longer."""
    until = time.monotonic() + max_s
    while run.poll() is None and time.monotonic() < until:
        if events.exists():
            with events.open("rb") as file:
                file.seek(seen)
                for line in file.read().split(b"\n")[:-1]:
                    event: dict[str, Any] = json.loads(line)
                    if all(event.get(name) == value for name, value in facts.items()):
                        return event
        time.sleep(0.005)
    return None


def test_killed_again_and_again_it_ends_the_same(tiny_survey: Path, tmp_path: Path) -> None:
    """At a random time in every stage."""
    workspace = settings_in(tmp_path / "killed")
    events = workspace.with_suffix(".jsonl")
    took_s = {
        stage: json.loads((tiny_survey / stage / "stage.json").read_text())["took_s"]
        for stage in FOLDERS
    }
    rng, pace = np.random.default_rng(5), 1.0
    killed = dict.fromkeys(FOLDERS, 0)
    whole_before_kill = 0
    while sum(killed.values()) < len(FOLDERS):
        stage = FOLDERS[sum(killed.values())]
        shutil.rmtree(workspace / stage, ignore_errors=True)  # it had ended before the last kill
        seen = events.stat().st_size if events.exists() else 0
        run = start(workspace, threads=1)
        assert wait_for(run, events, seen, event="stage_started", stage=stage), stage
        moment_s = pace * rng.uniform(0, took_s[stage])
        ended = wait_for(run, events, seen, moment_s, event="stage_finished", stage=stage)
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
            killed[stage] += 1
            whole_before_kill += (workspace / stage).exists()
        run.wait()
        if ended and not ended.get("resumed"):  # on a busy machine it took longer, or with kernels
            pace = min(pace, ended["took_s"] / took_s[stage])
    assert whole_before_kill < len(FOLDERS) - 4  # at least five fell into the work of their stage
    assert start(workspace, threads=1).wait() == 0
    assert not list(workspace.glob("*.partial"))
    again, whole = results(workspace), results(tiny_survey)
    assert set(again) == set(whole)
    different = [name for name in whole if again[name] != whole[name]]
    assert not different


TOO_LARGE = """
import numpy
import reconstruct.dense.run
reconstruct.dense.run.fuse_planes = lambda *_: numpy.empty(1 << 60, "u1")
from alice_survey.app.cli.main import main
main()
"""
"""The command line, where memory runs out before points are merged.

With a limit of the process's memory libraries may abort, or try for ever (OpenBLAS).
"""


def reconstruct(
    workspace: Path, *options: str, program: Sequence[str] = ("-m", "alice_survey")
) -> subprocess.Popen[str]:
    command = [sys.executable, *program, "reconstruct", "-w", str(workspace)]
    return subprocess.Popen(
        [*command, "--threads", "1", "--quiet", *options],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_what_goes_wrong_half_way_is_reported_in_a_line_and_nothing_is_lost(
    tiny_survey: Path, tmp_path: Path
) -> None:
    """A picture that goes, one that changes, and memory that runs out.

    The truth is not next to the pictures: in the end the reconstruction is the same without it.
    """
    workspace, events = tmp_path / "half", tmp_path / "half.jsonl"
    shutil.copytree(tiny_survey, workspace)
    made = ("mapping", "sparse", "dense", "mosaic", "mesh")
    for stage in (*made, "evaluation", "report", "calibration"):
        shutil.rmtree(workspace / stage)
    for stage in ("images", "flight", "pool"):
        shutil.rmtree(workspace / stage / "truth", ignore_errors=True)
        record = workspace / stage / "stage.json"  # as of before it had digests of outputs
        values = json.loads(record.read_text()) | {"outputs": {}, "checksum": ""}
        record.write_text(json.dumps(values))
    calibrate = [sys.executable, "-m", "alice_survey", "calibrate", "-w", str(workspace)]
    subprocess.run(calibrate, check=True, capture_output=True)  # it warns, in lines of its own
    first, *_, last = sorted((workspace / "images" / "right").glob("*.png"))
    kept = tmp_path / last.name
    shutil.copy2(last, kept)
    for step, spoil in (("features", last.unlink), ("matching", lambda: shutil.copy(first, last))):
        seen = events.stat().st_size if events.exists() else 0
        run = reconstruct(workspace, "--log-file", str(events))
        assert wait_for(run, events, seen, event="step_started", step=step)
        spoil()
        line = run.communicate()[1].strip()
        assert run.returncode == 1
        assert line.startswith("error: ") and "\n" not in line and last.name in line, line
        assert not [stage for stage in made if (workspace / stage).exists()]
        shutil.copy2(kept, last)
    run = reconstruct(workspace, program=("-c", TOO_LARGE))
    line = run.communicate()[1].strip()
    assert run.returncode == 1
    assert line.startswith("error: memory ran out") and "\n" not in line, line
    assert (workspace / "sparse").exists() and not (workspace / "dense").exists()
    run = reconstruct(workspace)
    assert (run.communicate()[1].strip(), run.returncode) == ("", 0)
    again, whole = results(workspace), results(tiny_survey)
    different = [name for name in again if again[name] != whole[name]]
    assert {name.split("/")[0] for name in again} >= {*made, "calibration"}
    assert not different


def test_a_second_run_does_nothing(tiny_survey: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in tiny_survey.rglob("*") if p.name != ".lock"}
    assert start(tiny_survey, threads=1).wait() == 0
    after = {p: p.stat().st_mtime_ns for p in tiny_survey.rglob("*") if p.name != ".lock"}
    assert before == after
