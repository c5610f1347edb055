"""Run the notebooks of `docs/notebooks`, and keep them with what they show, for the site.

python -m tests.docs.notebooks FOLDER
"""

import os
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

from tests.docs.pages import DOCS

os.environ["OPEN3D_DISABLE_WEB_VISUALIZER"] = "true"  # whose greeting would be a result
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def run_notebook(path: Path, folder: Path) -> Any:
    """A notebook after all its cells were run in a folder."""
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": folder}}
    NotebookClient(notebook, timeout=900, kernel_name="python3", resources=where).execute()
    return notebook


if __name__ == "__main__":
    kept = Path(sys.argv[1])
    (kept / "work").mkdir(parents=True, exist_ok=True)
    for one in NOTEBOOKS:
        nbformat.write(run_notebook(one, kept / "work"), kept / one.name)
