"""Ground control as ODM and Metashape write it arrives as points and picks of the workspace."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from alice_survey.core.artefacts import StaleError, write_json
from alice_survey.core.errors import WorkspaceError, collected_by, keep_warnings
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from reconstruct.placing.control_command import import_control
from reconstruct.placing.control_points import (
    Pick,
    coordinates,
    read_control,
    read_picks,
    save_control,
    save_picks,
    table_token,
)

PLACES = {
    "A": (46.8426, -91.9946, -12.5),
    "B": (46.8431, -91.9939, -13.0),
    "C": (46.8424, -91.9931, -12.0),
}
"""Latitude, longitude and height of points."""
PICKS = [("DJI_1", "A", 100.0, 200.5), ("DJI_2", "A", 40.25, 7.0), ("DJI_2", "B", 300.0, 20.0),
         ("DJI_1", "C", 3.5, 9.0), ("DJI_2", "C", 5.0, 6.0)]  # fmt: skip
NAMES = ("camera/DJI_1.jpg", "camera/DJI_2.jpg")


def utm(latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Easting and northing in zone 15 north: Kruger's series to the third order (Karney 2011)."""
    a, f = 6_378_137.0, 1 / 298.257223563
    n = f / (2 - f)
    size = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240,
    )  # fmt: skip
    phi, lam = math.radians(latitude_deg), math.radians(longitude_deg + 93.0)
    e = 2 * math.sqrt(n) / (1 + n)
    t = math.sinh(math.atanh(math.sin(phi)) - e * math.atanh(e * math.sin(phi)))
    xi, eta = math.atan2(t, math.cos(lam)), math.atanh(math.sin(lam) / math.hypot(1.0, t))
    east, north = eta, xi
    for j, c in enumerate(alpha, 1):
        east += c * math.cos(2 * j * xi) * math.sinh(2 * j * eta)
        north += c * math.sin(2 * j * xi) * math.cosh(2 * j * eta)
    return 500_000 + 0.9996 * size * east, 0.9996 * size * north


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    return workspace_of(tmp_path / "reef", NAMES)


def workspace_of(folder: Path, names: tuple[str, ...]) -> Path:
    records = [
        ImageRecord(image=name, camera=name.split("/", maxsplit=1)[0], station=i)
        for i, name in enumerate(names)
    ]
    (folder / "images").mkdir(parents=True)
    write_manifest(folder / "images" / "manifest.csv", records)
    write_json(folder / "images" / "stage.json", {"stage": "images", "digest": ""})
    return folder


