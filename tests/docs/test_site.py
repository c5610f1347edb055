"""The site of `docs/` builds without a warning, is whole, and needs no network."""

import itertools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import alice_survey as alice
from alice_survey.app.studio.jobs import _CODES_OF_STOP
from alice_survey.core.errors import NOT_GOOD_ENOUGH
from tests import structure
from tests.alice_survey.kit.browser import Heard, chromium, is_accessible
from tests.docs.notebooks import NOTEBOOKS
from tests.docs.pages import DOCS, pages

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("site")]
ROOT = DOCS.parent
SETTINGS = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as `make docs` builds it, into a folder of its own."""
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    output = built.stdout + built.stderr
    assert built.returncode == 0, output[-3000:]
    assert "WARNING" not in output, output[-3000:]
    return folder


def leaves(branch: Any) -> list[str]:
    """Pages of a part of `nav`."""
    if isinstance(branch, str):
        return [branch]
    inside = branch.values() if isinstance(branch, dict) else branch
    return [leaf for part in inside for leaf in leaves(part)]


def test_every_page_is_in_the_contents_once_and_was_built(site: Path) -> None:
    listed = leaves(SETTINGS["nav"])
    notebooks = [path.with_suffix(".md") for path in NOTEBOOKS]
    assert sorted(listed) == sorted(str(one.relative_to(DOCS)) for one in [*pages(), *notebooks])
    for page in listed:
        text = (site / page).with_suffix(".html").read_text(encoding="utf-8")
        assert re.search(r"<h1[ >]", text), page


def test_the_api_pages_show_each_public_name_with_all_its_fields(site: Path) -> None:
    page = "".join(path.read_text(encoding="utf-8") for path in (site / "api").glob("*.html"))
    for home, names in alice._HOMES.items():
        for name in names:
            assert f'id="{home}.{name}"' in page, name
    for field in (
        "camera.Camera.lens", "camera.Camera.fx_px", "lenses.opencv.OpenCVLens.k6",
        "ports.flat.FlatPort.port_distance_m", "ports.dome.DomePort.dome_x_m",
    ):  # fmt: skip
        assert f'id="camera_calib.{field}"' in page, field


def test_the_reference_has_every_command_option_and_setting(site: Path) -> None:
    pages = [site / "settings.html", *(site / "commands").glob("*.html")]
    reference = "".join(path.read_text(encoding="utf-8") for path in pages)
    assert "Until the site is built" not in reference
    for name, command in structure.commands().items():
        assert f'id="alice-survey-{name.replace(" ", "-")}"' in reference, name
        for option in command.params:
            assert f"<code>{option.opts[0]}</code>" in reference or option.opts[0][0] != "-"
    for section, field in alice.SurveyConfig.model_fields.items():
        for key in getattr(field.annotation, "model_fields", {section: field}):
            assert f"<code>{key}</code>" in reference, f"{section}.{key}"


def test_the_reference_has_every_exit_code(site: Path) -> None:
    page = (site / "conventions.html").read_text(encoding="utf-8")
    codes = re.findall(r"\d+", ",".join(re.findall(r"<td>([\d, ]+)</td>", page)))
    assert sorted(map(int, codes)) == sorted((0, 1, 2, NOT_GOOD_ENOUGH, *_CODES_OF_STOP))


def test_modules_that_the_theory_names_exist() -> None:
    chapters = sorted((DOCS / "theory").glob("*.md"))
    theory = "".join(path.read_text(encoding="utf-8") for path in chapters)
    named = re.findall(r"`((?:alice_survey|camera_calib|missions|reconstruct)(?:\.\w+)+)`", theory)
    assert len(named) > 80
    for module in named:
        path = ROOT / module.replace(".", "/")
        assert path.is_dir() or path.with_suffix(".py").is_file(), module


def test_formulas_became_mathml(site: Path) -> None:
    for page in sorted(site.rglob("*.html")):
        text = page.read_text(encoding="utf-8")
        assert "arithmatex" not in text, page.relative_to(site)
        for formula in re.findall(r"<math.*?</math>", text, re.S):
            assert "\\" not in formula, f"{page.relative_to(site)}: {formula}"
    chapters = sorted((site / "theory").glob("*.html"))
    theory = "".join(path.read_text(encoding="utf-8") for path in chapters)
    assert theory.count('display="block"') > 50
    assert "$" not in re.sub(r"<(script|style|code).*?</\1>", "", theory, flags=re.S)


_LIST = re.compile(r"(- |\d+\. |\|)")
_WITHIN = re.compile(r"( *- | *\d+\. |\||#|  )")


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_lists_and_tables_stand_apart(page: Path) -> None:
    """Without an empty line before it the site shows a list as running text."""
    plain = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    for before, line in itertools.pairwise(plain.split("\n")):
        if _LIST.match(line) and before.strip():
            assert _WITHIN.match(before), line


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


def test_pages_open_from_disk_and_ask_for_nothing_else(site: Path, browser: Any) -> None:
    tab = browser.new_page(viewport={"width": 400, "height": 900})
    heard = Heard()
    heard.listen(tab)
    held = [page for page in sorted(site.rglob("*.html")) if page.stem != "404"]
    assert len(held) >= len(pages())
    for page in held:
        tab.goto(page.as_uri())
        assert tab.evaluate("document.documentElement.scrollWidth") <= 400, page
        assert page.stat().st_size <= 300_000, page
        is_made = page.parent.name in ("api", "commands") or page.stem == "settings"
        height = tab.evaluate("document.documentElement.scrollHeight")
        assert is_made or height <= 8_000, page
    tab.close()
    tab = browser.new_page(viewport={"width": 1280, "height": 900})
    for name in (
        "index", "tutorial", "cameras", "paper-optics", "theory/placing", "measured/demo",
        "notebooks/plan", "notebooks/compare",
    ):  # fmt: skip
        tab.goto((site / f"{name}.html").as_uri())
        is_accessible(tab)  # it reads styles again, which browsers refuse to pages from disk
    tab.close()
    assert heard.complaints == []
    assert [asked for asked in heard.requests if not asked.startswith(("file:", "data:"))] == []
