"""Which frames of a video to take: by how far the picture moved on, and the sharpest of these.

Motion from frame to frame is a similarity fitted to tracked corners. It is exact for a camera that
looks straight at a flat floor, and near enough elsewhere to say how much two frames share.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from reconstruct.pictures.quality import sharpness

Grey = NDArray[np.uint8]

_SMALL_PX = 320
"""Longer side of the pictures in which motion is measured."""
_NEAR, _FAR = 0.75, 1.25
"""Window of the next frame, by the wanted advance."""
_AT_START = 0.25
"""The first frame is the sharpest until the picture moved by this part of the wanted advance ..."""
_START_S = 1.0
"""... or for so long."""
_PATIENCE_S = 0.5
"""For how long a frame may be looked for that shows what was seen before."""
_DARK = 12.0
"""Mean grey level below which a frame is black."""
_CORNERS, _MIN_CORNERS, _MIN_TRACKED = 300, 20, 12
_TRACKED_SHARE, _INLIER_SHARE = 0.25, 0.5
"""Least share of corners that are tracked there and back, and of these that agree."""
_BACK_PX = 0.5
_INLIER_PX, _INLIER_OF_MOTION = 1.5, 0.25
"""How far a corner may be from the common motion: relief moves near ground more than far."""
_MIN_LIKENESS = 0.3
"""Correlation of two frames over each other: noise can be tracked too."""
_DETAIL_PX = (2.0, 8.0)
_MAX_ZOOM = 2.0
"""Change of size from one frame to the next beyond which their motion is not believed."""
_CROP_PX = (640, 480)
"""Middle of a frame in which its sharpness is measured: all of it would take too long."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One frame of a recording."""

    time_s: float
    """Since the start of the recording."""
    pixels: NDArray[np.uint8]
    """(H, W, 3) BGR."""


@dataclass(kw_only=True)
class FrameCounts:
    """What a choice met with."""

    seen: int = 0
    dark: int = 0
    """Black frames."""
    unfollowed: int = 0
    """Frames that show nothing of those before and after."""
    breaks_s: list[float] = field(default_factory=list)
    """When the picture changed at once: cuts, and turns too fast to follow."""


@dataclass(kw_only=True, eq=False)
class _SharpFrame:
    """A frame that may be taken."""

    frame: Frame
    sharpness: float = 0.0
    moved: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) from its pixels to those of the frame now, in the small picture."""


class OverlapChooser:
    """Take frames so that neighbours overlap by about a share; holds three frames at most.

    The next frame is the sharpest of those that moved on from the last by 0.75 to 1.25 of the
    wanted advance, `1 - overlap`. While nothing moves, none is taken. Where the picture changes at
    once, the choice begins again.
    """

    def __init__(self, overlap: float, counts: FrameCounts) -> None:
        """Choose for an overlap of neighbours, between 0 and 1; count what it meets with."""
        self.counts = counts
        self._advance = 1.0 - overlap
        self._small: Grey | None = None
        self._size = (0, 0)
        self._moved = np.eye(3)
        self._best: _SharpFrame | None = None
        self._before: _SharpFrame | None = None
        self._starting = True
        self._followed = 0
        self._start_s = self._last_s = 0.0

    def take(self, frame: Frame) -> Iterator[Frame]:
        """Frames that are certain to be taken once this one is known, in order."""
        self.counts.seen += 1
        small = shrunk(frame.pixels)
        if small.mean() < _DARK:
            self.counts.dark += 1
            return
        if self._small is None:
            self._begin(frame, small)
            return
        step = motion(self._small, small)
        if step is None:
            if frame.time_s - self._last_s < _PATIENCE_S:
                self.counts.unfollowed += 1
                return
            yield from self.rest()
            if self._followed > 1:
                self.counts.breaks_s.append(frame.time_s)
            self._begin(frame, small)
            return
        self._followed += 1
        self._small, self._last_s = small, frame.time_s
        self._moved = step @ self._moved
        for one in (self._best, self._before):
            if one is not None:
                one.moved = step @ one.moved
        yield from self._weigh(frame)

    def rest(self) -> Iterator[Frame]:
        """The frame that would come next, if there is one, when nothing follows."""
        if self._followed < 2:  # alone: it shows what no other frame shows
            self.counts.unfollowed += self._followed
            return
        last = self._best
        if (
            last is None
            and self._before is not None
            and self._motion_since() > _AT_START * self._advance
        ):
            last = self._before
        self._best = self._before = None
        if last is not None:
            yield last.frame

    def _begin(self, frame: Frame, small: Grey) -> None:
        self._small, self._moved = small, np.eye(3)
        self._size = (small.shape[1], small.shape[0])
        self._starting, self._followed = True, 1
        self._start_s = self._last_s = frame.time_s
        self._before = None
        self._best = _SharpFrame(frame=frame, sharpness=_sharpness(frame.pixels))

    def _motion_since(self) -> float:
        """Share of the picture that the last taken frame does not show."""
        return 1.0 - shared(self._moved, self._size)

    def _weigh(self, frame: Frame) -> Iterator[Frame]:
        gone = self._motion_since()
        near, far = _NEAR * self._advance, _FAR * self._advance
        if self._starting:
            near, far = 0.0, _AT_START * self._advance
        late = self._starting and frame.time_s - self._start_s > _START_S
        if gone > far or late:
            # With none in the window, the frame before it overlaps more: the picture moves fast.
            chosen = self._best or self._before or _SharpFrame(frame=frame)
            self._moved, self._best, self._before = chosen.moved, None, None
            self._starting = False
            yield chosen.frame
            if chosen.frame is not frame:
                yield from self._weigh(frame)
            return
        if gone < near:
            self._before = _SharpFrame(frame=frame)
            return
        sharp = _sharpness(frame.pixels)
        if self._best is None or sharp > self._best.sharpness:
            self._best = _SharpFrame(frame=frame, sharpness=sharp)


def shrunk(pixels: NDArray[np.uint8]) -> Grey:
    """The small grey picture in which motion is measured."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    factor = _SMALL_PX / max(grey.shape)
    if factor >= 1.0:
        return np.asarray(grey, np.uint8)
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _sharpness(pixels: NDArray[np.uint8]) -> float:
    """Sharpness of the middle of a frame, as the check of a survey's pictures measures it."""
    height, width = pixels.shape[:2]
    w, h = min(width, _CROP_PX[0]), min(height, _CROP_PX[1])
    x, y = (width - w) // 2, (height - h) // 2
    return sharpness(pixels[y : y + h, x : x + w])


