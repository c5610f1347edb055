import json
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from alice_survey.core.config import AreaConfig, load_config
from alice_survey.core.errors import PlanError
from missions.areas import files
from missions.areas.survey import survey_area
from missions.values.area import Area
from tests.missions.areas.sites import TO_UTM, UTM, area_of

SITE = Polygon(
    [(700000, 3640000), (700030, 3640000), (700030, 3640020), (700015, 3640010), (700000, 3640020)],
    [[(700004, 3640003), (700009, 3640003), (700006, 3640008)]],
)
"""30 x 20 m with a bay and a hole, UTM zone 36 north."""


def in_degrees(geometry: BaseGeometry) -> Any:
    def degrees(xy: np.ndarray) -> np.ndarray:
        return np.column_stack(TO_UTM.transform(xy[:, 0], xy[:, 1], direction="INVERSE"))

    return shapely.transform(geometry, degrees)


def write(
    path: Path, geometries: Sequence[BaseGeometry], driver: str, crs: str = UTM, **more: Any
) -> Path:
    """By GDAL itself."""
    wkb = shapely.to_wkb(np.array(geometries, dtype=object))
    how = {"geometry_type": "Unknown", "crs": crs, "driver": driver, **more}
    pyogrio.raw.write(path, wkb, [np.arange(len(wkb))], ["number"], **how)
    return path


