"""The smallest surveys that go through the whole loop, made once for all tests."""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from alice_survey.core.config import SurveyConfig, change_section

SMALL = """
seed = 3
[area]
length_m = 1.3
width_m = 1.5
seafloor_depth_m = 12.0
[plan]
side_overlap = 0.35
[seafloor]
relief_m = 0.2
grid_m = 0.02
[imaging]
scale = 6
pool_views = 12
[reconstruct]
max_features = 1200
"""
"""Its results are compared with the truth."""
TINY = SMALL.replace("cale = 6", "cale = 16").replace("0.35", "0.35\ncross_lines = 0")
TINY = TINY.replace("1.3", "1.0").replace("1.5", "1.1")
"""Half as many pictures of a seventh of the pixels: its results are compared with each other."""


def settings_in(folder: Path, text: str = TINY) -> Path:
    """A new workspace with nothing but the settings."""
    folder.mkdir(parents=True)
    (folder / "survey.toml").write_text(text)
    return folder


def start(workspace: Path, threads: int) -> subprocess.Popen[bytes]:
    """Begin to run all stages, with events next to the workspace."""
    command = [sys.executable, "-m", "alice_survey", "run", "-w", str(workspace)]
    return subprocess.Popen(
        [*command, "--threads", str(threads), "--log-file", str(workspace.with_suffix(".jsonl"))],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def with_settings(config: SurveyConfig, values: Mapping[str, Any]) -> SurveyConfig:
    """A survey with settings such as `plan.speed_mps` changed."""
    for name, value in values.items():
        section, key = name.split(".")
        config = change_section(config, section, **{key: value})
    return config
