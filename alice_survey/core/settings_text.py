"""The text of a settings file with some settings changed; all else of it stays byte by byte.

A setting that is there keeps its place and its comment. A new one stands below the commented
example of its name, where the file has one (`# side_overlap = 0.28`), else behind the last of its
section. One that is taken out becomes a comment.
"""

import re
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.container import Container
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Comment, Item, Key, SingleKey, Table, Trivia

from alice_survey.core.config import settings_in
from alice_survey.core.contents import one_line
from alice_survey.core.errors import ConfigError

Values = Mapping[str, Mapping[str, Any]]
"""Settings by section and key; None takes a key out."""
_Body = list[tuple[Key | None, Item]]


def with_values(settings: Mapping[str, Any], values: Values) -> dict[str, Any]:
    """Settings with some of them changed.

    Raises:
        ConfigError: a section is not a table.
    """
    result = dict(settings)
    for section, changed in values.items():
        before = result.get(section, {})
        if not isinstance(before, dict):
            raise ConfigError(f"{section} is not a section: write [{section}] above its settings")
        after = {key: value for key, value in before.items() if changed.get(key, 0) is not None}
        after |= {key: value for key, value in changed.items() if value is not None}
        if after or section in result:
            result[section] = after
    return result


def with_settings_changed(text: str, values: Values, origin: str = "settings") -> str:
    """A settings file's text with settings changed.

    Args:
        text: of the file.
        values: of plain types (numbers, texts, lists and tables of them).
        origin: what messages call it.

    Raises:
        ConfigError: it is not TOML, or a section is not a table.
    """
    before = settings_in(text, origin)
    requested = with_values(before, values)
    line_end = "\r\n" if "\r\n" in text else "\n"
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise ConfigError(f"{origin}: not valid TOML: {one_line(error)}") from None
    added = ""
    for section, changed in values.items():
        if section in document:
            there = before[section]
            new = {k: v for k, v in changed.items() if not same_value(there.get(k), v)}
            _change(document, section, new, line_end)
        elif new := {key: value for key, value in changed.items() if value is not None}:
            lines = tomlkit.dumps({section: new}).splitlines()
            added += line_end.join(["", *lines, ""])
    result: str = document.as_string()
    if added:
        gap = "" if result.endswith("\n") else line_end
        result = f"{result}{gap}{added}" if result else added.removeprefix(line_end)
    if settings_in(result, origin) != requested:
        raise ConfigError(f"{origin}: write each of its sections once, as [section]")
    return result


def same_value(one: Any, other: Any) -> bool:
    """Whether two values of settings are equal; a number is none of true and false."""
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same_value, one, other))
    return isinstance(one, bool) == isinstance(other, bool) and bool(one == other)


def _change(
    document: tomlkit.TOMLDocument, section: str, changed: Mapping[str, Any], line_end: str
) -> None:
    """Change settings of a section that is there; each differs from what it is."""
    table: Any = document[section]
    plain = isinstance(table, Table) and not table.is_super_table()
    body: _Body = list(table.value.body) if plain else []
    for key, value in changed.items():
        if not plain:
            if value is not None:
                table[key] = value
            else:
                del table[key]
        elif key in table:
            at = next(i for i, (name, _) in enumerate(body) if name is not None and name == key)
            body[at : at + 1] = _replacement(body[at], value, line_end)
        else:
            _insert(body, key, value, line_end)
    if plain:
        document[section] = _with_body(table, body)


def _with_body(table: Table, body: _Body) -> Table:
    """A table of the same header with other contents, as they stand."""
    result = Table(
        Container(True),
        table.trivia,
        table.is_aot_element(),
        table.is_super_table(),
        table.name,
        table.display_name,
    )
    for key, item in body:
        result.raw_append(key, item)
    return result


def _replacement(entry: tuple[Key | None, Item], value: Any, line_end: str) -> _Body:
    """A setting with another value; with None what it was, as a comment."""
    key, old = entry
    assert key is not None  # noqa: S101  -- of a setting, not of a comment
    trivia = old.trivia
    if value is not None:
        item = tomlkit.item(value)
        for name in ("indent", "comment_ws", "comment", "trail"):
            setattr(item.trivia, name, getattr(trivia, name))
        return [(key, item)]
    written = f"{key.as_string()}{key.sep}{old.as_string()}{trivia.comment_ws}{trivia.comment}"
    comments = [Comment(Trivia("", "", f"# {line}", line_end)) for line in written.splitlines()]
    return [(None, comment) for comment in comments]


def _insert(body: _Body, key: str, value: Any, line_end: str) -> None:
    """Put a new setting below its commented example, or behind the last setting."""
    example = re.compile(rf"\s*#\s*{re.escape(key)}\s*=")
    examples = [i for i, (name, item) in enumerate(body)
                if name is None and example.match(item.as_string())]  # fmt: skip
    settings = [i for i, (name, _) in enumerate(body) if name is not None]
    at = max(examples or settings, default=-1)
    if at >= 0 and not body[at][1].trivia.trail.endswith("\n"):
        body[at][1].trivia.trail = line_end
    item = tomlkit.item(value)
    item.trivia.trail = line_end
    body.insert(at + 1, (SingleKey(key), item))
