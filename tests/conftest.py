"""What all tests share."""

import os
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from tests.small_survey import settings_in, start

# As the command line does, and before numpy is loaded: several threads for small matrices wait for
# each other by spinning, which made a fit to a log take eight times the processor's time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# How long an example takes depends on what else the machine does, kernels to compile included.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes long: at the end short tests leave no worker without work."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data next to the checkout; without it the test is skipped, never in CI."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"CI needs the real data at {folder}")
        pytest.skip(f"no real data at {folder}")
    return folder


@pytest.fixture(scope="session")
def small_survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished workspace, made once for all workers; copy it before you write into it."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    workspace, done = shared / "small" / "survey", shared / "small.done"
    with FileLock(shared / "small.lock"):
        if not done.exists():
            assert start(settings_in(workspace), threads=1).wait() == 0
            done.touch()
    return workspace
