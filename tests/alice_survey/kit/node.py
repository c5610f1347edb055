"""Run scripts of pages with node."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def run_node(*arguments: str, folder: Path | None = None) -> Any:
    """Run node in a folder and return what it prints, one JSON value."""
    node = shutil.which("node")
    if node is None:
        if os.environ.get("CI"):
            pytest.fail("CI needs node to run the scripts of pages")
        pytest.skip("no node here")
    done = subprocess.run(
        [node, *arguments], cwd=folder, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def run_modules(scripts: Path, folder: Path, code: str) -> Any:
    """Run the text of an ES module next to copies of others.

    Args:
        scripts: folder of the modules, which it imports as "./NAME.js".
        folder: for the copies.
        code: text of the module; it prints one JSON value.
    """
    for path in scripts.glob("*.js"):
        shutil.copy(path, folder)
    (folder / "package.json").write_text(json.dumps({"type": "module"}))
    (folder / "run.js").write_text(code)
    return run_node("run.js", folder=folder)
