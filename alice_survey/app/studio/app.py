"""The studio's answers: its page, tiles, files, endpoints and events."""

import asyncio
import re
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib import resources
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from alice_survey.app.studio.endpoints.base import (
    Call,
    Content,
    Endpoint,
    KeptValue,
    Studio,
    json_text,
)
from alice_survey.app.studio.endpoints.shell import all_endpoints
from alice_survey.app.studio.files import PAGE, POLICY, REVALIDATE, content_type, opened
from alice_survey.app.studio.guard import API, Guard, line
from alice_survey.app.studio.jobs import BusyError
from alice_survey.app.studio.layers import FILES
from alice_survey.app.studio.page import MESH, light_mesh, listing
from alice_survey.app.studio.paths import RefusedError, names_of, worked_on
from alice_survey.core.edited_files import StaleError
from alice_survey.core.errors import AliceError, WorkspaceError, known_fault

_TILE = re.compile(
    rf"/tiles/({'|'.join(FILES)})/([0-9]{{1,2}})/([0-9]{{1,6}})/([0-9]{{1,6}})\.webp"
)
_VERSION = re.compile(r"v=([0-9a-f-]{1,64})")
_KEEP = "private, max-age=86400, immutable"
"""Cache policy of requests that state a version."""
_BODY_S = 30.0
"""Time for the body of a request to arrive."""
_MAX_STREAMS = 100
_STUDIO_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:{}; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'"
)
"""Policy of the studio's page, with the server of a web map where one is named."""
_WEB_MAP = re.compile(r"(https?://[a-z0-9.-]+(?::[0-9]{1,5})?)/[A-Za-z0-9/._~{}?=&%+-]*")
"""Address of tiles; no character that could end a content security policy's source."""
_TOKEN = "X-Studio-Token"  # noqa: S105 (the name of a header)
_JSON = "application/json"
_APP = re.compile(r"/app/([a-z_]+\.(?:js|css))")
_KIT = ("map.js", "map_stations.js", "map_tiles.js", "mesh.js", "page.css")
_VENDORED = ("vendor_map.js", "vendor_map.css", "vendor_mesh.js")


def application(studio: Studio, hosts: frozenset[str]) -> ASGIApp:
    """The studio of a workspace.

    Args:
        studio: what its endpoints share.
        hosts: names and ports that it is asked by, lower case.
    """
    answers = _Answers(studio)
    routes = [_route(studio, endpoint) for endpoint in all_endpoints(studio)]
    events = Route(f"{API}events", _events(studio))
    return Guard(Starlette(routes=[events, *routes, Route("/{path:path}", answers.answer)]), hosts)


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


def _route(studio: Studio, endpoint: Endpoint) -> Route:
    """An endpoint behind its checks."""

    async def answer(request: Request) -> Response:
        if endpoint.writes and not _is_trusted(request, studio.token):
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
        return await run_in_threadpool(_answered, endpoint, call, request)

    return Route(endpoint.path, answer, methods=[endpoint.method])


def _is_trusted(request: Request, token: str) -> bool:
    return secrets.compare_digest(request.headers.get(_TOKEN, "").encode(), token.encode())


def _answered(endpoint: Endpoint, call: Call, request: Request) -> Response:
    try:
        found = endpoint.answer(call)
    except RefusedError as fault:
        return _fault(400, str(fault))
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
    if isinstance(found, Content):
        return _content(found, request)
    return Response(json_text(found), media_type=_JSON)


def _content(found: Content, request: Request) -> Response:
    headers = {"Content-Disposition": f"attachment; filename*=UTF-8''{quote(found.name, safe='')}"}
    if not found.name:
        headers = {}
    if found.tag:
        return _versioned(request, found.data, found.tag, found.kind, request.query_params.get("v"))
    return Response(found.data, headers=headers, media_type=found.kind)


def _fault(status: int, text: str, *, close: bool = False) -> Response:
    headers = {"Connection": "close"} if close else {}
    return Response(json_text({"error": text}), status, headers, _JSON)


