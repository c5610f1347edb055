"""The mesh that the studio's page shows, and the page that lists a folder."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from alice_survey.app.report.held import Held
from alice_survey.app.report.mesh_copy import mesh_copy
from alice_survey.app.studio.paths import Entry
from alice_survey.kit.document import Link, Report, Section
from alice_survey.kit.page import page_policy, render_html
from alice_survey.kit.words import count

MESH = "mesh/mesh.glb"


def light_mesh(workspace: Path) -> bytes:
    """The light copy of the mesh as binary glTF.

    Raises:
        FileNotFoundError: there is no mesh.
        WorkspaceError: it is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="alice-survey-") as folder:
        path = Path(folder) / "mesh.glb"
        if mesh_copy(Held.of(workspace), path) is None:
            raise FileNotFoundError(MESH)
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
