"""The pilot's two doors in this process and in simulated time, with a simulated vehicle behind."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array, attitude_from_rotation, rotation_from_attitude
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.simulator import TICK_S, SimulatedVehicle
from missions.live import ros
from missions.live.mavlink_pilot import GUIDED, SURFACE, MavlinkPilot
from missions.live.mission import LiveMission, Odometry
from tests.missions.live.fake_ardusub import InnerLoops, altimeter_m

PassOn = Callable[[Odometry], tuple[Odometry, str]]
"""What arrives of odometry that is sent, and the name of its frame."""
SET_MODE, NO_YAW = 176, 1024


class Nodes:
    """The two nodes of ROS 2, pilot and vehicle, joined by this object instead of DDS."""

    is_safe = True

    def __init__(self, mission: LiveMission, vehicle: SimulatedVehicle, pass_on: PassOn) -> None:
        self.pass_on, self.takes = pass_on, dict[str, Callable[[Any], None]]()
        self.library = replace(ros.load_ros(), rclpy=SimpleNamespace(create_node=self.create_node))
        self.pilot = ros.PilotNode(self.library, mission, ros.Topics(), sim_time=True)
        rng = np.random.default_rng(1)
        self.vehicle = ros.VehicleNode(self.library, vehicle, "thrusters", rng)

    def create_node(self, _: str, *, namespace: str, **others: Any) -> Any:
        """What the nodes use of one of rclpy's."""

        def publisher(kind: Any, topic: str, qos: Any) -> Any:
            return SimpleNamespace(publish=partial(self.publish, str(Path("/", namespace, topic))))

        def subscription(kind: Any, topic: str, take: Callable[[Any], None], qos: Any) -> None:
            self.takes[str(Path("/", namespace, topic))] = take

        return SimpleNamespace(create_publisher=publisher, create_subscription=subscription)

    def publish(self, topic: str, message: Any) -> None:
        if topic not in self.takes:
            return
        if topic.endswith("navigation/odometry"):
            arrives, frame = self.pass_on(ros.odometry_from(message))
            body, variances = message.child_frame_id, message.pose.covariance[::7]
            message = ros.odometry_message(self.library.build, arrives, body, variances)
            message.header.frame_id = frame
        self.takes[topic](message)

    def tick(self) -> Array:
        """Speeds of the thrusters for this tick."""
        for publisher, message in self.vehicle.readings(self.vehicle.vehicle.world.estimate):
            publisher.publish(message)
        return self.vehicle.speeds()


class Submarine:
    """A pilot over MAVLink, and its submarine, which surfaces by itself when asked to."""

    def __init__(self, mission: LiveMission, vehicle: SimulatedVehicle, pass_on: PassOn) -> None:
        self.vehicle, self.pass_on, self.loops = vehicle, pass_on, InnerLoops(vehicle)
        self.parser = dialect.MAVLink(None)
        self.own = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        sends = dialect.MAVLink(self, srcSystem=255, srcComponent=191)
        self.pilot = MavlinkPilot(mission, sends, sim_time=False)
        self.mode, self.target = GUIDED, (np.zeros(3), 0.0)

    def write(self, data: bytes) -> None:
        for message in self.parser.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "COMMAND_LONG" and (message.command, message.param2) == (SET_MODE, SURFACE):
                self.mode, self.target = SURFACE, (np.array([0.0, 0.0, -0.3]), self.target[1])
            elif kind == "SET_POSITION_TARGET_LOCAL_NED" and self.mode == GUIDED:
                yaw = self.target[1] if message.type_mask & NO_YAW else message.yaw
                self.target = np.array([message.vx, message.vy, message.vz]), yaw

    def tick(self) -> Array:
        """Speeds of the thrusters for this tick."""
        own, estimate, datum = self.own, self.vehicle.world.estimate, self.pilot.mission.plan.datum
        now_s = ros.START_S + TICK_S * self.vehicle.tick
        believed = rotation_from_attitude(*estimate[vector.ROLL : vector.U])
        odometry = Odometry(
            stamp_s=now_s, position_ned=estimate[: vector.ROLL].copy(),
            quaternion_xyzw=believed.as_quat(), velocity_body=estimate[vector.U : vector.P].copy(),
            rates_body=estimate[vector.P : vector.ALTITUDE].copy(),
        )  # fmt: skip
        arrives, _ = self.pass_on(odometry)
        turn, stamp_ms = Rotation.from_quat(arrives.quaternion_xyzw), round(1e3 * arrives.stamp_s)
        velocity = turn.apply(arrives.velocity_body)
        messages = [
            own.attitude_encode(stamp_ms, *attitude_from_rotation(turn), *arrives.rates_body),
            own.rangefinder_encode(altimeter_m(self.vehicle), 0.0),
            own.local_position_ned_encode(stamp_ms, *arrives.position_ned, *velocity),
        ]
        if self.vehicle.tick % 20 == 0:
            place = round(datum.latitude_deg * 1e7), round(datum.longitude_deg * 1e7), 0
            heartbeat = own.heartbeat_encode(12, 3, 1 | 128, self.mode, 4)
            messages = [heartbeat, own.gps_global_origin_encode(*place), *messages]
        for message in messages:
            for heard in self.parser.parse_buffer(message.pack(own)):
                self.pilot.hear(heard, now_s)
        self.pilot.step(now_s)
        return self.loops.speeds(self.vehicle.world.now, *self.target)

    @property
    def is_safe(self) -> bool:
        """Whether it is not on its way up by itself."""
        return bool(self.mode == GUIDED or self.vehicle.world.now[2] < 0.3)
