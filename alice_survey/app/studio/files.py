"""Files of a workspace, by the names that a request gives, and of the studio's page.

Nothing else can be reached: paths that climb, hidden or unfinished files, and links are refused or
not found.
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePath
from urllib.parse import quote

from rasterio.errors import RasterioError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, RedirectResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

from alice_survey.app.stages import LOOSE_FOLDERS, STAGES
from alice_survey.core.artefacts import STAGE_FILE, StaleError
from alice_survey.core.errors import AliceError
from alice_survey.kit.document import Link, Report, Section
from alice_survey.kit.page import page_policy, render_html
from alice_survey.kit.words import count

PRODUCTS = (*(stage.folder for stage in STAGES), *LOOSE_FOLDERS, "check", "revisit")
"""Folders that are shown."""
_LOOSE_FILES = ("survey.toml",)
_MAX_NAME = 255
_MAX_LISTED = 20_000
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


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of a listing."""

    name: str
    is_folder: bool
    size: int


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
        path = self._real_path(names)
        if not path.is_file():
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

    def is_folder(self, names: Sequence[str]) -> bool:
        """Whether a folder, not a link to one, is there."""
        try:
            return self._real_path(names).is_dir()
        except FileNotFoundError:
            return False

    def entries(self, names: Sequence[str]) -> tuple[Sequence[Entry], int]:
        """Visible contents of a folder, folders first, and the number of further entries.

        Raises:
            FileNotFoundError: there is no such folder.
        """
        if not self.is_folder(names):
            raise FileNotFoundError
        with os.scandir(self._real_path(names)) as entries:
            found = sorted(
                (
                    Entry(
                        name=entry.name,
                        is_folder=entry.is_dir(follow_symlinks=False),
                        size=entry.stat(follow_symlinks=False).st_size,
                    )
                    for entry in entries
                    if _is_shown(entry, top=not names)
                ),
                key=lambda entry: (not entry.is_folder, entry.name),
            )
        return found[:_MAX_LISTED], max(0, len(found) - _MAX_LISTED)

    def state(self, paths: Sequence[str]) -> tuple[str, ...]:
        """Tokens of all finished stages and of some files, empty where there is none."""
        files = (*(f"{name}/{STAGE_FILE}" for name in PRODUCTS), *paths)
        return tuple(self.token(path) if self.has(path) else "" for path in files)

    @contextmanager
    def check_unchanged(self, paths: Sequence[str] = ()) -> Iterator[tuple[str, ...]]:
        """The state of finished stages and of some files, which are read within this block.

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

    def _real_path(self, names: Sequence[str]) -> Path:
        path = self.folder.joinpath(*names)
        if path.resolve() != path:
            raise FileNotFoundError(path)
        return path


def _is_shown(entry: os.DirEntry[str], *, top: bool) -> bool:
    is_folder = entry.is_dir(follow_symlinks=False)
    is_file = entry.is_file(follow_symlinks=False)
    if top:
        is_folder = is_folder and entry.name in PRODUCTS
        is_file = is_file and entry.name in _LOOSE_FILES
    return _may_be_named(entry.name) and (is_folder or is_file)


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
    """Files of a workspace's products; folders are listed."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace."""
        super().__init__()
        self._workspace = workspace

    def get_path(self, scope: Scope) -> str:
        """The path as it was requested, below the folder of files."""
        path: str = scope["path"]
        return path.removeprefix(scope["root_path"]).removeprefix("/")

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        """A file, or a folder.

        Raises:
            ValueError: no product can have such a path.
        """
        names = _names_of(path)
        try:
            found = self._workspace.folder.joinpath(*names)
            if not self._workspace.is_folder(names):
                found = self._workspace.file(names)
            return str(found), found.stat()
        except OSError:
            return "", None

    async def get_response(self, path: str, scope: Scope) -> Response:
        """A file, or the list of a folder's contents."""
        try:
            names = _names_of(path)
        except ValueError:
            raise HTTPException(404) from None
        if scope["method"] not in ("GET", "HEAD") or not self._workspace.is_folder(names):
            if path.endswith("/"):
                raise HTTPException(404)
            return await super().get_response(path, scope)
        if path and not path.endswith("/"):
            return RedirectResponse("/files/" + "/".join(map(quote, names)) + "/", 301)
        content, policy = await run_in_threadpool(self._listing, names)
        headers = {"Cache-Control": REVALIDATE, POLICY: policy}
        return Response(content, headers=headers, media_type=PAGE)

    def _listing(self, names: Sequence[str]) -> tuple[bytes, str]:
        """A page that lists a folder, and its policy."""
        entries, more = self._workspace.entries(names)
        links = [Link(text="The studio", address="/")]
        if names:
            links.append(Link(text="..", address="../"))
        for entry in entries:
            mark = "/" if entry.is_folder else ""
            size = "" if entry.is_folder else count(entry.size, "byte")
            address = f"./{quote(entry.name)}{mark}"
            links.append(Link(text=entry.name + mark, address=address, about=size))
        text = [f"and {more:,} more"] if more else []
        report = Report(
            title="/".join(("files", *names)), subtitle="",
            sections=[Section(title="Files", text=text, links=links)],
        )  # fmt: skip
        return render_html(report).encode(), page_policy(report)


def _names_of(path: str) -> tuple[str, ...]:
    """The names along a requested path.

    Raises:
        ValueError: it climbs, is absolute, or has a name that no product has.
    """
    names = tuple(path.removesuffix("/").split("/")) if path else ()
    is_product = not names or names[0] in PRODUCTS or names == _LOOSE_FILES
    if not is_product or not all(map(_may_be_named, names)):
        raise ValueError("no product of a survey has this path")
    return names
