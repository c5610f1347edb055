"""A vehicle that speaks MAVLink as ArduSub does: `python -m ... PORT SETTINGS TRACK [FAULT]`.

Its dynamics are the simulator's; loops of its own turn velocity and heading into a wrench. It goes
on when the set-point of a tick has come, and ends when none comes any more at the surface, or when
it is asked to surface. With a fault, "nan" or "frozen", its position is so from `FAULT_S` on.
"""

import math
import sys
import time
from pathlib import Path

import numpy as np
from pymavlink import mavutil
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import SurveyConfig, load_config
from alice_survey.core.frames import Array, Datum, attitude_from_rotation
from alice_survey.sim.vehicle.allocation import AXIS_WEIGHTS, allocate, new_allocation
from alice_survey.sim.vehicle.navigation.sensors import DVL
from alice_survey.sim.vehicle.pilot.gains import (
    HEAVE,
    MASS,
    MAX_FORCE,
    MIN_FORCE,
    SURGE,
    SWAY,
    YAW,
    gains_for,
)
from alice_survey.sim.vehicle.rotations import wrap_angle
from alice_survey.sim.vehicle.sea import floor_range
from alice_survey.sim.vehicle.simulator import SimulatedVehicle
from missions.live.mission import plan_to_fly
from tests.missions.live.flights import vehicle_afloat

GUIDED, ARMED, SUBMARINE, ARDUPILOT = 4, 128, 12, 3
FAULT_S, SET_MODE = 20.0, 176
AXES = (SURGE, SWAY, HEAVE, YAW)


class InnerLoops:
    """PI loops on body velocity, and on the heading by its rate."""

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        gains = gains_for(vehicle.vehicle, 0.2)
        self.mass, self.minimum, self.maximum = (
            gains.axes[list(AXES), k] for k in (MASS, MIN_FORCE, MAX_FORCE)
        )
        self.allocation = new_allocation(
            vehicle.vehicle, np.ones(len(vehicle.vehicle.thrusters)), exact=True, axes=AXIS_WEIGHTS
        )
        self.total = np.zeros(4)

    def speeds(self, truth: Array, velocity_ned: Array, heading_rad: float) -> Array:
        turn = Rotation.from_quat(truth[3:7])
        heading = float(attitude_from_rotation(turn)[2])
        body = turn.inv()
        off = body.apply(velocity_ned - truth[7:10])
        turning = np.clip(0.6 * wrap_angle(heading_rad - heading), -0.25, 0.25)
        error = np.array([*off, turning - truth[12]])
        self.total = np.clip(
            self.total + 0.05 * 0.3 * self.mass * error, self.minimum, self.maximum
        )
        asked = np.clip(1.0 * self.mass * error + self.total, self.minimum, self.maximum)
        wrench = np.array([asked[0], asked[1], asked[2], 0.0, 0.0, asked[3]])
        estimate = np.zeros(14)
        estimate[6:9], estimate[9:12] = body.apply(truth[7:10]), truth[10:13]
        allocate(wrench, estimate[6:], self.allocation)
        return self.allocation.command.copy()


def fly(port: int, settings: Path, track: Path, fault: str = "") -> None:
    survey: SurveyConfig = load_config(settings)
    plan = plan_to_fly(settings.parent, None)
    vehicle = vehicle_afloat(plan, survey)
    loops = InnerLoops(vehicle)
    link = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{port}", dialect="ardupilotmega", source_system=1, source_component=1
    )
    origin = Datum(plan.datum.latitude_deg + 1e-4, plan.datum.longitude_deg)
    # The origin of its filter is some 11 m north of the plan's datum.
    shift = plan.datum.ned_from_geodetic(
        np.array([[origin.latitude_deg, origin.longitude_deg, 0.0]])
    )[0]
    target, answered_ms, dived, mode = (np.zeros(3), 0.0), -1, False, GUIDED
    spoilt = np.full(13, np.nan)
    rows: list[list[float]] = []

    def hear(message: object) -> None:
        nonlocal target, answered_ms, mode
        kind = message.get_type()  # type: ignore[attr-defined]
        if kind == "COMMAND_LONG" and message.command == 512:  # type: ignore[attr-defined]
            link.mav.gps_global_origin_send(
                round(origin.latitude_deg * 1e7), round(origin.longitude_deg * 1e7), 0
            )
        if kind == "COMMAND_LONG" and message.command == SET_MODE:  # type: ignore[attr-defined]
            mode = round(message.param2)  # type: ignore[attr-defined]
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            m = message
            heading = m.yaw if not m.type_mask & 1024 else target[1]  # type: ignore[attr-defined]
            assert m.coordinate_frame == 1  # type: ignore[attr-defined]
            target = (np.array([m.vx, m.vy, m.vz]), heading)  # type: ignore[attr-defined]
            answered_ms = m.time_boot_ms  # type: ignore[attr-defined]

    while vehicle.tick < 8000:
        vehicle.sense()
        truth = vehicle.world.now
        rows.append([vehicle.tick * 0.05, *truth[:7].tolist()])
        stamp_ms = 1000 + 50 * vehicle.tick
        if fault == "frozen" and vehicle.tick * 0.05 <= FAULT_S:
            spoilt = truth.copy()
        sent, asked = -math.inf, time.monotonic()
        while answered_ms < stamp_ms:
            waited_s = time.monotonic() - asked
            if waited_s > 60.0 or (dived and truth[2] < 0.35 and waited_s > 3.0):
                break
            if time.monotonic() - sent > 0.25:
                sent = time.monotonic()
                is_wrong = bool(fault) and vehicle.tick * 0.05 > FAULT_S
                send(link, vehicle, stamp_ms, shift, spoilt if is_wrong else truth, mode)
                if mode != GUIDED:
                    return
            message = link.recv_match(blocking=True, timeout=0.05)
            if message is not None:
                hear(message)
        dived = dived or truth[2] > 2.0
        if answered_ms < stamp_ms:
            break
        vehicle.move(loops.speeds(truth, *target))
    columns = ("time_s", "north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    write_csv(track, columns, rows)


def altimeter_m(vehicle: SimulatedVehicle) -> float:
    """Range straight down from the DVL's place to the sea floor; 0 is no echo."""
    truth = vehicle.world.now
    turn = Rotation.from_quat(truth[3:7])
    north, east, depth = truth[:3] + turn.apply(vehicle.parts.sensors.place[DVL])
    x, y, z = turn.apply([0.0, 0.0, 1.0])
    reach = floor_range(vehicle.parts.floor, north, east, depth, x, y, z, 75.0)
    return reach if math.isfinite(reach) else 0.0


def send(
    link: object, vehicle: SimulatedVehicle, stamp_ms: int, shift: Array, said: Array, mode: int
) -> None:
    mav, truth = link.mav, vehicle.world.now  # type: ignore[attr-defined]
    shown = said if np.all(np.isfinite(said)) else truth
    roll, pitch, heading = attitude_from_rotation(Rotation.from_quat(shown[3:7]))
    mav.heartbeat_send(SUBMARINE, ARDUPILOT, 1 | ARMED, mode, 4)
    mav.attitude_send(stamp_ms, roll, pitch, heading, *truth[10:13])
    mav.rangefinder_send(altimeter_m(vehicle), 0.0)
    mav.local_position_ned_send(stamp_ms, *(said[:3] - shift), *said[7:10])


if __name__ == "__main__":
    fly(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), *sys.argv[4:])
