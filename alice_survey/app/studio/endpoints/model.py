"""What the tab of the model asks for: values at a place, profiles, measures, the mesh."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from alice_survey.app.report.held import Held
from alice_survey.app.report.mesh_copy import mesh_about, mesh_copy
from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, KeptValue, Studio
from alice_survey.app.studio.files import STAGES_MADE, stale_page
from alice_survey.core.config import Config
from alice_survey.core.errors import AliceError
from alice_survey.core.products import DEM, MOSAIC, RASTERS
from alice_survey.core.records import MeshRecord
from reconstruct.measure.figures import Measured, Measurement, as_csv, as_geojson, geometry_of
from reconstruct.measure.shapes import measure_line, measure_points, measure_polygon, profile
from reconstruct.measure.surface import MeasuredSurface, values_at

_MESH = "mesh/mesh.glb"
_MAX_PLACES = 2000
_MAX_MEASURES = 1000
_READ = (
    *(one.file for one in RASTERS), "mosaic/mosaic_source.tif", "sparse/frame.json",
    "sparse/covariance.npz", "sparse/registration.json", "sparse/track.csv",
    "dense/surface.json", "dense/plane.json", "dense/stage.json", "sparse/stage.json",
)  # fmt: skip
"""Files that figures are of."""
_MAX_DRAWN = 1200
"""Samples of a profile that a page draws."""
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Metres, or units of a model without scale."""
Place = tuple[Coordinate, Coordinate]


class AskedPlace(Config):
    """A place of the map."""

    east: Coordinate
    north: Coordinate


class AskedProfile(Config):
    """A line on the surface."""

    places: list[Place] = Field(min_length=2, max_length=_MAX_PLACES)


class AskedMeasure(Config):
    """A line, points in space, or a polygon."""

    kind: Literal["line", "points", "polygon"]
    places: list[tuple[Coordinate, ...]] = Field(min_length=2, max_length=_MAX_PLACES)
    base: Coordinate | Literal["rim"] | None = None
    """Plane of a polygon's volume."""
    click: float = Field(0.0, ge=0, le=1e6)
    """Standard deviation of each coordinate of a place; 0 is not known."""


class ExportedFigure(Config):
    """A figure as it was measured."""

    name: str
    title: str
    value: float | None
    sigma: float | None
    own: float | None
    shared: float | None
    unit: str


class ExportedMeasure(Config):
    """A measurement as the page keeps it."""

    name: str = Field(max_length=200)
    kind: Literal["line", "points", "polygon"]
    places: list[tuple[Coordinate, ...]] = Field(min_length=1, max_length=_MAX_PLACES)
    figures: list[ExportedFigure] = Field(max_length=100)
    notes: list[str] = Field(default=[], max_length=20)


class AskedExport(Config):
    """Measurements to write."""

    form: Literal["csv", "geojson"]
    measures: list[ExportedMeasure] = Field(min_length=1, max_length=_MAX_MEASURES)


def plane_json(held: Held) -> dict[str, Any] | None:
    """Axes of the plane that the map is of, east, north, up; None of the level one."""
    plane = held.plane
    return None if plane is None else {
        "origin": plane.origin_enu, "right": plane.right_enu, "up": plane.up_enu,
        "out": plane.out_enu,
    }  # fmt: skip


