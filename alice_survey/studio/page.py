"""The pages that the server makes: the survey with its map, mesh and files, and lists of files."""

import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from urllib.parse import quote

from alice_survey.base.records import MeshRecord
from alice_survey.kit.document import (
    Link,
    Mesh,
    PictureLayer,
    Report,
    Section,
    ShapeLayer,
)
from alice_survey.kit.page import page_policy, render_html
from alice_survey.kit.words import count, length
from alice_survey.report.held import Held
from alice_survey.report.mesh_copy import mesh_about, mesh_copy, mesh_still
from alice_survey.report.run import survey_map
from alice_survey.report.shapes import shape_layers
from alice_survey.studio.layers import FILES, ChangedError, Layers
from alice_survey.studio.paths import Entry, Workspace

_STILL_PX = 900
_MESH = "mesh/mesh.glb"
_LINKS = (
    ("report/report.html", "The report", "what was mapped, how well, what to do next"),
    ("mosaic/mosaic.tif", "The mosaic", "cloud-optimised GeoTIFF"),
    ("dense/dem.tif", "The elevation model", "GeoTIFF"),
    ("dense/cloud.copc.laz", "The point cloud", "COPC, a LAZ with levels of detail"),
    (_MESH, "The mesh", "glTF"),
    ("sparse/track.csv", "The cameras' track", "CSV"),
    ("plan/plan.html", "The plan", "an interactive map"),
)


class Page:
    """The survey's page and its mesh, made on request and kept while nothing changes."""

    def __init__(self, workspace: Workspace, layers: Layers) -> None:
        """Take a workspace and its layers."""
        self._workspace, self._layers = workspace, layers
        self._page = lru_cache(maxsize=1)(self._render)
        self._mesh = lru_cache(maxsize=1)(self._light_mesh)

    def survey(self, host: str) -> tuple[bytes, str]:
        """The page of the survey as it is now, and its policy.

        Args:
            host: name and port, as the browser knows this server.

        Raises:
            WorkspaceError: a file of the workspace is damaged.
            FileNotFoundError: a stage was removed meanwhile.
        """
        return self._page(host, self._workspace.state(tuple(FILES.values())))

    def _render(self, host: str, _state: tuple[str, ...]) -> tuple[bytes, str]:
        report = self._report(host)
        return render_html(report).encode(), page_policy(report)

    def mesh(self, token: str | None) -> tuple[bytes, str]:
        """The light copy of the mesh as binary glTF, and the token of the mesh.

        Args:
            token: token of the mesh that the page has; None for the current one.

        Raises:
            FileNotFoundError: there is no mesh.
            ChangedError: there is another mesh by now.
            WorkspaceError: it is damaged.
        """
        now = self._workspace.token(_MESH)
        if token not in (None, now):
            raise ChangedError
        return self._mesh(now), now

    def _light_mesh(self, _token: str) -> bytes:
        with tempfile.TemporaryDirectory(prefix="alice-survey-") as folder:
            path = Path(folder) / "mesh.glb"
            if mesh_copy(Held.of(self._workspace.folder), path) is None:
                raise FileNotFoundError(_MESH)
            return path.read_bytes()

    def _report(self, host: str) -> Report:
        held = Held.of(self._workspace.folder)
        pictures = self._layers.picture_layers()
        layers: list[PictureLayer | ShapeLayer] = [*pictures, *shape_layers(held)]
        chart = None
        if layers:
            chart = survey_map(held, layers)
        mesh = self._mesh_view(held)
        parts = []
        if chart is not None:
            parts.append(Section(name="map", title="Map", scene="map"))
        if mesh is not None:
            parts.append(Section(name="mesh", title="Mesh", scene="mesh"))
        parts.append(_files(self._workspace, host))
        return Report(
            title=held.name,
            subtitle=f"{self._workspace.folder}, as it is now",
            summary={},
            facts=[(layer.title, _resolution(layer, held.unit)) for layer in pictures[:2]],
            verdicts=(),
            sections=parts,
            map=chart,
            mesh=mesh,
        )

    def _mesh_view(self, held: Held) -> Mesh | None:
        path, picture = held.file(_MESH), held.file("mesh/mesh.png")
        mesh = held.read(MeshRecord)
        if path is None or picture is None or mesh is None:
            return None
        return Mesh(
            glb=path,
            about=mesh_about(mesh),
            still=mesh_still(picture, _STILL_PX),
            address=f"/mesh.glb?v={self._workspace.token(_MESH)}",
        )


def _resolution(layer: PictureLayer, unit: str) -> str:
    pixel = length(layer.pixel_m, unit)
    return f"{layer.width_px:,} by {layer.height_px:,} pixels of {pixel}"


def _files(workspace: Workspace, host: str) -> Section:
    links = [Link(text="All files", address="/files/", about="of this workspace")]
    for path, text, about in _LINKS:
        if workspace.has(path):
            links.append(Link(text=text, address=f"/files/{path}", about=f"({path}): {about}"))
    return Section(
        name="files",
        title="Files",
        text=[
            "A GIS reads rasters from here part by part, without a copy: in QGIS add a raster "
            f"layer with the protocol HTTP(S) and the address http://{host}/files/mosaic/mosaic.tif"
        ],
        links=links,
    )


def listing(names: Sequence[str], entries: Sequence[Entry], more: int) -> tuple[bytes, str]:
    """A page that lists a folder, and its policy."""
    links = [Link(text="The survey", address="/")]
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
