"""Parts of files as browsers and GIS programs request them (RFC 9110, sections 8.8, 13, 14)."""

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from email.utils import formatdate, parsedate_to_datetime
from typing import Literal

_RANGE = re.compile(r"bytes[ \t]*=[ \t]*(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))[ \t]*")
_ENTITY_TAG = re.compile(r'(W/)?"[\x21\x23-\x7e\x80-\xff]*"')
_SETTLED_S = 2.0
"""Age from which a time in whole seconds identifies one content."""


@dataclass(frozen=True, kw_only=True)
class Version:
    """Identity of a file's content."""

    token: str
    modified_s: float

    @property
    def tag(self) -> str:
        """Entity tag of HTTP."""
        return f'"{self.token}"'

    @property
    def date(self) -> str:
        """Time of writing, in HTTP format."""
        return formatdate(int(self.modified_s), usegmt=True)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Bytes to send, with status and headers."""

    status: Literal[200, 206, 304, 412, 416]
    first: int = 0
    count: int = 0


def answer_to(headers: Mapping[str, str], size: int, version: Version, *, is_get: bool) -> Answer:
    """Part of a file to send for a request.

    Several ranges at once are not taken apart: the whole file is the answer, as the standard lets
    a server do.

    Args:
        headers: headers of the request, by their names in small letters.
        size: size of the file, bytes.
        version: version of the file.
        is_get: it is not a HEAD, for which ranges have no meaning.
    """
    whole = Answer(status=200, count=size)
    if "if-match" in headers:
        if not _matches(headers["if-match"], version, weak=False):
            return Answer(status=412)
    elif _is_later(headers.get("if-unmodified-since"), version):
        return Answer(status=412)
    if "if-none-match" in headers:
        if _matches(headers["if-none-match"], version, weak=True):
            return Answer(status=304)
    elif "if-modified-since" in headers and not _is_later(headers["if-modified-since"], version):
        since = _seconds(headers["if-modified-since"])
        if since is not None:
            return Answer(status=304)
    asked = _RANGE.fullmatch(headers.get("range", ""))
    if not is_get or asked is None or not _still_holds(headers.get("if-range"), version):
        return whole
    first, last, suffix = asked.groups()
    if suffix is not None:
        count = min(int(suffix), size)
        return _part(size - count, count)
    if last and int(last) < int(first):
        return whole  # no range by the standard's grammar
    end = min(int(last), size - 1) if last else size - 1
    return _part(int(first), end - int(first) + 1)


def _part(first: int, count: int) -> Answer:
    return Answer(status=206, first=first, count=count) if count > 0 else Answer(status=416)


def _matches(text: str, version: Version, *, weak: bool) -> bool:
    if text.strip() == "*":
        return True
    for found in _ENTITY_TAG.finditer(text):
        tag = found.group()
        if tag == version.tag or (weak and tag.removeprefix("W/") == version.tag):
            return True
    return False


def _still_holds(text: str | None, version: Version) -> bool:
    """Whether an If-Range names this very content."""
    if text is None:
        return True
    if text.strip().endswith('"'):
        return text.strip() == version.tag
    settled = time.time() - version.modified_s >= _SETTLED_S
    return settled and text.strip() == version.date


def _is_later(text: str | None, version: Version) -> bool:
    """Whether the file was written after a time; False where it is not a time."""
    seconds = None if text is None else _seconds(text)
    return seconds is not None and int(version.modified_s) > seconds


def _seconds(text: str) -> int | None:
    try:
        return int(parsedate_to_datetime(text).timestamp())
    except (TypeError, ValueError, OverflowError):
        return None
