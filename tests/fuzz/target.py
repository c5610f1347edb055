"""A reader to be fuzzed: the file that is damaged, what lies next to it, and how it is read."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.judge import Sandbox, Verdict, judge
from tests.fuzz.mutations import Syntax


@dataclass(frozen=True)
class Target:
    """One kind of file, in good order, and its reader."""

    name: str
    syntax: Syntax
    """How the file is damaged."""
    file: str
    """Path below a folder of its own."""
    good: str | Callable[[Path], object]
    """Its text, or what writes it there, and what its reader needs next to it."""
    read: Callable[[Path], object]
    """Takes the path of the file."""
    examples: int = 20
    """How often the short form tries it: fewer where one try takes long."""


class Trial:
    """A target in a sandbox of its own, ready to be tried with any bytes."""

    def __init__(self, target: Target, root: Path) -> None:
        """Build the file in good order and read it once, so that libraries are loaded."""
        self.target, self._sandbox = target, Sandbox(root)
        self._path = self._sandbox.inside / target.file
        if isinstance(target.good, str):
            self._path.write_text(target.good, encoding="utf-8")
        else:
            target.good(self._path)
        self.good = self._path.read_bytes()
        target.read(self._path)

    def verdict(self, data: bytes) -> Verdict:
        """What the reader does with these bytes."""
        self._path.write_bytes(data)
        return judge(self.target.read, self._path, self._sandbox)

    def verdict_of(self, make: Callable[[Path], object]) -> Verdict:
        """What the reader does with what is made in the file's place."""
        self._path.unlink()
        make(self._path)
        return judge(self.target.read, self._path, self._sandbox, max_s=2.0)
