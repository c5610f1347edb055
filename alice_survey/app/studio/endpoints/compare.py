"""The Compare tab: another survey over this one, and what has changed between them.

The other workspace is opened read-only and by the same rules as the studio's own: files of its
products alone, no links. It is named by a page that has the token, and reached by a name that
nobody can guess.
"""

import os
import secrets
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from alice_survey.app.report.colours import change_rasters
from alice_survey.app.report.held import Held
from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, Studio, scale_json
from alice_survey.app.studio.layers import Layers
from alice_survey.app.studio.paths import Workspace
from alice_survey.core.config import Config
from alice_survey.core.contents import shown
from alice_survey.core.edited_files import StaleError
from alice_survey.core.errors import AliceError
from alice_survey.core.frames import Datum
from alice_survey.kit.document import PictureLayer
from alice_survey.kit.map import picture_json
from reconstruct.evaluate.elevation import enu_from_enu
from reconstruct.views.model import datum_of

_MAX_OPEN = 4
_MAX_SIBLINGS = 200
_MAX_SHOWN = 100
"""Where a program that is started finds the package."""
_CHANGED = "the survey was worked on meanwhile: choose it again"


class _Named(Config):
    path: str = Field(min_length=1, max_length=4000)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Other:
    """Another survey that a page named."""

    workspace: Workspace
    layers: Layers
    name: str


class _Compare:
    def __init__(self, studio: Studio) -> None:
        self._studio, self._folder = studio, studio.workspace.folder
        self._lock = threading.Lock()
        self._others: dict[str, _Other] = {}
        self._results = lru_cache(_MAX_OPEN)(self._layers_of)

    def near(self, call: Call) -> dict[str, Any]:
        """Workspaces next to this one."""
        try:
            with os.scandir(self._folder.parent) as entries:
                folders = sorted(e.path for e in entries if e.is_dir(follow_symlinks=False))
        except OSError:
            folders = []
        surveys = [
            {"name": path.name, "path": str(path)}
            for path in map(Path, folders[:_MAX_SIBLINGS])
            if path != self._folder and _is_survey(path)
        ]
        return {"folder": str(self._folder.parent), "surveys": surveys}

    def open(self, call: Call) -> dict[str, Any]:
        """Open another survey, and describe its rasters in this one's coordinates."""
        path = Path(call.read(_Named).path).expanduser()
        path = path if path.is_absolute() else self._folder.parent / path
        try:
            is_there = path.is_dir() and _is_survey(path)
        except (OSError, ValueError):  # too long a name, a NUL, no permission
            is_there = False
        if not is_there:
            raise AliceError(
                f"{shown(str(path))} holds no surface and no mosaic of a survey: name the folder "
                "of a reconstructed workspace"
            )
        name = secrets.token_hex(12)
        workspace = Workspace(path)
        layers = Layers(workspace, address=f"/api/compare/{name}/tiles")
        other = _Other(workspace=workspace, layers=layers, name=Held.of(path).name)
        with self._lock:
            self._others[name] = other
            for old in list(self._others)[:-_MAX_OPEN]:
                del self._others[old]
        return {"id": name, **self._described(other)}

    def _described(self, other: _Other) -> dict[str, Any]:
        here, there = Held.of(self._folder), Held.of(other.workspace.folder)
        shift, note = _shift(here, there)
        pictures = [_picture(layer, shift) for layer in other.layers.picture_layers()]
        return {
            "name": other.name, "path": str(other.workspace.folder), "layers": pictures,
            "note": note, "comparable": not note,
        }  # fmt: skip

    def tile(self, call: Call) -> Content:
        """A tile of another survey."""
        return _tile(self._other(call).layers, call)

    def _other(self, call: Call) -> _Other:
        with self._lock:
            found = self._others.get(call.path["id"])
        if found is None:
            raise StaleError("the other survey is no longer open: choose it again")
        return found

    def results(self, call: Call) -> dict[str, Any]:
        """Comparisons that were made, the changed places of each, and its maps."""
        found = []
        for name, record in Held.of(self._folder).earlier:
            change = record.to_json()
            with self._lock:
                layers = self._results(name)
            found.append({
                "name": name,
                "earlier": change.get("earlier"),
                **{key: change.get(key) for key in ("gained", "lost", "area_m2", "changed_m2",
                                                    "unchanged", "registration")},
                "regions": _regions(change),
                "layers": [_picture(layer, (0.0, 0.0)) for layer in layers.picture_layers()],
            })  # fmt: skip
        return {"results": found}

    def _layers_of(self, name: str) -> Layers:
        return Layers(
            self._studio.workspace, overlays=change_rasters(name),
            address=f"/api/compare/results/{name}/tiles",
        )  # fmt: skip

    def change_tile(self, call: Call) -> Content:
        """A tile of a map of changes."""
        name = call.path["name"]
        self._studio.workspace.file(("against", name, "change.json"))
        with self._lock:
            layers = self._results(name)
        return _tile(layers, call)


