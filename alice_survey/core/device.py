"""What does dense work on pixels: the processor, or a GPU."""

import os
from importlib.util import find_spec
from typing import Literal

from alice_survey.core.errors import ConfigError, note

Choice = Literal["auto", "cpu", "gpu"]


def is_gpu_chosen(choice: Choice) -> bool:
    """Whether to work on the GPU of this machine, which is then named in a note.

    Args:
        choice: `auto` takes the GPU if there is one that can be used; `cpu` looks for none.

    Raises:
        ConfigError: `gpu` is chosen and none can be used.
    """
    if choice == "cpu":
        return False
    if find_spec("numba_cuda") is None:
        name, missing = None, "install 'alice-survey[gpu]'"
    else:
        name, missing = _first_gpu()
    if name is not None:
        note(f"depth is refined on the GPU, {name}")
    elif choice == "gpu":
        raise ConfigError(f"--device gpu: {missing}")
    return name is not None


def _first_gpu() -> tuple[str | None, str]:
    """Name of the first GPU; None without one, and what is missing."""
    # Memory is freed at once, not ten arrays later: other processes use the same GPU.
    os.environ.setdefault("NUMBA_CUDA_MAX_PENDING_DEALLOCS_COUNT", "0")
    try:
        from numba import cuda
    except ImportError as error:
        return None, f"numba-cuda cannot be loaded ({error}): install 'alice-survey[gpu]' again"
    if not cuda.is_available():
        why = " ".join(str(cuda.cuda_error() or "no NVVM").split())
        return None, f"no NVIDIA GPU answers ({why}): install its driver, or 'alice-survey[gpu]'"
    return getattr(cuda.gpus[0], "name", "simulated"), ""  # numba's simulator has no name
