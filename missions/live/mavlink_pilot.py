"""The pilot as a companion computer of ArduSub: velocity and heading set-points over MAVLink.

Of what ArduSub takes from outside, `SET_POSITION_TARGET_LOCAL_NED` in GUIDED with a velocity and a
heading fits best what the pilot knows: where the vehicle should go, by its outer loops. ArduSub's
own loops, tuned for its own vehicle, make the thrust; RC override or attitude targets would need
newtons per stick, which no message states, and would pass by its depth and heading loops. A
velocity set-point also lapses after 3 s: if this program or the link dies the vehicle stops.

Times are of the vehicle's clock since boot. At sea its offset from this machine's clock is the
least delay that was seen, so that messages that come late are found. With `sim_time` the pilot
ticks at each position, by its stamp.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import VehicleError, extra, note
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.simulator import TICK_S
from missions.live.mission import FIRST_S, SILENCE_S, Command, LinkState, LiveMission, Odometry

GUIDED, SURFACE = 4, 9
"""Modes of ArduSub."""
_ARMED, _CUSTOM_MODE = 128, 1
"""Bits of a heartbeat's base mode, and of that command."""
_AUTOPILOT = 1
"""Component of the vehicle that flies it."""
_ONBOARD_COMPUTER_TYPE, _ONBOARD_COMPUTER, _NO_AUTOPILOT = 18, 191, 8
_LOCAL_NED = 1
_NO_POSITION, _NO_ACCELERATION = 0b111, 0b111 << 6
_NO_YAW, _NO_YAW_RATE = 1 << 10, 1 << 11
_SET_MODE, _SET_INTERVAL, _REQUEST = 176, 511, 512
"""MAV_CMD_DO_SET_MODE, _SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE."""
_ATTITUDE, _POSITION, _ORIGIN, _RANGEFINDER = 30, 32, 49, 173
_INTERVALS_US = {_ATTITUDE: 50_000, _POSITION: 50_000, _RANGEFINDER: 100_000}
_HEARTBEAT_S = 3.0
"""A vehicle whose heartbeat is older is lost."""
_APART_S = 0.1
"""Attitude and position are of one moment when they are no farther apart."""
_DRIFT = 2e-4
"""Clocks may drift apart by this share (inferred: 200 ppm)."""
_ASK_S = 1.0
_ASKED_BEFORE_SETTING = 3
"""A vehicle that does not state its origin so many times has none: it is given the datum."""
_WAIT_S = 0.005


def pilot_over_mavlink(mission: LiveMission, address: str, *, sim_time: bool) -> None:
    """Fly a mission with ArduSub until it is over or interrupted.

    Args:
        mission: what to fly.
        address: of pymavlink, such as udpin:127.0.0.1:14550.
        sim_time: tick by the vehicle's clock.

    Raises:
        VehicleError: pymavlink is not installed, the address cannot be opened, or, with `sim_time`,
            the vehicle is silent.
    """
    link = mavlink_to(address, source_component=_ONBOARD_COMPUTER)
    pilot = MavlinkPilot(mission, link.mav, sim_time=sim_time)
    heard, max_s = time.monotonic(), FIRST_S
    note(f"waits for a heartbeat of the autopilot on {address}")
    try:
        while mission.loop.state != LinkState.OVER:
            message = link.recv_match(blocking=True, timeout=_WAIT_S)
            now = time.monotonic()
            if message is not None:
                pilot.hear(message, now)
                heard, max_s = now, SILENCE_S
            elif sim_time and now - heard > max_s:
                raise VehicleError(f"no message came on {address} for {max_s:g} s")
            pilot.step(now)
    finally:
        pilot.farewell()
        link.close()