def zipped(path: Path, members: Mapping[str, Path | bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content if isinstance(content, bytes) else content.read_bytes())
    return path


def shapefile(folder: Path, name: str = "site") -> Path:
    return write(folder / f"{name}.shp", [SITE], "ESRI Shapefile", geometry_type="Polygon")


def refusal(**settings: object) -> str:
    with pytest.raises(PlanError) as fault:
        area_of(**settings)
    assert "\n" not in str(fault.value)
    return str(fault.value)


@pytest.fixture(scope="module")
def wanted() -> Area:
    return area_of(wkt=SITE.wkt, crs="EPSG:32636")


def make(kind: str, folder: Path) -> Path:
    if kind == "geojson":
        digits = {"COORDINATE_PRECISION": "11"}
        place = [in_degrees(SITE)]
        return write(folder / "a.geojson", place, "GeoJSON", "EPSG:4326", layer_options=digits)
    if kind == "geojson with crs":
        return write(folder / "a.json", [SITE], "GeoJSON")
    if kind == "gpkg":
        return write(folder / "a.gpkg", [SITE], "GPKG")
    if kind == "shp":
        return shapefile(folder)
    if kind == "shp.zip":
        site = shapefile(folder)
        sides = {f"x/{p.name}": p for p in folder.glob("site.*")}
        return zipped(folder / f"{site.stem}.shp.zip", sides)
    if kind == "kml":
        return write(folder / "a.kml", [in_degrees(SITE)], "KML", "EPSG:4326")
    if kind == "kmz":
        kml = write(folder / "b.kml", [in_degrees(SITE)], "KML", "EPSG:4326")
        return zipped(folder / "a.kmz", {"doc.kml": kml, "files/photo.jpg": b"no picture"})
    file = folder / "a.wkt"
    file.write_text(f"SRID=32636;{SITE.wkt}\n")
    return file


KINDS = ["geojson", "geojson with crs", "gpkg", "shp", "shp.zip", "kml", "kmz", "wkt"]


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_file_gives_the_same_area(kind: str, tmp_path: Path, wanted: Area) -> None:
    plain = tmp_path / "plain"
    plain.mkdir()
    file = make(kind, plain)
    # Names that pyogrio would take for a way into an archive.
    folder = plain.rename(tmp_path / "a!b.zip")
    for side in folder.glob(f"{file.stem}.*"):
        side.rename(folder / f"Site of 2021!{side.suffix}")
    area = area_of(file=folder / f"Site of 2021!{file.suffix}")
    assert area.datum == wanted.datum
    assert area.survey.symmetric_difference(wanted.survey).area < 1e-3
    assert shapely.hausdorff_distance(area.survey, wanted.survey) < 1e-3
    assert area.no_go.area == pytest.approx(12.5, abs=0.01)


def test_the_files_of_an_area_are_known_with_their_side_files(tmp_path: Path) -> None:
    site = shapefile(tmp_path)
    other = make("kml", tmp_path)
    settings = AreaConfig(file=site, no_go_file=other, allowed_file=other)
    assert {file.name for file in settings.files} == {
        "site.shp", "site.shx", "site.dbf", "site.prj", "site.cpg", "a.kml"
    }  # fmt: skip
    assert len(settings.files) == 6
    assert AreaConfig().files == []


def test_a_file_without_a_system_is_read_by_crs_or_refused(tmp_path: Path, wanted: Area) -> None:
    site = shapefile(tmp_path)
    site.with_suffix(".prj").unlink()
    assert "crs" in refusal(file=site)
    area = area_of(file=site, crs="EPSG:32636")
    assert area.survey.symmetric_difference(wanted.survey).area < 1e-3
    local = shapely.transform(SITE, lambda xy: xy - [700000, 3640000])
    plain = write(tmp_path / "plain.shp", [local], "ESRI Shapefile", geometry_type="Polygon")
    plain.with_suffix(".prj").unlink()
    assert area_of(file=plain, crs="local").survey.bounds == pytest.approx((0, 0, 20, 30))

    file = tmp_path / "old.geojson"
    file.write_text(shapely.to_geojson(SITE))
    assert "crs" in refusal(file=file)
    assert area_of(file=file, crs="EPSG:32636").survey.area == pytest.approx(wanted.survey.area)


def test_layers_are_chosen_by_name(tmp_path: Path, wanted: Area) -> None:
    file = write(tmp_path / "chart.gpkg", [SITE], "GPKG", layer="reef")
    write(file, [SITE.buffer(5)], "GPKG", layer="permit", append=True)
    permit, buoys = tmp_path / "permit.gpkg", tmp_path / "buoys.gpkg"
    write(permit, [SITE.buffer(5)], "GPKG")
    write(buoys, [Point(700020, 3640003)], "GPKG")
    write(file, [Point(700020, 3640003)], "GPKG", layer="buoys", append=True)
    assert " layer" in refusal(file=file)
    assert "wreck" in refusal(file=file, layer="wreck")
    zones = {"allowed_file": permit, "no_go_file": buoys, "no_go_clearance_m": 1.0}
    area = area_of(file=file, layer="reef", **zones)
    assert area.allowed.area > wanted.survey.area
    # The hole (12.5 m2, 15.6 m round) and the disc about the buoy, each 1 m wider.
    assert len(area.no_go.geoms) == 2
    hole, disc = sorted((part.area for part in area.no_go.geoms), reverse=True)
    assert disc == pytest.approx(np.pi, rel=0.02)
    assert 12.5 + 15.6 < hole < 12.5 + 15.6 + 8
    assert "file of its own" in refusal(file=file, layer="reef", no_go_file=file)


def test_mixed_shapes_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = LineString([(700020, 3640003), (700060, 3640003)])
    file = write(tmp_path / "mixed.gpkg", [SITE, line, Point(700000, 3640000)], "GPKG")
    area = area_of(file=file, corridor_width_m=4.0)
    assert "4 m" in capsys.readouterr().err
    assert len(area.survey.geoms) == 1
    both = SITE.union(line.buffer(2, cap_style="flat"))
    assert area.survey.area == pytest.approx(both.area, rel=2e-3)
    buoys = write(tmp_path / "buoys.gpkg", [Point(700000, 3640000)], "GPKG")
    assert "1 point" in refusal(file=buoys)
    write(buoys, [line], "GPKG", layer="cable", append=True)
    assert area_of(file=buoys, corridor_width_m=4.0).survey.area == pytest.approx(160, rel=1e-2)
    assert "'buoys'" in capsys.readouterr().err


def test_a_ring_that_is_not_closed_is_closed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "open.geojson"
    ring = [[34.95, 32.82, -7.0], [34.951, 32.82, -7.0], [34.951, 32.821, -7.0]]
    file.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    area = area_of(file=file)
    assert "open.geojson: feature 1" in capsys.readouterr().err
    closed = [(lat, lon) for lon, lat, _ in ring]
    assert area.survey.area == pytest.approx(area_of(polygon_latlon_deg=closed).survey.area)


def lost(kind: str, places: str) -> tuple[str, bytes, str]:
    """GeoJSON with a triangle, and with something that GDAL passes over."""
    good = '{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}'
    bad = f'{{"type": "{kind}", "coordinates": {places}}}'
    text = f'{{"type": "GeometryCollection", "geometries": [{good}, {bad}]}}'
    return "a.geojson", text.encode(), "of which 1 can"


BOMB = (
    '<!DOCTYPE kml [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
    '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>&b;</name></Document></kml>'
)


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("a.kml", BOMB.encode(), "line 1: declares a DOCTYPE"),
        ("a.kml", ('<?xml version="1.0" encoding="UTF-16"?>' + BOMB).encode("utf-16"), "DOCTYPE"),
        ("a.kml", b"<OGRVRTDataSource/>", "OGRVRTDataSource"),
        ("a.kml", b'<kml xmlns="http://www.opengis.net/kml/2.2"><Document/></kml>', "a.kml"),
        ("a.kml", b'<?xml version="1.0" encoding="cp99"?><kml/>', "a.kml"),
        ("a.geojson", b"<OGRVRTDataSource/>", "line 1"),
        ("a.geojson", b'{"type": "Topology"}', "a.geojson"),
        ("a.geojson", b'{"fileType": "Plan"}', "not recognized"),
        ("a.geojson", b'{"type": ["Polygon"]}', "a.geojson"),
        ("a.geojson", b'{"type": "Polygon", "coordinates": [[[NaN, 0]]]}', "NaN"),
        ("a.geojson", b"[" * 100_000, "a.geojson"),
        ("a.geojson", b'{"type": "FeatureCollection", "features": []}', "a.geojson"),
        ("a.gpkg", b"<OGRVRTDataSource/>", "a.gpkg"),
        ("a.gpkg", b"SQLite format 3\x00 and then nothing", "a.gpkg"),
        ("a.shp", b"<OGRVRTDataSource/>", "a.shp"),
        ("a.shp", b"\x00\x00\x27\x0a" + bytes(96), "cannot be read: Unable to open a.shx or "),
        ("a.kmz", b"", "a.kmz"),
        ("a.wkt", b"\xff", "a.wkt"),
        ("a.wkt", b"POLYGON (0 0", "a.wkt"),
        ("a.wkt", b"GEOMETRYCOLLECTION (" * 50_000, "20 brackets"),
        ("a.wkt", b"SRID=" + b"9" * 40 + b";POLYGON ((0 0, 1 0, 1 1, 0 0))", "EPSG:999"),
        ("a.dxf", b"0", "'.dxf'"),
        ("a.jpg", b"\xff\xd8\xff\xe0", "'.jpg'"),
        ("a.poly", b"", "is empty"),
        ("a.poly", b"reef\n1\n 34.955 32.82\nEND\n", "line 1"),
        ("a.csv", b"lat,lon\n32.8,34.9\n0,0\n", "line 3"),
        ("a.csv", b"lat,lon\n32.8,34.9\n-9999,34.9\n", "line 3"),
        ("a.csv", b"name,depth\na,3\n", "name, depth"),
        ("a.waypoints", b"QGC WPL 110\n", ".poly"),
        ("a.gpx", b"<kml/>", "'kml'"),
        lost("Circle", "[1]"),
        lost("Polygon", "[[0, 0], [1, 0]]"),
        lost("MultiPolygon", "[[0]]"),
    ],
)
def test_files_that_are_not_what_they_say_are_refused(
    name: str, content: bytes, named: str, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    message = refusal(file=file)
    assert named in message
    assert "<DRIVER>" not in message and "SHAPE_RESTORE" not in message


ROUND = [(34.955, 32.8236), (34.9556, 32.8236), (34.9556, 32.824), (34.955, 32.824)]
HOLES = [shapely.box(x, 32.8237, x + 1e-4, 32.8238).exterior.coords for x in (34.9551, 34.9554)]
NEXT = "</innerBoundaryIs><innerBoundaryIs>"


@pytest.mark.parametrize("between", ["", "\n ", NEXT])
def test_every_ring_of_an_inner_boundary_is_a_hole(between: str, tmp_path: Path) -> None:
    file = write(tmp_path / "a.kml", [Polygon(ROUND, HOLES)], "KML", "EPSG:4326")
    text = file.read_text()
    assert NEXT in text
    file.write_text(text.replace(NEXT, between))
    area = area_of(file=file)
    assert len(area.no_go.geoms) == 2
    assert area.no_go.area == pytest.approx(2 * 103.8, rel=1e-3)
    point = "<Point><coordinates>34.955,32.8236</coordinates></Point>"
    for old, new in ((NEXT, "<!-- -->"), ("</Polygon>", f"</Polygon>{point}")):
        file.write_text(text.replace(old, new))
        assert "a.kml" in refusal(file=file)


def test_corners_and_closed_tracks_are_the_same_polygon(tmp_path: Path) -> None:
    ends = [*ROUND, ROUND[0]]
    metres = [TO_UTM.transform(x, y) for x, y in ROUND]
    track, route = (
        "".join(f'<{tag} lat="{y}" lon="{x}"/>' for x, y in ends) for tag in ("trkpt", "rtept")
    )
    texts = {
        "a.csv": "name;lat;lon\n" + "".join(f"x;{y};{x}\n" for x, y in ROUND),
        "a.poly": "#saved\n" + "".join(f"{y} {x}\n" for x, y in ROUND),
        "b.csv": "Easting,Northing\n" + "".join(f"{e:.4f},{n:.4f}\n" for e, n in metres),
        "a.gpx": f"<gpx><trk><trkseg>{track}</trkseg><trkseg/></trk></gpx>",
        "b.gpx": f"<gpx><rte>{route}</rte></gpx>",
    }
    expected = area_of(polygon_latlon_deg=[(y, x) for x, y in ROUND]).survey
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        area = area_of(file=tmp_path / name, crs=UTM if name == "b.csv" else None)
        assert area.survey.symmetric_difference(expected).area < 1e-2
    assert "crs" in refusal(file=tmp_path / "b.csv")


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    assert "none.kml" in refusal(file=tmp_path / "none.kml")
    (tmp_path / "folder.shp").mkdir()
    assert "folder.shp" in refusal(file=tmp_path / "folder.shp")
    assert "a.geojson" in refusal(file=Path("/vsicurl/http:/localhost/a.geojson"))


@pytest.mark.parametrize("ending", [".dbf", ".shx", ".prj", ".cpg"])
def test_a_pipe_next_to_a_shapefile_is_refused(ending: str, tmp_path: Path) -> None:
    side = shapefile(tmp_path).with_suffix(ending)
    side.unlink(missing_ok=True)
    os.mkfifo(side)
    assert f"site{ending} is not a file" in refusal(file=tmp_path / "site.shp")


def test_names_in_an_archive_lead_nowhere(tmp_path: Path, wanted: Area) -> None:
    site = shapefile(tmp_path)
    members: Mapping[str, Path | bytes] = {f"../../{p.name}": p for p in tmp_path.glob("site.*")}
    inner = tmp_path / "deep" / "er"
    inner.mkdir(parents=True)
    file = zipped(inner / "out.shp.zip", members)
    site.unlink()
    before = sorted(tmp_path.rglob("*"))
    assert area_of(file=file).survey.area == pytest.approx(wanted.survey.area, abs=1e-6)
    assert sorted(tmp_path.rglob("*")) == before


def test_archives_that_swell_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kml = make("kml", tmp_path)
    bomb = zipped(tmp_path / "bomb.kmz", {"doc.kml": kml, "padding.bin": bytes(3_000_000)})
    assert bomb.stat().st_size < 20_000
    monkeypatch.setattr(files, "MAX_BYTES", 1_000_000)
    assert "2 files of 3 MB" in refusal(file=bomb)
    many = zipped(tmp_path / "many.kmz", {f"{i}.txt": b"" for i in range(1001)})
    assert "1001 files" in refusal(file=many)
    monkeypatch.setattr(files, "MAX_BYTES", 10)
    assert " 0 MB" in refusal(file=kml)


def test_archives_without_the_one_file_are_refused(tmp_path: Path) -> None:
    kml = make("kml", tmp_path)
    assert "0 KML files" in refusal(file=zipped(tmp_path / "a.kmz", {"a.txt": b"x"}))
    two = zipped(tmp_path / "b.kmz", {"a.kml": kml, "b.kml": kml})
    assert "2 KML files" in refusal(file=two)
    assert ".shp" in refusal(file=zipped(tmp_path / "c.zip", {"a.kml": kml}))
    site = shapefile(tmp_path)
    same = zipped(tmp_path / "d.zip", {"a/site.shp": site, "b/site.shp": site})
    assert "d.zip" in refusal(file=same)
    one = zipped(tmp_path / "e.kmz", {"doc.kml": kml})
    broken = bytearray(one.read_bytes())
    broken[60:80] = bytes(20)
    one.write_bytes(broken)
    assert "'doc.kml'" in refusal(file=one)


def test_several_shapefiles_in_a_zip_are_layers(tmp_path: Path, wanted: Area) -> None:
    shapefile(tmp_path, "reef")
    shapefile(tmp_path, "other")
    file = zipped(tmp_path / "both.zip", {p.name: p for p in list(tmp_path.iterdir())})
    assert "'other', 'reef'" in refusal(file=file)
    area = area_of(file=file, layer="reef")
    assert area.survey.area == pytest.approx(wanted.survey.area, abs=1e-6)


def test_too_many_corners_are_refused(tmp_path: Path) -> None:
    angle = np.linspace(0, 2 * np.pi, 200_002)
    ring = Polygon(np.column_stack([50 * np.cos(angle), 50 * np.sin(angle)]))
    file = tmp_path / "coast.wkt"
    file.write_text(ring.wkt)
    assert "200000" in refusal(file=file)


DOC = (Path(__file__).parents[3] / "docs" / "areas.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("example", re.findall(r"```toml\n(.*?)```", DOC, re.DOTALL))
def test_an_example_gives_an_area_without_a_warning(
    example: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reef = shapely.box(34.9553, 32.8236, 34.9556, 32.8239)
    for layer in ("reef", "permit"):
        more = {"layer": layer, "append": layer == "permit"}
        write(tmp_path / "reef.gpkg", [reef], "GPKG", "EPSG:4326", **more)
    mark = Point(34.9554, 32.8238)
    (tmp_path / "wreck.geojson").write_text(shapely.to_geojson(mark))
    (tmp_path / "survey.toml").write_text(example)
    area = survey_area(load_config(tmp_path / "survey.toml").area, turn_margin_m=3.0)
    assert area.survey.area > 100
    assert area.allowed.area > area.survey.area * 0.999
    assert capsys.readouterr().err == ""
