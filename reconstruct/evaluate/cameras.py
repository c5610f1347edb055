"""How well the cameras of a simulated survey were placed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.evaluate.figures import rms
from reconstruct.placing.alignment import align_rigid, align_similarity


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraScore:
    """How well the cameras were placed."""

    registered: int
    total: int
    truth_from_world: RigidTransform
    """The rigid alignment; the surface and the mosaic are moved by it too."""
    names: tuple[str, ...]
    positions_ned: Array
    """(N, 3) aligned entrance pupils."""
    misses_m: Array
    """(N, 3) aligned minus true position, north, east, down."""
    turns_deg: Array
    """(N,) angle between aligned and true attitude."""
    scale_error: float
    """Scale of a similarity alignment minus one, sign as of the model: positive when too large."""
    georeference_m: Array
    """(3,) mean miss before the alignment, north, east, down."""

    @property
    def rms_m(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt((self.misses_m**2).sum(axis=1).mean()))

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres, degrees and parts per million."""
        return {
            "registered": self.registered,
            "total": self.total,
            "rms_mm": round(1e3 * self.rms_m, 3),
            "max_mm": round(1e3 * float(np.linalg.norm(self.misses_m, axis=1).max()), 3),
            "rms_north_east_down_mm": [
                round(1e3 * rms(self.misses_m[:, axis]), 3) for axis in range(3)
            ],
            "attitude_rms_deg": round(rms(self.turns_deg), 4),
            "scale_error_ppm": round(1e6 * self.scale_error, 1),
            "georeference_north_east_down_m": [round(float(m), 4) for m in self.georeference_m],
        }


@progress.step("score the cameras")
def score_cameras(
    estimated: Mapping[str, RigidTransform], truth: Mapping[str, RigidTransform], total: int
) -> CameraScore:
    """Compare entrance pupils with the true poses of a simulated survey.

    Args:
        estimated: `world_from_cam` by picture, in metres.
        truth: `ned_from_cam` by picture.
        total: how many pictures there are.

    Raises:
        WorkspaceError: fewer than three pictures are registered.
    """
    names = tuple(sorted(estimated))
    if len(names) < 3:
        raise WorkspaceError(f"{len(names)} registered pictures; 3 or more are needed to align")
    found = np.stack([estimated[name].translation for name in names])
    true = np.stack([truth[name].translation for name in names])
    alignment = align_rigid(found, true)
    similarity = align_similarity(found, true)
    turns = [
        (truth[n].rotation.inv() * alignment.rotation * estimated[n].rotation).magnitude()
        for n in names
    ]
    return CameraScore(
        registered=len(names),
        total=total,
        truth_from_world=alignment,
        names=names,
        positions_ned=alignment.apply(found),
        misses_m=alignment.apply(found) - true,
        turns_deg=np.rad2deg(turns),
        scale_error=1.0 / similarity.scale - 1.0,
        georeference_m=(found - true).mean(axis=0),
    )
