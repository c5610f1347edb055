"""The studio's server: on the loopback address, with a deadline for every request."""

import asyncio
import contextlib
import logging
import secrets
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from alice_survey.app.studio.files import Workspace
from alice_survey.app.studio.layers import Layers
from alice_survey.core.errors import WorkspaceError, why
from alice_survey.core.run.interrupts import for_other_programs

try:
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from alice_survey.app.studio.app import application
    from alice_survey.app.studio.endpoints.base import Studio
    from alice_survey.app.studio.endpoints.plan import prepare_planning
except ImportError as missing:
    raise WorkspaceError(
        f"the studio needs {missing.name}, which is not installed: "
        "pip install 'alice-survey[studio]'"
    ) from None

ADDRESS = "127.0.0.1"
_ASK_S = 10.0
"""Time from a connection, or from the last answer on it, to a whole request."""
_ANSWER_S = 900.0
"""Time to take an answer in: ten gigabytes by a slow disk."""
_ENDING_S = 3
"""Time to wait at the end for answers in work."""
_MAX_CONNECTIONS = 400


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

    def __init__(
        self,
        folder: Path,
        port: int = 0,
        *,
        log: str | None = None,
        background: str | None = None,
    ) -> None:
        """Listen.

        Args:
            folder: folder of the workspace.
            port: 0 for any that is free.
            log: where the navigation of a dive comes from.
            background: address of a web map's tiles to lie under it.

        Raises:
            WorkspaceError: the port is not available.
        """
        workspace = Workspace(folder)
        self.studio = Studio(
            workspace=workspace,
            layers=Layers(workspace),
            token=secrets.token_urlsafe(24),
            log=log,
            background=background,
        )
        try:
            self.socket = socket.create_server((ADDRESS, port), backlog=128)
        except OSError as error:
            raise WorkspaceError(
                f"port {port} of {ADDRESS}: {why(error)}: give another --port, or none"
            ) from None
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

    def _is_shown(self, _: logging.LogRecord) -> bool:
        """Whether uvicorn may speak: of what is dropped at the end nobody needs to hear."""
        return not self.studio.ending.is_set()

    def shutdown(self) -> None:
        """End `serve_forever`."""
        self.studio.ending.set()
        self._uvicorn.should_exit = True

    def close(self) -> None:
        """Stop listening, end the job, and wait briefly for what is being read."""
        with contextlib.suppress(OSError):
            self.socket.close()
        self.studio.jobs.close()
        self.studio.layers.close()


def run_studio(
    workspace: Path,
    port: int,
    *,
    browser: bool,
    show: Callable[[str], Any],
    log: str | None = None,
    background: str | None = None,
) -> None:
    """Serve a workspace; Ctrl-C ends it as it ends every command.

    Args:
        workspace: the workspace; it need not exist yet.
        port: to listen on; 0 for any that is free.
        browser: open one.
        show: prints a line.
        log: where the navigation of a dive comes from.
        background: address of a web map's tiles to lie under it.

    Raises:
        WorkspaceError: the port is taken.
    """
    server = Server(workspace, port, log=log, background=background)
    threading.Thread(target=prepare_planning, daemon=True).start()
    try:
        show(f"{workspace} is shown at {server.address} to this machine alone; Ctrl-C ends it")
        if browser:
            import webbrowser

            with for_other_programs():
                webbrowser.open(server.address)
        server.serve_forever()
    finally:
        server.close()
