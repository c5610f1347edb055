"""The studio's server: its page, endpoints, files and events, on the loopback address.

Starlette's middleware refuses a request whose Host is not this machine, since a page of another
site could otherwise reach it through a name of its own (DNS rebinding). Nothing allows another site
to read an answer. All but the empty page and its scripts need the token of the studio's address: in
a cookie that the page gets by that address, or in a header, which what changes files needs in any
case. Only endpoints below `/api/` take a body, from this server's own pages. Every request has a
deadline, and what computes waits in a queue of its own.
"""

import asyncio
import contextlib
import importlib
import logging
import pkgutil
import secrets
import socket
import threading
from collections.abc import Callable, Iterable
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.background import BackgroundTask
    from starlette.concurrency import run_in_threadpool
    from starlette.datastructures import Headers, MutableHeaders
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.requests import HTTPConnection, Request
    from starlette.responses import JSONResponse, Response, StreamingResponse
    from starlette.routing import Mount, Route
    from starlette.types import ASGIApp, Message, Receive, Scope, Send
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from alice_survey.app.studio.files import (
        INERT,
        PAGE,
        POLICY,
        REVALIDATE,
        ScriptFiles,
        Workspace,
        WorkspaceFiles,
    )
except ImportError as missing:
    from alice_survey.core.errors import WorkspaceError, extra

    raise WorkspaceError(f"the studio needs {missing.name}: {extra('studio')}") from None

from alice_survey.app.studio import endpoints
from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, Studio, json_text
from alice_survey.app.studio.jobs import BusyError, compile_survey
from alice_survey.app.studio.layers import Layers
from alice_survey.core.artefacts import StaleError
from alice_survey.core.compiled import left_to_compile
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import AliceError, WorkspaceError, known_fault, why
from alice_survey.core.run.events import event_of, event_text
from alice_survey.core.run.interrupts import for_other_programs
from alice_survey.core.run.progress import Run
from alice_survey.core.run.resources import release_memory
from missions.plan.preview import preview

ADDRESS = "127.0.0.1"
_ASK_S = 10.0
"""Time from a connection, or from the last answer on it, to a whole request."""
_ANSWER_S = 900.0
"""Time to take an answer in: ten gigabytes by a slow disk."""
_ENDING_S = 3
"""Time to wait at the end for answers in work."""
_MAX_CONNECTIONS = 400
HOSTS = ("127.0.0.1", "localhost")
"""Names of this machine."""
_KEEP = "private, max-age=86400, immutable"
"""Cache policy of requests that state a version."""
_BODY_S = 30.0
"""Time for the body of a request to arrive."""
_STUDIO_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob: "
    "https: http://127.0.0.1:* http://localhost:*; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'"
)
"""Policy of the studio's page."""
_LOCKED = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
}
_TOKEN, _NEWEST_OF = "X-Studio-Token", "X-Studio-Newest-Of"
"""Headers: the token, and the page that asks with the number of its request."""
_OLDER = "a newer request of the same page is answered"
_NEEDS_TOKEN = "this needs the address with its token, as the command printed it"  # noqa: S105 (a line)
_MAX_STREAMS = 100
"""Pages that listen for events."""
_COMPUTING, _MAX_WAITING, _WAIT_S = 2, 16, 60.0
"""Requests that compute at once, that wait for it, and how long they wait."""
_JSON = "application/json"


