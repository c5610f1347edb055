"""What a command does when the machine fails under it: disk full, read-only, crash, two at once."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from alice_survey.app.pipeline import init_survey

pytestmark = pytest.mark.slow

AS_ROOT = pytest.mark.skipif(
    os.geteuid() != 0 and "CI" not in os.environ, reason="only root mounts a small disk"
)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 300 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", folder], check=True)
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


def remount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", folder], check=True)


def plan(workspace: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "alice_survey", "plan", "-w", str(workspace), "--quiet"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 1, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert "Traceback" not in done.stderr
    assert lines[-1].startswith("error: ")
    return lines[-1]


def test_a_file_that_may_not_grow_is_named_with_what_to_do(tmp_path: Path) -> None:
    init_survey(tmp_path, "demo.toml")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        refused = one_line(plan(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "plan.partial" in refused and "ulimit" in refused
    assert plan(tmp_path).returncode == 0


@AS_ROOT
def test_a_full_disk_is_reported_and_the_same_command_goes_on(disk: Path) -> None:
    init_survey(disk, "demo.toml")
    assert "No space left" in one_line(plan(disk))
    assert not (disk / "plan").exists()
    remount(disk, "size=50m")
    assert plan(disk).returncode == 0
    assert (disk / "plan" / "plan.json").is_file()
    assert not list(disk.glob("*.partial"))


@AS_ROOT
def test_a_disk_that_fills_up_leaves_finished_stages_as_they_are(disk: Path) -> None:
    remount(disk, "size=50m")
    init_survey(disk, "demo.toml")
    assert plan(disk).returncode == 0
    before = {p: p.read_bytes() for p in (disk / "plan").rglob("*") if p.is_file()}
    free = shutil.disk_usage(disk).free
    with (disk / "other").open("wb") as other:
        other.write(b"\0" * (free - 50_000))
    settings = disk / "survey.toml"
    settings.write_text(settings.read_text().replace("side_overlap = 0.3", "side_overlap = 0.4"))
    assert "No space left" in one_line(plan(disk))
    assert {p: p.read_bytes() for p in (disk / "plan").rglob("*") if p.is_file()} == before
    (disk / "other").unlink()
    assert plan(disk).returncode == 0
    assert (disk / "plan" / "plan.json").read_bytes() != before[disk / "plan" / "plan.json"]


@AS_ROOT
def test_a_workspace_that_cannot_be_written_is_named(disk: Path) -> None:
    remount(disk, "size=50m")
    init_survey(disk, "demo.toml")
    remount(disk, "ro")
    assert str(disk) in one_line(plan(disk))


def _holder(workspace: Path) -> subprocess.Popen[str]:
    """Another process that works in the workspace until it is killed."""
    code = (
        "import sys, time; from pathlib import Path\n"
        "from alice_survey.app.pipeline import only_one\n"
        "with only_one(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(workspace)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_refused_and_a_crash_leaves_no_lock_behind(tmp_path: Path) -> None:
    init_survey(tmp_path, "demo.toml")
    holder = _holder(tmp_path)
    try:
        assert str(tmp_path) in one_line(plan(tmp_path))
        assert not (tmp_path / "plan").exists()
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    assert plan(tmp_path).returncode == 0


def test_a_clock_that_jumps_does_not_make_stages_stale(tmp_path: Path) -> None:
    init_survey(tmp_path, "demo.toml")
    assert plan(tmp_path).returncode == 0
    record = tmp_path / "plan" / "stage.json"
    before = record.read_bytes()
    for when in (0.0, time.time() + 10 * 365 * 86_400):
        for path in tmp_path.rglob("*"):
            os.utime(path, (when, when))
        assert plan(tmp_path).returncode == 0
        assert record.read_bytes() == before
