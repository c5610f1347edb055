"""Every reader of files from outside, given what is no ordinary file, or has no end."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz.cameras import read_picture, read_video, take_orientation_off
from tests.fuzz.target import Trial
from tests.fuzz.targets import TARGETS


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 20_000_000_000)


SPECIAL: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "20 GB of nothing": _sparse,
}


LEFT_OUT = (read_picture, read_video)
_OPENED = [name for name, target in TARGETS.items() if target.read is not take_orientation_off]


@pytest.mark.parametrize("name", _OPENED)
def test_what_is_no_ordinary_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    """Pictures are left out by name, where others are imported."""
    trial = Trial(TARGETS[name], tmp_path)
    for kind, make in SPECIAL.items():
        verdict = trial.verdict_of(make)
        assert verdict.outcome in ("refused", *(["value"] * (trial.target.read in LEFT_OUT))), (
            f"{kind}: {verdict.message}\n{verdict.trace}"
        )
