"""The MAVLink bridge: what it sends, its safe states, and a dive with a vehicle over UDP."""

import json
import math
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from alice_survey.core.artefacts import read_csv
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import VehicleError, collected_by
from missions.fly.simulation import flight_settings
from missions.live.mavlink_pilot import (
    GUIDED,
    SURFACE,
    MavlinkPilot,
    mavlink_to,
    pilot_over_mavlink,
)
from missions.live.mission import LinkLimits, LinkState, mission_of
from tests.missions.live.flights import FLOOR_M, pictures_of, small_plan, workspace_in

ARMED = 128


class Sink:
    """Takes packets, and gives them back as messages."""

    def __init__(self) -> None:
        self.parser = dialect.MAVLink(None)
        self.messages: list[dialect.MAVLink_message] = []

    def write(self, data: bytes) -> None:
        self.messages += self.parser.parse_buffer(data) or []

    def take(self, kind: str) -> list[dialect.MAVLink_message]:
        """All of a kind since the last time."""
        found = [m for m in self.messages if m.get_type() == kind]
        self.messages = [m for m in self.messages if m.get_type() != kind]
        return found


class Vehicle:
    """Packets of a submarine that stays at a place, through the protocol's own encoder."""

    def __init__(self, system: int = 1, **limits: object) -> None:
        plan = small_plan()
        self.mission = mission_of(plan, flight_settings(SurveyConfig()), LinkLimits(**limits))  # type: ignore[arg-type]
        self.sink = Sink()
        self.out = dialect.MAVLink(self.sink, srcSystem=255, srcComponent=191)
        self.pilot = MavlinkPilot(self.mission, self.out, sim_time=False)
        self.own, self.back = dialect.MAVLink(None, srcSystem=system, srcComponent=1), Sink()
        self.wall_s, self.boot_s = 5000.0, 20.0
        self.mode, self.armed = GUIDED, True

    def say(self, message: dialect.MAVLink_message) -> None:
        message.pack(self.own)
        (heard,) = self.back.parser.parse_buffer(message.get_msgbuf())
        self.pilot.hear(heard, self.wall_s)

    def heartbeat(self) -> None:
        base = 1 | (ARMED if self.armed else 0)
        self.say(self.own.heartbeat_encode(12, 3, base, self.mode, 4))

    def origin(self) -> None:
        datum = self.mission.plan.datum
        place = [round(d * 1e7) for d in (datum.latitude_deg, datum.longitude_deg)]
        self.say(self.own.gps_global_origin_encode(*place, 0))

    def motion(self, *, north: float = -1.6, depth: float = 4.0, late_s: float = 0.0) -> None:
        stamp = round((self.boot_s - late_s) * 1e3)
        roll = 1e-5 * math.sin(stamp)  # what lies still to the last bit is not flown
        self.say(self.own.attitude_encode(stamp, roll, 0.0, 0.3, 0.0, 0.0, 0.0))
        self.say(self.own.rangefinder_encode(FLOOR_M - depth, 0.0))
        self.say(self.own.local_position_ned_encode(stamp, north, 0.0, depth, 0.0, 0.0, 0.0))

    def step(
        self, count: int = 1, *, moves: bool = True, beats: bool = True, **motion: float
    ) -> None:
        for _ in range(count):
            self.wall_s += 0.05
            self.boot_s += 0.05
            if beats:
                self.heartbeat()
            if moves:
                self.motion(**motion)
            self.pilot.step(self.wall_s)

    def targets(self) -> list[dialect.MAVLink_message]:
        return self.sink.take("SET_POSITION_TARGET_LOCAL_NED")


@pytest.fixture
def flying() -> Vehicle:
    """A vehicle that is being flown."""
    return flown()


def flown(north: float = -1.6, depth: float = 4.0) -> Vehicle:
    vehicle = Vehicle()
    vehicle.heartbeat()
    vehicle.origin()
    vehicle.step(20, north=north, depth=depth)
    assert vehicle.mission.loop.state == LinkState.FLYING
    vehicle.targets()
    return vehicle


def test_setpoints_are_velocities_in_ned_and_a_heading() -> None:
    """The vehicle is 1 m above the wanted depth, 2 m off the start: it is sent down and there."""
    flying = flown(north=-3.0, depth=2.5)
    flying.step(1, north=-3.0, depth=2.5)
    (target,) = flying.targets()
    assert (target.target_system, target.target_component) == (1, 1)
    assert target.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
    # Positions, accelerations and the rate of the yaw are not to be followed.
    assert target.type_mask == 0b100111000111
    command = flying.mission.loop.tick(float(flying.mission.rows[-1][0]))
    c, s = math.cos(0.3), math.sin(0.3)
    surge, sway, heave = command.velocity_body
    expected = [c * surge - s * sway, s * surge + c * sway, heave]
    np.testing.assert_allclose([target.vx, target.vy, target.vz], expected, atol=1e-6)
    assert 0.05 < target.vz < 0.6
    assert np.hypot(target.vx, target.vy) > 0.01
    assert target.yaw == pytest.approx(command.heading_rad, abs=1e-6)


