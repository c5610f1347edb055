"""Files of other programs that once failed, where they lie beside the checkout."""

import csv
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError, keep_warnings
from alice_survey.core.frames import Array, Datum
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_task
from camera_calib.calibrate.options import CalibrateOptions, task_of
from camera_calib.calibration import TargetView
from camera_calib.formats.convert import Conversion, convert
from camera_calib.formats.rigs import ReadOptions
from camera_calib.rig import read_rig
from camera_calib.targets.target import parse_target
from missions.areas.bathymetry import read_bathymetry
from missions.areas.survey import survey_area
from reconstruct.pictures.importing import import_images
from tests.reconstruct.pictures.dated import rows_of

CASES = Path(__file__).parents[2] / "shared" / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="no cases beside the checkout")


@pytest.mark.parametrize("name", ["area.poly", "corners.csv", "track.gpx"])
def test_areas(name: str) -> None:
    area = survey_area(AreaConfig(file=CASES / "area-formats" / name), turn_margin_m=3.0)
    assert area.survey.area == pytest.approx(623.1, abs=0.5)


@pytest.mark.parametrize("name", ["m.waypoints", "corners.kml"])
def test_a_route_and_points_alone_are_no_area(name: str) -> None:
    with pytest.raises(PlanError):
        survey_area(AreaConfig(file=CASES / "area-formats" / name), turn_margin_m=3.0)


def test_both_rings_of_one_boundary_are_zones() -> None:
    file = CASES / "kml-two-rings-in-one-inner" / "two_holes.kml"
    area = survey_area(AreaConfig(file=file), turn_margin_m=3.0)
    assert len(area.no_go.geoms) == 2
    assert area.no_go.area == pytest.approx(207.7, abs=0.5)


@pytest.mark.parametrize("name", ["nd_in_9999.tif", "nd_in_0.tif"])
def test_depths_that_stand_for_unknown(name: str) -> None:
    with keep_warnings() as said:
        depth_m = read_bathymetry(
            CASES / "bathymetry-sentinels" / name, Datum(32.8236, 34.9553), sense="heights"
        ).known_m
    assert said and np.all((depth_m > 1.0) & (depth_m < 100.0))


@pytest.mark.parametrize("masks", ["colmap", "upper", None])
def test_masks(masks: str | None, tmp_path: Path) -> None:
    folder = CASES / "masks-named-by-others"
    apart = None if masks is None else folder / masks
    import_images(tmp_path, [folder / ("odm" if masks is None else "pics")], masks=apart)
    assert [bool(one.mask) for one in rows_of(tmp_path)] == [True, True]


@pytest.mark.parametrize("name", ["byname.csv", "metashape_ref.csv", "geo.txt"])
def test_positions_by_name(name: str, tmp_path: Path) -> None:
    case, pictures = CASES / "nav-by-name", CASES / "nav-zero-and-nodata" / "pics"
    import_images(tmp_path, [pictures], navigation=case / name)
    placed = rows_of(tmp_path)
    assert len(placed) == 6
    assert all(np.isfinite([one.latitude_deg, one.longitude_deg]).all() for one in placed)


@pytest.mark.parametrize("name", ["Caps.csv", "hdg.csv", "latlon.csv", "utm.csv"])
def test_columns_are_read_or_named(name: str, tmp_path: Path) -> None:
    case, pictures = CASES / "nav-unknown-columns", CASES / "nav-zero-and-nodata" / "pics"
    header = (case / name).read_text().splitlines()[0].split(",")
    with keep_warnings() as said:
        import_images(tmp_path, [pictures], navigation=case / name)
    placed = [one for one in rows_of(tmp_path) if np.isfinite(one.latitude_deg or np.nan)]
    unread = " ".join(text for text in said if "not read" in text)
    assert len(placed) == 6 or any(column in unread for column in header[1:])


@pytest.mark.parametrize(("name", "placed"), [("zero.csv", 0), ("zeromix.csv", 6)])
def test_no_fix_is_no_place(name: str, placed: int, tmp_path: Path) -> None:
    """The place of a moment without a fix is that between its neighbours."""
    case = CASES / "nav-zero-and-nodata"
    import_images(tmp_path, [case / "pics"], navigation=case / name)
    found = [one for one in rows_of(tmp_path) if np.isfinite(one.latitude_deg or np.nan)]
    assert len(found) == placed
    assert all(abs(one.latitude_deg or 0.0) > 1.0 for one in found)


def test_one_file_of_each_shot(tmp_path: Path) -> None:
    said = repr(import_images(tmp_path, [CASES / "raw-jpeg-pairs"]))
    assert len(rows_of(tmp_path)) == 2
    assert "DSC_0000" in said and "DSC_0001" in said


def test_two_zooms_are_two_lenses(tmp_path: Path) -> None:
    import_images(tmp_path, [CASES / "zoom-mixed"])
    cameras = [one.camera for one in rows_of(tmp_path)]
    assert sorted(map(cameras.count, set(cameras))) == [2, 2]


def test_pictures_that_calibrate_reads_are_imported(tmp_path: Path) -> None:
    import_images(tmp_path, [CASES / "bmp-pgm"])
    assert len(rows_of(tmp_path)) == 4


@pytest.mark.parametrize(
    "name",
    ["SN10000.conf", "k_ds_none.yaml", "orbslam3_stereo.yaml", "otus2.yaml", "photoscan_new.xml",
     "photoscan_old.xml"],
)  # fmt: skip
def test_calibrations(name: str, tmp_path: Path) -> None:
    reading = ReadOptions(image_size=(1920, 1080) if name.endswith(".conf") else None)
    source, target = CASES / "calib-formats" / name, tmp_path / "rig.json"
    convert(Conversion(source=source, target=target, reading=reading))
    rig = read_rig(target)
    pairs = ("SN10000.conf", "orbslam3_stereo.yaml", "k_ds_none.yaml")
    assert len(rig.cameras) == (2 if name in pairs else 1)
    if len(rig.cameras) == 2:
        assert 0.05 < rig.baseline_m < 0.2


@pytest.mark.slow
def test_a_real_dome_is_found_by_all_views_by_halves_and_by_thirds() -> None:
    """Its maker states 7.2 mm."""
    folder, pixels = CASES / "real-dome-corners", dict[str, Array]()
    for row in csv.DictReader((folder / "water_corners.csv").read_text().splitlines()):
        seen = pixels.setdefault(row["view"], np.full((48, 2), np.nan))
        seen[int(row["point"])] = float(row["x_px"]), float(row["y_px"])
    whole = [TargetView(name=name, pixels={"camera": seen}) for name, seen in pixels.items()]
    options = CalibrateOptions(
        water=True, port="auto", dome_radius_mm="47.302", glass_mm="3.75", n_glass="1.495",
        n_water="1.333",
    )  # fmt: skip
    target, start = parse_target("chessboard 8x6 30mm"), read_rig(folder / "air_rig.json")
    task = task_of(options, {"camera": "x"}, target, start)
    for part in (slice(None), slice(0, 37), slice(37, None), slice(0, None, 2), slice(2, None, 3)):
        found = Detections(views=tuple(whole[part]), sizes={"camera": (1440, 1080)}, rejections=())
        port = calibrate_task(task, found).rig.cameras["camera"].port
        assert port.shape == "dome"
        assert port.parameter("dome_z_m") == pytest.approx(-7.2e-3, abs=0.4e-3)
