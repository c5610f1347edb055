"""Predicted cost: its arithmetic against closed forms, and against a survey that was run."""

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from alice_survey.app import computing
from alice_survey.app.cli.main import app
from alice_survey.app.computing import (
    PREDICTED,
    StageCost,
    SurveyCost,
    SurveySize,
    correction,
    planned_size,
    size_of,
    stage_costs,
)
from alice_survey.core.artefacts import StageRecord
from alice_survey.core.config import CameraConfig, ImagingConfig, ReconstructConfig, SeafloorConfig
from benchmarks.costs import fitted, written
from reconstruct.matching.features import detection_scales

COST = StageCost(
    serial_s=10.0,
    tasks_s=80.0,
    tasks=40,
    process_mib=300.0,
    worker_mib=500.0,
    product_mb=7.0,
    scratch_mb=3.0,
)
RIG = ReconstructConfig()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of speeds of its own."""
    monkeypatch.setattr(computing, "_cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_tasks_are_shared_out_and_the_rest_is_not() -> None:
    assert COST.time_s(1) == COST.cpu_s(1) == COST.cpu_s(9) == 90.0
    assert COST.time_s(2) == 50.0
    assert COST.time_s(1) / 2 < COST.time_s(2) < COST.time_s(1)
    assert COST.time_s(40) == COST.time_s(4000) == 12.0
    started = replace(COST, start_s=3.0)
    assert started.time_s(1) == 90.0
    assert started.time_s(2) == 53.0
    assert started.cpu_s(4) == 90.0 + 4 * 3.0


def test_memory_is_of_the_largest_stage_and_disk_of_all() -> None:
    other = replace(COST, worker_mib=100.0, process_mib=1500.0, product_mb=100.0, scratch_mb=50.0)
    both = SurveyCost(stages={"mapping": COST, "dense": other}, workers=2)

    assert both.memory_mib(2) == 1700.0
    assert both.memory_mib(16) == 300.0 + 16 * 500.0
    assert both.disk_mb == 7.0 + 100.0 + 50.0
    assert both.time_s(2) == COST.time_s(2) + other.time_s(2)


def test_coefficients_are_recovered_from_what_they_give() -> None:
    rng = np.random.default_rng(4)
    names = ("once", "pictures", "cells")
    rows = [dict(zip(names, (1.0, *rng.uniform(1, 1e4, 2)), strict=True)) for _ in range(12)]
    true = {"once": 5.0, "cells": 0.02}

    found = fitted(rows, [sum(true[n] * row[n] for n in true) for row in rows])

    assert found.keys() >= true.keys()
    for name in names:
        assert found.get(name, 0.0) == pytest.approx(true.get(name, 0.0), rel=1e-8, abs=1e-12)


def test_small_surveys_count_like_large_ones() -> None:
    """Of values with one driver the coefficient is the geometric mean of their ratios to it."""
    sizes, ratios = np.array([3.0, 500.0, 80_000.0]), np.array([10.0, 15.0, 30.0])
    found = fitted([{"pictures": size} for size in sizes.tolist()], (sizes * ratios).tolist())
    assert found["pictures"] == pytest.approx(float(np.prod(ratios)) ** (1 / 3), rel=1e-6)


def test_what_is_written_is_read_as_it_was() -> None:
    stages = {"dense": {"serial_s": {"once": 2.5}, "tasks_s": {}}}
    read = tomllib.loads(written(stages, 0.25, 'a "processor"', ["reef"]))
    assert read.pop("stages") == stages
    assert read == {"surveys": ["reef"], "processor": 'a "processor"', "probe_s": 0.25}


@pytest.mark.parametrize("mpx", [0.5, 2.9, 3.1, 9.2, 30.0])
def test_pictures_are_halved_as_the_stages_do(mpx: float) -> None:
    side = int(np.sqrt(mpx * 1e6))
    full = size_of(10, mpx, ReconstructConfig())
    assert full.refined_mpx == mpx
    assert min(mpx, 0.75) <= full.matched_mpx <= 3.0
    assert np.log2(np.sqrt(mpx / full.matched_mpx)) % 1 == pytest.approx(0.0, abs=1e-9)
    coarse = size_of(10, mpx, ReconstructConfig(dem_cell_m=0.01), pixel_m=0.002)
    assert coarse.refined_mpx == pytest.approx(mpx * 0.5**2)
    assert size_of(10, mpx, ReconstructConfig(dense_scale=0.4)).refined_mpx == pytest.approx(
        0.16 * mpx
    )
    for maximum in (1000, 8000):
        reconstruct = ReconstructConfig(max_features=maximum)
        scales = detection_scales((side, side), maximum)
        for known, scale in ((True, scales[0]), (False, scales[-1])):
            found = size_of(10, mpx, reconstruct, rig_known=known).feature_mpx
            assert found == pytest.approx(mpx * scale**2, rel=0.02)


def test_the_area_of_a_line_is_that_of_its_pictures() -> None:
    plan: dict[str, Any] = {
        "footprint_m": [2.0, 1.0],
        "stations": 21,
        "altitude_m": 1.0,
        "lines": [{"start_ne_m": [0.0, 0.0], "end_ne_m": [0.0, 10.0]}],
        "area": {"allowed": {"type": "Polygon", "coordinates": [[[0, 0], [0, 8], [3, 8], [3, 0]]]}},
        "details": {"imaging": {"pixel_m": 0.0005}},
    }
    camera = CameraConfig(width_px=4000, height_px=2000)
    reconstruct = ReconstructConfig(dem_cell_m=0.01, mosaic_pixel_m=0.002)

    size = planned_size(
        plan, camera, ImagingConfig(scale=4), SeafloorConfig(grid_m=0.02), reconstruct
    )

    assert size.pictures == 42
    assert size.mpx == pytest.approx(0.5)
    assert size.pixel_m == pytest.approx(0.002)
    assert size.cells * 1e6 == pytest.approx(2.0 * 12.0 / 0.01**2)
    assert size.mosaic_mpx * 1e6 == pytest.approx(2.0 * 12.0 / 0.002**2)
    assert size.floor_cells * 1e6 == pytest.approx((3 + 2) * (8 + 2) / 0.02**2)


def test_a_survey_without_a_scale_has_the_cells_of_one_seen_as_often() -> None:
    pictures, pixel_m = 60, 0.001
    unscaled = size_of(pictures, 2.0, RIG)
    area_m2 = pictures * 2.0e6 * pixel_m**2 / 6
    scaled = size_of(pictures, 2.0, RIG, pixel_m=pixel_m, area_m2=area_m2)
    assert unscaled.cells == pytest.approx(scaled.cells)
    assert unscaled.mosaic_mpx == pytest.approx(scaled.mosaic_mpx)


def test_a_survey_that_was_not_learned_from_costs_what_it_did() -> None:
    """The survey of `tests/small_survey.py`, computing and products, as run with one worker."""
    size = SurveySize(
        pictures=30, mpx=0.2544, feature_mpx=0.12, features=1200, matched_mpx=0.2544,
        refined_mpx=0.2544, cells=0.1548, mosaic_mpx=0.9674, floor_cells=0.2656, board_pictures=24,
    )  # fmt: skip
    costs = stage_costs(size)
    measured = {"image": (28.9, 30.0), "calibrate and reconstruct": (77.7, 26.0)}
    for group, (cpu_s, product_mb) in measured.items():
        found = [costs[stage] for stage in computing.GROUPS[group]]
        assert 0.7 < sum(cost.cpu_s(1) for cost in found) / cpu_s < 1.3
        assert 0.7 < sum(cost.product_mb for cost in found) / product_mb < 1.3


def test_cost_grows_with_pictures_and_no_faster_than_they_do() -> None:
    once, twice = (stage_costs(size_of(n, 2.0, RIG, board_pictures=24)) for n in (500, 1000))
    for stage in PREDICTED:
        assert once[stage].cpu_s(1) <= twice[stage].cpu_s(1) <= 2 * once[stage].cpu_s(1)
    left = PREDICTED[3:]
    assert sum(twice[n].cpu_s(1) for n in left) > 1.8 * sum(once[n].cpu_s(1) for n in left)


def test_a_slower_machine_takes_longer_and_no_more_memory() -> None:
    size = size_of(100, 1.0, RIG, board_pictures=24)
    here, there = stage_costs(size, 3.0), stage_costs(size)
    for stage in PREDICTED:
        assert here[stage].cpu_s(2) == pytest.approx(3.0 * there[stage].cpu_s(2))
        assert here[stage].memory_mib(4) == there[stage].memory_mib(4)


def test_what_has_run_here_corrects_what_is_left() -> None:
    costs = dict.fromkeys(PREDICTED, COST)
    ran = StageRecord(cpu_s=135.0, processor="this")
    records = {
        "plan": ran,
        "image": ran,
        "mapping": StageRecord(cpu_s=45.0, processor="this"),
        "dense": StageRecord(cpu_s=900.0, processor="another"),
    }

    assert correction(costs, records, "this", 1) == (1.0, 1.0, ["image", "mapping"])
    assert correction(costs, {"image": ran}, "this", 1) == (1.5, math.sqrt(1.5), ["image"])
    assert correction(costs, {"image": ran}, "that", 1) == (1.0, 1.0, [])
    many = dict.fromkeys(PREDICTED[:-1], ran)
    ratio, factor, names = correction(costs, many, "this", 1)
    assert ratio == 1.5 > factor > 1.4
    assert names == [*PREDICTED[:-1]]
    assert COST.scaled(1.5).time_s(2) == 1.5 * COST.time_s(2)


def test_a_machine_is_probed_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    probes = iter([0.5, 7.0])
    monkeypatch.setattr(computing, "probe_s", lambda: next(probes))
    reference = computing.model()["probe_s"]

    first, second = computing.slowness(), computing.slowness()

    assert first == second == pytest.approx(0.5 / reference)
    monkeypatch.setattr(computing, "processor", lambda: "another one")
    assert computing.slowness() == pytest.approx(7.0 / reference)
    assert sorted(file.name for file in cache.iterdir()) == ["speed.json"]


def test_the_probe_leaves_opencv_as_it_was() -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(before + 1)
    try:
        assert computing.probe_s() > 0
        assert cv2.getNumThreads() == before + 1
    finally:
        cv2.setNumThreads(before)


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
    assert "0.45 mm pixels" in lines[-1]
    assert "on 64 workers" in shown
