"""The wheel is whole: installed in an empty environment it works outside of the checkout."""

import ast
import json
import os
import pickle
import signal
import subprocess
import sys
import venv
import zipfile
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from alice_survey.core.compiled import TABLE
from tests.alice_survey.app.studio.test_run import loaded
from tests.build_wheel import build
from tests.first_minutes import COMMANDS, INNER
from tests.small_survey import TINY, settings_in
from tests.test_loop import results

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wheel")]
ROOT = Path(__file__).parents[1]
PACKAGES = ("alice_survey", "camera_calib", "missions", "reconstruct")
_ROS = "missions/live/ros.py"
EXTRAS: dict[str, str | tuple[str, ...]] = {
    "starlette": "alice_survey/app/studio/",
    "uvicorn": "alice_survey/app/studio/",
    "distributed": "alice_survey/core/cluster/",
    "zict": "alice_survey/core/cluster/",
    "pymavlink": ("missions/live/mavlink_pilot.py", "missions/logs/"),
    **dict.fromkeys(
        ("builtin_interfaces", "geometry_msgs", "nav_msgs", "rclpy", "rosgraph_msgs",
         "sensor_msgs", "std_msgs"), _ROS,
    ),
}  # fmt: skip
"""Packages of extras, and the only places that may import them."""
ALLOWED = {
    # Views of larger arrays, or arrays that may not be written to, next to whole ones.
    "correlated_fit.whiten.entry": 3,
    "exact_observations._put.entry": 2,
    "solve.bilinear.entry": 2,
    "visibility.look_up": 2,
    # Literals, places left out, and two widths of numbers.
    "range_shift.slopes_of": 2,
    "surface_points.sorted_ranks": 2,
}
"""Most versions of kernels that may have more than one, by the reason."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("work"), {"tiny": TINY})


@pytest.fixture(scope="module")
def program(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of an environment that holds the wheel and its base dependencies alone."""
    folder = tmp_path_factory.mktemp("empty") / "env"
    venv.create(folder, with_pip=False, symlinks=True)
    subprocess.run(
        [sys.executable, "-m", "pip", f"--python={folder / 'bin' / 'python'}", "install",
         "--quiet", "--disable-pip-version-check", "--no-compile", str(wheel)],
        check=True, cwd=folder, env=_environment(),
    )  # fmt: skip
    return folder / "bin" / "alice-survey"


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def run(program: Path, folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [str(program), *arguments],
        cwd=folder, env=_environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def test_it_holds_what_the_packages_read(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    tracked = subprocess.run(
        ["git", "ls-files", *PACKAGES],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.split()  # fmt: skip
    only_to_build = (".json", ".mjs", ".d.ts", "entry_map.js", "entry_mesh.js", ".gitignore")
    needed = {name for name in tracked if not name.endswith(only_to_build)}
    assert needed <= held


def test_the_kernels_of_a_survey_have_one_version_each(wheel: Path) -> None:
    """Each combination of types of arguments is compiled for itself: literals and flags count."""
    versions: defaultdict[str, set[object]] = defaultdict(set)
    with zipfile.ZipFile(wheel) as archive:
        for index in (name for name in archive.namelist() if name.endswith(".nbi")):
            with archive.open(index) as file:
                _, (_, kept) = pickle.load(file), pickle.load(file)  # noqa: S301  our own
            versions[Path(index).name.rpartition("-")[0]].update(kept)
    counts = {name: len(kinds) for name, kinds in versions.items()}
    assert not {name: n for name, n in counts.items() if n > ALLOWED.get(name, 1)}
    table = json.loads(TABLE.read_text())  # else: python -m tests.test_kernels
    named = [name.split(".") for part in table.values() for name in part]
    own = {".".join(x[-3 if x[-1] == "entry" else -2 :]) for x in named}
    assert own == set(versions)


def test_it_compiles_nothing_where_nobody_may_write_to_it(
    wheel: Path, tiny_survey: Path, tmp_path: Path
) -> None:
    """As another user, who may read what root may; results are those of the clone to the byte."""
    installed, home, reef = (tmp_path / name for name in ("installed", "home", "home/reef"))
    with zipfile.ZipFile(wheel) as archive:  # what pip does for a wheel without programs in C
        archive.extractall(installed)
    subprocess.run(["chmod", "-R", "a-w", installed], check=True)
    settings_in(reef)
    user: list[str] = []
    if os.geteuid() == 0:
        subprocess.run(["chown", "-R", "65534:65534", home], check=True)
        may_read = [f"--{kind}-caps=+dac_read_search" for kind in ("inh", "ambient")]
        user = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", *may_read]
    places = {"PYTHONPATH": installed, "HOME": home, "TMPDIR": home, "XDG_CACHE_HOME": home}
    # As the program sets it before numpy is loaded, which is loaded here to hear of kernels.
    environment = {
        **os.environ, "NUMBA_CACHE_DIR": "", "OPENBLAS_NUM_THREADS": "1",
        **{name: str(place) for name, place in places.items()},
    }  # fmt: skip

    def compiled_by(*arguments: str) -> int:
        command = [*user, sys.executable, "-c", INNER, *arguments, "-w", "reef"]
        with subprocess.Popen(
            command, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        ) as running:  # fmt: skip
            if arguments[0] == "studio":
                assert running.stdout is not None
                url, token = running.stdout.readline().split()[4].split("?token=")
                assert json.loads(loaded(f"{url}api/plan", token))["saved"]
                running.send_signal(signal.SIGINT)
            said = running.communicate()[1]
        assert running.returncode in (0, 130), said
        stages = json.loads((home / "kernels.json").read_text()).values()
        return sum(len(versions) for stage in stages for versions in stage.values())

    found = {name: compiled_by(name) for name in COMMANDS}
    compiled_by("studio", "--no-browser")  # which may end at once: what it has kept is counted
    assert found == dict.fromkeys(found, 0)
    assert not [*home.rglob("*.nbi"), *installed.rglob("__pycache__/*.nbi")]
    assert results(reef) == results(tiny_survey)


def test_every_import_is_a_base_dependency_or_of_an_extra(program: Path, tmp_path: Path) -> None:
    """Imports inside functions count, too: they fail when a user gets there."""
    importers: dict[str, set[str]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.module:
                    names.append(node.module)
                for name in names:
                    place = path.relative_to(ROOT).as_posix()
                    importers.setdefault(name.partition(".")[0], set()).add(place)
    code = (
        "import importlib.util as u, sys; "
        "print(*(n for n in sys.argv[1:] if u.find_spec(n) is None))"
    )
    missing = run(program.with_name("python"), tmp_path, "-c", code, *importers).split()
    stray = {
        name: [path for path in importers[name] if not path.startswith(EXTRAS.get(name, "/"))]
        for name in missing
    }
    assert not any(stray.values()), stray


def test_commands_work_outside_of_the_checkout(program: Path, tmp_path: Path) -> None:
    python = program.with_name("python")
    where = run(python, tmp_path, "-c", "import missions; print(missions.__file__)")
    assert Path(where.strip()).is_relative_to(program.parents[1])
    assert "import-images" in run(program, tmp_path, "--help")
    assert "--json" in run(program, tmp_path, "report", "--help")
    assert "70" in run(program, tmp_path, "fov", "--validate")
    run(program, tmp_path, "init", "reef", "--example", "demo")
    run(program, tmp_path, "plan", "-w", "reef")
    for name in ("plan.json", "map.png", "settings.txt"):
        assert (tmp_path / "reef" / "plan" / name).stat().st_size > 1000
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(3):
        pixels = np.random.default_rng(number).integers(0, 256, (120, 160, 3), np.uint8)
        Image.fromarray(pixels).save(photos / f"{number}.png")
    run(program, tmp_path, "import-images", "photos", "-w", "dive")
    assert "image" in run(program, tmp_path, "status", "-w", "dive")


def test_the_python_example_works(program: Path, tmp_path: Path) -> None:
    """That of the package's docstring, and a new survey."""
    python = program.with_name("python")
    code = "import alice_survey, doctest, sys; sys.exit(doctest.testmod(alice_survey).failed)"
    run(python, tmp_path, "-c", code)
    run(python, tmp_path, "-c", "import alice_survey as alice; alice.Survey.new('reef')")
    assert (tmp_path / "reef" / "survey.toml").is_file()
