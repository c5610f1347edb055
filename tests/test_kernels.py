"""How often the kernels of the tutorial's commands are compiled."""

import json
import pickle
from collections import defaultdict
from pathlib import Path

import pytest

from alice_survey.core.compiled import TABLE
from tests.kernels import compiled_by
from tests.small_survey import settings_in, start

pytestmark = pytest.mark.slow

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
    table = json.loads(TABLE.read_text())  # else: python -m tests.kernels
    named = [name.split(".") for part in table.values() for name in part]
    own = {".".join(x[-3 if x[-1] == "entry" else -2 :]) for x in named}
    assert own == set(versions)


def test_a_command_compiles_the_kernels_of_its_table(tmp_path: Path) -> None:
    found = compiled_by("plan", settings_in(tmp_path / "survey"), tmp_path / "kernels")
    table = json.loads(TABLE.read_text())
    assert {stage: set(part) for stage, part in found.items()} == {"plan": set(table["plan"])}
