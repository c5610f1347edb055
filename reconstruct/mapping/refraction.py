"""Exact refraction with COLMAP's own adjustment of ideal pinholes.

COLMAP has no refractive camera. The mapper's keypoints are warped to pinholes, exact at one
working depth; once a point's depth before the pinhole's centre is known, where an ideal pinhole
sees the spot is known too (see `camera_calib.approximation.pinhole_warp`). Keypoints are put there
and the model is adjusted, until neither moves. What it converges to is the model that explains the
pixels as taken through the port. Where rays meet in one centre nothing changes.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import warn
from alice_survey.core.frames import Array
from alice_survey.core.records import RefractionRecord
from alice_survey.core.run import progress
from reconstruct.mapping.arrays import Indices, first_of, frames_of, model_groups, observations
from reconstruct.mapping.bundle import (
    FULLY,
    ROUGHLY,
    all_pictures,
    held_options,
    loss_scale,
    move_points,
    pixel_sigma,
    spread_part,
    take_poses,
)
from reconstruct.mapping.database import Observations, scratch_database
from reconstruct.mapping.mapper import Mapped
from reconstruct.views.model_files import stored_of

SETTLED_PX = 1e-4
"""Keypoints that move less have converged."""
_LAST_STEP_SIGMAS = 0.5
_SETTLED_SIGMAS = 0.05
"""And so have those that move less than this share of their noise, the farthest of them."""
_ROUNDS = 6
_UNMOVED_PX = 1e-6
"""Keypoints that move less are not written again."""
_MIN_DEPTHS, _MAX_DEPTHS = 0.2, 20.0
"""Depths of spots over the working depth; beyond, a point is wrong and is left to the filter."""
_WRONG_SIGMAS, _MIN_WRONG_PX, _MAX_WRONG_PX = 5.0, 1.0, 4.0
"""An observation that misses by this many sigmas of the usual miss is wrong; none below the first
bound is called wrong, all beyond the second (COLMAP's) is."""
_MIN_ANGLE_DEG = 1.5
"""Least angle between the rays of a point (COLMAP's)."""


class Keypoints:
    """The keypoints of a model, whose exact places follow from the model's depths.

    Rays are traced through the ports where they are needed: kept, they take twice the memory of
    the keypoints.
    """

    def __init__(self, mapped: Mapped, seen: Observations) -> None:
        """Take a model and its keypoints.

        Args:
            mapped: picture i of `seen` has the id i + 1 and its keypoints in the same order.
            seen: keypoints.
        """
        self._seen = seen
        self._warps = {
            number: mapped.warps[seen.images[number - 1].camera]
            for number, image in sorted(mapped.model.images.items())
            if image.has_pose
        }

    @property
    def shifted(self) -> bool:
        """Whether distance moves any keypoint; not so for a pinhole calibrated in water."""
        return any(warp.largest_offset_m > 0 for warp in self._warps.values())

    def metres_per_unit(self, model: pycolmap.Reconstruction) -> float:
        """Metres in a unit of a model without scale, whose median depth is the working depth."""
        working = [warp.working_depth_m for warp in self._warps.values()]
        return float(np.median(working) / np.median(observations(model).in_cameras[:, 2]))

    def correct(
        self, model: pycolmap.Reconstruction, metres_per_unit: float
    ) -> tuple[float, float]:
        """Put the keypoints that have a point where the pinholes see it, in place.

        Args:
            model: to change.
            metres_per_unit: its scale.

        Returns:
            The largest move, and the root mean square of the whole shift, pixels.
        """
        largest, squares, count = 0.0, 0.0, 0
        seen = observations(model)
        depths = metres_per_unit * seen.in_cameras[:, 2]
        for n, number in enumerate(seen.pictures.tolist()):
            rows = seen.of(n)
            at = seen.keypoint[rows]
            if not len(at):
                continue
            ideal = self._ideal(number, at, depths[rows])
            largest = max(largest, _put(model, number, at, seen.pixels[rows], ideal))
            squares += float(((ideal - self._seen.pixels[number - 1][at]) ** 2).sum())
            count += len(at)
        return largest, float(np.sqrt(squares / count)) if count else 0.0

    def correct_unseen(self, model: pycolmap.Reconstruction, metres_per_unit: float) -> None:
        """Move the keypoints that have no point by the depth of the nearest one that has."""
        from scipy.spatial import KDTree

        seen = observations(model)
        depths, stored = metres_per_unit * seen.in_cameras[:, 2], stored_of(model).keypoints
        for n, number in enumerate(seen.pictures.tolist()):
            rows, warped = seen.of(n), self._seen.pixels[number - 1]
            at = seen.keypoint[rows]
            rest = np.setdiff1d(np.arange(len(warped)), at)
            if not (len(at) and len(rest)):
                continue
            _, nearest = KDTree(warped[at]).query(warped[rest])
            ideal = self._ideal(number, rest, depths[rows][nearest])
            _put(model, number, rest, stored[number]["xy"][rest], ideal)

    def _ideal(self, number: int, at: Indices, depth_m: Array) -> Array:
        """Where a picture's pinhole sees the spots of some keypoints, (M, 2), from depths (M,)."""
        warp, working = self._warps[number], self._warps[number].working_depth_m
        metres = np.clip(depth_m, _MIN_DEPTHS * working, _MAX_DEPTHS * working)
        slope, offset = warp.lines(self._seen.taken[number - 1][at])
        ideal = warp.pinhole.pixels(slope + offset / metres[:, None])
        return np.where(np.isfinite(ideal), ideal, self._seen.pixels[number - 1][at])


def _put(
    model: pycolmap.Reconstruction, number: int, at: Indices, now: Array, ideal: Array
) -> float:
    """Put some keypoints of a picture, now at (M, 2), in their places; the farthest move."""
    points, moved = model.images[number].points2D, np.linalg.norm(ideal - now, axis=1)
    far = np.flatnonzero(moved > _UNMOVED_PX)
    for i, xy in zip(at[far].tolist(), ideal[far], strict=True):
        points[i].xy = xy
    return float(moved.max())


@progress.step("make refraction exact")
def refract(
    mapped: Mapped,
    seen: Observations,
    folder: Path,
    cam_from_rig: Mapping[str, RigidTransform] | None = None,
    *,
    settle: bool = True,
) -> tuple[Mapped, RefractionRecord]:
    """Make a model exact that was mapped from keypoints warped at one working depth.

    Keypoints are corrected and the model adjusted, in turns, until the keypoints converge. Once,
    when the model is exact enough, observations are tested again: wrong ones are removed, and those
    that the warp kept out are added.

    Args:
        mapped: picture i of `seen` has the id i + 1.
        seen: keypoints, and the matches from which tracks are completed.
        folder: for scratch files.
        cam_from_rig: poses of the cameras on one rig; None without one.
        settle: go on until keypoints converge; else end after the first turn, near enough for an
            adjustment on exact rays.

    Returns:
        The exact model, and how the keypoints converged.
    """
    keypoints = Keypoints(mapped, seen)
    notes = mapped.notes
    if not mapped.scaled and keypoints.shifted:
        notes = (
            *notes,
            "refraction through the port removed for a median distance of the working range",
        )

    pinholes = None
    if cam_from_rig is not None:
        pinholes = {n: mapped.warps[n].pinhole_from_cam * pose for n, pose in cam_from_rig.items()}
    model = pycolmap.Reconstruction(mapped.model)
    moves: list[float] = []
    removed = added = 0
    settled = False
    corrected = 0.0
    while len(moves) < _ROUNDS:
        scale = 1.0 if mapped.scaled else keypoints.metres_per_unit(model)
        moved, corrected = keypoints.correct(model, scale)
        moves.append(moved)
        if len(moves) > 2 and moved < max(SETTLED_PX, _SETTLED_SIGMAS * pixel_sigma(model)):
            settled = True
            break
        rough = replace(mapped, model=model, notes=notes)
        mapped = adjust_freely(rough, FULLY) if settle else adjust_freely(rough, spread=True)
        model = pycolmap.Reconstruction(mapped.model)
        if len(moves) == 1:
            keypoints.correct_unseen(model, scale)
            removed, added = _judge_again(model, seen, folder, pinholes)
            if not settle:
                keypoints.correct(model, scale)
                settled = True
                break
    if settle:  # no adjustment follows
        mapped = adjust_freely(replace(mapped, model=model))
        model = pycolmap.Reconstruction(mapped.model)
    model.update_point_3d_errors()
    found = RefractionRecord(
        moved_px=tuple(moves), corrected_px=corrected, removed=removed, added=added, settled=settled
    )
    if not settled:
        warn(
            f"refraction did not settle in {_ROUNDS} rounds: keypoints still move by "
            f"{moves[-1]:.2g} px; check the port's distance and the working range"
        )
    return replace(mapped, model=model), found


def adjust_freely(
    mapped: Mapped, tolerance: float | None = None, *, spread: bool = False
) -> Mapped:
    """Adjust all poses and points.

    A rig fixes the scale, so that one station's pose is all that is held of each group that points
    link; else two pictures are.

    Args:
        mapped: to adjust.
        tolerance: relative change of the cost at which the adjustment ends. If left out, that of a
            step of all unknowns of half a sigma: one of L sigmas lowers the cost of N observations,
            about N, by L^2 / 2.
        spread: adjust poses roughly, by points that are spread over the pictures, which all others
            follow: near enough for an adjustment on exact rays.
    """
    model = pycolmap.Reconstruction(mapped.model)
    part, sigma_px = spread_part(model) if spread else None, pixel_sigma(model)
    if spread:
        tolerance = ROUGHLY
    elif tolerance is None:
        count = sum(image.num_points3D for image in mapped.model.images.values())
        tolerance = _LAST_STEP_SIGMAS**2 / (2.0 * max(count, 1))
    adjusted = model if part is None else part
    config = all_pictures(adjusted)
    if np.isfinite(mapped.baseline):
        for frame in frames_of(adjusted)[first_of(model_groups(adjusted))].tolist():
            config.set_constant_rig_from_world_pose(frame)
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = held_options(sigma_px, tolerance)
    pycolmap.create_default_bundle_adjuster(options, config, adjusted).solve()
    if part is not None:
        take_poses(model, part)
        move_points(model, loss_scale(sigma_px))
    model.update_point_3d_errors()
    return replace(mapped, model=model)


def _judge_again(
    model: pycolmap.Reconstruction,
    seen: Observations,
    folder: Path,
    cam_from_rig: Mapping[str, RigidTransform] | None,
) -> tuple[int, int]:
    """Take wrong observations out and complete tracks, in place; how many went and came."""
    before = model.compute_num_observations()
    limit = float(np.clip(_WRONG_SIGMAS * pixel_sigma(model), _MIN_WRONG_PX, _MAX_WRONG_PX))
    if seen.pairs:
        cached = pycolmap.DatabaseCacheOptions()
        # a picture that no larger model could use is in none, but its few matches are there
        cached.image_names = {image.name for image in model.images.values()}
        with (
            scratch_database(folder / "refraction", seen, cam_from_rig) as scratch,
            pycolmap.Database.open(scratch / "database.db") as database,
        ):
            graph = pycolmap.DatabaseCache.create(database, cached).correspondence_graph
        manager = pycolmap.ObservationManager(model, graph)
        options = pycolmap.IncrementalTriangulatorOptions()
        options.ignore_two_view_tracks = False
        options.complete_max_reproj_error = options.merge_max_reproj_error = limit
        options.random_seed = 1
        triangulator = pycolmap.IncrementalTriangulator(graph, model, manager)
        triangulator.complete_all_tracks(options)
        triangulator.merge_all_tracks(options)
    else:
        manager = pycolmap.ObservationManager(model)
    added = model.compute_num_observations() - before
    removed = manager.filter_all_points3D(limit, _MIN_ANGLE_DEG)
    return int(removed), int(added)
