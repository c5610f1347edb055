"""Folders that a person may choose from: below the home or what was typed, never through links."""

from pathlib import Path

import pytest

from alice_survey.app.studio.endpoints.start import Folders
from alice_survey.core.errors import AliceError


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home with pictures, and a folder next to it with more of them."""
    dive = tmp_path / "home" / "dive"
    (dive / "left").mkdir(parents=True)
    (dive / ".hidden").mkdir()
    for name in ("a.jpg", "b.PNG", "c.mp4", "nav.csv", "rig.json", "notes.txt", ".d.jpg"):
        (dive / name).touch()
    secret = tmp_path / "secret" / "inside"
    secret.mkdir(parents=True)
    (secret / "x.jpg").touch()
    (tmp_path / "home" / "out").symlink_to(tmp_path / "secret")
    return tmp_path / "home"


def test_folders_are_listed_with_what_they_hold(home: Path) -> None:
    folders = Folders(home)
    top = folders.list_folder("", typed=False)
    assert [one.name for one in top.inside] == ["dive"]  # no link
    assert (top.above, top.inside[0].pictures, top.inside[0].videos) == (None, 2, 1)
    assert top.inside[0].folders == 1
    dive = folders.list_folder(str(home / "dive"), typed=False)
    assert [one.name for one in dive.inside] == ["left"] and dive.above == str(home)
    assert [Path(path).name for path in dive.files] == ["nav.csv", "notes.txt", "rig.json"]


def test_what_lies_outside_is_listed_only_where_it_was_typed(home: Path) -> None:
    folders = Folders(home)
    outside = home.parent / "secret"
    for path in (outside, home / "out", home / ".." / "secret", home / "out" / "inside", Path("/")):
        with pytest.raises(AliceError):
            folders.list_folder(str(path), typed=False)
    assert [one.name for one in folders.list_folder(str(outside), typed=True).inside] == ["inside"]
    inside = folders.list_folder(str(outside / "inside"), typed=False)
    assert inside.here.pictures == 1 and inside.above == str(outside)
    assert folders.list_folder(str(outside), typed=False).above is None
    with pytest.raises(AliceError):
        folders.list_folder(str(home.parent), typed=False)


@pytest.mark.parametrize("path", ["dive", "../secret", "/none/there", "dive\0", "a.jpg"])
def test_what_is_no_folder(home: Path, path: str) -> None:
    for typed in (True, False):
        with pytest.raises(AliceError):
            Folders(home).list_folder(path, typed=typed)
    with pytest.raises(AliceError):
        Folders(home).list_folder(str(home / "dive" / "a.jpg"), typed=True)
