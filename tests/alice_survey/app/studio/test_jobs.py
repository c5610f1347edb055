"""Jobs of the studio: one at a time, stopped like Ctrl-C, found again by a later studio."""

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from filelock import FileLock

from alice_survey.app.studio.jobs import (
    KEPT_LINES,
    BusyError,
    EventsTail,
    JobRecord,
    Jobs,
    RunState,
    compile_survey,
)
from alice_survey.core.errors import AliceError
from tests.engines import until

PROGRAM = """
import json, os, signal, subprocess, sys, time
path = next(a.split("=", 1)[1] for a in sys.argv if a.startswith("--log-file="))
def tell(**event):
    with open(path, "a") as file:
        file.write(json.dumps({"time_utc": "2026-01-01T00:00:00Z", **event}) + chr(10))
tell(event="run_started", process=os.getpid(), command="x", folder="/", versions={})
tell(event="stage_started", stage="plan", message="plan")
kind = sys.argv[1]
if kind == "plan":  # works until Ctrl-C, with a worker of its own
    worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        tell(event="note", message=f"worker {worker.pid}")
        for n in range(600):
            tell(event="step_progress", stage="plan", step="work", step_number=1, done=n, total=600,
                 elapsed_s=n / 10, remaining_s=60 - n / 10)
            time.sleep(0.1)
    except KeyboardInterrupt:
        worker.wait()
        tell(event="error", message="interrupted")
        tell(event="run_finished", exit_code=130, elapsed_s=1.0)
        sys.exit(130)
if kind == "fly":
    tell(event="error", message="no plan: run 'alice-survey plan -w reef' first")
    tell(event="run_finished", exit_code=1, elapsed_s=1.0)
    sys.exit(1)
if kind == "image":  # deaf
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    tell(event="note", message="deaf")
    time.sleep(60)
if kind == "report":
    print("error: no such option: --nothing", file=sys.stderr)
    sys.exit(2)
tell(event="stage_finished", stage="plan", took_s=1.0, cpu_s=1.0, peak_mib=1.0)
tell(event="result", message="table" + chr(10) + "plan: 4 lines" + chr(10) + "image: about 17 s")
tell(event="run_finished", exit_code=0, elapsed_s=1.0)
"""


@contextlib.contextmanager
def jobs_in(folder: Path, told: list[tuple[str, Any]] | None = None) -> Iterator[Jobs]:
    """Jobs of the program above; what they publish is appended to a list."""
    heard = [] if told is None else told
    program = [sys.executable, "-c", PROGRAM]
    jobs = Jobs(folder, lambda event, data: heard.append((event, data)), program)
    try:
        yield jobs
    finally:
        running = jobs.running()
        jobs.close()
        if running is not None:
            with contextlib.suppress(OSError):
                os.killpg(JobRecord.read(folder_of(folder) / "job.json").process, signal.SIGKILL)


def folder_of(workspace: Path, number: int = 1) -> Path:
    return workspace / ".studio" / "jobs" / f"{number:04d}"


def do(jobs: Jobs, name: str) -> None:
    """Start a job, and wait until it has ended."""
    jobs.start(name)
    until(lambda: jobs.running() is None)


def test_progress_is_published_and_the_end_kept(tmp_path: Path) -> None:
    told: list[tuple[str, Any]] = []
    with jobs_in(tmp_path, told) as jobs:
        do(jobs, "quality")
        assert jobs.state()["job"] is None
        (ended,) = jobs.history()
    assert (ended["state"], ended["exit_code"], ended["line"]) == ("done", 0, "plan: 4 lines")
    assert ended["finished"] == ["plan"] and ended["title"] == "Judge the pictures"
    name, last = told[-1]
    assert name == "run" and last["ended"] and last["last"] == ended
    with jobs_in(tmp_path) as later:
        assert later.history() == [ended]
        texts = [line["text"] for line in later.log(1)["lines"]]
    assert texts[1] == "plan" and texts[-1].startswith("run finished: exit code 0")
    file = folder_of(tmp_path) / "job.json"
    record = JobRecord.read(file)  # as if no studio had seen its end
    record.model_copy(update={"ended_utc": None, "state": "running"}).write(file)
    with jobs_in(tmp_path) as later:
        (found,) = later.history()
    assert (found["state"], found["exit_code"]) == ("done", 0)


