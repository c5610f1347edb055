"""Ties by learned features between pictures that SIFT cannot tie.

Pictures of planned pairs without a SIFT geometry get learned features too. Those of a picture are
points of their own, after its SIFT features: a learned tie holds a picture in the model only where
its points are tied further. So the other pairs of a picture that gained one are matched too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.executor import Executor
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from reconstruct.matching.features import load_features, save_features
from reconstruct.matching.learned import RATIO, find_learned, match_learned
from reconstruct.matching.matches import PairMatches, PairTask
from reconstruct.pictures.normalise import normalise, read_deep
from reconstruct.pictures.undistorted import read_mask

_STEEP = np.sqrt(0.5)
"""Cosine of the largest angle from straight down at which a picture is turned by its heading."""


@dataclass(frozen=True, kw_only=True)
class Taken:
    """A picture and where its features are kept."""

    picture: Path
    mask: Path | None
    features: Path
    """Of SIFT."""
    maximum: int
    turns: int
    """Quarter turns that bring its north up, see `quarter_turns`."""

    @property
    def learned(self) -> Path:
        """File of its learned features."""
        return self.features.with_name(f"{self.features.stem}-learned.npz")


def with_learned(
    taken: Sequence[Taken],
    tasks: Sequence[PairTask],
    found: Sequence[PairMatches],
    executor: Executor,
) -> list[PairMatches]:
    """Matches with those of learned features added where SIFT found no geometry, and around.

    Args:
        taken: all pictures.
        tasks: planned pairs.
        found: what SIFT gives for each.
        executor: where tasks run.

    Returns:
        One for each pair; indices beyond a picture's SIFT features are of its learned ones.
    """
    number = {picture.features: i for i, picture in enumerate(taken)}
    pairs = [(number[task.first], number[task.second]) for task in tasks]
    open_ = [k for k, pair in enumerate(found) if pair.geometry is None]
    gained = _matched(taken, tasks, pairs, open_, executor)
    touched = {i for k in gained for i in pairs[k]}
    around = [k for k, pair in enumerate(pairs) if k not in set(open_) and touched & {*pair}]
    gained |= _matched(taken, tasks, pairs, around, executor)
    counts = {i: len(load_features(taken[i].features).pixels) for k in gained for i in pairs[k]}
    whole = list(found)
    for k, pair in gained.items():
        after = np.array([counts[i] for i in pairs[k]], np.uint32)
        matches = np.concatenate([found[k].matches, pair.matches + after])
        whole[k] = PairMatches(matches=matches, geometry=found[k].geometry or pair.geometry)
    return whole


def _matched(
    taken: Sequence[Taken],
    tasks: Sequence[PairTask],
    pairs: Sequence[tuple[int, int]],
    chosen: Sequence[int],
    executor: Executor,
) -> dict[int, PairMatches]:
    """Learned matches of some pairs, of those that have a geometry."""
    pictures = [taken[i] for i in sorted({i for k in chosen for i in pairs[k]})]
    list(executor.map(extract_learned, pictures, label="learned features"))
    learned = [
        replace(tasks[k], first=taken[i].learned, second=taken[j].learned, ratio=RATIO)
        for k in chosen
        for i, j in (pairs[k],)
    ]
    matched = executor.map(match_learned, learned, label="learned matches")
    return {k: m for k, m in zip(chosen, matched, strict=True) if m.geometry is not None}


def extract_learned(taken: Taken) -> None:
    """Find and save the learned features of one picture, unless they are there."""
    if taken.learned.exists():
        return
    grey = normalise(read_deep(taken.picture))
    mask = None if taken.mask is None else read_mask(taken.mask, (grey.shape[1], grey.shape[0]))
    save_features(taken.learned, find_learned(grey, mask, maximum=taken.maximum, turns=taken.turns))


def all_pixels(features: Sequence[Path]) -> list[Array]:
    """Keypoints of every picture, (N, 2): those of SIFT, then learned ones where there are any."""
    pixels = []
    for path in features:
        learned = path.with_name(f"{path.stem}-learned.npz")
        files = (path, learned) if learned.exists() else (path,)
        pixels.append(np.concatenate([load_features(file).pixels for file in files]))
    return pixels


def quarter_turns(record: ImageRecord, rig: Rig | None) -> int:
    """Quarter turns, counter-clockwise, after which a picture from above has north up.

    Adjacent lines are flown in opposite directions, and learned descriptors do not turn with the
    picture. A picture that looks level is not turned, nor one of unknown attitude. Without a rig
    the camera is taken to look straight down, its top to the bow: only differences count.
    """
    if not record.has_attitude:
        return 0
    attitude = np.deg2rad([record.roll_deg, record.pitch_deg, record.heading_deg])
    ned_from_body = RigidTransform.from_rotation(rotation_from_attitude(*attitude))
    mount = RigidTransform.from_rotation(BODY_FROM_NADIR_CAM)
    body_from_cam = mount if rig is None else rig.body_from_cam(record.camera)
    axes = (ned_from_body * body_from_cam).rotation.as_matrix()
    if axes[2, 2] < _STEEP:
        return 0
    up = -axes[:, 1]  # the picture's y points down
    return -round(float(np.arctan2(up[1], up[0])) / (np.pi / 2)) % 4