def _events(studio: Studio) -> Callable[[Request], Awaitable[Response]]:
    """Server-sent events, for a limited number of pages."""
    open_now = 0

    async def answer(request: Request) -> Response:
        nonlocal open_now
        if open_now >= _MAX_STREAMS:
            return line(503, f"{_MAX_STREAMS} pages are open: close some")

        async def counted() -> AsyncIterator[str]:
            nonlocal open_now
            open_now += 1
            try:
                async for text in studio.events.stream(studio.ending.is_set):
                    yield text
            finally:
                open_now -= 1

        return StreamingResponse(counted(), media_type="text/event-stream")

    return answer


class _Answers:
    """Answers to requests for pages, tiles and files."""

    def __init__(self, studio: Studio) -> None:
        self._workspace, self._layers = studio.workspace, studio.layers
        self._mesh = KeptValue(lambda: light_mesh(studio.workspace.folder))
        web_map = "" if studio.background is None else f" {server_of(studio.background)}"
        self._policy = _STUDIO_POLICY.format(web_map)

    def answer(self, request: Request) -> Response:
        """Answer a request; runs in a thread of its own."""
        try:
            return self._answer(request)
        except RefusedError as fault:
            return line(400, str(fault))
        except StaleError as fault:
            return line(409, str(fault))
        except FileNotFoundError:
            return line(404, "nothing is here")
        except (
            Exception
        ) as fault:  # libraries raise known faults as all kinds; bugs are raised again
            known = known_fault(fault)
            if known is None:
                raise
            return line(500, known)

    def _answer(self, request: Request) -> Response:
        path = request.scope["raw_path"].decode("latin-1")
        requested = _VERSION.fullmatch(request.url.query)
        token = requested.group(1) if requested else None
        tile, own = _TILE.fullmatch(path), _APP.fullmatch(path)
        if path == "/":
            return _made(_web("index.html"), self._policy)
        if own:
            headers = {"Cache-Control": REVALIDATE}
            return Response(_web(own.group(1)), headers=headers, media_type=content_type(path))
        if tile:
            name, level, x, y = tile.groups()
            content, found = self._layers.tile(name, int(level), int(x), int(y), token)
            tag = f"{found}-{level}-{x}-{y}"
            return _versioned(request, content, tag, "image/webp", token)
        if path == "/mesh.glb":
            now = self._workspace.token(MESH)
            if token not in (None, now):
                raise worked_on()
            return _versioned(request, self._mesh.of(now), now, "model/gltf-binary", token)
        if path == "/files":
            return RedirectResponse("/files/", 301)
        if path.startswith("/files/"):
            return self._file(request, path.removeprefix("/files/"))
        raise FileNotFoundError(path)

    def _file(self, request: Request, path: str) -> Response:
        names = names_of(path)
        if path == "" or path.endswith("/"):
            entries, more = self._workspace.listed(names)
            return _made(*listing(names, entries, more))
        if self._workspace.is_folder(names):
            return RedirectResponse("/files/" + "/".join(map(quote, names)) + "/", 301)
        return opened(request, self._workspace.file(names))


def _web(name: str) -> bytes:
    """A file of the studio's page: its own, or of the kit that reports use too.

    Raises:
        FileNotFoundError: there is no such file.
    """
    folder = "app/studio/web"
    if name in _KIT:
        folder = "kit"
    elif name in _VENDORED:
        folder = "kit/web"
    return (resources.files("alice_survey") / folder / name).read_bytes()


def _made(content: bytes, policy: str) -> Response:
    """A page that is made for each request."""
    return Response(content, headers={"Cache-Control": REVALIDATE, POLICY: policy}, media_type=PAGE)


def _versioned(
    request: Request, content: bytes, found: str, kind: str, requested: str | None
) -> Response:
    keep = REVALIDATE if requested is None else _KEEP
    headers = {"ETag": f'"{found}"', "Cache-Control": keep}
    if request.headers.get("If-None-Match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=kind)
