"""Count what makes the code easy or hard to live in: `python -m tests.structure`.

Each count has a bound, and the exit code is 1 where one is exceeded. Bounds only go down.
"""

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import typer
from pydantic import BaseModel
from scipy.sparse.csgraph import connected_components

from alice_survey.app.cli.main import app
from alice_survey.core.config import SurveyConfig

T = TypeVar("T", bound=ast.AST)
ROOT = Path(__file__).parents[1]
PACKAGES = ("alice_survey", "camera_calib", "missions", "reconstruct")
WORDS = Path(__file__).with_name("structure_words.toml")
"""Words that are not used, and where each of them counts."""
BOUNDS = {
    "code lines of the packages": 71_436,  # 69,438, and a part of the reserve of 2,000
    "code lines of the tests": 52_086,  # 48,310, and a part of the reserve of 4,000
    "code lines of the benchmarks": 7_973,
    "lines of our own JavaScript": 4_896,
    "modules": 393,
    "modules with a single importer": 70,
    "kernels": 238,
    "commands": 36,
    "options of commands": 349,
    "settings": 125,
    "functions that take the whole SurveyConfig": 14,
    "layers of the import contract": 8,
    "modules without a layer": 0,
    "circles of imports": 0,
    "class names with two meanings": 0,
    "modules that import matplotlib": 2,
    "pages begun by hand (<!DOCTYPE)": 2,
    "modules that name the flat port": 9,
    "identifiers with an avoided word": 0,
    "functions named by a participle": 0,
    "help texts with an avoided phrase": 0,
    "lines of docs with an avoided phrase": 0,
    "sentences of docs over 35 words": 0,
}
"""How large each count may be: these go down, never up."""
_KERNEL = re.compile(r"(\w+\.)*(compiled|compiled_ieee|kernel|njit|jit)(\(.*)?", re.DOTALL)
_VENDORED = "vendor"


@dataclass(frozen=True, kw_only=True)
class Count:
    """One number that is counted, and how large it may be."""

    name: str
    value: int
    maximum: int
    """The bound; a larger value fails."""
    places: tuple[str, ...] = ()
    """Where it was counted, for those that have to be looked up."""


class Module(NamedTuple):
    """One source file of the four packages."""

    text: str
    nodes: tuple[ast.AST, ...]
    """All parts of its code."""


@cache
def modules() -> dict[str, Module]:
    """All modules of the four packages, by name."""
    found = {}
    for package in PACKAGES:
        for path, text in _texts(package).items():
            name = path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
            found[name] = Module(text, tuple(ast.walk(ast.parse(text))))
    return found


def nodes(kind: type[T]) -> Iterator[tuple[str, T]]:
    """Parts of the code of a kind, with the module that each is in."""
    for name, module in modules().items():
        for node in module.nodes:
            if isinstance(node, kind):
                yield name, node


def code_lines(text: str) -> int:
    """Lines with code: neither blank, nor comment, nor docstring (of a field included)."""
    lines: set[int] = set()
    previous = tokenize.NEWLINE
    passed = (
        tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
        tokenize.ENCODING, tokenize.ENDMARKER,
    )  # fmt: skip
    tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    for number, token in enumerate(tokens):
        starts = previous in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
        if token.type == tokenize.STRING and starts:
            after = number + 1
            while tokens[after].type == tokenize.COMMENT:
                after += 1
            if tokens[after].type == tokenize.NEWLINE:  # a docstring
                previous = token.type
                continue
        if token.type not in passed:
            lines.update(range(token.start[0], token.end[0] + 1))
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            previous = token.type
    return len(lines)


def imports() -> dict[str, set[str]]:
    """For each module those of the four packages that it imports, within functions too."""
    known = modules()
    found: dict[str, set[str]] = {}
    for name, module in known.items():
        used = set()
        for node in module.nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    used.add(inner if inner in known else node.module)
            elif isinstance(node, ast.Import):
                used.update(alias.name for alias in node.names)
        found[name] = {other for other in used if other in known} - {name}
    return found


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Sets of modules that import one another (strongly connected components)."""
    number = {name: i for i, name in enumerate(graph)}
    imported = np.zeros((len(graph), len(graph)), bool)
    for name, others in graph.items():
        imported[number[name], [number[other] for other in others]] = True
    _, part = connected_components(imported, connection="strong")
    found = [sorted(np.array(list(graph))[part == one].tolist()) for one in range(part.max() + 1)]
    return [names for names in found if len(names) > 1]


def layers() -> list[list[str]]:
    """The layers of the import contract, the highest first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    return [[name.strip() for name in row.replace(":", "|").split("|")] for row in contract]


