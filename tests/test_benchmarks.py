"""`python -m benchmarks`: every benchmark returns figures of one form, and the table shows all."""

import argparse
import importlib
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import table
from benchmarks.figures import Figure, Findings, Goal, hand_over
from benchmarks.measured import Cost
from benchmarks.parts import PARTS, Part
from benchmarks.reconstruct_scores import bend_mm
from reconstruct.placing.alignment import sag_weights

ROOT = Path(__file__).parents[1]
MODULES = sorted({part.file for part in PARTS})
MACHINE = {
    "processor": "a processor", "cores": 2, "system": "a system", "load": "0.10 0.20 0.30",
    "versions": {"python": "3.11", "numpy": "2.0"},
}  # fmt: skip


def test_every_benchmark_that_hands_figures_over_is_a_part() -> None:
    files = [file for file in (ROOT / "benchmarks").glob("*.py") if file.stem != "figures"]
    found = sorted(file.stem for file in files if "add_options(parser" in file.read_text())

    assert found == MODULES
    assert {"camera", "planner", "vehicle", "features", "refraction", "bend",
            "cluster", "scale", "many_pictures", "refine_gpu", "precision",
            "reconstruct", "missions", "mosaic", "harbour", "facade", "turbid", "colour",
            "real_pictures", "studio"} == {*MODULES}  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_takes_quick_and_json(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for part in PARTS:
        if part.file == name and (reason := missing_packages(part)):
            pytest.skip(reason)
    monkeypatch.setattr(sys, "argv", [name, "--help"])

    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"benchmarks.{name}").main()

    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "--quick" in text
    assert "--json" in text


def missing_packages(part: Part) -> str | None:
    try:
        for package in part.packages:
            importlib.import_module(package)
    except ImportError as error:
        return str(error)
    return None


@pytest.mark.parametrize(
    ("value", "goal", "met"),
    [
        (5.0, Goal(maximum=5.0), True),
        (5.1, Goal(maximum=5.0), False),
        (0.9, Goal(minimum=1.0), False),
        (1.0, Goal(minimum=0.8, maximum=1.25), True),
        (1.3, Goal(minimum=0.8, maximum=1.25), False),
        (3.0, Goal(minimum=2.0, of="ratio"), False),  # 1.5 times the peer's
        (4.0, Goal(minimum=2.0, of="ratio"), True),
        (math.nan, Goal(maximum=5.0), False),
        (9.0, None, None),
    ],
)
def test_a_goal_bounds_a_value_or_a_ratio(
    value: float, goal: Goal | None, met: bool | None
) -> None:
    figure = Figure(name="speed", value=value, unit="m/s", peer="p", peer_value=2.0, goal=goal)
    assert figure.met is met


def handed_over(folder: Path, findings: Findings, **rows: Any) -> tuple[int, dict[str, Any]]:
    file = folder / "figures.json"
    options = argparse.Namespace(quick=True, json=file)
    code = hand_over(options, MACHINE, findings, rows)
    return code, json.loads(file.read_text())


def test_figures_are_handed_over_with_what_was_missed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = Figure(name="time", value=1.0, unit="s", peer="slow", peer_value=4.0,
                  goal=Goal(maximum=0.5, of="ratio"))  # fmt: skip
    bad = Figure(name="memory", value=math.inf, unit="MiB", goal=Goal(maximum=1536.0))

    code, report = handed_over(tmp_path, Findings(figures=(good, bad)), rows=[{"a": math.nan}])

    assert code == 1
    assert report["figures"] == [
        {"name": "time", "value": 1.0, "unit": "s", "peer": "slow", "peer_value": 4.0,
         "goal": "ratio <= 0.5", "ratio": 0.25, "met": True},
        {"name": "memory", "value": None, "unit": "MiB", "peer": None, "peer_value": None,
         "goal": "<= 1536", "ratio": None, "met": False},
    ]  # fmt: skip
    assert report["missed"] == ["memory: inf MiB, goal <= 1536"]
    assert report["rows"] == [{"a": None}]
    assert report["machine"] == MACHINE
    assert report["missed"][0] in capsys.readouterr().out
    assert handed_over(tmp_path, Findings(figures=(good,), left_out=("x",)))[0] == 0
    assert handed_over(tmp_path, Findings(failed=("it broke",)))[0] == 1


def a_run(folder: Path, *figures: Figure, code: int = 0, **others: Any) -> table.Run:
    _, report = handed_over(folder, Findings(figures=figures, **others))
    log = folder / "run.log"
    log.write_text("first\nlast words\n")
    cost = Cost(wall_s=12.4, cpu_s=10.0, peak_mib=100.0, code=code, log=log)
    return table.Run(cost=cost, load_before="1.00 1.00 1.00 (1, 5, 15 min)", report=report)


def three_runs(folder: Path) -> list[table.Run]:
    """Times of 3, 1, 8 s against 4, 4, 2 s; a speed that falls short once."""
    times, peers, speeds = (3.0, 1.0, 8.0), (4.0, 4.0, 2.0), (20.0, 30.0, 5.0)
    return [
        a_run(
            folder,
            Figure(name="time", value=time, unit="s", peer="slow | old", peer_value=peer),
            Figure(name="time", value=time, unit="s", goal=Goal(maximum=9.0)),
            Figure(name="speed", value=speed, unit="m/s", goal=Goal(minimum=10.0)),
            code=int(speed < 10),
        )
        for time, peer, speed in zip(times, peers, speeds, strict=True)
    ]


