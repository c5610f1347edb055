"""Navigation over a link: datagrams, MAVLink, ROS 2 odometry.

Packets are lost, doubled and overtake one another: they are held for `WINDOW_S` and put in order.
"""

import contextlib
import math
import socket
import time
from collections import Counter
from typing import Any

import numpy as np

from alice_survey.core.errors import NavigationError, VehicleError
from alice_survey.core.frames import Array, Datum, attitude_from_rotation, rotation_from_attitude
from camera_calib.rig import Rig
from missions.follow.rows import Piece, Reordered, row_of_text
from missions.live.loop import Odometry
from missions.live.mavlink_link import mavlink_to

UDP_PORT = 14600
"""Where datagrams are taken by default; MAVLink's are 14550 and on."""
WINDOW_S = 1.0
"""How long a packet is waited for that another one has overtaken."""
_MAX_PACKET = 4096
_MAX_PACKETS = 5000
"""Packets that are looked at in one call: the rest waits in the socket."""
_APART_S = 0.2
"""Attitude, range and position are of one moment when they are no farther apart (inferred)."""
_ASK_S = 2.0
_AUTOPILOT, _SET_INTERVAL, _REQUEST = 1, 511, 512
_ATTITUDE, _POSITION, _ORIGIN, _RANGEFINDER = 30, 32, 49, 173
_INTERVAL_US = 100_000


class UdpSource:
    """One line a datagram, as `row_of_text` has it, from this machine or the network.

    Several lines in one datagram are several packets.
    """

    def __init__(self, datum: Datum, port: int = UDP_PORT, host: str = "127.0.0.1") -> None:
        """Listen.

        Args:
            datum: of the plan, from which north and east count.
            port: to listen on; 0 for any that is free.
            host: address to listen on; 0.0.0.0 takes packets of other machines too.

        Raises:
            NavigationError: the port is taken, or the address is not this machine's.
        """
        self._datum = datum
        self.left_out: Counter[str] = Counter()
        self._ordered = Reordered(WINDOW_S, self.left_out)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise NavigationError(
                f"udp:{host}:{port} cannot be listened on ({error}): choose another port"
            ) from None
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])
        self.name = f"datagrams on {host}:{self.port}"

    def poll(self, wall_s: float) -> list[Piece]:
        """Packets that came since and whose turn it is."""
        rows = []
        for _ in range(_MAX_PACKETS):
            try:
                data = self._socket.recv(_MAX_PACKET)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # of a packet that this socket did not send
                continue
            for line in data.splitlines():
                try:
                    rows.append(row_of_text(line.decode("utf-8"), self._datum))
                except ValueError:
                    self.left_out["packets that are no navigation"] += 1
        sent = self._ordered.passed(rows, wall_s)
        return [Piece(rows=sent)] if len(sent) else []

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def altitude_of_range(range_m: float, attitude: Array, altimeter_from_glass_m: Array) -> float:
    """Altitude of the left port's glass by an altimeter that looks down along the hull.

    Args:
        range_m: along the beam.
        attitude: (3,) roll, pitch, heading.
        altimeter_from_glass_m: (3,) place of the altimeter from the glass, in the body.
    """
    turn = rotation_from_attitude(*attitude)
    beam = turn.apply(np.array([0.0, 0.0, range_m]) + altimeter_from_glass_m)
    return float(beam[2])


def altimeter_from_glass(rig: Rig, altimeter_body_m: tuple[float, float, float]) -> Array:
    """Place of the altimeter from the left port's glass, (3,) in the body."""
    glass = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    place: Array = np.array(altimeter_body_m) - glass
    return place


class OdometryRows:
    """Rows from odometry and ranges, which come apart."""

    def __init__(self, datum: Datum, altimeter_from_glass_m: Array) -> None:
        """Nothing has come yet."""
        self._datum, self._altimeter = datum, altimeter_from_glass_m
        self._range: tuple[float, float] | None = None

    def hear_range(self, stamp_s: float, range_m: float) -> None:
        """Take a range; what is not positive and finite is no reading."""
        usable = math.isfinite(range_m) and range_m > 0.0
        self._range = (stamp_s, range_m) if usable else None

    def row(self, odometry: Odometry) -> Array | None:
        """The row of an odometry; None of one that is not finite."""
        if not odometry.is_finite:
            return None
        from scipy.spatial.transform import Rotation

        attitude = attitude_from_rotation(Rotation.from_quat(odometry.quaternion_xyzw)).ravel()
        north, east, depth = odometry.position_ned
        place = self._datum.geodetic_from_ned(np.array([[north, east, 0.0]]))[0]
        altitude = math.nan
        if self._range is not None and abs(self._range[0] - odometry.stamp_s) <= _APART_S:
            altitude = altitude_of_range(self._range[1], attitude, self._altimeter)
        angles = np.rad2deg(attitude)
        return np.array(
            [odometry.stamp_s, place[0], place[1], depth, *angles[:2], angles[2] % 360.0, altitude]
        )


