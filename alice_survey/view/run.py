"""The command `view`: serve a workspace until Ctrl-C."""

from collections.abc import Callable
from pathlib import Path

from alice_survey.base.errors import WorkspaceError
from alice_survey.base.run.interrupts import for_other_programs
from alice_survey.report.held import Held
from alice_survey.view.server import Server


def run_view(workspace: Path, port: int, *, browser: bool, show: Callable[[str], None]) -> None:
    """Serve a workspace; Ctrl-C ends it as it ends every command.

    Args:
        workspace: the workspace to show.
        port: to listen on; 0 for any that is free.
        browser: open one.
        show: prints a line.

    Raises:
        WorkspaceError: there is nothing to show, or the port is taken.
    """
    if not Held.of(workspace).stages:
        raise WorkspaceError(
            f"{workspace} holds nothing to show: run 'alice-survey plan' or 'import-images'"
        )
    server = Server(workspace, port)
    try:
        show(f"{workspace} is shown at {server.url} to this machine alone; Ctrl-C ends it")
        if browser:
            import webbrowser

            with for_other_programs():
                webbrowser.open(server.url)
        server.serve_forever()
    finally:
        server.server_close()