def application(studio: Studio, port: int) -> Starlette:
    """The studio of a workspace.

    Args:
        studio: what its endpoints share.
        port: that it is asked by.
    """
    package = resources.files("alice_survey")
    index = (package / "app/studio/web/index.html").read_bytes()

    queue, cookie = _ComputeQueue(), f"studio-{port}"

    async def page(request: Request) -> Response:
        found = Response(
            index, headers={"Cache-Control": REVALIDATE, POLICY: _STUDIO_POLICY}, media_type=PAGE
        )
        if _is_token(studio, request.query_params.get("token")):
            found.set_cookie(cookie, studio.token, httponly=True, samesite="strict")
        return found

    async def events(_: Request) -> Response:
        return _EventStream(studio)

    return Starlette(
        routes=[
            Route("/", page),
            Route("/api/events", events),
            *(_route(studio, queue, endpoint) for endpoint in all_endpoints(studio)),
            Mount("/app", ScriptFiles()),
            Mount("/files", WorkspaceFiles(studio.workspace)),
        ],
        middleware=[
            Middleware(
                _Guard,
                origins={f"http://{name}:{port}" for name in HOSTS},
                is_known=lambda request: (
                    _is_token(studio, request.cookies.get(cookie))
                    or _is_token(studio, request.headers.get(_TOKEN))
                    or (
                        request.url.path.startswith("/files/")  # as a GIS asks
                        and _is_token(studio, request.query_params.get("token"))
                    )
                ),
            ),
            Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False),
        ],
    )


def all_endpoints(studio: Studio) -> Iterable[Endpoint]:
    """The endpoints of every tab."""
    for found in pkgutil.iter_modules(endpoints.__path__):
        tab = importlib.import_module(f"{endpoints.__name__}.{found.name}")
        if hasattr(tab, "endpoints"):
            yield from tab.endpoints(studio)


def _is_token(studio: Studio, given: str | None) -> bool:
    return secrets.compare_digest((given or "").encode(), studio.token.encode())


class _EventStream(StreamingResponse):
    """Events for one page, of those that may listen at once."""

    def __init__(self, studio: Studio) -> None:
        events = studio.events
        super().__init__(events.stream(studio.ending.is_set), media_type="text/event-stream")
        self._listening = events.listening

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if len(self._listening) >= _MAX_STREAMS:
            await _fault(503, f"{_MAX_STREAMS} pages listen already: close some")(
                scope, receive, send
            )
            return
        self._listening.add(self)
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._listening.discard(self)