def gcp_list(path: Path, system: str = "WGS84 UTM 15N", *, named: bool = True) -> Path:
    lines = [system, "# a comment", ""]
    for picture, point, x, y in PICKS:
        latitude, longitude, height = PLACES[point]
        east, north = utm(latitude, longitude)
        lines.append(
            f"{east:.4f}\t{north:.4f} {height} {x} {y} {picture}.JPG"
            + (f" {point}" if named else "")
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def markers_xml(path: Path, **changes: str) -> Path:
    """What Metashape writes, with B unticked and one marker place that is only expected.

    `system` and `settings` stand in for the chunk's own.
    """
    text = (Path(__file__).parents[2] / "data" / "metashape_markers.xml").read_text()
    for name, tag in (("system", "reference"), ("settings", "settings")):
        pattern = re.compile(f"<{tag}>.*</{tag}>", re.DOTALL)
        text = pattern.sub(changes.get(name, r"\g<0>"), text)
    path.write_text(text)
    return path


def points_of(workspace: Path) -> dict[str, Any]:
    return {point.name: point for point in read_control(workspace / "control.csv").points}


def check_places(workspace: Path) -> None:
    found = points_of(workspace)
    assert set(found) == set(PLACES)
    for name, (latitude, longitude, height) in PLACES.items():
        point = found[name]
        metres = (
            np.deg2rad([point.latitude_deg - latitude, point.longitude_deg - longitude]) * 6.4e6
        )
        assert np.abs(metres).max() < 2e-4
        assert point.depth_m == pytest.approx(-height)


def picks_of(workspace: Path) -> Array:
    picks = read_picks(workspace / "picks.csv")
    order = [(f"camera/{p}.jpg", point) for p, point, _, _ in PICKS]
    by = {(pick.image, pick.point): pick for pick in picks}
    assert len(by) == len(picks) == len(PICKS)
    return np.array([[by[key].x_px, by[key].y_px] for key in order])


def test_odm_lists_give_points_where_they_are_and_picks_to_the_pixel(
    workspace: Path, tmp_path: Path
) -> None:
    found = import_control(workspace, gcp_list(tmp_path / "gcp_list.txt"), sigma_m=0.02)
    check_places(workspace)
    np.testing.assert_allclose(picks_of(workspace), [[x, y] for _, _, x, y in PICKS], atol=1e-9)
    assert found == "3 points, 5 picks in 2 pictures"
    assert {p.sigma_m for p in points_of(workspace).values()} == {0.02}


def test_rows_without_names_are_one_point_by_place(workspace: Path, tmp_path: Path) -> None:
    path = gcp_list(tmp_path / "gcp_list.txt", named=False)
    import_control(workspace, path, sigma_m=0.02, sigma_vertical_m=0.04)
    assert sorted(points_of(workspace)) == ["P1", "P2", "P3"]
    assert points_of(workspace)["P1"].sigma_vertical_m == 0.04
    assert [p.point for p in read_picks(workspace / "picks.csv")] == ["P1", "P1", "P2", "P3", "P3"]


def test_metashape_markers_keep_their_accuracies_and_checks(
    workspace: Path, tmp_path: Path
) -> None:
    found = import_control(workspace, markers_xml(tmp_path / "markers.xml"))
    check_places(workspace)
    np.testing.assert_allclose(picks_of(workspace), [[x, y] for _, _, x, y in PICKS], atol=1e-9)
    # What is not pinned is no pick.
    assert found == "3 points (1 of them to check by), 5 picks in 2 pictures"
    points = points_of(workspace)
    assert [points[n].use for n in "ABC"] == ["control", "check", "control"]
    assert [points[n].sigma_m for n in "ABC"] == [0.01, 0.01, 0.03]
    assert points["C"].sigma_vertical_m == 0.05
    assert {p.sigma_px for p in read_picks(workspace / "picks.csv")} == {0.8}


def test_heights_of_the_ellipsoid_stay_heights(workspace: Path, tmp_path: Path) -> None:
    import_control(workspace, markers_xml(tmp_path / "m.xml"), heights="ellipsoid")
    assert points_of(workspace)["A"].height_m == -12.5
    assert math.isnan(points_of(workspace)["A"].depth_m)


def test_a_local_grid_has_north_and_east(workspace: Path, tmp_path: Path) -> None:
    local = '<reference>LOCAL_CS["Local",LOCAL_DATUM["Local",0],UNIT["metre",1]]</reference>'
    path = markers_xml(tmp_path / "m.xml", system=local)
    import_control(workspace, path)
    point = points_of(workspace)["A"]
    assert (point.north_m, point.east_m, point.depth_m) == (46.8426, -91.9946, 12.5)
    with pytest.raises(WorkspaceError, match="local grid"):
        import_control(workspace, path, heights="ellipsoid", overwrite=True)


def test_pictures_of_a_rig_are_told_apart_by_their_folder(tmp_path: Path) -> None:
    workspace = workspace_of(tmp_path / "w", ("left/1.png", "right/1.png", "left/2.png"))
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        "EPSG:4326\n-91 46 1 10 20 left/1.png A\n-91 46 1 11 21 right\\1.png A\n"
        "-91 46 1 12 22 2.png A\n-91 46 1 13 23 1.png A\n-91 46 1 13 23 9.png A\n"
    )
    warnings: list[str] = []
    with collected_by(lambda _, text: warnings.append(text)):
        import_control(workspace, path, sigma_m=0.1)
    assert [p.image for p in read_picks(workspace / "picks.csv")] == [
        "left/1.png", "right/1.png", "left/2.png",
    ]  # fmt: skip
    assert any("1.png, 9.png" in line for line in warnings)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("EPSG:4326\n-91 46 1 10 20 DJI_1.jpg A\n", "--sigma"),
        ("EPSG:4326\n-91 46 1 10 DJI_1.jpg\n", "line 2: 5 fields"),
        ("EPSG:999999\n-91 46 1 10 20 DJI_1.jpg\n", "no coordinate system"),
        ("EPSG:4326\n46 -91 1 10 20 DJI_1.jpg\n", "exchanged"),
        ("WGS84 UTM 30U\n683000 3633500 1 10 20 DJI_1.jpg\n", "EPSG:32630"),
        (
            "EPSG:4326\n-91 46 1 10 20 x.jpg A\n-91 47 1 1 2 x.jpg A\n",
            "line 3: point A has another",
        ),
        ("EPSG:4326\n-91 46 nan 10 20 DJI_1.jpg A\n", "no point has a place"),
        ("easting northing\n1 2\n", "neither a gcp_list.txt.*control.csv"),
        ("<document><chunk><markers></chunk>", "not valid XML"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><document><markers/></document>', "DOCTYPE"),
        ("<document><chunk><markers/></chunk></document>", "no coordinate system"),
    ],
)
def test_faults_are_named_in_one_line(
    workspace: Path, tmp_path: Path, text: str, named: str
) -> None:
    path = tmp_path / "control.txt"
    path.write_text(text)
    with pytest.raises(WorkspaceError, match=named) as fault:
        import_control(workspace, path)
    assert "\n" not in str(fault.value)
    assert not (workspace / "control.csv").exists()


