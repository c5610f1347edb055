"""Every number of the settings at the least and the most that is allowed, and what is no number."""

import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.core.config import SurveyConfig, load_config, parse_config
from alice_survey.core.errors import AliceError, ConfigError
from alice_survey.sim.vehicle import vehicle as vehicles
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.plan.rows import imaging_rows, settings_table
from missions.plan.strength import survey_costs
from tests.refusals import refused

SECTIONS = ("camera", "water", "plan", "vehicle", "sea", "imaging")
_TINY = 1e-300
_LARGEST = 1e300
_MAX_NUMBER = re.compile(r"\d{19}|\b(?:nan|inf)\b")


def numbers() -> list[tuple[str, str, type]]:
    """Section, key and type of every setting that is one number."""
    found = []
    for section in SECTIONS:
        model: Any = SurveyConfig.model_fields[section].annotation
        for key, field in model.model_fields.items():
            kinds = {float, int} & {field.annotation, *getattr(field.annotation, "__args__", ())}
            if kinds:
                found.append((section, key, kinds.pop()))
    return found


def limits(section: str, key: str, kind: type) -> list[float]:
    """The numbers next to what is not allowed."""
    model: Any = SurveyConfig.model_fields[section].annotation
    found = {"low": -_LARGEST, "high": _LARGEST}
    for bound in model.model_fields[key].metadata:
        match type(bound).__name__:
            case "Gt":
                found["low"] = max(math.nextafter(bound.gt, math.inf), _TINY)
            case "Ge":
                found["low"] = bound.ge
            case "Lt":
                found["high"] = math.nextafter(bound.lt, -math.inf)
            case "Le":
                found["high"] = bound.le
    ends = [*found.values(), *([_TINY] if found["low"] == 0 and kind is float else [])]
    return [kind(end) for end in ends if kind is float or abs(end) < _LARGEST]


def table_of(config: SurveyConfig) -> str:
    """What the settings come to, in words."""
    setup = ImagingSetup(
        plan=config.plan, camera=config.camera, water=config.water, imaging=config.imaging
    )
    imaging = imaging_settings(setup.rig, setup)
    costs = survey_costs(config, imaging_w=imaging.imaging_w)
    assert np.all(np.asarray(costs.line_w) >= 0)
    return settings_table(imaging_rows(imaging, setup))


@pytest.mark.parametrize(
    ("section", "key", "kind"), numbers(), ids=lambda part: getattr(part, "__name__", part)
)
def test_a_number_at_its_limit_is_used_or_refused_in_a_line_and_true_is_none(
    section: str, key: str, kind: type
) -> None:
    for value in limits(section, key, kind):
        try:
            said = table_of(parse_config({section: {key: value}}, "settings"))
        except AliceError as error:
            said = str(error)
            assert len(said.splitlines()) == 1
        odd = _MAX_NUMBER.search(said)
        assert not odd, f"{value}: {said[max(0, odd.start() - 100) : odd.end() + 100]}"
    with pytest.raises(ConfigError, match=f"{section}.{key}"):
        parse_config({section: {key: True}}, "settings")


def test_true_is_no_number_in_a_list_and_is_itself_where_it_is_wanted() -> None:
    with pytest.raises(ConfigError, match="home_ne_m"):
        parse_config({"plan": {"home_ne_m": [True, 0.0]}}, "settings")
    assert parse_config({"plan": {"closing_line": False}}, "settings").plan.closing_line is False


@pytest.mark.parametrize("kind", ["fifo", "device", "folder"])
def test_what_is_no_file_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    """A pipe that nobody writes to, and one without end."""
    path = tmp_path / "settings"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path = Path("/dev/zero")
    else:
        path.mkdir()
    with refused(ConfigError, path, "no ordinary file"):
        load_config(path)


def test_an_area_from_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "area.kml")
    (tmp_path / "survey.toml").write_text('[area]\nfile = "area.kml"\n')
    with pytest.raises(ConfigError, match=r"area\.file: .*area\.kml is neither"):
        load_config(tmp_path / "survey.toml")


def test_a_vehicle_without_thrust_is_refused() -> None:
    dead = ["starboard", "port", "vertical", "bow", "stern"]
    with pytest.raises(AliceError, match=r"alice has no thruster left: check vehicle\.failures"):
        survey_costs(parse_config({"vehicle": {"failures": dead}}, "settings"))


@pytest.mark.parametrize(("dry_kg", "way"), [(60.0, "up"), (44.0, "down")])
def test_a_vehicle_out_of_trim_is_refused_by_its_weight(
    dry_kg: float, way: str, tmp_path: Path
) -> None:
    known = Path(vehicles.__file__).parent / "fleet_files/alice.toml"
    own = tmp_path / "own.toml"
    own.write_text(known.read_text().replace("dry_kg = 52.0", f"dry_kg = {dry_kg}"))
    weight_n = (dry_kg - 52.1) * 9.8
    with pytest.raises(
        AliceError, match=rf"dry_kg {dry_kg:g} .* {weight_n:.0f}\.\d N .*push {way}"
    ):
        survey_costs(parse_config({"vehicle": {"name": str(own)}}, "settings"))
