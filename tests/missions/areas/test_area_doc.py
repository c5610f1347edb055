import re
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import shapely

from alice_survey.core.config import load_config
from missions.areas.survey import survey_area

DOC = (Path(__file__).parents[3] / "docs" / "areas.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```toml\n(.*?)```", DOC, re.DOTALL)


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the files that the examples name."""
    corners = [(34.9553, 32.8236), (34.9556, 32.8236), (34.9556, 32.8239), (34.9553, 32.8239)]
    wkb = shapely.to_wkb(np.array([shapely.Polygon(corners)]))
    for layer in ("reef", "permit"):
        pyogrio.raw.write(
            tmp_path / "reef.gpkg", wkb, [], [], geometry_type="Polygon", crs="EPSG:4326",
            driver="GPKG", layer=layer, append=layer != "reef",
        )  # fmt: skip
    (tmp_path / "wreck.geojson").write_text('{"type": "Point", "coordinates": [34.9554, 32.8238]}')
    return tmp_path


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_an_example_gives_an_area_without_a_warning(
    number: int, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (site / "survey.toml").write_text(EXAMPLES[number])
    area = survey_area(load_config(site / "survey.toml").area, turn_margin_m=3.0)
    assert area.survey.area > 100
    assert area.allowed.area > area.survey.area * 0.999
    assert capsys.readouterr().err == ""
