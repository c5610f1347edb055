"""Vehicle files, coefficient files and foreign logs."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle import vehicle as vehicles
from alice_survey.sim.vehicle.coefficients import Coefficients
from alice_survey.sim.vehicle.identification.problem import inputs, make_windows
from alice_survey.sim.vehicle.log import VehicleLog, read_column_map, read_foreign_log

HERE = Path(__file__).parent
SMALL = """
[rigid_body]
dry_kg = 10.0
buoyancy_kg = 10.0
entrained_kg = 0.0
cg_body_m = [0.0, 0.0, 0.02]
inertia_kg_m2 = [0.2, 0.3, 0.3]
[coefficients]
X_uu = -20
[[thrusters]]
name = "left"
position_body_m = [-0.2, -0.3, 0.0]
direction_body = [1.0, 0.0, 0.0]
[[thrusters]]
name = "right"
position_body_m = [-0.2, 0.3, 0.0]
direction_body = [1.0, 0.0, 0.0]
"""


def small(tmp_path: Path, text: str = SMALL) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(text)
    return path


def test_any_thruster_matrix_comes_from_a_file(tmp_path: Path) -> None:
    made = vehicles.vehicle_from(str(small(tmp_path)))
    assert made.name == "small"
    assert made.coefficients.values == {"X_uu": -20.0}
    log = VehicleLog(
        time_s=np.arange(3.0),
        thrust_n={"left": np.array([1.0, 2, 3]), "right": np.array([1.0, 0, -3])},
    )
    rps, wrench = inputs(log, made)
    assert rps.shape == (3, 0)
    # More thrust to port turns the bow to starboard: 0.3 m times the difference.
    np.testing.assert_allclose(wrench[:, 0], [2, 2, 0])
    np.testing.assert_allclose(wrench[:, 5], [0, 0.6, 1.8])
    assert vehicles.speeds_missing(small(tmp_path)) == [
        "left (diameter_m, kt_forward, kt_reverse, time_constant_s)",
        "right (diameter_m, kt_forward, kt_reverse, time_constant_s)",
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dry_kg = 10.0\n", "", "rigid_body.dry_kg"),
        ("dry_kg = 10.0", "weight = 10.0", "rigid_body.weight"),
        ("dry_kg = 10.0", "dry_kg = 'ten'", "rigid_body.dry_kg"),
        ("[0.0, 0.0, 0.02]", "0.02", "rigid_body.cg_body_m"),
        ("X_uu", "X_zz", "X_zz"),
        ('name = "right"', 'name = "left"', "thrusters"),
        ('name = "right"', "", "thrusters.1.name"),
        ("[rigid_body]", "[rigid]", "rigid"),
        ("[rigid_body]", "[rigid_body", "small.toml"),
    ],
)
def test_faults_of_vehicle_files_are_named(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in SMALL
    with pytest.raises(VehicleError) as raised:
        vehicles.vehicle_from_file(small(tmp_path, SMALL.replace(old, new, 1)))
    assert message in str(raised.value)


def test_coefficients_go_through_a_file(tmp_path: Path) -> None:
    known = Coefficients(name="found", values={"X_uu": -12.3456789012, "Y_rdot": 1.5})
    vehicles.write_coefficients(
        tmp_path / "c.json", known, {"vehicle": "alice", "values_of": "nothing"}
    )
    read = vehicles.coefficients_from_file(tmp_path / "c.json")
    assert (read.name, read.values) == ("found", known.values)
    plain = tmp_path / "plain.toml"
    plain.write_text("X_uu = -3\n")
    assert vehicles.coefficients_from_file(plain).values == {"X_uu": -3.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": "else 2", "values": {"X_uu": 1}}', "'else 2'"),
        ("{}", r"found\.json"),
        ('{"X_uu": -14.0, "Y_vv": 300.0}', r"found\.json: Y_vv"),  # damping must damp
        ('{"a": -14.0}', r"found\.json: .*\'a\'"),
    ],
)
def test_wrong_coefficient_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "found.json").write_text(text)
    with pytest.raises(VehicleError, match=message):
        vehicles.coefficients_from_file(tmp_path / "found.json")


def test_foreign_axes_become_ours(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(
        'time = "ns"\ntime_unit_s = 1e-9\nbody = "flu"\nworld = "enu"\n'
        'position = ["x", "y", "z"]\nquaternion_xyzw = ["qx", "qy", "qz", "qw"]\n'
        'velocity = ["u", "v", "w"]\nrates = ["p", "q", "r"]\n'
        'wrench = ["fx", "fy", "fz", "tx", "ty", "tz"]\nrpm = {}\nthrust = {main = "m1"}\n'
    )
    # Heading east in ENU is a turn of 0; 30 degrees to port of that is a heading of 60 degrees.
    q = Rotation.from_euler("ZYX", [30.0, -10.0, 20.0], degrees=True).as_quat()
    row = [5_000_000_000, 1, 2, -3, *q, 0.5, 0.1, -0.2, 0.01, 0.02, 0.03, 1, 2, 3, 4, 5, 6, 7]
    other = [6_000_000_000, *row[1:]]
    names = "ns,x,y,z,qx,qy,qz,qw,u,v,w,p,q,r,fx,fy,fz,tx,ty,tz,m1"
    lines = [names, *(",".join(str(value) for value in r) for r in (row, other))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    log = read_foreign_log(tmp_path / "log.csv", read_column_map(tmp_path / "map.toml"))
    np.testing.assert_allclose(log.time_s, [0, 1])
    np.testing.assert_allclose(log.position_ned[0], [2, 1, 3])
    # Pitch: nose down by ROS's sign of -10 is nose up by ours of +10; roll keeps its sign.
    np.testing.assert_allclose(np.rad2deg(log.attitude_rad[0]), [20, 10, 60], atol=1e-9)
    np.testing.assert_allclose(log.velocity_body[0], [0.5, -0.1, 0.2])
    np.testing.assert_allclose(log.rates_body[0], [0.01, -0.02, -0.03])
    np.testing.assert_allclose(log.wrench[0], [1, -2, -3, 4, -5, -6])
    assert log.thrust_n["main"].tolist() == [7, 7]


def test_missing_inputs_are_held_but_not_for_long(capsys: pytest.CaptureFixture[str]) -> None:
    known, time_s = vehicles.vehicle_from("alice"), np.arange(60.0) * 0.1
    rpm = {t.name: np.full(60, 600.0) for t in known.thrusters}
    rpm["port"][10:14] = np.nan
    rpm["port"][30:50] = np.nan
    log = VehicleLog(
        time_s=time_s, quaternion_xyzw=np.tile([0.0, 0, 0, 1], (60, 1)),
        velocity_body=np.zeros((60, 3)),
        rpm=rpm,
    )  # fmt: skip
    first, second = make_windows(log, known)
    assert (len(first.record.time_s), len(second.record.time_s)) == (40, 10)
    np.testing.assert_array_equal(first.record.rps, 10.0)
    assert "10 of 60 rows" in capsys.readouterr().err
