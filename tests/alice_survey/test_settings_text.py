"""Settings changed in the text of their file: what is not changed stays byte by byte."""

import difflib
import re
import tomllib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.app.pipeline import template_text
from alice_survey.core.errors import ConfigError
from alice_survey.core.settings_text import with_settings_changed, with_values
from tests.refusals import refused

TEMPLATE = template_text()
SECTIONS = list(tomllib.loads(TEMPLATE).keys() - {"name", "seed"})
_TEXTS = {name: TEMPLATE.split(f"[{name}]")[1].split("\n[")[0] for name in SECTIONS}
KEYS = {
    name: sorted(set(re.findall(r"^(?:# )?(\w+) = ", text, re.M))) for name, text in _TEXTS.items()
}
"""All keys that the template names, in use or as an example."""


def _lines(before: str, after: str) -> tuple[list[str], list[str]]:
    """Lines that are gone, and new ones."""
    found = list(difflib.ndiff(before.splitlines(), after.splitlines()))
    gone, new = ([line[2:] for line in found if line.startswith(mark)] for mark in ("- ", "+ "))
    return gone, new


def values() -> st.SearchStrategy[Any]:
    numbers = st.one_of(st.integers(-(10**6), 10**6), st.floats(-1e6, 1e6), st.booleans())
    places = st.lists(st.lists(st.floats(-50, 50), min_size=2, max_size=2), max_size=4)
    return st.one_of(numbers, places, st.text(max_size=12), st.none())


@st.composite
def edits(draw: Any) -> dict[str, dict[str, Any]]:
    """Changes of keys that the template has, and of some that it has not."""
    changes: dict[str, dict[str, Any]] = {}
    for section in draw(st.lists(st.sampled_from([*SECTIONS, "extra"]), max_size=4)):
        keys = [*KEYS.get(section, []), "new_key", "with space"]
        chosen = draw(st.lists(st.sampled_from(keys), max_size=4))
        changes[section] = {key: draw(values()) for key in chosen}
    return changes


def test_a_value_keeps_its_line_and_its_comment() -> None:
    after = with_settings_changed(TEMPLATE, {"plan": {"altitude_m": 2.5}})
    assert _lines(TEMPLATE, after) == (
        ["altitude_m = 2.0              # of the left port's outer glass"],
        ["altitude_m = 2.5              # of the left port's outer glass"],
    )


def test_a_new_setting_stands_below_its_commented_example() -> None:
    after = with_settings_changed(TEMPLATE, {"plan": {"line_heading_deg": 45.0}}).splitlines()
    at = after.index("line_heading_deg = 45.0")
    assert after[at - 1].startswith("# line_heading_deg = 0.0")
    assert _lines(TEMPLATE, "\n".join(after))[0] == []


def test_what_is_taken_out_becomes_a_comment() -> None:
    without = with_settings_changed(TEMPLATE, {"plan": {"line_spacing_m": None}})
    gone, new = _lines(TEMPLATE, without)
    assert new == [f"# {line}" for line in gone] and len(gone) == 1
    back = with_settings_changed(without, {"plan": {"line_spacing_m": 1.0}})
    assert tomllib.loads(back) == tomllib.loads(TEMPLATE)


def test_equal_values_change_nothing() -> None:
    same: dict[str, dict[str, Any]] = {
        "plan": {"altitude_m": 2, "closing_line": True}, "camera": {"dome_centre_m": [0, 0, 0]}
    }  # fmt: skip
    assert with_settings_changed(TEMPLATE, same) == TEMPLATE


def test_windows_line_ends_and_a_missing_last_one_are_kept() -> None:
    text = "[plan]\r\naltitude_m = 2.0  # low\r\n\r\n[sea]\r\nswell_m = 1.0"
    after = with_settings_changed(text, {"plan": {"speed_mps": 0.3}, "sea": {"gust_n": [1.0]}})
    assert after == (
        "[plan]\r\naltitude_m = 2.0  # low\r\nspeed_mps = 0.3\r\n\r\n"
        "[sea]\r\nswell_m = 1.0\r\ngust_n = [1.0]\r\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        "", "plan = {altitude_m = 2.0}\n", "plan.altitude_m = 2.0\n[sea]\nswell_m = 1\n",
        "[plan]\naltitude_m = 1\n[sea]\n[plan.sub]\nx = 1\n", "[sea]\nswell_m = 1",
        "[plan]\n# of old\nno_go = [ # ring\n  [1, 2],\n]\n",
    ],
)  # fmt: skip
def test_any_form_of_a_section_is_changed(text: str) -> None:
    changes = {"plan": {"altitude_m": 2.5, "no_go": None, "speed_mps": 0.1}}
    after = with_settings_changed(text, changes)
    assert tomllib.loads(after) == with_values(tomllib.loads(text), changes)
    for comment in re.findall(r"#.*", text):
        assert comment in after


@pytest.mark.parametrize("text", ["[plan", "plan = 3\n", "[[plan]]\na = 1\n"])
def test_what_has_no_such_section_is_one_line(text: str) -> None:
    with refused(ConfigError):
        with_settings_changed(text, {"plan": {"altitude_m": 2.5}}, "reef/survey.toml")


@settings(max_examples=60, deadline=None)
@given(changes=edits(), more=edits())
def test_edits_hold_and_lose_no_comment(changes: Any, more: Any) -> None:
    once = with_settings_changed(TEMPLATE, changes)
    twice = with_settings_changed(once, more)

    assert once == with_settings_changed(TEMPLATE, changes)
    expected = with_values(tomllib.loads(TEMPLATE), changes)
    assert tomllib.loads(twice) == with_values(expected, more)
    for line in TEMPLATE.splitlines():
        # An example may come into use: what is said of it stays.
        assert "#" not in line or line.rsplit("#", 1)[1] in twice