def test_repeats_become_median_and_spread(tmp_path: Path) -> None:
    found = table.outcome("part", "python -m part", three_runs(tmp_path))

    compared, alone, speed = found.figures
    assert compared == {
        "name": "time", "unit": "s", "repeats": 3, "median": 3.0, "minimum": 1.0, "maximum": 8.0,
        "peer": "slow | old", "peer_median": 4.0,
        "ratio": 0.75,  # the median of 0.75, 0.25 and 4
        "goal": None, "judged": 0, "met": 0,
    }  # fmt: skip
    assert (alone["peer"], alone["ratio"], alone["goal"]) == (None, None, "<= 9")
    assert (alone["met"], alone["judged"]) == (3, 3)
    assert (speed["met"], speed["judged"]) == (2, 3)
    assert found.state == table.MISSED
    assert not found.good
    assert found.missed == ("speed: 5 m/s, goal >= 10",)


def test_states_of_parts(tmp_path: Path) -> None:
    good = a_run(tmp_path, Figure(name="time", value=1.0, unit="s"))
    died = replace(good, cost=replace(good.cost, code=-9), report=None)
    odd = replace(good, cost=replace(good.cost, code=3))
    broke = a_run(tmp_path, failed=("import ended with exit code 1",), code=1)
    lacking = a_run(tmp_path, left_out=("no pictures in data",))

    def of(*runs: table.Run) -> tuple[str, str | None]:
        found = table.outcome("part", "python", runs)
        return found.state, found.reason

    assert of(good, good) == (table.DONE, None)
    assert of(good, died) == (table.FAILED, "ended with exit code -9: last words")
    assert of(odd) == (table.FAILED, "ended with exit code 3 after its figures: last words")
    assert of(broke) == (table.FAILED, "import ended with exit code 1")
    assert of(lacking) == (table.LEFT_OUT, "no pictures in data")


def test_the_table_has_all_parts(tmp_path: Path) -> None:
    good = a_run(tmp_path)
    died = replace(good, cost=replace(good.cost, code=1), report=None)
    outcomes = [
        table.outcome("first", "python -m benchmarks.first", three_runs(tmp_path)),
        table.outcome("second", "python -m benchmarks.second", [died]),
        table.Outcome(name="third", command="python -m benchmarks.third", state=table.LEFT_OUT,
                      reason="no pictures in data"),
    ]  # fmt: skip
    about = {"date": "2026-01-02T03:04:05+00:00", "command": "python -m benchmarks --work W",
             "quick": False, "commit": "abc", "machine": MACHINE}  # fmt: skip

    table.write(tmp_path, about, outcomes)

    text = (tmp_path / "table.md").read_text()
    for number in ("12, 12, 12", "| 1 to 8 |", "| 0.75 |", "3 of 3", "2 of 3", "no pictures"):
        assert number in text, number
    data = json.loads((tmp_path / "table.json").read_text())
    assert [part["state"] for part in data["parts"]] == ["goal missed", "failed", "left out"]
    assert data["parts"][0]["figures"][0] == outcomes[0].figures[0]
    assert data["machine"]["cores"] == 2


def test_bend_of_a_track_is_the_sag_of_its_heights_and_not_their_tilt() -> None:
    north, east = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 8, 17), [0.0, 1.0, 2.0]))
    true = np.column_stack([north, east, np.full(north.shape, 13.0)])
    tilted = true + np.column_stack([0 * north, 0 * north, 0.3 + 0.01 * north - 0.02 * east])
    lower = 0.005 * (1 - ((north - 4) / 4) ** 2)  # the middle, by 5 mm

    assert bend_mm(true, tilted) == pytest.approx(0.0, abs=1e-9)
    assert bend_mm(true, tilted + lower[:, None] * [0, 0, 1]) == pytest.approx(5.0)


def test_one_part_runs_and_one_is_left_out(tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = benchmarks("--work", out, "--quick", "--only", "refraction", "reconstruct-brighton",
                     "--data", tmp_path)  # fmt: skip

    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == str(out / "table.md")
    refraction, brighton = json.loads((out / "table.json").read_text())["parts"]
    assert brighton["state"] == "left out"
    assert brighton["reason"].startswith("--quick")
    assert refraction["state"] == "done"
    assert refraction["command"] == "python -m benchmarks.refraction --quick"
    cameras = [row for row in refraction["figures"] if row["name"].endswith("rms of cameras")]
    assert len(cameras) == 8  # of two ports at two tilts, against two others
    assert all(0 < row["median"] < 10 and row["unit"] == "mm" for row in cameras)
    assert all(row["ratio"] < 1 for row in cameras if row["peer"] == "OPENCV")
    assert "OPENCV" in (out / "logs" / "refraction-1.log").read_text()
    assert (out / "table.md").is_file()


def test_sags_are_those_of_a_bent_and_tilted_block_whichever_way_it_lies() -> None:
    u, v = np.meshgrid(np.linspace(-15.0, 15.0, 31), np.linspace(-5.0, 5.0, 9))
    heights = 0.012 * (u / 15.0) ** 2 - 0.003 * (v / 5.0) ** 2 + 0.002 * u - 0.01 * v + 0.4
    turn = Rotation.from_rotvec([0.0, 0.0, 0.6])
    places = turn.apply(np.column_stack([u.ravel(), v.ravel(), np.full(u.size, 7.0)]))
    np.testing.assert_allclose(
        sag_weights(places[:, :2]) @ heights.ravel(), (0.012, -0.003), atol=1e-12
    )


def benchmarks(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks", *(str(a) for a in arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
