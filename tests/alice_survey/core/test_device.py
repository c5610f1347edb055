import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from alice_survey.app.commands import base as device
from alice_survey.app.commands.base import DeviceCommand
from alice_survey.core.errors import ConfigError, collected_by

Chosen = Callable[[device.Choice], tuple[bool, list[str]]]


@pytest.fixture
def chosen(tmp_path: Path) -> Chosen:
    """Whether an executor uses the GPU by `--device`, and what is said."""

    def found(choice: device.Choice) -> tuple[bool, list[str]]:
        said: list[str] = []
        with (
            collected_by(lambda _, text: said.append(text)),
            DeviceCommand(workspace=tmp_path, threads=1).started_executor(choice) as executor,
        ):
            return executor.uses_gpu, said

    return found


def test_a_gpu_that_answers_is_used_and_named(
    monkeypatch: pytest.MonkeyPatch, chosen: Chosen
) -> None:
    monkeypatch.setattr(device, "find_spec", lambda name: name)
    monkeypatch.setattr(device, "_first_gpu", lambda: ("Card 7", ""))
    for choice in ("auto", "gpu"):
        uses, (line,) = chosen(choice)
        assert uses
        assert "Card 7" in line
    assert chosen("cpu") == (False, [])


def test_without_the_extra_only_a_demand_for_a_gpu_is_an_error(
    monkeypatch: pytest.MonkeyPatch, chosen: Chosen
) -> None:
    monkeypatch.setattr(device, "find_spec", lambda _: None)
    assert chosen("auto") == chosen("cpu") == (False, [])
    with pytest.raises(ConfigError, match="numba-cuda") as error:
        chosen("gpu")
    assert "\n" not in str(error.value)


def test_a_gpu_that_does_not_answer_is_an_error_of_one_line(
    monkeypatch: pytest.MonkeyPatch, chosen: Chosen
) -> None:
    cuda = pytest.importorskip("numba.cuda")
    monkeypatch.setattr(device, "find_spec", lambda name: name)
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    monkeypatch.setattr(cuda, "cuda_error", lambda: "no device\nis there")
    assert chosen("auto") == (False, [])
    with pytest.raises(ConfigError, match="no device is there"):
        chosen("gpu")


def test_a_cluster_takes_no_gpu(tmp_path: Path) -> None:
    with (
        pytest.raises(typer.BadParameter, match="--device"),
        DeviceCommand(workspace=tmp_path, scheduler="tcp://127.0.0.1:1").started_executor("gpu"),
    ):
        pass


def test_the_processor_needs_no_cuda() -> None:
    code = (
        "import sys, reconstruct.dense.run\n"
        "from alice_survey.app.commands.base import is_gpu_chosen\n"
        "assert not is_gpu_chosen('cpu'); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not any(name.startswith(("numba.cuda", "numba_cuda")) for name in done.stdout.split())
