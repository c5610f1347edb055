"""COLMAP models that were cut short or damaged."""

import struct
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import ReconstructionError, WorkspaceError
from alice_survey.core.frames import Datum
from reconstruct.views.model import WorldFrame, read_frame, write_frame
from reconstruct.views.model_files import read_reconstruction
from tests.reconstruct.scenes import make_scene
from tests.reconstruct.true_models import near_truth, warped_scene

NAMES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = make_scene(lines=1, stations=2, points=60)
    mapped = near_truth(scene, *warped_scene(scene), np.random.default_rng(1))
    mapped.model.write(tmp_path)
    return tmp_path


def test_a_whole_model_is_read(folder: Path) -> None:
    model = read_reconstruction(folder)
    assert len(model.images) == 4
    assert len(model.points3D) > 10


@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_is_missing_cut_or_longer_is_refused(folder: Path, name: str) -> None:
    whole = (folder / name).read_bytes()
    spoilt = [b"", whole[:7], whole[: len(whole) // 2], whole[:-1], whole + b"\0"]
    for data in spoilt:
        (folder / name).write_bytes(data)
        with pytest.raises(ReconstructionError, match=name):
            read_reconstruction(folder)
    (folder / name).unlink()
    with pytest.raises(ReconstructionError, match=name):
        read_reconstruction(folder)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [1 << 40, (1 << 64) - 1, 3_000_000_000])
def test_counts_beyond_the_file_are_not_followed(folder: Path, name: str, count: int) -> None:
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(struct.pack("<Q", count) + whole[8:])
    with pytest.raises(ReconstructionError, match=name):
        read_reconstruction(folder)


@pytest.mark.parametrize(
    ("old", "new"), [('"ned"', '"enu"'), ("46.5", "91"), ('"latitude_deg"', '"latitude"')]
)
def test_a_frame_that_was_changed_names_its_file(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "frame.json"
    datum = Datum(46.5, -91.5)
    frame = WorldFrame(name="ned", datum=datum, scaled=True, vertical_datum="sea", notes=("a",))
    write_frame(path, frame)
    assert read_frame(path) == frame
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(WorkspaceError, match=r"frame\.json"):
        read_frame(path)
