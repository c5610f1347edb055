import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from scipy.spatial.transform import RigidTransform

from alice_survey.app.commands.missions import CheckCommand
from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.kit.words import share
from camera_calib.mount import mount_rotation
from camera_calib.rig import write_rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.stations import Stations, join, plan_pattern, stations_of_plan
from missions.fly.check import check_report, rig_of
from missions.route.ways import Ways
from missions.values.line import Line
from missions.values.navigation import write_navigation
from missions.values.plan_file import Plan, read_plan
from tests.missions.coverage.logs import log_of, write_triggers
from tests.missions.exports.plans import RIG
from tests.missions.follow.dives import workspace_of
from tests.oracles_coverage import DATUM, area_of, lawnmower, left_alone, plan_of
from tests.oracles_route import inside

CONFIG = SurveyConfig()


PLAN = plan_of(area_of(shapely.box(0, 0, 8, 6)), lawnmower(8.0, 6.0, 1.0, 0.46, over_m=1.0))
WHOLE, MISSING = stations_of_plan(PLAN), 3
FLOWN = WHOLE.some(WHOLE.line != MISSING)
"""One line was not flown."""


def certified(stations: Stations) -> Certificate:
    return certificate(PLAN.area, RIG, stations, plan_pattern(PLAN, RIG))


def checked_dive(
    workspace: Path, flown: Stations, plan: Plan = PLAN, **out: Any
) -> tuple[str, dict]:
    """The report of a workspace with a plan, and the log and triggers of a dive."""
    time_s = 50.0 + PLAN.interval_s * np.arange(len(flown), dtype=float)
    flown, at = replace(flown, time_s=time_s), workspace / "triggers.csv"
    write_navigation(workspace / "nav.csv", log_of(flown, plan, RIG), DATUM)
    write_triggers(at, flown)
    workspace_of(workspace, plan)
    return check_report(workspace, CONFIG, workspace / "nav.csv", triggers=at, **out)


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, dict]:
    workspace = tmp_path_factory.mktemp("dive")
    return workspace, *checked_dive(workspace, FLOWN)


def test_a_dive_is_compared_with_its_plan(checked: tuple[Path, str, dict]) -> None:
    workspace, text, data = checked
    exact, seen = certified(WHOLE), certified(FLOWN)

    assert data["planned"]["share_at_overlap"] == exact.share_at_overlap == 1.0
    assert data["flown"]["share_at_overlap"] == pytest.approx(seen.share_at_overlap, abs=1e-4)
    assert 0.8 < seen.share_at_overlap < 0.95
    assert len(data["holes"]) == 1
    assert data["holes"][0]["size_m"][0] == pytest.approx(8.0, abs=0.05)
    assert data["holes_m2"] == pytest.approx((1 - seen.share_at_overlap) * 48.0, rel=0.01)
    assert share(seen.share_at_overlap, 2) in text
    assert f"{data['holes'][0]['latitude_deg']:.7f}" in text
    written = json.loads((workspace / "check" / "certificate.json").read_text())
    assert written == {key: data[key] for key in written}
    assert ("shortfall" in data) == (seen.share_at_overlap < 0.9)
    half = FLOWN.some(FLOWN.line < 4)
    assert not CheckCommand().is_passed(checked_dive(workspace, half, out=workspace / "half")[1])


def test_the_map_and_the_outlines_lie_where_the_hole_is(checked: tuple[Path, str, dict]) -> None:
    workspace, _, data = checked
    with rasterio.open(workspace / "check" / "coverage.tif") as raster:
        assert raster.crs.to_epsg() == DATUM.utm_epsg
        bands = dict(zip(raster.descriptions, raster.read(), strict=True))
        pictures = bands["pictures of all cameras"]
        within = pictures != raster.nodata
        pixel_m2 = raster.res[0] * raster.res[1]
        row, column = np.argwhere(within & (pictures == 0)).mean(axis=0)
        x, y = raster.xy(row, column)
        lon, lat = rasterio.warp.transform(raster.crs, "EPSG:4326", [float(x)], [float(y)])
    assert within.sum() * pixel_m2 == pytest.approx(48.0, rel=0.02)
    assert (within & (pictures == 0)).sum() * pixel_m2 == pytest.approx(data["unseen_m2"], rel=0.03)
    middle = DATUM.ned_from_geodetic(np.array([[lat[0], lon[0], 0.0]]))[0, :2]
    np.testing.assert_allclose(middle, [4.0, PLAN.lines[MISSING].start_ne_m[1]], atol=0.15)

    holes = json.loads((workspace / "check" / "holes.geojson").read_text())
    ring = shapely.get_coordinates(shapely.geometry.shape(holes["features"][0]["geometry"]))
    ned = DATUM.ned_from_geodetic(np.column_stack([ring[:, [1, 0]], np.zeros(len(ring))]))
    outline = shapely.Polygon(ned[:, :2])
    assert outline.area == pytest.approx(data["holes_m2"], rel=0.02)
    assert (workspace / "check" / "coverage.png").is_file()


