"""Make the pictures of the tutorial and of `docs/studio.md` again, or the front page's from a demo.

    python -m tests.docs.renew [FOLDER]
    python -m tests.docs.renew --demo DEMO

The tutorial's own commands are run first, but for a folder where they were; nothing in it changes.
"""

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from tests.alice_survey.app.studio.client import serving
from tests.alice_survey.app.studio.journey_page import begun_page, button
from tests.alice_survey.app.studio.test_follow_browser import SimulatedDive
from tests.alice_survey.app.studio.test_model_browser import click
from tests.docs.given import TUTORIAL, Made
from tests.docs.pages import DOCS
from tests.missions.follow.dives import text_of

WIDE, NARROW = {"width": 1280, "height": 800}, {"width": 400, "height": 800}
WAIT_MS = 60_000
SHEETS: dict[str, tuple[int, list[str]]] = {
    "plan.png": (800, ["plan/map.png"]),
    "flight.png": (1400, ["flight/track.png"]),
    "pictures.jpg": (
        1260,
        ["images/left/000014.png", "images/right/000014.png", "pool/left/03.png"],
    ),
    "surface.jpg": (1000, ["dense/dem.png", "mosaic/mosaic.png"]),
    "mesh.jpg": (1000, ["mesh/mesh.png"]),
    "errors.png": (1400, ["evaluation/errors.png"]),
}
"""Widths, and what is shown side by side; station 14 shows the amphora."""


def main() -> None:
    """Run the tutorial unless it was, and draw its pictures and those of the studio."""
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        if sys.argv[1:2] == ["--demo"]:
            front_page(Path(shutil.copytree(sys.argv[2], scratch / "demo")))
            return
        made = Path(sys.argv[1]) if sys.argv[1:] else Made(scratch).after(TUTORIAL)
        copy = Path(shutil.copytree(made / "reef", scratch / "copy" / "reef"))
        for file, (width, paths) in SHEETS.items():
            sheet = side_by_side([copy / path for path in paths], width)
            few = sheet.quantize(96) if file.endswith(".png") else sheet  # colours: small files
            few.save(DOCS / "tutorial" / file, optimize=True)
        with begun_page({"width": 1100, "height": 900}) as (page, _):
            page.goto((copy / "report" / "report.html").as_uri())
            photograph(page, DOCS / "tutorial" / "report.jpg", 1500)
        photograph_studio(copy, DOCS / "studio")


def front_page(demo: Path) -> None:
    """What the demo makes, and the studio that measures in it beside the error of its surface."""
    picture, errors, studio = (demo / name for name in ("left.png", "errors.png", "studio.jpg"))
    whole = Image.open(demo / "evaluation" / "errors.png")
    whole.crop((0, 0, whole.width * 57 // 100, whole.height)).save(errors)
    Image.open(demo / "images" / "left" / "000048.png").save(picture)
    with serving(demo) as server, begun_page(WIDE) as (page, _):
        page.goto(server.address)
        page.wait_for_selector("body[data-ready]")
        page.locator("#tab-model").click()
        page.wait_for_timeout(4000)
        measure(page)
        photograph(page, studio, 1500)
    rows = ([picture, demo / "dense" / "dem.png"], [demo / "mosaic" / "mosaic.png", errors])
    parts = [ImageOps.pad(side_by_side(row, 1100), (1100, 540), color="white") for row in rows]
    Image.fromarray(np.vstack([np.asarray(part) for part in parts])).save(
        DOCS / "demo.jpg", quality=80
    )
    side_by_side([studio, errors], 1636).save(DOCS / "front.jpg", quality=80)


def side_by_side(paths: list[Path], width: int) -> Image.Image:
    """Pictures of one height without their white borders, in a row; what is clear becomes white."""
    row = []
    for path in paths:
        clear = Image.open(path).convert("RGBA")
        one = Image.alpha_composite(Image.new("RGBA", clear.size, "white"), clear).convert("RGB")
        one = one.crop(ImageOps.invert(one.convert("L")).getbbox())
        row.append(np.asarray(ImageOps.expand(ImageOps.contain(one, (9999, 620)), 6, "white")))
    return ImageOps.contain(Image.fromarray(np.hstack(row)), (width, 9999))


def photograph_studio(reef: Path, out: Path) -> None:
    """Serve a workspace, and photograph its tabs."""
    dive = SimulatedDive.read(reef)
    (reef / "nav.csv").write_bytes(text_of(dive.between(0.0, float(np.mean(dive.on_lines[2])))))
    before = {"model": measure, "pictures": open_pictures, "follow": follow}
    with serving(reef) as server, begun_page(WIDE) as (page, _):
        page.goto(server.address)
        page.wait_for_selector("body[data-ready]")
        for name in ("follow", "model", "pictures", "run", "plan"):
            page.locator(f"#tab-{name}").click()
            page.wait_for_timeout(4000)
            before.get(name, lambda _: None)(page)
            photograph(page, out / f"{name}.jpg", 1500)
        page.set_viewport_size(NARROW)
        photograph(page, out / "narrow.jpg", 3000)
    with serving(reef.parent / "bay") as server, begun_page(WIDE) as (page, _):
        page.goto(server.address)
        button(page, "Plan a survey").click()
        photograph(page, out / "begin.jpg", 0)


def measure(page: Any) -> None:
    """An area in the middle of the map."""
    box = page.locator("#map-canvas")
    east, north = (float(box.get_attribute(f"data-{axis}")) for axis in ("east", "north"))
    size = 130 / 2 ** float(box.get_attribute("data-zoom"))
    button(page, "Area").click()
    corners = ((-1, -1), (0.2, -1.3), (0.6, 0.1), (-0.5, 0.5))
    click(page, *((east + size * e, north + size * n) for e, n in corners))
    button(page, "Finish").click()
    page.wait_for_selector("tr[data-measure]")


def open_pictures(page: Any) -> None:
    """The pictures that see the middle of the map."""
    button(page, "Choose on the map").click()
    page.locator("#map-canvas").focus()
    page.keyboard.press("Enter")
    page.locator(".picture-view[data-ready]").nth(3).wait_for(timeout=WAIT_MS)


def follow(page: Any) -> None:
    """A dive that has lost a stretch of its second line, with lines that close the hole."""
    page.get_by_label("Navigation CSV of this workspace").select_option("nav.csv")
    button(page, "Follow it").click()
    page.wait_for_selector("#panel-follow button.primary:enabled", timeout=WAIT_MS)


def photograph(page: Any, path: Path, after_ms: int) -> None:
    """What the page shows at its top after a while."""
    page.wait_for_timeout(after_ms)
    page.screenshot(path=str(path), type="jpeg", quality=76)


if __name__ == "__main__":
    main()
