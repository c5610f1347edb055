"""The formats there are: the modules of `missions.exports.formats`, imported when they are used."""

import pkgutil
from importlib import import_module
from typing import TYPE_CHECKING

from alice_survey.core.errors import PlanError
from missions.exports import formats

if TYPE_CHECKING:
    from missions.exports.format import ExportFormat

_REMOVED = {"cola2-v1": "cola2", "qgc-survey": "qgc"}


def format_names() -> list[str]:
    """Names of all formats, in alphabetical order; imports none of them."""
    found = pkgutil.iter_modules(formats.__path__)
    return sorted(module.name.replace("_", "-") for module in found)


def format_named(name: str) -> "ExportFormat":
    """A format by its name.

    Raises:
        PlanError: there is none of this name.
    """
    if name in _REMOVED:
        raise PlanError(f"format {name!r} is no longer written: use {_REMOVED[name]!r}")
    if name not in format_names():
        raise PlanError(f"format {name!r} is not known; known are {', '.join(format_names())}")
    module = import_module(f"{formats.__name__}.{name.replace('-', '_')}")
    found: ExportFormat = module.FORMAT
    return found


def formats_table() -> str:
    """The formats as a table in Markdown, for the documentation."""
    rows = ["| format (`--format`) | files | read by |", "|---|---|---|"]
    for name in format_names():
        known = format_named(name)
        files = ", ".join(f"`{file.name.format(1)}`" for file in known.files)
        rows.append(f"| `{name}` | {files} | {known.read_by} |")
    return "\n".join(rows)
