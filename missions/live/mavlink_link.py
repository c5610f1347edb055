"""Connections to ArduSub over MAVLink, by pymavlink."""

from typing import Any

from alice_survey.core.errors import VehicleError


def mavlink_to(address: str, **settings: int) -> Any:
    """Open a connection of pymavlink to ArduSub.

    Args:
        address: of pymavlink, such as udpin:127.0.0.1:14550.
        settings: more of `mavutil.mavlink_connection`.

    Raises:
        VehicleError: pymavlink is not installed, or the address cannot be opened.
    """
    try:
        from pymavlink import mavutil
    except ImportError:
        raise VehicleError(
            "pymavlink is not installed: pip install 'alice-survey[mavlink]'"
        ) from None
    try:
        return mavutil.mavlink_connection(address, dialect="ardupilotmega", **settings)
    except (OSError, ValueError, IndexError) as error:
        raise VehicleError(
            f"{address}: cannot be opened ({error}): give one as udpin:127.0.0.1:14550"
        ) from None
