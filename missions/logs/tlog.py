"""A ground station's telemetry log (.tlog) as tables of numbers.

A record is a big-endian count of microseconds since 1970 by the ground station's clock, 8 bytes,
and a MAVLink packet of version 1 or 2 (mavlink.io/en/guide/serialization.html). Packets are decoded
by pymavlink's generated message definitions.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.errors import NavigationError
from missions.logs.dataflash import Table

RECORDED = "recorded_s"
"""Column of the ground station's time, seconds since 1970."""
SYSTEM, COMPONENT = "system", "component"
_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01


def read_tlog(
    path: Path, wanted: Collection[str], lost: Counter[str]
) -> tuple[dict[str, Table], list[str]]:
    """Read the messages of some names; text fields are left out.

    Args:
        path: the file.
        wanted: names of messages.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name with the columns `RECORDED`, `SYSTEM` and `COMPONENT`, and the names of all
        messages in the log.

    Raises:
        NavigationError: the file cannot be read, or holds no MAVLink packet.
    """
    from pymavlink.dialects.v20 import (  # type: ignore[import-untyped]
        ardupilotmega as mavlink,
    )

    try:
        data = path.read_bytes()
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {error.strerror}") from None
    names = {number: kind.msgname for number, kind in mavlink.mavlink_map.items()}
    decoder = mavlink.MAVLink(None)
    rows: dict[str, list[list[float]]] = defaultdict(list)
    fields: dict[str, list[str]] = {}
    present: set[str] = set()

    def whole(packet: bytes) -> bool:
        try:
            decoder.decode(bytearray(packet))
        except mavlink.MAVError:
            return False
        return True

    for recorded_us, number, packet in _packets(data, whole, lost):
        name = names.get(number)
        if name is None:
            continue
        present.add(name)
        if name not in wanted:
            continue
        try:
            message: Any = decoder.decode(bytearray(packet))
        except mavlink.MAVError:
            lost[f"{name}: the checksum is wrong"] += 1
            continue
        if name not in fields:
            fields[name] = [f for f in message.fieldnames if _is_number(getattr(message, f))]
        values = [float(getattr(message, field)) for field in fields[name]]
        origin = [message.get_srcSystem(), message.get_srcComponent()]
        rows[name].append([recorded_us * 1e-6, *map(float, origin), *values])
    if not present:
        raise NavigationError(f"{path}: no telemetry log: it holds no MAVLink packet")
    tables = {}
    for name, values_of in rows.items():
        table = np.array(values_of)
        columns = [RECORDED, SYSTEM, COMPONENT, *fields[name]]
        tables[name] = Table(
            name=name,
            columns={column: table[:, i] for i, column in enumerate(columns)},
            kinds=dict.fromkeys(columns, "d"),
            texts={},
        )
    return tables, sorted(present)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float)


def _packets(
    data: bytes, whole: Callable[[bytes], bool], lost: Counter[str]
) -> Iterator[tuple[int, int, bytes]]:
    """Time, message number and packet, one record after the other.

    Where no packet follows a packet, its checksum decides whether it is one.
    """
    place, end, skipped = 0, len(data), 0
    while place + 8 < end:
        length, number = _measure(data, place + 8)
        following = place + 8 + length
        packet = data[place + 8 : following]
        linked = following == end or (following + 8 < end and data[following + 8] in (_V1, _V2))
        if not length or following > end or not (linked or whole(packet)):
            place += 1
            skipped += 1
            continue
        recorded = int.from_bytes(data[place : place + 8], "big")
        yield recorded, number, packet
        place = following
    if skipped or place < end:
        lost["bytes that are no message, or of one that is cut off"] += skipped + end - place


def _measure(data: bytes, start: int) -> tuple[int, int]:
    """Length and message number of the packet at a place; 0, 0 where none can start."""
    if data[start] == _V2 and start + 10 <= len(data):
        signature = 13 if data[start + 2] & _SIGNED else 0
        return 12 + data[start + 1] + signature, int.from_bytes(
            data[start + 7 : start + 10], "little"
        )
    if data[start] == _V1 and start + 6 <= len(data):
        return 8 + data[start + 1], data[start + 5]
    return 0, 0