class _ModelTab:
    def __init__(self, studio: Studio) -> None:
        self.studio = studio
        self._light = KeptValue(self._make_light_mesh)
        self._kept = KeptValue(lambda: MeasuredSurface.of(studio.workspace.folder))

    @contextmanager
    def _surface(self) -> Iterator[MeasuredSurface]:
        """The surface as it is now; what is replaced meanwhile is the page's to load again."""
        with self._check_files() as state:
            if not self.studio.workspace.has(DEM.file):
                raise FileNotFoundError(DEM.file)
            yield self._kept.of(state)

    @contextmanager
    def _check_files(self) -> Iterator[tuple[str, ...]]:
        """Tokens of the files that figures are of; a link among them is refused."""
        workspace = self.studio.workspace
        for path in _READ:
            if (workspace.folder / path).exists() and not workspace.has(path):
                raise AliceError(f"{path} is, or lies behind, a link: files of a survey are none")
        with workspace.check_unchanged(*STAGES_MADE, *_READ) as state:
            yield state

    def value(self, call: Call) -> dict[str, Any]:
        """Value and sigma of every raster at a place."""
        asked = call.ask(AskedPlace)
        place = (asked.east, asked.north)
        workspace = self.studio.workspace
        with self._check_files():
            there = [one for one in RASTERS if workspace.has(one.file)]
            found = values_at(workspace.folder, place, there)
        unit = Held.of(workspace.folder).unit
        rows = []
        for one in there:
            if values := found.get(one.file):
                factor, shown = one.shown_unit(unit)
                value: Any = [round(v) for v in values] if one == MOSAIC else factor * values[0]
                rows.append({
                    "file": one.file, "title": one.title, "value": value,
                    "unit": shown.replace("degrees", "°"),
                })  # fmt: skip
        return {"values": rows, "unit": unit}

    def profile(self, call: Call) -> dict[str, Any]:
        """Heights along a line with their sigmas, thinned to what a page draws."""
        asked = call.read(AskedProfile)
        with self._surface() as surface:
            found = profile(surface, asked.places)
            sigma = found.samples.sigma
            step = max(1, -(-len(found.along) // _MAX_DRAWN))
            kept = np.unique(
                [*range(0, len(found.along), step), *found.corners, len(found.along) - 1]
            )
            return {
                "along": found.along[kept].tolist(),
                "height": found.samples.height[kept].tolist(),
                "sigma": sigma[kept].tolist(),
                "places": found.samples.places[kept].tolist(),
                "corners": [float(found.along[n]) for n in found.corners],
                "every": step,
                "unit": surface.unit,
            }

    def measure(self, call: Call) -> dict[str, Any]:
        """All figures of a line, of points in space, or of a polygon."""
        asked = call.read(AskedMeasure)
        size = 3 if asked.kind == "points" else 2
        if any(len(place) != size for place in asked.places):
            raise AliceError(f"the request: places of {asked.kind!r} have {size} numbers")
        notes: tuple[str, ...] = ()
        figures: tuple[Measured, ...]
        with self._surface() as found:
            surface = found.picked_to(asked.click)
            if asked.kind == "line":
                figures = measure_line(surface, asked.places)
            elif asked.kind == "points":
                figures, notes = measure_points(surface, asked.places)
            else:
                figures, notes = measure_polygon(surface, asked.places, asked.base)
            return {
                "figures": [one.to_json() for one in figures],
                "notes": notes,
                "unit": surface.unit,
            }

    def export(self, call: Call) -> Content:
        """Measurements of the page as a file."""
        asked = call.read(AskedExport)
        measurements = [
            Measurement(
                name=one.name, kind=one.kind, notes=one.notes,
                geometry=geometry_of(one.kind, one.places),
                figures=[figure.model_dump() for figure in one.figures],
            )
            for one in asked.measures
        ]  # fmt: skip
        if asked.form == "csv":
            text, kind = as_csv(measurements), "text/csv; charset=utf-8"
        else:
            with self._surface() as surface:
                placed = surface.frame.name == "ned" and surface.plane.is_level
                datum = surface.frame.datum if placed else None
                text = as_geojson(measurements, datum, surface.unit)
            kind = "application/geo+json"
        return Content(data=text.encode(), kind=kind, name=f"measures.{asked.form}")

    def light_mesh(self, call: Call) -> Content:
        """The light copy of the mesh as binary glTF."""
        token = self.studio.workspace.token(_MESH)
        if call.query.get("v") not in (None, token):
            raise stale_page()
        return Content(data=self._light.of(token), kind="model/gltf-binary", tag=token)

    def _make_light_mesh(self) -> bytes:
        with tempfile.TemporaryDirectory(prefix="alice-survey-") as folder:
            path = Path(folder) / "mesh.glb"
            if mesh_copy(Held.of(self.studio.workspace.folder), path) is None:
                raise FileNotFoundError(_MESH)
            return path.read_bytes()

    def mesh(self, call: Call) -> dict[str, Any]:
        """Where the mesh is to be had, and how its points lie on the map."""
        workspace = self.studio.workspace
        held = Held.of(workspace.folder)
        record = held.read(MeshRecord)
        if record is None or not workspace.has(_MESH):
            raise FileNotFoundError(_MESH)
        tiles = "mesh/tiles/tileset.json"
        return {
            "address": f"/mesh.glb?v={workspace.token(_MESH)}",
            "about": mesh_about(record),
            "triangles": record.triangles,
            "still": "/files/mesh/mesh.png" if workspace.has("mesh/mesh.png") else None,
            "tiles": f"/files/{tiles}" if workspace.has(tiles) else None,
            "offset": record.offset_east_north_up,
            "plane": plane_json(held),
        }


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """Of the model."""
    model = _ModelTab(studio)
    return (
        Endpoint(path="/api/model/value", answer=model.value),
        Endpoint(path="/api/model/mesh", answer=model.mesh),
        Endpoint(path="/mesh.glb", answer=model.light_mesh, computes=True),
        Endpoint(path="/api/model/profile", answer=model.profile, method="POST", computes=True),
        Endpoint(path="/api/model/measure", answer=model.measure, method="POST", computes=True),
        Endpoint(path="/api/model/export", answer=model.export, method="POST", max_bytes=16 << 20),
    )
