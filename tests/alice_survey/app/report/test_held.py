import json
from pathlib import Path

import numpy as np
import pytest
import rasterio

from alice_survey.app.report.held import Held
from alice_survey.app.report.shapes import shape_layers
from alice_survey.core.artefacts import write_json
from alice_survey.core.frames import Datum
from tests.alice_survey.app.report.tiny import CELL_M, COLUMNS, ROWS, SIGMA_M, SLOPE, tiny_workspace


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Held:
    return Held.of(tiny_workspace(tmp_path_factory.mktemp("tiny")))


def test_area_relief_and_cover_are_those_of_the_plane(held: Held) -> None:
    surface = held.surface
    assert surface is not None
    cells = ROWS * COLUMNS
    assert surface.area == pytest.approx((cells - 400) * CELL_M**2)
    assert surface.covered == pytest.approx(1.0 - 400 / cells)
    assert surface.high - surface.low == pytest.approx(SLOPE * COLUMNS * CELL_M, rel=0.06)
    assert surface.sigma_median == pytest.approx(SIGMA_M, rel=1e-6)
    assert surface.unchecked == 0.0


def test_what_lies_beyond_the_planned_area_is_not_judged(tmp_path: Path) -> None:
    """The northern half is planned; cells of the southern one are seen by two stations, and bad."""
    folder, north, east = tiny_workspace(tmp_path), ROWS * CELL_M, COLUMNS * CELL_M
    plan = json.loads((folder / "plan/plan.json").read_text())
    ring = [[north / 2, 0.0], [north, 0.0], [north, east], [north / 2, east], [north / 2, 0.0]]
    plan["area"]["survey"]["coordinates"] = [[ring]]
    write_json(folder / "plan/plan.json", plan)
    for name, value in (("stations", 2), ("sigma", 1.0)):
        with rasterio.open(folder / f"dense/{name}.tif", "r+") as raster:
            band = raster.read(1)
            band[ROWS // 2 :] = value
            raster.write(band, 1)
    surface = Held.of(folder).surface
    assert surface is not None
    assert (surface.unchecked, surface.covered) == (0.0, 1.0)
    assert surface.sigma_95 == pytest.approx(SIGMA_M, rel=1e-6)


def test_place_on_earth_is_the_rms_of_the_cameras_level_sigmas(held: Held) -> None:
    assert held.place_sigma_m == pytest.approx(0.05)
    assert held.pictures == "4 pictures taken at 2 stations"


def test_what_is_not_there_is_not_held(tmp_path: Path) -> None:
    """A place on the Earth without positions, all of an empty folder, a half-written stage."""
    local = Held.of(tiny_workspace(tmp_path / "a", frame={"name": "model", "datum": None}))
    empty = Held.of(tmp_path / "none")
    assert np.isnan([local.place_sigma_m, empty.place_sigma_m]).all()
    assert empty.surface is None and not empty.stages
    (tmp_path / "a" / "dense" / "stage.json").unlink()
    held = Held.of(tmp_path / "a")
    assert not held.has("dense")
    assert held.file("dense/dem.tif") is held.surface is None


def test_pictures_lie_on_the_map_before_there_is_a_model(tmp_path: Path) -> None:
    datum = Datum(-33.9, 151.3)
    north_east = np.array([[0.0, 0.0], [3.0, -4.0]])
    places = datum.geodetic_from_ned(np.column_stack([north_east, np.zeros(2)]))
    names = ("cam/a.jpg", "cam/b.jpg", "cam/no_fix.jpg")
    rows = [
        f"{name},{lat!r},{lon!r}"
        for name, (lat, lon, _) in zip(names[:2], places.tolist(), strict=True)
    ]
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "manifest.csv").write_text(
        "\n".join(["image,latitude_deg,longitude_deg", *rows, "cam/no_fix.jpg,,"])
    )
    stage = {"stage": "images", "version": 1, "digest": "", "took_s": 1.0}
    write_json(tmp_path / "images" / "stage.json", stage)
    place = {"latitude_deg": -33.9, "longitude_deg": 151.3, "height_m": 0.0}
    write_json(tmp_path / "images" / "survey.json", {"source": "imported", "datum": place})
    (layer,) = shape_layers(Held.of(tmp_path))
    assert layer.shown
    np.testing.assert_allclose([shape[0] for shape in layer.shapes], north_east[:, ::-1], atol=1e-4)
