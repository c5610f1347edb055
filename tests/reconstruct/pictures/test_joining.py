"""Pictures of two dives in one workspace."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from alice_survey.core.artefacts import Stage, renew_outputs, run_stage, write_json
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import CalibrationError, ImageError, PlanError, WorkspaceError
from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.core.records import PicturesRecord, PlaceRecord
from alice_survey.core.stages import is_imported
from camera_calib.rig import design_rig, read_rig, write_rig
from missions.coverage.dive_record import assign_lines
from missions.coverage.stations import stations_of_plan
from missions.values.plan_file import Plan, read_plan
from reconstruct.pictures.importing import join_dives
from reconstruct.stages import rig_file
from tests.oracles_coverage import area_of, lawnmower, plan_of

RIG = design_rig(CameraConfig(), WaterConfig())
PLAN = plan_of(area_of(shapely.box(0, 0, 4, 3)), lawnmower(4.0, 3.0, 1.0, 0.46))


def dive(folder: Path, stations: int, *, level: str = "sea surface", plan: Plan = PLAN) -> Path:
    """A workspace with pictures, each of bytes of its own, a rig and a plan."""
    records = [
        ImageRecord(
            image=f"{camera}/{s}.png", camera=camera, station=s, time_s=10.0 + 2 * s, depth_m=5.0
        )
        for s in range(stations)
        for camera in ("left", "right")
    ]

    def work(part: Path) -> None:
        for record in records:
            (part / record.image).parent.mkdir(exist_ok=True)
            (part / record.image).write_text(f"{folder.name} {record.image}")
        write_manifest(part / "manifest.csv", records)
        write_rig(part / "rig.json", RIG)
        place = PlaceRecord(latitude_deg=32.8, longitude_deg=34.9)
        about = PicturesRecord(source="imported", datum=place, vertical_datum=level)
        about.write(part / "survey.json")

    def plan_it(part: Path) -> None:
        write_json(part / "plan.json", plan.to_json())

    for name, function in (("images", work), ("plan", plan_it)):
        run_stage(folder, Stage(name=name, version=1, settings={}), function)
    return folder


def test_every_picture_keeps_its_bytes_camera_and_order(tmp_path: Path) -> None:
    dives = [dive(tmp_path / "one", 3), dive(tmp_path / "two", 2)]
    both = tmp_path / "both"

    join_dives(both, dives)

    records = read_manifest(both / "images" / "manifest.csv")
    assert [r.station for r in records] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    for record in records:
        number, _, name = record.image.partition("/")
        source = dives[int(number.removeprefix("dive")) - 1]
        copy = (both / "images" / record.image).read_bytes()
        assert copy == (source / "images" / name).read_bytes()
        assert record.camera == Path(name).parent.name
    times = np.array([r.time_s for r in records[::2]])
    np.testing.assert_allclose(np.diff(times)[[0, 1, 3]], 2.0)
    assert np.diff(times)[2] > 3600.0
    assert is_imported(both)
    written = rig_file(both)
    assert written is not None
    assert list(read_rig(written).cameras) == ["left", "right"]
    before = (both / "images" / "manifest.csv").stat().st_mtime_ns
    join_dives(both, dives)
    assert (both / "images" / "manifest.csv").stat().st_mtime_ns == before


def test_the_plan_of_both_dives_holds_all_lines(tmp_path: Path) -> None:
    second = replace(PLAN, lines=PLAN.lines[:2])
    dives = [dive(tmp_path / "one", 2), dive(tmp_path / "two", 2, plan=second)]

    join_dives(tmp_path / "both", dives)

    whole = read_plan(tmp_path / "both" / "plan" / "plan.json")
    count = len(PLAN.lines)
    assert whole.lines == PLAN.lines + second.lines
    assert whole.area.survey.equals(PLAN.area.survey)
    assert whole.dives[1].first_line == count
    flown = {leg.line for leg in whole.dives[1].route.legs}
    assert min(flown - {-1}) == count
    stations = stations_of_plan(replace(PLAN, lines=PLAN.lines))
    assert (assign_lines(stations, whole) == stations.line).all()


def test_dives_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    one, two = dive(tmp_path / "one", 2), dive(tmp_path / "two", 2, level="NN2000")
    three, both = dive(tmp_path / "three", 2), tmp_path / "both"
    write_rig(three / "images" / "rig.json", RIG.in_water(1.36))
    renew_outputs(three / "images", [three / "images" / "rig.json"])
    elsewhere = replace(PLAN, area=replace(PLAN.area, datum=Datum(32.0, 34.0)))
    four = dive(tmp_path / "four", 2, plan=elsewhere)
    for workspace, other, fault, named in (
        (both, two, ImageError, "--vertical-datum"), (both, three, CalibrationError, "--rig"),
        (both, one, WorkspaceError, "each once"), (one, two, WorkspaceError, "another with -w"),
        (both, tmp_path / "none", WorkspaceError, "import-images"),
        (both, four, PlanError, "different datums"),
    ):  # fmt: skip
        with pytest.raises(fault, match=named):
            join_dives(workspace, [one, other])
