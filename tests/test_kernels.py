"""Which kernels the commands of a survey compile, and how often.

`python -m tests.test_kernels` writes the table of their times, on a machine that does nothing else.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from alice_survey.core.compiled import TABLE
from tests.first_minutes import COMMANDS, INNER
from tests.small_survey import settings_in

pytestmark = pytest.mark.slow

ZONE = [[[0.4, 0.4], [0.8, 0.4], [0.8, 0.8], [0.4, 0.8]]]


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
