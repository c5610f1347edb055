"""Mathematics of the pages as MathML, and tables of what the code knows, when the site is built.

Nothing is fetched to show them.

`pymdownx.arithmatex` finds `$...$` and `$$...$$` outside of code; what it found is converted here.
"""

import html
import re

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.S)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.S)
_UNKNOWN = re.compile(r"\\[A-Za-z]+")
_NAMED = r"<mi>(?:sin|cos|tan|arctan|arccos|cosh|sinh|tanh|exp|log|ln)</mi>"
_BEFORE = re.compile(rf"(</m(?:i|n|sub|sup|subsup|frac|row)>)(?=(?:<m(?:sup|sub)>)?{_NAMED})")
_AFTER = re.compile(
    rf"((?<!<msup>)(?<!<msub>){_NAMED}|<m(sup|sub)>{_NAMED}<m[nr].*?</m\2>)(?=<m[^o])"
)
_GAP = '<mspace width="0.17em" />'
_BAR = re.compile(r'<mo(?: stretchy="false")?>(&#x02016;|&#x0007C;)</mo>')
_STAGES = "<!-- stages: a table, made when the site is built -->"
_FORMATS = "<!-- export formats: a table, made when the site is built -->"
_RASTERS = "<!-- rasters: a table, made when the site is built -->"
_TIGHT_BAR = r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>'


def on_page_content(content: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the mathematics of a page; mkdocs calls it once Markdown has become HTML."""
    where = page.file.src_uri
    content = _BLOCK.sub(lambda found: _block(found[1], where), content)
    return _INLINE.sub(lambda found: mathml(found[1], "inline", where), content)


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the tables of stages, export formats and rasters where a page asks for them."""
    if _STAGES in markdown:
        from alice_survey.app import stages

        markdown = markdown.replace(_STAGES, stages.table())
    if _FORMATS in markdown:
        markdown = markdown.replace(_FORMATS, formats_table())
    if _RASTERS in markdown:
        markdown = markdown.replace(_RASTERS, rasters_table())
    return markdown


def formats_table() -> str:
    """The formats of export as a table in Markdown."""
    from missions.exports.registry import format_named, format_names

    rows = ["| format (`--format`) | files | read by |", "|---|---|---|"]
    for name in format_names():
        known = format_named(name)
        files = ", ".join(f"`{file.name.format(1)}`" for file in known.files)
        rows.append(f"| `{name}` | {files} | {known.read_by} |")
    return "\n".join(rows)


def rasters_table() -> str:
    """All rasters as a table in Markdown."""
    from alice_survey.core.products import LENGTH, RASTERS

    rows = ["| file | values | unit |", "|---|---|---|"]
    for one in RASTERS:
        unit = "m, or model units" if one.unit == LENGTH else one.unit
        rows.append(f"| `{one.file}` | {one.about} | {unit} |")
    return "\n".join(rows)


def _block(latex: str, where: str) -> str:
    return f'<div class="equation" tabindex="0">{mathml(latex, "block", where)}</div>'


def mathml(latex: str, display: str, where: str) -> str:
    r"""Convert one formula.

    Args:
        latex: as it stands in HTML, `&lt;` for a less-than sign.
        display: "inline" or "block".
        where: the page, for messages.

    Raises:
        PluginError: A brace has no partner, or a command is unknown: it would stand in the page
            as `\name`.
    """
    latex = html.unescape(latex).strip()
    if len(re.findall(r"(?<!\\)\{", latex)) != len(re.findall(r"(?<!\\)\}", latex)):
        raise PluginError(f"{where}: {latex!r} has a brace without its partner")
    try:
        converted = convert(latex, display=display)
    except Exception as error:  # of many kinds, none of them documented
        raise PluginError(f"{where}: {latex!r} is no formula: {error!r}") from error
    unknown = _UNKNOWN.search(converted)
    if unknown:
        raise PluginError(f"{where}: {unknown[0]} is unknown in {latex!r}")
    spaced = _BEFORE.sub(rf"\1{_GAP}", _AFTER.sub(rf"\1{_GAP}", converted))  # a sin x, not asinx
    return _BAR.sub(_TIGHT_BAR, spaced)
