"""What the fields of the settings say of themselves: the text of a new file, and rows of a form."""

import json
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, get_args, get_origin

from pydantic.fields import FieldInfo

from alice_survey.core.config import Config, SurveyConfig

_HEAD = """\
# A survey: where, how densely, with which camera, and how pictures become a model.
# Every key may be left out; what stands here is the default: the mission of Gutnik et al. (2021),
# 15 x 17 m, lines 1 m apart, 2 m altitude, 0.2 m/s, 12.5 mm lens.
# An unknown key is an error. Next: alice-survey plan -w THIS_FOLDER

"""
_COMMENT_AT = 30
_UNITS = {
    "_mps": ("m/s", 0.01), "_m": ("m", 0.05), "_deg_s": ("deg/s", 1.0), "_deg": ("deg", 1.0),
    "_mm": ("mm", 0.5), "_um": ("um", 0.01), "_px": ("px", 0.1), "_s": ("s", 1.0),
    "_wh": ("Wh", 10.0), "_w": ("W", 1.0), "_e": ("e", 1.0), "_n": ("N", 0.1),
    "_nm": ("nm", 1.0), "_c": ("deg C", 0.5), "_psu": ("psu", 0.5), "_lumens": ("lm", 1000.0),
    "latitude_deg": ("deg", 1e-6), "longitude_deg": ("deg", 1e-6),
}  # fmt: skip
"""Unit and step of settings whose names end so."""
_SHARE_STEP = 0.01
_BOUNDS = {"ge": "low", "gt": "low", "le": "high", "lt": "high"}


def sections() -> dict[str, type[Config]]:
    """The sections of the settings by name."""
    kinds = {name: field.annotation for name, field in SurveyConfig.model_fields.items()}
    return {
        name: kind
        for name, kind in kinds.items()
        if isinstance(kind, type) and issubclass(kind, Config)
    }


def settings_template() -> str:
    """The commented settings that a new survey starts from: every field with its default."""
    groups = [_lines(SurveyConfig, [n for n in SurveyConfig.model_fields if n not in sections()])]
    for name, kind in sections().items():
        about = SurveyConfig.model_fields[name].description
        header = f"[{name}]".ljust(_COMMENT_AT) + f"# {about}"
        groups.append([header, *_lines(kind, list(kind.model_fields))])
    return _HEAD + "\n\n".join("\n".join(lines) for lines in groups) + "\n"


def _lines(kind: type[Config], names: Sequence[str]) -> list[str]:
    lines = []
    for name in names:
        field = kind.model_fields[name]
        extra = field.json_schema_extra
        assert isinstance(extra, dict)  # noqa: S101  -- of `setting`
        if extra["above"]:
            lines.append(f"# {extra['above']}")
        value = extra["example"] or extra["template"] or json.dumps(field.default)
        text = f"{'# ' if extra['example'] else ''}{name} = {value}"
        lines.append(f"{text.ljust(_COMMENT_AT - 1)} # {field.description}")
    return lines


def settings_form(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Range, step, unit and purpose of every numeric setting, by names such as `plan.altitude_m`.

    Args:
        names: of sections.
    """
    return {
        f"{section}.{key}": _row(key, field)
        for section in names
        for key, field in sections()[section].model_fields.items()
        if {int, float} & set(_plain_types(field.annotation))
    }


def _plain_types(annotation: Any) -> Iterator[Any]:
    """A type, or those that an optional one allows, without limits."""
    if get_origin(annotation) is Annotated:
        yield from _plain_types(get_args(annotation)[0])
    elif type(None) in get_args(annotation):
        for part in get_args(annotation):
            yield from _plain_types(part)
    else:
        yield annotation


def _row(key: str, field: FieldInfo) -> dict[str, Any]:
    limits = {
        end: float(value)
        for limit in field.metadata
        for bound, end in _BOUNDS.items()
        if (value := getattr(limit, bound, None)) is not None
    }
    whole = int in _plain_types(field.annotation)
    unit, step = next(
        (_UNITS[end] for end in sorted(_UNITS, key=len, reverse=True) if key.endswith(end)),
        ("", _SHARE_STEP),
    )
    return {
        "low": limits.get("low"),
        "high": limits.get("high"),
        "step": 1.0 if whole else _fine_step(step, field.default),
        "whole": whole,
        "unit": unit,
        "about": field.description,
        "default": field.default,
    }


def _fine_step(step: float, default: Any) -> float:
    """A step of which a default value is several."""
    while isinstance(default, int | float) and 0.0 < default < 2.0 * step:
        step /= 10.0
    return float(f"{step:.3g}")
