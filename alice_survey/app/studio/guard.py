"""Which requests the studio allows at all, and what every answer carries.

A request whose Host is not this server by its address and port is refused, since a page of another
site could otherwise reach it through a name of its own (DNS rebinding). Nothing allows another site
to read an answer. Only endpoints below `/api/` take a body, from this server's own pages; what
changes files needs the token of the studio's address on top.
"""

import itertools

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from alice_survey.app.studio.files import INERT, POLICY

_MAX_HEAD = 32 << 10
_ALLOWED = ("GET", "HEAD")
_COMMON = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
_FRAMED = "/files/report/report.html"
"""The page that the studio shows inside its own."""
API = "/api/"


class Guard:
    """Refuses what is not a request to this server, and locks every answer in."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        """Guard an application.

        Args:
            app: the application.
            hosts: names and ports that it is asked by, lower case.
        """
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        framed = scope["path"] == _FRAMED

        async def locked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, text in _COMMON.items():
                    headers[name] = text
                around = "'self'" if framed else "'none'"
                headers[POLICY] = f"{headers.get(POLICY, INERT)}; frame-ancestors {around}"
                headers["X-Frame-Options"] = "SAMEORIGIN" if framed else "DENY"
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        refused = self._refused(scope)
        await (refused or self._app)(scope, receive, locked)

    def _refused(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        hosts = headers.getlist("Host")
        if scope["http_version"] not in ("1.0", "1.1"):
            return line(505, "HTTP 1.1 alone is spoken")
        if sum(map(len, itertools.chain(*scope["headers"]))) > _MAX_HEAD:
            return line(431, f"more than {_MAX_HEAD} bytes of headers", Connection="close")
        if len(hosts) != 1:
            return line(400, f"{len(hosts)} Host headers, 1 expected")
        host = hosts[0].strip().lower()
        if host not in self._hosts:
            return line(421, f"this is {', '.join(sorted(self._hosts))}")
        if not scope["raw_path"].startswith(b"/"):
            return line(400, "a request for another server")
        if scope["method"] == "POST" and scope["path"].startswith(API):
            return _refused_post(headers, host)
        if scope["method"] not in _ALLOWED:
            return line(405, "GET and HEAD alone are answered", Allow=", ".join(_ALLOWED))
        if "Transfer-Encoding" in headers or headers.get("Content-Length", "0") != "0":
            return line(400, "a request with a body", Connection="close")
        return None


def _refused_post(headers: Headers, host: str) -> Response | None:
    """A form of another site can be neither of this origin nor of these types."""
    origin = headers.get("Origin", f"http://{host}").lower()
    if origin != f"http://{host}":
        return line(403, "a request of another page", Connection="close")
    kind = headers.get("Content-Type", "").split(";")[0].strip().lower()
    if kind not in ("application/json", "application/octet-stream"):
        return line(415, "application/json or application/octet-stream", Connection="close")
    if "Transfer-Encoding" in headers or not headers.get("Content-Length", "").isdecimal():
        return line(411, "a body without its length", Connection="close")
    return None


def line(status: int, text: str, **headers: str) -> Response:
    """An answer of one line."""
    return PlainTextResponse(f"{text}\n", status, headers)
