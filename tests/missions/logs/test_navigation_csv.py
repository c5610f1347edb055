import re
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from alice_survey.core.errors import NavigationError, keep_warnings
from missions.logs.navigation_csv import find_zone, read_navigation, warn_of_gaps
from tests.refusals import refused

HEADER = "time_s,latitude_deg,longitude_deg,depth_m,heading_deg,altitude_m"


def log_file(folder: Path, *rows: str, header: str = HEADER) -> Path:
    path = folder / "nav.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8-sig")
    return path


def test_values_lie_on_the_line_between_rows(tmp_path: Path) -> None:
    path = log_file(tmp_path, "0,60.0,5.0,10,350,2.0", "1,60.2,5.4,12,10,3.0", "2,60.4,5.4,12,30,")
    log = read_navigation(path, UTC)
    found = log.at(np.array([0.5, 1.0, 1.5]))
    np.testing.assert_allclose(found["latitude_deg"], [60.1, 60.2, 60.3])
    np.testing.assert_allclose(found["depth_m"], [11, 12, 12])
    np.testing.assert_allclose(found["heading_deg"], [0, 10, 20], atol=1e-9)  # the short way
    np.testing.assert_allclose(found["altitude_m"], [2.5, 3.0, np.nan])


def test_nothing_is_made_up_beyond_the_log_or_in_gaps(tmp_path: Path) -> None:
    rows = [f"{t},60,5,{t},0,2" for t in (0, 1, 2, 3, 20, 21)]
    log = read_navigation(log_file(tmp_path, *rows), UTC)
    assert log.max_gap_s == 5.0
    depth = log.at(np.array([-0.1, 2.5, 3.0, 10.0, 20.5, 21.1, np.nan]))["depth_m"]
    np.testing.assert_allclose(depth, [np.nan, 2.5, 3.0, np.nan, 20.5, np.nan, np.nan])


def test_bad_rows_are_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = log_file(
        tmp_path,
        "0,60,5,1,0,2",
        "1,nan,5,1,0,2",
        "2,60,5,x,0,2",
        "3,60,5,3,nan,2",
        "2.5,60,5,3,0,2",
        "4,97,5,4,0,2",
        "5,60,5,5,0,2",
    )
    log = read_navigation(path, UTC)
    np.testing.assert_allclose(log.time_s, [0, 3, 5])
    assert np.isnan(log.columns["heading_deg"][1])
    warned = capsys.readouterr().err
    assert warned.count("\n") == 1
    for line in (3, 4, 5, 6, 7):
        assert f"line {line}: " in warned


