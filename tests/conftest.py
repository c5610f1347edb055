"""What all tests share."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How long an example takes depends on what else the machine does, kernels to compile included.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")


def pytest_configure(config: pytest.Config) -> None:
    """Drop compiled kernels that are older than a source beside them.

    numba looks at the age of a kernel's own file only, not at that of the kernels it calls.
    """
    if hasattr(config, "workerinput"):
        return
    for cache in Path(__file__).parents[1].glob("[acm]*/**/__pycache__"):
        sources = max((f.stat().st_mtime for f in _room(cache).rglob("*.py")), default=0.0)
        for compiled in cache.glob("*.nb[ci]"):
            if compiled.stat().st_mtime < sources:
                compiled.unlink()


def _room(cache: Path) -> Path:
    """The package whose kernels call one another: a room of `alice_survey`, or a top level."""
    inside = cache.relative_to(Path(__file__).parents[1]).parts
    depth = 2 if inside[0] == "alice_survey" else 1
    return Path(__file__).parents[1].joinpath(*inside[:depth])


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data beside the checkout; without it the test is skipped, never in CI."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"CI needs the real data at {folder}")
        pytest.skip(f"no real data at {folder}")
    return folder
