"""Files made to harm: small ones that swell, that loop, that climb out of their folder."""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.transform import from_origin

from alice_survey.core.config import load_config
from alice_survey.sim.vehicle.log import read_column_map
from missions.logs import ros_bag
from tests.fuzz import areas, cameras, logs, workspace
from tests.fuzz.cameras import png_of
from tests.fuzz.judge import Sandbox, Verdict, judge

pytestmark = pytest.mark.slow

_MANY = 100_000

_LAUGHS = "<!DOCTYPE k [<!ENTITY a0 'ha'>" + "".join(
    f"<!ENTITY a{i} '{f'&a{i - 1};' * 10}'>" for i in range(1, 12)
) + "]>\n"  # fmt: skip
_QUADRATIC = f"<!DOCTYPE k [<!ENTITY a '{'x' * 50_000}'>]>\n"
_OUTSIDE = "<!DOCTYPE k [<!ENTITY a SYSTEM 'file:///etc/passwd'>]>\n"


@pytest.fixture
def sandbox(tmp_path: Path) -> Sandbox:
    return Sandbox(tmp_path / "box")


def tried(sandbox: Sandbox, name: str, data: bytes | str, read: Callable[[Path], object]) -> str:
    """The refusal of a file's content; fails where it is none."""
    verdict = looked_at(sandbox, name, data, read)
    assert verdict.outcome == "refused", f"{verdict.message}\n{verdict.trace}"
    return verdict.message


def looked_at(
    sandbox: Sandbox, name: str, data: bytes | str, read: Callable[[Path], object]
) -> Verdict:
    path = sandbox.inside / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    verdict = judge(read, path, sandbox)
    assert verdict.outcome != "fault", f"{verdict.message}\n{verdict.trace}"
    return verdict


def packed(
    members: Mapping[str | zipfile.ZipInfo, str | bytes], method: int = zipfile.ZIP_STORED
) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


@pytest.mark.parametrize(
    ("head", "use"), [(_LAUGHS, "&a11;"), (_QUADRATIC, "&a;" * 20_000), (_OUTSIDE, "&a;")],
    ids=["billion laughs", "quadratic", "another file"],
)  # fmt: skip
def test_entities_of_kml_are_not_expanded(sandbox: Sandbox, head: str, use: str) -> None:
    assert "DOCTYPE" in tried(sandbox, "a.kml", areas.kml(use, head), areas.read_area)
    data = packed({"doc.kml": areas.kml(use, head)}, zipfile.ZIP_DEFLATED)
    assert "DOCTYPE" in tried(sandbox, "b.kmz", data, areas.read_area)


