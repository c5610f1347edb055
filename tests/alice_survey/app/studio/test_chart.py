"""A chart under the survey, against places that pyproj puts there."""

import io
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import Transformer
from rasterio.transform import Affine

from alice_survey.app.report.held import Held
from alice_survey.app.studio.chart import check_chart
from alice_survey.core.errors import WorkspaceError
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import ask, serving

SPOT_M = (30.0, -20.0)
"""North and east of the datum, where the chart has a hill of 4 m."""
RADIUS_M = 36.0


def written_chart(path: Path, workspace: Path, *, bands: int = 1, crs: str = "EPSG:32636") -> Path:
    """A chart of 400 m a side in UTM, with a spot that differs."""
    place = Held.of(workspace).frame.datum
    assert place is not None
    local = f"+proj=aeqd +lat_0={place.latitude_deg} +lon_0={place.longitude_deg} +datum=WGS84"
    to_chart = Transformer.from_crs(local, "EPSG:32636", always_xy=True)
    middle = to_chart.transform(0.0, 0.0)
    at = to_chart.transform(SPOT_M[1], SPOT_M[0])
    transform = Affine(1, 0, middle[0] - 200, 0, -1, middle[1] + 200)
    rows, columns = np.mgrid[:400, :400] + 0.5
    x, y = transform.c + columns, transform.f - rows
    spot = np.hypot(x - at[0], y - at[1]) < RADIUS_M
    values = np.where(spot, -5.7, -10.0 - 0.001 * rows).astype(np.float32)
    if bands == 3:
        values = np.where(spot, 250, 20).astype(np.uint8)
    with rasterio.open(
        path, "w", driver="GTiff", width=400, height=400, count=bands, dtype=values.dtype,
        crs=crs or None, transform=transform, tiled=True, blockxsize=256, blockysize=256,
    ) as raster:  # fmt: skip
        raster.write(np.broadcast_to(values, (bands, 400, 400)))
    return path


@pytest.mark.parametrize("bands", [1, 3])
def test_a_chart_lies_where_it_belongs(tmp_path: Path, bands: int) -> None:
    workspace = tiny_workspace(tmp_path / "reef")
    chart = written_chart(tmp_path / "chart.tif", workspace, bands=bands)
    with serving(workspace, chart=chart) as server:
        found = ask(server, "/api/map").json
        layer = next(one for one in found["layers"] if one["name"] == "chart")
        tile = ask(server, layer["address"].replace("{}", f"{layer['levels'] - 1}/0/0"))
    assert layer["under"] and layer["shown"] and not layer["base"]
    west, south, east, north = found["extent"]
    assert east - west < 300 and north - south < 300  # the first view is the survey's
    pixels = np.asarray(Image.open(io.BytesIO(tile.body)).convert("RGB")).astype(float)
    wide, high = layer["sizes"][0][2:]
    brightness = pixels.sum(axis=2)
    if bands == 1:  # the hill's palest colour, away from its shaded rim
        brightness = pixels[..., 0] - pixels[..., 2]
    rows, columns = np.nonzero(brightness > 0.8 * brightness.max())
    place = (
        layer["north"] - (rows.mean() + 0.5) * high, layer["west"] + (columns.mean() + 0.5) * wide,
    )  # fmt: skip
    assert place == pytest.approx(SPOT_M, abs=1.0)


def test_contours_lie_round_the_hill(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path / "reef")
    chart = written_chart(tmp_path / "chart.tif", workspace)
    with serving(workspace, chart=chart) as server:
        found = ask(server, "/api/map").json
    extent = found["extent"]
    (contours,) = (one for one in found["layers"] if one["name"] == "contours")
    reach = max(extent[2] - extent[0], extent[3] - extent[1])
    places = np.vstack([np.array(shape) for shape in contours["shapes"]])
    assert np.abs(places - [[extent[0], extent[1]]]).max() <= 2 * reach + 1  # around the survey
    away = np.hypot(places[:, 0] - SPOT_M[1], places[:, 1] - SPOT_M[0])
    assert abs(away.mean() - RADIUS_M) < 0.5  # half a cell
    assert np.abs(away - RADIUS_M).max() < 1.42  # its diagonal
    assert all(text.endswith(" m") for text in contours["texts"])


def test_charts_that_cannot_be_shown(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path / "reef")
    no_place = written_chart(tmp_path / "a.tif", workspace, crs="")
    with pytest.raises(WorkspaceError, match="coordinate system"):
        check_chart(no_place)
    (tmp_path / "b.tif").write_text("no raster")
    for path in (tmp_path / "b.tif", tmp_path / "none.tif"):
        with pytest.raises(Exception, match=path.name):
            check_chart(path)
    described = tmp_path / "c.vrt"
    described.write_text("<VRTDataset rasterXSize='1' rasterYSize='1'></VRTDataset>")
    with pytest.raises(Exception, match="description of other files"):
        check_chart(described)


def test_a_chart_of_a_workspace_without_a_place_is_left_out(tmp_path: Path) -> None:
    placed = tiny_workspace(tmp_path / "reef")
    chart = written_chart(tmp_path / "chart.tif", placed)
    workspace = tiny_workspace(tmp_path / "other", placed=False)
    (workspace / "plan" / "stage.json").unlink()
    with serving(workspace, chart=chart) as server:
        names = [layer["name"] for layer in ask(server, "/api/map").json["layers"]]
        assert ask(server, "/tiles/chart/0/0/0.webp").status == 404
    assert names and "chart" not in names
