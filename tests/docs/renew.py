"""Make the tutorial's pictures again, from a run of the tutorial's own commands.

`python -m tests.docs.renew` runs them first; `--folder F` takes a folder where they were run.
"""

import argparse
import tempfile
from pathlib import Path

from PIL import Image, ImageOps

from tests.alice_survey.kit.browser import chromium
from tests.docs.given import TUTORIAL, Made
from tests.docs.pages import DOCS

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
    to_width(read(reef / "plan/map.png"), 800).save(out / "plan.png", optimize=True)
    to_width(read(reef / "flight/track.png"), 1400).save(out / "flight.png", optimize=True)
    pair = [read(reef / f"images/{side}/{STATION:06d}.png") for side in ("left", "right")]
    pictures = side_by_side([*pair, read(reef / "pool/left/03.png")], 338)
    pictures.save(out / "pictures.jpg", quality=82)
    surface = [cut(read(reef / "dense/dem.png")), read(reef / "mosaic/mosaic.png")]
    side_by_side(surface, 620).save(out / "surface.jpg", quality=82)
    to_width(cut(read(reef / "mesh/mesh.png")), 1000).save(out / "mesh.jpg", quality=82)
    read(reef / "evaluation/errors.png").save(out / "errors.png", optimize=True)
    photograph(reef / "report/report.html", out / "report.jpg")
    size = sum(path.stat().st_size for path in out.iterdir())
    if size > MAX_BYTES:
        raise ValueError(f"{size / 1e6:.2f} MB of pictures in {out}")


def read(path: Path) -> Image.Image:
    """A picture, in colour; what is clear becomes white."""
    picture = Image.open(path).convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture).convert("RGB")


def cut(picture: Image.Image) -> Image.Image:
    """What is left without a white border."""
    dark = ImageOps.invert(picture.convert("L")).point(lambda value: 255 * (value > NOTICED_PX))
    return picture.crop(dark.getbbox())


def to_width(picture: Image.Image, width: int) -> Image.Image:
    """The picture at another size."""
    return picture.resize((width, round(picture.height * width / picture.width)))


def side_by_side(pictures: list[Image.Image], height: int) -> Image.Image:
    """Pictures of one height with gaps between them."""
    row = [to_width(one, round(one.width * height / one.height)) for one in pictures]
    width = sum(one.width + GAP_PX for one in row) - GAP_PX
    sheet, left = Image.new("RGB", (width, height), "white"), 0
    for one in row:
        sheet.paste(one, (left, 0))
        left += one.width + GAP_PX
    return sheet


def photograph(page: Path, path: Path) -> None:
    """What a browser shows of a page at its top."""
    with chromium() as browser:
        tab = browser.new_page(viewport={"width": 1100, "height": 900})
        tab.goto(page.resolve().as_uri())
        tab.wait_for_timeout(1500)
        tab.screenshot(path=str(path), type="jpeg", quality=80)


if __name__ == "__main__":
    main()
