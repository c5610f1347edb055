"""The first start: a survey to plan, or pictures that are there, become a workspace."""

import base64
import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import Field, RootModel

from alice_survey.app.commands.pictures import ImportImagesCommand
from alice_survey.app.pipeline import init_survey
from alice_survey.app.studio.endpoints.base import Call, Endpoint, Studio
from alice_survey.app.studio.jobs import TRIAL, command_of
from alice_survey.core.artefacts import StaleError, json_values, refuse_links
from alice_survey.core.config import Config
from alice_survey.core.errors import AliceError, WorkspaceError, why
from alice_survey.core.settings_text import Values
from missions.areas.files import SUFFIXES
from reconstruct.pictures.files import VIDEO, kind_of
from reconstruct.pictures.importing import cameras_in, preview_import

_MAX_FOLDERS = 500
_MAX_ENTRIES = 20_000
_CHOSEN = (".csv", ".json", ".txt")
"""Endings of files that a person may choose next to their pictures."""


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A folder, and what it holds itself."""

    path: str
    name: str
    pictures: int
    videos: int
    folders: int
    more: bool = False
    """Whether it holds more than was counted."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """A folder with those inside."""

    here: Folder
    above: str | None
    """The folder that it lies in, if that may be listed."""
    inside: Sequence[Folder]
    files: Sequence[str]
    """Paths of CSV, JSON and text files: logs and calibrations."""


class Folders:
    """What may be listed: the home, and what was typed since the studio has started."""

    def __init__(self, home: Path | None = None) -> None:
        """Take the home, this user's if none is given."""
        self._roots = [(Path.home() if home is None else home).resolve()]

    def list_folder(self, path: str, *, typed: bool) -> Listing:
        """The folders inside one.

        Args:
            path: of it; empty for the home.
            typed: whether a person has typed it, and so allows to list what is below.

        Raises:
            AliceError: it is no folder, cannot be read, or may not be listed.
        """
        place = Path(path).expanduser() if path else self._roots[0]
        if "\0" in path or not place.is_absolute():
            raise AliceError(f"{path}: not a whole path, such as {self._roots[0] / 'dive'}")
        real = place.resolve()
        if not real.is_dir():
            raise AliceError(f"{place}: no such folder")
        if typed:
            self._roots.append(real)
        if not self._may_list(real):
            raise AliceError(f"{place} lies outside of {self._roots[0]}: type its path to list it")
        above = real.parent
        try:
            with os.scandir(real) as entries:
                seen = [entry for entry in islice(entries, _MAX_ENTRIES) if _is_shown(entry)]
        except OSError as error:
            raise AliceError(f"{real}: cannot be listed: {why(error)}") from None
        seen.sort(key=lambda entry: entry.name.lower())
        inside = [Path(e.path) for e in seen if e.is_dir(follow_symlinks=False)]
        files = [e for e in seen if e.is_file(follow_symlinks=False)]
        return Listing(
            here=_count_folder(real),
            above=str(above) if above != real and self._may_list(above) else None,
            inside=[_count_folder(one) for one in inside[:_MAX_FOLDERS]],
            files=[e.path for e in files if Path(e.name).suffix.lower() in _CHOSEN],
        )

    def _may_list(self, real: Path) -> bool:
        return any(real.is_relative_to(root) for root in self._roots)


def _is_shown(entry: os.DirEntry[str]) -> bool:
    return not entry.name.startswith(".") and entry.name.isprintable()


def _count_folder(folder: Path) -> Folder:
    """A folder with the numbers of its pictures, videos and folders; one that cannot be read, 0."""
    entries: list[os.DirEntry[str]] = []
    with contextlib.suppress(OSError), os.scandir(folder) as found:
        entries = list(islice(found, _MAX_ENTRIES + 1))
    shown = [entry for entry in entries[:_MAX_ENTRIES] if _is_shown(entry)]
    files = [Path(entry.name) for entry in shown if not entry.is_dir(follow_symlinks=False)]
    pictures = sum(bool(kind_of(file)) for file in files)
    videos = sum(not kind_of(file) and file.suffix.lower() in VIDEO for file in files)
    return Folder(
        path=str(folder), name=folder.name or str(folder), pictures=pictures, videos=videos,
        folders=len(shown) - len(files), more=len(entries) > _MAX_ENTRIES,
    )  # fmt: skip