def test_stop_ends_its_whole_group_as_ctrl_c_does(tmp_path: Path) -> None:
    with jobs_in(tmp_path) as jobs:
        jobs.start("plan")
        until(lambda: any("worker" in line["text"] for line in jobs.log(1)["lines"]))
        texts = " ".join(line["text"] for line in jobs.log(1)["lines"])
        worker = int(texts.split("worker ")[1].split()[0])
        assert psutil.pid_exists(worker)
        assert jobs.stop()
        until(lambda: jobs.running() is None)
        (ended,) = jobs.history()
        assert not jobs.stop()
    assert (ended["state"], ended["exit_code"]) == ("stopped", 130)
    until(lambda: not psutil.pid_exists(worker))


def test_a_killed_job_says_so(tmp_path: Path) -> None:
    with jobs_in(tmp_path) as jobs:
        jobs.start("plan")
        until(lambda: jobs.log(1)["total"] > 2)
        os.kill(JobRecord.read(folder_of(tmp_path) / "job.json").process, signal.SIGKILL)
        until(lambda: jobs.running() is None)
        (ended,) = jobs.history()
        assert ended["state"] == "killed" and "start it again" in ended["line"]
        do(jobs, "quality")  # and another may begin
        assert [one["state"] for one in jobs.history()] == ["done", "killed"]


def test_a_fault_is_its_one_line(tmp_path: Path) -> None:
    with jobs_in(tmp_path) as jobs:
        do(jobs, "fly")
        do(jobs, "report")
        usage, fault = jobs.history()
    assert fault["state"] == "failed" and fault["stage"] == "plan"
    assert fault["line"] == "no plan: run 'alice-survey plan -w reef' first"
    assert usage["state"] == "failed" and usage["line"] == "no such option: --nothing"


def test_a_second_start_is_refused(tmp_path: Path) -> None:
    with jobs_in(tmp_path) as jobs, jobs_in(tmp_path) as another_page:
        jobs.start("plan")
        for refused in (jobs, another_page):
            with pytest.raises(BusyError):
                refused.start("quality")
        assert another_page.running() is not None
        jobs.stop()
        until(lambda: jobs.running() is None and another_page.running() is None)
        until(jobs.history)  # the job is kept a moment after it has ended
        assert len(jobs.history()) == 1


def test_a_command_elsewhere_is_seen_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("alice_survey.app.studio.jobs._LOCK_S", 0.2)
    with jobs_in(tmp_path) as jobs:
        (tmp_path / "dense.partial").mkdir()
        assert not jobs.state()["elsewhere"]
        with FileLock(tmp_path / ".lock"):
            assert jobs.state()["elsewhere"]
            with pytest.raises(BusyError):
                jobs.start("quality")
        assert not jobs.state()["elsewhere"]
        do(jobs, "quality")


def test_a_later_studio_finds_the_job_and_can_stop_it(tmp_path: Path) -> None:
    with jobs_in(tmp_path) as killed:  # its threads go on; those of a killed studio would not
        killed.start("plan")
        until(lambda: killed.log(1)["total"] > 2)
        told: list[tuple[str, Any]] = []
        with jobs_in(tmp_path, told) as later:
            job = later.running()
            assert job is not None and job["name"] == "plan" and job["state"] == "running"
            until(lambda: any(data["job"] and data["job"]["steps"] for _, data in told))
            later.stop()
            until(lambda: later.running() is None)
            (ended,) = later.history()
    assert (ended["state"], ended["exit_code"]) == ("stopped", 130)


def test_another_process_of_the_same_number_is_not_the_job(tmp_path: Path) -> None:
    own = psutil.Process()
    same = JobRecord(
        number=1, name="plan", title="", command="", started_utc="2026-01-01T00:00:00+00:00",
        process=own.pid, created_s=own.create_time(),
    )  # fmt: skip
    assert same.is_alive()
    assert not same.model_copy(update={"created_s": own.create_time() - 5}).is_alive()


def test_the_studio_ends_its_job(tmp_path: Path) -> None:
    with jobs_in(tmp_path) as jobs:
        jobs.start("plan")
        until(lambda: jobs.log(1)["total"] > 2)
        jobs.close()
        (ended,) = until(jobs.history)  # its end is recorded a moment later
    assert (ended["state"], ended["exit_code"]) == ("stopped", 130)


