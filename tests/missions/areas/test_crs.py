import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Transformer
from shapely.geometry import Polygon

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Datum
from missions.areas.crs import LocalFrame
from tests.missions.areas.sites import area_of

WGS84 = Geod(ellps="WGS84")


def frame_at(latitude_deg: float, longitude_deg: float, depth_m: float) -> LocalFrame:
    datum = Datum(latitude_deg, longitude_deg)
    return LocalFrame(datum=datum, seafloor_depth_m=depth_m, datum_is_given=True)


@given(
    latitude_deg=st.floats(-85, 85),
    longitude_deg=st.floats(-180, 180),
    depth_m=st.floats(1, 6000),
    north_m=st.floats(-14_000, 14_000),
    east_m=st.floats(-14_000, 14_000),
)
def test_places_on_the_sea_floor_come_back(
    latitude_deg: float, longitude_deg: float, depth_m: float, north_m: float, east_m: float
) -> None:
    frame = frame_at(latitude_deg, longitude_deg, depth_m)
    point = np.array([[north_m, east_m]])
    again = frame.ne_from_latlon(frame.latlon_from_ne(point))
    np.testing.assert_allclose(again, point, atol=1e-6)


# UTM north and south, a Transverse Mercator with east last in its definition, Lambert's conic,
# Mercator across the date line, polar stereographic, and degrees in either order of axes.
@pytest.mark.parametrize(
    ("crs", "latitude_deg", "longitude_deg"),
    [
        ("EPSG:32636", 32.82, 34.95),
        ("EPSG:32760", -45.0, 179.9999),
        ("EPSG:2193", -41.3, 174.8),
        ("EPSG:3035", 50.0, 10.0),
        ("EPSG:3832", 10.0, 180.0),
        ("EPSG:3995", 82.0, 30.0),
        ("EPSG:4326", 32.82, 34.95),
        ("OGC:CRS84", 32.82, 34.95),
        ("+proj=aeqd +lat_0=32.8 +lon_0=35 +datum=WGS84", 32.82, 34.95),
    ],
)
def test_any_system_comes_back_within_a_millimetre(
    crs: str, latitude_deg: float, longitude_deg: float
) -> None:
    frame = frame_at(latitude_deg, longitude_deg, 15.0)
    wanted = np.array([[0, 0], [80, 10], [70, 90], [10, 60]], float)
    lat, lon = frame.latlon_from_ne(wanted).T
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    wkt = Polygon(np.column_stack([x, y])).wkt
    area = area_of(wkt=wkt, crs=crs, latitude_deg=latitude_deg, longitude_deg=longitude_deg)
    (polygon,) = area.survey.geoms
    np.testing.assert_allclose(np.asarray(polygon.exterior.coords)[:-1], wanted, atol=1e-3)


@settings(max_examples=50)
@given(
    latitude_deg=st.floats(-84, 84),
    longitude_deg=st.floats(-180, 180),
    size_m=st.floats(10, 4000),
    turn_deg=st.floats(0, 90),
)
def test_areas_are_those_on_the_ellipsoid(
    latitude_deg: float, longitude_deg: float, size_m: float, turn_deg: float
) -> None:
    azimuths = turn_deg + np.arange(5) * 72.0
    start = (np.full(5, longitude_deg), np.full(5, latitude_deg))
    lon, lat, _ = WGS84.fwd(*start, azimuths, np.full(5, size_m))
    expected_m2 = abs(WGS84.polygon_area_perimeter(lon, lat)[0])
    # At 1 m depth, so that what the Earth's roundness takes from areas below is 3e-7.
    area = area_of(polygon_latlon_deg=tuple(zip(lat, lon, strict=True)), seafloor_depth_m=1.0)
    assert area.survey.area == pytest.approx(expected_m2, rel=1e-4)


def test_the_datum_of_an_area_across_the_date_line_is_its_middle() -> None:
    corners = np.array([[179.999, 10.0], [-179.998, 10.0], [-179.998, 10.001], [179.999, 10.001]])
    plain = area_of(wkt=Polygon(corners).wkt, crs="EPSG:4326")
    assert plain.datum == Datum(10.0005, -179.9995)
    east = corners.copy()
    east[:, 0] %= 360.0
    further = area_of(wkt=Polygon(east).wkt, crs="EPSG:4326")
    assert further.survey.area == pytest.approx(plain.survey.area)
    halves = (
        "MULTIPOLYGON (((179.999 10, 180 10, 180 10.001, 179.999 10.001, 179.999 10)),"
        "((-180 10, -179.998 10, -179.998 10.001, -180 10.001, -180 10)))"
    )
    joined = area_of(wkt=halves, crs="EPSG:4326")
    assert len(joined.survey.geoms) == 1
    assert joined.survey.area == pytest.approx(plain.survey.area, rel=1e-6)
    width_m = WGS84.inv(179.999, 10.0, -179.998, 10.0)[2]
    assert plain.survey.bounds[3] - plain.survey.bounds[1] == pytest.approx(width_m, rel=1e-5)


@pytest.mark.parametrize(
    ("wkt", "crs", "named"),
    [
        ("POLYGON ((0 86, 0.01 86, 0.01 86.1, 0 86))", "EPSG:4326", "corner 1 at (86, "),
        ("POLYGON ((32 134, 32 134.1, 32.1 134, 32 134))", "EPSG:4326", "134"),
        ("POLYGON ((7e5 3.6e6, 7.1e5 3.6e6, 7.1e5 3.61e6, 7e5 3.6e6))", "EPSG:4326", "700000"),
        ("POLYGON ((0 0, 1e30 0, 0 1, 0 0))", "EPSG:32636", "UTM zone 36N"),
        ("POLYGON ((0 0, 1 0, 0 1, 0 0))", "EPSG:999999", "'EPSG:999999'"),
        ("POLYGON ((0 0, 1 0, 0 1, 0 0))", "EPSG:5773", "crs"),
        ("POLYGON ((0 0, 1 0, 0 1, 0 0))", "EPSG:4978", "crs"),
        ("POLYGON ((0 0, 1 0, nan 1, 0 0))", "EPSG:32636", "(1, nan)"),
    ],
)
def test_coordinates_that_cannot_be_are_refused_with_the_corner(
    wkt: str, crs: str, named: str
) -> None:
    with pytest.raises(PlanError) as fault:
        area_of(wkt=wkt, crs=crs)
    assert named in str(fault.value)
    assert "\n" not in str(fault.value)


def test_depth_moves_corners_together_as_the_earth_is_round() -> None:
    corners = ((32.0, 34.0), (32.01, 34.0), (32.0, 34.01))
    shallow, deep = (
        area_of(polygon_latlon_deg=corners, seafloor_depth_m=depth_m).survey.area
        for depth_m in (10.0, 4010.0)
    )
    assert deep / shallow == pytest.approx((1 - 4000 / 6.371e6) ** 2, rel=1e-5)
