import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from alice_survey.base.config import (
    AreaConfig,
    PlanConfig,
    SurveyConfig,
    changed,
    load_config,
    parse_config,
    parse_current,
    parse_health,
)
from alice_survey.base.errors import ConfigError
from alice_survey.base.seawater import n_water


def fault(settings: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as error:
        parse_config(settings, "survey.toml")
    text = str(error.value)
    assert "\n" not in text
    assert text.startswith("survey.toml: ")
    return text


def test_an_empty_file_is_the_papers_mission(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text("")
    config = load_config(tmp_path / "survey.toml")

    assert config == SurveyConfig()
    assert (config.area.length_m, config.area.width_m) == (15.0, 17.0)
    assert (config.plan.altitude_m, config.plan.speed_mps) == (2.0, 0.2)
    assert (config.camera.width_px, config.camera.height_px) == (3384, 2710)
    assert (config.camera.focal_mm, config.camera.baseline_m) == (12.5, 0.1)


def test_settings_of_a_file_are_read(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text(
        'name = "wreck"\nseed = 7\n[plan]\naltitude_m = 3\nline_spacing_m = 1.0\n'
        "[area]\npolygon_ne_m = [[0, 0], [10, 0], [10, 30.5]]\n"
    )
    config = load_config(tmp_path / "survey.toml")

    assert (config.name, config.seed) == ("wreck", 7)
    assert config.plan.altitude_m == 3.0
    assert config.plan.line_spacing_m == 1.0
    assert config.area.polygon_ne_m == ((0.0, 0.0), (10.0, 0.0), (10.0, 30.5))


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ({"plan": {"altitude_m": 99}}, ["plan.altitude_m = 99", ">= 0.3 and <= 10"]),
        ({"plan": {"altitude_m": 0.1}}, ["plan.altitude_m = 0.1", ">= 0.3"]),
        ({"plan": {"speed_mps": 0}}, ["plan.speed_mps = 0", "> 0 and <= 3"]),
        ({"plan": {"speed_mps": math.nan}}, ["plan.speed_mps = nan", "> 0 and <= 3"]),
        ({"plan": {"speed_mps": math.inf}}, ["plan.speed_mps = inf"]),
        ({"plan": {"speed_mps": "fast"}}, ["plan.speed_mps = 'fast'", "number"]),
        ({"plan": {"line_spacing_m": -1}}, ["plan.line_spacing_m = -1", "> 0 and <= 20"]),
        ({"area": {"latitude_deg": 91}}, ["area.latitude_deg = 91", "85"]),
        ({"area": {"longitude_deg": 181}}, ["area.longitude_deg = 181", "180"]),
        ({"area": {"heading_deg": 360}}, ["area.heading_deg = 360", "< 360"]),
        ({"water": {"jerlov": "4C"}}, ["water.jerlov = '4C'", "'5C'"]),
        ({"camera": {"width_px": 3384.5}}, ["camera.width_px = 3384.5", "integer"]),
        ({"camera": {"position_body_m": [1, 2]}}, ["camera.position_body_m"]),
        ({"seed": -1}, ["seed = -1", ">= 0"]),
        ({"name": ""}, ["name = ''"]),
        ({"name": "a/b"}, ["name = 'a/b': use letters, digits, spaces, . _ -"]),
        ({"plan": 3}, ["plan = 3"]),
        ({"plan": [1, 2]}, ["plan"]),
    ],
)
def test_a_value_out_of_range_is_named_with_its_range(
    settings: dict[str, Any], parts: list[str]
) -> None:
    text = fault(settings)
    for part in parts:
        assert part in text


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"plan": {"altitude": 2}},
            "plan.altitude is not a known setting; did you mean altitude_m?",
        ),
        ({"plan": {"sped_mps": 2}}, "did you mean speed_mps?"),
        ({"plans": {}}, "plans is not a known setting; did you mean plan?"),
        (
            {"water": {"zzz": 2}},
            "water.zzz is not a known setting; known are n_water, jerlov, temperature_c, "
            "salinity_psu, wavelength_nm",
        ),
    ],
)
def test_an_unknown_key_is_refused_and_a_near_one_offered(
    settings: dict[str, Any], words: str
) -> None:
    assert words in fault(settings)


def test_all_faults_are_told_at_once() -> None:
    text = fault({"plan": {"altitude_m": 99, "speed": 1}, "seed": -1})
    for word in ("plan.altitude_m = 99", "plan.speed is not", "seed = -1"):
        assert word in text


def test_a_long_value_is_cut_short() -> None:
    text = fault({"plan": {"altitude_m": "x" * 500}})
    assert len(text) < 250


@given(value=st.floats(allow_nan=True, allow_infinity=True))
def test_no_value_slips_through_its_bounds(value: float) -> None:
    if 0 <= value <= 0.95:
        assert parse_config({"plan": {"side_overlap": value}}, "x").plan.side_overlap == value
    else:
        assert "plan.side_overlap" in fault({"plan": {"side_overlap": value}})


def test_sections_cannot_be_changed() -> None:
    config = SurveyConfig()
    with pytest.raises(ValidationError):
        config.seed = 3  # type: ignore[misc]
    with pytest.raises(ValidationError):
        config.plan.altitude_m = 3.0  # type: ignore[misc]


def test_settings_come_back_from_their_json() -> None:
    config = parse_config(
        {
            "area": {"polygon_latlon_deg": [[32.0, 34.0], [32.1, 34.0], [32.0, 34.1]]},
            "plan": {"line_spacing_m": 1.0},
        },
        "x",
    )
    assert SurveyConfig.model_validate(config.model_dump(mode="json")) == config


