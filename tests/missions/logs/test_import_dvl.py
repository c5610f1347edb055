"""Logs of Doppler logs and attitudes become navigation whose sigma grows."""

import json
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from missions.logs.dead_reckoning import TrackErrors
from missions.logs.import_log import ImportOptions, read_dive
from missions.logs.ros_builder import flipped_quaternion
from tests.missions.logs.log_files import Bag, imported, numbers
from tests.missions.logs.test_import_bag import START

DATUM = Datum(43.05, 5.92)
RADIUS_M, SPEED_MPS, STEP_S, COUNT = 6.0, 0.4, 0.2, 600
FIX = (DATUM.latitude_deg, DATUM.longitude_deg, 0.0)


TIME_S = np.arange(COUNT, dtype=float) * STEP_S
COURSE = SPEED_MPS / RADIUS_M * TIME_S
PLACES = RADIUS_M * np.column_stack([np.sin(COURSE), 1 - np.cos(COURSE)])
"""A circle to starboard that starts northwards."""
TURN = rotation_from_attitude(np.deg2rad(5.0), 0.0, COURSE + np.deg2rad(-10.0))
"""Crabbing by 10 degrees to port with 5 degrees of roll."""
BODY_MPS = TURN.inv().apply(
    SPEED_MPS * np.column_stack([np.cos(COURSE), np.sin(COURSE), 0.0 * COURSE])
)


def dive(version: int = 2, *, twist: str | None = None, fix: bool = True, lost: int = 0) -> Bag:
    """The circle, 8 m deep."""
    bag = Bag(version)
    for i, (t, turn, speed) in enumerate(zip(TIME_S, TURN.as_quat(), BODY_MPS, strict=True)):
        stamp = START + round(t * 1e9)
        bag.add_imu(stamp, "/imu", "imu", flipped_quaternion(turn))
        if twist is None:
            bag.add_dvl(stamp, "/dvl/data", speed, 2.0, valid=not 100 <= i < 100 + lost)
        else:
            bag.add_twist(stamp, "/dvl/twist", twist, speed * [1, -1, -1])
        bag.add_pressure(stamp, "/pressure", 101325.0 + 1025.0 * 9.80665 * 8.0)
    if fix:
        bag.add_fix(START, "/gps", FIX)
    return bag


def track(folder: Path) -> Array:
    place = numbers(folder, "latitude_deg", "longitude_deg", "depth_m")
    return DATUM.ned_from_geodetic(place[np.isfinite(place).all(axis=1)])


@pytest.mark.parametrize(("version", "twist"), [(1, None), (2, None), (2, "base_link")])
def test_a_circle_closes(tmp_path: Path, version: int, twist: str | None) -> None:
    log = dive(version, twist=twist).write(tmp_path / ("d.bag" if version == 1 else "d"))
    data = imported(log, dead_reckon=TrackErrors())
    found = track(tmp_path)
    # Chords of trapezoids are within (angle of a step)^2 / 12 of the arcs.
    np.testing.assert_allclose(found[:, :2], PLACES, atol=2e-3)
    np.testing.assert_allclose(found[:, 2], 8.0, atol=1e-3)
    sigma = numbers(tmp_path, "sigma_horizontal_m")
    # The fix's variances, 4 and 16 m^2, those of scale and heading, which grow with the distance
    # from it alone and so shrink again as the circle closes, and the noise's, with time.
    away = np.sum(np.square(PLACES), axis=1)
    constant = 0.5 * (0.005**2 + np.deg2rad(1.0) ** 2) * away
    expected = np.sqrt(10.0 + constant + 0.02**2 * np.arange(COUNT) * STEP_S)
    np.testing.assert_allclose(sigma, expected, rtol=1e-4)
    assert data["sources"]["position"].endswith("dead reckoning")
    altitude = numbers(tmp_path, "altitude_m")
    if twist is None:
        np.testing.assert_allclose(altitude, 2.0 * np.cos(np.deg2rad(5.0)), atol=1e-4)


