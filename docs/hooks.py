"""Mathematics of the pages as MathML, and tables of what the code knows, when the site is built.

Nothing is fetched to show them.

`pymdownx.arithmatex` finds `$...$` and `$$...$$` outside of code; what it found is converted here.
"""

import base64
import html
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
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
_TABLE = re.compile(r"<!-- ([\w ]+): made when the site is built -->(?:\nUntil the site .*)?")
_OPTION_HEAD = ["| option | value | default | what |", "|---|---|---|---|"]
_SETTING_HEAD = ["| setting | default | range | what |", "|---|---|---|---|"]
_PARTS = re.compile(
    r'(<nav class="md-nav"[^>]*)aria-labelledby="__nav_\w+"'
    r"([^>]*>\s*<label[^>]*>\s*<span[^>]*></span>([^<]+)</label>)"
)
_TIGHT_BAR = r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>'


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Show each notebook as a page, with its results where `make docs` has run it."""
    for path in sorted(Path(config.docs_dir).glob("notebooks/*.ipynb")):
        cells = _cells(path)
        run = Path(config.config_file_path).parent / "build/notebooks" / path.name
        if run.is_file() and _sources(_cells(run)) == _sources(cells):
            cells = _cells(run)
        lines: list[str] = []
        for number, cell in enumerate(cells):
            text = "".join(cell["source"])
            lines += [text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```", ""]
            for k, output in enumerate(cell.get("outputs", ())):
                picture = f"notebooks/{path.stem}-{number}-{k}.png"
                if "image/png" in output.get("data", {}):
                    content = base64.b64decode(output["data"]["image/png"])
                    files.append(File.generated(config, picture, content=content))
                lines += [_result(output, picture), ""]
        lines.append(f"[Download the notebook]({path.name}){{ download }}")
        page = f"notebooks/{path.stem}.md"
        files.append(File.generated(config, page, content="\n".join(lines)))
    return files


def _cells(path: Path) -> list[Any]:
    return list(json.loads(path.read_text(encoding="utf-8"))["cells"])


def _sources(cells: list[Any]) -> list[str]:
    return ["".join(cell["source"]) for cell in cells]


def _result(output: Any, picture: str) -> str:
    """What a cell has shown, in Markdown; what went to standard error is left out."""
    data = output.get("data", {})
    if "image/png" in data:
        return f"![What the code above draws]({Path(picture).name})"
    if "text/html" in data:
        return f"<div>{''.join(data['text/html'])}</div>"
    text = "".join(data.get("text/plain", output.get("text", "")))
    return f"```text\n{text.rstrip()}\n```" if text and output.get("name") != "stderr" else ""


def on_page_content(content: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the mathematics of a page; mkdocs calls it once Markdown has become HTML."""
    where = page.file.src_uri
    content = _BLOCK.sub(lambda found: _block(found[1], where), content)
    return _INLINE.sub(lambda found: mathml(found[1], "inline", where), content)