def without_a_layer() -> list[str]:
    """Modules that no layer names; those that hold nothing but a docstring need none."""
    named = [name for row in layers() for name in row]
    return [
        name
        for name, module in modules().items()
        if name not in PACKAGES
        and sum(isinstance(node, ast.stmt) for node in module.nodes) > 1
        and not any(name == layer or name.startswith(f"{layer}.") for layer in named)
    ]


def ambiguous_classes() -> list[str]:
    """Class names that are defined in more than one module."""
    places = defaultdict(list)
    for name, node in nodes(ast.ClassDef):
        places[node.name.lstrip("_")].append(f"{name}.{node.name}")
    return [f"{name}: {where}" for name, where in places.items() if len(where) > 1]


def whole_config() -> list[str]:
    """Functions that take the whole `SurveyConfig`."""
    return [
        f"{name}.{node.name}"
        for name, node in nodes(ast.FunctionDef)
        if "SurveyConfig" in ast.unparse(node.args)
    ]


def naming(*words: str) -> list[str]:
    """Modules whose text has one of the words."""
    return [name for name, module in modules().items() if any(w in module.text for w in words)]


@cache
def words() -> dict[str, Any]:
    """The list of words that are not used: `[identifiers]`, `[help]`, `[docs]`, `[functions]`."""
    return tomllib.loads(WORDS.read_text(encoding="utf-8"))


def avoided_identifiers() -> list[str]:
    """Names in the code that hold one of the avoided words, once for each module."""
    rule = words()["identifiers"]
    avoided = re.compile(rule["pattern"])
    return [
        f"{name}.{identifier}"
        for name, module in modules().items()
        for identifier in sorted(set(_identifiers(module)) - set(rule["allowed"]))
        if avoided.search(identifier.strip("_"))
    ]


def _identifiers(module: Module) -> Iterator[str]:
    for node in module.nodes:
        match node:
            case ast.Name(id=name) | ast.arg(arg=name) | ast.Attribute(attr=name):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.alias(name=name, asname=alias):
                yield alias or name.rpartition(".")[2]
            case ast.keyword(arg=str(name)):
                yield name


def participles() -> list[str]:
    """Functions whose name is a bare participle; properties and tests of truth are not meant."""
    rule = words()["functions"]
    bare = re.compile(rule["pattern"])
    found = []
    for name, node in nodes(ast.FunctionDef):
        if bare.fullmatch(node.name.strip("_")) and node.name not in rule["allowed"]:
            decorators = {ast.unparse(one).split(".")[-1] for one in node.decorator_list}
            says = node.returns is not None and ast.unparse(node.returns) == "bool"
            if not says and not decorators & {"property", "cached_property"}:
                found.append(f"{name}.{node.name}")
    return found


def avoided_in_docs() -> list[str]:
    """Lines of the documentation with a phrase that is not used."""
    phrases = re.compile("|".join(words()["docs"]["patterns"]), re.IGNORECASE)
    return [
        f"{where}:{number}: {match[0]}"
        for where, text in _docs().items()
        for number, line in enumerate(text.splitlines(), 1)
        for match in phrases.finditer(line)
    ]


def long_sentences() -> list[str]:
    """Sentences of the documentation over 35 words; code and a formula in a line are one word."""
    found = []
    for where, text in _docs().items():
        plain = re.sub(r"(?ms)```.*?```|<!--.*?-->|\$\$.*?\$\$|^(?:\||#|    ).*?$", "", text)
        plain = re.sub(r"`[^`]*`|\$[^$]*\$", "X", plain)
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", plain)
        for block in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", plain):
            sentences = re.split(r"(?<=[.!?:;])\s+(?=[A-Z\"(*])", " ".join(block.split()))
            found += [f"{where}: {one}" for one in sentences if len(one.split()) > 35]
    return found


def _docs() -> dict[str, str]:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in pages}


@cache
def commands() -> dict[str, Any]:
    """The commands of the command line that its help shows."""
    found: dict[str, Any] = {}

    def walk(command: Any, path: str) -> None:
        inner = getattr(command, "commands", {})
        for name, one in inner.items():
            walk(one, f"{path} {name}".strip())
        alone = not inner or (path and getattr(command, "invoke_without_command", False))
        if alone and not command.hidden:
            found[path] = command

    walk(typer.main.get_command(app), "")
    return found


def options() -> list[str]:
    """Options of these commands, `--help` left out."""
    return [
        f"{name} {option.opts[0]}"
        for name, command in commands().items()
        for option in command.params
        if option.param_type_name == "option" and option.name != "help"
    ]


