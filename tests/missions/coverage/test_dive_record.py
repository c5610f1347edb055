import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import rotation_from_attitude
from alice_survey.core.trajectory import Trajectory, write_track
from missions.coverage.dive_record import DiveRecord, assign_lines, read_dive_record
from missions.coverage.stations import Stations, stations_of_plan
from missions.values.navigation import write_navigation
from tests.missions.coverage.logs import log_of, write_triggers
from tests.missions.exports.plans import RIG
from tests.oracles_coverage import DATUM, area_of, lawnmower, plan_of, stations_at

LINES = lawnmower(6.0, 3.0, 1.0, 0.46, over_m=0.5)
PLAN = plan_of(area_of(shapely.box(0, 0, 6, 3)), LINES)


def leaning_flight() -> Stations:
    """The plan's stations flown with some roll, pitch and altitude, 2.3 s apart."""
    exact = stations_of_plan(PLAN)
    rng = np.random.default_rng(5)
    tilt = np.deg2rad(rng.normal(0, 3, (len(exact), 2)))
    attitude = np.column_stack([tilt, exact.attitude_rad[:, 2]])
    time_s = 100.0 + PLAN.interval_s * np.arange(len(exact), dtype=float)
    altitude_m = rng.uniform(1.8, 2.2, len(exact))
    return replace(exact, attitude_rad=attitude, altitude_m=altitude_m, time_s=time_s)


@dataclass(frozen=True)
class LoggedFlight:
    """A navigation CSV, its triggers, and the stations they were made of."""

    folder: Path
    flown: Stations

    def edited(
        self, change: dict[str, str], rows: slice = slice(None), of: Path | None = None
    ) -> Path:
        """The log, or another, with columns set to a text in some rows."""
        with (of or self.folder / "nav.csv").open(newline="") as file:
            table = list(csv.DictReader(file))
        for row in table[rows]:
            row.update(change)
        out = self.folder / f"edited{len(list(self.folder.iterdir()))}.csv"
        write_csv(out, list(table[0]), [list(row.values()) for row in table])
        return out

    def record(self, log: Path | None = None, triggers: str | None = "triggers.csv") -> DiveRecord:
        at = {} if triggers is None else {"triggers": self.folder / triggers}
        return read_dive_record(log or self.folder / "nav.csv", PLAN, RIG, **at)

    def refusal(self, log: Path | None = None, triggers: str = "triggers.csv") -> str:
        with pytest.raises(NavigationError) as fault:
            self.record(log, triggers)
        return str(fault.value)


@pytest.fixture
def dive(tmp_path: Path) -> LoggedFlight:
    flown = leaning_flight()
    write_navigation(tmp_path / "nav.csv", log_of(flown, PLAN, RIG), DATUM)
    write_triggers(tmp_path / "triggers.csv", flown)
    return LoggedFlight(tmp_path, flown)


def assert_alike(found: Stations, expected: Stations, place_m: float = 2e-5) -> None:
    np.testing.assert_allclose(found.glass_ne, expected.glass_ne, atol=place_m)
    np.testing.assert_allclose(found.altitude_m, expected.altitude_m, atol=2e-5)
    np.testing.assert_allclose(
        np.exp(1j * found.attitude_rad), np.exp(1j * expected.attitude_rad), atol=1e-7
    )
    np.testing.assert_array_equal(found.line, expected.line)


def test_a_log_gives_back_where_its_pictures_were_taken(
    dive: LoggedFlight, capsys: pytest.CaptureFixture[str]
) -> None:
    record = dive.record()

    assert_alike(record.stations, dive.flown)
    assert (record.triggered, record.left_out, record.notes) == (len(dive.flown), {}, ())
    assert capsys.readouterr().err == ""


