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


def plan(workspace: Path, code: int = 0) -> str:
    """The last line of what planning says; its exit code is as wanted."""
    command = [sys.executable, "-m", "alice_survey", "plan", "-w", str(workspace), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    line = ["", *done.stderr.strip().splitlines()][-1]
    assert code == 0 or line.startswith("error: ")
    return line


def test_a_file_that_may_not_grow_is_named_with_what_to_do(tmp_path: Path) -> None:
    init_survey(tmp_path, "demo.toml")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        refused = plan(tmp_path, code=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "plan.partial" in refused and "ulimit" in refused
    plan(tmp_path)


@AS_ROOT
def test_a_full_disk_is_reported_and_the_same_command_goes_on(disk: Path) -> None:
    init_survey(disk, "demo.toml")
    assert "No space left" in plan(disk, code=1)
    assert not (disk / "plan").exists()
    remount(disk, "size=50m")
    plan(disk)
    assert (disk / "plan" / "plan.json").is_file()
    assert not list(disk.glob("*.partial"))
    # It fills up again: finished stages stay as they are.
    before = {p: p.read_bytes() for p in (disk / "plan").rglob("*") if p.is_file()}
    free = shutil.disk_usage(disk).free
    with (disk / "other").open("wb") as other:
        other.write(b"\0" * (free - 50_000))
    settings = disk / "survey.toml"
    settings.write_text(settings.read_text().replace("side_overlap = 0.3", "side_overlap = 0.4"))
    assert "No space left" in plan(disk, code=1)
    assert {p: p.read_bytes() for p in (disk / "plan").rglob("*") if p.is_file()} == before
    (disk / "other").unlink()
    plan(disk)
    assert (disk / "plan" / "plan.json").read_bytes() != before[disk / "plan" / "plan.json"]
    remount(disk, "ro")
    assert str(disk) in plan(disk, code=1)


def test_a_second_process_is_refused_and_a_crash_leaves_no_lock_behind(tmp_path: Path) -> None:
    init_survey(tmp_path, "demo.toml")
    code = (
        "import sys, time; from pathlib import Path\n"
        "from alice_survey.app.pipeline import only_one\n"
        "with only_one(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        assert str(tmp_path) in plan(tmp_path, code=1)
        assert not (tmp_path / "plan").exists()
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    plan(tmp_path)


def test_a_clock_that_jumps_does_not_make_stages_stale(tmp_path: Path) -> None:
    init_survey(tmp_path, "demo.toml")
    plan(tmp_path)
    record = tmp_path / "plan" / "stage.json"
    before = record.read_bytes()
    for when in (0.0, time.time() + 10 * 365 * 86_400):
        for path in tmp_path.rglob("*"):
            os.utime(path, (when, when))
        plan(tmp_path)
        assert record.read_bytes() == before
