"""Predicted cost: its arithmetic against closed forms, and against a survey that was run."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from alice_survey.app import computing
from alice_survey.app.cli.main import app
from alice_survey.app.computing import (
    PREDICTED,
    StageCost,
    correction,
    size_of,
    stage_costs,
    total_cost,
)
from alice_survey.app.stages import spec
from alice_survey.core.artefacts import StageRecord
from alice_survey.core.config import ReconstructConfig

COST = StageCost(
    serial_s=10.0,
    tasks_s=80.0,
    tasks=40,
    process_mib=300.0,
    worker_mib=500.0,
    product_mb=7.0,
    scratch_mb=3.0,
)
SETTINGS = ReconstructConfig()


def test_tasks_are_shared_out_and_the_rest_is_not() -> None:
    assert COST.time_s(1) == COST.cpu_s == 90.0
    assert COST.time_s(2) == 50.0
    assert COST.time_s(1) / 2 < COST.time_s(2) < COST.time_s(1)
    assert COST.time_s(40) == COST.time_s(4000) == 12.0


def test_memory_is_of_the_largest_stage_and_disk_of_all() -> None:
    other = replace(COST, worker_mib=100.0, process_mib=1500.0, product_mb=100.0, scratch_mb=50.0)
    assert total_cost([COST, other], 2) == {
        "time_s": COST.time_s(2) + other.time_s(2),
        "memory_mib": 1700.0,
        "disk_mb": 7.0 + 100.0 + 50.0,
    }
    assert total_cost([COST, other], 16)["memory_mib"] == 300.0 + 16 * 500.0


def test_a_survey_that_was_not_learned_from_costs_what_it_did() -> None:
    """The survey of `tests/small_survey.py`, computing and products, as run with one worker."""
    size = size_of(30, 0.2544, SETTINGS, board_pictures=24)
    costs = stage_costs(size)
    measured = {"image": (28.9, 30.0), "calibrate and reconstruct": (77.7, 26.0)}
    for group, (cpu_s, product_mb) in measured.items():
        found = [costs[stage] for stage in computing.GROUPS[group]]
        assert 0.5 < sum(cost.cpu_s for cost in found) / cpu_s < 2.0
        assert 0.5 < sum(cost.product_mb for cost in found) / product_mb < 2.0


def test_a_coarser_surface_takes_less() -> None:
    coarse = ReconstructConfig(dem_cell_m=0.01)
    size = size_of(10, 2.0, coarse, pixel_m=0.002)
    assert size.refined_mpx == pytest.approx(2.0 * 0.5**2)
    fine = stage_costs(size_of(10, 2.0, SETTINGS, pixel_m=0.002))
    for stage, cost in stage_costs(size).items():
        assert (cost.cpu_s < fine[stage].cpu_s) == (stage in ("dense", "mesh"))


def test_cost_grows_with_pictures_and_no_faster_than_they_do() -> None:
    once, twice = (stage_costs(size_of(n, 2.0, SETTINGS, board_pictures=24)) for n in (500, 1000))
    for stage in PREDICTED:
        assert once[stage].cpu_s <= twice[stage].cpu_s <= 2 * once[stage].cpu_s
    left = PREDICTED[3:]
    assert sum(twice[n].cpu_s for n in left) > 1.8 * sum(once[n].cpu_s for n in left)


def test_what_has_run_here_corrects_what_is_left() -> None:
    def record(stage: str, cpu_s: float, processor: str = "this") -> StageRecord:
        return StageRecord(cpu_s=cpu_s, processor=processor, command=spec(stage).command)

    costs = dict.fromkeys(PREDICTED, COST)
    ran = record("image", 135.0)
    records = {
        "plan": record("plan", 135.0),
        "image": ran,
        "mapping": record("mapping", 45.0),
        "dense": record("dense", 900.0, "another"),
    }

    assert correction(costs, records, "this") == (1.0, 1.0, ["image", "mapping"])
    assert correction(costs, {"image": ran}, "this") == (1.5, math.sqrt(1.5), ["image"])
    assert correction(costs, {"image": ran}, "that") == (1.0, 1.0, [])
    copied = StageRecord(cpu_s=0.1, processor="this", command="import-images")
    assert correction(costs, {"image": copied}, "this") == (1.0, 1.0, [])
    many = {stage: record(stage, 135.0) for stage in PREDICTED[:-1]}
    ratio, factor, names = correction(costs, many, "this")
    assert ratio == 1.5 > factor > 1.4
    assert names == [*PREDICTED[:-1]]
    assert COST.scale(1.5).time_s(2) == 1.5 * COST.time_s(2)


def test_plan_and_status_say_what_is_left_to_pay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(computing, "default_threads", lambda: 2)
    folder = tmp_path / "cove"
    folder.mkdir()
    (folder / "survey.toml").write_text("[area]\nlength_m = 2.0\nwidth_m = 2.0\n")
    run = CliRunner()

    planned = run.invoke(app, ["plan", "-w", str(folder), "--json"])
    cost = json.loads(planned.stdout)["cost"]
    lines = run.invoke(app, ["plan", "-w", str(folder)]).stdout.splitlines()
    left = json.loads(run.invoke(app, ["status", str(folder), "--json", "--workers", "64"]).stdout)
    shown = run.invoke(app, ["status", str(folder), "--workers", "64"]).stdout

    image, rest = cost["image"], cost["calibrate and reconstruct"]
    assert image["stages"] + rest["stages"] == list(PREDICTED) == left["cost"]["left"]["stages"]
    assert left["cost"]["left"]["time_s"]["16"] == pytest.approx(
        image["time_s"]["16"] + rest["time_s"]["16"], abs=2
    )
    assert left["cost"]["left"]["time_s"]["64"] < rest["time_s"]["16"] + image["time_s"]["16"]
    for name, line in zip(("image: ", "calibrate and reconstruct: "), lines[-2:], strict=True):
        assert line.startswith(name)
        for part in (" on 16), ", " of memory, ", " of disk"):
            assert part in line
    assert "on 64 workers" in shown
