"""Build a wheel that brings its kernels along, for this version of Python: `make wheel`.

    python -m tests.build_wheel --out FOLDER

A copy of the packages computes small surveys in a folder of its own; what it compiles on the way
goes into the wheel. Kernels need what numba's own wheel needs, whose platform it therefore names.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import distribution
from pathlib import Path

from alice_survey.core.compiled import PROCESSOR
from tests.small_survey import SMALL

ROOT = Path(__file__).parents[1]
SOURCES = ("alice_survey", "camera_calib", "missions", "reconstruct",
           "LICENSE", "README.md", "pyproject.toml")  # fmt: skip
FISHEYE = '[camera]\nlens = "fisheye"\nport = "dome"\n'
IN_AIR = '[camera]\nport = "none"\n'
PREVIEW = (
    "from alice_survey.core.config import SurveyConfig; from missions.plan.preview import preview; "
    "preview(SurveyConfig())"
)
"""What the studio computes before a page asks."""
FILL = (
    ("small", SMALL, ("run", "evaluate", "report", "status")),
    ("fisheye", SMALL + FISHEYE, ("run",)),
    ("air", SMALL + IN_AIR, ("plan", "fly", "image")),
)
"""Surveys that call the kernels: names, settings, commands."""


def build(out: Path, work: Path) -> Path:
    """The wheel, written into a folder; `work` is an empty one for all else."""
    source = work / "source"
    tracked = subprocess.check_output(["git", "ls-files", *SOURCES], cwd=ROOT, text=True)
    for name in tracked.split("\n")[:-1]:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(source)

    def python(*arguments: str, cwd: Path = work) -> None:
        subprocess.run([sys.executable, *arguments], env=environment, cwd=cwd, check=True)

    python("-c", PREVIEW)
    for name, settings, commands in FILL:
        (work / name).mkdir()
        (work / name / "survey.toml").write_text(settings)
        for command in commands:
            python("-m", "alice_survey", command, "-w", name)
    for file in source.rglob("__pycache__/*.nb[ic]"):
        folder = file.parent.with_name("_kernels")
        folder.mkdir(exist_ok=True)
        file.rename(folder / file.name)
    about = distribution("numba").read_text("WHEEL") or ""
    python_tag, _, platform = about.split("Tag: ")[1].strip().split("-")
    tags = f"[bdist_wheel]\npython_tag = {python_tag}\nplat_name = {platform}\n"
    (source / "setup.cfg").write_text(tags)
    python("-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps",
           "--no-build-isolation", "-w", str(out.resolve()), str(source))  # fmt: skip
    return next(out.glob(f"alice_survey-*-{python_tag}-none-{platform}.whl"))


def main() -> None:
    """Build it, and print where it is."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    options = parser.parse_args()
    if os.environ["NUMBA_CPU_NAME"] != PROCESSOR:
        raise SystemExit(f"error: build it on a processor that has all of {PROCESSOR}")
    with tempfile.TemporaryDirectory() as work:
        wheel = build(options.out, Path(work))
    sys.stdout.write(f"{wheel}: {wheel.stat().st_size / 1e6:.1f} MB\n")


if __name__ == "__main__":
    main()
