"""Files damaged as users and disks damage them: by what they hold, and byte by byte.

Every choice is drawn from one `random.Random`, so that hypothesis can shrink and
repeat a fault.
"""

import json
import re
import string
import struct
from collections.abc import Callable
from random import Random
from typing import Any, Literal

Syntax = Literal["json", "toml", "csv", "text", "binary"]
MAX_BYTES = 1_000_000

_WORDS = (
    "nan", "NaN", "-nan", "inf", "-inf", "Infinity", "1e308", "-1e308", "1e999", "-1", "0", "-0.0",
    "1e-320", "5e-324", "1e-300", "1e300", "9" * 25, "9" * 400, "1" + "0" * 5000, "0x10", "1_000",
    "1,5", "", " ", "null", "true", "false", "[true]", "None", "[]", "{}", "[[[[]]]]", '"', "'",
    "#", "..", "../../../etc/passwd",
    "/etc/passwd", "a" * 300, "é", "日本", "\u202e", "\ufeff", "\x00", "\x1b[31m", "\r", "\n", "%s",
    "2147483648", "9223372036854775808", "18446744073709551616", "-9223372036854775809",
    "0001-01-01T00:00:00", "9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00+23:59",
    "2024-02-30", "25:61:61", "١٢",
)  # fmt: skip
_ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, -(2**63) - 1, 10**400, 0.5, -0.0, 1e-320,
    5e-324, 1e-300, 1e300, 1e308, -1e308, float("nan"), float("inf"), "", "x", "nan", "1e5",
    "../../etc/passwd", "a\nb",
    "\x00", "é" * 40, [], {}, [[]], [{}], [0.0], {"": None}, ["a", 1], [1e308] * 3, [None] * 4,
)  # fmt: skip
_SIZES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF,
          0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 1000, 10**6, 10**9, 10**12)  # fmt: skip


def mutate(data: bytes, syntax: Syntax, rng: Random) -> bytes:
    """A damaged copy of a file, of at most `MAX_BYTES`."""
    known = _OF_SYNTAX[syntax]
    for _ in range(rng.randint(1, 4)):
        general = syntax != "binary" and rng.random() < 0.15
        data = rng.choice(_BYTES if general else known)(data, rng)
    return data[:MAX_BYTES]


def nested(depth: int) -> Any:
    """Lists in lists."""
    value: Any = []
    for _ in range(depth):
        value = [value]
    return value


def _json_value(data: bytes, rng: Random) -> bytes:
    """Another value, or none, in one place; or a key twice."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return _token(data, rng)
    places = _places(value)
    if not places:
        return json.dumps(rng.choice(_ODD)).encode()
    holder, key = rng.choice(places)
    match rng.randint(0, 7):
        case 0:
            del holder[key]
        case 1:
            holder[key] = nested(rng.choice([3, 50, 900]))
        case 2:
            holder[key] = [holder[key]]
        case 3 if isinstance(holder, list):
            holder.insert(key, holder[key])
        case 3:
            holder[f"{key}?"] = holder.pop(key)
        case 4 if isinstance(holder[key], int | float):
            holder[key] = rng.choice([-holder[key], str(holder[key]), holder[key] * 10**6])
        case _:
            holder[key] = rng.choice(_ODD)
    try:
        return json.dumps(value, indent=rng.choice([None, 2])).encode()
    except (ValueError, RecursionError):  # a number or a nesting of more than Python writes
        return data


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every holder and key within a value."""
    found: list[tuple[Any, Any]] = []
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if not isinstance(one, dict | list):
            continue
        for key in list(one) if isinstance(one, dict) else range(len(one)):
            found.append((one, key))
            waiting.append(one[key])
    return found


def _assignment(data: bytes, rng: Random) -> bytes:
    """Another value after an `=` or `:`."""
    lines = data.split(b"\n")
    at = [i for i, line in enumerate(lines) if re.search(rb"[=:]", line)]
    if not at:
        return _token(data, rng)
    i = rng.choice(at)
    key, mark, _ = re.split(rb"([=:])", lines[i], maxsplit=1)
    lines[i] = key + mark + b" " + _word(rng)
    return b"\n".join(lines)


def _cell(data: bytes, rng: Random) -> bytes:
    """Another cell, one more or one less."""
    lines = data.split(b"\n")
    i = rng.randrange(len(lines))
    cells = lines[i].split(b",")
    j = rng.randrange(len(cells))
    match rng.randint(0, 5):
        case 0:
            del cells[j]
        case 1:
            cells.insert(j, _word(rng))
        case 2:
            cells[j] = b'"' + cells[j]
        case _:
            cells[j] = _word(rng)
    lines[i] = b",".join(cells)
    return b"\n".join(lines)