class _ComputeQueue:
    """Work of endpoints that compute: few at once, and only the newest of what a page replaces."""

    def __init__(self) -> None:
        self._places = asyncio.Semaphore(_COMPUTING)
        self._waiting: dict[object, tuple[int, asyncio.Future[None]]] = {}

    async def run(self, newest_of: str, path: str, work: Callable[[], Response]) -> Response:
        """Do the work of a page in its turn.

        Args:
            newest_of: a name of the page and the number of its request, since connections do not
                keep the order in which it asked. Empty: every request is answered.
            path: that is asked for.
            work: what answers it.
        """
        page, _, digits = newest_of.partition(" ")
        number = int(digits) if digits.isdecimal() else 0
        key = (page, path) if page else object()
        waiting, other = self._waiting.get(key, (0, None))
        if other is not None and waiting > number:
            return _fault(409, _OLDER)
        if other is not None:
            del self._waiting[key]
            other.set_result(None)
        if len(self._waiting) >= _MAX_WAITING:
            return _fault(503, "the studio computes for other pages: try again in a moment")
        gives_way: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[key] = number, gives_way
        turn = asyncio.ensure_future(self._places.acquire())
        try:
            await asyncio.wait(
                (turn, gives_way), timeout=_WAIT_S, return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            if self._waiting.get(key) == (number, gives_way):
                del self._waiting[key]
            has_turn = turn.done() or not turn.cancel()
        try:
            if gives_way.done():
                return _fault(409, _OLDER)
            if not has_turn:
                return _fault(503, "the studio computes for other pages: try again in a moment")
            found = await run_in_threadpool(work)
            found.background = BackgroundTask(release_memory)
            return found
        finally:
            if has_turn:
                self._places.release()


class _Guard:
    """Refuses who has no token and bodies of other pages, and locks every answer in."""

    def __init__(
        self, app: ASGIApp, origins: set[str], is_known: Callable[[HTTPConnection], bool]
    ) -> None:
        self._app, self._origins, self._is_known = app, origins, is_known

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_locked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(_LOCKED)
                headers[POLICY] = f"{headers.get(POLICY, INERT)}; frame-ancestors 'none'"
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        refusal = self._refusal(scope["method"], Headers(scope=scope))
        is_open = scope["path"] == "/" or scope["path"].startswith("/app/")
        if refusal is None and not is_open and not self._is_known(HTTPConnection(scope)):
            refusal = _fault(403, _NEEDS_TOKEN, close=True)
        await (refusal or self._app)(scope, receive, send_locked)

    def _refusal(self, method: str, headers: Headers) -> Response | None:
        """A form of another site can be neither of this origin nor of these types."""
        size = headers.get("Content-Length", "0")
        if method != "POST":
            has_body = "Transfer-Encoding" in headers or size != "0"
            return _fault(400, "a request with a body", close=True) if has_body else None
        origin = headers.get("Origin")
        if origin is not None and origin.lower() not in self._origins:
            return _fault(403, "a request of another page", close=True)
        kind = headers.get("Content-Type", "").split(";")[0].strip().lower()
        if kind not in (_JSON, "application/octet-stream"):
            return _fault(415, "application/json or application/octet-stream", close=True)
        if "Transfer-Encoding" in headers or not size.isdecimal() or int(size) == 0:
            return _fault(411, "a body without its length", close=True)
        return None


def _route(studio: Studio, queue: _ComputeQueue, endpoint: Endpoint) -> Route:
    """An endpoint behind its checks."""

    async def answer(request: Request) -> Response:
        if endpoint.writes and not _is_token(studio, request.headers.get(_TOKEN)):
            return _fault(403, _NEEDS_TOKEN)
        body = b""
        if endpoint.method == "POST":
            size = int(request.headers["Content-Length"])
            if size > endpoint.max_bytes:
                return _fault(
                    413, f"{size:,} bytes: at most {endpoint.max_bytes:,} are taken", close=True
                )
            try:
                body = await asyncio.wait_for(request.body(), _BODY_S)
            except TimeoutError:
                return _fault(408, "the request did not arrive in time", close=True)
        call = Call(query=dict(request.query_params), path=dict(request.path_params), body=body)
        work = partial(_answer, endpoint, call, request)
        if endpoint.computes:
            return await queue.run(request.headers.get(_NEWEST_OF, ""), endpoint.path, work)
        return await run_in_threadpool(work)

    return Route(endpoint.path, answer, methods=[endpoint.method])


def _answer(endpoint: Endpoint, call: Call, request: Request) -> Response:
    try:
        found = endpoint.answer(call)
    except (StaleError, BusyError) as fault:
        return _fault(409, str(fault))
    except FileNotFoundError:
        return _fault(404, "nothing is here")
    except Exception as fault:  # libraries raise known faults as all kinds; bugs are raised again
        known = known_fault(fault)
        if known is None:
            raise
        asked_wrongly = isinstance(fault, AliceError) and not isinstance(fault, WorkspaceError)
        return _fault(400 if asked_wrongly else 500, known)
    if not isinstance(found, Content):
        return Response(json_text(found), media_type=_JSON)
    headers = {}
    if found.name:
        headers["Content-Disposition"] = (
            f"attachment; filename*=UTF-8''{quote(found.name, safe='')}"
        )
    if found.tag:
        headers |= {
            "ETag": f'"{found.tag}"',
            "Cache-Control": _KEEP if "v" in call.query else REVALIDATE,
        }
        if request.headers.get("If-None-Match") == headers["ETag"]:
            return Response(status_code=304, headers=headers)
    return Response(found.data, headers=headers, media_type=found.kind)


def _fault(status: int, text: str, *, close: bool = False) -> Response:
    return JSONResponse({"error": text}, status, {"Connection": "close"} if close else {})


class _TimedConnection(H11Protocol):
    """A connection that is closed where its request or the reading of an answer takes too long."""

    _deadline: asyncio.TimerHandle | None = None

    # asyncio gives a server a Transport; uvicorn narrows the type of its base in the same way.
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._allow(_ASK_S)

    def handle_events(self) -> None:
        answered = self.cycle
        super().handle_events()
        if self.cycle is not answered:
            self._allow(_ANSWER_S)

    def on_response_complete(self) -> None:
        self._allow(_ASK_S)
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _allow(self, seconds: float) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = self.loop.call_later(seconds, self.transport.abort)


class Server:
    """Serves one workspace until it is shut down."""

    def __init__(self, folder: Path, port: int = 0, *, log: str | None = None) -> None:
        """Listen.

        Args:
            folder: folder of the workspace.
            port: 0 for any that is free.
            log: where the navigation of a dive comes from.

        Raises:
            WorkspaceError: the port is not available.
        """
        workspace = Workspace(folder)
        self.studio = Studio(
            workspace=workspace, layers=Layers(workspace), token=secrets.token_urlsafe(24), log=log
        )
        try:
            self.socket = socket.create_server((ADDRESS, port), backlog=128)
        except OSError as error:
            raise WorkspaceError(f"port {port}: {why(error)}: give another, or no --port") from None
        self.port: int = self.socket.getsockname()[1]
        self._uvicorn = uvicorn.Server(
            uvicorn.Config(
                application(self.studio, self.port),
                http=_TimedConnection,
                ws="none",
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                limit_concurrency=_MAX_CONNECTIONS,
                timeout_keep_alive=int(_ASK_S),
                timeout_graceful_shutdown=_ENDING_S,
            )
        )

    @property
    def url(self) -> str:
        """Where the studio is."""
        return f"http://{ADDRESS}:{self.port}/"

    @property
    def address(self) -> str:
        """The same with the token that a page needs to change anything."""
        return f"{self.url}?token={self.studio.token}"

    def serve_forever(self) -> None:
        """Answer until an interruption of this thread, or `shutdown` from another.

        Answers are made in another thread: an interruption would break one off that has begun.
        """
        answering = threading.Thread(
            target=self._uvicorn.run, kwargs={"sockets": [self.socket]}, daemon=True
        )
        answering.start()
        log = logging.getLogger("uvicorn.error")
        log.addFilter(self._is_shown)
        try:
            answering.join()
        finally:
            self.shutdown()
            answering.join(2 * _ENDING_S)
            log.removeFilter(self._is_shown)

    def _is_shown(self, record: logging.LogRecord) -> bool:
        """Whether uvicorn may speak: not of wrong requests, nor of what is dropped at the end."""
        return record.levelno >= logging.ERROR and not self.studio.ending.is_set()

    def shutdown(self) -> None:
        """End `serve_forever`."""
        self.studio.ending.set()
        self._uvicorn.should_exit = True

    def close(self) -> None:
        """Stop listening, and end the job."""
        with contextlib.suppress(OSError):
            self.socket.close()
        self.studio.jobs.close()


def _compile_ahead(studio: Studio) -> None:
    """Compile what a page will ask for, and then, while a person reads, what commands need."""

    def publish(record: logging.LogRecord) -> bool:
        event = event_of(record)
        studio.publish("compiling", event_text(event) if "remaining_s" in event else "")
        return False

    log = logging.Logger("compiling")
    log.addFilter(publish)
    run = Run(log=log)
    with run.stage("plan", ""):
        preview(SurveyConfig())
    run.close()
    if left_to_compile():
        compile_survey(studio.ending)


def run_studio(
    workspace: Path, port: int, *, browser: bool, show: Callable[[str], Any], log: str | None = None
) -> None:
    """Serve a workspace; Ctrl-C ends it as it ends every command.

    Args:
        workspace: the workspace; it need not exist yet.
        port: to listen on; 0 for any that is free.
        browser: open one.
        show: prints a line.
        log: where the navigation of a dive comes from.

    Raises:
        WorkspaceError: the port is taken.
    """
    server = Server(workspace, port, log=log)
    ahead = threading.Thread(target=_compile_ahead, args=(server.studio,), daemon=True)
    ahead.start()
    try:
        new = "" if workspace.is_dir() else " (not there yet)"
        show(f"{workspace}{new} is shown at {server.address} to this machine alone; Ctrl-C ends it")
        if browser:
            import webbrowser

            with for_other_programs():
                webbrowser.open(server.address)
        server.serve_forever()
    finally:
        ahead.join(_ENDING_S)
        server.close()
