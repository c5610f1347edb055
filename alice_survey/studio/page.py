"""The mesh that the studio's page shows, and the page that lists a folder."""

import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from urllib.parse import quote

from alice_survey.kit.document import Link, Report, Section
from alice_survey.kit.page import page_policy, render_html
from alice_survey.kit.words import count
from alice_survey.report.held import Held
from alice_survey.report.mesh_copy import mesh_copy
from alice_survey.studio.paths import Entry, Workspace, worked_on

_MESH = "mesh/mesh.glb"


class MeshCopies:
    """The light copy of the mesh, made on request and kept while the mesh is the same."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace."""
        self._workspace = workspace
        self._copy = lru_cache(maxsize=1)(self._made)

    def read(self, token: str | None) -> tuple[bytes, str]:
        """The light copy of the mesh as binary glTF, and the token of the mesh.

        Args:
            token: token of the mesh that the page has; None for the current one.

        Raises:
            FileNotFoundError: there is no mesh.
            StaleError: there is another mesh by now.
            WorkspaceError: it is damaged.
        """
        now = self._workspace.token(_MESH)
        if token not in (None, now):
            raise worked_on()
        return self._copy(now), now

    def _made(self, _token: str) -> bytes:
        with tempfile.TemporaryDirectory(prefix="alice-survey-") as folder:
            path = Path(folder) / "mesh.glb"
            if mesh_copy(Held.of(self._workspace.folder), path) is None:
                raise FileNotFoundError(_MESH)
            return path.read_bytes()


def listing(names: Sequence[str], entries: Sequence[Entry], more: int) -> tuple[bytes, str]:
    """A page that lists a folder, and its policy."""
    links = [Link(text="The studio", address="/")]
    if names:
        links.append(Link(text="..", address="../"))
    for entry in entries:
        mark = "/" if entry.is_folder else ""
        size = "" if entry.is_folder else count(entry.size, "byte")
        links.append(
            Link(text=entry.name + mark, address=f"./{quote(entry.name)}{mark}", about=size)
        )
    text = [f"and {more:,} more"] if more else []
    report = Report(
        title="/".join(("files", *names)),
        subtitle="",
        sections=[Section(title="Files", text=text, links=links)],
    )
    return render_html(report).encode(), page_policy(report)
