"""A ground station's telemetry log (.tlog) as tables of numbers.

A record is a big-endian count of microseconds since 1970 by the ground station's clock, 8 bytes,
and a packet of MAVLink, version 1 or 2 (`mavlink.py`).
"""

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from alice_survey.base.errors import NavigationError
from missions.logs.dataflash import LogTable
from missions.logs.mavlink import LONGEST, MESSAGES, V1, V2, Message, Packet, packet_at

RECORDED = "recorded_s"
"""Column of the ground station's time, seconds since 1970."""
SYSTEM, COMPONENT = "system", "component"
_STAMP = 8
_REACH = _STAMP + LONGEST + _STAMP + 1
"""Bytes that a record and the start of the next can take."""
_CHUNK = 1 << 20
_DAY_US = 86_400_000_000
_START = re.compile(bytes([ord("["), V1, V2, ord("]")]))


def read_tlog(
    path: Path, wanted: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Read the messages of some names.

    Args:
        path: the file.
        wanted: names of messages, of `mavlink.MESSAGES`.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name with the columns `RECORDED`, `SYSTEM` and `COMPONENT`; and the names of what
        messages there are in the log.

    Raises:
        NavigationError: the file cannot be read, or holds no MAVLink packet.
    """
    rows: dict[int, bytearray] = defaultdict(bytearray)
    present: set[int] = set()
    numbers = {message.name: number for number, message in MESSAGES.items()}
    asked = {numbers[name] for name in wanted}
    try:
        with path.open("rb") as file:
            for stamp, packet in packets(file, lost):
                present.add(packet.number)
                if packet.number in asked:
                    length = MESSAGES[packet.number].length
                    rows[packet.number] += stamp
                    rows[packet.number] += bytes((packet.system, packet.component))
                    rows[packet.number] += packet.payload[:length].ljust(length, b"\0")
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {error.strerror}") from None
    if not present:
        raise NavigationError(f"{path}: no telemetry log: it holds no MAVLink packet")
    tables = {
        MESSAGES[number].name: _table(MESSAGES[number], bytes(of_one))
        for number, of_one in rows.items()
    }
    names = sorted(MESSAGES[number].name for number in present if number in MESSAGES)
    others = len(present) - len(names)
    if others:
        names.append(f"{others} more that do not say where a vehicle is")
    return tables, names


def packets(
    file: BinaryIO, lost: Counter[str], chunk_bytes: int = _CHUNK
) -> Iterator[tuple[bytes, Packet]]:
    """Stamp and packet, one record after the other; a chunk of the file is in memory.

    A packet counts where its checksum holds. One whose checksum does not hold, or is not known,
    is taken for one (to be left out, and to be passed over) where a record of about the same time
    follows, or the end of the log; anything else is damage, out of which the next record is looked
    for byte by byte.

    Args:
        file: the log, open at its start.
        lost: counts packets with a wrong checksum, and bytes that are not a message; is added to.
        chunk_bytes: how much to read at once.
    """
    data, place, skipped = b"", 0, 0
    ended, previous = False, b""
    while True:
        if not ended and len(data) - place < _REACH:
            more = file.read(chunk_bytes)
            ended = not more
            data, place = data[place:] + more, 0
            continue
        if place + _STAMP >= len(data):
            break
        packet = packet_at(data, place + _STAMP)
        if packet is not None:
            following = place + _STAMP + packet.length
            if packet.whole or _leads_on(data, place, following, previous):
                if packet.whole is False:
                    lost[f"{MESSAGES[packet.number].name}: the checksum is wrong"] += 1
                else:
                    yield data[place : place + _STAMP], packet
                place, previous = following, data[place : place + _STAMP]
                continue
        previous = b""
        start = _START.search(data, place + _STAMP + 1)
        # Without a start in sight, the last bytes may be the stamp of one out of sight.
        step = (start.start() if start else len(data)) - _STAMP - place
        place += step
        skipped += step
    skipped += len(data) - place
    if skipped:
        lost["bytes that are no message, or of one that is cut off"] += skipped


def _leads_on(data: bytes, place: int, following: int, previous: bytes) -> bool:
    """Whether after the record at a place comes another, within a day of it.

    At the end of the log, with no room for another, it is the record right before that must be
    within a day: `previous` is its stamp, empty where there is damage before.
    """
    other = data[following : following + _STAMP]
    if following + _STAMP >= len(data):
        other = previous
    elif data[following + _STAMP] not in (V1, V2):
        return False
    stamp = data[place : place + _STAMP]
    apart_us = int.from_bytes(stamp, "big") - int.from_bytes(other, "big")
    return bool(other) and abs(apart_us) < _DAY_US


def _table(message: Message, records: bytes) -> LogTable:
    """Stamps, origins and payloads, one after the other, as columns."""
    kind = np.dtype(
        [(RECORDED, ">u8"), (SYSTEM, "u1"), (COMPONENT, "u1"), ("payload", message.payload)]
    )
    rows = np.frombuffer(records, kind)
    columns = {name: rows[name].astype(np.float64) for name in (RECORDED, SYSTEM, COMPONENT)}
    columns[RECORDED] *= 1e-6
    for name in message.payload.names or ():
        columns[name] = rows["payload"][name].astype(np.float64)
    return LogTable(name=message.name, columns=columns, texts={})
