"""What a process keeps between the mosaic's tasks: lenses, small copies, a few pictures."""

import uuid
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reconstruct.mosaic.finish import curve_by_root
from reconstruct.mosaic.ortho import lanczos_weights
from reconstruct.mosaic.picture_measures import linear_table, read_small
from reconstruct.mosaic.visibility import CameraOptics, Water, camera_optics, channel_optics
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View

_CACHED_BYTES = 100_000_000
"""Pictures as taken that each process keeps."""
_SMALL_COPIES = 40
"""Small copies of pictures that each process keeps."""


@dataclass(frozen=True, kw_only=True)
class MosaicSetup:
    """What all tasks share; it travels to each process once a task."""

    workspace: Path
    scratch: Path
    """Folder of what is known of pictures."""
    dem: Path
    """The surface, in the frame of a plane."""
    sights: Path
    """Folder of what views see of it."""
    scaled: bool
    water: Water | None
    """Water of the port's dispersion; None where channels are not distinguished."""
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Distinguishes runs in a process that works for several: files may have changed."""


class Tools:
    """What a process keeps between tasks."""

    def __init__(self, survey: MosaicSetup) -> None:
        self._pictures = Pictures.still(survey.workspace)
        self.small = lru_cache(maxsize=_SMALL_COPIES)(partial(read_small, survey.scratch))
        self.table = linear_table()
        self.weights = lanczos_weights()
        self.curve = curve_by_root()
        self._water, self._scaled = survey.water, survey.scaled
        self._optics: dict[str, CameraOptics] = {}
        self._channels: dict[str, tuple[CameraOptics, ...]] = {}
        self._kept: dict[str, NDArray[np.uint8]] = {}

    def optics(self, view: View) -> CameraOptics:
        """Optics of a view's camera (its green channel)."""
        if view.camera not in self._optics:
            self._optics[view.camera] = camera_optics(self._pictures.warp(view.image), self._scaled)
        return self._optics[view.camera]

    def channels(self, view: View) -> tuple[CameraOptics, ...] | None:
        """Optics of a view's channels, BGR; None where they share one."""
        warp = self._pictures.warp(view.image)
        if self._water is None or warp.camera.n_water == 1:
            return None
        if view.camera not in self._channels:
            self._channels[view.camera] = channel_optics(warp, self._water, self._scaled)
        return self._channels[view.camera]

    def usable(self, image: str) -> NDArray[np.bool_] | None:
        """Mask of a picture as taken."""
        return self._pictures.usable(image)

    def picture(self, image: str) -> NDArray[np.uint8]:
        """A picture as taken; the last few stay in memory."""
        if image in self._kept:
            self._kept[image] = self._kept.pop(image)  # now the last to go
            return self._kept[image]
        taken = self._pictures.taken(image)
        while len(self._kept) >= max(1, _CACHED_BYTES // taken.nbytes):
            del self._kept[next(iter(self._kept))]
        self._kept[image] = taken
        return taken


@lru_cache(maxsize=1)
def tools_of(survey: MosaicSetup) -> Tools:
    """The tools of this process for a survey."""
    return Tools(survey)
