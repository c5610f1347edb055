"""The notebooks run from top to bottom, in an empty folder, and are stored without results."""

import shutil
from pathlib import Path

import nbformat
import pytest

from tests.docs.notebooks import NOTEBOOKS, run_notebook


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    survey = "tiny" if path.stem == "compare" else "small"
    shutil.copytree(request.getfixturevalue(f"{survey}_survey"), tmp_path / survey)
    stored = nbformat.read(path, as_version=4).cells
    assert not any(cell.get("outputs") for cell in stored)
    shown = [out for c in run_notebook(path, tmp_path).cells for out in c.get("outputs", ())]
    assert any("image/png" in out.get("data", {}) for out in shown)
    assert not any(out.output_type == "error" for out in shown)
