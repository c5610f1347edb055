"""How long the studio takes to plan again and to make a tile, next to twins in the same run.

    .venv/bin/python -m benchmarks.studio [--quick] [--json FILE]

A re-plan is what a page waits for when a setting changes: the draft of `survey.toml`, the plan, and
its JSON; warm, of one core, the median of some with another setting each. The whole stage plans,
certifies on the fine grid, and writes maps, page and missions for vehicles. Two areas: that of the
template that the tutorial starts from, and a strip of 10,000 swaths. Tiles are of a mosaic as the
program writes it, cloud-optimised, from all of its levels, none asked for twice; the twin reads the
same pixels with rasterio and encodes them alike, and does nothing else. Then a studio of its own is
put under load. Ends with exit code 1 when
a goal is missed.
"""

import math
import select
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rasterio
from pydantic_core import to_json
from rasterio.shutil import copy
from rasterio.transform import Affine
from rasterio.windows import Window

from alice_survey.app.pipeline import template_text
from alice_survey.app.report.rasters import encode_webp
from alice_survey.app.studio.files import Workspace
from alice_survey.app.studio.layers import Layers
from alice_survey.core.errors import collected_by
from alice_survey.core.executor import SERIAL
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from missions.plan.preview import draft_settings, preview
from missions.plan.run import run_plan

_ALTITUDES_M = (0.8, 0.82, 0.81, 0.805, 0.815)
"""Of re-plans over the strip; over the tutorial's area 2.5 times as high."""


def tile_figures(side_px: int, number: int = 60) -> list[Figure]:
    """Computing of tiles of a mosaic of texture, spread over its levels and places."""
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
    own_ms, twin_ms = float(np.mean(times_ms)), float(np.mean(twins_ms))
    return [
        Figure(name="tile of a mosaic", value=own_ms, unit="ms", goal=Goal(maximum=60.0)),
        Figure(
            name="tile of a mosaic over reading and encoding it", value=own_ms, unit="ms",
            peer="rasterio and OpenCV", peer_value=twin_ms, goal=Goal(maximum=1.5, of="ratio"),
        ),
    ]  # fmt: skip


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
    parser = Parser(__doc__, quick="a strip of 1,000 swaths, and a tenth of the load")
    options, about = parser.begin("numpy", "numba", "shapely", "tomlkit", "rasterio")
    swaths = 1_000 if options.quick else 10_000
    figures = [
        *replan_figures("tutorial", {}, 2.5),
        *replan_figures(f"{swaths:,} swaths", _strip(swaths), 1.0),
        *tile_figures(4_096 if options.quick else 16_384),
        *load_figures(10 if options.quick else 1),
    ]
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures)), {}))


def _strip(swaths: int) -> dict[str, dict[str, Any]]:
    """Settings of a strip that lines cross, as many as are wanted."""
    plan = {"line_spacing_m": 0.25, "line_heading_deg": 90.0, "speed_mps": 0.1, "relief_m": 0.05}
    area = {"length_m": swaths * 0.25 - 0.01, "width_m": 6.0}
    return {"area": area, "plan": plan, "camera": {"focal_mm": 8.0}}


def replan_figures(area: str, settings: dict[str, dict[str, Any]], scale: float) -> list[Figure]:
    """Plan an area again and again as the studio does, and once as the command line does."""
    text = draft_settings(template_text(), Path("survey.toml"), settings).text
    times_s = []
    for altitude_m in (_ALTITUDES_M[0], *_ALTITUDES_M):
        began = time.process_time()
        draft = draft_settings(
            text, Path("survey.toml"), {"plan": {"altitude_m": scale * altitude_m}}
        )
        found = preview(draft.config)
        to_json(found, inf_nan_mode="null")
        times_s.append(time.process_time() - began)
        if not found["ok"]:
            raise RuntimeError(found["error"])
    with tempfile.TemporaryDirectory() as folder, collected_by(lambda _, __: None):
        began = time.process_time()
        run_plan(Path(folder), Path(folder), SERIAL, survey=draft.config)()
        whole_s = time.process_time() - began
    cpu_s = float(np.median(times_s[1:]))
    maximum = {"tutorial": 0.5, "10,000 swaths": 2.0}.get(area, math.inf)
    return [
        Figure(name=f"{area}: re-plan", value=cpu_s, unit="s", goal=Goal(maximum=maximum)),
        Figure(
            name=f"{area}: re-plan over a whole plan", value=cpu_s, unit="s", peer="stage plan",
            peer_value=whole_s, goal=Goal(maximum=0.5, of="ratio"),
        ),
    ]  # fmt: skip


def load_figures(part: int) -> list[Figure]:
    """A studio under load: what it holds afterwards, and how long others wait meanwhile.

    2,000 reads that are broken off, 300 clients that send a request byte by byte and never end it,
    200 that listen for events, and 60 previews of 300 x 300 m, or a part of them.
    """
    with tempfile.TemporaryDirectory() as temporary:
        (big := Path(temporary) / "dense" / "big.bin").parent.mkdir()
        big.write_bytes(bytes(8 << 20))
        command = [sys.executable, "-m", "alice_survey", "studio", "-w", temporary, "--no-browser"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as studio:
            address, token = str(studio.stdout and studio.stdout.readline()).split()[4].split("?")
            port, cookie = int(address.split(":")[2].strip("/")), f"X-Studio-Token: {token[6:]}"
            process, waits_s, opened = psutil.Process(studio.pid), [], list[socket.socket]()

            def ask(path: str, body: str = "", end: str = "\r\n\r\n") -> socket.socket:
                kind = f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n"
                text = f"{'POST' if body else 'GET'} {path} HTTP/1.1\r\nHost: localhost\r\n"
                one = socket.create_connection(("127.0.0.1", port), timeout=120)
                one.sendall(f"{text}{kind * bool(body)}{cookie}{end}{body}".encode())
                return one

            preview_of = '{"changes": {"area": {"length_m": 300, "width_m": 300}}}'
            ask("/api/plan/preview", preview_of).recv(12)  # compiled and loaded
            time.sleep(5.0)
            files, resident = process.num_fds(), process.memory_info().rss
            for _ in range(2_000 // part):
                ask("/files/dense/big.bin").recv(1000)
            opened += [ask("/api/events", end="") for _ in range(300 // part)]
            opened += [ask("/api/events") for _ in range(200 // part)]
            opened += [ask("/api/plan/preview", preview_of) for _ in range(60 // part)]
            while opened:
                began_s = time.monotonic()
                ask("/app/core.js").recv(12)
                waits_s.append(time.monotonic() - began_s)
                time.sleep(0.25)
                opened = [one for one in opened if not select.select([one], [], [], 0)[0]]
            time.sleep(15.0)
            resident -= process.memory_info().rss
            found = (
                ("open files after the load, more than before", process.num_fds() - files, "", 2.0),
                ("memory after the load, more than before", -resident / 2**20, "MiB", 200.0),
                ("longest wait for a static file", max(waits_s), "s", 5.0),
            )
            studio.terminate()
    return [Figure(name=n, value=v, unit=u, goal=Goal(maximum=most)) for n, v, u, most in found]


if __name__ == "__main__":
    main()
