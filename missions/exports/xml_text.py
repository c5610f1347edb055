"""XML as text: escaped, indented, the same every time."""

import math
import re
from pathlib import Path
from xml.etree import ElementTree as ET

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import parse_number, xml_root

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""What XML 1.0 cannot hold in any way (W3C, section 2.2)."""


def clean(text: str) -> str:
    """Text that XML can hold: characters it cannot become the replacement character."""
    return _NOT_XML.sub("�", text)


def child(
    parent: ET.Element, tag: str, text: str | float | None = None, **attributes: str
) -> ET.Element:
    """A new element under another."""
    element = ET.SubElement(parent, tag, attributes)
    if text is not None:
        element.text = clean(str(text))
    return element


def write_xml(path: Path, root: ET.Element, comment: str | None = None) -> None:
    """Write a document; the comment stands before its root.

    COLA2's readers take the first child of an element for one of theirs, so that comments within
    the document break them.
    """
    ET.indent(root)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    if comment is not None:
        lines.append(f"<!-- {_in_comment(comment)} -->")
    lines.append(ET.tostring(root, encoding="unicode"))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def degrees(value: float) -> str:
    """Latitude or longitude to 1e-10 degrees, 0.01 mm."""
    return f"{value:.10f}"


def metres(value: float) -> str:
    """To 0.1 mm; never a negative zero."""
    return f"{value + 0.0:.4f}".replace("-0.0000", "0.0000")


def _in_comment(text: str) -> str:
    """Two hyphens end a comment: part them."""
    return re.sub("-(?=-|$)", "- ", clean(text))


def root_of(text: str) -> ET.Element | None:
    """The root of a document; None where the text is not XML, or declares entities."""
    if not text.lstrip("\ufeff \t\r\n").startswith("<"):
        return None
    try:
        return xml_root(text.lstrip("\ufeff"))
    except ValueError:
        return None


def value_of(parent: ET.Element, tag: str) -> str:
    """Text of a child.

    Raises:
        ValueError: there is none.
    """
    found = parent.find(tag)
    if found is None or not (found.text or "").strip():
        raise ValueError(f"<{parent.tag}> lacks <{tag}>")
    return str(found.text).strip()


def number_of(parent: ET.Element, tag: str) -> float:
    """A child's finite number.

    Raises:
        ValueError: there is none.
    """
    text = value_of(parent, tag)
    try:
        number = parse_number(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"<{tag}> is {text[:40]!r}, not a number")
    return number