def on_post_page(output: str, *, page: Page, config: MkDocsConfig) -> str:
    """Name what the theme leaves without a name, for readers of screens."""
    output = output.replace('role="dialog"', 'role="dialog" aria-label="Search"')
    output = _PARTS.sub(
        lambda found: f'{found[1]}aria-label="{found[3].strip()}"{found[2]}', output
    )
    return output.replace("<th></th>", "<td></td>")


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put tables of what the code knows where a page asks for them; link to notebooks as pages."""
    if not page.file.src_uri.startswith("notebooks/"):
        markdown = re.sub(r"(\(\S*notebooks/\w+)\.ipynb\)", r"\1.md)", markdown)
    return _TABLE.sub(lambda found: made_table(found[1], page.file.src_uri), markdown)


def made_table(name: str, where: str) -> str:
    """One of these tables in Markdown.

    Raises:
        PluginError: There is none of this name.
    """
    from alice_survey.app import stages

    tables = {
        "stages": stages.table,
        "export formats": formats_table,
        "rasters": rasters_table,
        "commands": commands_table,
        "exit codes": exit_codes_table,
        "settings": settings_tables,
    }
    if name.startswith("commands of "):
        return command_sections(name.removeprefix("commands of "))
    if name not in tables:
        raise PluginError(f"{where}: there is no table of {name}")
    return tables[name]()


def commands_table() -> str:
    """All commands by the headings of the first help, and the options that many have."""
    from alice_survey.app.cli.main import GROUPS

    lines: list[str] = []
    for heading, names in GROUPS.items():
        lines += [f"## {heading}", "| command | what it does |", "|---|---|"]
        for name, command in _found(names):
            link = f"[`{name}`]({heading.lower()}.md#alice-survey-{name.replace(' ', '-')})"
            lines.append(f"| {link} | {_plain(command.help.splitlines()[0])} |")
        lines.append("")
    shared: dict[str, str] = {}
    for _, command in _found(" ".join(GROUPS.values())):
        for option in command.params:
            if _is_shared(option):
                shared.setdefault(_name(option), _option_row(option))
    return "\n".join([*lines, "## Options of many commands", *_OPTION_HEAD, *shared.values()])


def command_sections(heading: str) -> str:
    """The commands below a heading of the first help, each with its help, examples and options."""
    from alice_survey.app.cli.main import GROUPS

    lines: list[str] = []
    for name, command in _found(GROUPS[heading]):
        examples = command.epilog.split("Examples:\n")[-1]
        lines += [f"## `alice-survey {name}`", _plain(command.help.replace("\b\n", "")), ""]
        lines += ["```text", *(line.strip() for line in examples.strip().splitlines()), "```", ""]
        own = [one for one in command.params if not _is_shared(one)]
        if own:
            lines += [*_OPTION_HEAD, *map(_option_row, own), ""]
        if shared := [f"`{_name(one)}`" for one in command.params if _is_shared(one)]:
            lines += [f"Also {', '.join(shared)} ([options of many commands](index.md)).", ""]
    return "\n".join(lines)


def _found(names: str) -> Iterator[tuple[str, Any]]:
    """Commands of these names that do something, and those below them."""
    import typer

    from alice_survey.app.cli.main import app

    commands: Any = typer.main.get_command(app)
    for name in names.split():
        command = commands.commands[name]
        inner = getattr(command, "commands", {})
        if not inner or command.invoke_without_command:
            yield name, command
        yield from ((f"{name} {k}", one) for k, one in inner.items() if not one.hidden)


def _name(option: Any) -> str:
    """An option's long name, an argument's own."""
    return str(option.opts[0] if option.param_type_name == "option" else option.metavar)


def _is_shared(option: Any) -> bool:
    """Whether many commands have it; `folder` is the workspace as an argument."""
    from alice_survey.app.cli.main import SHARED

    return option.name in (*SHARED, "folder")


def _option_row(option: Any) -> str:
    is_option = option.param_type_name == "option"
    names = ", ".join(f"`{one}`" for one in [*option.opts, *option.secondary_opts])
    is_set = option.default not in (None, False, ()) and not callable(option.default)
    shown = {True: f"`{option.default}`", False: ""}[is_set]
    metavar = f"`{option.metavar}`" if option.metavar else ""
    kind = str(getattr(getattr(option, "type_descriptor", None), "annotation", ""))
    if not metavar and "Literal" in kind:
        metavar = _choices(kind)
    cells = [names if is_option else metavar, metavar if is_option else "", shown]
    return f"| {' | '.join(cells)} | {_plain(option.help or '')} |"


def _choices(literal: str) -> str:
    return ", ".join(f"`{choice}`" for choice in re.findall(r"'([^']+)'", literal))


def _plain(text: str) -> str:
    """Words of the command line, safe in a table of Markdown."""
    return re.sub(r"([|*_<\[\]`])", r"\\\1", text)


def settings_tables() -> str:
    """All settings of `survey.toml`, section by section."""
    from alice_survey.core.config import Config, SurveyConfig

    sections = {
        name: field.annotation
        for name, field in SurveyConfig.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, Config)
    }
    lines = ["## At the top", *_SETTING_HEAD]
    lines += [
        _setting_row(name, field)
        for name, field in SurveyConfig.model_fields.items()
        if name not in sections
    ]
    for name, model in sections.items():
        about = (inspect.getdoc(model) or "").splitlines()[0]
        lines += ["", f"## `[{name}]`", _plain(about), "", *_SETTING_HEAD]
        lines += [_setting_row(key, field) for key, field in model.model_fields.items()]
    return "\n".join(lines)


def _setting_row(name: str, field: Any) -> str:
    """A setting: its default or an example, its range or choices, what it is."""
    extra = field.json_schema_extra or {}
    default = field.get_default(call_default_factory=True)
    if isinstance(default, tuple | str | bool | int | float):
        shown = f"`{json.dumps(default)}`"
    else:
        shown = f"none, or such as `{extra['example']}`" if extra.get("example") else "none"
    if "Literal" in str(field.annotation):
        limits = _choices(str(field.annotation))
    else:
        signs = (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
        bounds = [(sign, getattr(one, key, None)) for one in field.metadata for key, sign in signs]
        limits = ", ".join(f"{sign} {value:.10g}" for sign, value in bounds if value is not None)
    return f"| `{name}` | {shown} | {limits} | {_plain(field.description or '')} |"


def exit_codes() -> dict[str, str]:
    """What each exit code of the command line means."""
    from alice_survey.app.cli.main import main

    about = re.sub(r"\n {8}", " ", inspect.getdoc(main) or "")
    return dict(re.findall(r"^    ([\d, ]+): (.*)$", about, re.M))


def exit_codes_table() -> str:
    """The exit codes as a table in Markdown."""
    rows = [f"| {codes} | {meaning} |" for codes, meaning in exit_codes().items()]
    return "\n".join(["| code | meaning |", "|---|---|", *rows])


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
