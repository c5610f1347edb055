"""The sparse model as the later stages see it: views through ideal pinholes, and points."""

import copyreg
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.contents import Location, in_workspace, taken_from
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import CamerasRecord, FrameRecord, PlaceRecord
from alice_survey.kit.words import count
from camera_calib.approximation.pinhole_warp import Pinhole, PinholeWarp, warp_from_json
from reconstruct.views.range_shift import KernelLens, RangeShift, carry, no_shift, range_shift

MEAN_PLANE = "mean plane of the sea floor in the pictures"
"""Vertical datum of a model that its own surface puts level."""
_ENU_FROM_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, kw_only=True)
class WorldFrame:
    """What the coordinates of a model mean. The third axis points down in every frame."""

    name: Literal["ned", "model", "plane"]
    """`ned`: north, east, down from the datum; `model`: arbitrary origin and heading, levelled;
    `plane`: of a plane in one of these (`reconstruct.planes`)."""
    datum: Datum | None
    scaled: bool
    """Whether lengths are metres."""
    vertical_datum: str
    """Name of the level from which depths and heights count."""
    notes: tuple[str, ...] = ()
    """What a reader of any result must know, such as where the scale came from."""
    tags: tuple[tuple[str, str], ...] = ()
    """Names and values that its rasters carry besides."""

    @property
    def unit(self) -> str:
        """Name of the unit of length for labels."""
        return "m" if self.scaled else "model units"


def as_given(matrix: Array) -> RigidTransform:
    """A transform of a matrix (4, 4), to the last bit."""
    return RigidTransform(matrix, normalize=False)


# scipy normalizes what it unpickles, which changes last bits: a task would not compute the same in
# another process.
copyreg.pickle(RigidTransform, lambda one: (as_given, (one.as_matrix(),)))


@dataclass(frozen=True, kw_only=True)
class View:
    """One registered picture, as an ideal pinhole sees it.

    Example:
        >>> import alice_survey as alice
        >>> model = alice.Survey("small").model
        >>> model.views[0].project(model.points_world).shape == (len(model.points_world), 2)
        True
    """

    image: str
    """Name in the manifest."""
    camera: str
    station: int
    pinhole: Pinhole
    world_from_cam: RigidTransform
    shift: RangeShift
    """What the warp of the picture leaves of the port's refraction."""

    def __repr__(self) -> str:
        return f"view: {self.image}, station {self.station}"

    def project(self, points_world: Array) -> Array:
        """Pixels (N, 2) at which the warped picture shows points (N, 3); NaN behind the camera."""
        points = self.world_from_cam.inv().apply(points_world)
        return self.shift.warp(self.pinhole.project(points), points[:, 2])

    def at_depth(self, pixels: Array, depth: Array) -> Array:
        """World points (N, 3) that the warped picture shows at pixels (N, 2) and depths (N,)."""
        slopes = self.pinhole.slopes(self.shift.ideal(pixels, depth))
        points = np.column_stack([slopes * depth[:, None], depth])
        return np.asarray(self.world_from_cam.apply(points))

    def show_in(self, other: "View", pixels: Array, depth: NDArray[Any]) -> Array:
        """What pixels (N, 2) show at depths (N,) in another view: pixels and depths there, (N, 3).

        A row is NaN behind the other camera.
        """
        move = (other.world_from_cam.inv() * self.world_from_cam).as_matrix()[:3]
        lenses = self.kernel_lens, np.ascontiguousarray(move), other.kernel_lens
        return carry(pixels, depth.astype(np.float64), *lenses)

    @property
    def kernel_lens(self) -> KernelLens:
        """Pinhole and shift as kernels take them."""
        return self.pinhole.numbers, self.shift.field, self.shift.inverse_working


@dataclass(frozen=True, kw_only=True, eq=False)
class SparseModel:
    """Registered views and triangulated points, in one world frame.

    Example:
        >>> import alice_survey as alice
        >>> model = alice.Survey("small").model
        >>> model.points_world.shape[1]
        3
    """

    frame: WorldFrame
    views: tuple[View, ...]
    """Sorted by image name."""
    points_world: Array
    """(P, 3) points in the world."""
    observations: NDArray[np.int64]
    """(O, 2) rows of point index and view index."""

    def __repr__(self) -> str:
        views, points = count(len(self.views), "view"), count(len(self.points_world), "point")
        return f"model: {views}, {points} in the frame '{self.frame.name}'"


