"""Build a wheel that brings its kernels along, for this version of Python: `make wheel`.

    python -m tests.build_wheel FOLDER

A copy of the packages computes small surveys in a folder of its own; what it compiles on the way
goes into the wheel. Kernels need what numba's own wheel needs, whose platform it therefore names.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib.metadata import distribution
from pathlib import Path

from alice_survey.core.compiled import PROCESSOR
from tests.small_survey import SMALL, settings_in
from tests.structure import PACKAGES, ROOT

SOURCES = (*PACKAGES, "LICENSE", "README.md", "pyproject.toml")
SURVEYS = {
    "flat": SMALL,
    "fisheye": f'{SMALL}[camera]\nlens = "fisheye"\nport = "dome"\n',
    "air": f'{SMALL}[camera]\nport = "none"\n',
}
"""Settings of those that are computed."""


def build(out: Path, work: Path, surveys: Mapping[str, str] = SURVEYS) -> Path:
    """The wheel, written into a folder; `work` is an empty one for all else."""
    source = work / "source"
    tracked = subprocess.check_output(["git", "ls-files", *SOURCES], cwd=ROOT, text=True)
    for name in tracked.splitlines():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)

    def python(*arguments: str) -> None:
        places = {"PYTHONPATH": str(source), "NUMBA_CACHE_DIR": ""}
        command = [sys.executable, "-m", *arguments]
        subprocess.run(command, env=os.environ | places, cwd=work, check=True)

    for name, text in surveys.items():
        settings_in(work / name, text)
        python("alice_survey", "run", "-w", name, "--threads", "1")
    for file in list(source.rglob("__pycache__/*.nb[ic]")):
        folder = file.parent.with_name("_kernels")
        folder.mkdir(exist_ok=True)
        file.rename(folder / file.name)
    about = distribution("numba").read_text("WHEEL") or ""
    tag, _, platform = about.split("Tag: ")[1].strip().split("-")
    (source / "setup.cfg").write_text(f"[bdist_wheel]\npython_tag={tag}\nplat_name={platform}\n")
    pip = ("pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps")
    python(*pip, "--no-build-isolation", "-w", str(out.resolve()), str(source))
    return next(out.glob(f"alice_survey-*-{tag}-none-{platform}.whl"))


def main() -> None:
    """Build it, and print where it is."""
    out = Path(*sys.argv[1:])
    if os.environ["NUMBA_CPU_NAME"] != PROCESSOR:
        raise SystemExit(f"error: build it on a processor that has all of {PROCESSOR}")
    with tempfile.TemporaryDirectory() as work:
        wheel = build(out, Path(work))
    sys.stdout.write(f"{wheel}: {wheel.stat().st_size / 1e6:.1f} MB\n")


if __name__ == "__main__":
    main()
