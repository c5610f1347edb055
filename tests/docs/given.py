"""Files that pages take for granted: made here, before a page's commands run."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path

from camera_calib.rig import read_rig, write_rig
from tests.docs import given_divers
from tests.docs import given_files as files
from tests.docs.pages import DOCS, script_of

MAX_S = 1200.0
TUTORIAL = "tutorial.md"
SMALL_PX = 282
"""Width of pictures that are brought along: small, so that they are soon reconstructed."""
FEW = (0, 1, 2, 3, 10, 11, 12)
"""Stations of a line of the tutorial's survey and of the one across it."""


class Made:
    """What takes long to make, made once and only on request."""

    def __init__(self, folder: Path) -> None:
        """Have a folder to make it in."""
        self._folder = folder
        self.run = cache(self._run)

    def _run(self, page: str) -> tuple[Path, subprocess.CompletedProcess[str]]:
        """Type the commands of a page; others may look at what they made, not change it.

        Returns:
            Where, and what came of it.
        """
        folder = self._folder / page.removesuffix(".md").replace("/", "-")
        folder.mkdir()
        prepare = GIVEN.get(page)
        if prepare is not None:
            prepare(folder, self)
        # A browser that does nothing.
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        ended = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script_of(DOCS / page)], cwd=folder,
            env={**os.environ, "PATH": path, "COLUMNS": "120", "BROWSER": "true"},
            capture_output=True, text=True, timeout=MAX_S,
        )  # fmt: skip
        return folder, ended

    def after(self, page: str) -> Path:
        """The folder that the commands of a page leave behind.

        Raises:
            RuntimeError: they fail; the page's own test shows how.
        """
        folder, ran = self.run(page)
        if ran.returncode != 0:
            raise RuntimeError(f"the commands of {page} fail")
        return folder

    @property
    def reef(self) -> Path:
        """The workspace of the tutorial, finished to its report."""
        return self.after(TUTORIAL) / "reef"

    @cached_property
    def small_rig(self) -> Path:
        """The rig of that survey for pictures of `SMALL_PX`."""
        path = self._folder / "small_rig.json"
        write_rig(path, files.smaller_rig(read_rig(self.reef / "calibration/rig.json"), SMALL_PX))
        return path

    @cached_property
    def pool(self) -> Path:
        """Pictures of a board in a pool."""
        files.boards(self._folder, air=False)
        return self._folder / "pool"

    @property
    def dive(self) -> Path:
        """A workspace of a few small pictures with rig and navigation, reconstructed."""
        return self.after("how-to/own-pictures.md") / "dive"


def _bring(folder: Path, *paths: Path) -> None:
    """Copy files and folders under their own names."""
    for path in paths:
        (shutil.copytree if path.is_dir() else shutil.copy)(path, folder / path.name)


def _reef(folder: Path, made: Made) -> None:
    # Settings name the area by a path relative to their workspace.
    _bring(folder, made.reef, made.reef.parent / "area.geojson")


def _cameras(folder: Path, made: Made) -> None:
    files.boards(folder, air=True)
    _bring(folder, made.pool)


def _certificate(folder: Path, made: Made) -> None:
    """Planned and flown as in the tutorial."""
    (folder / "reef").mkdir()
    _bring(folder / "reef", *(made.reef / name for name in ("survey.toml", "plan", "flight")))
    _bring(folder, made.reef.parent / "area.geojson")
    files.navigation(made.reef, folder / "dive.csv", dated=False)
    shutil.copy(made.reef / "flight/triggers.csv", folder / "t.csv")


def _logs(folder: Path, made: Made) -> None:
    files.vehicle_logs(made.reef, folder)
    files.photos(made.reef, folder / "photos", FEW, late_s=files.FAST_S)


def _few_features(folder: Path, colour: str = "even") -> None:
    """Settings for small pictures, in which nothing moves; a reader's need none."""
    settings = f"[reconstruct]\nmax_features = 600\nmask_moving = false\ncolour = '{colour}'\n"
    (folder / "survey.toml").write_text(settings)


