"""What `python -m tests.structure` counts is noticed where it is too much; `make check` counts."""

import shutil
import subprocess
import sys
from contextlib import nullcontext
from itertools import cycle
from pathlib import Path

import pytest

from tests import conftest, structure


def excess(name: str) -> int:
    """How much more of something is too much by one."""
    count = next(count for count in structure.counts() if count.name == name)
    return max(count.maximum - count.value, 0) + 1


@pytest.mark.slow
def test_every_bound_that_is_broken_fails_the_check(tmp_path: Path) -> None:
    """A copy in which each count is exceeded."""
    copy = tmp_path / "copy"
    for name in (*structure.PACKAGES, "tests", "benchmarks", "docs"):
        shutil.copytree(
            structure.ROOT / name, copy / name,
            ignore=shutil.ignore_patterns("__pycache__", "node_modules"),
        )  # fmt: skip
    for name in ("pyproject.toml", "README.md", "CONTRIBUTING.md"):
        shutil.copy(structure.ROOT / name, copy / name)
    room = copy / "alice_survey" / "core"

    modules = excess("modules") + excess("modules with a single importer")
    for number in range(modules):
        (room / f"extra_{number}.py").write_text("import matplotlib\nFlatPort = '<!doctype'\n")
    importer = [f"import alice_survey.core.extra_{number}\n" for number in range(modules)]
    (room / "importer.py").write_text("".join(importer))
    kernel = "@compiled\ndef moved():\n    return 1\n"
    many = max(excess("kernels"), excess("functions named by a participle"))
    (room / "kernels.py").write_text(kernel * many)
    names = [f"wanted_{n} = 1\n" for n in range(excess("identifiers with an avoided word"))]
    (room / "names.py").write_text("".join(names))
    takes = "def call(config: SurveyConfig):\n    return config\n"
    lines = "x = 1\n" * excess("code lines of the packages")
    whole = takes * excess("functions that take the whole SurveyConfig")
    (room / "large.py").write_text(lines + whole)
    for letter in "ab":
        other = "ba"["ab".index(letter)]
        (room / f"ring_{letter}.py").write_text(
            f"import alice_survey.core.ring_{other}\n"
            + "".join(f"class Twice{n}:\n    pass\n" for n in range(9))
        )
    (copy / "alice_survey" / "nowhere.py").write_text("x = 1\ny = 2\n")
    for folder in ("tests", "benchmarks"):
        lines = "x = 1\n" * excess(f"code lines of the {folder}")
        (copy / folder / "large.py").write_text(lines)
    script = "x = 1;\n" * excess("lines of our own JavaScript")
    (copy / "alice_survey" / "kit" / "large.js").write_text(script)
    options = ", ".join(f"a{n}: int = 0" for n in range(excess("options of commands")))
    commands = (
        f"\nfor number in range({excess('commands')}):\n"
        "    @app.command(name=f'extra{number}', help='What is wanted.')\n"
        f"    def extra({options}):\n"
        "        pass\n"
    )
    append(copy / "alice_survey/app/cli/main.py", commands)
    settings = "".join(f"    extra_{n}: int = 0\n" for n in range(excess("settings")))
    insert(copy / "alice_survey/core/config.py", "class SurveyConfig(Config):\n", settings)
    insert(copy / "pyproject.toml", "layers = [\n", '    "nowhere_at_all",\n' * 9)
    phrase = "There is a way out.\n"
    append(copy / "README.md", phrase * excess("lines of docs with an avoided phrase"))
    sentence = f"\nOne{' more' * 36} word.\n" * excess("sentences of docs over 35 words")
    append(copy / "README.md", sentence)

    run = subprocess.run(
        [sys.executable, "-m", "tests.structure"],
        cwd=copy, env={"PYTHONPATH": str(copy), "PATH": ""}, capture_output=True, text=True,
    )  # fmt: skip

    assert run.returncode == 1, run.stderr
    held = [line for line in run.stdout.splitlines() if not line.endswith("over")]
    assert not held
    assert len(run.stdout.splitlines()) == len(structure.BOUNDS)


def append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


def insert(path: Path, after: str, text: str) -> None:
    before = path.read_text(encoding="utf-8")
    assert after in before
    path.write_text(before.replace(after, after + text, 1), encoding="utf-8")


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


@pytest.mark.parametrize(
    ("spent_s", "compiles", "marks", "fails"),
    [(14.0, 0, (), 0), (16.0, 0, (), 1), (16.0, 1, (), 0), (16.0, 0, ("slow",), 0)],
)
def test_a_daily_test_that_takes_long_fails(
    spent_s: float, compiles: bool, marks: tuple[str, ...], fails: bool,
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    item = pytest.Function.from_parent(request.node.parent, name="f", callobj=excess)
    for mark in marks:
        item.add_marker(mark)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(conftest, "_cpu_s", cycle((1.0, 1.0 + spent_s)).__next__)
    if compiles:
        (tmp_path / "kernel.nbi").touch()
    call = conftest.pytest_runtest_call(item)
    next(call)
    with pytest.raises(pytest.fail.Exception, match=r"16\.0 CPU s") if fails else nullcontext():
        list(call)
