"""The Pictures tab as a person uses it: spots picked by mouse and keys, found again, saved."""

import math
from dataclasses import dataclass
from typing import Any

WAIT_MS = 240_000
_ALL_READY = """() => [...document.querySelectorAll('.picture-view')].every(
    (view) => 'ready' in view.dataset)"""


def said(page: Any, start: str) -> None:
    """Wait until the page's line of status begins with these words."""
    page.wait_for_function(
        "(start) => document.getElementById('status').textContent.startsWith(start)",
        arg=start, timeout=WAIT_MS,
    )  # fmt: skip


@dataclass(frozen=True)
class PicturePage:
    """Pixels count from 0 at the middle of the first one, as the page shows them."""

    page: Any
    size_px: tuple[int, int]
    """Width and height of the survey's pictures."""

    def opened(self, image: str, x: float, y: float) -> Any:
        """The view of a picture from the list, with a spot picked near a pixel.

        Returns once the pictures that show the same spot are there.
        """
        self.page.get_by_text("Start from a picture").click()
        self.page.get_by_label("Find").fill(image)
        self.page.get_by_role("button", name=image, exact=True).click()
        view = self.page.locator(".picture-view[data-ready]").first
        view.wait_for()
        view.scroll_into_view_if_needed()
        box, (wide, high) = view.bounding_box(), self.size_px
        # The picture is about as wide as the view: zooms are steps of a half.
        scale = 2 ** (round(2 * math.log2(box["width"] / wide)) / 2)
        view.click(position={
            "x": box["width"] / 2 + (x + 0.5 - wide / 2) * scale,
            "y": box["height"] / 2 + (y + 0.5 - high / 2) * scale,
        })  # fmt: skip
        title = self.page.locator(".wall strong", has_text="the spot")
        title.filter(has_not_text="Click").wait_for()
        self.page.wait_for_function(_ALL_READY)
        self.page.get_by_text("Start from a picture").click()
        return view

    def moved_to(self, view: Any, x: float, y: float) -> tuple[float, float]:
        """Move a pick by the keys to a tenth of a pixel of where it is meant."""
        view.focus()
        for to, axis, less, more in ((x, "x", "ArrowLeft", "ArrowRight"),
                                     (y, "y", "ArrowUp", "ArrowDown")):  # fmt: skip
            tenths = round(10 * (to - float(view.get_attribute(f"data-{axis}"))))
            whole = round(tenths / 10)
            for count, key in ((whole, ""), (tenths - 10 * whole, "Shift+")):
                for _ in range(abs(count)):
                    self.page.keyboard.press(key + (more if count > 0 else less))
        return float(view.get_attribute("data-x")), float(view.get_attribute("data-y"))

    def found_in_others(self) -> int:
        """Have the page find the spot in the other pictures, and count those."""
        self.page.get_by_role("button", name="Find it in all others").click()
        said(self.page, "Found in")
        return int(self.page.locator("#status").inner_text().split()[2])

    def saved(self, name: str) -> None:
        self.page.get_by_label("Name of the point").fill(name)
        self.page.get_by_role("button", name="Save the point").click()
        said(self.page, f"Saved {name} ")
        self.closed()

    def closed(self) -> None:
        self.page.get_by_role("button", name="Back to the map").click()

    def length(self, first: str, second: str) -> tuple[float, float]:
        """The length between two points and its sigma, as shown."""
        ticked = self.page.locator(".points input:checked")
        while ticked.count():
            ticked.first.click()  # the table is drawn again
        for name in (first, second):
            self.page.get_by_label(name, exact=True).check()
        self.page.wait_for_function(
            "(words) => document.querySelector('[data-value] strong')"
            "?.textContent.startsWith(words)",
            arg=f"{first} to {second}:", timeout=WAIT_MS,
        )  # fmt: skip
        shown = self.page.locator("[data-value]")
        value, sigma = (float(shown.get_attribute(f"data-{key}")) for key in ("value", "sigma"))
        return value, sigma