SCALEBARS = (
    '<scalebars next_id="4"><scalebar id="0" label="short" {ends}>'
    '<reference distance="0.5" accuracy="0.0002" enabled="true"/></scalebar>'
    '<scalebar id="1" label="A_C"><reference distance="81.5" enabled="false"/></scalebar>'
    '<scalebar id="2" label="B_D"><reference distance="1.5"/></scalebar>'
    '<scalebar id="3" label="B_C"/>'
    '<scalebar id="4" label="A_B"><reference distance=" "/></scalebar></scalebars>'
)


@pytest.mark.parametrize("placed", [True, False])
@pytest.mark.parametrize("ends", ['marker_id1="0" marker_id2="1"', 'marker1="0" marker2="1"'])
def test_scale_bars_of_metashape_become_bars(workspace: Path, ends: str, placed: bool) -> None:
    path = workspace / "markers.xml"
    settings = (
        '<settings><property name="accuracy_markers" value="0.01"/>'
        '<property name="accuracy_scalebars" value="0.004"/></settings>'
    )
    markers_xml(path, settings=settings + SCALEBARS.format(ends=ends))
    if not placed:  # a diver's reef: bars, and no place of any marker
        text = re.sub(r'<reference x="[^>]*/>', "", path.read_text())
        path.write_text(re.sub(r"<reference>.*?</reference>", "", text))
    with keep_warnings() as said:
        found = import_control(workspace, path)
    counts = (3, 2) if placed else (0, 1)
    assert found.startswith("{} points, 2 scale bars ({} of them to check by)".format(*counts))
    assert any("B_D, B_C, A_B" in text for text in said)
    lengths = {bar.name: bar for bar in read_control(workspace / "control.csv").lengths}
    assert set(lengths) == {"short", "A_C"}
    short, long = lengths["short"], lengths["A_C"]
    assert (short.ends, short.length_m, short.sigma_m, short.use) == (
        ("A", "B"), 0.5, 0.0002, "control",
    )  # fmt: skip
    assert (long.ends, long.length_m, long.sigma_m, long.use) == (
        ("A", "C"), 81.5, 0.004, "check",
    )  # fmt: skip
    assert {pick.point for pick in read_picks(workspace / "picks.csv")} == {"A", "B", "C"}


def pick(image: str, point: str, x: float = 10.0, y: float = 20.0, **more: object) -> Pick:
    values = {"sigma_px": 0.3, "matched_to": "", **more}
    return Pick(image=image, point=point, x_px=x + 0.5, y_px=y + 0.5, **values)  # type: ignore[arg-type]


def test_other_rows_comments_and_columns_stay_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    kept = (
        "# seen by Ada, at noon\r\n"
        'left/a.png, p1 ,1.50,2,0.5,"said ""maybe"", twice"\r\n'
        "left/b.png,p2,,,,to look for\r\n"
    )
    path.write_bytes(
        ("image,point,x,y,sigma_px,note\r\n" + kept + "left/b.png,p2,5,6,,mine\r\n").encode()
    )

    save_picks(
        path, table_token(path),
        [pick("left/b.png", "p2", 7.25, 8.0), pick("right/b.png", "p2", matched_to="left/b.png")],
        {"p2"},
    )  # fmt: skip

    text = path.read_bytes().decode()
    head, rest = text.split("\r\n", 1)
    assert head == "image,point,x,y,sigma_px,note,matched_to"
    assert rest == (
        kept.replace("left/b.png,p2,,,,to look for\r\n", "")
        + "left/b.png,p2,7.2500,8.0000,0.3000,to look for,\r\n"
        + "right/b.png,p2,10.0000,20.0000,0.3000,,left/b.png\r\n"
    )
    found = {(p.image, p.point): p for p in read_picks(path)}
    assert found["left/b.png", "p2"].x_px == 7.75
    assert found["right/b.png", "p2"].matched_to == "left/b.png"
    assert found["left/a.png", "p1"].x_px == 2.0 and len(found) == 3