def motion(before: Grey, after: Grey) -> Array | None:
    """The similarity from the pixels of one picture to those of the next.

    Corners are tracked by optical flow (Lucas and Kanade 1981) there and back; where that fails, it
    starts again from the shift that phase correlation finds (Kuglin and Hines 1975).

    Args:
        before: (H, W) grey.
        after: of the same size.

    Returns:
        (3, 3), or None where they have too little in common.
    """
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _MIN_CORNERS:
        return None
    found = _similarity(before, after, corners, np.zeros(2))
    if found is not None:
        return found
    window = cv2.createHanningWindow((before.shape[1], before.shape[0]), cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(before.astype(np.float32), after.astype(np.float32), window)
    return _similarity(before, after, corners, np.array(shift))


def _similarity(before: Grey, after: Grey, corners: Array, shift: Array) -> Array | None:
    start = np.float32(corners + shift)
    flow = {"winSize": (21, 21), "maxLevel": 4, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, start.copy(), **flow)
    back, kept, _ = cv2.calcOpticalFlowPyrLK(
        after, before, there, np.float32(there - shift), **flow
    )
    away = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = (seen.ravel() == 1) & (kept.ravel() == 1) & (away < _BACK_PX)
    if good.sum() < max(_MIN_TRACKED, _TRACKED_SHARE * len(corners)):
        return None
    lengths = np.linalg.norm((there - corners)[good].reshape(-1, 2), axis=1)
    near_px = max(_INLIER_PX, _INLIER_OF_MOTION * float(np.median(lengths)))
    found, inliers = cv2.estimateAffinePartial2D(
        corners[good], there[good], method=cv2.RANSAC, ransacReprojThreshold=near_px,
        confidence=0.999,
    )  # fmt: skip
    if found is None or inliers.sum() < _INLIER_SHARE * good.sum():
        return None
    zoom = float(np.hypot(found[0, 0], found[1, 0]))
    if not 1.0 / _MAX_ZOOM < zoom < _MAX_ZOOM:
        return None
    if likeness(before, after, found) < _MIN_LIKENESS:
        return None
    return np.vstack([found, [0.0, 0.0, 1.0]])


def likeness(before: Grey, after: Grey, moved: Array) -> float:
    """Correlation of the detail of two pictures where they overlap; near 0 for noise.

    Args:
        before: (H, W) grey.
        after: of the same size.
        moved: (2, 3) from the pixels of the one to those of the other.
    """
    size = (after.shape[1], after.shape[0])
    there = cv2.warpAffine(_detail(before), moved, size)
    inside = cv2.warpAffine(np.ones(before.shape, np.uint8), moved, size) > 0
    if inside.sum() < _MIN_TRACKED:
        return 0.0
    one, other = there[inside], _detail(after)[inside]
    scale = float(np.sqrt(np.mean(one**2) * np.mean(other**2)))
    return float(np.mean(one * other)) / scale if scale > 0 else 0.0


def _detail(grey: Grey) -> NDArray[np.float32]:
    """Detail of some pixels, without noise and uneven light."""
    levels = grey.astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(levels, (0, 0), sigma) for sigma in _DETAIL_PX)
    return np.asarray(fine - coarse, np.float32)


def shared(moved: Array, size: tuple[int, int]) -> float:
    """Share that two frames have in common, of the one that shows more.

    Args:
        moved: (3, 3) similarity from the pixels of the one to those of the other.
        size: width and height of both.
    """
    width, height = size
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    other = frame @ moved[:2, :2].T + moved[:2, 2]
    if not np.isfinite(other).all():
        return 0.0
    area, _ = cv2.intersectConvexConvex(np.float32(frame), np.float32(other))
    larger = width * height * max(1.0, float(np.linalg.det(moved[:2, :2])))
    return float(np.clip(area / larger, 0.0, 1.0))
