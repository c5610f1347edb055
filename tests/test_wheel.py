"""The wheel is whole: installed in an empty environment it works outside of the checkout."""

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", str(ROOT), "--no-deps", "--no-build-isolation",
         "--quiet", "--disable-pip-version-check", "-w", str(folder)],
        check=True, capture_output=True, cwd=folder,
    )  # fmt: skip
    return next(folder.glob("alice_survey-*.whl"))


@pytest.fixture(scope="module")
def program(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of an environment that holds the wheel, and sees the dependencies alone."""
    folder = tmp_path_factory.mktemp("empty") / "env"
    venv.create(folder, with_pip=False, symlinks=True)
    packages = next(folder.glob("lib/python*/site-packages"))
    # Lines of .pth files are paths: an editable install in the other environment stays unseen.
    known = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "dependencies.pth").write_text("\n".join(known) + "\n")
    subprocess.run(
        [sys.executable, "-m", "pip", f"--python={folder / 'bin' / 'python'}", "install",
         "--no-deps", "--no-index", "--quiet", "--disable-pip-version-check",
         "--force-reinstall", str(wheel)],
        check=True, capture_output=True, cwd=folder,
    )  # fmt: skip
    return folder / "bin" / "alice-survey"


def run(program: Path, folder: Path, *arguments: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(program), *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def test_it_holds_what_the_packages_read(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    tracked = subprocess.run(
        ["git", "ls-files", "alice_survey", "camera_calib", "missions", "reconstruct"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.split()  # fmt: skip
    only_to_build = (".json", ".mjs", "entry_map.js", "entry_mesh.js", ".gitignore")
    needed = {name for name in tracked if not name.endswith(only_to_build)}
    assert needed <= held


def test_commands_work_outside_of_the_checkout(program: Path, tmp_path: Path) -> None:
    where = subprocess.run(
        [str(program.with_name("python")), "-c", "import missions; print(missions.__file__)"],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert Path(where).is_relative_to(program.parents[1])
    assert "import-images" in run(program, tmp_path, "--help")
    assert "70" in run(program, tmp_path, "fov", "--validate")
    run(program, tmp_path, "init", "reef", "--example", "demo")
    run(program, tmp_path, "plan", "-w", "reef")
    for name in ("plan.json", "plan.html", "map.png", "settings.txt"):
        assert (tmp_path / "reef" / "plan" / name).stat().st_size > 1000