class MavlinkPilot:
    """A mission and what the vehicle says of itself; the wall's time is an argument."""

    def __init__(self, mission: LiveMission, mav: Any, *, sim_time: bool) -> None:
        """A pilot that has heard nothing yet.

        Args:
            mission: what to fly.
            mav: `MAVLink` of pymavlink's ardupilotmega dialect, which sends.
            sim_time: tick by the vehicle's clock.
        """
        self.mission, self.mav, self.sim_time = mission, mav, sim_time
        self.system: int | None = None
        """The vehicle's system number; None before its first heartbeat."""
        self.mode, self.is_armed = -1, False
        self.has_flown = False
        self._offset: tuple[float, float] | None = None
        self._origin_ned: Array | None = None
        self._attitude: Any = None
        self._heartbeat_wall = -math.inf
        self._asked_wall, self._asked = -math.inf, 0
        self._ticked_wall = -math.inf
        self._stamp_s = 0.0
        self._kinds: dict[str, Callable[[Any, float], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "ATTITUDE": self._on_attitude,
            "LOCAL_POSITION_NED": self._on_position,
            "GPS_GLOBAL_ORIGIN": self._on_origin,
            "RANGEFINDER": self._on_range,
        }

    def hear(self, message: Any, wall_s: float) -> None:
        """Take a message of the vehicle; others are not looked at."""
        kind = message.get_type()
        if kind not in self._kinds or message.get_srcComponent() != _AUTOPILOT:
            return
        if self.system is None and kind == "HEARTBEAT":
            self.system = message.get_srcSystem()
        if message.get_srcSystem() == self.system:
            self._kinds[kind](message, wall_s)

    def step(self, wall_s: float) -> None:
        """Do what is due: ask for what is missing, tick, and say that this computer is there."""
        if wall_s - self._asked_wall >= _ASK_S:
            self._asked_wall = wall_s
            self._ask()
        if not self.sim_time and wall_s - self._ticked_wall >= TICK_S and self._offset is not None:
            # Without drift of the ticks, unless some were missed.
            late = wall_s - self._ticked_wall > 2.0 * TICK_S
            self._ticked_wall = wall_s if late else self._ticked_wall + TICK_S
            self._tick(self._now_s(wall_s), wall_s)

    def farewell(self) -> None:
        """Stop the vehicle, for whatever reason the program ends."""
        self.mission.loop.end("interrupted")
        if self.system is not None and self.mode == GUIDED:
            for _ in range(3):
                self._send_velocity(np.zeros(3), math.nan)

    @property
    def is_cleared(self) -> bool:
        """Whether the vehicle's operator lets this computer fly it."""
        return self.mode == GUIDED and self.is_armed and self._origin_ned is not None

    def _now_s(self, wall_s: float) -> float:
        """Time on the vehicle's clock."""
        if self.sim_time or self._offset is None:
            return self._stamp_s
        return wall_s - self._offset[0]

    def _on_heartbeat(self, message: Any, wall_s: float) -> None:
        self.mode, self.is_armed = message.custom_mode, bool(message.base_mode & _ARMED)
        self._heartbeat_wall = wall_s
        loop = self.mission.loop
        if loop.state == LinkState.GIVEN_UP and self.mode == SURFACE:
            loop.end("given up: odometry was lost; the vehicle surfaces by itself")
        elif self.has_flown and not self.is_cleared and loop.state != LinkState.GIVEN_UP:
            loop.end("ended: the vehicle was disarmed or taken out of GUIDED")

    def _on_attitude(self, message: Any, wall_s: float) -> None:
        self._see_clock(message, wall_s)
        self._attitude = message

    def _on_origin(self, message: Any, wall_s: float) -> None:
        place = np.array([[message.latitude * 1e-7, message.longitude * 1e-7, 0.0]])
        if np.any(place):
            ned = self.mission.plan.datum.ned_from_geodetic(place)[0]
            self._origin_ned = np.array([ned[0], ned[1], 0.0])

    def _on_range(self, message: Any, wall_s: float) -> None:
        # It has no stamp: it is of now. 0 is no reading.
        reach = float(message.distance)
        now_s = self._now_s(wall_s)
        self.mission.loop.hear_range(now_s, reach if reach > 0.0 else math.inf, now_s)

    def _on_position(self, message: Any, wall_s: float) -> None:
        self._see_clock(message, wall_s)
        stamp_s, attitude = message.time_boot_ms * 1e-3, self._attitude
        if self.sim_time:
            self._stamp_s = stamp_s
        if attitude is not None and self._origin_ned is not None:
            apart_s = abs(attitude.time_boot_ms * 1e-3 - stamp_s)
            alive = wall_s - self._heartbeat_wall < _HEARTBEAT_S
            if apart_s <= _APART_S and alive:
                odometry = odometry_from(message, attitude, self._origin_ned)
                self.mission.loop.hear_odometry(odometry, self._now_s(wall_s))
        if self.sim_time:
            self._tick(stamp_s, wall_s)

    def _see_clock(self, message: Any, wall_s: float) -> None:
        """Keep the least delay of messages as the offset of the vehicle's clock."""
        seen = wall_s - message.time_boot_ms * 1e-3
        if self._offset is None:
            self._offset = (seen, wall_s)
            return
        offset, before = self._offset
        self._offset = (min(seen, offset + _DRIFT * (wall_s - before)), wall_s)

    def _ask(self) -> None:
        self.mav.heartbeat_send(_ONBOARD_COMPUTER_TYPE, _NO_AUTOPILOT, 0, 0, 4)
        if self.system is None:
            return
        if self._attitude is None:
            for number, interval_us in _INTERVALS_US.items():
                self._command(_SET_INTERVAL, number, interval_us)
        if self._origin_ned is None:
            self._command(_REQUEST, _ORIGIN)
            self._asked += 1
            if self._asked > _ASKED_BEFORE_SETTING:
                datum: Datum = self.mission.plan.datum
                place = [round(d * 1e7) for d in (datum.latitude_deg, datum.longitude_deg)]
                self.mav.set_gps_global_origin_send(self.system, *place, 0)
        loop = self.mission.loop
        if loop.state == LinkState.GIVEN_UP and loop.limits.on_loss == "surface":
            self._command(_SET_MODE, _CUSTOM_MODE, SURFACE)

    def _command(self, number: int, *params: float) -> None:
        values = [*params, *[0.0] * (7 - len(params))]
        self.mav.command_long_send(self.system, _AUTOPILOT, number, 0, *values)

    def _tick(self, now_s: float, wall_s: float) -> None:
        if not self.is_cleared and not self.has_flown:
            return
        command = self.mission.tick(now_s)
        self.has_flown = self.has_flown or command.state == LinkState.FLYING
        if command.state == LinkState.WAITING or self.mode != GUIDED:
            return
        heading_rad = float(self.mission.loop.estimate[vector.HEADING])
        self._send_velocity(velocity_ned(command, heading_rad), command.heading_rad)

    def _send_velocity(self, velocity: Array, heading_rad: float) -> None:
        yaws = math.isfinite(heading_rad)
        mask = _NO_POSITION | _NO_ACCELERATION | _NO_YAW_RATE | (0 if yaws else _NO_YAW)
        last = self.mission.rows[-1][0] if self.mission.rows else 0.0
        self.mav.set_position_target_local_ned_send(
            round(float(last) * 1e3), self.system, _AUTOPILOT, _LOCAL_NED, mask, 0.0, 0.0, 0.0,
            *(float(v) for v in velocity), 0.0, 0.0, 0.0,
            math.remainder(heading_rad, math.tau) if yaws else 0.0, 0.0,
        )  # fmt: skip


def velocity_ned(command: Command, heading_rad: float) -> Array:
    """Velocity over ground that a command asks for, (3,) NED: surge and sway are level."""
    if command.state != LinkState.FLYING:
        return np.zeros(3)
    turned: Array = rotation_from_attitude(0.0, 0.0, heading_rad).apply(command.velocity_body)
    return turned


def odometry_from(position: Any, attitude: Any, origin_ned: Array) -> Odometry:
    """Odometry of LOCAL_POSITION_NED and ATTITUDE.

    Args:
        position: the message.
        attitude: the message.
        origin_ned: (3,) origin of the vehicle's frame from the plan's datum.
    """
    angles = [attitude.roll, attitude.pitch, attitude.yaw]
    known = bool(np.all(np.isfinite(angles)))
    turn = rotation_from_attitude(*angles) if known else Rotation.identity()
    return Odometry(
        stamp_s=position.time_boot_ms * 1e-3,
        position_ned=np.array([position.x, position.y, position.z]) + origin_ned,
        quaternion_xyzw=turn.as_quat() if known else np.full(4, np.nan),
        velocity_body=turn.inv().apply([position.vx, position.vy, position.vz]),
        rates_body=np.array([attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed]),
    )


def mavlink_to(address: str, **settings: int) -> Any:
    """Open a connection of pymavlink to ArduSub.

    Args:
        address: of pymavlink, such as udpin:127.0.0.1:14550 or /dev/ttyACM0,115200.
        settings: more of `mavutil.mavlink_connection`.

    Raises:
        VehicleError: pymavlink or pyserial is not installed, or the address cannot be opened.
    """
    try:
        from pymavlink import mavutil

        return mavutil.mavlink_connection(address, dialect="ardupilotmega", **settings)
    except ImportError as error:
        raise VehicleError(f"{error.name} is not installed: {extra('mavlink')}") from None
    except (OSError, ValueError, IndexError) as error:
        raise VehicleError(
            f"{address}: cannot be opened ({error}): give one as udpin:127.0.0.1:14550 or "
            "/dev/ttyACM0,115200"
        ) from None
