"""Pictures that SIFT cannot tie: one rendered survey in ever more turbid water, mapped both ways.

    .venv/bin/python -m benchmarks.turbid --work FOLDER [--quick] [--json FILE]

A stereo survey of 22 stations at 2 m, at an eighth of the resolution, in Jerlov's coastal waters
with strobes of some brightness: contrast falls by attenuation and backscatter, noise rises. Each is
mapped and placed with SIFT alone and with learned features. Workspaces are kept in FOLDER: what is
rendered there is not rendered again. The error is that of the cameras, after a rigid motion of the
model onto the truth: it includes how navigation places parts that no picture ties together.
"""

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.app.api.survey import Survey
from alice_survey.app.stages import spec
from alice_survey.core.config import Jerlov
from alice_survey.core.errors import AliceError
from alice_survey.core.executor import local_executor
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from benchmarks.measured import measured
from benchmarks.reconstruct_surveys import demo_like, render
from reconstruct.evaluate.figures import rms
from reconstruct.evaluate.truth import read_true_poses
from reconstruct.placing.alignment import align_rigid
from reconstruct.placing.track import read_track_poses

_LENGTH_M, _WIDTH_M, _SCALE = 2.4, 1.6, 8


@dataclass(frozen=True, kw_only=True)
class Level:
    """Water, light, and what learned features must register there at least."""

    jerlov: Jerlov
    strobe_lumens: float
    registered: Goal | None = None

    @property
    def name(self) -> str:
        """For people, and of its workspace."""
        return f"{self.jerlov}-{self.strobe_lumens / 1000:g}klm"


LEVELS = (
    Level(jerlov="3C", strobe_lumens=30_000, registered=Goal(minimum=1.0)),
    Level(jerlov="5C", strobe_lumens=60_000, registered=Goal(minimum=0.9)),
    Level(jerlov="5C", strobe_lumens=30_000, registered=Goal(minimum=0.8)),
    Level(jerlov="7C", strobe_lumens=120_000),
)


def main() -> int:
    """Render what is missing, map, compare; the exit code is 1 when a goal is missed."""
    parser = Parser(__doc__, quick="the third level alone", work="keeps pictures and workspaces")
    parser.add_argument("--map", type=Path, help=argparse.SUPPRESS)
    options, about = parser.begin("numpy", "opencv-contrib-python-headless", "pycolmap")
    if options.map is not None:
        return _map(options.map)
    findings = Findings()
    for level in LEVELS[2:3] if options.quick else LEVELS:
        rendered = options.work / level.name / "rendered"
        render(rendered, survey_toml(level))
        for learned in (False, True):
            findings += _compared(level, rendered, learned=learned)
    return hand_over(options, about, findings)


def survey_toml(level: Level) -> str:
    """Settings of a level's survey."""
    text = demo_like(_LENGTH_M, _WIDTH_M, _SCALE)
    light = f"[imaging]\nstrobe_lumens = {level.strobe_lumens:g}"
    return text.replace("[imaging]", light, 1) + f'\n[water]\njerlov = "{level.jerlov}"\n'


def _compared(level: Level, rendered: Path, *, learned: bool) -> Findings:
    """Map in a copy of the workspace, and judge it."""
    word = "learned" if learned else "SIFT"
    workspace = rendered.with_name(word)
    shutil.rmtree(workspace, ignore_errors=True)
    shutil.copytree(rendered, workspace)
    settings = workspace / "survey.toml"
    own = f"[reconstruct]\nlearned_features = {str(learned).lower()}"
    settings.write_text(settings.read_text().replace("[reconstruct]", own, 1))
    line = [sys.executable, "-m", "benchmarks.turbid", "--work", ".", "--map", str(workspace)]
    cost = measured(line, workspace.with_suffix(".log"))
    name = f"{level.name}, {word}"
    if not cost.ok:
        if not learned or level.registered is None:
            return Findings(left_out=(f"{name}: {cost.last_line()}",))
        return Findings(failed=(f"{name}: {cost.last_line()}",))
    share, largest, misses_m = judged(workspace)
    rms_mm, max_mm = 1e3 * rms(misses_m), 1e3 * float(misses_m.max())
    print(f"{name}: judged", flush=True)
    return Findings(
        figures=(
            Figure(name=f"{name}: registered", value=share, unit="1",
                   goal=level.registered if learned else None),
            Figure(name=f"{name}: in the largest part", value=largest, unit="1"),
            Figure(name=f"{name}: cameras, rms", value=rms_mm, unit="mm"),
            Figure(name=f"{name}: cameras, largest", value=max_mm, unit="mm"),
            Figure(name=f"{name}: computing", value=cost.cpu_s, unit="s"),
        )
    )  # fmt: skip


def judged(workspace: Path) -> tuple[float, float, np.ndarray]:
    """Shares of pictures with a place and in the largest part; (N,) misses of cameras, metres."""
    poses = read_track_poses(workspace / "sparse" / "track.csv")
    true = read_true_poses(workspace / "images" / "truth" / "poses.csv")
    names = sorted(poses)
    found = np.array([poses[name].translation for name in names])
    target = np.array([true[name].translation for name in names])
    mapping = json.loads((workspace / "mapping" / "mapping.json").read_text())
    misses = np.linalg.norm(align_rigid(found, target).apply(found) - target, axis=1)
    return len(names) / len(true), mapping["models"][0] / len(true), misses


def _map(workspace: Path) -> int:
    """Map and place; an error is one line."""
    config = Survey(workspace).config
    try:
        for stage in ("mapping", "placing"):
            spec(stage).make(workspace, config, local_executor(2))
    except AliceError as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