_MAX_BYTES = 12 << 20
_SINGLE = tuple(suffix for suffix in SUFFIXES if suffix != ".shp")
"""Kinds of area files that are one file."""


class _AskedFolder(Config):
    path: str = Field("", max_length=4000)
    typed: bool = False


class _ChosenArea(Config):
    name: str = Field(max_length=300)
    base64: str


class _NewSurvey(Config):
    name: Annotated[str, Field(min_length=1, max_length=80)]
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    length_m: float | None = None
    width_m: float | None = None
    seafloor_depth_m: float | None = None
    focal_mm: float | None = None
    area: _ChosenArea | None = None
    trial: bool = False


_Arguments = RootModel[dict[str, Any]]


@dataclass(frozen=True)
class _StartPage:
    studio: Studio
    folders: Folders = field(default_factory=Folders)

    def list_folder(self, call: Call) -> Any:
        """Folders inside one."""
        asked = call.read(_AskedFolder)
        return asdict(self.folders.list_folder(asked.path, typed=asked.typed))

    def preview(self, call: Call) -> Any:
        """What an import would find, and whether folders inside look like those of a rig."""
        asked = call.read(_Arguments).root
        given = cast(
            ImportImagesCommand, command_of("import-images", asked, self.studio.workspace.folder)
        )
        folders = given.folders or []
        rig = cameras_in(folders[0]) if len(folders) == 1 and not given.recursive else {}
        try:
            found = preview_import(
                () if rig else folders, cameras=rig or given.cameras(), videos=given.video or (),
                recursive=given.recursive, navigation=given.navigation, rig=given.rig,
                clock_offset_s=given.clock_offset, time_zone=given.time_zone,
                split=given.split is not None,
            )  # fmt: skip
        except WorkspaceError as fault:  # of a rig that is none, which was chosen wrongly
            raise AliceError(str(fault)) from None
        return json_values(found) | {"rig_folders": {name: str(path) for name, path in rig.items()}}

    def survey(self, call: Call) -> Any:
        """Write the settings of a survey to plan."""
        asked = call.read(_NewSurvey)
        workspace = self.studio.workspace.folder
        area = {"latitude_deg", "longitude_deg", "length_m", "width_m", "seafloor_depth_m"}
        values: dict[str, Mapping[str, Any]] = {
            "area": asked.model_dump(include=area, exclude_none=True),
            "camera": asked.model_dump(include={"focal_mm"}, exclude_none=True),
            **(TRIAL if asked.trial else {}),
        }  # fmt: skip
        if (asked.latitude_deg is None) != (asked.longitude_deg is None):
            raise AliceError("latitude and longitude go together: give both, or neither")
        if (workspace / "survey.toml").exists():
            raise StaleError(f"{workspace} has a survey already: change it in the Plan tab")
        with self.studio.only_writer():
            if asked.area is None:
                init_survey(workspace, name=asked.name, values=values)
            else:
                self._with_area(asked.area, asked.name, values)
        return {"workspace": str(workspace)}

    def _with_area(self, given: _ChosenArea, name: str, values: Values) -> None:
        """Write an area file that was chosen, and the settings that name it; both or neither."""
        suffix = Path(given.name).suffix.lower()
        if suffix not in _SINGLE:
            raise AliceError(
                f"{given.name}: {suffix or 'no ending'!r} files are not read; those that are: "
                f"{', '.join(_SINGLE)} (a shapefile as .zip)"
            )
        try:
            content = base64.b64decode(given.base64, validate=True)
        except ValueError:
            raise AliceError(f"{given.name} did not arrive whole: choose it again") from None
        folder = self.studio.workspace.folder
        area = folder / f"area{suffix}"
        refuse_links(folder, area)
        if area.exists():
            raise StaleError(f"{area} exists already: remove it first")
        try:
            area.write_bytes(content)
            init_survey(folder, area=area, name=name, values=values)
        except BaseException:
            area.unlink(missing_ok=True)
            raise


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """Folders, preview, and a survey to begin."""
    start = _StartPage(studio)
    post: dict[str, Any] = {"method": "POST", "writes": True}
    return (
        Endpoint(path="/api/start/folders", answer=start.list_folder, **post),
        Endpoint(path="/api/start/preview", answer=start.preview, computes=True, **post),
        Endpoint(path="/api/start/survey", answer=start.survey, max_bytes=_MAX_BYTES, **post),
    )
