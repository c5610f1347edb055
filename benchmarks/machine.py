"""What a benchmark ran on."""

import os
import platform
import shutil
import subprocess
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from alice_survey.core.run.resources import processor


def machine(packages: Sequence[str]) -> dict[str, Any]:
    """Processor, cores that may be used, system, load, versions of Python and of packages."""
    return {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        "load": load(),
        "versions": {"python": platform.python_version(), **{n: version(n) for n in packages}},
    }


def load() -> str:
    """How busy the machine is."""
    return " ".join(f"{load:.2f}" for load in os.getloadavg()) + " (1, 5, 15 min)"


def heading(about: dict[str, Any]) -> str:
    """The machine in three lines."""
    versions = ", ".join(f"{name} {number}" for name, number in about["versions"].items())
    return f"{about['processor']}, {about['cores']} cores\n{versions}\nload before: {about['load']}"


def commit() -> str | None:
    """The sources' commit; None where they are in no repository."""
    git = shutil.which("git")
    if git is None:
        return None
    asked = subprocess.run(
        [git, "describe", "--always", "--dirty", "--abbrev=12"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
    )
    return asked.stdout.strip() or None
