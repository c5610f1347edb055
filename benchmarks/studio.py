"""How long the studio takes to plan again and to make a tile, next to twins in the same run.

    .venv/bin/python -m benchmarks.studio [--quick] [--json FILE]

A re-plan is what a page waits for when a setting changes: the draft of `survey.toml`, the plan, and
its JSON; warm, of one core, the median of some with another setting each. The whole stage plans,
certifies on the fine grid, and writes maps, page and missions for vehicles. Two areas: that of the
template that the tutorial starts from, and a strip of 10,000 swaths. Tiles are of a mosaic as the
program writes it, cloud-optimised, from all of its levels, none asked for twice; the twin reads the
same pixels with rasterio and encodes them alike, and does nothing else. Ends with exit code 1 when
a goal is missed.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from pydantic_core import to_json
from rasterio.shutil import copy
from rasterio.transform import Affine
from rasterio.windows import Window

from alice_survey.app.pipeline import template_text
from alice_survey.app.report.rasters import encode_webp
from alice_survey.app.studio.files import Workspace
from alice_survey.app.studio.layers import Layers
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import collected_by
from alice_survey.core.executor import SERIAL
from benchmarks.figures import Figure, Findings, Goal, add_options, hand_over
from benchmarks.machine import heading, machine
from missions.plan.preview import Draft, draft_settings, preview
from missions.plan.run import run_plan

_GOALS_S = {"tutorial": 0.5, "10,000 swaths": 2.0}
_SPACING_M = 0.25
_SWATH_M = 6.0
_ALTITUDES_M = (0.8, 0.82, 0.81, 0.805, 0.815)
"""Of re-plans over the strip; over the tutorial's area 2.5 times as high."""


@dataclass(frozen=True, kw_only=True)
class Replan:
    """How long an area takes to plan."""

    area: str
    swaths: int
    stations: int
    cpu_s: float
    """Of a re-plan: draft, plan and JSON."""
    first_s: float
    """The same, of the first, cold."""
    megabytes: float
    """Of its JSON."""
    whole_s: float
    """Of the stage `plan`."""

    def figures(self) -> list[Figure]:
        """Computing of a re-plan, next to the whole stage."""
        maximum = _GOALS_S.get(self.area)
        goal = None if maximum is None else Goal(maximum=maximum)
        return [
            Figure(name=f"{self.area}: re-plan", value=self.cpu_s, unit="s", goal=goal),
            Figure(
                name=f"{self.area}: re-plan over a whole plan", value=self.cpu_s, unit="s",
                peer="stage plan", peer_value=self.whole_s, goal=Goal(maximum=0.5, of="ratio"),
            ),
        ]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """How long tiles of a mosaic take."""

    megapixels: float
    tiles: int
    cpu_ms: float
    """Of a tile, mean over all levels."""
    worst_ms: float
    twin_ms: float
    """Of reading and encoding its pixels alone."""

    def figures(self) -> list[Figure]:
        """Computing of a tile, next to its twin."""
        return [
            Figure(name="tile of a mosaic", value=self.cpu_ms, unit="ms", goal=Goal(maximum=60.0)),
            Figure(
                name="tile of a mosaic over reading and encoding it", value=self.cpu_ms, unit="ms",
                peer="rasterio and OpenCV", peer_value=self.twin_ms,
                goal=Goal(maximum=1.5, of="ratio"),
            ),
        ]  # fmt: skip


