"""Files of a workspace, by the names that a request gives, and of the studio's page.

Nothing else can be reached: paths that climb, hidden or unfinished files, and links are refused or
not found.
"""

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path, PurePath

from rasterio.errors import RasterioError
from starlette.datastructures import Headers
from starlette.responses import FileResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

from alice_survey.app.stages import LOOSE_FOLDERS, STAGES
from alice_survey.core.artefacts import STAGE_FILE, StaleError
from alice_survey.core.errors import AliceError

PRODUCTS = (*(stage.folder for stage in STAGES), *LOOSE_FOLDERS, "check", "revisit")
"""Folders that are shown."""
STAGES_MADE = tuple(f"{name}/{STAGE_FILE}" for name in PRODUCTS)
"""Files that say that a stage is finished."""
_LOOSE_FILES = ("survey.toml",)
_MAX_NAME = 255
_UNFINISHED = (".partial", ".replaced")
POLICY = "Content-Security-Policy"
REVALIDATE = "no-cache"
INERT = "default-src 'none'; sandbox"
_CLOSED_PAGE = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; sandbox allow-scripts"
)
"""Policy of self-contained pages: they run, but reach neither a network nor this server."""
_TEXT = "text/plain; charset=utf-8"
PAGE = "text/html; charset=utf-8"
_TYPES = {
    ".css": "text/css; charset=utf-8", ".csv": "text/csv; charset=utf-8",
    ".geojson": "application/geo+json", ".glb": "model/gltf-binary", ".html": PAGE,
    ".jpg": "image/jpeg", ".js": "text/javascript; charset=utf-8", ".json": "application/json",
    ".md": _TEXT, ".pdf": "application/pdf", ".png": "image/png", ".svg": "image/svg+xml",
    ".tif": "image/tiff", ".toml": _TEXT, ".txt": _TEXT, ".webp": "image/webp",
    ".xml": "text/xml",
}  # fmt: skip
"""What browsers show; all other files are bytes to save."""
_SCRIPT = re.compile(r"[a-z_]+\.(js|css)")


def stale_page() -> StaleError:
    """The error of a page whose files are others by now."""
    return StaleError("the survey was worked on meanwhile: load the page again")


def token_of(status: os.stat_result) -> str:
    """Token of a file's content: another file, or the same file changed, has another."""
    return f"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}"


class Workspace:
    """A folder, of which files are opened to read."""

    def __init__(self, folder: Path) -> None:
        """Take a folder; it need not hold anything yet."""
        self.folder = folder.resolve()

    def file(self, names: Sequence[str]) -> Path:
        """A file, by the names along its path.

        Raises:
            FileNotFoundError: there is no such file, or it is a link or below one.
        """
        path = self.folder.joinpath(*names)
        if path.resolve() != path or not path.is_file():
            raise FileNotFoundError(path)
        return path

    def has(self, path: str) -> bool:
        """Whether there is such a file; see `file`."""
        try:
            return bool(self.file(path.split("/")))
        except FileNotFoundError:
            return False

    def token(self, path: str) -> str:
        """Token of a file as it is now; see `file`."""
        return token_of(self.file(path.split("/")).stat())

    def state(self, paths: Sequence[str]) -> tuple[str, ...]:
        """Tokens of some files, empty where there is none."""
        return tuple(self.token(path) if self.has(path) else "" for path in paths)

    @contextmanager
    def check_unchanged(self, *paths: str) -> Iterator[tuple[str, ...]]:
        """The state of some files, which are read within this block.

        Raises:
            StaleError: they are others by now; what reading them raised gives way to that.
        """
        before = self.state(paths)
        try:
            yield before
        except (AliceError, OSError, RasterioError):
            if self.state(paths) != before:
                raise stale_page() from None
            raise
        if self.state(paths) != before:
            raise stale_page()


def _may_be_named(name: str) -> bool:
    return (
        name.isprintable()  # neither NUL nor bytes that are not UTF-8
        and "\\" not in name
        and not name.startswith(".")
        and not name.endswith(_UNFINISHED)
        and 0 < len(name.encode()) <= _MAX_NAME
    )


class _Files(StaticFiles):
    """Files in whole and in parts, with the policies of the studio."""

    def file_response(
        self,
        full_path: str | os.PathLike[str],
        stat_result: os.stat_result,
        scope: Scope,
        status_code: int = 200,
    ) -> Response:
        """A file, or that the browser's copy is still good."""
        kind = _TYPES.get(PurePath(full_path).suffix.lower(), "application/octet-stream")
        policy = _CLOSED_PAGE if kind == PAGE else INERT
        headers = {
            "Cache-Control": REVALIDATE,
            POLICY: policy,
            "ETag": f'"{token_of(stat_result)}"',
        }
        response = FileResponse(
            full_path, status_code, headers, media_type=kind, stat_result=stat_result
        )
        if self.is_not_modified(response.headers, Headers(scope=scope)):
            return NotModifiedResponse(response.headers)
        return response


class ScriptFiles(_Files):
    """Scripts and styles: the studio's own, and those of the kit that reports use too."""

    def __init__(self) -> None:
        """Take them from the package."""
        super().__init__()
        package = resources.files("alice_survey")
        folders = ("app/studio/web", "kit", "kit/web")
        self.all_directories = [str(package / folder) for folder in folders]

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        """A file by its name."""
        return super().lookup_path(path) if _SCRIPT.fullmatch(path) else ("", None)


class WorkspaceFiles(_Files):
    """Files of a workspace's products."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace."""
        super().__init__()
        self._workspace = workspace

    def get_path(self, scope: Scope) -> str:
        """The path as it was requested, below the folder of files."""
        path: str = scope["path"]
        return path.removeprefix(scope["root_path"]).removeprefix("/")

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        """A file that a product may have, and that neither is a link nor lies behind one."""
        names = path.split("/")
        if (names[0] in PRODUCTS or path in _LOOSE_FILES) and all(map(_may_be_named, names)):
            with contextlib.suppress(OSError):
                found = self._workspace.file(names)
                return str(found), found.stat()
        return "", None
