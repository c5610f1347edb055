"""The tab Plan: settings and shapes as they are, planned again while they change, and saved."""

import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field
from pydantic_core import to_json

from alice_survey.app.pipeline import init_survey, run, template_text
from alice_survey.app.stages import spec
from alice_survey.app.studio.endpoints.base import (
    Call,
    Content,
    Endpoint,
    FormatRequest,
    Studio,
    zip_files,
)
from alice_survey.core.artefacts import check_token, content_of, content_token, json_values
from alice_survey.core.config import Config, SurveyConfig, parse_settings, settings_in
from alice_survey.core.errors import AliceError, ConfigError, PlanError, collected_by, keep_warnings
from alice_survey.core.executor import local_executor
from alice_survey.core.frames import Datum
from alice_survey.core.settings_form import settings_form
from alice_survey.sim.vehicle.vehicle import known_vehicles
from missions.areas.drawn import AreaDrawing, DrawnShapes, area_drawing, drawing_of_file
from missions.areas.files import SUFFIXES
from missions.exports.registry import format_named, format_names
from missions.plan.preview import Draft, draft_settings, preview, refusal_json
from missions.values.plan_file import read_plan

SETTINGS = "survey.toml"
_MAX_REQUEST = 8 << 20
_MAX_FILE = 32 << 20
_LENSES_MM = (12.5, 25.0)
"""Of the paper."""
_JSON = "application/json"


class PlanRequest(Config):
    """Settings that a page has changed, and what it has drawn."""

    changes: dict[str, dict[str, Any]] = Field(default_factory=dict)
    shapes: DrawnShapes | None = None
    token: str | None = None
    """Of the settings that the page has seen."""
    page: str = ""
    """Names the page, whose own changes are no news to it."""


class _AreaFile(Config):
    name: str
    role: Literal["survey", "no_go", "allowed"] = "survey"


class _Settings(NamedTuple):
    """survey.toml as it is, or the template where there is none."""

    text: str
    token: str
    """Empty where there is no file."""


