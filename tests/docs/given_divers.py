"""What a diver brings home: chapters of a GoPro, a dive computer's log, a mixed card."""

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.reconstruct.pictures import gopro
from tests.reconstruct.pictures.dated import save

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 290.0
RATE_HZ = 5.0
LOCAL = datetime(2024, 7, 1, 14, tzinfo=UTC)
"""By the camera's clock, which is that of Oslo and 4 s late."""
BEGAN = LOCAL - timedelta(hours=2) + timedelta(seconds=4)
FLOOR_M = 12.0
_SHEET_PX_M, _MARGIN_M, _SIDE_M = 250, 1.5, 5.2


def relief_m(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the floor over its mean."""
    return 0.10 * np.sin(3.1 * x) + 0.08 * np.cos(4.3 * y + x) + 0.05 * np.sin(9 * x + 2 * y)


def grains(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Sand and stones: noise of several grain sizes, (height, width)."""
    grey = np.zeros(size)
    for grain in (2, 5, 13, 34):
        small = rng.normal(size=(size[0] // grain + 2, size[1] // grain + 2))
        grey += cv2.resize(small, size[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 28 * grey, 0, 255).astype(np.uint8)


def _seen(
    sheet: NDArray[np.uint8], place_m: NDArray[np.float64], turn: Rotation
) -> NDArray[np.uint8]:
    """The frame of a pinhole that looks down: each ray is followed to the floor."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL_PX, (v - HEIGHT / 2) / FOCAL_PX, np.ones_like(u)], -1)
    rays = turn.apply(rays.reshape(-1, 3)).reshape(HEIGHT, WIDTH, 3)
    hit = place_m - rays * (place_m[2] / rays[..., 2])[..., None]
    for _ in range(12):
        down = -relief_m(hit[..., 0], hit[..., 1])
        hit = place_m + rays * ((down - place_m[2]) / rays[..., 2])[..., None]
    x, y = (((hit[..., i] + _MARGIN_M) * _SHEET_PX_M - 0.5).astype(np.float32) for i in (0, 1))
    grey = cv2.remap(sheet, x, y, cv2.INTER_LINEAR)
    return np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)


def path_m() -> NDArray[np.float64]:
    """(N, 3) metres: three lines of 2.2 m, 0.55 m apart, up and down by a decimetre."""
    along, across = np.linspace(0.0, 2.2, 26), np.linspace(0.0, 0.55, 7)[1:-1]
    parts = []
    for line in range(3):
        there = along if line % 2 == 0 else along[::-1]
        parts.append(np.stack([there, np.full(len(there), 0.55 * line)], axis=1))
        if line < 2:
            parts.append(np.stack([np.full(5, there[-1]), 0.55 * line + across], axis=1))
    flat = np.concatenate(parts)
    return np.column_stack([flat, -1.2 - 0.12 * np.sin(np.arange(len(flat)) / 11)])


def pose(frame: int) -> tuple[NDArray[np.float64], Rotation]:
    """Where a frame of the dive was taken."""
    angles = [6 * np.sin(frame / 5), 7 * np.cos(frame / 7), 4 * np.sin(frame / 9)]
    return path_m()[frame], Rotation.from_euler("xyz", angles, degrees=True)


def dive_frames(numbers: Iterable[int]) -> list[NDArray[np.uint8]]:
    """What the camera sees on the way."""
    side = round(_SIDE_M * _SHEET_PX_M)
    sheet = grains(np.random.default_rng(7), (side, side))
    return [_seen(sheet, *pose(number)) for number in numbers]


def chapters(folder: Path) -> None:
    """Write `GX010042.MP4`, `GX020042.MP4` and `computer.csv`; each sixth frame is blurred."""
    places = path_m()
    frames = dive_frames(range(len(places)))
    for i in range(2, len(frames), 6):
        frames[i] = np.asarray(cv2.GaussianBlur(frames[i], (0, 0), 1.6), np.uint8)
    half = len(frames) // 2
    for name, part in (("GX010042", frames[:half]), ("GX020042", frames[half:])):
        gopro.film(folder / f"{name}.MP4", part, RATE_HZ, created=LOCAL)
    rows = ["time_utc,depth_m,sigma_depth_m"]
    for i, place in enumerate(places):
        when = BEGAN + timedelta(seconds=i / RATE_HZ)
        rows.append(f"{when.isoformat()},{FLOOR_M + place[2]:.2f},0.05")
    (folder / "computer.csv").write_text("\n".join(rows) + "\n")


def card(folder: Path) -> None:
    """Write pictures of two cameras in folders of their own, a copy of one, and a note."""
    rng = np.random.default_rng(8)
    makes = (
        ("100GOPRO", "GOPR", "GoPro", "GoPro HERO9 Black", (240, 320), 8),
        ("100OLYMP", "P701", "OLYMPUS", "TG-6", (300, 400), 6),
    )
    for inside, prefix, make, model, size, count in makes:
        for number in range(count):
            tags = {"make": make, "model": model, "orientation": (1, 6)[number % 2]}
            picture = np.repeat(grains(rng, size)[..., None], 3, axis=2)
            save(folder / inside / f"{prefix}{number:04d}.jpg", picture, **tags)
    first = folder / "100GOPRO" / "GOPR0003.jpg"
    first.with_name("GOPR0003 copy.jpg").write_bytes(first.read_bytes())
    (folder / "notes.txt").write_text("12 m, visibility 8 m\n")
