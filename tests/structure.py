"""Count what makes the code easy or hard to live in: `python -m tests.structure`.

Each count has a bound; `tests/test_structure.py` holds those that can rot.
"""

import ast
import io
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[1]
PACKAGES = ("alice_survey", "camera_calib", "missions", "reconstruct")
AVOIDED = (
    "told", "tell", "tells", "telling", "mended", "mend", "mends", "anew", "foretell", "beside",
    "likewise",
)  # fmt: skip
"""Words that STYLE replaces by modern ones; in identifiers they are errors."""


@dataclass(frozen=True, kw_only=True)
class Count:
    """One number that is counted, and how large it may be."""

    name: str
    value: int
    maximum: int
    """The bound; a larger value fails."""
    places: tuple[str, ...] = ()
    """Where it was counted, for those that have to be looked up."""


@dataclass(frozen=True, kw_only=True)
class Module:
    """One source file of the four packages."""

    name: str
    path: Path
    text: str
    tree: ast.Module


@cache
def modules() -> dict[str, Module]:
    """All modules of the four packages, by name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            name = name.removesuffix(".__init__")
            text = path.read_text(encoding="utf-8")
            found[name] = Module(name=name, path=path, text=text, tree=ast.parse(text))
    return found


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
        for node in ast.walk(module.tree):
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
        and len(module.tree.body) > 1
        and not any(name == layer or name.startswith(f"{layer}.") for layer in named)
    ]


def ambiguous_classes() -> dict[str, list[str]]:
    """Class names that are defined in more than one module."""
    places = defaultdict(list)
    for name, module in modules().items():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                places[node.name.lstrip("_")].append(f"{name}.{node.name}")
    return {name: where for name, where in places.items() if len(where) > 1}


def whole_config() -> list[str]:
    """Functions that take the whole `SurveyConfig`."""
    found = []
    for name, module in modules().items():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.FunctionDef):
                every = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
                notes = [ast.unparse(arg.annotation) for arg in every if arg.annotation]
                if any("SurveyConfig" in note for note in notes):
                    found.append(f"{name}.{node.name}")
    return found


def naming(*words: str) -> list[str]:
    """Modules whose text has one of the words."""
    return [name for name, module in modules().items() if any(w in module.text for w in words)]


def avoided_identifiers() -> list[str]:
    """Names in the code that hold one of the avoided words."""
    found = []
    for name, module in modules().items():
        found += [
            f"{name}.{identifier}"
            for identifier in sorted(set(_identifiers(module.tree)))
            if set(identifier.lower().strip("_").split("_")) & set(AVOIDED)
        ]
    return found


def _identifiers(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.arg(arg=name) | ast.Attribute(attr=name):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.alias(name=name, asname=alias):
                yield alias or name.rpartition(".")[2]
            case ast.keyword(arg=str(name)):
                yield name


def single_importer() -> list[str]:
    """Modules that only one other imports."""
    users = Counter(other for used in imports().values() for other in used)
    return [name for name, count in users.items() if count == 1]


@cache
def counts() -> list[Count]:
    """All counts, with their bounds."""
    sources = [module.text for module in modules().values()]
    tests = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")]
    matplotlib = [
        name
        for name, module in modules().items()
        if any(line.lstrip().startswith(("import matplotlib", "from matplotlib"))
               for line in module.text.splitlines())
    ]  # fmt: skip
    pages = [
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.suffix in {".py", ".html", ".jinja", ".js"}
        and "<!doctype" in path.read_text(encoding="utf-8", errors="replace").lower()
    ]
    rings = circles(imports())
    names = ambiguous_classes()
    return [
        Count(
            name="code lines of the packages", value=sum(map(code_lines, sources)), maximum=57_000
        ),
        Count(name="code lines of the tests", value=sum(map(code_lines, tests)), maximum=36_000),
        Count(name="modules", value=len(sources), maximum=448),
        _count("modules with a single importer", single_importer(), 178),
        Count(name="layers of the import contract", value=len(layers()), maximum=8),
        _count("modules without a layer", without_a_layer(), 0),
        _count("circles of imports", [" <-> ".join(ring) for ring in rings], 0),
        _count("class names with two meanings", [f"{n}: {w}" for n, w in names.items()], 4),
        _count("functions that take the whole SurveyConfig", whole_config(), 20),
        _count("modules that import matplotlib", matplotlib, 9),
        _count("pages begun by hand (<!DOCTYPE)", pages, 2),
        _count("modules that name the flat port", naming("FlatPort", "flat_port"), 75),
        _count("identifiers with an avoided word", avoided_identifiers(), 0),
    ]


def _count(name: str, places: list[str], maximum: int) -> Count:
    return Count(name=name, value=len(places), maximum=maximum, places=tuple(places))


def main(arguments: list[str]) -> None:
    """Print the counts; with `-v` also the places of those that are over their bound."""
    for count in counts():
        state = "" if count.value <= count.maximum else "  over"
        print(f"{count.name:45} {count.value:6}   at most {count.maximum:6}{state}")
        if "-v" in arguments and state:
            for place in count.places:
                print(f"    {place}")


if __name__ == "__main__":
    main(sys.argv[1:])