@dataclass(eq=False)
class _PlanTab:
    studio: Studio
    saving: threading.Lock = field(default_factory=threading.Lock)
    kept: tuple[str, dict[str, Any]] | None = None
    """Preview of what is saved, with the token of its settings and their files."""

    @property
    def path(self) -> Path:
        return self.studio.workspace.folder / SETTINGS

    @cached_property
    def limits(self) -> dict[str, dict[str, Any]]:
        return settings_form(("plan", "area", "camera", "water", "sea", "vehicle", "imaging"))

    def settings(self) -> _Settings:
        """The settings file.

        Raises:
            ConfigError: it cannot be read.
        """
        try:
            data = self.studio.workspace.file([SETTINGS]).read_bytes()
        except FileNotFoundError:
            return _Settings(template_text(), "")
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror}") from None
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError:
            raise ConfigError(f"{self.path}: is not text") from None
        return _Settings(text, content_token(data))

    def draft(self, request: PlanRequest) -> Draft:
        """The settings with a page's changes."""
        with _quiet():
            return draft_settings(self.settings().text, self.path, request.changes, request.shapes)

    def overview(self, call: Call) -> Content:
        """Settings, limits and shapes, and the plan that is saved."""
        return _json(self._overview())

    def _overview(self) -> dict[str, Any]:
        found = self.settings()
        common: dict[str, Any] = {
            "token": found.token,
            "error": None,
            "written": {},
            "limits": self.limits,
            "formats": format_names(),
            "suffixes": list(SUFFIXES),
            "stage": "missing",
            "saved": None,
        }
        try:
            written = settings_in(found.text, SETTINGS)
            config = parse_settings(found.text, self.path)
        except ConfigError as error:
            return {**common, **_about(SurveyConfig(), None), "error": str(error)}
        common["written"] = {
            name: list(part) for name, part in written.items() if isinstance(part, dict)
        }
        if not found.token:  # a new survey, of which nothing is drawn yet
            return {**common, **_about(config, None)}
        drawing = None
        try:
            with _quiet():
                drawing = area_drawing(config.area)
        except AliceError as error:
            common["error"] = str(error)
        common["stage"] = spec("plan").state(self.studio.workspace.folder, config, {})
        common["saved"] = self.preview_saved(found.token, config)
        return {**common, **_about(config, drawing)}

    def preview_saved(self, token: str, config: SurveyConfig) -> dict[str, Any]:
        """The preview of the saved settings; kept while these and their files stay."""
        files = [path.stat() for path in config.area.files]
        key = f"{token} {[(status.st_mtime_ns, status.st_size) for status in files]}"
        if self.kept is None or self.kept[0] != key:
            self.kept = (key, preview(config))
        return self.kept[1]

    def preview(self, call: Call) -> Content:
        """Plan with a page's changes; nothing is written."""
        return _json(self._preview(call.read(PlanRequest)))

    def _preview(self, request: PlanRequest) -> dict[str, Any]:
        try:
            draft = self.draft(request)
        except AliceError as error:
            return {**refusal_json(error), "cpu_s": 0.0}
        with tempfile.TemporaryDirectory() as scratch:  # for its files
            return preview(draft.config_with(Path(scratch)))

    def read_dropped(self, call: Call) -> dict[str, Any]:
        """The shapes of a file that was dropped on the page."""
        asked = call.ask(_AreaFile)
        name = Path(asked.name).name
        found = self.settings()
        config = parse_settings(found.text, self.path)
        with tempfile.TemporaryDirectory() as scratch, keep_warnings() as warnings, _quiet():
            file = Path(scratch) / f"dropped{Path(name).suffix.lower()}"
            file.write_bytes(call.body)
            try:
                # The middle of the file is the datum of a new survey.
                datum = area_drawing(config.area).datum if found.token else None
                drawing = drawing_of_file(file, config.area, role=asked.role, datum=datum)
            except PlanError as error:
                text = str(error).replace(str(file), name).replace(file.name, name)
                raise PlanError(text) from None
        texts = [text.replace(file.name, name) for text in warnings]
        shapes = drawing.shapes.model_dump(mode="json")
        return {**shapes, "datum": _datum(drawing.datum), "warnings": texts}

    def save(self, call: Call) -> Content:
        """Write the settings, and plan as the command line does."""
        request = call.read(PlanRequest)
        folder = self.studio.workspace.folder
        with self.saving, _quiet():
            with self.studio.only_writer():
                check_token(SETTINGS, content_of(self.path), request.token or "")
                draft = self.draft(request)
                if not request.token:
                    init_survey(folder)
                draft.write()
            token = self.settings().token
            self.studio.publish("plan", {"token": token, "page": request.page})
            fault = None
            try:
                run(["plan"], folder, None, executor=local_executor(1))
            except AliceError as error:
                fault = error
            config = parse_settings(draft.text, self.path)
            shown = self.preview_saved(token, config)
            if fault is not None and shown["ok"]:
                shown = refusal_json(fault)
        return _json({"token": token, "saved": shown})

    def export(self, call: Call) -> Content:
        """A file of the saved plan; of one a dive all of them, zipped."""
        name = call.ask(FormatRequest).format
        files = format_named(name).files
        plan = read_plan(self.studio.workspace.file(["plan", "plan.json"]))
        names = [
            file.name.format(dive + 1)
            for file in files
            for dive in range(len(plan.dives) if "{}" in file.name else 1)
        ]
        paths = {one: self.studio.workspace.file(["plan", "exports", one]) for one in names}
        if len(names) == 1:
            data = paths[names[0]].read_bytes()
            return Content(data=data, kind="application/octet-stream", name=names[0])
        return zip_files(f"{name}.zip", paths)


def _json(found: Mapping[str, Any]) -> Content:
    """JSON, quicker than of the shell: plans have many thousand lines."""
    return Content(data=to_json(found, inf_nan_mode="null"), kind=_JSON)


def _quiet() -> AbstractContextManager[None]:
    """Without notes and warnings on the terminal."""
    return collected_by(lambda _, __: None)


def _about(config: SurveyConfig, drawing: AreaDrawing | None) -> dict[str, Any]:
    """Settings as JSON values, their area as shapes."""
    datum = Datum(config.area.latitude_deg, config.area.longitude_deg)
    return {
        "settings": json_values(config.model_dump(mode="json")),
        "shapes": (DrawnShapes() if drawing is None else drawing.shapes).model_dump(mode="json"),
        "datum": _datum(datum if drawing is None else drawing.datum),
        "vehicles": sorted({*known_vehicles(), config.vehicle.name}),
        "lenses_mm": sorted({*_LENSES_MM, config.camera.focal_mm}),
    }


def _datum(datum: Datum) -> dict[str, float]:
    return {"latitude_deg": datum.latitude_deg, "longitude_deg": datum.longitude_deg}


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """All of the tab Plan."""
    plan = _PlanTab(studio)

    def post(name: str, answer: Callable[[Call], Any], **options: Any) -> Endpoint:
        return Endpoint(
            path=f"/api/plan/{name}", answer=answer, method="POST",
            **{"max_bytes": _MAX_REQUEST, **options},
        )  # fmt: skip

    return (
        Endpoint(path="/api/plan", answer=plan.overview),
        Endpoint(path="/api/plan/export", answer=plan.export),
        post("preview", plan.preview, computes=True),
        post("import", plan.read_dropped, max_bytes=_MAX_FILE),
        post("save", plan.save, writes=True),
    )
