"""Pictures of one instant are found by their numbers, or by their order."""

from pathlib import Path

import pytest

from alice_survey.base.errors import CalibrationError
from camera_calib.calibrate.picture_sets import find_pictures, pair_pictures


def paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


def test_names_pair_by_their_last_number() -> None:
    sets = pair_pictures(
        {"left": paths("cam1_0007.png", "cam1_0010.png"), "right": paths("b_10.png", "b_7.png")}
    )
    assert [one.name for one in sets] == ["07", "10"]
    assert [one.paths["right"].name for one in sets] == ["b_7.png", "b_10.png"]


def test_a_missing_partner_leaves_one_camera_alone(capsys: pytest.CaptureFixture[str]) -> None:
    sets = pair_pictures(
        {"left": paths("1.png", "2.png", "3.png"), "right": paths("1.png", "3.png")}
    )
    assert [sorted(one.paths) for one in sets] == [["left", "right"], ["left"], ["left", "right"]]
    assert "2.png" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (("a100.png", "a101.png"), ("b500.png", "b501.png")),
        (("dive.png", "next.png"), ("one.png", "two.png")),
        (("a1.png", "b1.png"), ("c1.png", "d1.png")),
    ],
)
def test_without_common_numbers_the_order_decides(
    left: tuple[str, str], right: tuple[str, str]
) -> None:
    sets = pair_pictures({"left": paths(*left), "right": paths(*right)})
    assert [(one.paths["left"].name, one.paths["right"].name) for one in sets] == [
        (left[0], right[0]), (left[1], right[1]),
    ]  # fmt: skip


def test_lists_of_other_lengths_without_common_numbers_do_not_pair() -> None:
    with pytest.raises(CalibrationError, match=r"2.*left"):
        pair_pictures({"left": paths("a1.png", "a2.png"), "right": paths("b8.png")})


def test_one_camera_needs_no_pairs() -> None:
    sets = pair_pictures({"camera": paths("a.png", "b.png")})
    assert [(one.name, list(one.paths)) for one in sets] == [("a", ["camera"]), ("b", ["camera"])]


def test_pictures_are_found_in_folders_and_by_patterns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("b.PNG", "a.png", "note.txt", "left2.jpg", "left1.jpg"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in find_pictures(str(tmp_path))] == [
        "a.png", "b.PNG", "left1.jpg", "left2.jpg",
    ]  # fmt: skip
    assert [p.name for p in find_pictures(str(tmp_path / "left*.jpg"))] == [
        "left1.jpg",
        "left2.jpg",
    ]
    monkeypatch.chdir(tmp_path.parent)
    assert len(find_pictures(f"{tmp_path.name}/left*")) == 2
    assert len(find_pictures(f"{tmp_path.name[:-1]}?/left*")) == 2


def test_pairs_by_order_of_pictures_with_other_numbers_are_reported(
    capsys: pytest.CaptureFixture[str],
) -> None:
    pair_pictures({"left": paths("a1.png", "a2.png"), "right": paths("b51.png", "b52.png")})
    shown = capsys.readouterr().err
    assert "a1.png" in shown and "b51.png" in shown
    assert len(shown.splitlines()) == 1