def test_without_a_fix_a_start_is_asked_for_and_used(tmp_path: Path) -> None:
    log = dive(fix=False).write(tmp_path / "d")
    with pytest.raises(NavigationError, match="--start-at"):
        imported(log, dead_reckon=TrackErrors())
    imported(log, dead_reckon=TrackErrors(), start_at=(*FIX[:2], 5.0))
    np.testing.assert_allclose(track(tmp_path)[:, :2], PLACES, atol=2e-3)
    assert numbers(tmp_path, "sigma_horizontal_m")[0] == pytest.approx(5.0, rel=1e-3)


def test_loss_of_bottom_lock_ends_the_track(tmp_path: Path) -> None:
    data = imported(dive(lost=100).write(tmp_path / "d"), dead_reckon=TrackErrors())
    assert len(track(tmp_path)) == 100
    assert data["left_out"]["velocities in stretches without a fix"] == COUNT - 200
    assert any("1 gaps in the velocity" in note for note in data["notes"])


def reports() -> list[str]:
    """The same circle as a Water Linked DVL reports it, with noise between the lines."""
    lines = ['{"type": "veloc', '{"type": "config", "x": 1}']
    yaws = (np.rad2deg(COURSE) - 10.0 + 180.0) % 360.0 - 180.0
    for valid, yaw, v in zip(START / 1e9 + TIME_S, yaws, BODY_MPS, strict=True):
        report = {"time": 1e3 * STEP_S, "vx": v[0], "vy": v[1], "vz": v[2], "altitude": 2.0,
                  "velocity_valid": True, "status": 0, "type": "velocity",
                  "time_of_validity": round(valid * 1e6)}  # fmt: skip
        lines.append(json.dumps(report))
        place = {"ts": valid, "x": 99, "y": 99, "z": 9, "roll": 5.0, "pitch": 0.0, "yaw": yaw}
        lines.append(json.dumps({**place, "type": "position_local", "status": 0}))
    return lines


def test_reports_of_a_water_linked_dvl_close_the_circle(tmp_path: Path) -> None:
    log = tmp_path / "dvl.json"
    log.write_text("\n".join(reports()))
    data = imported(log, dead_reckon=TrackErrors(), start_at=(*FIX[:2], 2.0))
    place = numbers(tmp_path, "latitude_deg", "longitude_deg")
    found = DATUM.ned_from_geodetic(np.column_stack([place, np.zeros(len(place))]))
    np.testing.assert_allclose(found[:, :2], PLACES, atol=2e-3)
    altitude = numbers(tmp_path, "altitude_m")
    np.testing.assert_allclose(altitude, 2.0 * np.cos(np.deg2rad(5.0)), atol=1e-6)
    assert data["dated"]
    assert data["left_out"] == {"lines that are no report": 1}


def test_reports_of_json_v1_are_read(tmp_path: Path) -> None:
    """Without types and dates; a logger wrote each three times, and bottom lock is lost once."""
    lines = []
    for i, v in enumerate(BODY_MPS[:50]):
        held = i != 20
        report = {"time": 1e3 * STEP_S + 1e-3 * i, "vx": v[0], "vy": v[1], "vz": v[2],
                  "fom": 0.003, "altitude": 2.0 if held else -1.0, "velocity_valid": held,
                  "status": 0, "format": "json_v1"}  # fmt: skip
        lines += [json.dumps(report)] * 3
    log = tmp_path / "dvl.txt"
    log.write_text("\n".join(lines))
    dive = read_dive(log, ImportOptions())
    assert dive.velocity_body is not None and dive.altitude is not None and not dive.dated
    np.testing.assert_allclose(dive.velocity_body.time_s, TIME_S[1:51], atol=2e-3)
    expected = np.where(np.arange(50)[:, None] == 20, np.nan, BODY_MPS[:50])
    np.testing.assert_allclose(dive.velocity_body.values, expected)
    assert np.isnan(dive.altitude.values[:, 0]).nonzero()[0].tolist() == [20]
    assert sorted(dive.lost.values()) == [1, 100]
    assert any("0.003 m/s" in note for note in dive.notes)


def test_velocities_of_the_world_are_refused(tmp_path: Path) -> None:
    log = dive(twist="odom").write(tmp_path / "d")
    with pytest.raises(NavigationError, match="does not turn with the body"):
        imported(log, dead_reckon=TrackErrors())
