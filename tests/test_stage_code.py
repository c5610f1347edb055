"""A stage whose code changed has a new version, or is declared to give the same result."""

import json
from pathlib import Path

import pytest

from tests import stage_code


def test_versions_of_stages_are_not_forgotten() -> None:
    recorded, present = json.loads(stage_code.RECORD.read_text()), stage_code.state()
    found = stage_code.changes(recorded, present)
    assert not found, stage_code.message(found)
    assert recorded["versions"] == present["versions"], "run 'python -m tests.stage_code --record'"


def test_only_code_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "missions"
    package.mkdir()
    used, user = package / "used.py", package / "user.py"
    used.write_text("def one() -> int:\n    return 1\n")
    user.write_text("def two() -> int:\n    from missions.used import one\n    return one() + 1\n")
    monkeypatch.setattr(stage_code, "ROOT", tmp_path)

    def state() -> dict[str, object]:
        stage_code.tree_of.cache_clear()
        modules = sorted(stage_code.closure_of("missions.user"))
        trees = {name: stage_code.tree_of(name) for name in modules}
        dumps = {name: stage_code.ast.dump(tree) for name, tree in trees.items() if tree}
        return {"versions": {"toy": 1}, "modules": dumps, "stages": {"toy": modules}}

    recorded = state()
    used.write_text('def one() -> int:\n    """Return one."""\n    # as it is\n    return 1\n')
    assert stage_code.changes(recorded, state()) == {}
    used.write_text("def one() -> int:\n    return 2\n")
    assert stage_code.changes(recorded, state()) == {"toy": ["missions.used"]}
    raised = state() | {"versions": {"toy": 2}}
    assert stage_code.changes(recorded, raised) == {}
    stage_code.tree_of.cache_clear()
