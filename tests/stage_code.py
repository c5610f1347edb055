"""The code that each stage depends on, so that a stage's version is not forgotten.

    python -m tests.stage_code          what changed since the versions were recorded
    python -m tests.stage_code --record record the present state, once the versions are right

`stage_code.json` next to this file keeps a digest of every module that a stage imports, directly or
not, and each stage's version. Comments, docstrings and layout do not count.
"""

import ast
import hashlib
import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

from alice_survey.app.stages import STAGES

ROOT = Path(__file__).parents[1]
RECORD = Path(__file__).with_suffix(".json")
PACKAGES = ("alice_survey", "camera_calib", "missions", "reconstruct")
WITHOUT_EFFECT = (
    "alice_survey.app.api", "alice_survey.core.errors", "alice_survey.core.run",
    "alice_survey.core.stages", "alice_survey.app.stages", "alice_survey.app.pipeline",
    "camera_calib.stages", "missions.stages", "reconstruct.stages",
)  # fmt: skip
"""Modules that call stages, list them or show what happens, and decide no result."""


@cache
def tree_of(module: str) -> ast.Module | None:
    """The code of a module without docstrings; None where it is not one of ours."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if module.split(".")[0] not in PACKAGES or not file.is_file():
        return None
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [  # type: ignore[attr-defined]
                one
                for one in body
                if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))
            ]
    return tree


def imports_of(module: str) -> set[str]:
    """Our modules that a module imports, at its head or in a function."""
    found: set[str] = set()
    tree = tree_of(module)
    for node in ast.walk(tree) if tree is not None else ():
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return {name for name in found if tree_of(name) is not None}


def closure_of(module: str) -> set[str]:
    """A module and all of ours that it imports, directly or not."""
    found, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name not in found and name not in PACKAGES and not name.startswith(WITHOUT_EFFECT):
            found.add(name)
            waiting += imports_of(name)
    return found


def state() -> dict[str, Any]:
    """Versions and modules of all stages, and digests of these modules."""
    modules = {stage.name: sorted(closure_of(stage.work.split(":")[0])) for stage in STAGES}
    return {
        "versions": {stage.name: stage.version for stage in STAGES},
        "modules": {
            name: hashlib.blake2b(ast.dump(tree).encode(), digest_size=8).hexdigest()
            for name in sorted({name for names in modules.values() for name in names})
            if (tree := tree_of(name)) is not None
        },
        "stages": modules,
    }


def changes(recorded: dict[str, Any], present: dict[str, Any]) -> dict[str, list[str]]:
    """Modules whose code changed while the version of a stage stayed, by stage."""
    found = {}
    for stage, modules in present["stages"].items():
        if recorded["versions"].get(stage) != present["versions"][stage]:
            continue
        changed = [
            name for name in modules if recorded["modules"].get(name) != present["modules"][name]
        ]
        if changed:
            found[stage] = changed
    return found


def message(found: dict[str, list[str]]) -> str:
    """What a developer does about changed code."""
    return "\n".join(
        [
            "code of these stages changed since their versions were recorded:",
            *(f"{stage}: {', '.join(modules)}" for stage, modules in found.items()),
            "where a result changed, raise the version in stages.py of its package; "
            "then run 'python -m tests.stage_code --record'",
        ]
    )


def main() -> None:
    """Print what changed, or record it."""
    present = state()
    found = changes(json.loads(RECORD.read_text()), present) if RECORD.exists() else {}
    if found:
        sys.stdout.write(message(found) + "\n")
    if "--record" in sys.argv[1:]:
        kept = {name: present[name] for name in ("versions", "modules")}
        RECORD.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
