"""Endpoints of the studio: what one is, what it is asked, and what it may use."""

import asyncio
import contextlib
import functools
import io
import json
import math
import threading
import zipfile
from collections.abc import AsyncIterator, Callable, Hashable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError

from alice_survey.app.pipeline import only_one
from alice_survey.app.studio.files import Workspace
from alice_survey.app.studio.jobs import Jobs
from alice_survey.app.studio.layers import Layers
from alice_survey.core.config import Config
from alice_survey.core.contents import first_fault
from alice_survey.core.errors import AliceError

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")
_ALIVE_S = 5.0
"""Time after which a silent stream of events says that it is there."""
_MAX_WAITING = 1000
"""Events that a page may be behind; a slower one misses the oldest."""


@dataclass(frozen=True, kw_only=True)
class Content:
    """An answer that is not JSON."""

    data: bytes
    kind: str
    """Content type."""
    tag: str = ""
    """Token of what it is of; empty for an answer that is not to be kept."""
    name: str = ""
    """File name to save it by; empty for one to be shown."""


def zip_files(name: str, files: Mapping[str, bytes | Path]) -> Content:
    """Files by their names in a ZIP."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in files.items():
            data = content if isinstance(content, bytes) else content.read_bytes()
            archive.writestr(zipfile.ZipInfo(file), data, zipfile.ZIP_DEFLATED)
    return Content(data=packed.getvalue(), kind="application/zip", name=name)


class KeptValue(Generic[T]):
    """A value that is made again when what it is of has changed; threads may share it."""

    def __init__(self, make: Callable[[], T]) -> None:
        """Take what makes it."""
        self._lock = threading.Lock()
        self._made = lru_cache(1)(lambda _: make())

    def of(self, state: Hashable) -> T:
        """The value of a state."""
        with self._lock:
            return self._made(state)


@dataclass(frozen=True, kw_only=True)
class Call:
    """A request to an endpoint."""

    query: Mapping[str, str]
    path: Mapping[str, str]
    """Values of the parts in braces of the endpoint's path."""
    body: bytes = b""

    def read(self, kind: type[M]) -> M:
        """The body as a model.

        Raises:
            AliceError: it is not one; the line names the first value that is wrong.
        """
        return _validate(lambda: kind.model_validate_json(self.body))

    def ask(self, kind: type[M]) -> M:
        """The query and the parts of the path as a model; see `read`."""
        return _validate(lambda: kind.model_validate({**self.query, **self.path}))


def _validate(make: Callable[[], M]) -> M:
    try:
        return make()
    except ValidationError as error:
        raise AliceError(f"the request: {first_fault(error, 'its body')}") from None


class FormatRequest(Config):
    """A format to export."""

    format: str = ""


class TileRequest(Config):
    """A tile of a picture or of a layer, of some version."""

    name: str
    level: int = Field(ge=0, le=1_000_000)
    """0 is the coarsest."""
    x: int = Field(ge=0, le=1_000_000)
    y: int = Field(ge=0, le=1_000_000)
    v: str | None = None


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """Something that a page may ask for."""

    path: str
    """From `/api/` on; `{name}` and `{name:path}` stand for a part of it."""
    answer: Callable[[Call], Any]
    """Runs in a thread. Returns JSON values, or `Content`. A number that is not finite is null."""
    method: Literal["GET", "POST"] = "GET"
    writes: bool = False
    """Whether files change, or files outside of the workspace are named: needs the token."""
    computes: bool = False
    """Whether it takes long enough to wait for its turn, so that other requests do not."""
    max_bytes: int = 1 << 20
    """Largest body."""

    def __post_init__(self) -> None:
        if self.writes and self.method != "POST":
            raise ValueError(f"{self.path} writes, and is not POST")


@dataclass(frozen=True, kw_only=True, eq=False)
class Studio:
    """What endpoints share."""

    workspace: Workspace
    layers: Layers
    token: str
    """What a page has to show to change anything."""
    log: str | None = None
    """Where the navigation of a dive comes from, as `--log` names it."""
    events: "Events" = field(default_factory=lambda: Events())
    ending: threading.Event = field(default_factory=threading.Event)
    """Set when the studio ends: threads of endpoints have to end then."""

    def publish(self, event: str, data: Any) -> None:
        """Send an event to every page; any thread may."""
        self.events.publish(event, data)

    @functools.cached_property
    def jobs(self) -> Jobs:
        """The commands that run in the workspace."""
        return Jobs(self.workspace.folder, self.publish)

    def only_writer(self) -> AbstractContextManager[None]:
        """Keep commands and other pages from working in the workspace."""
        return only_one(self.workspace.folder)


class Events:
    """Server-sent events (WHATWG HTML, 9.2) for any number of pages."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: dict[asyncio.Queue[str], asyncio.AbstractEventLoop] = {}
        self.listening: set[object] = set()
        """Streams that were accepted and have not ended."""

    def publish(self, event: str, data: Any) -> None:
        """Send an event to every page; any thread may."""
        text = f"event: {event}\ndata: {json_text(data)}\n\n"
        with self._lock:
            for queue, loop in self._pages.items():
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(_put, queue, text)

    async def stream(self, ended: Callable[[], bool]) -> AsyncIterator[str]:
        """Events from now on, until the server ends."""
        queue: asyncio.Queue[str] = asyncio.Queue()
        with self._lock:
            self._pages[queue] = asyncio.get_running_loop()
        try:
            yield "retry: 1000\n\n"
            silent_s = 0.0
            while not ended():
                try:
                    yield await asyncio.wait_for(queue.get(), 0.5)
                    silent_s = 0.0
                except TimeoutError:
                    silent_s += 0.5
                    if silent_s >= _ALIVE_S:
                        silent_s = 0.0
                        yield ": still here\n\n"
        finally:
            with self._lock:
                self._pages.pop(queue, None)


def _put(queue: asyncio.Queue[str], text: str) -> None:
    if queue.qsize() >= _MAX_WAITING:
        queue.get_nowait()
    queue.put_nowait(text)


def json_text(values: Any) -> str:
    """JSON on one line; numbers that are not finite are null."""
    return json.dumps(_finite(values), allow_nan=False, separators=(",", ":"))


def _finite(values: Any) -> Any:
    if isinstance(values, float):
        return values if math.isfinite(values) else None
    if isinstance(values, dict):
        return {str(name): _finite(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [_finite(value) for value in values]
    return values
