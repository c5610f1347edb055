"""Which kernels the commands of a survey compile, and how often.

`python -m tests.test_kernels` writes the table of their times, on a machine that does nothing else.
"""

import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import pytest

from alice_survey.core.compiled import TABLE
from tests.first_minutes import COMMANDS, INNER
from tests.small_survey import settings_in, start

pytestmark = pytest.mark.slow

ZONE = [[[0.4, 0.4], [0.8, 0.4], [0.8, 0.8], [0.4, 0.8]]]
ALLOWED = {
    # Views of larger arrays, or arrays that may not be written to, next to whole ones.
    "correlated_fit.whiten.entry": 3,
    "exact_observations._put.entry": 2,
    "solve.bilinear.entry": 2,
    "visibility.look_up": 2,
    # Literals, places left out, and two widths of numbers.
    "points._way": 2,
    "range_shift.slopes_of": 2,
    "surface_points.sorted_ranks": 2,
}
"""Most versions of kernels that may have more than one, by the reason."""


def test_the_kernels_of_a_survey_have_one_version_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each combination of types of arguments is compiled for itself: literals and flags count."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    assert start(settings_in(tmp_path / "survey"), threads=1).wait() == 0

    versions: defaultdict[str, set[object]] = defaultdict(set)
    for index in (tmp_path / "kernels").rglob("*.nbi"):
        with index.open("rb") as file:
            _, (_, kept) = pickle.load(file), pickle.load(file)  # noqa: S301  our own
        versions[index.name.rpartition("-")[0]].update(kept)
    counts = {name: len(kinds) for name, kinds in versions.items()}
    assert not {name: n for name, n in counts.items() if n > ALLOWED.get(name, 1)}
    table = json.loads(TABLE.read_text())  # else: python -m tests.test_kernels
    named = [name.split(".") for part in table.values() for name in part]
    own = {".".join(x[-3 if x[-1] == "entry" else -2 :]) for x in named}
    assert own == set(versions)


def test_a_first_plan_compiles_a_kernel_of_the_table_once(tmp_path: Path) -> None:
    """Those of its cameras alone, and around a zone that of its edges."""
    survey = settings_in(tmp_path / "survey")
    settings = survey / "survey.toml"
    settings.write_text(settings.read_text().replace("[plan]", f"no_go_ne_m = {ZONE}\n[plan]"))
    found = compiled_by("plan", survey, tmp_path / "kernels")
    table = json.loads(TABLE.read_text())["plan"]
    once = dict.fromkeys([*table, "missions.route.ways._crossings.entry"], 1)
    assert {name: len(times) for name, times in found["plan"].items()} == once
    assert not any(part in name for name in table for part in (".lenses.", ".dome.", ".none."))


def compiled_by(command: str, workspace: Path, kept: Path) -> dict[str, dict[str, list[float]]]:
    """Seconds of each version of the kernels that a command compiles, by stage and name."""
    threads = [] if command in ("plan", "fly") else ["--threads=1"]
    call = [sys.executable, "-c", INNER, command, "-w", str(workspace), *threads]
    places = {"NUMBA_CACHE_DIR": str(kept), "PYTHONPATH": str(Path(__file__).parents[1])}
    subprocess.run(
        call, cwd=workspace, env=os.environ | places, check=True, stdout=subprocess.DEVNULL
    )
    return json.loads((workspace / "kernels.json").read_text())


def main() -> None:
    """Write the table, by commands of the smallest survey that each have no kernel kept."""
    table = dict[str, dict[str, float]]()
    with tempfile.TemporaryDirectory() as scratch:
        survey = settings_in(Path(scratch) / "survey")
        for command in COMMANDS[:5]:
            for stage, part in compiled_by(command, survey, Path(scratch) / command).items():
                table[stage] = {k: max(0.01, round(sum(part[k]), 2)) for k in sorted(part)}
    TABLE.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