def zeros(count: int) -> bytes:
    """A number of zeros, packed: pieces of a MiB are packed once and repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return piece * (count >> 20) + zlib.compressobj(9, zlib.DEFLATED, -15).flush()


def stated_zip(name: bytes, content: bytes, size: int) -> bytes:
    """A zip of one member that states a size."""
    rest = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 0, 0, len(content), size, len(name), 0)
    local = b"PK\3\4" + rest + name + content
    central = b"PK\1\2\x14\0" + rest + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(central), len(local), 0)
    return local + central + end


@pytest.mark.parametrize("stated", [1 << 30, 1000, 0xFFFFFFF0])
def test_a_zip_of_a_gigabyte_is_not_unpacked(sandbox: Sandbox, stated: int) -> None:
    for name, member in (("a.kmz", b"doc.kml"), ("a.zip", b"a.shp")):
        data = stated_zip(member, zeros(1 << 30), stated)
        assert len(data) < 2_000_000
        tried(sandbox, name, data, areas.read_area)


@pytest.mark.parametrize(
    "name", ["../../../evil", "/evil", "..\\..\\evil", "C:\\evil", "a/../../evil", "a\0evil"]
)
def test_names_in_archives_do_not_climb(sandbox: Sandbox, name: str) -> None:
    data = packed({f"{name}.kml": areas.kml()})
    looked_at(sandbox, "a.kmz", data, areas.read_area)  # read, into a name of our own

    areas.build_shapefile(sandbox.inside / "a.shp")
    sides = sandbox.inside.glob("a.[sdp]??")
    data = packed({f"{name}{side.suffix}": side.read_bytes() for side in sides})
    looked_at(sandbox, "b.zip", data, areas.read_area)
    assert not Path("/evil.shp").exists()


def test_links_in_archives_are_not_followed(sandbox: Sandbox) -> None:
    link = zipfile.ZipInfo("doc.kml")
    link.create_system, link.external_attr = 3, 0o120777 << 16
    tried(sandbox, "a.kmz", packed({link: "/etc/passwd"}), areas.read_area)


_TABLES: dict[str, Callable[[Path], object]] = {
    "n.csv": logs.read_nav, "d.csv": logs.check_dive, "v.csv": logs.read_vehicle_log,
    "control.csv": workspace.read_control, "q.csv": logs.read_any_log,
    "current.csv": logs.read_current,
}  # fmt: skip
_ALIASES = [f"a{i}: &a{i} [{f'*a{i - 1},' * 10}]" for i in range(1, 12)]
_FOLDERS = [(1000, 1000), (30_000, 30_000), (_MANY, 0)]
_DEEP: tuple[tuple[str, str, Callable[[Path], object]], ...] = (
    *(
        (name, piece * _MANY, read)
        for piece in ("[", '{"a":[')
        for name, read in (
            ("a.geojson", areas.read_area), ("rig.json", cameras.read_rig),
            ("v.json", logs.read_vehicle), ("board.json", cameras.read_board),
        )
    ),
    *(("c.kml", f"<kml>{'<Folder>' * n}{'</Folder>' * end}", areas.read_area)
      for n, end in _FOLDERS),
    ("b.yaml", "a: " + "[" * _MANY, cameras.read_calibration),
    ("b.xml", f"<?xml version='1.0'?><opencv_storage>{'<a>' * _MANY}", cameras.read_calibration),
    ("b.toml", "a = " + "[" * _MANY, load_config),
    ("survey.toml", "a." * 5000 + "a = 1", load_config),
    ("map.toml", "a." * 5000 + "a = 1", read_column_map),
    ("c.wkt", "GEOMETRYCOLLECTION (" * _MANY, areas.read_area),
    ("camchain.yaml", "\n".join(["a0: &a0 [x]", *_ALIASES]), cameras.read_calibration),
    *((name, piece * (3_000_000 // len(piece)), read)
      for piece in ("a", ",", '"') for name, read in _TABLES.items()),
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text", "read"), _DEEP, ids=[f"{i} {name}" for i, (name, *_) in enumerate(_DEEP)]
)
def test_files_nested_deep_and_lines_of_3_mb_are_refused(
    sandbox: Sandbox, name: str, text: str, read: Callable[[Path], object]
) -> None:
    said = tried(sandbox, name, text, read)
    assert name != "camchain.yaml" or "alias" in said


def test_toml_of_a_million_keys(sandbox: Sandbox) -> None:
    text = "".join(f"k{i} = {i}\n" for i in range(1_000_000))
    tried(sandbox, "survey.toml", text, load_config)
    text = "".join(f"k{i} = {i}\n" for i in range(20_000))
    message = tried(sandbox, "survey.toml", text, load_config)
    assert len(message) < 2000


def test_a_line_of_100_mb(sandbox: Sandbox) -> None:
    rows = logs.navigation_rows(dated=False)
    tried(sandbox, "n.csv", rows[0] + "\n" + "1" * 100_000_000, logs.read_nav)


def test_a_polygon_of_a_million_corners(sandbox: Sandbox) -> None:
    angles = np.linspace(0, 2 * np.pi, 1_000_000)
    ring = np.column_stack([35 + 1e-3 * np.cos(angles), 32 + 1e-3 * np.sin(angles)]).round(9)
    text = json.dumps({"type": "Polygon", "coordinates": [ring.tolist()]})
    assert "corners; at most" in tried(sandbox, "a.geojson", text, areas.read_area)


@pytest.mark.parametrize(
    "text",
    [
        "[35, 32], [35.001, 32.001], [35.001, 32], [35, 32.001], [35, 32]",
        "[35, 32], [35.001, 32], [35.0005, 32], [35, 32]",
        "[35, 32], [35, 32], [35, 32], [35, 32]",
        "[35, NaN], [35.001, 32.001], [35.001, 32], [35, NaN]",
        "[35, 1e999], [35.001, 32.001], [35.001, 32], [35, 1e999]",
        "[1e308, -1e308], [-1e308, 1e308], [1e308, 1e308], [1e308, -1e308]",
        "[35, 32, 5], [35.001], [35.001, 32]", "[]", "null", "[[[35, 32]]]",
        "[179.999, 10], [-179.999, 10], [-179.999, 10.001], [179.999, 10.001], [179.999, 10]",
        "[0, 90], [90, 90], [180, 90], [0, 90]",
    ],
)  # fmt: skip
def test_polygons_that_are_none(sandbox: Sandbox, text: str) -> None:
    looked_at(
        sandbox, "a.geojson", f'{{"type": "Polygon", "coordinates": [[{text}]]}}', areas.read_area
    )


def _tiff(width: int, height: int, bits: int = 16) -> bytes:
    tags = [(256, width), (257, height), (258, bits), (259, 1), (262, 1), (273, 8), (277, 1),
            (278, height), (279, 0xFFFFFFFF)]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)


def _jpeg(width: int, height: int, tmp: Path) -> bytes:
    data = bytearray(cameras.picture(tmp / "seed.jpg").read_bytes())
    at = data.find(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


_READERS: dict[str, Callable[[Path], object]] = {
    "import": cameras.read_picture, "match": cameras.read_for_matching,
    "mask": cameras.read_small_mask, "board": cameras.look_for_board,
}  # fmt: skip


@pytest.mark.parametrize("reader", _READERS)
@pytest.mark.parametrize("size", [50_000, 30_000, 13_000])
def test_pictures_that_state_a_great_size(
    sandbox: Sandbox, tmp_path: Path, size: int, reader: str
) -> None:
    pictures = {
        "a.png": png_of(size, size), "b.png": png_of(size, size, 16, 6),
        "c.tif": _tiff(size, size), "d.jpg": _jpeg(size, size, tmp_path),
        "e.png": png_of(size, size, 1, 0, zeros(size * size // 8)), "f.jpg": png_of(size, size),
        "g.tif": png_of(size, size, 16, 6), "h.png": b"P6 %d %d 65535\n" % (size, size),
        "i.jpg": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (size, size),
        "j.png": b"BM" + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, size, size, 1, 24, 0, 0, 0,
                                     0, 0, 0),
    }  # fmt: skip
    for name, data in pictures.items():
        looked_at(sandbox, name, data, _READERS[reader])


@pytest.mark.parametrize(
    ("tags", "gps"),
    [
        ({0x9003: "0001:01:01 00:00:00", 0x9011: "+23:59"}, {}),
        ({0x9003: "9999:12:31 23:59:59", 0x9011: "-99:99"}, {}),
        ({0x9003: "2024:05:01 12:00:00", 0x9011: "+99:99", 0x9291: "9" * 400}, {}),
        ({0x9003: b"\xff\xfe", 0xA405: 65535}, {2: 5.0, 4: (1.0,), 6: "x"}),
        ({0xA405: 0}, {2: (1e300, 0.0, 0.0), 4: (181.0, 0.0, 0.0), 1: 5, 3: b"\0", 5: 7}),
        ({}, {2: "N", 4: b"\0\0\0", 6: (1, 0)}),
    ],
)  # fmt: skip
def test_exif_that_lies(sandbox: Sandbox, tags: dict[int, object], gps: dict[int, object]) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    exif.get_ifd(0x8825).update(gps)
    try:
        Image.new("RGB", (48, 32)).save(sandbox.inside / "a.jpg", exif=exif)
    except (ValueError, TypeError, struct.error, OverflowError, AttributeError):
        pytest.skip("Pillow does not write this")
    data = (sandbox.inside / "a.jpg").read_bytes()
    assert looked_at(sandbox, "a.jpg", data, cameras.read_picture).outcome == "value"


def test_clouds_of_a_trillion_points(sandbox: Sandbox) -> None:
    for kind in ("ascii", "binary_little_endian", "binary_big_endian"):
        head = f"ply\nformat {kind} 1.0\nelement vertex 1000000000000\n"
        text = head + "".join(f"property double {a}\n" for a in "xyz") + "end_header\n1 2 3\n"
        tried(sandbox, "a.ply", text, workspace.read_reference)
    workspace.build_las(sandbox.inside / "a.las")
    good = (sandbox.inside / "a.las").read_bytes()
    for at, kind in ((100, "<I"), (107, "<I"), (243, "<I"), (247, "<Q"), (96, "<I"), (235, "<Q")):
        value = (1 << (8 * struct.calcsize(kind) - 1)) - 1
        data = good[:at] + struct.pack(kind, value) + good[at + struct.calcsize(kind) :]
        looked_at(sandbox, "a.las", data, workspace.read_reference)


def test_packed_points_that_break_their_decoder(sandbox: Sandbox) -> None:
    """lazrs 0.6 reads out of bounds and ends the process."""
    workspace.build_las(sandbox.inside / "a.laz")
    good = (sandbox.inside / "a.laz").read_bytes()
    data = good[:840] + b"\xff" * 512 + good[1352:]
    looked_at(sandbox, "a.laz", data, workspace.read_reference)


def test_rasters_of_a_trillion_cells(sandbox: Sandbox) -> None:
    path = sandbox.inside / "a.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=1_000_000, height=1_000_000, count=1, dtype="float32",
        crs="EPSG:4326", transform=from_origin(34.9, 32.9, 2e-7, 2e-7), tiled=True,
        blockxsize=16384, blockysize=16384, sparse_ok=True, bigtiff="YES",
    ):  # fmt: skip
        pass
    data = path.read_bytes()
    assert len(data) < 1_000_000
    looked_at(sandbox, "a.tif", data, areas.read_depths)
    looked_at(sandbox, "a.tif", data, workspace.read_reference)


@pytest.mark.parametrize(
    "source", ["/etc/passwd", "/vsicurl/http://127.0.0.1:9/a.tif", "../../a.tif"]
)
def test_rasters_that_name_other_files_are_not_followed(sandbox: Sandbox, source: str) -> None:
    text = (
        '<VRTDataset rasterXSize="20" rasterYSize="20"><SRS>EPSG:4326</SRS>'
        "<GeoTransform>34.9999,1e-5,0,32.8004,0,-1e-5</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        f"<SourceFilename>{source}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    for name in ("a.vrt", "a.tif"):
        tried(sandbox, name, text, areas.read_depths)
    tried(sandbox, "a.tif", text, workspace.read_reference)


@pytest.mark.parametrize("method", ["bz2", "zstd"])
def test_bags_whose_chunks_swell(
    sandbox: Sandbox, tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_bag, "MAX_BYTES", 8 << 20)
    path = logs.swelling_bag(tmp_path, method, 10 << 20)
    data = path.read_bytes()
    assert len(data) < 100_000
    assert "8 MiB" in tried(sandbox, f"a{path.suffix}", data, logs.read_any_log)