@pytest.mark.parametrize(("mode", "armed"), [(19, True), (GUIDED, False)])
def test_nothing_is_commanded_before_the_operator_clears_it(mode: int, armed: bool) -> None:
    vehicle = Vehicle()
    vehicle.mode, vehicle.armed = mode, armed
    vehicle.heartbeat()
    vehicle.origin()
    vehicle.step(100)
    assert not vehicle.targets()
    assert vehicle.mission.loop.ticks == 0
    vehicle.mode, vehicle.armed = GUIDED, True
    vehicle.step(5)
    assert vehicle.targets()


def test_lost_position_stops_then_surfaces(flying: Vehicle) -> None:
    flying.step(15, moves=False)
    flying.targets()
    flying.step(80, moves=False)
    stops = flying.targets()
    assert len(stops) >= 79
    for target in stops:
        assert (target.vx, target.vy, target.vz) == (0.0, 0.0, 0.0)
        assert target.type_mask & 1024
    flying.step(60, moves=False)
    assert flying.mission.loop.state == LinkState.GIVEN_UP
    modes = [m for m in flying.sink.take("COMMAND_LONG") if m.command == 176]
    assert modes
    assert {(m.param1, m.param2) for m in modes} == {(1.0, float(SURFACE))}
    flying.mode = SURFACE
    flying.step(1, moves=False)
    assert flying.mission.loop.ending.startswith("given up")


@pytest.mark.parametrize("spoilt", ["late", "nan", "no heartbeat", "rebooted"])
def test_what_is_not_of_now_is_not_flown_by(flying: Vehicle, spoilt: str) -> None:
    if spoilt == "late":
        flying.step(30, late_s=0.7)
    elif spoilt == "nan":
        flying.step(30, north=math.nan)
    elif spoilt == "no heartbeat":
        flying.step(80, beats=False)
    else:
        flying.boot_s = 1.0
        flying.step(30)
    assert flying.mission.loop.state == LinkState.HELD
    last = flying.targets()[-1]
    assert (last.vx, last.vy, last.vz) == (0.0, 0.0, 0.0)


def test_a_serial_port_without_its_library_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(VehicleError, match=r"pip install .*pymavlink"):
        mavlink_to("/dev/ttyACM0,115200")


def test_what_it_waits_for_is_noted_at_once() -> None:
    notes: list[str] = []
    mission = Vehicle().mission
    mission.loop.end("over before it begins")
    with collected_by(lambda level, text: notes.append(text)):
        pilot_over_mavlink(mission, "udpin:127.0.0.1:0", sim_time=False)
    assert len(notes) == 1 and "udpin:127.0.0.1:0" in notes[0]


def test_vehicle_without_an_origin_is_given_the_datum() -> None:
    vehicle = Vehicle()
    vehicle.heartbeat()
    vehicle.step(110)
    asked = [m for m in vehicle.sink.take("COMMAND_LONG") if m.command == 512]
    (given, *_) = vehicle.sink.take("SET_GPS_GLOBAL_ORIGIN")
    assert len(asked) >= 4
    assert {m.param1 for m in asked} == {49.0}
    datum = vehicle.mission.plan.datum
    assert given.latitude * 1e-7 == pytest.approx(datum.latitude_deg, abs=1e-7)
    assert given.longitude * 1e-7 == pytest.approx(datum.longitude_deg, abs=1e-7)
    assert not vehicle.targets()


def dive_over_udp(folder: Path, *fault: str) -> subprocess.CompletedProcess[str]:
    """The command flies a vehicle of another process, whose own loops follow the set-points."""
    settings = workspace_in(folder) / "survey.toml"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    track, record = folder / "track.csv", folder / "record.csv"
    program = [sys.executable, "-m", "tests.missions.live.fake_ardusub"]
    fake = subprocess.Popen([*program, str(port), str(settings), str(track), *fault])
    try:
        ended = subprocess.run(
            [
                sys.executable, "-m", "alice_survey", "pilot", "-w", str(folder), "--sim-time",
                "--mavlink", f"udpin:127.0.0.1:{port}", "--record", str(record), "--json",
            ],
            capture_output=True, text=True, timeout=900, check=False,
        )  # fmt: skip
        fake.wait(240)
    finally:
        fake.kill()
    return ended


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "why"), [("nan", "not a number"), ("frozen", "not change")])
def test_wrong_positions_over_udp_end_with_exit_code_3(
    tmp_path: Path, fault: str, why: str
) -> None:
    ended = dive_over_udp(tmp_path, fault)
    assert ended.returncode == 3, ended.stderr
    found = json.loads(ended.stdout)
    assert found["ending"].startswith("given up")
    assert any(why in kind for kind in found["refused"])


@pytest.mark.slow
def test_dive_over_udp(tmp_path: Path) -> None:
    ended, track, record = dive_over_udp(tmp_path), tmp_path / "track.csv", tmp_path / "record.csv"
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["ending"] == "complete"

    _, truth = read_csv(track)
    true = np.array([[float(cell) for cell in row.values()] for _, row in truth])
    at_s, lines = pictures_of(record, -1.0)
    assert lines == (0,) * 6 + (1,) * 6
    # The body's origin is 0.55 m behind the glass, and 0.05 m to starboard of it.
    north = np.interp(at_s, true[:, 0], true[:, 1])
    east = np.interp(at_s, true[:, 0], true[:, 2])
    there = np.array([*np.linspace(0, 4, 6) - 0.55, *np.linspace(4, 0, 6) + 0.55])
    np.testing.assert_allclose(north, there, atol=0.15)
    np.testing.assert_allclose(east, [0.05] * 6 + [0.95] * 6, atol=0.15)
