"""Printed targets are true to scale: the files, drawn and measured by other tools, show it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pypdf import PdfReader

from alice_survey.core.errors import CalibrationError
from camera_calib.targets.detect import detect
from camera_calib.targets.sheet import BAR_MM, PAPERS_MM, lay_out, write_sheet
from camera_calib.targets.target import Target, parse_target

KINDS = ["chessboard 7x4 20mm", "charuco 7x5 20mm 15mm DICT_4X4_50", "apriltag 3x2 40mm 0.3"]
MM_PER_POINT = 25.4 / 72.0


def painted(rectangles_mm: np.ndarray, page_mm: tuple[float, float], dpi: float) -> np.ndarray:
    """A page by samples at the middles of sub-pixels: 4 x 4 a pixel."""
    per_mm, fine = dpi / 25.4, 4
    width, height = (int(np.ceil(side * per_mm)) for side in page_mm)
    black = np.zeros((height * fine, width * fine), dtype=bool)
    for x0, y0, x1, y1 in np.rint(rectangles_mm * per_mm * fine).astype(int):
        black[y0:y1, x0:x1] = True
    share = black.reshape(height, fine, width, fine).mean(axis=(1, 3))
    return np.rint(255 * (1 - share)).astype(np.uint8)


def read_pdf(path: Path) -> tuple[np.ndarray, tuple[float, float], str]:
    """Filled rectangles in mm from the top left, the page in mm, and the words."""
    reader = PdfReader(path, strict=True)
    (page,) = reader.pages
    assert reader.viewer_preferences.print_scaling == "/None"
    rectangles, at = [], []

    def visit(operator: bytes, operands: list, matrix: list, _: object) -> None:
        if operator == b"re":
            rectangles.append([float(value) for value in operands])
            at.append([float(value) for value in matrix])

    words = page.extract_text(visitor_operand_before=visit).strip()
    assert np.allclose(at, [1, 0, 0, 1, 0, 0])
    resources: Any = page["/Resources"]
    assert resources["/Font"]["/F1"]["/BaseFont"] == "/Helvetica"
    width, height = float(page.mediabox.width), float(page.mediabox.height)
    x, y, w, h = np.array(rectangles).T
    boxes = np.column_stack([x, height - y - h, x + w, height - y]) * MM_PER_POINT
    return boxes, (width * MM_PER_POINT, height * MM_PER_POINT), words


def check_scale(target: Target, picture: np.ndarray, dpi: float, within_m: float) -> None:
    """The points measured in a picture of the page are where the target has them."""
    found = detect(target, picture).pixels
    assert found is not None
    assert np.isfinite(found).all()
    metres = found * 25.4e-3 / dpi
    off = (metres - metres.mean(axis=0)) - (target.points - target.points.mean(axis=0))[:, :2]
    assert np.abs(off).max() < within_m
    true = np.linalg.norm(target.points[-1] - target.points[0])
    assert np.linalg.norm(metres[-1] - metres[0]) == pytest.approx(true, rel=1e-3)


def check_bar(rectangles: np.ndarray, page: tuple[float, float], pattern_bottom: float) -> None:
    """The last three rectangles: a bar of 100 mm below the pattern."""
    bar = rectangles[-3:]
    assert bar[:, 2].max() - bar[:, 0].min() == pytest.approx(BAR_MM, abs=1e-3)
    assert bar[:, 1].min() > pattern_bottom + 2
    assert bar.min() > 4
    assert np.all(bar[:, 2:].max(axis=0) < np.array(page) - 4)


@pytest.mark.parametrize("text", KINDS)
def test_lines_are_true_to_scale(text: str, tmp_path: Path) -> None:
    target = parse_target(text)
    path = tmp_path / "board.pdf"

    described, _ = write_sheet(target, path)

    rectangles, page, words = read_pdf(path)
    check_bar(rectangles, page, rectangles[:-3, 3].max())
    # The painter rounds edges to 32 um.
    check_scale(target, painted(rectangles[:-3], page, 200.0), 200.0, 25e-6)
    assert words.startswith(target.description)
    assert parse_target(str(described)) == target
    write_sheet(target, tmp_path / "again.pdf")
    assert (tmp_path / "again.pdf").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("paper", list(PAPERS_MM))
def test_boards_lie_or_stand_on_paper_and_stay_on_it(paper: str) -> None:
    for text in ("chessboard 9x6 20mm", "chessboard 6x9 20mm"):
        sheet = lay_out(parse_target(text), paper.lower())
        page = sheet.width_mm, sheet.height_mm
        assert tuple(sorted(page)) == tuple(sorted(PAPERS_MM[paper]))
        assert sheet.rectangles_mm.min() >= 7.9
        assert np.all(sheet.rectangles_mm[:, 2:].max(axis=0) <= np.array(page) - 7.9)
        # The pattern is centred from side to side.
        sides = sheet.rectangles_mm[:-3, 0].min(), page[0] - sheet.rectangles_mm[:-3, 2].max()
        assert sides[0] == pytest.approx(sides[1])


@pytest.mark.parametrize(
    "text", ["chessboard 9x6 40mm", "charuco 12x9 40mm 30mm", "apriltag 6x6 88mm 0.3"]
)
def test_what_does_not_fit_is_refused(text: str) -> None:
    with pytest.raises(CalibrationError, match="A4"):
        lay_out(parse_target(text), "A4")


def test_wrong_wishes_give_one_clear_line(tmp_path: Path) -> None:
    target = parse_target(KINDS[0])
    for path, paper in (("board.gif", None), ("board.pdf", "A7")):
        with pytest.raises(CalibrationError):
            write_sheet(target, tmp_path / path, paper)
    with pytest.raises(CalibrationError, match="5080 mm"):
        lay_out(parse_target("chessboard 9x6 1m"))
    assert not list(tmp_path.iterdir())


def test_the_description_of_another_target_is_kept(tmp_path: Path) -> None:
    """A printed board must not go with the JSON file of another."""
    board, other = parse_target(KINDS[1]), parse_target(KINDS[0])
    described, _ = write_sheet(board, tmp_path / "b.pdf")
    write_sheet(board, tmp_path / "b.pdf", "A4")  # another page of the same target
    with pytest.raises(CalibrationError, match=r"b\.json describes charuco 7x5"):
        write_sheet(other, tmp_path / "b.pdf")
    assert parse_target(str(described)) == board
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.json", "b.pdf"]

    (tmp_path / "own.json").write_text('{"mine": 1}')
    with pytest.raises(CalibrationError, match=r"own\.json"):
        write_sheet(other, tmp_path / "own.pdf")
    assert (tmp_path / "own.json").read_text() == '{"mine": 1}'
