"""The camera track of a workspace as arrays."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.contents import taken_from
from alice_survey.core.frames import Array
from reconstruct.placing.track import read_track_poses
from reconstruct.views.model import WorldFrame, read_frame


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Track:
    """Positions of the registered pictures, with their covariances.

    Example:
        >>> import alice_survey as alice
        >>> track = alice.Survey("small").track
        >>> len(track.images) == len(track.world_from_cam)
        True
    """

    images: tuple[str, ...]
    """(N,) names as in the manifest."""
    world_from_cam: RigidTransform
    """(N,) poses of the entrance pupils, RDF camera to the model's frame."""
    frame: WorldFrame
    """Frame of the coordinates: `ned` in metres, or the model's own."""
    covariance: Array | None
    """(N, 6, 6) of position in the frame (metres) and of a small turn about its axes (radians);
    None where it was not estimated."""

    @property
    def sigma(self) -> Array | None:
        """(N, 3) standard deviations of the positions."""
        if self.covariance is None:
            return None
        sigma: Array = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, :3])
        return sigma

    def __repr__(self) -> str:
        text = f"track: {len(self.images)} pictures in the frame '{self.frame.name}'"
        if self.sigma is not None:
            text += f", median position sigma {np.median(self.sigma):.3g} {self.frame.unit}"
        return text

    def _repr_html_(self) -> str:
        title, _, text = repr(self).partition(": ")
        return f"<b>{title}</b>: {text}"


def read_track(workspace: str | Path) -> Track:
    """Read the camera track of a reconstructed workspace.

    Args:
        workspace: its folder.

    Raises:
        WorkspaceError: there is no track, or a file is damaged.

    Example:
        >>> import alice_survey as alice
        >>> alice.read_track("small").covariance.shape[1:]
        (6, 6)
    """
    folder = Path(workspace) / "sparse"
    poses = read_track_poses(folder / "track.csv")
    images = tuple(sorted(poses))
    return Track(
        images=images,
        world_from_cam=RigidTransform.concatenate([poses[name] for name in images]),
        frame=read_frame(folder / "frame.json"),
        covariance=_covariance(folder / "track_covariance.npz", images),
    )


def _covariance(path: Path, images: tuple[str, ...]) -> Array | None:
    if not path.is_file():
        return None
    with taken_from(path), np.load(path) as stored:
        row = {str(name): i for i, name in enumerate(stored["image"])}
        rows: Array = stored["covariance"][[row[name] for name in images]]
    return rows
