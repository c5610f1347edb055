"""Print a target at true scale: a PDF, with a bar to check the printer."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reportlab.lib import pagesizes
from reportlab.lib.units import mm

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import AliceError, CalibrationError
from alice_survey.core.frames import Array
from camera_calib.targets.pattern import black_rectangles
from camera_calib.targets.target import Target, parse_target, read_target, write_target

PAPERS_MM = {
    name: (round(width / mm, 1), round(height / mm, 1))
    for name in ("A4", "A3", "A2", "A1", "A0", "letter")
    for width, height in [getattr(pagesizes, name)]
}
BAR_MM = 100.0
_MARGIN_MM = 8.0
"""White margin around the pattern; printers leave about 5 mm blank themselves."""
_STRIP_MM = 11.0
"""Space below the pattern, for the bar and the text."""
_TICK_MM, _LINE_MM, _TEXT_MM = 3.0, 0.3, 2.6
_MAX_PAGE_MM = 5080.0
"""A PDF page is at most 200 inches."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sheet:
    """A page: black rectangles and a line of words; y runs down from the top left corner."""

    width_mm: float
    height_mm: float
    rectangles_mm: Array
    """(M, 4) least x, least y, greatest x, greatest y."""
    words: str
    words_at_mm: tuple[float, float]
    """Left end of the words' base line."""


def lay_out(target: Target, paper: str | None = None) -> Sheet:
    """Place a target on a page, upright or lying, with the bar and the words below it.

    Args:
        target: what to print.
        paper: a name in `PAPERS_MM`; without it the page is as large as the target needs.

    Raises:
        CalibrationError: the paper is unknown, or the target does not fit.
    """
    left, top, right, bottom = (1e3 * side for side in target.outline)
    width, height = right - left, bottom - top
    # On a page made for it a board gets half a square of white all around.
    margin = max(_MARGIN_MM, -0.5 * left) if paper is None else _MARGIN_MM
    needed = max(width, BAR_MM) + 2.0 * margin, height + _STRIP_MM + 2.0 * margin
    page = needed if paper is None else _on_paper(target, needed, paper)
    if max(page) > _MAX_PAGE_MM:
        raise CalibrationError(
            f"a page of {page[0]:.0f} x {page[1]:.0f} mm; files hold at most "
            f"{_MAX_PAGE_MM:.0f} mm: take fewer or smaller squares"
        )
    x = (page[0] - width) / 2.0
    y = (page[1] - height - _STRIP_MM) / 2.0
    place = np.array([x - left, y - top])
    pattern = 1e3 * black_rectangles(target) + np.tile(place, 2)
    bar_x, bar_y = _MARGIN_MM, page[1] - _MARGIN_MM
    words = f"{target.description} - print at 100 %: the bar is {BAR_MM:.0f} mm"
    return Sheet(
        width_mm=page[0],
        height_mm=page[1],
        rectangles_mm=np.concatenate([pattern, _bar(bar_x, bar_y)]),
        words=words,
        words_at_mm=(bar_x, bar_y - _TICK_MM - 1.0),
    )


def _on_paper(target: Target, needed: tuple[float, float], paper: str) -> tuple[float, float]:
    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    if paper.lower() not in known:
        raise CalibrationError(f"no paper '{paper}'; take one of {', '.join(PAPERS_MM)}")
    width, height = known[paper.lower()]
    for page in ((width, height), (height, width)):
        if needed[0] <= page[0] and needed[1] <= page[1]:
            return page
    raise CalibrationError(
        f"{target.description} needs a page of {needed[0]:.0f} x {needed[1]:.0f} mm, {paper} has "
        f"{width:g} x {height:g} mm: take larger paper, or fewer or smaller squares"
    )


def _bar(x: float, y: float) -> Array:
    """A line of 100 mm between the outer edges of two ticks; y is the lower end of the ticks."""
    middle = y - _TICK_MM / 2.0
    return np.array(
        [
            [x, y - _TICK_MM, x + _LINE_MM, y],
            [x + _LINE_MM, middle - _LINE_MM / 2, x + BAR_MM - _LINE_MM, middle + _LINE_MM / 2],
            [x + BAR_MM - _LINE_MM, y - _TICK_MM, x + BAR_MM, y],
        ]
    )


def to_pdf(sheet: Sheet) -> bytes:
    """The page as a PDF of filled rectangles and one line of Helvetica, to print without scaling.

    The same sheet gives the same bytes.
    """
    from reportlab.pdfgen.canvas import Canvas

    file = io.BytesIO()
    page = (sheet.width_mm * mm, sheet.height_mm * mm)
    canvas = Canvas(file, pagesize=page, invariant=True, pageCompression=False)
    canvas.setViewerPreference("PrintScaling", "None")
    path = canvas.beginPath()
    for x0, y0, x1, y1 in sheet.rectangles_mm * mm:
        path.rect(x0, page[1] - y1, x1 - x0, y1 - y0)
    canvas.drawPath(path, stroke=0, fill=1)
    canvas.setFont("Helvetica", _TEXT_MM * mm)
    x, y = sheet.words_at_mm
    canvas.drawString(x * mm, page[1] - y * mm, sheet.words)
    canvas.save()
    return file.getvalue()


def write_sheet(target: Target, path: Path, paper: str | None = None) -> tuple[Path, Sheet]:
    """Write a page to print, and next to it the target's JSON file, for calibrations.

    Args:
        target: what to print.
        path: of the PDF.
        paper: a name in `PAPERS_MM`, or as large as needed.

    Returns:
        The path of the JSON file, and the page.

    Raises:
        CalibrationError: the paper is unknown, the target does not fit, or the JSON file is there
            and describes something else.
    """
    if path.suffix.lower() != ".pdf":
        raise CalibrationError(f"{path}: write to a name that ends in .pdf")
    sheet, described = lay_out(target, paper), path.with_suffix(".json")
    _check_description(described, target)
    with atomic_path(path) as temporary:
        temporary.write_bytes(to_pdf(sheet))
    write_target(described, target)
    return described, sheet


def _check_description(path: Path, target: Target) -> None:
    """Keep the description of another target, whose sheets may be printed already."""
    if not path.exists():
        return
    try:
        known = read_target(path).description
    except AliceError:
        known = "something else"
    if known != target.description:
        raise CalibrationError(
            f"{path} describes {known}, and would be replaced: choose another name with -o"
        )


def print_target(text: str, path: Path, paper: str | None) -> tuple[str, dict[str, object]]:
    """Run `alice-survey target`; return its result as text and as JSON values."""
    target = parse_target(text)
    described, sheet = write_sheet(target, path, paper)
    lines = [
        f"wrote {path}, {sheet.width_mm:.1f} x {sheet.height_mm:.1f} mm, and {described}",
        "print it at 100 % (no fitting to the page), glue it flat, and measure the bar of "
        f"{BAR_MM:.0f} mm and a row of squares",
    ]
    if target.is_ambiguous:
        lines.append(
            "this chessboard looks the same when turned by half a turn, so that cameras that are "
            "turned against each other may number its corners differently: use an odd and an even "
            "count, such as 9x6"
        )
    data = {
        "file": str(path),
        "target": target.to_json(),
        "page_mm": [round(sheet.width_mm, 3), round(sheet.height_mm, 3)],
        "points": len(target.points),
    }
    return "\n".join(lines), data
