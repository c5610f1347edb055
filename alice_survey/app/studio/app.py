"""The studio's answers: its page, its endpoints, the files of its workspace, and events.

Starlette's middleware refuses a request whose Host is not this machine, since a page of another
site could otherwise reach it through a name of its own (DNS rebinding). Nothing allows another site
to read an answer. Only endpoints below `/api/` take a body, from this server's own pages; what
changes files needs the token of the studio's address on top.
"""

import asyncio
import re
import secrets
from collections.abc import AsyncIterator
from importlib import resources
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, Studio, json_text
from alice_survey.app.studio.endpoints.shell import all_endpoints
from alice_survey.app.studio.files import (
    INERT,
    PAGE,
    POLICY,
    REVALIDATE,
    ScriptFiles,
    WorkspaceFiles,
)
from alice_survey.app.studio.jobs import BusyError
from alice_survey.core.artefacts import StaleError
from alice_survey.core.errors import AliceError, WorkspaceError, known_fault

HOSTS = ("127.0.0.1", "localhost")
"""Names of this machine."""
_KEEP = "private, max-age=86400, immutable"
"""Cache policy of requests that state a version."""
_BODY_S = 30.0
"""Time for the body of a request to arrive."""
_STUDIO_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:{}; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'"
)
"""Policy of the studio's page, with the server of a web map where one is named."""
_WEB_MAP = re.compile(r"(https?://[a-z0-9.-]+(?::[0-9]{1,5})?)/[A-Za-z0-9/._~{}?=&%+-]*")
"""Address of tiles; no character that could end a content security policy's source."""
_LOCKED = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
_FRAMED = "/files/report/report.html"
"""The page that the studio shows inside its own."""
_TOKEN = "X-Studio-Token"  # noqa: S105 (the name of a header)
_JSON = "application/json"


def application(studio: Studio, port: int) -> Starlette:
    """The studio of a workspace.

    Args:
        studio: what its endpoints share.
        port: that it is asked by.
    """
    web_map = "" if studio.background is None else f" {server_of(studio.background)}"
    policy = _STUDIO_POLICY.format(web_map)
    package = resources.files("alice_survey")
    index = (package / "app/studio/web/index.html").read_bytes()

    async def page(_: Request) -> Response:
        return Response(
            index, headers={"Cache-Control": REVALIDATE, POLICY: policy}, media_type=PAGE
        )

    async def events(_: Request) -> Response:
        stream: AsyncIterator[str] = studio.events.stream(studio.ending.is_set)
        return StreamingResponse(stream, media_type="text/event-stream")

    return Starlette(
        routes=[
            Route("/", page),
            Route("/api/events", events),
            *(_route(studio, endpoint) for endpoint in all_endpoints(studio)),
            Mount("/app", ScriptFiles()),
            Mount("/files", WorkspaceFiles(studio.workspace)),
        ],
        middleware=[
            Middleware(_Guard, origins={f"http://{name}:{port}" for name in HOSTS}),
            Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False),
        ],
    )


def server_of(background: str) -> str:
    """Scheme, host and port of a web map's tiles.

    Args:
        background: their address, with {z}, {x} and {y}.

    Raises:
        WorkspaceError: it is none.
    """
    found = _WEB_MAP.fullmatch(background)
    parts = re.findall(r"\{.*?\}", background)
    if found is None or sorted(parts) != ["{x}", "{y}", "{z}"]:
        raise WorkspaceError(
            f"--background {background}: give the address of tiles, such as "
            "https://tiles.example.org/{z}/{x}/{y}.png"
        )
    return found.group(1)


class _Guard:
    """Refuses bodies that are not from this server's own pages, and locks every answer in."""

    def __init__(self, app: ASGIApp, origins: set[str]) -> None:
        self._app, self._origins = app, origins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        framed = scope["path"] == _FRAMED

        async def send_locked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(_LOCKED)
                around = "'self'" if framed else "'none'"
                headers[POLICY] = f"{headers.get(POLICY, INERT)}; frame-ancestors {around}"
                headers["X-Frame-Options"] = "SAMEORIGIN" if framed else "DENY"
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        refusal = self._refusal(scope["method"], Headers(scope=scope))
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


def _route(studio: Studio, endpoint: Endpoint) -> Route:
    """An endpoint behind its checks."""

    async def answer(request: Request) -> Response:
        token = request.headers.get(_TOKEN, "").encode()
        if endpoint.writes and not secrets.compare_digest(token, studio.token.encode()):
            return _fault(403, "this needs the address with its token, as the command printed it")
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
        return await run_in_threadpool(_answer, endpoint, call, request)

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
    headers = {"Connection": "close"} if close else {}
    return Response(json_text({"error": text}), status, headers, _JSON)
