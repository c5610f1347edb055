"""Numbers that arithmetic stumbles over, and files that are none, wherever a survey is planned."""

import itertools
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.core.config import load_config
from alice_survey.core.errors import AliceError
from tests.fuzz import areas, logs
from tests.fuzz.judge import MAX_S, Sandbox, bounded, judge
from tests.fuzz.workspace import read_and_check_survey

pytestmark = pytest.mark.slow

ODD = ("inf", "nan", "-inf", "1e308", "-1", "0", "5e-324", "1e-300", "true")
OPTIONS = (
    ("plan", "solve", "--resolution"),
    ("plan", "solve", "--resolution", "0.5", "--lens"),
    *(
        ("fov", f"--{name}")
        for name in (
            "lens", "altitude", "temperature", "salinity", "port-distance", "glass", "n-glass",
            "f-number", "coc", "focus-air", "pixel", "match-sigma", "speed", "exposure", "blur",
        )
    ),
)  # fmt: skip
NUMBERS = (
    *(("plan", key) for key in ("speed_mps", "allowed_blur_px", "altitude_m", "relief_m")),
    *(("plan", key) for key in ("forward_overlap", "yaw_rate_deg_s", "sharp_px", "margin_m")),
    ("camera", "focal_mm"),
    ("imaging", "strobe_lumens"),
    ("sea", "current_mps"),
    ("vehicle", "battery_wh"),
)


@pytest.fixture(scope="module", autouse=True)
def loaded(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Load libraries and compile kernels: neither counts."""
    path = tmp_path_factory.mktemp("loaded") / "survey.toml"
    path.write_text("")
    read_and_check_survey(path)


@pytest.mark.parametrize("words", OPTIONS, ids=" ".join)
def test_odd_numbers_of_options_are_used_or_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    for number in ODD:
        where = ["-w", str(tmp_path)] if words[0] == "plan" else []
        with bounded(MAX_S):
            done = CliRunner().invoke(app, [*words, number, *where])
        error = done.exception
        assert error is None or isinstance(error, SystemExit | AliceError), (number, repr(error))
        assert not re.search(r"\d{25}", f"{done.output}{error}"), number


@pytest.mark.parametrize(("section", "key"), NUMBERS)
def test_odd_numbers_of_settings_are_used_or_refused(
    section: str, key: str, tmp_path: Path
) -> None:
    sandbox = Sandbox(tmp_path)
    path = sandbox.inside / "survey.toml"
    for number, rate in itertools.product((*ODD, "0.001", "0.01"), (1.0, 20.0)):
        lines = {"plan": f"roll_pitch_rate_deg_s = {rate}\n"}
        lines[section] = f"{lines.get(section, '')}{key} = {number}\n"
        path.write_text("".join(f"[{name}]\n{text}" for name, text in lines.items()))
        verdict = judge(read_and_check_survey, path, sandbox)
        assert verdict.outcome != "fault", (number, verdict.message, verdict.trace)
        if number in ("inf", "nan", "-inf", "1e308", "true", "-1"):
            assert verdict.outcome == "refused", number


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("survey.toml", load_config),
        *((f"a.{ending}", areas.read_area) for ending in ("kml", "kmz", "geojson", "wkt", "plan")),
        ("a.tif", areas.read_depths),
        ("a.tlog", logs.read_any_log),
    ],
)
def test_what_is_no_file_is_refused_at_once(
    kind: str, name: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    """A pipe that nobody writes to, and a device without end."""
    sandbox = Sandbox(tmp_path)
    path = sandbox.inside / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    verdict = judge(read, path, sandbox, max_s=5.0)
    assert verdict.outcome == "refused", verdict.message
