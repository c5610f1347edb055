"""The vehicle log: what is written is read, what is wrong is reported, and nothing is lost."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import rotation_from_attitude
from alice_survey.sim.vehicle.log import VehicleLog, read_vehicle_log, write_vehicle_log


def a_log(count: int = 40) -> VehicleLog:
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.04, 0.06, count))
    angles = rng.uniform(-0.5, 0.5, (3, count)) * np.array([[1.0], [1.0], [6.0]])
    velocity = rng.normal(size=(count, 3))
    velocity[::3] = np.nan
    return VehicleLog(
        time_s=time_s,
        position_ned=rng.normal(size=(count, 3)),
        quaternion_xyzw=rotation_from_attitude(*angles).as_quat(),
        velocity_body=velocity,
        rates_body=rng.normal(size=(count, 3)),
        altitude_m=rng.uniform(1, 3, count),
        rpm={"port": rng.normal(0, 900, count), "bow": rng.normal(0, 900, count)},
    )


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "dive.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    log = a_log()
    write_vehicle_log(tmp_path / "dive.csv", log)
    read = read_vehicle_log(tmp_path / "dive.csv")
    for name in ("time_s", "position_ned", "velocity_body", "rates_body", "altitude_m", "wrench"):
        np.testing.assert_allclose(getattr(read, name), getattr(log, name), rtol=0, atol=6e-10)
    np.testing.assert_allclose(read.attitude_rad, log.attitude_rad, rtol=0, atol=2e-11)
    assert list(read.rpm) == ["port", "bow"]
    np.testing.assert_allclose(read.rpm["bow"], log.rpm["bow"], rtol=0, atol=6e-10)
    write_vehicle_log(tmp_path / "again.csv", read)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "dive.csv").read_bytes()


def test_attitude_reads_from_angles_and_from_quaternions(tmp_path: Path) -> None:
    # Heading 90 degrees: the bow points east, so (0, 0, sin 45, cos 45).
    half = np.sqrt(0.5)
    angles = written(tmp_path, "time_s,roll_deg,pitch_deg,heading_deg\n0,0,0,90\n1,,0,0\n")
    first = read_vehicle_log(angles)
    np.testing.assert_allclose(first.quaternion_xyzw[0], [0, 0, half, half], atol=1e-12)
    assert np.all(np.isnan(first.quaternion_xyzw[1]))
    text = f"time_s,quat_x,quat_y,quat_z,quat_w\n0,0,0,{half:.6f},{half:.6f}\n"
    np.testing.assert_allclose(
        read_vehicle_log(written(tmp_path, text)).attitude_rad[0], [0, 0, np.pi / 2], atol=1e-12
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "dive"),
        ("time_s,u_mps\n", "dive"),
        ("time,u_mps\n0,1\n", "column time_s "),
        ("time_s,u_mps\n0,1\n2,1\n1,1\n", "row 3: time_s"),
        ("time_s,u_mps\n0,1\n,1\n", "row 2: time_s"),
        ("time_s,u_mps\n0,1\n1,fast\n", "line 3: u_mps"),
        ("time_s,u_mps\n0,1\n1,inf\n", "line 3: u_mps"),
        ("time_s,u_mps\n0,1\n1\n", "line 3: "),
        ("time_s,u_mps,u_mps\n0,1,1\n", "'u_mps'"),
        ("time_s,roll_deg,heading_deg\n0,1,1\n", "pitch_deg"),
        ("time_s,quat_x,quat_y,quat_z,quat_w\n0,0,0,0,0.5\n", "row 1: "),
        ("time_s,roll_deg,quat_x\n0,1,1\n", "dive"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(VehicleError, match="dive") as raised:
        read_vehicle_log(written(tmp_path, text))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)
