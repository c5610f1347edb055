"""What a form has to know of the settings: their range, unit and step, and a line about each."""

import re
from typing import Any

from alice_survey.core.config import Config, SurveyConfig

SECTIONS = ("plan", "area", "camera", "water", "sea", "vehicle", "imaging")
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


def setting_limits(template: str) -> dict[str, dict[str, Any]]:
    """Range, step, unit and purpose of every numeric setting, by names such as `plan.altitude_m`.

    Args:
        template: commented settings; the comment of a setting says what it is about.
    """
    about = _comments(template)
    found = {}
    for section in SECTIONS:
        kind: Any = SurveyConfig.model_fields[section].annotation
        for key, field in kind.model_fields.items():
            if not _is_number(field.annotation):
                continue
            name = f"{section}.{key}"
            bounds: dict[str, float] = {}
            for limit in field.metadata:
                for bound, end in _BOUNDS.items():
                    if (value := getattr(limit, bound, None)) is not None:
                        bounds[end] = float(value)
            low, high = bounds.get("low"), bounds.get("high")
            whole = field.annotation is int
            unit, step = _unit(key)
            found[name] = {
                "low": low,
                "high": high,
                "step": 1.0 if whole else _fine(step, field.default),
                "whole": whole,
                "unit": unit,
                "about": about.get(name, ""),
                "default": None if isinstance(field.default, Config) else field.default,
            }
    return found


def _is_number(annotation: Any) -> bool:
    return annotation in (int, float, int | None, float | None) or (getattr(
        annotation, "__metadata__", None
    ) is not None and getattr(annotation, "__origin__", None) in (int, float))  # fmt: skip


def _unit(key: str) -> tuple[str, float]:
    """Unit and usual step of a setting by its name."""
    for ending in sorted(_UNITS, key=len, reverse=True):
        if key.endswith(ending):
            return _UNITS[ending]
    return "", _SHARE_STEP


def _fine(step: float, usual: Any) -> float:
    """A step of which a usual value is some."""
    while isinstance(usual, int | float) and 0.0 < usual < 2.0 * step:
        step /= 10.0
    return float(f"{step:.3g}")


def _comments(template: str) -> dict[str, str]:
    """The comment behind each setting, also behind one that is an example only."""
    section, found = "", {}
    for line in template.splitlines():
        if header := re.match(r"\[(\w+)\]", line):
            section = header.group(1)
        elif setting := re.match(r"(?:# )?(\w+) = .*?\s# (.*)", line):
            found[f"{section}.{setting.group(1)}"] = setting.group(2).strip()
    return found
