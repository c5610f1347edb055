"""Tasks on a real Dask cluster: the same results, whatever happens to workers and scheduler."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from distributed.client import ClosedClientError

from alice_survey.core.cluster import engine
from alice_survey.core.cluster.engine import ClusterExecutor, cluster_executor, read_cluster_file
from alice_survey.core.cluster.shared_values import LARGE_BYTES, pack, pack_once, unpack
from alice_survey.core.cluster.worker import code_and_versions
from alice_survey.core.errors import AliceError, ConfigError, WorkspaceError, keep_warnings
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.run.resources import Meter, cpu_s, family
from tests import dask_tasks
from tests.dask_machines import Machines, kill, kill_work
from tests.test_loop import results, wait_for


@pytest.mark.parametrize("kind", ["C", "F", "every second", "one to many", "records", "read only"])
def test_large_arrays_are_files_and_come_back_as_they_were(kind: str, tmp_path: Path) -> None:
    array = np.random.default_rng(1).normal(size=(2 * LARGE_BYTES // 80, 10, 2))
    value = {
        "C": array,
        "F": np.asfortranarray(array),
        "every second": array[::2, ::2],
        "one to many": np.broadcast_to(array[0], array.shape),
        "records": array.view([("x", "f8"), ("y", "f8")]),
        "read only": array,
    }[kind]
    value.flags.writeable = kind != "read only" and value.flags.writeable

    data = pack({"large": value, "small": array[0], "again": value}, tmp_path)
    found = unpack(data, tmp_path)

    assert len(data) < 2000
    assert len(list(tmp_path.iterdir())) == 1
    for name in ("large", "again"):
        np.testing.assert_array_equal(found[name], value)
        assert found[name].dtype == value.dtype
    found["large"][:] = found["large"][::-1]
    np.testing.assert_array_equal(unpack(data, tmp_path)["large"], value)  # not what a task wrote


def test_arrays_of_the_same_bytes_and_another_shape_are_others(tmp_path: Path) -> None:
    array = np.arange(LARGE_BYTES, dtype=np.int64)
    wide = array.reshape(2, -1)
    for value in (array, wide, wide.astype(np.float64), np.asfortranarray(wide), wide.view("u8")):
        found = unpack(pack(value, tmp_path), tmp_path)
        np.testing.assert_array_equal(found, value)
        assert (found.dtype, found.shape, found.strides) == (
            value.dtype, value.shape, value.strides,
        )  # fmt: skip


def test_a_large_function_is_sent_by_name(tmp_path: Path) -> None:
    words = tuple(f"{n} words" for n in range(10_000))
    assert isinstance(pack_once(words[:10], tmp_path), bytes)
    name = pack_once(words, tmp_path)
    assert isinstance(name, str)
    assert unpack(name, tmp_path) == words


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "one of address, scheduler_file and start"),
        ("address = 'tcp://a:1'\nstart = 'b.C'", "one of"),
        ("address = 'tcp://a:1'\nworkers = 3", "give start"),
        ("addres = 'tcp://a:1'", "addres"),
        ("address = ", "not valid TOML"),
        ("start = 'b.C'\nworkers = 0", "workers"),
    ],
)
def test_a_wrong_cluster_file_is_named(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "cluster.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words) as raised:
        read_cluster_file(path)
    assert str(path) in str(raised.value)


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    with Machines(tmp_path_factory.mktemp("machines")) as running:
        yield running


@pytest.fixture
def executor(machines: Machines, tmp_path: Path) -> Iterator[ClusterExecutor]:
    with cluster_executor(tmp_path, machines.address, None) as found:
        yield found


def reported(executor: Executor) -> tuple[list[int], list[str], str]:
    """Results until a fault, the warnings, and the fault."""
    found = []
    with keep_warnings() as warnings, pytest.raises(AliceError) as raised:
        for result in executor.map(dask_tasks.square, range(40), label="square"):
            found.append(result)  # noqa: PERF402 (until the fault)
    return found, warnings, str(raised.value)


@pytest.mark.slow
def test_a_cluster_gives_what_this_process_gives(executor: ClusterExecutor, tmp_path: Path) -> None:
    meter = Meter()
    assert reported(executor) == reported(SERIAL)
    assert list(executor.map(str, iter([b"x" * 10_000_000]), label="long")) == [
        str(b"x" * 10_000_000)
    ]
    assert meter.look()["cpu_s"] > 0.0
    with pytest.raises(TypeError) as raised:
        list(executor.map(abs, ["a"], label="abs"))  # type: ignore[arg-type]
    assert "run_task" in "".join(raised.value.__notes__)  # where it happened
    assert [path.name for path in tmp_path.iterdir()] == [engine.STORE]


def test_what_a_killed_run_left_goes_and_what_another_uses_stays(tmp_path: Path) -> None:
    hold = (
        "import sys, time; from pathlib import Path; from alice_survey.core.cluster import engine; "
        "store = engine._store(Path(sys.argv[1])); print(store.__enter__(), flush=True)"
    )
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", f"{hold}; time.sleep(60)", str(tmp_path)],
            stdout=subprocess.PIPE, text=True,
        )
        for _ in range(2)
    ]  # fmt: skip
    try:
        killed, alive = (Path(run.stdout.readline().strip()) for run in runs if run.stdout)
        runs[0].kill()
        runs[0].wait()
        with engine._store(tmp_path) as own:
            assert own.is_dir() and alive.is_dir()
            assert not killed.exists()
        assert {path.name for path in own.parent.iterdir()} == {alive.name, f"{alive.name}.lock"}
    finally:
        for run in runs:
            run.kill()
            run.communicate()


@pytest.mark.slow
def test_computing_of_workers_below_this_process_counts_once(tmp_path: Path) -> None:
    file = tmp_path / "local.toml"
    file.write_text(
        'start = "distributed.LocalCluster"\noptions = { n_workers = 1, threads_per_worker = 1 }'
    )
    with cluster_executor(tmp_path, None, file) as executor:
        list(executor.map(dask_tasks.compute, [0.0], label="load"))
        before_s, meter = sum(map(cpu_s, family())), Meter()
        list(executor.map(dask_tasks.compute, [1.0] * 4, label="compute"))
        assert 3.9 < meter.look()["cpu_s"] < sum(map(cpu_s, family())) - before_s + 1.0


@pytest.mark.slow
def test_shared_values_go_with_their_run(machines: Machines, tmp_path: Path) -> None:
    with cluster_executor(tmp_path, None, machines.file) as executor:
        large = [np.full(LARGE_BYTES, n) for n in range(3)]
        found = list(executor.map(np.sum, large * 2, label="sum"))
        assert len(list(tmp_path.rglob("*.npy"))) == 3
    assert found == [0, LARGE_BYTES, 2 * LARGE_BYTES] * 2
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_killed_worker_and_a_stopped_one_change_nothing(
    executor: ClusterExecutor, machines: Machines, tmp_path: Path
) -> None:
    squares = [n * n for n in range(20)]
    tasks = [(tmp_path / "ended", n) for n in range(20)]
    assert list(executor.map(dask_tasks.end_worker_once, tasks, label="end")) == squares
    assert (tmp_path / "ended").exists()
    tasks = [(tmp_path / "stopped", n) for n in range(20)]
    assert list(executor.map(dask_tasks.stop_worker_once, tasks, label="stop")) == squares
    assert (tmp_path / "stopped").exists()
    for nanny in machines.workers:
        kill_work(nanny)  # a stopped one too; its nanny starts another


@pytest.mark.slow
def test_a_task_that_ends_every_worker_is_a_fault(executor: ClusterExecutor) -> None:
    with pytest.raises(AliceError, match=r"'end'.*memory"):
        list(executor.map(dask_tasks.end_worker, range(4), label="end"))


@pytest.mark.slow
def test_a_worker_that_loses_the_files_is_left_out(tmp_path: Path) -> None:
    """It sees the workspace in a name space of its own, where the test hides it."""
    space = ("unshare", "--mount", "--propagation", "slave")
    if subprocess.run([*space, "true"], capture_output=True).returncode:
        pytest.skip("this user may not make name spaces")
    folder = tmp_path / "workspace"
    folder.mkdir()
    (folder / "seven").write_text("7")
    with Machines(tmp_path / "machines", workers=0) as machines:
        hidden = machines.add("hidden", wrap=space)
        with (
            cluster_executor(folder, machines.address, None) as executor,
            keep_warnings() as warnings,
        ):
            machines.add("sound")
            while len(executor.cluster.workers()) < 2:
                time.sleep(0.1)
            tasks = [(tmp_path, folder / "seven", n) for n in range(8)]
            found = executor.map(dask_tasks.read_when_allowed, tasks, label="read")
            with ThreadPoolExecutor(1) as waiting:
                all_found = waiting.submit(copy_context().run, lambda: list(found))
                while len(list(tmp_path.glob("*.begun"))) < 2:
                    time.sleep(0.05)
                enter = ("nsenter", "--mount", "--target", str(hidden.pid))
                subprocess.run([*enter, "mount", "-t", "tmpfs", "none", str(folder)], check=True)
                (tmp_path / "go").touch()
                assert all_found.result() == [7 * n for n in range(8)]
            # Tasks may now go to one worker alone; it ends, and another takes its place.
            ends = [(tmp_path / "ended", n) for n in range(20)]
            squares = executor.map(dask_tasks.end_worker_once, ends, label="end")
            assert list(squares) == [n * n for n in range(20)]
        assert [text for text in warnings if "hidden" in text and "does not see" in text]


@pytest.mark.slow
def test_a_lost_scheduler_is_a_fault_of_one_line(tmp_path: Path) -> None:
    with (
        Machines(tmp_path / "machines") as machines,
        cluster_executor(tmp_path, machines.address, None) as executor,
    ):
        found = executor.map(dask_tasks.end_worker_once, [(tmp_path, 0)] * 500, label="wait")
        next(found)
        assert machines.scheduler
        kill(machines.scheduler.pid)
        with pytest.raises(AliceError, match=r"the scheduler at .* was lost"):
            list(found)


def test_a_task_that_cannot_be_forgotten_hides_no_fault() -> None:
    """A client closes some time after its scheduler was lost."""
    future, cluster = (
        Mock(cancel=Mock(side_effect=ClosedClientError)),
        engine.Cluster(Mock(), Mock()),
    )
    engine._Submitted(Mock(cluster=cluster, send=lambda *_: future), b"", b"").cancel()
    with pytest.raises(AliceError), cluster.report_loss():
        future.cancel()


@pytest.mark.slow
def test_what_is_wrong_with_a_cluster_is_said_before_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fault(folder: Path = tmp_path) -> str:
        with pytest.raises(WorkspaceError) as raised, cluster_executor(folder, address, None):
            pass
        return str(raised.value)

    monkeypatch.setattr(engine, "_WAIT_S", 1.0)
    monkeypatch.setattr(engine, "_CONNECT_S", 2)
    address = "tcp://127.0.0.1:9"
    assert "does not answer" in fault()
    with Machines(tmp_path / "machines", workers=0) as machines:
        address = machines.address
        assert "no worker" in fault()
        machines.add("broad", threads=2)
        monkeypatch.setattr(engine, "_WAIT_S", 60.0)
        assert "--nthreads 1" in fault()
        kill(machines.workers[-1].pid, signal.SIGTERM)
        machines.workers[-1].wait()
        machines.add("narrow")
        other = tuple({**dict(code_and_versions()), "numpy": "0.1"}.items())
        monkeypatch.setattr(engine, "code_and_versions", lambda: other)
        assert "this machine has 0.1: install the same" in fault()
    assert not (tmp_path / engine.STORE).exists()


@pytest.mark.slow
def test_a_survey_on_a_cluster_has_the_same_bytes_whatever_is_killed(
    tiny_survey: Path, tmp_path: Path
) -> None:
    """A worker is killed in every stage that renders or reconstructs, in one the scheduler.

    What is computed elsewhere is there before; the report fits what is made again.
    """
    stages = ("images", "mapping", "dense", "mosaic", "mesh")
    made = shutil.ignore_patterns(*stages, "sparse")
    workspace = Path(shutil.copytree(tiny_survey, tmp_path / "survey", ignore=made))
    events = workspace.with_suffix(".jsonl")
    with Machines(tmp_path / "machines") as machines:
        command = [
            sys.executable, "-m", "alice_survey", "run", "-w", str(workspace),
            "--cluster", str(machines.file), "--log-file", str(events),
        ]  # fmt: skip
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        for number, stage in enumerate(stages):
            assert wait_for(run, events, 0, event="stage_started", stage=stage), stage
            wait_for(run, events, 0, max_s=2.0, event="step_progress", stage=stage)
            kill_work(machines.workers[number % 2])
            if stage == "dense":
                assert machines.scheduler
                kill(machines.scheduler.pid)
                _, said = run.communicate()
                assert run.returncode == 1
                assert "was lost" in said.decode().splitlines()[-1], said.decode()
                machines.stop()
                machines.start()
                run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        _, said = run.communicate()
        assert run.returncode == 0, said.decode()
    assert not list(workspace.glob("*.partial"))
    assert not (workspace / engine.STORE).exists()
    here, there = results(tiny_survey), results(workspace)
    assert set(here) == set(there)
    assert not [name for name in here if here[name] != there[name]]
    steps = [json.loads(line) for line in events.read_text().splitlines()]
    assert any(step.get("sent_bytes", 0) > 0 for step in steps)
