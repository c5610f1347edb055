"""Rendered surveys of any number of pictures, for benchmarks."""

import csv
import os
import re
import shutil
import subprocess
from importlib import resources
from pathlib import Path

from alice_survey.core.artefacts import read_stage, write_csv
from benchmarks.measured import python

_SIMULATED = ("plan", "fly", "image", "calibrate")


def render(workspace: Path, survey: str) -> None:
    """Plan, fly, take pictures of and calibrate a simulated survey; what is done is skipped."""
    workspace.mkdir(parents=True, exist_ok=True)
    settings = workspace / "survey.toml"
    if not settings.exists() or settings.read_text() != survey:
        settings.write_text(survey)
    for command in _SIMULATED:
        subprocess.run(
            python("-m", "alice_survey", command, "-w", str(workspace)),
            check=True,
            stdout=subprocess.DEVNULL,
        )


def survey_toml(pictures: int, scale: int) -> str:
    """Settings of a survey like the demo's that gives at least a number of pictures.

    Args:
        pictures: of both cameras.
        scale: divides the camera's resolution.
    """
    side = (1.1 * pictures / 116) ** 0.5  # the demo has 116 pictures of 4.5 x 3.7 m; and a margin
    return demo_like(4.5 * side + 0.6, 3.7 * side + 0.6, scale)


def demo_like(length_m: float, width_m: float, scale: int = 4) -> str:
    """Settings of the demo, over an area of another size."""
    text = (resources.files("alice_survey") / "demo.toml").read_text()
    for name, value in (("length_m", length_m), ("width_m", width_m), ("scale", scale)):
        text, count = re.subn(rf"(?m)^{name} = .*$", f"{name} = {value:.6g}", text)
        assert count == 1, name
    return text


def subset(whole: Path, part: Path, pictures: int) -> Path:
    """The first stations of a survey as a workspace of its own, its pictures linked.

    Args:
        whole: workspace whose pictures are rendered.
        part: to make; emptied first.
        pictures: of both cameras; an even number.

    Returns:
        `part`.

    Raises:
        SystemExit: the survey has fewer pictures.
    """
    if part.exists():
        shutil.rmtree(part)
    images = part / "images"
    images.mkdir(parents=True)
    with (whole / "images" / "manifest.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    if len(rows) < pictures:
        raise SystemExit(f"{whole} has {len(rows)} pictures; {pictures} are requested")
    stations = sorted({int(row["station"]) for row in rows})[: pictures // 2]
    rows = [row for row in rows if int(row["station"]) in set(stations)]
    write_csv(images / "manifest.csv", list(rows[0]), ([*row.values()] for row in rows))
    for row in rows:
        target = images / row["image"]
        target.parent.mkdir(exist_ok=True)
        os.link((whole / "images" / row["image"]).resolve(), target)
    for name in ("survey.json", "stage.json"):
        shutil.copyfile(whole / "images" / name, images / name)
    (images / "truth").symlink_to((whole / "images" / "truth").resolve())
    for stage in ("plan", "calibration"):
        if read_stage(whole / stage) is not None:
            (part / stage).symlink_to((whole / stage).resolve())
    shutil.copyfile(whole / "survey.toml", part / "survey.toml")
    return part


def pictures_of(workspace: Path, folder: Path) -> Path:
    """The pictures alone, linked into a folder for programs that read all files of one."""
    with (workspace / "images" / "manifest.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            target = folder / row["image"]
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link((workspace / "images" / row["image"]).resolve(), target)
    return folder
