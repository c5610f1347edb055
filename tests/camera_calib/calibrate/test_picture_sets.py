"""Pictures of one instant are found by their numbers, or by their order."""

from pathlib import Path

import pytest

from alice_survey.core.errors import CalibrationError
from camera_calib.calibrate.picture_sets import check_own, find_pictures, pair_pictures


def paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


def test_names_pair_by_their_last_number() -> None:
    sets = pair_pictures(
        {"left": paths("cam1_0007.png", "cam1_0010.png"), "right": paths("b_10.png", "b_7.png")}
    )
    assert [one.name for one in sets] == ["07", "10"]
    assert [one.paths["right"].name for one in sets] == ["b_7.png", "b_10.png"]
    sets = pair_pictures({"camera": paths("a.png", "b.png")})  # one camera needs no pairs
    assert [(one.name, list(one.paths)) for one in sets] == [("a", ["camera"]), ("b", ["camera"])]
    with pytest.raises(CalibrationError, match=r"2.*left"):  # lengths differ, no common number
        pair_pictures({"left": paths("a1.png", "a2.png"), "right": paths("b8.png")})


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
    left: tuple[str, str], right: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Numbers that differ are reported."""
    sets = pair_pictures({"left": paths(*left), "right": paths(*right)})
    assert [(one.paths["left"].name, one.paths["right"].name) for one in sets] == [
        (left[0], right[0]), (left[1], right[1]),
    ]  # fmt: skip
    shown = capsys.readouterr().err.splitlines()
    assert [left[0] in line and right[0] in line for line in shown] == [True] * (
        left[0] == "a100.png"
    )


def test_pictures_of_four_cameras_pair_where_each_shares_most_with_another(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The last camera saw only some of the moments, and one that nobody else saw."""
    sets = pair_pictures(
        {
            "a": paths("1.png", "2.png", "3.png", "4.png"),
            "b": paths("x1.png", "x2.png", "x3.png"),
            "c": paths("y2.png", "y3.png", "y4.png"),
            "d": paths("z3.png", "z4.png", "z9.png"),
        }
    )
    together = {one.name: "".join(one.paths) for one in sets}
    assert together == {"1": "ab", "2": "abc", "3": "abcd", "4": "acd", "9": "d"}
    assert "z9.png" in capsys.readouterr().err


def test_the_same_pictures_are_not_two_cameras(tmp_path: Path) -> None:
    for folder in "ab":
        (tmp_path / folder).mkdir()
        for number in range(3):
            (tmp_path / folder / f"{number}.png").write_bytes(f"{folder} {number}".encode())
    a, b = (find_pictures(str(tmp_path / folder)) for folder in "ab")
    check_own({"left": a, "right": b})
    for lists in ({"left": a, "right": a}, {"left": a, "mid": b, "right": b}):
        with pytest.raises(CalibrationError, match=r"and right have the same picture"):
            check_own(lists)
    (tmp_path / "b" / "7.png").write_bytes(a[1].read_bytes())  # a copy by another name
    with pytest.raises(CalibrationError, match=r"1\.png.*7\.png"):
        check_own({"left": a, "right": find_pictures(str(tmp_path / "b"))})


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
