"""Every reader of files from outside, with files damaged by `mutations`."""

from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import PlanError, WorkspaceError
from tests.fuzz.judge import Sandbox, judge
from tests.fuzz.mutations import mutate
from tests.fuzz.target import Trial
from tests.fuzz.targets import TARGETS

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    trial = Trial(TARGETS[name], tmp_path)
    assert trial.verdict(trial.good).outcome == "value"
    outcomes: list[str] = []

    @settings(
        max_examples=trial.target.examples, derandomize=True, database=None,
        phases=[Phase.generate], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.randoms(use_true_random=False))
    def attempt(rng: Random) -> None:
        data = mutate(trial.good, trial.target.syntax, rng)
        verdict = trial.verdict(data)
        outcomes.append(verdict.outcome)
        assert verdict.outcome != "fault", f"{verdict.message}\n{verdict.trace}\n{data[:2000]!r}"

    attempt()
    assert len(outcomes) >= trial.target.examples


def _slow(_: Path) -> None:
    while True:
        pass


def _greedy(_: Path) -> None:
    assert b"x" * (300 << 20)


def _leaking(path: Path) -> None:
    (path.parent / "more").write_text("x")


def _raising(error: Exception) -> Callable[[Path], None]:
    def read(_: Path) -> None:
        raise error

    return read


@pytest.mark.parametrize(
    ("read", "outcome", "message"),
    [
        (_slow, "fault", "took over"), (_greedy, "fault", "MiB"),
        (_leaking, "fault", "wrote or changed in/more"),
        (_raising(KeyError("x")), "fault", "KeyError"),
        (_raising(PlanError("two\nlines")), "fault", "several lines"),
        (_raising(WorkspaceError("file: none")), "refused", "file: none"),
        (lambda path: path, "value", ""),
    ],
)  # fmt: skip
def test_the_judge_sees_each_kind_of_fault_and_refusals_for_what_they_are(
    read: Callable[[Path], object], outcome: str, message: str, tmp_path: Path
) -> None:
    sandbox = Sandbox(tmp_path)
    (sandbox.inside / "file").write_text("x")
    verdict = judge(read, sandbox.inside / "file", sandbox, max_bytes=200 << 20, max_s=2.0)
    assert verdict.outcome == outcome
    assert message in verdict.message