@pytest.mark.parametrize(
    ("cells", "named"),
    [("60,5,3_2,0,2", "'3_2'"), ("60,5,1e308,0,2", "depth_m"), ("60,5,1,0,-999", "altitude_m")],
)
def test_numbers_that_are_none_or_cannot_be_are_not_taken(
    cells: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = read_navigation(log_file(tmp_path, "0,60,5,1,0,2", f"1,{cells}", "2,60,5,1,0,2"), UTC)
    assert not np.isin([32, 1e308, -999], [*log.columns.values()]).any()
    assert named in capsys.readouterr().err


def test_decimal_commas_between_commas_are_refused(tmp_path: Path) -> None:
    with pytest.raises(NavigationError, match="decimal commas"):
        read_navigation(log_file(tmp_path, "0,5,60,2,5,1,10,2,0"), UTC)
    assert read_navigation(log_file(tmp_path, "0,60,5,1,0,2,, "), UTC).columns["depth_m"] == [1]


def test_rows_of_one_fault_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [f"{t},{'nan' if 10 <= t < 50 else 60},5,1,{'x' if t in (5, 6, 8) else 0},2"
            for t in range(60)]  # fmt: skip
    read_navigation(log_file(tmp_path, *rows, "3,60,5,1,0,2"), UTC)
    parts = capsys.readouterr().err.split("left out ")[1].split("; ")
    assert [part.split(":")[0] for part in parts] == [
        "3 lines from 7 on", "40 lines from 12 on", "line 62",
    ]  # fmt: skip


@pytest.mark.parametrize(("depths", "said"), [("-4.0 -3.5", 1), ("-4.0 ", 1), ("-0.1 3.5", 0)])
def test_depths_that_are_heights_are_noticed(tmp_path: Path, depths: str, said: int) -> None:
    path = tmp_path / "log.csv"
    rows = (f"{i},32.8,35.0,{one}" for i, one in enumerate(depths.split(" ")))
    path.write_text("\n".join(["time_s,latitude_deg,longitude_deg,depth_m", *rows, ""]))
    with keep_warnings() as warnings:
        read_navigation(path, UTC, ())
    assert len(warnings) == said


def test_dates_obey_their_own_zone_else_the_one_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Between dots a day comes first; what a time without a zone is taken for is said."""
    header = "time_utc,latitude_deg,longitude_deg,depth_m"
    rows = ["2024-07-01T10:00:02.5+00:00,60,5,2", "01.07.2024 12:00:05,60,5,1"]
    rows += ["01/07/2024 12:00:06,60,5,1", "13/07/2024 12:00:05,60,5,1"]  # the first may be January
    path = log_file(tmp_path, "2024-07-01 12:00:00,60,5,1", *rows, header=header)
    log = read_navigation(path, find_zone("Europe/Oslo"))
    assert log.start_utc == datetime(2024, 7, 1, 10, tzinfo=UTC)
    np.testing.assert_allclose(log.time_s, [0, 2.5, 5.0, 12 * 86400.0 + 5.0])
    assert "2024-07-01 10:00:00 UTC" in capsys.readouterr().err
    read_navigation(log_file(tmp_path, rows[0], header=header), UTC)
    assert not capsys.readouterr().err
    assert find_zone("Europe/Oslo") == ZoneInfo("Europe/Oslo")


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("latitude_deg,longitude_deg,depth_m", []),
        ("time_s,latitude_deg,longitude_deg", []),
        (HEADER, []),
        (HEADER, ["0,nan,5,1,0,2"]),
        ('"a\nb",c', ["1,2"]),
    ],
)
def test_a_useless_log_gives_one_line(tmp_path: Path, header: str, rows: list[str]) -> None:
    with refused(NavigationError):
        read_navigation(log_file(tmp_path, *rows, header=header), UTC)


def test_pictures_without_navigation_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = read_navigation(log_file(tmp_path, "0,60,5,1,0,2", "1,60,5,1,0,2"), UTC)
    warn_of_gaps(["a.jpg", "b.jpg"], np.array([0.5, 9.0]), np.array([1.0, np.nan]), log)
    warned = capsys.readouterr().err
    assert "b.jpg" in warned
    assert "a.jpg" not in warned


def test_any_one_reading_is_enough_where_none_is_needed(tmp_path: Path) -> None:
    path = log_file(tmp_path, "0,5.0,", "1,,90", "2,6.0,x", header="time_s,depth_m,heading_deg")
    log = read_navigation(path, UTC, ())
    np.testing.assert_array_equal(log.columns["depth_m"], [5.0, np.nan, 6.0])
    np.testing.assert_array_equal(log.columns["heading_deg"], [np.nan, 90.0, np.nan])
    with pytest.raises(NavigationError, match="none of the columns latitude_deg"):
        read_navigation(log_file(tmp_path, "0,1", header="time_s,sigma_depth_m"), UTC, ())


def test_each_reading_has_gaps_of_its_own(tmp_path: Path) -> None:
    """Depths every second; fixes every 8 s, then none for two minutes."""
    fixes = {8 * k: 60.0 + 0.08 * k for k in (*range(12), *range(27, 33))}
    rows = [f"{t},{fixes.get(t, '')},{5 if t in fixes else ''},{0.1 * t}" for t in range(260)]
    header = "time_s,latitude_deg,longitude_deg,depth_m"
    found = read_navigation(log_file(tmp_path, *rows, header=header), UTC, ()).at(
        np.array([12.5, 150.0, 220.0])
    )
    np.testing.assert_allclose(found["latitude_deg"], [60.125, np.nan, 62.2])
    np.testing.assert_allclose(found["depth_m"], [1.25, 15.0, 22.0])


DATES = ["2024-07-06T10:00:00Z", "2024-07-06T10:00:05Z"]
FOREIGN = {
    "usual names": (",", "time_utc,lat,Longitude (deg),Depth,yaw_deg,altitude", DATES),
    "prefixes": (",", "timestamp,pose.lat,gps.lon,pose.dep,nav.heading,pose.alt", DATES),
    "decimal commas": (";", "Timestamp;LATITUDE;lon;depth [m];HDG;alt_m", DATES),
    "since 1970": ("\t", "time_s\tlat\tlon\tdepth\thdg\talt", ["1720260000", "1720260005"]),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
@pytest.mark.parametrize("kind", FOREIGN)
def test_tables_of_other_programs_are_read(tmp_path: Path, kind: str, encoding: str) -> None:
    mark, header, times = FOREIGN[kind]
    rows = [[time, "60.25", "5.5", "3.5", "90", "2.25", "Épave"] for time in times]
    text = "\n".join(mark.join(row) for row in [[*header.split(mark), "site"], *rows])
    path = tmp_path / "n.csv"
    path.write_text(text if mark == "," else text.replace(".", ","), encoding=encoding)
    log = read_navigation(path, UTC)
    assert log.start_utc == datetime(2024, 7, 6, 10, tzinfo=UTC)
    np.testing.assert_allclose(log.time_s, [0, 5])
    found = {name: list(values) for name, values in log.columns.items()}
    assert found == {
        "latitude_deg": [60.25] * 2, "longitude_deg": [5.5] * 2, "depth_m": [3.5] * 2,
        "heading_deg": [90] * 2, "altitude_m": [2.25] * 2,
    }  # fmt: skip


def test_columns_that_are_not_read_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An altitude without a depth may be above the sea."""
    header = "time_s,depth_mm,east_m,altitude,heading_rad,roll_deg"
    read_navigation(log_file(tmp_path, "0,60,5,1,0,2", header=header), UTC, ())
    warned = capsys.readouterr().err
    assert all(name in warned for name in (*header.split(",")[1:5], "depth_m", "latitude_deg"))
    assert "roll" not in warned and warned.count("\n") == 1
    with refused(NavigationError, "occurs twice"):
        read_navigation(log_file(tmp_path, "0,60,5", header="time_s,depth_m,depth_m"), UTC, ())


DIVES = {
    "Subsurface": (
        '"dive number","date","time","sample time (min)","sample depth (m)","sample heartrate"',
        [f'"7","2024-07-06","10:00:00","{cells}' for cells in ('0:20","3.5",""', '61:40","8",""',
                                                               '0:01","0",""')],
    ),
    "unicsv": (
        "No,Latitude,Longitude,Depth,Date,Time",
        ["1,60,5,3.5,2024/07/06,10:00:20", "2,60,5,8,2024/07/06,11:01:40"],
    ),
    "hours and feet": (
        "date,time,sample time,depth (ft),depth",
        ["2024-07-06,10:00,0:00:20,9,3.5", "2024-07-06,10:00,1:01:40,9,8"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", DIVES)
def test_dive_computers_give_depths(tmp_path: Path, kind: str) -> None:
    """Subsurface ends a dive with a row of its own at one second."""
    header, rows = DIVES[kind]
    log = read_navigation(log_file(tmp_path, *rows, header=header), find_zone("Europe/Oslo"), ())
    assert log.start_utc == datetime(2024, 7, 6, 8, 0, 20, tzinfo=UTC)
    np.testing.assert_allclose(log.time_s, [0, 3680])
    np.testing.assert_allclose(log.columns["depth_m"], [3.5, 8.0])


@pytest.mark.parametrize("cells", ["0,0,7,3", "60,5,-9999,3", "60,5,nan,3", "60,5,1e6,3"])
def test_what_stands_for_unknown_is_no_value(tmp_path: Path, cells: str) -> None:
    header = "time_s,latitude_deg,longitude_deg,depth_m,altitude_m"
    log = read_navigation(log_file(tmp_path, f"0,{cells}", header=header), UTC, ())
    known = {name for name, values in log.columns.items() if np.isfinite(values).all()}
    lost = {"latitude_deg", "longitude_deg"} if cells.startswith("0,0") else {"depth_m"}
    assert known == {*header.split(",")[1:]} - lost


def test_positions_by_the_names_of_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Metashape exports them; a name with its folder comes before one without."""
    header = '# CoordinateSystem: GEOGCS["WGS 84",\n# 3 cameras\n#'
    header += "SourceFile,X/Longitude,Y/Latitude,Z/Altitude,Yaw"
    rows = ["IMG_2.JPG,5.5,60,-3,350", "dive2\\img_1.jpg,6,61,-4,10", "IMG_1,7,62,-5,-20"]
    log = read_navigation(log_file(tmp_path, *rows, header=header), UTC, (), by_picture=True)
    time_s, found = log.of_pictures(["a/dive1/IMG_1.png", "dive2/IMG_1.JPG", "img_2.jpg", "IMG_3"])
    assert np.isnan(time_s).all()
    np.testing.assert_allclose(found["latitude_deg"], [62, 61, 60, np.nan])
    np.testing.assert_allclose(found["depth_m"], [5, 4, 3, np.nan])
    np.testing.assert_allclose(found["heading_deg"], [340, 10, 350, np.nan])
    assert {"GEOGCS", "cameras"} <= set(re.findall(r"\w+", capsys.readouterr().err))
    with refused(NavigationError, "line 7: a second row"):
        rows = [*rows, "img_2.png,1,1,1,1"]
        read_navigation(log_file(tmp_path, *rows, header=header), UTC, (), by_picture=True)


@pytest.mark.parametrize(
    ("system", "x", "y"),
    [
        ("EPSG:4326", 34.955, 32.8236), ("WGS84 UTM 36N", 683005.264, 3633424.290),
        ("+proj=utm +zone=36 +datum=WGS84 +units=m +no_defs", 683005.264, 3633424.290),
    ],
)  # fmt: skip
def test_geo_txt_of_open_drone_map(tmp_path: Path, system: str, x: float, y: float) -> None:
    """Heights are up; angles and accuracies of 0 are unknown, and so is a place of 0, 0."""
    rows = [
        f"A.JPG {x} {y} -5.5 350 2 1 0.5 0.2", f"b.jpg\t{x} {y} -6 0 0 0 3.0 0",
        "# a comment", "", "c.jpg 0 0 -7 0 0 0 0 0", "D.JPG north 2 -8 10 0 0 0 0",
    ]  # fmt: skip
    log = read_navigation(log_file(tmp_path, *rows, header=system), UTC, (), by_picture=True)
    found = log.of_pictures(["in/a.png", "B.jpg", "c.jpg", "d.jpg"])[1]
    expected = {
        "latitude_deg": [32.8236, 32.8236, np.nan, np.nan],
        "longitude_deg": [34.955, 34.955, np.nan, np.nan], "depth_m": [5.5, 6, 7, 8],
        "heading_deg": [350, np.nan, np.nan, 10], "roll_deg": [1, np.nan, np.nan, 0],
        "sigma_horizontal_m": [0.5, 3, np.nan, np.nan],
        "sigma_depth_m": [0.2, np.nan, np.nan, np.nan],
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, atol=1e-7)


def test_geo_txt_says_what_is_not_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = log_file(tmp_path, "a.jpg 5 60 -3 0.02 0.05", header="EPSG:4326")
    log = read_navigation(path, UTC, (), by_picture=True)
    assert {*log.columns} == {"latitude_deg", "longitude_deg", "depth_m"}
    assert "not read" in capsys.readouterr().err
    for header, named in (
        ("EPSG:1", "EPSG:1"),
        ('LOCAL_CS["site"]', "time_s"),
        ("EPSG:4326", "reading"),
    ):
        with refused(NavigationError, named):
            rows = ["a.jpg 5"] if header == "EPSG:4326" else ["a.jpg 5 60 -3"]
            read_navigation(log_file(tmp_path, *rows, header=header), UTC, (), by_picture=True)