@pytest.mark.parametrize("linked", [".studio", ".studio/jobs", ".studio/jobs/2024"])
def test_jobs_behind_a_link_are_not_touched(linked: str, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for year in range(2000, 2025):
        (photos / "jobs" / str(year)).mkdir(parents=True)
        (photos / "jobs" / str(year) / "photo.jpg").touch()
    target = {".studio": photos, ".studio/jobs": photos / "jobs"}.get(linked, photos / "jobs/2024")
    before = sorted(photos.rglob("*"))
    link = tmp_path / "work" / linked
    link.parent.mkdir(parents=True)
    link.symlink_to(target)
    with jobs_in(tmp_path / "work") as jobs:
        assert jobs.history() == []
        with pytest.raises(AliceError, match="is a link"):
            jobs.start("quality")
    assert sorted(photos.rglob("*")) == before


def test_only_folders_of_recorded_jobs_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("alice_survey.app.studio.jobs._KEPT_JOBS", 1)
    with jobs_in(tmp_path) as jobs:
        do(jobs, "quality")
        (folder_of(tmp_path) / "notes.txt").write_text("of a person")
        photo = folder_of(tmp_path, 2000) / "photo.jpg"
        photo.parent.mkdir()
        photo.write_text("a photo")
        copied = JobRecord.read(folder_of(tmp_path) / "job.json")
        copied.write(folder_of(tmp_path, 1999) / "job.json")  # of another number than its folder's
        for _ in range(2):
            do(jobs, "quality")
        assert [one["number"] for one in jobs.history()] == [2002]
    assert photo.read_text() == "a photo"
    assert (folder_of(tmp_path, 1999) / "job.json").is_file()
    assert [path.name for path in folder_of(tmp_path).iterdir()] == ["notes.txt"]
    assert not folder_of(tmp_path, 2001).exists()


def test_a_log_is_bounded_and_damaged_lines_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    tail, run = EventsTail(path), RunState()
    assert not run.update(tail.read())
    note = json.dumps({"event": "note", "message": "words", "time_utc": "2026"})
    path.write_text(f"{note}\n" * (KEPT_LINES + 5) + "{damaged\n[1]\n" + note[:9])
    assert run.update(tail.read())
    assert run.lines_n == KEPT_LINES + 5 and len(run.log()) == KEPT_LINES
    with path.open("a") as file:
        file.write(note[9:] + "\n")
    run.update(tail.read())
    assert run.lines_n == KEPT_LINES + 6
    assert len(run.log(after=KEPT_LINES + 5)) == 1 and run.log(after=10**6) == []


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("job.json", {"process": "x"}), ("job.json", {"process": -1}),  # all that this user runs
        ("job.json", {"number": 10**400}), ("job.json", {"started_utc": "yesterday"}),
        ("events.jsonl", {"step_number": None}), ("events.jsonl", {"elapsed_s": "abc"}),
        ("events.jsonl", {"event": "run_finished"}),
        ("events.jsonl", {"event": "run_finished", "exit_code": "x"}),
        ("events.jsonl", {"event": "stage_finished", "stage": "nostage"}),
    ],
)  # fmt: skip
def test_damaged_records_hide_a_job_at_most(
    file: str, text: dict[str, Any], tmp_path: Path
) -> None:
    with jobs_in(tmp_path) as jobs:
        do(jobs, "quality")
    job, path = folder_of(tmp_path) / "job.json", folder_of(tmp_path) / file
    job.write_text(json.dumps(json.loads(job.read_text()) | {"ended_utc": None}))
    kept = json.loads(job.read_text()) if path == job else {"event": "step_progress"}
    path.write_text(json.dumps(kept | text))
    with jobs_in(tmp_path) as later:
        later.state()
        assert len(later.history()) <= 1
        do(later, "quality")


def test_what_compiles_ahead_has_the_lowest_priority_and_ends_with_the_studio() -> None:
    ending, before = threading.Event(), psutil.Process().children()
    ahead = threading.Thread(target=compile_survey, args=(ending,))
    ahead.start()
    (one,) = until(lambda: [new for new in psutil.Process().children() if new not in before])
    until(lambda: one.nice() == 19)
    scratch = Path(one.cmdline()[-1].partition("=")[2])
    assert scratch.is_dir()
    ending.set()
    ahead.join(30.0)
    assert not (one.is_running() or scratch.exists())