def write_frame(path: Path, frame: WorldFrame) -> None:
    """Write `frame.json`.

    Raises:
        ValueError: it is a plane's, which `plane.json` describes.
    """
    if frame.name == "plane":
        raise ValueError(f"{path}: frame.json describes a model, not {frame.vertical_datum}")
    datum = frame.datum
    FrameRecord(
        name=frame.name,
        datum=None if datum is None else PlaceRecord(**asdict(datum)),
        scaled=frame.scaled,
        vertical_datum=frame.vertical_datum,
        notes=frame.notes,
    ).write(path)


def read_frame(path: Path) -> WorldFrame:
    """Read `frame.json`.

    Raises:
        WorkspaceError: it is missing, or not as it was written.
    """
    stored = FrameRecord.read(path)
    return WorldFrame(
        name=stored.name,
        datum=None if stored.datum is None else datum_of(stored.datum),
        scaled=stored.scaled,
        vertical_datum=stored.vertical_datum,
        notes=stored.notes,
    )


def datum_of(place: PlaceRecord) -> Datum:
    """The datum that a file of a workspace names."""
    return Datum(place.latitude_deg, place.longitude_deg, place.height_m)


def read_warps(path: Path) -> dict[str, PinholeWarp]:
    """The cameras of a `cameras.json` and their pinholes, by name.

    Raises:
        WorkspaceError: it is missing, or a camera is wrong.
    """
    stored = CamerasRecord.read(path).cameras
    with taken_from(path):
        return {name: warp_from_json(warp) for name, warp in stored.items()}


def read_model(sparse: Location) -> SparseModel:
    """Read the model of a finished `sparse/` stage, or of a workspace.

    Raises:
        WorkspaceError: a file is missing, or not as it was written.
        ReconstructionError: the model is damaged.

    Example:
        >>> import alice_survey as alice
        >>> alice.read_model("small/sparse").frame.name
        'ned'
    """
    sparse = in_workspace(sparse, "sparse")
    from reconstruct.views.model_files import read_reconstruction

    stored = CamerasRecord.read(sparse / "cameras.json")
    frame = read_frame(sparse / "frame.json")
    model = read_reconstruction(sparse / "model")
    with taken_from(sparse / "cameras.json"):
        return _model(stored, frame, model)


def _model(stored: CamerasRecord, frame: WorldFrame, model: Any) -> SparseModel:
    from reconstruct.views.model_files import as_transform, stored_of

    warps = {name: warp_from_json(warp) for name, warp in stored.cameras.items()}
    # Without lengths in metres a port's shift is not known.
    shifts = {
        name: range_shift(warp) if frame.scaled else no_shift(*warp.pinhole.size_px)
        for name, warp in warps.items()
    }
    images = sorted(
        (i for i in model.images.values() if i.has_pose), key=lambda image: str(image.name)
    )
    views = []
    for image in images:
        record = stored.images[image.name]
        views.append(
            View(
                image=image.name,
                camera=record.camera,
                station=record.station,
                pinhole=warps[record.camera].pinhole,
                world_from_cam=as_transform(image.cam_from_world()).inv(),
                shift=shifts[record.camera],
            )
        )
    kept = stored_of(model)
    seen = [at[at >= 0] for at in (kept.keypoints[i.image_id]["point"] for i in images)]
    points = np.searchsorted(kept.point_ids, np.concatenate([kept.point_ids[:0], *seen]))
    numbers = np.repeat(np.arange(len(seen)), [len(one) for one in seen])
    order = np.lexsort((numbers, points))
    return SparseModel(
        frame=frame,
        views=tuple(views),
        points_world=kept.points,
        observations=np.column_stack([points[order], numbers[order]]),
    )


def points_of_views(model: SparseModel) -> list[Array]:
    """World coordinates (N, 3) of the sparse points that each view observed."""
    order = np.argsort(model.observations[:, 1], kind="stable")
    points, views = model.observations[order].T
    starts = np.searchsorted(views, np.arange(1, len(model.views)))
    return [model.points_world[seen] for seen in np.split(points, starts)]


def scaled_view(view: View, scale: float) -> View:
    """The same view in a picture shrunk by a factor (1 keeps it)."""
    if scale == 1.0:
        return view
    old = view.pinhole
    width, height = (round(side * scale) for side in old.size_px)
    return replace(
        view,
        pinhole=old.resize(width, height),
        shift=view.shift.scale(width / old.width_px, height / old.height_px),
    )


def enu_from_cam(view: View, offset_enu: Array) -> Array:
    """(3, 4) transform from a view's camera to east, north, up from an offset."""
    matrix = _ENU_FROM_WORLD @ view.world_from_cam.as_matrix()[:3]
    matrix[:, 3] -= offset_enu
    return np.ascontiguousarray(matrix)
