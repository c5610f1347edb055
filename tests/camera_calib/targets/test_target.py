"""Targets are read, checked, numbered and drawn as OpenCV and Kalibr have them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.errors import CalibrationError
from camera_calib.targets.pattern import black_rectangles
from camera_calib.targets.target import Target, aruco_dictionary, parse_target, write_target

KINDS = [
    "chessboard 9x6 25mm",
    "charuco 12x9 40mm 30mm DICT_5X5_1000",
    "charuco 5x8 40mm 30mm DICT_4X4_50 legacy",
    "apriltag 6x4 88mm 0.3",
]
TAG_0 = 0xD5D628584
"""The first code of the family 36h11, as Kalibr and the AprilTag library list it."""


def coverage(target: Target, per_square: int) -> np.ndarray:
    """How often each cell of a grid over the target is black."""
    low = np.array(target.outline[:2])
    sides = np.rint((np.array(target.outline[2:]) - low) / target.size_m * per_square).astype(int)
    black = np.zeros((sides[1], sides[0]), dtype=int)
    cells = (black_rectangles(target) - np.tile(low, 2)) / target.size_m * per_square
    np.testing.assert_allclose(cells, np.rint(cells), atol=1e-6)
    for x0, y0, x1, y1 in np.rint(cells).astype(int):
        black[y0:y1, x0:x1] += 1
    return black


@pytest.mark.parametrize("text", KINDS)
def test_words_and_file_give_the_same_target(text: str, tmp_path: Path) -> None:
    target = parse_target(text)
    path = tmp_path / "my target.json"

    write_target(path, target)

    assert target.description == text
    assert not target.is_ambiguous
    assert parse_target(str(path)) == target
    assert json.loads(path.read_text())["size_m"] == target.size_m


@given(
    columns=st.integers(3, 60),
    rows=st.integers(3, 60),
    size=st.floats(1e-3, 1.0),
    unit=st.sampled_from(["mm", "cm", "m"]),
)
def test_any_chessboard_comes_back_from_its_words(
    columns: int, rows: int, size: float, unit: str
) -> None:
    number = f"{size * {'mm': 1e3, 'cm': 1e2, 'm': 1.0}[unit]:.9f}"
    target = parse_target(f"chessboard {columns}x{rows} {number}{unit}")

    again = parse_target(target.description)

    assert target.size_m == pytest.approx(size, abs=1e-9)
    assert (again.columns, again.rows) == (columns, rows)
    assert again.size_m == pytest.approx(target.size_m, rel=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        *("", "circles 9x6 25mm", "apriltag 30x30 88mm 0.3"),
        *(f"chessboard {size} 25mm" for size in ("9", "9x2", "900x6")),
        *(f"chessboard 9x6{side}" for side in ("", " 25", " 0mm", " 25m")),
        *(f"charuco 12x9 40mm {marker}" for marker in ("40mm", "4mm")),
        *(f"charuco 12x9 40mm 30mm DICT_{name}" for name in ("9X9_50", "4X4_50", "4X4_100 old")),
        *(f"apriltag 6x6 88mm{gap}" for gap in ("", " 26.4mm", " 26", " nan")),
    ],
)
def test_wrong_words_give_one_clear_line(text: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        parse_target(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        *(("format", "something"), ("version", 2), ("columns", "9"), ("columns", True)),
        *(("size_m", None), ("shape", "round"), ("kind", "circles")),
        *(("spacing", 0.3), ("marker_m", 0.01)),
    ],
)
def test_wrong_files_give_one_clear_line(change: tuple[str, object], tmp_path: Path) -> None:
    path = tmp_path / "target.json"
    path.write_text(json.dumps(parse_target("chessboard 9x6 25mm").to_json() | dict([change])))
    with pytest.raises(CalibrationError, match=r"target\.json") as caught:
        parse_target(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("length", ["25mm", "2.5cm", "0.025m", ".025m"])
def test_points_run_right_then_down_from_the_first_inner_corner(length: str) -> None:
    target = parse_target(f"chessboard 9x6 {length}")
    assert target == parse_target("chessboard 9x6 25mm")
    points = target.points
    assert points.shape == (54, 3)
    np.testing.assert_allclose(
        points[[0, 1, 9]], [[0.0, 0.0, 0.0], [0.025, 0.0, 0.0], [0.0, 0.025, 0.0]]
    )


@pytest.mark.parametrize("text", [k for k in KINDS if k.startswith("charuco")])
def test_charuco_boards_are_opencvs(text: str) -> None:
    target = parse_target(text)
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows),
        target.size_m,
        target.marker_m,
        aruco_dictionary(str(target.dictionary)),
    )
    board.setLegacyPattern(target.legacy)
    corners = board.getChessboardCorners()

    np.testing.assert_allclose(target.points, corners - corners[0], atol=1e-7)
    markers = np.array([marker[0][:2] for marker in board.getObjPoints()])
    np.testing.assert_allclose(target.marker_places, markers - corners[0, :2], atol=1e-7)
    # 40 cells a square, 30 a marker: whole cells a bit where the marker has six bits.
    if target.legacy:
        size = (target.columns * 40, target.rows * 40)
        drawn = board.generateImage(size, marginSize=0, borderBits=1)
        assert np.array_equal(coverage(target, 40) == 1, drawn == 0)


def test_apriltag_grids_are_kalibrs() -> None:
    target = parse_target("apriltag 3x2 100mm 0.3")
    black = coverage(target, 10)
    assert set(np.unique(black)) == {0, 1}
    # Kalibr's points count from the bottom left, upwards; ours from the top left, downwards.
    row, column = np.mgrid[:4, :6]
    kalibr = np.stack([column // 2 * 1.3 + column % 2, row // 2 * 1.3 + row % 2], axis=-1) * 0.1
    ours = target.points[:, :2].reshape(4, 6, 2)[::-1]
    np.testing.assert_allclose(ours * [1, -1] + [0, ours[0, 0, 1]], kalibr, atol=1e-12)
    # Its first tag is at the bottom left: two bits of border, then the code, its first bit at the
    # top left, white where the bit is 1.
    tag = black[-13:-3, 3:13]
    code = np.array([TAG_0 >> (35 - i) & 1 for i in range(36)]).reshape(6, 6)
    assert np.array_equal(tag[2:8, 2:8], 1 - code)
    assert tag[:2].all() and tag[8:].all() and tag[:, :2].all() and tag[:, 8:].all()
    # A black square of the gap's size touches every corner of every tag.
    assert black[:3, :3].all() and black[-3:, -3:].all() and black[13:16, 13:16].all()
    assert not black[:3, 3:13].any() and not black[13:16, 3:13].any()


@pytest.mark.parametrize("text", KINDS)
def test_colours_around_the_points_are_reported(text: str) -> None:
    target = parse_target(text)
    rectangles = black_rectangles(target)
    near = 0.02 * target.size_m * np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]])
    for point, top_left_black in zip(target.points[:, :2], target.top_left_black, strict=True):
        x, y = (point + near).T[..., None]
        x0, y0, x1, y1 = rectangles.T
        black = ((x > x0) & (x < x1) & (y > y0) & (y < y1)).any(axis=1)
        assert black.tolist() == [top_left_black] * 2 + [not top_left_black] * 2


@pytest.mark.parametrize("size", ["9x6", "8x5", "9x7", "8x6", "7x7", "6x6"])
def test_a_chessboard_is_ambiguous_where_half_a_turn_keeps_the_picture(size: str) -> None:
    target = parse_target(f"chessboard {size} 25mm")
    black = coverage(target, 1)
    assert np.array_equal(black[::-1, ::-1], black) == target.is_ambiguous
    turned = target.points[-1] - target.points[::-1]
    np.testing.assert_allclose(turned, target.points, atol=1e-12)


def test_tags_count_from_the_bottom_left() -> None:
    target = parse_target("apriltag 5x4 88mm 0.3")
    step = 1.3 * 0.088
    x, y = np.meshgrid(step * np.arange(5), step * np.arange(4)[::-1])
    np.testing.assert_allclose(target.marker_places, np.column_stack([x.ravel(), y.ravel()]))
