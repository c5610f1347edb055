"""Arrays of each view on disk between the steps of a stage, so that memory stays bounded."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.artefacts import atomic_path


@dataclass(frozen=True)
class ViewStore:
    """A folder with one file per view and name; a file is there whole or not at all."""

    folder: Path

    def path(self, view: int, name: str) -> Path:
        """Where an array is kept."""
        return self.folder / f"{view:06d}.{name}.npy"

    def has(self, view: int, name: str) -> bool:
        """Whether an array was saved."""
        return self.path(view, name).is_file()

    def save(self, view: int, name: str, array: NDArray[Any]) -> None:
        """Keep an array."""
        with atomic_path(self.path(view, name)) as path:
            np.save(path, array)

    def load(self, view: int, name: str) -> NDArray[Any]:
        """The array saved before, read only where touched."""
        array: NDArray[Any] = np.load(self.path(view, name), mmap_mode="r")
        return array
