"""Finished products that a disk, a person or another program has damaged since."""

import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.app.commands.survey import RunCommand
from alice_survey.app.pipeline import run, status_report
from alice_survey.app.stages import STAGES, spec
from alice_survey.core.artefacts import read_stage, renew_outputs, run_stage
from alice_survey.core.config import load_config
from alice_survey.core.errors import AliceError, PlanError, WorkspaceError
from alice_survey.core.executor import SERIAL
from tests.small_survey import start
from tests.test_loop import results

pytestmark = pytest.mark.slow

DAMAGES = 400


def flip(path: Path, rng: np.random.Generator) -> None:
    content = bytearray(path.read_bytes())
    content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)


def cut(path: Path, rng: np.random.Generator) -> None:
    os.truncate(path, int(rng.integers(path.stat().st_size)))


def blank(path: Path, _: np.random.Generator) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def remove(path: Path, _: np.random.Generator) -> None:
    path.unlink()


KINDS: tuple[Callable[[Path, np.random.Generator], None], ...] = (flip, cut, blank, remove)


def invoke(words: list[str]) -> tuple[int, str]:
    """Exit code and text of a command; a known fault is raised."""
    done = CliRunner().invoke(app, words)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.output


@pytest.fixture
def workspace(tiny_survey: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_survey, tmp_path / "survey"))


def test_hundreds_of_damages_are_noticed(workspace: Path) -> None:
    """By the state of the stage that wrote the file; of the same size and time, if files are read.

    A copy of the workspace, whose files have other times, is not damaged.
    """
    rng = np.random.default_rng(5)
    files = [path for one in STAGES for path in sorted((workspace / one.folder).rglob("*"))
             if path.is_file()]  # fmt: skip
    os.utime(workspace / "dense" / "dem.tif")
    assert {*status_report(workspace, None)[1]["stages"].values()} == {"up to date"}
    noticed: Counter[str] = Counter()
    for number in range(DAMAGES):
        path, kind = files[number % len(files)], KINDS[rng.integers(len(KINDS))]
        before, status = path.read_bytes(), path.stat()
        kind(path, rng)
        if path.exists() and path.read_bytes() == before:
            continue
        is_same_time = kind is not remove and number % 10 == 0
        if is_same_time:
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        folder = path.relative_to(workspace).parts[0]
        found = status_report(workspace, None, verify=is_same_time)[1]
        state = found["stages"][spec(folder).name]
        assert state != "up to date", f"{kind.__name__} of {path}"
        assert path.name == "stage.json" or path.name in state
        noticed[kind.__name__] += 1
        path.write_bytes(before)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert min(noticed.values()) > 60
    found = status_report(workspace, None, verify=True)[1]
    assert {*found["stages"].values()} == {"up to date"}


def test_nothing_is_computed_from_damaged_files(workspace: Path) -> None:
    """Neither size nor time shows these damages: who reads a file notices."""
    config, rng = load_config(workspace / "survey.toml"), np.random.default_rng(6)
    read = 0
    for one in STAGES:
        stage = one.stage(workspace, config)
        record = read_stage(workspace / one.folder)
        assert record is not None
        inputs = [workspace / name for name in record.inputs if not name.startswith("..")]
        for path in [inputs[i] for i in rng.permutation(len(inputs))[:3]]:
            before, status = path.read_bytes(), path.stat()
            flip(path, rng)
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
            with pytest.raises(WorkspaceError, match=path.name) as refusal:
                run_stage(workspace, replace(stage, version=-1), lambda _: pytest.fail("worked"))
            owner = spec(path.relative_to(workspace).parts[0])
            assert f"alice-survey {owner.command} -w {workspace}'" in str(refusal.value)
            with pytest.raises(WorkspaceError, match=path.name):
                owner.need(workspace)
            path.write_bytes(before)
            read += 1
    assert read >= 20


def test_two_threads_make_every_damaged_product_again(tiny_survey: Path, workspace: Path) -> None:
    """All products of all stages are damaged at once; the same command makes each again.

    Two threads give the same numbers as one.
    """
    rng = np.random.default_rng(7)
    for number, name in enumerate(results(workspace)):
        KINDS[number % len(KINDS)](workspace / name, rng)
    with pytest.raises(AliceError):
        run(["evaluate"], workspace, None, SERIAL)
    assert start(workspace, threads=2).wait() == 0
    again, whole = results(workspace), results(tiny_survey)
    assert again.keys() == whole.keys()
    before = ("plan", "flight", "pool", "images", "calibration")
    assert not [name for name in whole if name.startswith(before) and again[name] != whole[name]]
    for name in ("sparse/track.csv", "evaluation/cameras.csv"):
        one, two = (
            [row.split(",") for row in made[name].decode().splitlines()] for made in (whole, again)
        )
        assert len(one) == len(two)
        for a, b in zip(one, two, strict=True):
            for x, y in zip(a, b, strict=True):
                try:
                    assert float(x) == pytest.approx(float(y), abs=1e-6)
                except ValueError:
                    assert x == y
    for name, atol in (("dense/dem.tif", 1e-6), ("mosaic/mosaic.tif", 0.0)):
        with rasterio.open(tiny_survey / name) as a, rasterio.open(workspace / name) as b:
            np.testing.assert_allclose(a.read(), b.read(), rtol=0, atol=atol)
            assert a.transform == b.transform


def test_an_edited_mission_is_flown_only_on_request(workspace: Path) -> None:
    exports = workspace / "plan" / "exports"
    mission = exports / "mission_dive1.xml"
    fly = ["fly", "-w", str(workspace), "--mission", str(mission)]
    subprocess.run(["sha256sum", "--check", "SHA256SUMS"], cwd=exports, check=True)
    text = mission.read_text()
    mission.write_text(text[: len(text) // 2])
    with pytest.raises(PlanError, match="edited or is damaged"):
        invoke(fly)
    assert "exports/mission_dive1.xml has changed" in invoke(["status", "-w", str(workspace)])[1]
    mission.write_text(text + "\n")
    with pytest.raises(PlanError, match="--edited"):
        invoke(fly)
    code, said = invoke([*fly, "--edited"])
    assert code == 0 and "complete" in said
    invoke(["plan", "export", str(workspace)])
    assert mission.read_text() == text
    assert invoke(fly)[0] == 0
    assert "plan/         up to date" in invoke(["status", "-w", str(workspace)])[1]


def test_a_flight_that_ends_early_stops_the_run(
    workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RunCommand, "stages", lambda _: ["plan", "fly", "pool"])
    flight = workspace / "flight" / "flight.json"
    flight.write_text(flight.read_text().replace('"complete"', '"aborted: no progress"'))
    renew_outputs(flight.parent, [flight])
    (workspace / "pool" / "manifest.csv").unlink()
    code, said = invoke(["run", "-w", str(workspace)])
    assert code == 3 and "fly: the flight ended early: aborted" in said
    assert not (workspace / "pool" / "manifest.csv").exists()
    assert invoke(["run", "-w", str(workspace), "--accept"])[0] == 3
    assert (workspace / "pool" / "manifest.csv").exists()
