"""Learned features (XFeat) and their matches: for pairs of little texture that SIFT cannot tie.

The network of Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR
2024, with the authors' weights (`xfeat/README.md`), is run by OpenCV. It gives, for every 8 x 8
pixels, a descriptor, how reliable it is, and where among the 64 pixels a keypoint lies, if any.
The picture's size decides all shapes, no sum depends on the number of threads: the same picture
gives the same bytes.

Pictures of planned pairs without a SIFT geometry get learned features too. Those of a picture are
points of their own, after its SIFT features: a learned tie holds a picture in the model only where
its points are tied further. So the other pairs of a picture that gained one are matched too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from alice_survey.core.executor import Executor
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from reconstruct.matching.features import (
    Features,
    clear_of_mask,
    load_features,
    save_features,
    spread,
)
from reconstruct.matching.matches import (
    PairMatches,
    PairTask,
    as_seen,
    kept_features,
    match_descriptors,
    verify,
)
from reconstruct.pictures.normalise import normalise, read_deep
from reconstruct.pictures.undistorted import read_mask

RATIO = 0.85
"""Largest distance of a match over that of the second nearest."""
_MAX_PX = 1.5e6
"""Pixels to which a larger picture is reduced, as for SIFT."""
_MAX_SIDE_PX = 2.0
"""Small pictures are enlarged by up to this much, as SIFT doubles them."""
_MAX_FALSE_ALARMS = 1e-3
"""Expected number of pairs of unrelated pictures, for each pair, that would agree as well."""
_MAX_ERROR_PX = 4.0
"""Distance from an epipolar line up to which a match agrees: COLMAP's."""
_STILL = 0.02
"""Share of a picture's longer side by which a match must move from picture to picture."""
_FREE = 7
"""Matches that fix an epipolar geometry, and agree with it whatever they are."""
_CELL = 8
"""Pixels along the side of a cell."""
_STEP = 32
"""What width and height are multiples of: the coarsest layer has one value for so many pixels."""
_MIN_SCORE = 0.05
"""Least probability of a keypoint times reliability. The authors ask this of the probability alone:
in turbid water the doubtful keypoints that this adds give wrong ties, and few right ones."""
_APART = 5
"""Side of the window in which a keypoint is the most probable."""
_SUPPORT_PX = 16.0
"""How far a mask must stay away from a keypoint: what a descriptor sees most of."""
_LEVELS = 256.0
"""Byte steps for one unit of a descriptor; components of unit vectors beyond a half are rare."""
_EPSILON = 1e-5

Floats = NDArray[np.float32]


def find_learned(
    grey: NDArray[np.uint8], mask: NDArray[np.bool_] | None, *, maximum: int, turns: int = 0
) -> Features:
    """Find learned features, evenly over a picture.

    Args:
        grey: (H, W) normalised picture.
        mask: (H, W) where features may be, or None.
        maximum: how many to keep.
        turns: quarter turns, counter-clockwise, by which the picture is turned first: descriptors
            of one spot resemble each other only when seen less than about 45 degrees turned.

    Returns:
        Keypoints with descriptors of 64 bytes, distances of which are those of XFeat's unit
        vectors times a constant; `scale_px` is the side of a cell.
    """
    if turns % 4:
        rest = None if mask is None else np.ascontiguousarray(np.rot90(mask))
        turned = find_learned(
            np.ascontiguousarray(np.rot90(grey)), rest, maximum=maximum, turns=turns - 1
        )
        # what has become the row was counted from the right
        back = np.column_stack([grey.shape[1] - turned.pixels[:, 1], turned.pixels[:, 0]])
        return replace(turned, pixels=back)
    height, width = grey.shape
    by = min(_MAX_SIDE_PX, math.sqrt(_MAX_PX / (width * height)))
    size = [max(_STEP, round(side * by / _STEP) * _STEP) for side in (width, height)]
    way = cv2.INTER_AREA if size[0] < width else cv2.INTER_CUBIC
    descriptors, likely, reliable = dense_features(cv2.resize(grey, size, interpolation=way))
    score = likely * reliable
    highest = cv2.dilate(score, np.ones((_APART, _APART), np.uint8))
    rows, columns = np.nonzero((score == highest) & (score > _MIN_SCORE))
    steps = np.array([width / size[0], height / size[1]])
    pixels = (np.column_stack([columns, rows]) + 0.5) * steps
    strength = score[rows, columns].astype(np.float64)
    usable = clear_of_mask(pixels, mask, _SUPPORT_PX * steps.mean())
    sizes = np.full(len(usable), _CELL * steps.mean())
    chosen = usable[spread(pixels[usable], sizes, strength[usable], (width, height), maximum)]
    there = (np.column_stack([columns, rows])[chosen] + 0.5) / _CELL - 0.5
    found = sample(descriptors, there)
    found = found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), _EPSILON)
    return Features(
        pixels=pixels[chosen],
        scale_px=np.full(len(chosen), _CELL * steps.mean(), np.float32),
        descriptors=np.clip(np.rint(128.0 + _LEVELS * found), 0, 255).astype(np.uint8),
    )


