"""Faults put into the code one at a time, and whether the tests of every day notice.

    python -m benchmarks.mutants --work FOLDER [--tree CHECKOUT]

A mutant is known by its function's name and the text that it changes, so that it survives moves of
the function and of the line. Each is put into a copy of the checkout, and the quick tests run that
import its module, or a module that imports it, up to the first failure. FOLDER/mutants.jsonl gets a
line for each, and a run that was broken off goes on there. An error of collection is noticed too.
"""

import argparse
import ast
import copy
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.structure import PACKAGES

DRAWN = Path(__file__).with_name("mutants.json")
"""A hundred, drawn by the digests of the names of functions and of changes."""
_MAX_S = 900.0
_SWAPS: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


def functions(tree: Path) -> Iterator[tuple[Path, str, ast.FunctionDef]]:
    """Functions and methods of the packages: file, qualified name, and the code."""
    for path in sorted(path for package in PACKAGES for path in (tree / package).rglob("*.py")):
        module = ast.parse(path.read_text())
        classes = [one for one in module.body if isinstance(one, ast.ClassDef)]
        for owner in [None, *classes]:
            for one in (owner or module).body:
                if isinstance(one, ast.FunctionDef):
                    yield path, f"{getattr(owner, 'name', '')}.{one.name}".lstrip("."), one


def changes(function: ast.FunctionDef) -> Iterator[tuple[ast.expr, str]]:
    """Expressions that can be changed, each with what it becomes."""
    for node in (node for statement in function.body for node in ast.walk(statement)):
        new = copy.deepcopy(node)
        if isinstance(new, ast.Compare) and type(new.ops[0]) in _SWAPS:
            new.ops[0] = _SWAPS[type(new.ops[0])]()
        elif isinstance(new, ast.BinOp | ast.BoolOp) and type(new.op) in _SWAPS:
            new.op = _SWAPS[type(new.op)]()
        elif isinstance(new, ast.Constant) and isinstance(new.value, float) and new.value:
            new.value *= 1.1
        elif isinstance(new, ast.Constant) and type(new.value) in (int, float):
            new = ast.Constant(ast.literal_eval(new) + 1)
        else:
            continue
        assert isinstance(node, ast.expr)
        yield node, f"({ast.unparse(new)})"


def mutated(tree: Path, mutant: dict[str, str]) -> tuple[Path, str] | None:
    """The file of a mutant and its new text; None where its function has gone."""
    places = [one for one in functions(tree) if one[1] == mutant["function"]]
    places.sort(key=lambda one: one[0].relative_to(tree).as_posix() != mutant["in"])
    for path, _, function in places:
        for node, to in changes(function):
            if (ast.unparse(node), to) == (mutant["from"], mutant["to"]):
                lines = path.read_bytes().splitlines(keepends=True)
                starts = [sum(map(len, lines[:n])) for n in range(len(lines))]
                end = starts[(node.end_lineno or 1) - 1] + (node.end_col_offset or 0)
                text = b"".join(lines)
                start = starts[node.lineno - 1] + node.col_offset
                return path, (text[:start] + to.encode() + text[end:]).decode()
    return None


def tests_of(tree: Path, path: Path) -> list[str]:
    """Test files that import a module, or where none does, one that imports it; else its folder's.

    Those that are named like the module come first.
    """
    name = path.relative_to(tree).with_suffix("").as_posix().replace("/", ".")
    files = sorted((tree / "tests").rglob("test_*.py"))
    wanted = {name.removesuffix(".__init__")}
    for _ in range(3):
        pattern = re.compile("|".join(rf"\b{re.escape(one)}\b" for one in wanted))
        parents = "|".join(rf"from {re.escape(p)} import .*\b{n}\b" for p, _, n in (
            one.rpartition(".") for one in wanted))  # fmt: skip
        at = [one for one in files if re.search(f"{pattern.pattern}|{parents}", one.read_text())]
        if at:
            return [str(one) for one in sorted(at, key=lambda one: path.stem not in one.name)]
        for package in PACKAGES:
            for one in (tree / package).rglob("*.py"):
                if pattern.search(one.read_text()):
                    wanted.add(one.relative_to(tree).with_suffix("").as_posix().replace("/", "."))
    folder = next(f for f in path.relative_to(tree).parents if (tree / "tests" / f).is_dir())
    return [str(tree / "tests" / folder)]


def noticed(tree: Path, work: Path, mutant: dict[str, str]) -> str:
    """`noticed`, `survived`, or `gone` where the function is."""
    found = mutated(tree, mutant)
    if found is None:
        return "gone"
    shutil.rmtree(work / "tree", ignore_errors=True)
    left_out = shutil.ignore_patterns(".venv", ".git", "node_modules")
    shutil.copytree(tree, work / "tree", copy_function=os.link, ignore=left_out)
    changed = work / "tree" / found[0].relative_to(tree)
    changed.unlink()  # a hard link
    changed.write_text(found[1])
    names = [str(Path(one).relative_to(tree)) for one in tests_of(tree, found[0])]
    options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow"]
    call = [sys.executable, "-m", "pytest", *options, *names]
    try:
        ended = subprocess.run(call, cwd=work / "tree", capture_output=True, timeout=_MAX_S)
    except subprocess.TimeoutExpired:
        return "noticed"
    return "survived" if ended.returncode in (0, 5) else "noticed"


def main() -> None:
    """Run what is left to run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--tree", type=Path, default=Path())
    options = parser.parse_args()
    tree = options.tree.resolve()
    options.work.mkdir(parents=True, exist_ok=True)
    if not (link := options.work / "shared").is_symlink():
        link.symlink_to(tree.parent / "shared")
    record = options.work / "mutants.jsonl"
    record.touch()
    done = [json.loads(line) for line in record.read_text().splitlines()]
    known = [one | {"state": None} for one in done]
    for mutant in json.loads(DRAWN.read_text()):
        if mutant | {"state": None} not in known:
            done.append(mutant | {"state": noticed(tree, options.work, mutant)})
            with record.open("a") as file:
                file.write(json.dumps(done[-1]) + "\n")
            print(done[-1]["state"], mutant["in"], mutant["function"], flush=True)
    print(Counter(one["state"] for one in done))


if __name__ == "__main__":
    main()