def _line(data: bytes, rng: Random) -> bytes:
    """A line less, twice, elsewhere, or many times."""
    lines = data.split(b"\n")
    i = rng.randrange(len(lines))
    match rng.randint(0, 3):
        case 0:
            del lines[i]
        case 1:
            lines.insert(i, lines[i])
        case 2:
            lines.insert(rng.randrange(len(lines)), lines.pop(i))
        case _:
            lines[i:i] = [lines[i]] * 50
    return b"\n".join(lines)


def _token(data: bytes, rng: Random) -> bytes:
    """Another number or word."""
    places = [token.span() for token in re.finditer(rb"[-+.\w]+", data)]
    start, end = rng.choice(places or [(len(data), len(data))])
    return data[:start] + _word(rng) + data[end:]


def _ends_of_lines(data: bytes, rng: Random) -> bytes:
    match rng.randint(0, 3):
        case 0:
            return b"\xef\xbb\xbf" + data
        case 1:
            return data.replace(b"\n", b"\r\n")
        case 2:
            return data.replace(b"\n", b"\r")
        case _:
            text = data.decode("utf-8", "replace")
            return text.encode(rng.choice(["utf-16", "utf-32", "latin-1", "cp500"]), "replace")


def _word(rng: Random) -> bytes:
    if rng.random() < 0.1:
        return "".join(rng.choice(string.printable) for _ in range(rng.randint(1, 8))).encode()
    return rng.choice(_WORDS).encode()


def _flip(data: bytes, rng: Random) -> bytes:
    if not data:
        return data
    spoilt = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 8])):
        spoilt[rng.randrange(len(data))] ^= 1 << rng.randint(0, 7)
    return bytes(spoilt)


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: rng.randint(0, len(data))]


def _hole(data: bytes, rng: Random) -> bytes:
    start = rng.randint(0, len(data))
    return data[:start] + data[start + rng.choice([1, 2, 4, 8, 64, 512]) :]


def _insert(data: bytes, rng: Random) -> bytes:
    start, count = rng.randint(0, len(data)), rng.choice([1, 2, 4, 8, 64, 4096])
    piece = rng.choice([b"\0", b"\xff", b"A", b"\x80", b"\n"]) * count
    if rng.random() < 0.3 and data:
        first = rng.randrange(len(data))
        piece = data[first : first + count]
    return data[:start] + piece + data[start:]


def _zeroes(data: bytes, rng: Random) -> bytes:
    start, count = rng.randint(0, len(data)), rng.choice([1, 4, 16, 512, 4096])
    fill = rng.choice([b"\0", b"\xff"])
    return data[:start] + fill * min(count, len(data) - start) + data[start + count :]


def _size(data: bytes, rng: Random) -> bytes:
    """A number of 1 to 8 bytes set to one that lengths and counts stumble over."""
    width = rng.choice([1, 2, 4, 4, 8, 8])
    if len(data) < width:
        return data
    near_start = rng.random() < 0.5
    start = rng.randint(0, min(len(data) - width, 256 if near_start else len(data)))
    value = rng.choice(_SIZES) & ((1 << (8 * width)) - 1)
    piece = value.to_bytes(width, rng.choice(["little", "big"]))
    return data[:start] + piece + data[start + width :]


def _real(data: bytes, rng: Random) -> bytes:
    """A float set to one that arithmetic stumbles over."""
    kind = rng.choice(["<f", "<d", ">d"])
    width = struct.calcsize(kind)
    if len(data) < width:
        return data
    start = rng.randint(0, len(data) - width)
    value = rng.choice([float("nan"), float("inf"), float("-inf"), 3e38, -3e38, 1e-40, -0.0])
    return data[:start] + struct.pack(kind, value) + data[start + width :]


_Change = Callable[[bytes, Random], bytes]
_BYTES: tuple[_Change, ...] = (_flip, _cut, _hole, _insert, _zeroes, _ends_of_lines)
_OF_SYNTAX: dict[Syntax, tuple[_Change, ...]] = {
    "json": (_json_value, _json_value, _json_value, _token, _line),
    "toml": (_assignment, _assignment, _token, _line),
    "csv": (_cell, _cell, _cell, _line, _token),
    "text": (_token, _token, _line, _assignment),
    "binary": (_flip, _cut, _hole, _insert, _zeroes, _size, _size, _size, _real),
}