def test_lines_are_found_where_triggers_name_none(dive: LoggedFlight) -> None:
    flown = dive.flown
    write_triggers(dive.folder / "bare.csv", flown, columns=2)
    assert_alike(dive.record(triggers="bare.csv").stations, flown)

    # Without triggers the plan's interval counts from the start of the log.
    record = dive.record(triggers=None)
    assert "interval" in record.triggers
    assert_alike(record.stations, flown.some(np.arange(len(flown) - 1)))


def test_triggers_in_a_gap_and_beyond_the_log_are_counted(
    dive: LoggedFlight, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = list(csv.reader((dive.folder / "nav.csv").read_text().splitlines()))
    gappy = dive.folder / "gappy.csv"
    # Rows every 2.3 s: nothing is interpolated over more than 5 of these.
    write_csv(gappy, rows[0], [*rows[1:11], *rows[31:-3]])

    record = dive.record(gappy)

    assert_alike(record.stations, dive.flown.some(np.r_[0:10, 30 : len(dive.flown) - 3]))
    assert list(record.left_out.values()) == [3, 20]
    assert record.gaps[0] == pytest.approx((100.0 + 9 * 2.3, 21 * 2.3))
    warnings = capsys.readouterr().err
    assert "48.3 s from 120.7 s" in warnings
    assert warnings.count("\n") == 1  # the rest is said once, in the report


def test_a_log_without_altitude_uses_depth_and_sea_floor(
    dive: LoggedFlight, capsys: pytest.CaptureFixture[str]
) -> None:
    record = dive.record(dive.edited({"altitude_m": ""}))

    assert_alike(record.stations, dive.flown)  # the test's sea floor is level at the plan's depth
    assert f"{len(dive.flown)} of {len(dive.flown)}" in record.notes[0]
    assert "15 m" in record.notes[0]
    assert capsys.readouterr().err == ""


def test_a_log_without_depth_uses_altitude(dive: LoggedFlight) -> None:
    record = dive.record(dive.edited({"depth_m": ""}))
    assert_alike(record.stations, dive.flown, place_m=1e-3)  # a degree is shorter at depth
    blind = {"depth_m": "", "altitude_m": ""}
    assert "neither depth_m nor altitude_m" in dive.refusal(dive.edited(blind))
    record = dive.record(dive.edited(blind, slice(0, 9)))
    assert record.left_out == {"without a depth or an altitude": 9}


def test_a_log_without_attitude_is_level_along_its_track(dive: LoggedFlight) -> None:
    record = dive.record(dive.edited({"roll_deg": "", "pitch_deg": "", "heading_deg": ""}))

    assert np.all(record.stations.attitude_rad[:, :2] == 0.0)
    away = record.stations.attitude_rad[:, 2] - dive.flown.attitude_rad[:, 2]
    inner = np.ones(len(dive.flown), dtype=bool)
    ends = np.flatnonzero(np.diff(dive.flown.line))
    inner[[0, *ends, *(ends + 1), -1]] = False  # there the course is that of the way to the next
    assert np.abs(np.angle(np.exp(1j * away[inner]))).max() < math.radians(6.0)
    assert len(record.notes) == 2


def test_pictures_from_high_above_and_from_below_do_not_count(dive: LoggedFlight) -> None:
    high = dive.edited({"altitude_m": "3.01"}, slice(8, 13))

    record = dive.record(dive.edited({"altitude_m": "-0.2"}, slice(5, 7), high))

    assert_alike(record.stations, dive.flown.some(np.r_[0:5, 7:8, 13 : len(dive.flown)]))
    assert sorted(record.left_out.values()) == [2, 5]
    assert record.on_way == 0


def test_triggers_on_the_way_down_and_up_are_not_amiss(dive: LoggedFlight) -> None:
    down = dive.edited({"altitude_m": "9"}, slice(0, 6))
    gap = dive.edited({"altitude_m": "4"}, slice(20, 22), down)

    record = dive.record(dive.edited({"altitude_m": "3.5"}, slice(-3, None), gap))

    assert record.on_way == record.to_json()["on_way"] == 6 + 3
    assert list(record.left_out.values()) == [2]
    assert len(record.stations) == len(dive.flown) - 11


def test_logs_of_elsewhere_or_another_time_are_refused(dive: LoggedFlight) -> None:
    assert "11.1 km" in dive.refusal(dive.edited({"latitude_deg": "32.9236"}))
    nav = (dive.folder / "nav.csv").read_text()
    turned = nav.replace("latitude_deg,longitude_deg", "longitude_deg,latitude_deg", 1)
    (dive.folder / "turned.csv").write_text(turned)
    assert "longitudes" in dive.refusal(dive.folder / "turned.csv")

    late, count = np.asarray(dive.flown.time_s) + 1e6, len(dive.flown)
    write_triggers(dive.folder / "late.csv", replace(dive.flown, time_s=late))
    assert f"{count} triggers" in dive.refusal(triggers="late.csv")
    write_triggers(dive.folder / "back.csv", dive.flown.some(np.arange(count)[::-1]))
    assert "line 3" in dive.refusal(triggers="back.csv")
    (dive.folder / "none.csv").write_text("station,when\n0,1\n")
    assert "time_utc" in dive.refusal(triggers="none.csv")
    (dive.folder / "dates.csv").write_text("time_utc\n2024-05-01T12:00:00Z\n")
    assert "dates.csv" in dive.refusal(triggers="dates.csv")


def test_a_simulated_flight_counts_by_its_true_track(tmp_path: Path) -> None:
    flown = leaning_flight()
    log = log_of(flown, PLAN, RIG)
    believed = replace(log, position_ned=log.position_ned + np.array([3.0, 0.0, 0.5]))
    write_navigation(tmp_path / "navigation.csv", believed, DATUM)
    write_triggers(tmp_path / "triggers.csv", flown)
    rotation = rotation_from_attitude(*log.attitude_rad.T)
    poses = RigidTransform.from_components(log.position_ned, rotation)
    track = Trajectory(time_s=log.time_s, ned_from_body=poses)
    write_track(tmp_path / "truth" / "track.csv", track)

    by_track, drifted = (
        read_dive_record(log, PLAN, RIG).stations for log in (tmp_path, tmp_path / "navigation.csv")
    )
    assert_alike(by_track, flown)
    assert np.all(drifted.glass_ne[:, 0] - flown.glass_ne[: len(drifted), 0] > 2.9)


def test_straight_runs_off_the_plan_are_separate_lines() -> None:
    """A straight run across, between lines too far off, and single pictures in a turn."""
    exact = stations_of_plan(PLAN)
    run = np.column_stack([np.full(5, 3.0), np.linspace(6.0, 8.0, 5)])
    turning = np.column_stack([np.linspace(20, 21, 4), np.full(4, 20.0)])
    headings = np.concatenate([np.full(5, math.pi / 2), [0.0, 1.5, 3.0, 4.5]])
    level = np.column_stack([np.zeros((9, 2)), headings])
    attitude = np.concatenate([exact.attitude_rad, level])
    places = np.concatenate([exact.glass_ne, run, turning])
    others = stations_at(places, 2.0, attitude_rad=attitude, line=np.full(len(places), -1))

    lines = assign_lines(others, PLAN)

    np.testing.assert_array_equal(lines[: len(exact)], exact.line)
    np.testing.assert_array_equal(lines[-9:-4], len(PLAN.lines))
    np.testing.assert_array_equal(lines[-4:], -1)


def test_a_closing_line_back_along_the_first_has_pictures_of_its_own() -> None:
    back = replace(LINES[0].reverse(), kind="closing")
    closed = plan_of(PLAN.area, [*LINES, back])
    exact = stations_of_plan(closed)
    found = assign_lines(exact, closed)
    off = found != exact.line
    np.testing.assert_array_equal(found[~off], exact.line[~off])
    assert not off[exact.line < len(LINES)].any()
    assert off.sum() <= 1  # the first: where it came from is on another line