def test_the_plan_for_the_holes_is_whole_and_closes_them(checked: tuple[Path, str, dict]) -> None:
    workspace, _, data = checked
    again = read_plan(workspace / "check" / "refly" / "plan" / "plan.json")

    assert all(isinstance(line, Line) for line in again.lines)
    assert again.stations < 0.5 * PLAN.stations
    assert again.coverage >= 0.999
    assert again.coverage == data["refly"]["coverage"]
    assert again.dives[0].first_line == 0
    assert again.dives[-1].last_line == len(again.lines) - 1
    assert again.duration_s > again.length_m / PLAN.speed_mps
    assert again.energy_wh > 0
    ways = Ways(PLAN.area.allowed)
    for dive in again.dives:
        places = dive.route.places(np.arange(0.0, dive.route.length_m, 0.02))
        assert all(inside(ways, places))
    # Both dives together leave nothing.
    both = join(FLOWN, stations_of_plan(again))
    assert certified(both).share_at_overlap >= 0.9999
    assert (workspace / "check" / "refly" / "plan" / "exports" / "about.txt").is_file()


def test_holes_over_a_bathymetry_are_flown_above_its_shallowest_place(tmp_path: Path) -> None:
    floors = [PLAN.seafloor_depth_m + np.linspace(-0.4, 0.3, line.stations) for line in PLAN.lines]
    over = replace(
        PLAN,
        line_floors_m=tuple(tuple(floor.tolist()) for floor in floors),
        line_depths_m=tuple(tuple((floor - PLAN.altitude_m).tolist()) for floor in floors),
        way_depths_m=tuple((math.nan,) * len(dive.route.legs) for dive in PLAN.dives),
    )
    checked_dive(tmp_path, FLOWN, over)
    folder = tmp_path / "check" / "refly" / "plan"
    again = read_plan(folder / "plan.json")
    assert again.seafloor_depth_m == pytest.approx(PLAN.seafloor_depth_m - 0.4)
    assert again.stations > 0 and not again.line_depths_m
    assert (folder / "exports" / "about.txt").is_file()


def test_a_complete_dive_leaves_no_plan(tmp_path: Path) -> None:
    out = tmp_path / "out"
    data = checked_dive(tmp_path, WHOLE, out=out)[1]

    assert data["flown"]["share_at_overlap"] == 1.0
    assert "refly" not in data
    assert not (out / "refly").exists()
    assert json.loads((out / "holes.geojson").read_text())["features"] == []


def test_the_mount_is_the_calibrated_else_the_found_else_the_designed_one(tmp_path: Path) -> None:
    """Each place says in `source` which one it took."""
    calibrated = replace(RIG, body_from_rig=None, source="a pool")
    found = RigidTransform.from_components([0.2, 0.3, 0.4], mount_rotation("aft+60"))
    stated = RigidTransform.from_components([0.1, 0.0, 0.4], mount_rotation("nadir-bow-left"))
    for folder in ("calibration", "sparse"):
        (tmp_path / folder).mkdir()

    def taken() -> tuple[Array, str]:
        rig = rig_of(tmp_path, CONFIG.camera, CONFIG.water)
        return rig.body_from_rig.as_matrix(), rig.source

    assert taken()[1] == RIG.source
    write_rig(tmp_path / "calibration" / "rig.json", calibrated)
    another = replace(left_alone(RIG), body_from_rig=found, source="another rig")
    for of_other in (None, calibrated, another):
        if of_other is not None:
            write_rig(tmp_path / "sparse" / "rig.json", of_other)
        mount, source = taken()
        np.testing.assert_allclose(mount, RIG.body_from_rig.as_matrix(), atol=1e-9)
        assert "a pool" in source
        assert source.endswith("mounted as designed")
    write_rig(tmp_path / "sparse" / "rig.json", replace(calibrated, body_from_rig=found))
    mount, source = taken()
    np.testing.assert_allclose(mount, found.as_matrix(), atol=1e-9)
    assert source.endswith("mounted as the reconstruction found")
    write_rig(tmp_path / "calibration" / "rig.json", replace(calibrated, body_from_rig=stated))
    mount, source = taken()
    np.testing.assert_allclose(mount, stated.as_matrix(), atol=1e-9)
    assert "mounted" not in source
