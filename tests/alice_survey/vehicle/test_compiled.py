"""Compiled kernels are kept between processes, and dropped when what they call has changed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import TypingError

import alice_survey.vehicle.compiled as compiled

ASK = "import inner, outer; print(outer.twice(3.0), sum(outer.twice.stats.cache_hits.values()))"
INNER = "from compiled import kernel\n\n@kernel\ndef once(x):\n    return {}\n"
OUTER = (
    "from compiled import kernel\nfrom inner import once\n\n"
    "@kernel\ndef twice(x):\n    return once(x) * 2.0\n"
)


def ask(folder: Path) -> tuple[float, int]:
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "kept")}
    done = subprocess.run(
        [sys.executable, "-c", ASK], env=environment, capture_output=True, text=True, check=True
    )
    value, hits = done.stdout.split()
    return float(value), int(hits)


def test_a_kernel_is_kept_until_one_that_it_calls_changes(tmp_path: Path) -> None:
    shutil.copy(compiled.__file__, tmp_path / "compiled.py")
    (tmp_path / "inner.py").write_text(INNER.format("x + 1.0"))
    (tmp_path / "outer.py").write_text(OUTER)
    assert ask(tmp_path) == (8.0, 0)
    assert ask(tmp_path) == (8.0, 1)
    (tmp_path / "inner.py").write_text(INNER.format("x + 10.0"))
    assert ask(tmp_path) == (26.0, 0)


def test_a_kernel_cannot_allocate() -> None:
    def allocates(x: float) -> float:
        return float(np.zeros(3)[0] + x)

    with pytest.raises(TypingError, match="Only accept returning of array passed into"):
        compiled.kernel(allocates)(1.0)
