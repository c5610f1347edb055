import io
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from pypdf import PdfReader

from alice_survey.kit.document import Report, Section, Table
from alice_survey.kit.paper import render_pdf
from tests.alice_survey.kit.sketch import RUDE, sketch_report

DATE = datetime(2026, 5, 5, 12, 30)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    return sketch_report(tmp_path_factory.mktemp("sketch"), side=600)


@pytest.fixture(scope="module")
def pdf(report: Report) -> bytes:
    return render_pdf(report, DATE)


def printed(pdf: bytes) -> str:
    text = "".join(page.extract_text() for page in PdfReader(io.BytesIO(pdf)).pages)
    return "".join(text.split()).replace("\u200b", "")


def test_the_same_report_gives_the_same_bytes(report: Report, pdf: bytes) -> None:
    assert render_pdf(report, DATE) == pdf


def test_text_is_never_markup(report: Report, pdf: bytes) -> None:
    assert "".join(RUDE.split()) in printed(pdf)
    hostile = '#read("/etc/passwd") $x$ *bold* _it_ @ref <label> \\ // `raw`'
    other = replace(
        report,
        title=hostile,
        map=None,
        mesh=None,
        sections=[
            Section(title=hostile, tables=[Table(title=hostile, header=["a"], rows=[["b"]])])
        ],
    )
    assert printed(render_pdf(other, DATE)).count("".join(hostile.split())) >= 3


@pytest.mark.slow
def test_a_screen_reader_gets_what_figures_show(report: Report, pdf: bytes) -> None:
    reader = PdfReader(io.BytesIO(pdf))
    items: list[Any] = [reader.get_object(n) for n in {*reader.xref[0], *reader.xref_objStm}]
    alts = [str(item["/Alt"]) for item in items if isinstance(item, dict) and "/Alt" in item]
    assert report.mesh is not None
    assert report.mesh.still.alt in alts
    assert b"pdfuaid" in pdf or reader.xmp_metadata is not None


def test_files_stay_out_of_the_folder_of_the_caller(
    report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    render_pdf(report, DATE)
    assert list(tmp_path.iterdir()) == []