def _is_survey(folder: Path) -> bool:
    """Whether a folder holds a finished surface or mosaic."""
    workspace = Workspace(folder)
    return any(
        workspace.has(f"{stage}/stage.json") and workspace.has(f"{stage}/{file}")
        for stage, file in (("dense", "dem.tif"), ("mosaic", "mosaic.tif"))
    )


def _shift(here: Held, there: Held) -> tuple[tuple[float, float], str]:
    """East and north from another survey's coordinates to this one's, and why that is not known."""
    if here.plane is not None or there.plane is not None:
        return (0.0, 0.0), "a survey is on a plane that is not level: they may not lie as shown"
    mine, other = here.frame, there.frame
    if mine.datum is None or other.datum is None:
        return (0.0, 0.0), "a survey has no datum: each lies in its own model's coordinates"
    first: Datum = datum_of(mine.datum)
    if first == datum_of(other.datum):
        return (0.0, 0.0), ""
    moved = enu_from_enu(first, datum_of(other.datum)).apply(np.zeros((1, 3)))[0]
    return (float(moved[0]), float(moved[1])), ""


def _picture(layer: PictureLayer, shift: tuple[float, float]) -> dict[str, Any]:
    """A raster as the map's script takes it."""
    return {
        **picture_json(layer), "title": layer.title, "about": layer.about,
        "west": layer.west_m + shift[0], "north": layer.north_m + shift[1],
        "address": layer.address, "scale": scale_json(layer),
    }  # fmt: skip


def _tile(layers: Layers, call: Call) -> Content:
    level, x, y = (call.whole(part) for part in ("level", "x", "y"))
    try:
        data, token = layers.tile(call.path["layer"], level, x, y, call.query.get("v"))
    except StaleError:
        raise StaleError(_CHANGED) from None
    return Content(data=data, kind="image/webp", tag=f"{token}-{level}-{x}-{y}")


def _regions(change: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Places that changed, the largest first; those of older files have no outlines."""
    regions = change.get("regions")
    if not isinstance(regions, list):
        return []
    keys = ("east_m", "north_m", "area_m2", "volume_l", "sigma_l", "most_mm")
    return [
        {**{key: one.get(key) for key in keys}, "outlines": one.get("outlines") or []}
        for one in regions[:_MAX_SHOWN]
        if isinstance(one, dict)
    ]


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """What the tab asks."""
    tab = _Compare(studio)
    post: dict[str, Any] = {"method": "POST", "writes": True}
    return (
        Endpoint(path="/api/compare/near", answer=tab.near, **post),
        Endpoint(path="/api/compare/open", answer=tab.open, **post),
        Endpoint(path="/api/compare/results", answer=tab.results),
        Endpoint(
            path="/api/compare/results/{name}/tiles/{layer}/{level}/{x}/{y}.webp",
            answer=tab.change_tile,
        ),
        Endpoint(path="/api/compare/{id}/tiles/{layer}/{level}/{x}/{y}.webp", answer=tab.tile),
    )
