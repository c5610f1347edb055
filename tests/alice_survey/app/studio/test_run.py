"""The command: a mosaic of 1 Gpx in little memory, Ctrl-C, and what it refuses to start with."""

import io
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.transform import Affine
from rasterio.windows import Window
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.app.studio.server import ADDRESS, Server
from tests.alice_survey.app.report.tiny import tiny_workspace

SIDE = 32_768
MAX_GROWTH_MIB = 180
"""Seen: 87. While it is served; the elevation model alone has 4096 MiB, the mosaic as many."""


def large_workspace(folder: Path) -> Path:
    """A survey of 164 m by 164 m at 5 mm, of which a few spots are known."""
    workspace = tiny_workspace(folder)
    profile = {
        "driver": "GTiff", "width": SIDE, "height": SIDE, "tiled": True, "blockxsize": 512,
        "blockysize": 512, "sparse_ok": True, "compress": "deflate", "bigtiff": "yes",
        "transform": Affine(0.005, 0, 0, 0, -0.005, 164),
    }  # fmt: skip
    dem, mosaic = workspace / "dense" / "dem.tif", workspace / "mosaic" / "mosaic.tif"
    rows = np.arange(512, dtype=np.float32)[:, None]
    patch = np.broadcast_to(rows / 512 - 10, (512, 512))
    with rasterio.open(dem, "w", count=1, dtype="float32", nodata=np.nan, **profile) as raster:
        for at in (0, 10_240, 18_944):
            raster.write(patch, 1, window=Window(at, at, 512, 512))
    seen = np.full((4, 512, 512), 200, np.uint8)
    seen[3] = 255
    with rasterio.open(
        mosaic, "w", count=4, dtype="uint8", photometric="RGB", alpha="YES", **profile
    ) as raster:
        raster.write(seen, window=Window(10_240, 10_240, 512, 512))
    return workspace


def max_mib(process: int) -> float:
    text = Path(f"/proc/{process}/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", text)
    assert found is not None
    return int(found.group(1)) / 1024


def loaded(address: str, token: str) -> bytes:
    asked = urllib.request.Request(address, headers={"X-Studio-Token": token})  # noqa: S310
    with urllib.request.urlopen(asked, timeout=60) as answer:  # noqa: S310
        content: bytes = answer.read()
    return content


@pytest.mark.slow
def test_a_large_raster_in_little_memory_until_ctrl_c(tmp_path: Path) -> None:
    workspace = large_workspace(tmp_path / "reef")
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    started = subprocess.Popen(
        [sys.executable, "-m", "alice_survey", "studio", "-w", str(workspace), "--no-browser"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={"TMPDIR": str(temporary), "PATH": ""},
    )  # fmt: skip
    try:
        assert started.stdout is not None
        line = started.stdout.readline()
        url, token = line.split(" is shown at ")[1].split()[0].split("?token=")
        assert url.startswith(f"http://{ADDRESS}:")
        loaded(f"{url}tiles/sigma/0/0/0.webp", token)  # what it needs anyway is loaded
        before = max_mib(started.pid)
        for spot, expected in {
            "dem/6/1/0": 0, "dem/6/0/0": 512**2, "dem/6/37/37": 512**2,
            "dem/5/10/10": 256**2, "dem/3/2/2": 64**2, "dem/1/0/0": 2 * 16**2,
            "dem/0/0/0": 3 * 8**2, "mosaic/6/20/20": 512**2, "mosaic/4/5/5": 128**2,
        }.items():  # fmt: skip
            with Image.open(io.BytesIO(loaded(f"{url}tiles/{spot}.webp", token))) as tile:
                opaque = np.asarray(tile.convert("RGBA"))[..., 3] == 255
            # A level covers the whole raster, so that coarse pixels are not quite 2**h wide.
            assert (spot, opaque.sum()) == (spot, pytest.approx(expected, rel=0.3))
        assert b"/tiles/dem/{}.webp" in loaded(f"{url}api/map", token)
        grown = max_mib(started.pid) - before
        started.send_signal(signal.SIGINT)
        out, shown = started.communicate(timeout=20)
    finally:
        started.kill()
    assert (started.returncode, out, shown) == (130, "", "interrupted\n")
    assert list(temporary.iterdir()) == []
    assert grown < MAX_GROWTH_MIB
    with pytest.raises(OSError):  # the port is closed
        socket.create_connection((ADDRESS, int(url.rsplit(":", 1)[1].strip("/"))), timeout=2)


def test_a_port_that_is_taken(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    with socket.create_server((ADDRESS, 0)) as taken:
        port = taken.getsockname()[1]
        done = CliRunner().invoke(app, ["studio", "-w", str(workspace), "--port", str(port)])
    assert done.exit_code == 1
    assert str(port) in str(done.exception) and "--port" in str(done.exception)


def test_it_cannot_be_reached_from_another_machine(tmp_path: Path) -> None:
    server = Server(tiny_workspace(tmp_path))
    assert server.socket.getsockname()[0] == "127.0.0.1"
    assert server.socket.family == socket.AF_INET
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", server.port), timeout=2)
    server.close()
