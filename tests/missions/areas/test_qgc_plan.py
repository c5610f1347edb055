import json
import math
from pathlib import Path
from typing import Any

import pytest
import shapely

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError
from missions.areas.survey import survey_area
from missions.values.area import Area

POLYGON = [[32.82, 34.95], [32.821, 34.95], [32.821, 34.951], [32.82, 34.951]]


def plan_of(**fence: Any) -> dict[str, Any]:
    return {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "geoFence": {"version": 2, "polygons": [], "circles": [], **fence},
        "mission": {
            "version": 2,
            "items": [
                {"type": "SimpleItem", "command": 22, "params": [0, 0, 0, None, 0, 0, 0]},
                {"type": "ComplexItem", "complexItemType": "survey", "polygon": POLYGON},
            ],
        },
    }


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def to_file(data: Any) -> Path:
        path = tmp_path / "site.plan"
        path.write_text(json.dumps(data))
        return path

    return to_file


def area_of(**settings: object) -> Area:
    return survey_area(AreaConfig.model_validate(settings), turn_margin_m=3.0)


def test_the_polygon_of_a_survey_item_is_the_area(write: Any) -> None:
    direct = area_of(polygon_latlon_deg=POLYGON)
    assert area_of(file=write(plan_of())).survey.equals(direct.survey)


def test_corridor_and_structure_items(write: Any) -> None:
    plan = plan_of()
    plan["mission"]["items"] = [
        {
            "type": "ComplexItem",
            "complexItemType": "CorridorScan",
            "CorridorWidth": 8,
            "polyline": [[32.82, 34.95], [32.821, 34.95]],
        }
    ]
    corridor = area_of(file=write(plan), corridor_width_m=3.0)
    length_m = 110.9  # of a thousandth of a degree of latitude at 33 degrees
    assert corridor.survey.area == pytest.approx(8 * length_m, rel=1e-3)
    plan["mission"]["items"] = [
        {"type": "ComplexItem", "complexItemType": "StructureScan", "polygon": POLYGON}
    ]
    structure = area_of(file=write(plan))
    assert structure.survey.equals(area_of(polygon_latlon_deg=POLYGON).survey)


def test_fences_keep_out_and_in(write: Any, capsys: pytest.CaptureFixture[str]) -> None:
    fence_in = [[32.8195, 34.9495], [32.8215, 34.9495], [32.8215, 34.9515], [32.8195, 34.9515]]
    path = write(
        plan_of(
            polygons=[{"inclusion": True, "polygon": fence_in, "version": 1}],
            circles=[
                {
                    "inclusion": False,
                    "circle": {"center": [32.8205, 34.9505], "radius": 10.0},
                    "version": 1,
                }
            ],
        )
    )
    whole = area_of(polygon_latlon_deg=POLYGON)
    area = area_of(file=path)
    assert "allowed_file" in capsys.readouterr().err
    # A polygon of 64 corners around the circle: no place in it is left to the vehicle.
    circle_m2 = 64 * math.tan(math.pi / 64) * 10.0**2
    assert area.no_go.area == pytest.approx(circle_m2, rel=1e-4)
    assert area.survey.area == pytest.approx(whole.survey.area - circle_m2, rel=1e-6)
    assert area.no_go.buffer(1e-4).contains(shapely.Point(0, 0).buffer(10.0, 128))
    inside = area_of(file=path, allowed_file=path)
    assert capsys.readouterr().err == ""
    assert inside.allowed.area == pytest.approx(4 * whole.survey.area - circle_m2, rel=1e-3)
    kept_out = area_of(polygon_latlon_deg=POLYGON, no_go_file=path)
    assert kept_out.survey.area == pytest.approx(area.survey.area, rel=1e-9)


def _mission(kind: str, **item: object) -> dict[str, Any]:
    return {"mission": {"items": [{"complexItemType": kind, **item}]}}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"fileType": "Rally"}, "fileType"),
        ({"mission": {"items": []}}, "'mission'"),
        ({"mission": {"items": 3}}, "mission.items"),
        (_mission("survey", polygon=[[1]]), "mission.items.0.polygon"),
        (_mission("survey"), "'mission'"),
        (_mission("survey", polygon=[[135, 1]] * 3), "mission 1, corner 1 "),
        (_mission("survey", polygon=[[10**400, 35.0], *POLYGON[1:]]), "items.0.polygon.0"),
        (_mission("CorridorScan", polyline=POLYGON, CorridorWidth=0), "CorridorWidth"),
        (_mission("CorridorScan", polyline=POLYGON, CorridorWidth=1e300), "CorridorWidth"),
        ({"geoFence": {"polygons": [{"polygon": POLYGON}]}}, "geoFence.polygons.0"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(write: Any, change: dict[str, Any], named: str) -> None:
    with pytest.raises(PlanError) as fault:
        area_of(file=write({**plan_of(), **change}))
    assert named in str(fault.value)
    assert "\n" not in str(fault.value)


def test_another_layer_can_be_chosen(write: Any) -> None:
    fence = {"inclusion": True, "polygon": POLYGON, "version": 1}
    path = write({**plan_of(polygons=[fence]), "mission": {"items": []}})
    assert area_of(file=path, layer="inclusion").survey.area > 1000
    with pytest.raises(PlanError, match="inclusion"):
        area_of(file=path)
    with pytest.raises(PlanError, match="'fence'"):
        area_of(file=path, layer="fence")