def match_learned(task: PairTask) -> PairMatches:
    """As `match_pair`, of learned features, guarded against chance and against what stays.

    Backscatter, vignette and dirt on the port are at one place in all pictures; in very turbid
    water little else is seen. Matches that do not move are left out: of a sea floor that does not
    move they would say nothing either.
    Where nothing stands out, matches are many and mostly false, and the best geometry of many false
    matches explains enough of them to pass: `false_alarms` says how likely that is.
    """
    a, b = kept_features(task.first), kept_features(task.second)
    matches = match_descriptors(a.descriptors, b.descriptors, task.ratio)
    seen = as_seen(a.pixels, task.warps[0]), as_seen(b.pixels, task.warps[1])
    width, height = (task.cameras[1][side] for side in ("width", "height"))
    way = np.linalg.norm(b.pixels[matches[:, 1]] - a.pixels[matches[:, 0]], axis=1)
    matches = matches[way > _STILL * max(width, height)]
    pair = verify(task, seen, matches)
    if pair.geometry is not None and (
        false_alarms(len(pair.matches), len(matches), (width, height)) > _MAX_FALSE_ALARMS
    ):
        return PairMatches(matches=matches[:0], geometry=None)
    return pair


def false_alarms(agreeing: int, matches: int, size: tuple[int, int]) -> float:
    """How many epipolar geometries of random matches are expected to explain as many of them.

    Moisan & Stival, "A probabilistic criterion to detect rigid point matches between two images",
    IJCV 57 (2004), eq. 10: (n - 7) C(n, k) C(k, 7) p^(k - 7), where p = 2 D e / A bounds the share
    of a picture of diagonal D and area A within e of a line.

    Args:
        agreeing: matches that one geometry explains.
        matches: all of them.
        size: width and height of the second picture.
    """
    if agreeing <= _FREE:
        return math.inf
    share = min(1.0, 2.0 * math.hypot(*size) * _MAX_ERROR_PX / (size[0] * size[1]))
    logarithm = math.log(matches - _FREE) + (agreeing - _FREE) * math.log(share)
    for n, k in ((matches, agreeing), (agreeing, _FREE)):
        logarithm += math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
    return math.exp(min(logarithm, 700.0))


def dense_features(grey: NDArray[np.uint8]) -> tuple[Floats, Floats, Floats]:
    """Descriptors of all cells, keypoints and reliability of all pixels.

    Args:
        grey: (H, W), both multiples of 32.

    Returns:
        (H / 8, W / 8, 64) unit vectors; (H, W) probabilities that a pixel is its cell's keypoint, a
        softmax over 64 pixels and "none"; (H, W) reliability of the descriptor there.
    """
    height, width = grey.shape
    rows, columns = height // _CELL, width // _CELL
    even = grey.astype(np.float32)
    even = (even - even.mean()) / np.sqrt(even.var() + np.float32(_EPSILON))
    blocks = even.reshape(rows, _CELL, columns, _CELL).transpose(1, 3, 0, 2)
    network = _network()
    network.setInput(even[None, None], "picture")
    network.setInput(np.ascontiguousarray(blocks.reshape(1, -1, rows, columns)), "blocks")
    found, logits, reliable = network.forward(["descriptors", "logits", "reliability"])
    found = found[0].transpose(1, 2, 0)
    found = found / np.maximum(np.linalg.norm(found, axis=2, keepdims=True), _EPSILON)
    logits = np.exp(logits[0] - logits[0].max(axis=0))
    likely = (logits / logits.sum(axis=0))[: _CELL * _CELL].reshape(_CELL, _CELL, rows, columns)
    likely = likely.transpose(2, 0, 3, 1).reshape(height, width)
    smooth = cv2.resize(reliable[0, 0], (width, height), interpolation=cv2.INTER_LINEAR)
    return found, likely, smooth


def sample(field: Floats, at: Array) -> Array:
    """Values (N, C) of a field (H, W, C) at places (N, 2), x and y, bilinear; held at its rim."""
    where = np.broadcast_arrays(at[:, 1:], at[:, :1], np.arange(field.shape[2]))
    return map_coordinates(field, where, np.float64, order=1, mode="nearest")


@lru_cache(maxsize=1)
def _network() -> cv2.dnn.Net:
    model = resources.files("reconstruct.matching").joinpath("xfeat/xfeat.onnx").read_bytes()
    return cv2.dnn.readNetFromONNX(np.frombuffer(model, np.uint8))


_STEEP = np.sqrt(0.5)
"""Cosine of the largest angle from straight down at which a picture is turned by its heading."""


@dataclass(frozen=True, kw_only=True)
class Taken:
    """A picture whose features are sought, and where they are kept."""

    picture: Path
    mask: Path | None
    features: Path
    """Of SIFT."""
    maximum: int
    turns: int
    """Quarter turns that bring its north up, see `quarter_turns`."""
    thrifty: bool = False
    """Look for SIFT where there are enough first, see `detection_scales`."""

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

    def match(chosen: Sequence[int]) -> dict[int, PairMatches]:
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

    gained = match([k for k, pair in enumerate(found) if pair.geometry is None])
    touched = {i for k in gained for i in pairs[k]}
    tied = [k for k, pair in enumerate(found) if pair.geometry is not None]
    gained |= match([k for k in tied if touched & {*pairs[k]}])
    counts = {i: len(load_features(taken[i].features).pixels) for k in gained for i in pairs[k]}
    whole = list(found)
    for k, pair in gained.items():
        after = np.array([counts[i] for i in pairs[k]], np.uint32)
        matches = np.concatenate([found[k].matches, pair.matches + after])
        whole[k] = PairMatches(matches=matches, geometry=found[k].geometry or pair.geometry)
    return whole


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
    mount = BODY_FROM_NADIR_CAM if rig is None else rig.body_from_cam(record.camera).rotation
    axes = (record.ned_from_body * mount).as_matrix()
    if axes[2, 2] < _STEEP:
        return 0
    up = -axes[:, 1]  # the picture's y points down
    return -round(float(np.arctan2(up[1], up[0])) / (np.pi / 2)) % 4
