"""Areas by their settings, and sea floors about a datum."""

from pathlib import Path

from pyproj import Transformer

from alice_survey.core.config import AreaConfig
from alice_survey.core.frames import Array, Datum
from missions.areas.bathymetry import Bathymetry
from missions.areas.survey import survey_area
from missions.values.area import Area
from tests.oracles_lines import DATUM

UTM = "EPSG:32636"
TO_UTM = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)


def area_of(**settings: object) -> Area:
    return survey_area(AreaConfig.model_validate(settings), turn_margin_m=3.0)


def floor_of(depth_m: Array, cell_m: float = 0.5) -> Bathymetry:
    """A raster in UTM whose middle is at the datum."""
    x, y = TO_UTM.transform(DATUM.longitude_deg, DATUM.latitude_deg)
    rows, columns = depth_m.shape
    west, north = x - columns / 2 * cell_m, y + rows / 2 * cell_m
    from_pixel = (cell_m, 0.0, west, 0.0, -cell_m, north)
    return Bathymetry(
        name="floor.tif", datum=DATUM, crs=UTM, from_pixel=from_pixel, depth_m=depth_m
    )


def real_floor(shared_data: Path) -> tuple[Path, Datum]:
    """A real BAG and a place within it."""
    path = next((shared_data / "bathymetry").glob("*.bag"))
    to_degrees = Transformer.from_crs("EPSG:32602", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(621_500.0, 7_244_800.0)
    return path, Datum(lat, lon)