def tiles_of(side_px: int, number: int = 60) -> Tiles:
    """Ask for tiles of a mosaic of texture, spread over its levels and places."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mosaic" / "mosaic.tif"
        path.parent.mkdir()
        _write_mosaic(path, side_px)
        layers = Layers(Workspace(Path(folder)))
        (about,) = layers.picture_layers()
        rng, times_ms, twins_ms = np.random.default_rng(5), [], []
        asked: set[tuple[int, int, int]] = set()
        while len(asked) < number:
            level = int(rng.integers(about.levels))
            columns, rows, _, _ = about.size(level)
            x, y = (int(rng.integers(-(-n // about.tile_px))) for n in (columns, rows))
            if (level, x, y) in asked:
                number -= level < about.levels - 2  # few tiles at the coarse end
                continue
            asked.add((level, x, y))
            began = time.process_time()
            layers.tile("mosaic", level, x, y, None)
            times_ms.append(1e3 * (time.process_time() - began))
            began = time.process_time()
            _twin(path, about.levels - 1 - level, x, y, about.tile_px)
            twins_ms.append(1e3 * (time.process_time() - began))
    return Tiles(
        megapixels=side_px**2 / 1e6,
        tiles=len(times_ms),
        cpu_ms=float(np.mean(times_ms)),
        worst_ms=float(np.max(times_ms)),
        twin_ms=float(np.mean(twins_ms)),
    )


def _write_mosaic(path: Path, side_px: int) -> None:
    rng = np.random.default_rng(6)
    block = np.clip(rng.normal(120, 30, (4, 1024, 1024)), 0, 255).astype(np.uint8)
    block[3] = 255
    plain = path.with_name("plain.tif")
    profile = {
        "driver": "GTiff", "width": side_px, "height": side_px, "count": 4, "dtype": "uint8",
        "tiled": True, "blockxsize": 512, "blockysize": 512, "photometric": "RGB", "alpha": "YES",
        "transform": Affine(0.001, 0, 0, 0, -0.001, side_px / 1e3),
    }  # fmt: skip
    with rasterio.open(plain, "w", **profile) as raster:
        for row in range(0, side_px, 1024):
            for column in range(0, side_px, 1024):
                raster.write(block, window=Window(column, row, 1024, 1024))
    copy(plain, path, driver="COG", blocksize=512, compress="deflate", level=1)
    plain.unlink()


def _twin(path: Path, halvings: int, x: int, y: int, tile_px: int) -> bytes:
    options = {} if halvings == 0 else {"overview_level": halvings - 1}
    with rasterio.open(path, **options) as raster:
        left, top = x * tile_px, y * tile_px
        window = Window(left, top, min(tile_px, raster.width - left),
                        min(tile_px, raster.height - top))  # fmt: skip
        return encode_webp(np.moveaxis(raster.read(window=window), 0, -1))


def main() -> None:
    """Measure, print, and say which goals are missed."""
    options = _options()
    about = machine(("numpy", "numba", "shapely", "tomlkit", "rasterio"))
    print(heading(about), "\n", flush=True)
    swaths = 1_000 if options.quick else 10_000
    rows = [replanned("tutorial", {}, 2.5), replanned(f"{swaths:,} swaths", _strip(swaths), 1.0)]
    tiles = tiles_of(4_096 if options.quick else 16_384)
    figures = (*(figure for row in rows for figure in row.figures()), *tiles.figures())
    values = {"replans": [asdict(row) for row in rows], "tiles": asdict(tiles)}
    sys.exit(hand_over(options, about, Findings(figures=figures), values))


def _strip(swaths: int) -> dict[str, dict[str, Any]]:
    """Settings of a strip that lines cross, as many as are wanted."""
    return {
        "area": {"length_m": swaths * _SPACING_M - 0.01, "width_m": _SWATH_M},
        "plan": {"line_spacing_m": _SPACING_M, "line_heading_deg": 90.0, "speed_mps": 0.1,
                 "relief_m": 0.05},
        "camera": {"focal_mm": 8.0},
    }  # fmt: skip


def replanned(name: str, settings: dict[str, dict[str, Any]], scale: float) -> Replan:
    """Plan an area again and again as the studio does, and once as the command line does."""
    text = draft_settings(template_text(), Path("survey.toml"), settings).text
    times_s, draft, size = [], None, 0
    for altitude_m in (_ALTITUDES_M[0], *_ALTITUDES_M):
        began = time.process_time()
        changes = {"plan": {"altitude_m": scale * altitude_m}}
        draft = draft_settings(text, Path("survey.toml"), changes)
        found = preview(draft.config)
        size = len(to_json(found, inf_nan_mode="null"))
        times_s.append(time.process_time() - began)
        if not found["ok"]:
            raise RuntimeError(found["error"])
    assert isinstance(draft, Draft)
    return Replan(
        area=name,
        swaths=sum(line["kind"] == "survey" for line in found["lines"]),
        stations=found["totals"]["stations"],
        cpu_s=float(np.median(times_s[1:])),
        first_s=times_s[0],
        megabytes=size / 1e6,
        whole_s=_whole_s(draft.config),
    )


def _whole_s(config: SurveyConfig) -> float:
    """Computing of the stage `plan`."""
    with tempfile.TemporaryDirectory() as folder, collected_by(lambda _, __: None):
        began = time.process_time()
        run_plan(Path(folder), Path(folder), SERIAL, survey=config)
        return time.process_time() - began


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Benchmark of the studio.")
    add_options(parser, quick="a strip of 1,000 swaths")
    return parser.parse_args()


if __name__ == "__main__":
    main()
