"""The commands that the pages of `docs/` give work as written."""

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer

from alice_survey.app.cli.main import app
from tests.docs.given import GIVEN, Made
from tests.docs.pages import DOCS, fences, mentioned, name_of, pages, script_of

LANGUAGES = {"bash", "text", "toml", "json", "python", "csv", "math"}
"""`bash` is run; `text` is what a program prints, or a form that stands for many commands."""


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("made"))


@pytest.mark.slow
@pytest.mark.xdist_group("docs")
@pytest.mark.parametrize("page", [page for page in pages() if script_of(page)], ids=name_of)
def test_the_commands_of_a_page_run(page: Path, made: Made) -> None:
    _, ran = made.run(name_of(page))
    assert ran.returncode == 0, f"{ran.stdout[-3000:]}\n{ran.stderr[-3000:]}"
    assert "Traceback" not in ran.stderr


def test_files_are_given_to_pages_that_exist() -> None:
    assert set(GIVEN) <= {name_of(page) for page in pages()}


@pytest.mark.parametrize("page", [*pages(), DOCS.parent / "README.md"], ids=lambda page: page.stem)
def test_commands_that_are_mentioned_exist(page: Path) -> None:
    for command in mentioned(page.read_text(encoding="utf-8")):
        check_command(command)


def check_command(text: str) -> None:
    """Follow a command's words into groups, and look for its options."""
    # Newer typers bring their own click, so that its classes cannot be tested for.
    found: Any = typer.main.get_command(app)
    options = {o for p in found.params for o in (*p.opts, *p.secondary_opts)} | {"-h", "--help"}
    for word in shlex.split(text)[1:]:
        if word in getattr(found, "commands", {}):
            found = found.commands[word]
            options |= {o for p in found.params for o in (*p.opts, *p.secondary_opts)}
        elif word.startswith("-") and not word[1:2].isdigit():
            option = word.split("=")[0]
            assert option in options, f"{text!r}: {option} is unknown"
        elif getattr(found, "commands", {}) and not found.invoke_without_command:
            pytest.fail(f"{text!r}: no command is called {word!r}")


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_blocks_are_of_a_kind_that_is_looked_at(page: Path) -> None:
    """What is not named could hold commands that are never tried."""
    for fence in fences(page):
        assert fence.language in LANGUAGES, f"{name_of(page)} line {fence.line}"
        if fence.language == "toml":
            tomllib.loads(fence.text)


def test_modules_that_are_named_exist() -> None:
    """But for placeholders; `*` stands for several, and folders that lead there may be left out."""
    root = DOCS.parent
    texts = [page.read_text(encoding="utf-8") for page in [*pages(), *root.glob("[!C]*.md")]]
    texts.append((root / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    names = set(re.findall(r"`([\w/*]+\.py)`", "".join(texts)))
    folders = ("alice_survey", "camera_calib", "missions", "reconstruct", "tests", "benchmarks")
    files = [path for folder in folders for path in (root / folder).rglob("*.py")]
    unknown = {name for name in names if not any(path.match(name) for path in files)}
    assert all(name.endswith("NAME.py") for name in unknown), unknown