def _stereo(folder: Path, made: Made) -> None:
    files.smaller(made.reef, {"left": folder / "cam1", "right": folder / "cam2"}, FEW, SMALL_PX)
    _few_features(folder)


def _own_camera(folder: Path, made: Made) -> None:
    _bring(folder, made.pool)
    for name, kind in (("camchain.yaml", "kalibr"), ("stereo.yml", "opencv")):
        files.calibrated_in_air(folder / name, kind)


def _own_vehicle(folder: Path, made: Made) -> None:
    files.vehicle_logs(made.reef, folder)
    files.own_logs(folder)
    (folder / "surveyed").mkdir()
    _bring(folder / "surveyed", made.reef / "survey.toml", made.reef / "plan")


def _identified(folder: Path, made: Made) -> None:
    files.own_logs(folder)
    (folder / "own.toml").write_text(files.OWN_VEHICLE)


def _own_pictures(folder: Path, made: Made) -> None:
    late_s = files.FAST_S
    for camera, name in (("left", "cam1"), ("right", "cam2")):
        files.photos(made.reef, folder / name, FEW, camera=camera, width_px=SMALL_PX, late_s=late_s)
    files.photos(made.reef, folder / "photos", FEW, late_s=late_s)
    files.photos(made.reef, folder / "shallow", FEW, gps=True)
    files.masks(folder / "photos", folder / "masks")
    files.navigation(made.reef, folder / "navigation.csv", dated=True)
    shutil.copy(made.small_rig, folder / "rig.json")
    given_divers.chapters(folder)
    given_divers.card(folder / "card")
    _few_features(folder, "water")


def _robots(folder: Path, made: Made) -> None:
    files.robot_bag(made.reef, folder / "dive.bag", FEW, SMALL_PX)
    shutil.copy(made.small_rig, folder / "rig.json")
    _few_features(folder)


def _colour_camera(folder: Path, made: Made) -> None:
    _bring(folder, made.dive, made.reef / "calibration/rig.json")
    _few_features(folder / "dive", "water")
    shutil.copytree(made.reef / "images/left", folder / "pictures")


def _big_survey(folder: Path, made: Made) -> None:
    before = made.after("how-to/own-pictures.md")
    for name, to in (("cam1", "left"), ("cam2", "right")):
        shutil.copytree(before / name, folder / to)
    lines = (before / "navigation.csv").read_text().splitlines(keepends=True)
    half = len(lines) // 2
    (folder / "dive1.csv").write_text("".join(lines[:half]))
    (folder / "dive2.csv").write_text("".join([lines[0], *lines[half:]]))
    shutil.copy(before / "rig.json", folder)
    _few_features(folder)


def _reconstruction(folder: Path, made: Made) -> None:
    _reef(folder, made)
    for side in ("left", "right"):
        (folder / side).mkdir()
        shutil.copy(made.reef / f"images/{side}/000005.png", folder / side)
    shutil.copy(made.reef / "calibration/rig.json", folder)


GIVEN: dict[str, Callable[[Path, Made], None]] = {
    "how-to/big-survey.md": _big_survey,
    "how-to/cluster.md": _reef,
    "how-to/colour-camera.md": _colour_camera,
    "how-to/measure.md": _reef,
    "how-to/no-navigation.md": _stereo,
    "how-to/other-programs.md": _reef,
    "how-to/own-camera.md": _own_camera,
    "how-to/own-pictures.md": _own_pictures,
    "how-to/own-vehicle.md": _own_vehicle,
    "how-to/robots.md": _robots,
    "cameras.md": _cameras,
    "certificate.md": _certificate,
    "logs.md": _logs,
    "reconstruction.md": _reconstruction,
    "identification.md": _identified,
    "studio.md": _reef,
}
"""By page."""