def avoided_in_help() -> list[str]:
    """Help texts of commands and options with a phrase that is not used."""
    phrases = re.compile("|".join(words()["help"]["patterns"]), re.IGNORECASE)
    texts = {}
    for name, command in commands().items():
        texts[name] = command.help or ""
        for option in command.params:
            texts[f"{name} {option.name}"] = getattr(option, "help", None) or ""
    return [
        f"{name}: {match[0]}" for name, text in texts.items() if (match := phrases.search(text))
    ]


def settings(model: type[BaseModel] | None = None, path: str = "") -> list[str]:
    """Keys of `survey.toml`."""
    found = []
    for name, field in (model or SurveyConfig).model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            found += settings(kind, f"{path}{name}.")
        else:
            found.append(f"{path}{name}")
    return found


def kernels() -> list[str]:
    """Functions that numba compiles."""
    return [
        f"{name}.{node.name}"
        for name, node in nodes(ast.FunctionDef)
        if any(_KERNEL.fullmatch(ast.unparse(one)) for one in node.decorator_list)
    ]


def own_javascript() -> dict[str, int]:
    """Lines of the packages' JavaScript files that are not built from libraries."""
    return {
        where: len(text.splitlines())
        for package in PACKAGES
        for where, text in _texts(package, ".js").items()
        if _VENDORED not in where.rpartition("/")[2] and "node_modules" not in where
    }


def single_importer() -> list[str]:
    """Modules that only one other imports."""
    users = Counter(other for used in imports().values() for other in used)
    return [name for name, count in users.items() if count == 1]


@cache
def counts() -> list[Count]:
    """All counts, with their bounds."""
    matplotlib = re.compile(r"^\s*(import|from) matplotlib", re.MULTILINE)
    places = {
        "modules": list(modules()),
        "modules with a single importer": single_importer(),
        "kernels": kernels(),
        "commands": list(commands()),
        "options of commands": options(),
        "settings": settings(),
        "functions that take the whole SurveyConfig": whole_config(),
        "layers of the import contract": [str(layer) for layer in layers()],
        "modules without a layer": without_a_layer(),
        "circles of imports": [" <-> ".join(ring) for ring in circles(imports())],
        "class names with two meanings": ambiguous_classes(),
        "modules that import matplotlib": [
            name for name, module in modules().items() if matplotlib.search(module.text)
        ],
        "pages begun by hand (<!DOCTYPE)": [
            where
            for package in PACKAGES
            for where, text in _texts(package, ".py", ".html", ".jinja", ".js").items()
            if "<!doctype" in text.lower()
        ],
        "modules that name the flat port": naming("FlatPort", "flat_port"),
        "identifiers with an avoided word": avoided_identifiers(),
        "functions named by a participle": participles(),
        "help texts with an avoided phrase": avoided_in_help(),
        "lines of docs with an avoided phrase": avoided_in_docs(),
        "sentences of docs over 35 words": long_sentences(),
    }
    return [
        _lines("code lines of the packages", {name: m.text for name, m in modules().items()}),
        _lines("code lines of the tests", _texts("tests")),
        _lines("code lines of the benchmarks", _texts("benchmarks")),
        _sum("lines of our own JavaScript", own_javascript()),
        *(_count(name, found) for name, found in places.items()),
    ]


def _count(name: str, places: list[str]) -> Count:
    return Count(name=name, value=len(places), maximum=BOUNDS[name], places=tuple(places))


def _sum(name: str, sizes: dict[str, int]) -> Count:
    largest = sorted(sizes.items(), key=lambda one: -one[1])[:20]
    places = tuple(f"{size:6} {where}" for where, size in largest)
    return Count(name=name, value=sum(sizes.values()), maximum=BOUNDS[name], places=places)


def _lines(name: str, texts: dict[str, str]) -> Count:
    return _sum(name, {where: code_lines(text) for where, text in texts.items()})


def _texts(folder: str, *suffixes: str) -> dict[str, str]:
    """Texts of the files of a folder with some suffixes, by their paths."""
    paths = [p for p in sorted((ROOT / folder).rglob("*")) if p.suffix in (suffixes or (".py",))]
    return {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8", errors="replace")
        for path in paths
    }


def main(arguments: list[str]) -> int:
    """Print the counts; with `-v` also the places of those that are over their bound.

    Returns:
        The exit code: 1 where a count is over its bound.
    """
    for count in counts():
        state = "" if count.value <= count.maximum else "  over"
        print(f"{count.name:45} {count.value:6}   at most {count.maximum:6}{state}")
        if "-v" in arguments and state:
            for place in count.places:
                print(f"    {place}")
    return int(any(count.value > count.maximum for count in counts()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
