"""Plans flown by real vehicles, or by others' simulators: ROS 2 and MAVLink."""
