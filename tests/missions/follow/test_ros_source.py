"""Odometry of ROS 2 as a source of navigation."""

import os
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import VehicleError
from missions.follow.links import RosSource
from missions.live import ros_messages
from missions.live.loop import Odometry
from missions.logs.ros_builder import ODOMETRY, RANGE
from tests.missions.follow.dives import DATUM
from tests.missions.live import flights

rclpy = pytest.importorskip(
    "rclpy", reason="ROS 2 is not installed: pip install 'alice-survey[ros]'"
)
pytestmark = pytest.mark.xdist_group("ros")


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain of its own, on the loopback alone."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + (os.getpid() + 50) % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv(
        "FASTDDS_DEFAULT_PROFILES_FILE", str(Path(flights.__file__).with_name("loopback.xml"))
    )
    monkeypatch.setenv("ROS_LOG_DIR", f"{tempfile.gettempdir()}/alice-survey-ros-{os.getpid()}")


def test_odometry_and_ranges_become_rows() -> None:
    source = RosSource(DATUM, np.zeros(3), "alice")
    node = rclpy.create_node("vehicle", namespace="alice")
    try:
        ros = ros_messages.load_ros()
        odometry = node.create_publisher(
            ros_messages.message_class(ODOMETRY), "navigation/odometry", ros.qos
        )
        ranges = node.create_publisher(ros_messages.message_class(RANGE), "altimeter", ros.qos)
        until_s = time.monotonic() + 30.0
        while not (odometry.get_subscription_count() and ranges.get_subscription_count()):
            assert time.monotonic() < until_s
            time.sleep(0.05)
        rows = []
        for i in range(30):
            turn = Rotation.from_euler("ZYX", [0.5, -0.02, 0.03])
            stamp_s = 100.0 + 0.1 * i
            ranges.publish(ros.build.range(round(1e9 * stamp_s), "alice/altimeter", 2.0))
            said = Odometry(
                stamp_s=stamp_s,
                position_ned=np.array([0.02 * i, 1.0, 13.0]),
                quaternion_xyzw=turn.as_quat(),
                velocity_body=np.array([0.2, 0.0, 0.0]),
                rates_body=np.zeros(3),
            )
            odometry.publish(
                ros_messages.odometry_message(ros.build, said, "alice/base_link", np.ones(6))
            )
            rows += [piece.rows for piece in source.poll(0.1 * i)]
        until_s = time.monotonic() + 10.0
        while sum(map(len, rows)) < 30 and time.monotonic() < until_s:
            rows += [piece.rows for piece in source.poll(1e3)]
    finally:
        node.destroy_node()
        source.close()
    heard = np.concatenate(rows)
    assert len(heard) == 30
    ned = DATUM.ned_from_geodetic(np.column_stack([heard[:, 1:3], np.zeros(30)]))
    np.testing.assert_allclose(ned[:, 0], 0.02 * np.arange(30), atol=1e-6)
    np.testing.assert_allclose(heard[:, 3], 13.0)
    np.testing.assert_allclose(heard[:, 4:7], np.tile(np.rad2deg([0.03, -0.02, 0.5]), (30, 1)))
    known = np.isfinite(heard[:, 7])
    assert known.sum() >= 20  # of the first ones the range may not have been heard yet
    np.testing.assert_allclose(heard[known, 7], 2.0 * np.cos(0.03) * np.cos(0.02), rtol=1e-6)


def test_a_topic_that_cannot_be_is_refused_in_a_line() -> None:
    with pytest.raises(VehicleError):
        RosSource(DATUM, np.zeros(3), "alice", odometry="not a topic")