def test_the_index_of_water_follows_from_temperature_salinity_and_depth() -> None:
    sea = {"temperature_c": 24.0, "salinity_psu": 35.0}
    for depth_m, wavelength_nm in ((15.0, 530.0), (4000.0, 460.0)):
        config = parse_config(
            {
                "water": sea | ({} if wavelength_nm == 530.0 else {"wavelength_nm": 460.0}),
                "area": {"seafloor_depth_m": depth_m},
            },
            "x",
        )
        assert config.water.n_water == float(n_water(24.0, 35.0, depth_m, wavelength_nm))
        assert SurveyConfig.model_validate(config.model_dump(mode="json")) == config
    assert parse_config({}, "x").water.n_water == 1.34


@pytest.mark.parametrize(
    ("water", "words"),
    [
        (
            {"temperature_c": 24, "salinity_psu": 35, "n_water": 1.34},
            "water: temperature_c and salinity_psu give n_water = 1.34118, and n_water = 1.34 is "
            "set too: leave one out",
        ),
        ({"temperature_c": 24}, "water: give temperature_c and salinity_psu both, or n_water"),
        ({"salinity_psu": 35}, "water: give temperature_c and salinity_psu both, or n_water"),
        ({"wavelength_nm": 460}, "water: wavelength_nm needs temperature_c and salinity_psu"),
        ({"temperature_c": 50, "salinity_psu": 35}, "water.temperature_c = 50"),
        ({"temperature_c": 24, "salinity_psu": 350}, "water.salinity_psu = 350"),
    ],
)
def test_water_is_told_once_and_whole(water: dict[str, float], words: str) -> None:
    assert words in fault({"water": water})


def test_two_shapes_of_area_are_refused() -> None:
    corners = [[0, 0], [1, 0], [0, 1]]
    text = fault({"area": {"polygon_ne_m": corners, "polygon_latlon_deg": corners}})
    assert "area: give polygon_ne_m or polygon_latlon_deg, not both" in text


def test_a_corner_out_of_range_is_named() -> None:
    text = fault({"area": {"polygon_latlon_deg": [[0, 0], [95, 0], [0, 1]]}})
    assert "area.polygon_latlon_deg.1.0 = 95" in text


def test_a_missing_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: no such file; 'alice-survey init DIR'"):
        load_config(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[plan\naltitude_m = 2", "not valid TOML"),
        (b"plan = {", "not valid TOML"),
        (b"[plan]\naltitude_m = nan", "plan.altitude_m = nan"),
        (b"\xff\xfe\x00", "cannot be read"),
    ],
)
def test_a_broken_file_is_told_in_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "survey.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert words in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_is_no_survey(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path)


def test_defaults_pass_their_own_bounds() -> None:
    for section in SurveyConfig.model_fields:
        value = getattr(SurveyConfig(), section)
        if hasattr(value, "model_dump"):
            assert type(value).model_validate(value.model_dump()) == value
    assert AreaConfig() == SurveyConfig().area
    assert PlanConfig() == SurveyConfig().plan


def test_files_named_in_settings_lie_beside_them(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(
        '[sea]\ncurrent_file = "adcp.csv"\n[vehicle]\ncoefficients_file = "/far/found.json"\n'
    )
    config = load_config(path)
    assert config.sea.current_file == tmp_path / "adcp.csv"
    assert config.vehicle.coefficients_file == Path("/far/found.json")


def test_thrusters_have_their_health_by_name() -> None:
    config = parse_config({"vehicle": {"thruster_health": {"stern": 0.0, "bow": 0.5}}}, "test")
    assert config.vehicle.thruster_health.impaired == {"stern": 0.0, "bow": 0.5}
    with pytest.raises(ConfigError, match=r"thruster_health.warp is not a known setting"):
        parse_config({"vehicle": {"thruster_health": {"warp": 0.0}}}, "test")


@pytest.mark.parametrize(
    ("text", "expected"), [("0.1@90", (0.1, 90.0)), ("1@-10", (1.0, 350.0)), (None, (None, None))]
)
def test_a_current_is_read_from_its_text(
    text: str | None, expected: tuple[float | None, float | None]
) -> None:
    assert parse_current(text) == expected


@pytest.mark.parametrize("text", ["abc", "0.1", "0.1@", "@90", "0.1@north", ""])
def test_a_current_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="SPEED@DIRECTION"):
        parse_current(text)


def test_a_changed_setting_is_checked_like_one_in_the_file() -> None:
    config = parse_config({}, "test")
    assert changed(config, "sea", current_mps=0.3, current_towards_deg=None).sea.current_mps == 0.3
    assert changed(config, "sea", current_mps=None) is config
    with pytest.raises(ConfigError, match=r"command line: sea.current_mps = 9: .*allowed: >= 0"):
        changed(config, "sea", current_mps=9)


def test_weak_thrusters_are_read_from_their_texts() -> None:
    assert parse_health(["stern", "bow=0.5"]) == {"stern": 0.0, "bow": 0.5}
    assert parse_health(None) is None
    with pytest.raises(ConfigError, match="NAME=SHARE"):
        parse_health(["bow=half"])


def test_settings_without_end_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    for text, told in (
        (f"a = {'9' * 5000}", "not valid TOML"),
        ("a = " + "[" * 100_000, "not valid TOML"),
        ("\n".join(f"k{i} = 1" for i in range(200)), "and 192 more"),
        ('"a\\nb" = 1', "a b is not a known setting"),
        ("#" * 1_000_001, "no settings file is that long"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=told) as fault:
            load_config(path)
        assert "\n" not in str(fault.value)
        assert len(str(fault.value)) < 2000
