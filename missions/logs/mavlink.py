"""Packets of MAVLink, versions 1 and 2: where they end, whether they are whole, what they hold.

The form of packets, the checksum and its CRC_EXTRA, the order of fields on the wire and the
cutting of trailing zeros: mavlink.io/en/guide/serialization.html. Signatures, which are passed over
unchecked, as only the holder of the key can check them: mavlink.io/en/guide/message_signing.html.
The messages: mavlink.io/en/messages/common.html and, of RANGEFINDER, .../ardupilotmega.html.
"""

import binascii
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

V1, V2 = 0xFE, 0xFD
"""First byte of a packet."""
LONGEST = 280
"""Bytes of the longest packet: 10 of head, 255 of payload, 2 of checksum, 13 of signature."""
_HEAD = {V1: 6, V2: 10}
_CHECKSUM, _SIGNATURE = 2, 13
_SIGNED = 0x01
"""Incompatibility flag: a signature follows. A reader must refuse flags that it does not know."""
_FORMS = {
    "uint64_t": "<u8", "int64_t": "<i8", "double": "<f8", "uint32_t": "<u4", "int32_t": "<i4",
    "float": "<f4", "uint16_t": "<u2", "int16_t": "<i2", "uint8_t": "u1", "int8_t": "i1",
}  # fmt: skip
_MIRRORED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


def checksum(data: bytes) -> int:
    """The CRC of MAVLink: that of X.25, with polynomial 0x1021 and start 0xFFFF, not inverted.

    It takes each byte's lowest bit first. The standard library's takes the highest first, and thus
    gives the mirror image for mirrored bytes.
    """
    mirrored = binascii.crc_hqx(data.translate(_MIRRORED), 0xFFFF)
    return (_MIRRORED[mirrored & 0xFF] << 8) | _MIRRORED[mirrored >> 8]


@dataclass(frozen=True)
class Message:
    """What one message holds.

    Extensions, which version 2 may append to the fields, are not part of the checksum's seed; none
    is used here, so that none is listed.
    """

    number: int
    name: str
    listing: str
    """Types and names in the order of the message's definition."""

    @cached_property
    def on_wire(self) -> tuple[tuple[str, str], ...]:
        """Types and names as sent: the largest types first, otherwise as they are defined."""
        pairs = (field.split() for field in self.listing.split(", "))
        fields = [(kind, name) for kind, name in pairs]
        return tuple(sorted(fields, key=lambda field: -np.dtype(_FORMS[field[0]]).itemsize))

    @cached_property
    def payload(self) -> np.dtype[np.void]:
        """The payload without extensions, as it is in memory."""
        return np.dtype([(name, _FORMS[kind]) for kind, name in self.on_wire])

    @cached_property
    def length(self) -> int:
        """Bytes of the payload without extensions."""
        return self.payload.itemsize

    @cached_property
    def crc_extra(self) -> int:
        """The byte that enters checksums: it differs where sender and reader define differently."""
        words = [self.name, *(word for field in self.on_wire for word in field)]
        seed = checksum("".join(f"{word} " for word in words).encode())
        return (seed & 0xFF) ^ (seed >> 8)


MESSAGES = {
    message.number: message
    for message in (
        Message(
            0, "HEARTBEAT",
            "uint8_t type, uint8_t autopilot, uint8_t base_mode, uint32_t custom_mode, "
            "uint8_t system_status, uint8_t mavlink_version",
        ),
        Message(
            24, "GPS_RAW_INT",
            "uint64_t time_usec, uint8_t fix_type, int32_t lat, int32_t lon, int32_t alt, "
            "uint16_t eph, uint16_t epv, uint16_t vel, uint16_t cog, uint8_t satellites_visible",
        ),
        Message(
            30, "ATTITUDE",
            "uint32_t time_boot_ms, float roll, float pitch, float yaw, float rollspeed, "
            "float pitchspeed, float yawspeed",
        ),
        Message(
            33, "GLOBAL_POSITION_INT",
            "uint32_t time_boot_ms, int32_t lat, int32_t lon, int32_t alt, int32_t relative_alt, "
            "int16_t vx, int16_t vy, int16_t vz, uint16_t hdg",
        ),
        Message(
            36, "SERVO_OUTPUT_RAW",
            "uint32_t time_usec, uint8_t port, uint16_t servo1_raw, uint16_t servo2_raw, "
            "uint16_t servo3_raw, uint16_t servo4_raw, uint16_t servo5_raw, uint16_t servo6_raw, "
            "uint16_t servo7_raw, uint16_t servo8_raw",
        ),
        Message(
            74, "VFR_HUD",
            "float airspeed, float groundspeed, int16_t heading, uint16_t throttle, float alt, "
            "float climb",
        ),
        Message(
            132, "DISTANCE_SENSOR",
            "uint32_t time_boot_ms, uint16_t min_distance, uint16_t max_distance, "
            "uint16_t current_distance, uint8_t type, uint8_t id, uint8_t orientation, "
            "uint8_t covariance",
        ),
        Message(173, "RANGEFINDER", "float distance, float voltage"),
    )
}  # fmt: skip
"""Messages by number: those about navigation, and the one that every system sends."""


class Packet(NamedTuple):
    """One packet as it was sent."""

    length: int
    """Bytes from its first to its last, a signature included."""
    number: int
    system: int
    component: int
    payload: bytes
    """Payload as sent: version 2 cuts zeros off its end."""
    whole: bool | None
    """Whether its checksum is right; None for a message not in `MESSAGES`, whose is not known."""


def packet_at(data: bytes, start: int) -> Packet | None:
    """The packet that starts at a place; None where none can, or where it does not end in `data`.

    Args:
        data: what was received.
        start: index of a byte of `data`.
    """
    head = _HEAD.get(data[start])
    if head is None or start + head > len(data):
        return None
    checked = start + head + data[start + 1]
    end = checked + _CHECKSUM
    if head == _HEAD[V1]:
        system, component, number = data[start + 3], data[start + 4], data[start + 5]
    else:
        flags = data[start + 2]
        if flags & ~_SIGNED:
            return None
        end += _SIGNATURE if flags else 0
        system, component = data[start + 5], data[start + 6]
        number = int.from_bytes(data[start + 7 : start + 10], "little")
    if end > len(data):
        return None
    message, whole = MESSAGES.get(number), None
    if message is not None:
        stated = int.from_bytes(data[checked : checked + _CHECKSUM], "little")
        whole = checksum(data[start + 1 : checked] + bytes([message.crc_extra])) == stated
    return Packet(end - start, number, system, component, data[start + head : checked], whole)
