"""KML, GPX and GeoJSON read back by fastkml, gpxpy and GDAL."""

import tempfile
from pathlib import Path
from typing import Any

import gpxpy
import numpy as np
import pyogrio
import pytest
import shapely
from fastkml import Document, Folder, Placemark, kml
from fastkml.utils import find_all
from hypothesis import given

from missions.exports.write import write_exports
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG, small_plan
from tests.missions.exports.readers import WIDE, local_ne, plans

MM = 1e-3


def clean(name: str) -> str:
    """A name without what XML 1.0 cannot hold, and as XML reads carriage returns."""
    held = "".join(
        c if c in "\t\n\r" or "\x20" <= c <= "\ud7ff" or "\ue000" <= c <= "\ufffd"
        or c >= "\U00010000" else "\ufffd"
        for c in name
    )  # fmt: skip
    return held.replace("\r\n", "\n").replace("\r", "\n")


def ne(plan: Plan, lon_lat: Any) -> np.ndarray:
    return np.array([local_ne(plan.datum, lat, lon) for lon, lat, *_ in lon_lat])


def found(inside: object, kind: type) -> list[Any]:
    return list(find_all(inside, of_type=kind))


def placemarks(path: Path, name: str) -> list[Any]:
    (folder,) = [f for f in found(kml.KML.parse(path), Folder) if f.name == name]
    return found(folder, Placemark)


@WIDE
@given(plan=plans())
def test_kml_in_fastkml(plan: Plan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_exports(Path(folder), plan, RIG, formats=["kml"])
        path = Path(folder) / "plan.kml"
        lines, routes = placemarks(path, "Lines"), placemarks(path, "Routes")
        (document,) = found(kml.KML.parse(path), Document)
    assert (document.name or "").strip() == clean(plan.name).strip()
    assert len(lines) == len(plan.lines)
    assert len(routes) == len(plan.dives)
    for mark, wanted in zip(lines, plan.lines, strict=True):
        coordinates = mark.geometry.coords
        ends = [wanted.start_ne_m, wanted.end_ne_m]
        np.testing.assert_allclose(ne(plan, coordinates), ends, atol=MM)
        depth = plan.seafloor_depth_m - plan.altitude_m
        assert [c[2] for c in coordinates] == pytest.approx([-depth] * 2, abs=MM)
        data = {element.name: element.value for element in mark.extended_data.elements}
        assert (data["kind"], int(data["stations"])) == (wanted.kind, wanted.stations)
    for mark, dive in zip(routes, plan.dives, strict=True):
        places = ne(plan, mark.geometry.coords)
        length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
        assert length == pytest.approx(dive.route.length_m, rel=1e-4, abs=0.02)


@WIDE
@given(plan=plans())
def test_gpx_in_gpxpy(plan: Plan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_exports(Path(folder), plan, RIG, formats=["gpx"])
        gpx = gpxpy.parse((Path(folder) / "plan.gpx").read_text(encoding="utf-8"))
    assert (gpx.name or "").strip() == clean(plan.name).strip()
    wanted = [end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)]
    read = [local_ne(plan.datum, end.latitude, end.longitude) for end in gpx.waypoints]
    np.testing.assert_allclose(read, [plan.home_ne_m, *wanted], atol=MM)
    assert len(gpx.routes) == len(plan.dives)
    for route, dive in zip(gpx.routes, plan.dives, strict=True):
        places = np.array([local_ne(plan.datum, p.latitude, p.longitude) for p in route.points])
        length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
        assert length == pytest.approx(dive.route.length_m, rel=1e-4, abs=0.02)
        floor = plan.seafloor_depth_m - plan.altitude_m
        assert route.points[1].elevation == pytest.approx(-floor, abs=MM)
        assert route.points[-1].elevation == 0.0


@WIDE
@given(plan=plans())
def test_geojson_in_gdal(plan: Plan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_exports(Path(folder), plan, RIG, formats=["geojson"])
        about, _, shapes, columns = pyogrio.raw.read(Path(folder) / "plan.geojson")
    fields = dict(zip(about["fields"], columns, strict=True))
    shapes = shapely.from_wkb(shapes)
    roles = fields["role"]

    def places(role: str) -> np.ndarray:
        return ne(plan, shapely.get_coordinates(shapes[roles == role]))

    ends = [end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)]
    np.testing.assert_allclose(places("line"), ends, atol=MM)
    stations = np.vstack([line.stations_ne for line in plan.lines])
    np.testing.assert_allclose(places("station"), stations, atol=MM)
    np.testing.assert_allclose(places("home"), [plan.home_ne_m], atol=MM)
    assert list(fields["kind"][roles == "line"]) == [line.kind for line in plan.lines]
    assert list(fields["dive"][roles == "route"]) == list(range(1, len(plan.dives) + 1))
    # Every footprint holds the place below its glass.
    prints = shapes[roles == "footprint"]
    assert shapely.contains(prints, shapes[roles == "station"]).all()
    for role, geometry in (("area", plan.area.survey), ("allowed", plan.area.allowed)):
        (read,) = shapes[roles == role]
        assert len(read.interiors) == len(geometry.geoms[0].interiors)
        assert read.exterior.is_ccw
        np.testing.assert_allclose(
            shapely.Polygon(ne(plan, read.exterior.coords)).area,
            shapely.Polygon(geometry.geoms[0].exterior).area,
            rtol=1e-3,
        )


def test_holes_in_geojson_run_clockwise(tmp_path: Path) -> None:
    write_exports(tmp_path, small_plan(), RIG, formats=["geojson"])
    about, _, shapes, columns = pyogrio.raw.read(tmp_path / "plan.geojson")
    roles = columns[list(about["fields"]).index("role")]
    (area,), (zone,) = (shapely.from_wkb(shapes[roles == role]) for role in ("area", "no_go"))
    assert not area.interiors[0].is_ccw
    assert zone.exterior.is_ccw
    assert shapely.Polygon(area.interiors[0]).equals(zone)
