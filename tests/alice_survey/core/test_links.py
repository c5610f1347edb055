"""A workspace from somebody else may hold links: nothing writes or deletes through them."""

from collections.abc import Callable
from pathlib import Path

import pytest

from alice_survey.app.pipeline import only_one
from alice_survey.core.artefacts import Stage, refuse_links, run_stage
from alice_survey.core.cluster.engine import STORE, _store
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.executor import Executor
from reconstruct.pictures.quality import quality_report

STAGE = Stage(name="dense", version=1, settings={}, resumes=True)


def _work(folder: Path) -> None:
    (folder / "dem.tif").write_text("new")


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """A folder outside of the workspace, with what somebody would not like to lose."""
    folder = tmp_path / "elsewhere"
    (folder / "2024").mkdir(parents=True)
    (folder / "2024.lock").touch()
    (folder / "2024" / "photo.jpg").write_text("a photo")
    (folder / "dem.tif").write_text("old")
    return folder


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    folder = tmp_path / "work"
    folder.mkdir()
    return folder


def _content(folder: Path) -> dict[str, str]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}


@pytest.mark.parametrize("name", ["dense", "dense.partial", "dense.replaced"])
def test_a_stage_whose_folder_is_a_link_is_refused_before_its_work(
    name: str, workspace: Path, elsewhere: Path
) -> None:
    before = _content(elsewhere)
    (workspace / name).symlink_to(elsewhere)
    with pytest.raises(WorkspaceError, match=f"{name} is a link"):
        run_stage(workspace, STAGE, lambda folder: pytest.fail(f"works in {folder}"))
    assert _content(elsewhere) == before


def test_a_link_in_an_unfinished_stage_is_not_written_through(
    workspace: Path, elsewhere: Path
) -> None:
    before = _content(elsewhere)
    with pytest.raises(RuntimeError):
        run_stage(workspace, STAGE, _fail)  # leaves what a later run resumes
    (workspace / "dense.partial" / "dem.tif").symlink_to(elsewhere / "dem.tif")
    with pytest.raises(WorkspaceError, match="is a link"):
        run_stage(workspace, STAGE, _work)
    assert _content(elsewhere) == before


def _fail(folder: Path) -> None:
    raise RuntimeError(folder)


def _lock(workspace: Path) -> None:
    with only_one(workspace):
        pass


def _share(workspace: Path) -> None:
    with _store(workspace):
        pass


@pytest.mark.parametrize(
    ("name", "target", "work"),
    [
        (".lock", "dem.tif", _lock),
        (STORE, "", _share),
        ("quality", "", lambda folder: quality_report(folder, Executor(workers=1))),
    ],
)
def test_what_works_in_a_workspace_refuses_links(
    name: str, target: str, work: Callable[[Path], object], workspace: Path, elsewhere: Path
) -> None:
    before = _content(elsewhere)
    (workspace / name).symlink_to(elsewhere / target)
    with pytest.raises(WorkspaceError, match="is a link"):
        work(workspace)
    assert _content(elsewhere) == before


def test_links_on_the_way_and_inside_are_found(workspace: Path, elsewhere: Path) -> None:
    (workspace / "check").mkdir()
    refuse_links(workspace, workspace / "check" / "refly", elsewhere)  # elsewhere is not inside
    (workspace / "check" / "refly").symlink_to(elsewhere)
    for path in (Path("check"), Path("check/refly"), Path("check/refly/2024")):
        with pytest.raises(WorkspaceError, match="refly is a link"):
            refuse_links(workspace, workspace / path)


def test_the_workspace_itself_may_be_a_link(workspace: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(workspace)
    assert run_stage(link, STAGE, _work)
    assert (workspace / "dense" / "dem.tif").read_text() == "new"
