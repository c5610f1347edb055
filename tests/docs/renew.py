"""Make the tutorial's pictures again, from a run of the tutorial's own commands.

`python -m tests.docs.renew` runs them first; `--folder F` takes a folder where they were run.
"""

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.alice_survey.kit.browser import chromium
from tests.docs.given import TUTORIAL, Made
from tests.docs.pages import DOCS

Picture = NDArray[np.uint8]
MAX_BYTES = 1_500_000
STATION = 14
"""One that shows the amphora."""
GAP_PX = 12
NOTICED_PX = 4


def main() -> None:
    """Run the tutorial unless it was, and draw its pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path)
    folder = parser.parse_args().folder
    with tempfile.TemporaryDirectory() as scratch:
        renew(folder or Made(Path(scratch)).after(TUTORIAL), DOCS / "tutorial")


def renew(made: Path, out: Path) -> None:
    """Draw the pictures of `docs/tutorial.md`.

    Args:
        made: where its commands were run.
        out: folder to write.

    Raises:
        ValueError: together they are too large for a page.
    """
    out.mkdir(exist_ok=True)
    reef = made / "reef"
    png(out / "plan.png", to_width(read(reef / "plan/map.png"), 800))
    png(out / "flight.png", to_width(read(reef / "flight/track.png"), 1400))
    pair = [read(reef / f"images/{side}/{STATION:06d}.png") for side in ("left", "right")]
    jpeg(out / "pictures.jpg", side_by_side([*pair, read(reef / "pool/left/03.png")], 338))
    surface = [cut(read(reef / "dense/dem.png")), read(reef / "mosaic/mosaic.png")]
    jpeg(out / "surface.jpg", side_by_side(surface, 620))
    jpeg(out / "mesh.jpg", to_width(cut(read(reef / "mesh/mesh.png")), 1000))
    png(out / "errors.png", read(reef / "evaluation/errors.png"))
    photograph(reef / "report/report.html", out / "report.jpg")
    size = sum(path.stat().st_size for path in out.iterdir())
    if size > MAX_BYTES:
        raise ValueError(f"{size / 1e6:.2f} MB of pictures in {out}")


def read(path: Path) -> Picture:
    """A picture, in colour; what is clear becomes white."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise FileNotFoundError(path)
    if picture.ndim == 3 and picture.shape[2] == 4:
        clear = 1 - picture[..., 3:] / 255.0
        picture = np.rint(picture[..., :3] * (1 - clear) + 255 * clear).astype(np.uint8)
    return np.asarray(picture, np.uint8)


def cut(picture: Picture) -> Picture:
    """What is left without a white border."""
    there = np.argwhere(np.any(picture < 255 - NOTICED_PX, axis=-1))
    (top, left), (bottom, right) = there.min(axis=0), there.max(axis=0) + 1
    return picture[top:bottom, left:right]


def to_width(picture: Picture, width: int) -> Picture:
    """The picture at another size."""
    return scaled(picture, width / picture.shape[1])


def scaled(picture: Picture, by: float) -> Picture:
    """The picture, larger or smaller."""
    how = cv2.INTER_AREA if by < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, None, fx=by, fy=by, interpolation=how), np.uint8)


def side_by_side(pictures: list[Picture], height: int) -> Picture:
    """Pictures of one height with gaps between them."""
    row = []
    for picture in pictures:
        small = scaled(picture, height / picture.shape[0])[:height]
        row += [small, np.full((len(small), GAP_PX, 3), 255, np.uint8)]
    return np.hstack(row[:-1])


def jpeg(path: Path, picture: Picture) -> None:
    """Write what was photographed."""
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 82])


def png(path: Path, picture: Picture) -> None:
    """Write what was drawn."""
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def photograph(page: Path, path: Path) -> None:
    """What a browser shows of a page at its top."""
    with chromium() as browser:
        tab = browser.new_page(viewport={"width": 1100, "height": 900})
        tab.goto(page.resolve().as_uri())
        tab.wait_for_timeout(1500)
        tab.screenshot(path=str(path), type="jpeg", quality=80)


if __name__ == "__main__":
    main()
