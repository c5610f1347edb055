import math
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.config import (
    REMOVED,
    SurveyConfig,
    change_section,
    constants_of,
    load_config,
    parse_config,
    parse_current,
    parse_failures,
)
from alice_survey.core.errors import ConfigError
from alice_survey.core.seawater import n_water, n_water_sigma
from alice_survey.core.settings_form import sections, settings_template
from tests.refusals import refused


def fault(settings: dict[str, Any]) -> str:
    with refused(ConfigError, "survey.toml: ") as error:
        parse_config(settings, "survey.toml")
    return str(error.value)


def test_an_empty_file_is_the_papers_mission(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text("")
    config = load_config(tmp_path / "survey.toml")

    assert config == SurveyConfig()
    assert (config.area.length_m, config.area.width_m) == (15.0, 17.0)
    assert (config.plan.altitude_m, config.plan.speed_mps) == (2.0, 0.2)
    assert (config.camera.width_px, config.camera.height_px) == (3384, 2710)
    assert (config.camera.focal_mm, config.camera.baseline_m) == (12.5, 0.1)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("plan", "altitude_m", 99), ("plan", "altitude_m", 0.1), ("plan", "speed_mps", 0),
        ("plan", "speed_mps", math.nan), ("plan", "speed_mps", math.inf),
        ("plan", "speed_mps", "fast"), ("plan", "line_spacing_m", -1), ("area", "latitude_deg", 91),
        ("area", "longitude_deg", 181), ("area", "heading_deg", 360), ("water", "jerlov", "4C"),
        ("camera", "width_px", 3384.5), ("", "seed", -1), ("", "name", ""), ("", "name", "a/b"),
        ("", "plan", 3),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_named(section: str, key: str, value: object) -> None:
    text = fault({section: {key: value}} if section else {key: value})
    assert f"{section}.{key} = {value!r}".lstrip(".") in text


@pytest.mark.parametrize(
    ("settings", "near"),
    [
        ({"plan": {"altitude": 2}}, "altitude_m"), ({"plan": {"sped_mps": 2}}, "speed_mps"),
        ({"plans": {}}, "plan"), ({"water": {"zzz": 2}}, "n_water"),
    ],
)  # fmt: skip
def test_an_unknown_key_is_refused_and_a_near_one_offered(
    settings: dict[str, Any], near: str
) -> None:
    assert near in fault(settings).split("not a known setting")[1]


@given(value=st.floats(allow_nan=True, allow_infinity=True))
def test_no_value_slips_through_its_bounds(value: float) -> None:
    if 0 <= value <= 0.95:
        assert parse_config({"plan": {"side_overlap": value}}, "x").plan.side_overlap == value
    else:
        assert "plan.side_overlap" in fault({"plan": {"side_overlap": value}})


def test_the_index_of_water_follows_from_temperature_salinity_and_depth() -> None:
    sea = {"temperature_c": 24.0, "salinity_psu": 35.0}
    corners = [[32.0, 34.0], [32.1, 34.0], [32.0, 34.1]]
    for depth_m in (15.0, 4000.0):
        area = {"seafloor_depth_m": depth_m, "polygon_latlon_deg": corners}
        config = parse_config({"water": sea, "area": area, "plan": {"line_spacing_m": 1.0}}, "x")
        assert config.water.n_water == float(n_water(24.0, 35.0, depth_m, 530.0))
        assert config.water.index_sigma == n_water_sigma(24.0, 35.0, 530.0)
        assert SurveyConfig.model_validate(config.model_dump(mode="json")) == config
    assert parse_config({}, "x").water.n_water == 1.34
    assert parse_config({}, "x").water.index_sigma == n_water_sigma()
    assert parse_config({"water": {"n_water_sigma": 1e-3}}, "x").water.index_sigma == 1e-3


@pytest.mark.parametrize(
    ("water", "named"),
    [
        ({"temperature_c": 24, "salinity_psu": 35, "n_water": 1.34}, "n_water = 1.34118"),
        ({"temperature_c": 24}, "salinity_psu"), ({"salinity_psu": 35}, "temperature_c"),
        ({"temperature_c": 50, "salinity_psu": 35}, "temperature_c = 50"),
        ({"temperature_c": 24, "salinity_psu": 350}, "salinity_psu = 350"),
    ],
)  # fmt: skip
def test_water_is_given_once_and_whole(water: dict[str, float], named: str) -> None:
    assert named in fault({"water": water})


@pytest.mark.parametrize(
    "content",
    [
        b"[plan\naltitude_m = 2", b"plan = {", b"[plan]\naltitude_m = nan", b"\xff\xfe\x00",
        b"a = " + b"9" * 5000, b"a = " + b"[" * 100_000, b'"a\\nb" = 1', b"#" * 1_000_001,
        "\n".join(f"k{i} = 1" for i in range(200)).encode(),
    ],
    ids=lambda content: content[:12],
)  # fmt: skip
def test_a_broken_file_is_reported_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "survey.toml"
    path.write_bytes(content)
    with refused(ConfigError, path) as error:
        load_config(path)
    assert len(str(error.value)) < 2000


def test_files_named_in_settings_are_relative_to_them(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(
        '[sea]\ncurrent_file = "adcp.csv"\n[vehicle]\ncoefficients = "/far/found.json"\n'
    )
    config = load_config(path)
    assert config.sea.current_file == tmp_path / "adcp.csv"
    assert config.vehicle.coefficients_file == Path("/far/found.json")
    for name, file in (("rov.toml", tmp_path / "rov.toml"), ("/f/rov.JSON", Path("/f/rov.JSON"))):
        path.write_text(f'[vehicle]\nname = "{name}"\n')
        assert load_config(path).vehicle.file == file
    assert SurveyConfig().vehicle.file is None


def test_thrusters_have_their_health_by_name() -> None:
    config = parse_config({"vehicle": {"failures": ["stern", "bow=0.5", "port@60"]}}, "test")
    assert config.vehicle.impaired == {"stern": 0.0, "bow": 0.5}
    for wrong in ("bow=1.5", "bow=-0.1", "bow=half", "bow@soon", "bow@-1", True):
        assert "vehicle.failures" in fault({"vehicle": {"failures": [wrong]}})
    assert parse_failures(["stern", "bow=0.5"]) == ({"stern": 0.0, "bow": 0.5}, [], [])
    assert parse_failures(["stern@600", "bow=0.5@30"])[1] == [("stern", 600, 0), ("bow", 30, 0.5)]
    propellers = parse_failures(["bow:propeller=0.2", "stern:propeller@600"])
    assert propellers == ({}, [], [("bow", 0.0, 0.2), ("stern", 600.0, 0.0)])
    assert parse_failures([]) == ({}, [], [])


def test_surveys_are_keys() -> None:
    """Results are kept by the survey that they are of."""
    weak = {"vehicle": {"failures": ["bow=0.5"]}}
    same, again, other = (parse_config(given, "test") for given in (weak, weak, {}))
    assert len({same: 1, again: 2, other: 3}) == 2


def test_a_current_is_read_from_its_text() -> None:
    assert parse_current("0.1@90") == (0.1, 90.0)
    assert parse_current("1@-10") == (1.0, 350.0)
    assert parse_current(None) == (None, None)
    for text in ("abc", "0.1", "0.1@", "@90", "0.1@north", ""):
        with pytest.raises(ConfigError):
            parse_current(text)


def test_a_changed_setting_is_checked_like_one_in_the_file() -> None:
    config = parse_config({}, "test")
    changed = change_section(config, "sea", current_mps=0.3, current_towards_deg=None)
    assert changed.sea.current_mps == 0.3
    assert change_section(config, "sea", current_mps=None) is config
    with pytest.raises(ConfigError, match=r"sea\.current_mps = 9"):
        change_section(config, "sea", current_mps=9)


def test_a_key_that_is_gone_says_what_to_do() -> None:
    for name, (_, cure) in REMOVED.items():
        section, key = name.split(".")
        assert f"{name} is gone: {cure}" in fault({section: {key: "other"}})


def test_a_key_that_is_gone_may_hold_what_now_always_holds() -> None:
    """As files that an earlier version wrote."""
    for section in sections():
        for key, value in constants_of(section).items():
            assert parse_config({section: {key: value}}, "old") == SurveyConfig()


def test_a_new_file_holds_every_setting_with_its_default() -> None:
    text = settings_template()
    new = parse_config(tomllib.loads(text), "template")
    assert new == change_section(SurveyConfig(), "plan", line_spacing_m=1.0)
    lines = text.splitlines()
    for section, kind in sections().items():
        part = lines[next(i for i, x in enumerate(lines) if x.startswith(f"[{section}]")) :]
        for key in kind.model_fields:
            assert any(
                re.match(rf"(# )?{key} = .* # \S", line.replace("#   ", "# ")) for line in part
            ), key
    examples = "\n".join(
        line.removeprefix("# ") for line in lines if re.match(r"# \w+ = |\[", line)
    )
    for section, values in tomllib.loads(examples).items():
        for key, value in values.items():
            one = {"temperature_c": {"salinity_psu": 39.0}, "salinity_psu": {"temperature_c": 22.0}}
            parse_config({section: {key: value, **one.get(key, {})}}, "example")
    assert max(map(len, lines)) <= 120
