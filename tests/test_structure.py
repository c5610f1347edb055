"""What `python -m tests.structure` counts does not get worse."""

import pytest

from tests import structure

HELD = (
    "layers of the import contract",
    "modules without a layer",
    "circles of imports",
    "class names with two meanings",
    "modules that import matplotlib",
    "pages begun by hand (<!DOCTYPE)",
)


@pytest.mark.parametrize("name", HELD)
def test_a_count_stays_within_its_bound(name: str) -> None:
    count = next(count for count in structure.counts() if count.name == name)
    assert count.value <= count.maximum, count.places


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ('"""Doc."""\n\nx = 1  # why\n', 1),
        ("# only\n\n", 0),
        ('def f():\n    """Doc.\n\n    More.\n    """\n    return (\n        1\n    )\n', 4),
        ('class A:\n    x: int\n    """Of the field."""\n', 2),
        ('x = """a\nb"""\n', 2),
        ('f(\n    "text"\n)\n', 3),
    ],
)
def test_lines_of_code_are_neither_blank_nor_comments_nor_docstrings(text: str, lines: int) -> None:
    assert structure.code_lines(text) == lines


@pytest.mark.parametrize(
    ("graph", "rings"),
    [
        ({"a": {"b"}, "b": set()}, []),
        ({"a": {"b"}, "b": {"a"}}, [["a", "b"]]),
        ({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}, [["a", "b", "c"]]),
    ],
)
def test_circles_are_found(graph: dict[str, set[str]], rings: list[list[str]]) -> None:
    assert structure.circles(graph) == rings
