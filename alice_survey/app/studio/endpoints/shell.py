"""What every tab needs: the state of the workspace, and the map of what it holds."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from alice_survey.app.report.held import Held
from alice_survey.app.report.run import survey_map
from alice_survey.app.report.shapes import shape_layers
from alice_survey.app.stages import STAGES
from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, Studio, TileRequest
from alice_survey.app.studio.files import STAGES_MADE
from alice_survey.kit.document import EAST_NORTH, PictureLayer, ShapeLayer
from alice_survey.kit.map import map_data, map_extent

TABS = ("plan", "model", "pictures", "follow", "run")
_PRODUCTS = {
    "plan": "plan/plan.json", "flight": "flight/navigation.csv", "pictures": "images/manifest.csv",
    "sparse": "sparse/track.csv", "dem": "dense/dem.tif", "mosaic": "mosaic/mosaic.tif",
    "mesh": "mesh/mesh.glb", "cloud": "dense/cloud.copc.laz", "report": "report/report.html",
    "survey": "survey.toml",
}  # fmt: skip
_EMPTY_M = 50.0
"""Half a side of the map of a workspace that holds nothing."""


@dataclass(frozen=True)
class _Shell:
    studio: Studio

    def state(self, call: Call) -> dict[str, Any]:
        """The workspace in short: what it is called, what it holds, where its map lies."""
        workspace = self.studio.workspace
        held = Held.of(workspace.folder)
        found = survey_map(held, ())
        datum = held.frame.datum if found.axes == EAST_NORTH else None
        is_model = found.axes != EAST_NORTH and held.has("sparse")
        return {
            "workspace": str(workspace.folder),
            "name": held.name,
            "stages": sorted(held.stages),
            "datum": datum and [datum.latitude_deg, datum.longitude_deg],
            "unit": found.unit,
            "axes": found.axes if is_model else EAST_NORTH,
            "has": {name: workspace.has(path) for name, path in _PRODUCTS.items()},
            "files": {
                f"{stage.folder}/{path}": text
                for stage in STAGES
                for path, text in stage.products.items()
                if workspace.has(f"{stage.folder}/{path}")
            },
            "log": self.studio.log,
            "tabs": TABS,
        }

    def tile(self, call: Call) -> Content:
        """A tile of a raster; of the version that the page has, where it states one."""
        asked = call.ask(TileRequest)
        data, found = self.studio.layers.tile(asked.name, asked.level, asked.x, asked.y, asked.v)
        return Content(
            data=data, kind="image/webp", tag=f"{found}-{asked.level}-{asked.x}-{asked.y}"
        )

    def map(self, call: Call) -> dict[str, Any]:
        """The layers of what the workspace holds, as the map's script takes them."""
        with self.studio.workspace.check_unchanged(*STAGES_MADE):
            held = Held.of(self.studio.workspace.folder)
            pictures = self.studio.layers.picture_layers()
            layers: list[PictureLayer | ShapeLayer] = [*pictures, *shape_layers(held)]
            page_map = survey_map(held, layers)
        found: dict[str, Any] = {"layers": []}
        extent = (-_EMPTY_M, -_EMPTY_M, _EMPTY_M, _EMPTY_M)
        if layers:
            found = json.loads(map_data(page_map)[0])
            extent = map_extent(page_map)
        found["extent"] = extent
        for described, layer in zip(found["layers"], layers, strict=True):
            described |= _layer_json(layer)
        return found


def _layer_json(layer: PictureLayer | ShapeLayer) -> dict[str, Any]:
    """What the list of layers says of one."""
    picture = layer if isinstance(layer, PictureLayer) else None
    return {
        "title": layer.title, "about": layer.about, "shown": layer.shown,
        "group": "Base layer" if picture is not None and picture.base else "Overlays",
        "scale": None if picture is None or picture.scale is None else vars(picture.scale),
    }  # fmt: skip


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """State and map."""
    shell = _Shell(studio)
    return (
        Endpoint(path="/api/state", answer=shell.state),
        Endpoint(path="/api/map", answer=shell.map),
        Endpoint(path="/tiles/{name}/{level}/{x}/{y}.webp", answer=shell.tile),
    )
