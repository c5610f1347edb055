"""A reader to be fuzzed: the file that is damaged, what lies next to it, and how it is read."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.mutations import Syntax


@dataclass(frozen=True)
class Target:
    """One kind of file, in good order, and its reader."""

    name: str
    syntax: Syntax
    """How the file is damaged."""
    file: str
    """Path below the folder that `build` fills."""
    build: Callable[[Path], None]
    """Writes a good file, and what its reader needs next to it."""
    read: Callable[[Path], object]
    """Takes the path of the file."""
    examples: int = 20
    """How often the short form tries it: fewer where one try takes long."""