class MavlinkSource:
    """ArduSub's position, attitude and range, as any ground station hears them."""

    def __init__(self, url: str, datum: Datum, altimeter_from_glass_m: Array) -> None:
        """Open a link.

        Args:
            url: of pymavlink, such as udpin:127.0.0.1:14550.
            datum: of the plan.
            altimeter_from_glass_m: as `altimeter_from_glass`.

        Raises:
            VehicleError: pymavlink is not installed, or the address cannot be opened.
        """
        self._link = mavlink_to(url)
        self.name = f"MAVLink on {url}"
        self.left_out: Counter[str] = Counter()
        self._datum, self._rows = datum, OdometryRows(datum, altimeter_from_glass_m)
        self._ordered = Reordered(WINDOW_S, self.left_out)
        self._attitude: Any = None
        self._origin_ned: Array | None = None
        self._stamp_s, self._asked_s = 0.0, -math.inf

    def poll(self, wall_s: float) -> list[Piece]:
        """What was heard since."""
        rows = []
        for _ in range(_MAX_PACKETS):
            message = self._link.recv_match(blocking=False)
            if message is None:
                break
            row = self._hear(message)
            if row is not None:
                rows.append(row)
        if wall_s - self._asked_s >= _ASK_S and self._link.target_system:
            self._asked_s = wall_s
            self._ask()
        sent = self._ordered.passed(rows, wall_s)
        return [Piece(rows=sent)] if len(sent) else []

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _hear(self, message: Any) -> Array | None:
        from missions.live.mavlink_pilot import odometry_from

        kind = message.get_type()
        if message.get_srcComponent() != _AUTOPILOT:
            return None
        if kind == "ATTITUDE":
            self._attitude, self._stamp_s = message, message.time_boot_ms * 1e-3
        elif kind == "RANGEFINDER":  # it has no stamp: it is of now
            self._rows.hear_range(self._stamp_s, float(message.distance))
        elif kind == "GPS_GLOBAL_ORIGIN":
            place = np.array([[message.latitude * 1e-7, message.longitude * 1e-7, 0.0]])
            ned = self._datum.ned_from_geodetic(place)[0]
            self._origin_ned = np.array([ned[0], ned[1], 0.0]) if np.any(place) else None
        elif kind == "LOCAL_POSITION_NED":
            self._stamp_s = message.time_boot_ms * 1e-3
            if self._attitude is None or self._origin_ned is None:
                self.left_out["positions before an attitude and the origin were heard"] += 1
                return None
            if abs(self._attitude.time_boot_ms * 1e-3 - self._stamp_s) > _APART_S:
                self.left_out["positions without an attitude of that moment"] += 1
                return None
            return self._rows.row(odometry_from(message, self._attitude, self._origin_ned))
        return None

    def _ask(self) -> None:
        """Ask for what is missing: a vehicle sends by itself what its ground station asked for."""
        if self._attitude is None:
            for number in (_ATTITUDE, _POSITION, _RANGEFINDER):
                self._command(_SET_INTERVAL, number, _INTERVAL_US)
        if self._origin_ned is None:
            self._command(_REQUEST, _ORIGIN)

    def _command(self, number: int, *params: float) -> None:
        with contextlib.suppress(OSError):  # nobody is there yet
            self._link.mav.command_long_send(
                self._link.target_system, _AUTOPILOT, number, 0,
                *params, *[0.0] * (7 - len(params)),
            )  # fmt: skip


class RosSource:
    """`nav_msgs/Odometry` from the plan's datum, and a `sensor_msgs/Range`, of ROS 2."""

    def __init__(
        self, datum: Datum, altimeter_from_glass_m: Array, vehicle: str,
        odometry: str = "navigation/odometry", altitude: str = "altimeter",
    ) -> None:  # fmt: skip
        """Subscribe.

        Args:
            datum: of the plan.
            altimeter_from_glass_m: as `altimeter_from_glass`.
            vehicle: its name, below which topics are that do not begin with a slash.
            odometry: topic.
            altitude: topic.

        Raises:
            VehicleError: ROS 2 is not installed, or a topic cannot have its name.
        """
        from missions.live.ros_messages import load_ros, message_class
        from missions.logs.ros_builder import ODOMETRY, RANGE

        self._ros = load_ros()
        from rclpy.signals import SignalHandlerOptions

        self.name = f"ROS 2 odometry on {odometry}"
        self.left_out: Counter[str] = Counter()
        self._rows = OdometryRows(datum, altimeter_from_glass_m)
        self._ordered, self._heard = Reordered(WINDOW_S, self.left_out), list[Array]()
        self._ros.rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        from rclpy.exceptions import InvalidTopicNameException

        self._node = self._ros.rclpy.create_node("follow", namespace=vehicle)
        subscribe, qos = self._node.create_subscription, self._ros.qos
        try:
            subscribe(message_class(ODOMETRY), odometry, self._on_odometry, qos)
            subscribe(message_class(RANGE), altitude, self._on_range, qos)
        except InvalidTopicNameException as error:
            self.close()
            raise VehicleError(" ".join(str(error).split())) from None

    def poll(self, wall_s: float) -> list[Piece]:
        """What was heard since."""
        until_s = time.monotonic() + 0.05
        while time.monotonic() < until_s:
            self._ros.rclpy.spin_once(self._node, timeout_sec=0.0)
        rows, self._heard = self._heard, []
        sent = self._ordered.passed(rows, wall_s)
        return [Piece(rows=sent)] if len(sent) else []

    def close(self) -> None:
        """Leave."""
        self._node.destroy_node()
        self._ros.rclpy.try_shutdown()

    def _on_odometry(self, message: Any) -> None:
        from missions.live.ros_messages import odometry_from

        row = self._rows.row(odometry_from(message))
        if row is None:
            self.left_out["odometry that is not finite"] += 1
        else:
            self._heard.append(row)

    def _on_range(self, message: Any) -> None:
        from missions.live.ros_messages import range_from, seconds

        self._rows.hear_range(seconds(message.header.stamp), range_from(message))
