"""A survey's settings as somebody changes and draws them: the new text of `survey.toml`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.config import (
    AreaConfig,
    Config,
    SurveyConfig,
    checked_settings,
    parse_settings,
    settings_files,
    settings_in,
)
from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Datum
from alice_survey.core.settings_text import Values, with_settings_changed, with_values
from missions.areas.drawn import DrawnShapes, area_settings


@dataclass(frozen=True, kw_only=True)
class Draft:
    """Settings that were changed, not yet written."""

    path: Path
    """Of the settings file."""
    text: str
    """What it will hold."""
    config: SurveyConfig
    """The same, checked; files that are still to be written are named as they will be."""
    files: Mapping[str, str]
    """Contents of files to write next to it, by name."""

    def config_with(self, scratch: Path) -> SurveyConfig:
        """The settings with their new files written into a folder that nobody else reads."""
        if not self.files:
            return self.config
        for name, text in self.files.items():
            (scratch / name).write_text(text, encoding="utf-8")
        area = self.config.area
        moved = {
            key: scratch / file.name
            for key in ("file", "no_go_file", "allowed_file")
            if (file := getattr(area, key)) is not None and file.name in self.files
        }
        return self.config.model_copy(update={"area": area.model_copy(update=moved)})

    def write(self) -> None:
        """Write the settings, and first the files that they name; each appears whole."""
        for name, text in self.files.items():
            _write(self.path.with_name(name), text)
        _write(self.path, self.text)


def draft_settings(
    text: str, path: Path, changes: Values, shapes: DrawnShapes | None = None
) -> Draft:
    """Change settings, and draw their area.

    Args:
        text: of the settings file so far.
        path: of that file.
        changes: settings by section and key; None takes one out.
        shapes: of the area; None: as the settings have them.

    Raises:
        ConfigError: a value is not allowed, or names a file that is not next to the settings.
        PlanError: the shapes cannot be kept.
    """
    origin = str(path)
    before = settings_in(text, origin)
    _check_files(changes, before, path.parent)
    area = dict(changes.get("area", {}))
    files: dict[str, str] = {}
    if shapes is not None:
        base = parse_settings(text, path).area
        drawn, files = area_settings(shapes, base, _moved_datum(base, area))
        area = {**drawn, **area}
    values = {**changes, **({"area": area} if area else {})}
    config = checked_settings(with_values(before, values), path)
    typed = {
        section: {
            key: None if value is None else _as_typed(value, _setting(config, section, key))
            for key, value in part.items()
        }
        for section, part in values.items()
    }
    try:
        new = with_settings_changed(text, typed, origin)
        new.encode("utf-8")
    except UnicodeEncodeError:
        raise ConfigError(f"{origin}: a setting holds what is no text: write it again") from None
    return Draft(path=path, text=new, config=config, files=files)


def _setting(config: SurveyConfig, section: str, key: str) -> Any:
    part = getattr(config, section)
    return getattr(part, key) if isinstance(part, Config) else None


def _moved_datum(area: AreaConfig, changes: Mapping[str, Any]) -> Datum | None:
    """The datum that changes set; None where they set none that can be."""
    names = ("latitude_deg", "longitude_deg")
    if all(changes.get(name) is None for name in names):
        return None
    moved = {name: changes[name] for name in names if changes.get(name) is not None}
    try:
        found = AreaConfig.model_validate({name: getattr(area, name) for name in names} | moved)
    except ValidationError:
        return None  # the settings as a whole are checked, too
    return Datum(found.latitude_deg, found.longitude_deg)


def _as_typed(value: Any, checked: Any) -> Any:
    """A value as it is written: of the number's type that the setting has."""
    if isinstance(value, list) and isinstance(checked, list | tuple):
        return [_as_typed(one, other) for one, other in zip(value, checked, strict=True)]
    if isinstance(value, dict) and isinstance(checked, dict):
        return {key: _as_typed(one, checked.get(key)) for key, one in value.items()}
    if isinstance(checked, int | float) and not isinstance(value, bool):
        return checked
    return value


def _check_files(changes: Values, before: Mapping[str, Any], folder: Path) -> None:
    """Refuse files outside of the folder of the settings, unless the settings name them already.

    Raises:
        ConfigError: with the setting.
    """
    named = set(settings_files(before))
    for section, key, name in settings_files(changes):
        if (section, key, name) in named:
            continue
        try:
            within = (folder / name).resolve().is_relative_to(folder.resolve())
        except (OSError, ValueError):
            within = False
        if not within:
            raise ConfigError(
                f"{section}.{key} = {name!r}: put the file into {folder}, and give its name"
            )


def _write(path: Path, text: str) -> None:
    try:
        with atomic_path(path) as temporary:
            temporary.write_bytes(text.encode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
