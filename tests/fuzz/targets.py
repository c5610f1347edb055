"""The table of everything that is read from outside."""

from collections.abc import Mapping
from pathlib import Path

from tests.fuzz import areas, cameras, logs, videos, workspace
from tests.fuzz.judge import Sandbox, Verdict, judge
from tests.fuzz.target import Target

GROUPS: Mapping[str, tuple[Target, ...]] = {
    "areas": areas.TARGETS,
    "logs": logs.TARGETS,
    "cameras": cameras.TARGETS,
    "workspace": workspace.TARGETS,
    "videos": videos.TARGETS,
}
TARGETS: Mapping[str, Target] = {
    target.name: target for targets in GROUPS.values() for target in targets
}


class Trial:
    """A target in a sandbox of its own, ready to be tried with any bytes."""

    def __init__(self, target: Target, root: Path) -> None:
        """Build the file in good order and read it once, so that libraries are loaded."""
        self.target = target
        self._sandbox = Sandbox(root)
        target.build(self._sandbox.inside)
        self._path = self._sandbox.inside / target.file
        self.good = self._path.read_bytes()
        target.read(self._path)

    def verdict(self, data: bytes) -> Verdict:
        """What the reader does with these bytes."""
        self._path.write_bytes(data)
        return judge(self.target.read, self._path, self._sandbox)
