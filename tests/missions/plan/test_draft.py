"""Drafts of a survey: any edit gives settings or one line, the same bytes each time."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.app.pipeline import template_text
from alice_survey.core.config import SurveyConfig, load_config, parse_settings
from alice_survey.core.errors import AliceError, ConfigError, collected_by
from missions.areas.drawn import FILES, DrawnPolygon, DrawnShapes, area_drawing
from missions.plan.preview import draft_settings, preview

TEMPLATE = template_text()
PATH = Path("reef") / "survey.toml"
SQUARE = DrawnPolygon(outer=((0, 0), (10, 0), (10, 8), (0, 8)))
HOLED = DrawnPolygon(outer=SQUARE.outer, holes=(((4, 4), (6, 4), (6, 6)),))


def shapes() -> st.SearchStrategy[DrawnShapes | None]:
    place = st.tuples(st.floats(-12, 12), st.floats(-12, 12))
    ring = st.lists(place, min_size=3, max_size=6).map(tuple)
    polygon = st.builds(DrawnPolygon, outer=ring, holes=st.lists(ring, max_size=1).map(tuple))
    some = st.lists(polygon, max_size=2).map(tuple)
    lines = st.lists(st.lists(place, min_size=1, max_size=3).map(tuple), max_size=1).map(tuple)
    drawn = st.builds(DrawnShapes, survey=some, no_go=some, allowed=some, corridors=lines)
    usual = st.builds(DrawnShapes, survey=st.sampled_from([(SQUARE,), (HOLED,)]), no_go=some)
    return st.none() | usual | drawn


@st.composite
def changes(draw: Any) -> dict[str, dict[str, Any]]:
    """What sliders send, and what they should not."""
    wild = st.floats(-1, 12) | st.integers(-1, 400) | st.none() | st.sampled_from(["best", True])
    likely: dict[str, dict[str, st.SearchStrategy[Any]]] = {
        "plan": {
            "altitude_m": st.floats(1.5, 3), "speed_mps": st.floats(0.1, 0.4),
            "line_spacing_m": st.floats(0.8, 2), "side_overlap": st.floats(0, 0.5),
            "line_heading_deg": st.floats(0, 359), "cross_lines": st.integers(0, 3),
            "turns": st.sampled_from(["auto", "spot"]), "home_ne_m": st.just([1, 2]),
            "margin_m": st.integers(0, 2),
        },
        "sea": {"current_mps": st.floats(0, 0.2), "swell_m": st.floats(0, 1)},
        "camera": {"focal_mm": st.sampled_from([8, 12.5, 25]), "f_number": st.floats(2, 8)},
        "vehicle": {"name": st.sampled_from(["alice", "sparus2"]), "battery_wh": st.floats(20, 99)},
        "area": {"turn_margin_m": st.floats(1, 6), "seafloor_depth_m": st.floats(5, 50),
                 "latitude_deg": st.floats(-80, 80), "corridor_width_m": st.floats(1, 6)},
    }  # fmt: skip
    found: dict[str, dict[str, Any]] = {}
    for section in draw(st.lists(st.sampled_from(sorted(likely)), max_size=3)):
        keys = draw(st.lists(st.sampled_from(sorted(likely[section])), max_size=2))
        usual = draw(st.integers(0, 9)) > 0
        found[section] = {key: draw(likely[section][key] if usual else wild) for key in keys}
    return found


@settings(max_examples=60, deadline=None)
@given(edit=changes(), drawn=shapes())
def test_any_edit_gives_the_same_bytes_each_time_or_one_line(edit: Any, drawn: Any) -> None:
    with collected_by(lambda *_: None):
        try:
            draft = draft_settings(TEMPLATE, PATH, edit, drawn)
        except AliceError as error:
            assert len(str(error).splitlines()) == 1
            return
        assert draft_settings(TEMPLATE, PATH, edit, drawn) == draft
        assert parse_settings(draft.text, PATH) == draft.config
    for section, values in edit.items():
        for key, value in values.items():
            if value is None:
                default = getattr(getattr(SurveyConfig(), section), key)
                assert getattr(getattr(draft.config, section), key) == default
    for line in TEMPLATE.splitlines():
        # An example may come into use: what is said of it stays.
        assert "#" not in line or line.rsplit("#", 1)[1] in draft.text


@pytest.mark.slow  # a drawing of crossing corridors takes ten times as long as the usual one
@settings(max_examples=24, deadline=None)
@given(edit=changes(), drawn=shapes())
def test_any_edit_is_planned_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, edit: Any, drawn: Any
) -> None:
    with collected_by(lambda *_: None):
        try:
            draft = draft_settings(TEMPLATE, PATH, edit, drawn)
        except AliceError:
            return
        found = preview(draft.config_with(tmp_path_factory.mktemp("scratch")))
    if found["ok"]:
        assert 0.0 <= found["totals"]["at_overlap"] <= 1.0
        assert found["totals"]["stations"] == sum(line["stations"] for line in found["lines"])
    else:
        assert len(found["error"].splitlines()) == 1


def test_numbers_are_written_as_the_settings_have_them() -> None:
    text = draft_settings(TEMPLATE, PATH, {"plan": {"altitude_m": 3, "cross_lines": 2.0}}).text
    assert "\naltitude_m = 3.0 " in text and "\ncross_lines = 2 " in text
    assert (
        draft_settings(text, PATH, {"plan": {"altitude_m": 2, "cross_lines": 1}}).text == TEMPLATE
    )


def test_a_draft_is_written_whole_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    draft = draft_settings(TEMPLATE, path, {}, DrawnShapes(survey=(HOLED,)))
    draft.write()
    assert sorted(file.name for file in tmp_path.iterdir()) == [FILES["survey"], "survey.toml"]
    assert path.read_bytes() == draft.text.encode()
    again = load_config(path)
    assert again == draft.config
    assert area_drawing(again.area).shapes.survey == (HOLED,)
    assert draft_settings(draft.text, path, {}, area_drawing(again.area).shapes).text == draft.text


def test_shapes_move_with_the_datum_that_is_changed_with_them(tmp_path: Path) -> None:
    moved = {"area": {"latitude_deg": -10.0, "longitude_deg": 20.0}}
    draft = draft_settings(TEMPLATE, tmp_path / "survey.toml", moved, DrawnShapes(survey=(HOLED,)))
    drawing = area_drawing(draft.config_with(tmp_path).area)
    assert (drawing.datum.latitude_deg, drawing.datum.longitude_deg) == (-10.0, 20.0)
    assert drawing.shapes.survey == (HOLED,)


@pytest.mark.parametrize(
    ("section", "key", "name"),
    [
        ("area", "file", "/etc/reef.geojson"), ("area", "bathymetry_file", "../site.tif"),
        ("vehicle", "name", "/opt/own.toml"), ("sea", "current_file", "a\0b.csv"),
    ],
)  # fmt: skip
def test_files_elsewhere_are_refused_unless_they_are_named_already(
    section: str, key: str, name: str
) -> None:
    with pytest.raises(ConfigError, match="put the file into"):
        draft_settings(TEMPLATE, PATH, {section: {key: name}})
    if "\0" not in name:
        text = f'[{section}]\n{key} = "{name}"\n'
        assert draft_settings(text, PATH, {section: {key: name}}).text == text


def test_what_is_no_section_or_no_text_is_refused() -> None:
    with pytest.raises(ConfigError, match="section"):
        draft_settings("area = 3\n", PATH, {"area": {"file": "reef.kml"}})
    with pytest.raises(ConfigError):
        draft_settings(TEMPLATE, PATH, {"area": {"layer": "\ud800"}})