def test_of_two_writers_the_second_is_told(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    token = save_picks(path, "", [pick("a.png", "p")], {"p"})
    before = path.read_bytes()

    with pytest.raises(StaleError):
        save_picks(path, "", [pick("b.png", "q")], {"q"})
    assert path.read_bytes() == before

    save_picks(path, token, [pick("b.png", "q")], {"q"})
    assert {p.point for p in read_picks(path)} == {"p", "q"}


def test_a_wrong_table_is_left_alone_and_its_line_named(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    path.write_text("image,point,x,y\na.png,p,1,2\na.png,q,one,2\n")
    before = path.read_bytes()
    with pytest.raises(WorkspaceError, match="line 3"):
        save_picks(path, table_token(path), [pick("b.png", "p")], {"p"})
    assert path.read_bytes() == before


def test_control_rows_are_replaced_by_kind_and_name(tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    point = {"kind": "point", "name": "1", "use": "control", "north_m": "1", "east_m": "2",
             "depth_m": "9", "sigma_m": "0.01"}  # fmt: skip
    bar = {"kind": "bar", "name": "1", "use": "check", "from": "1", "to": "2", "length_m": "0.5",
           "sigma_m": "0.001"}  # fmt: skip
    token = save_control(path, "", [point, bar], [])
    token = save_control(path, token, [{**point, "depth_m": "10"}], [("point", "1")])
    known = read_control(path)
    assert known.points[0].depth_m == 10.0 and known.lengths[0].length_m == 0.5
    save_control(path, token, [], [("point", "1")])
    assert read_control(path).points == () and len(read_control(path).lengths) == 1


@pytest.mark.parametrize(
    ("place", "pixel", "said"),
    [
        ("-71.00001 46.00001 -6.0", (20, 30), ""),
        ("46 -71 -6.0", (20, 30), "exchanged"),
        ("-70 46 -6.0", (20, 30), "zone"),
        ("-71 46 -9999", (20, 30), "unknown"),
        ("0 0 -6.0", (20, 30), "unknown"),
        ("-71 46 5.5", (20, 30), "negative heights"),
        ("-71 46 -260", (20, 30), "count from"),
        ("-71 46 -6.0", (410, 230), "6.4"),
    ],
)  # fmt: skip
def test_control_is_compared_with_the_pictures(
    tmp_path: Path, place: str, pixel: tuple[int, int], said: str
) -> None:
    names = ("left/1.png", "left/2.png")
    workspace = workspace_of(tmp_path / "w", names)
    records = [
        replace(r, latitude_deg=46.0, longitude_deg=-71.0, depth_m=5.0, sigma_depth_m=1.0)
        for r in read_manifest(workspace / "images" / "manifest.csv")
    ]
    write_manifest(workspace / "images" / "manifest.csv", records)
    (workspace / "images" / "left").mkdir()
    for name in names:
        cv2.imwrite(str(workspace / "images" / name), np.zeros((48, 64), np.uint8))
    path = tmp_path / "gcp_list.txt"
    rows = [f"{place} {pixel[0]} {pixel[1]} {number}.png CHK-A" for number in (1, 2)]
    path.write_text(
        "\n".join(["EPSG:4326", *rows, *["-71 46 -6 20 30 1.png CHK-B"] * (said == "unknown")])
    )
    warnings: list[str] = []
    with collected_by(lambda _, text: warnings.append(text)):
        import_control(workspace, path, sigma_m=0.1)
    assert [said in text for text in warnings] == [True] * bool(said)
    points = read_control(workspace / "control.csv").points
    assert [p.use for p in points] == ["check"]


@pytest.mark.parametrize(
    ("row", "outside"),
    [("683000 3633500 -1", 0), ("683000 411645 -1", 1), ("900000 3633500 -1", 1)],
)
def test_places_outside_of_their_coordinate_system_are_named(
    workspace: Path, tmp_path: Path, row: str, outside: int
) -> None:
    """A zone south of the equator with the northing of one north of it; three zones to the east."""
    coordinates.cache_clear()
    path = tmp_path / "gcp_list.txt"
    path.write_text("\n".join(["WGS84 UTM 36S", *[f"{row} 1 2 DJI_1.jpg A{n}" for n in range(3)]]))
    with keep_warnings() as warned:
        import_control(workspace, path, sigma_m=0.1)
    assert len(warned) == outside


@pytest.mark.parametrize("place", ["-9999,5,1", "0,0,1", "60,5,-32768"])
def test_control_without_a_place_is_refused(tmp_path: Path, place: str) -> None:
    path = tmp_path / "control.csv"
    header = "kind,name,use,latitude_deg,longitude_deg,depth_m,sigma_m"
    path.write_text(f"{header}\npoint,A,control,{place},1\n")
    with pytest.raises(WorkspaceError, match="line 2"):
        read_control(path)
