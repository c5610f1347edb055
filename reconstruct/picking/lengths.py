"""Lengths and areas between spots picked in pictures, with sigmas of picks, poses and the scale.

A pixel of one picture is found again in the others that see it; the exact rays give the point.

Two spots that the same pictures show share the errors of these: the block around them is adjusted
once more, to first order, and tells how stations err together. With a point of slopes J by its
place, P by a station's pose and C by the rig, and picks that weigh W, a step of the stations and of
the rig moves it by `-(J^T W J)^-1 J^T W (P dpose + C drig)`. A length is a difference of two such
points, so that a shift or turn of the whole block cancels, and so does what both share. The normal
equations of the model's keypoints, points eliminated, give the covariance of the poses for a rig
that is known; poses follow the rig as they say (implicit function theorem), and the covariance of
the rig, as the survey refined it, moves both. Only stations around the spots count; leaving others
out knows less, never more.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.contents import read_arrays
from alice_survey.core.errors import ReconstructionError, offer
from alice_survey.core.frames import Array
from alice_survey.core.records import MappingRecord, RegistrationRecord, ScaleRecord
from alice_survey.kit.words import digits, with_sigma
from camera_calib.rig import Rig, read_rig
from reconstruct.adjustment.exact_observations import (
    PixelParts,
    Pixels,
    RigState,
    calibrated_parameters,
    exact_observations,
    exact_residuals,
    linearise_parts,
)
from reconstruct.adjustment.normal_equations import Gauge, PointEquations, by_pose, reduce_parts
from reconstruct.mapping.arrays import MIN_POINTS, Indices, first_of, linked_groups
from reconstruct.measure.figures import polygon_area, polyline, slopes_of
from reconstruct.picking.matching import refine
from reconstruct.picking.registered import RegisteredPictures
from reconstruct.picking.surface import ModelSurface, SurfacePlace
from reconstruct.pictures.undistorted import read_colour
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.control import tie_control
from reconstruct.placing.control_command import note_scale
from reconstruct.placing.control_points import (
    PICK_SIGMA_PX,
    Control,
    Pick,
    TriangulatedPoint,
    covariance_of_picks,
    gain_of,
    own_sigmas,
    residuals,
    triangulate_picks,
)
from reconstruct.placing.place import LENGTH_SCALE_SIGMA
from reconstruct.stages import SCALE_FILE
from reconstruct.views.model import WorldFrame
from reconstruct.views.model_files import ImagesFile, points_of

PolylineFigure = tuple[Callable[[Array], float], int]
"""A figure of points (N, 3), and the power of a length that it is."""
MAX_STATIONS = 120
"""Stations that are adjusted: the nearest to the spots."""
_MAX_OBSERVATIONS = 400_000
"""Observations that are adjusted; of more, evenly chosen points."""


@dataclass(frozen=True, kw_only=True)
class PickedFigure:
    """A figure of picked points, in the unit of the model, and parts of its sigma."""

    value: float
    sigma_picks: float
    sigma_poses: float
    sigma_scale: float
    """By the calibration of the rig, or by what the model was scaled with."""

    @property
    def sigma(self) -> float:
        """Of all."""
        parts = (self.sigma_picks, self.sigma_poses, self.sigma_scale)
        return float(np.sqrt(np.sum(np.square(parts))))


@dataclass(frozen=True, kw_only=True, eq=False)
class StationBlock:
    """Neighbouring stations as their keypoints determine them."""

    numbers: Indices
    """(F,) stations, ascending."""
    state: RigState
    fields: tuple[str, ...]
    covariance: Array
    """(G, G) of the rig's parameters `fields`, then of the shifts of keypoints, where known."""
    equations: PointEquations
    gauge: Gauge

    @classmethod
    def around(
        cls, workspace: Path, pictures: RegisteredPictures, stations: Sequence[int]
    ) -> "StationBlock":
        """The block of some stations.

        Args:
            workspace: folder with a finished `sparse/`.
            pictures: its pictures.
            stations: their numbers.

        Raises:
            ReconstructionError: these do not hang together, or have too few points.
        """
        folder = workspace / "sparse" / "model"
        rig = _rig_of(workspace, pictures)
        names = list(rig.cameras)
        numbers = np.unique(stations)
        rows = np.flatnonzero(np.isin(pictures.station, numbers))
        state = _state_of(pictures, rig, numbers)
        pixels, state = _observations(ImagesFile(folder), folder, pictures, rows, state, numbers)
        fields = calibrated_parameters(rig, names)
        known = np.zeros((0, 0))
        if rig.covariance is not None:
            known = rig.covariance.marginal(fields).matrix
        sigma = 1.0  # of no effect on one station, which has no shape
        if len(numbers) > 1:
            path = workspace / "sparse" / "covariance.npz"
            stored = read_arrays(path, "sigma_px", optional=("shared_calibration",))
            sigma = float(stored["sigma_px"])
            if len(known) and "shared_calibration" in stored:
                state = state.with_shifts()
                known = stored["shared_calibration"].astype(np.float64)
        parts = PixelParts(pixels, len(numbers))
        linear = linearise_parts(parts, state, fields, (sigma, sigma**2))
        group = linked_groups(pixels.station, pixels.point, len(numbers))
        if group.any():
            raise ReconstructionError(
                "no points join the pictures of the two spots: their distance is not known"
            )
        scale_free = not _has_baseline(pictures, rows)
        reach = state.points[pixels.point] - state.centres[pixels.station]
        gauge = Gauge(
            state.centres, float(np.median(np.linalg.norm(reach, axis=1))), scale_free, group
        )
        held = gauge.held.copy()
        held[first_of(group)] = True
        held[np.bincount(pixels.station, minlength=len(numbers)) < MIN_POINTS] = True
        return cls(
            numbers=numbers, state=state, fields=fields, covariance=known, gauge=gauge,
            equations=replace(reduce_parts(linear), free=~held),
        )  # fmt: skip

    def errors(
        self, target: TriangulatedPoint, picks: Sequence[Pick], pictures: RegisteredPictures
    ) -> tuple[Array, Array, Array]:
        """How a spot errs that was found from picks in pictures of the block.

        Returns:
            (3, 3) covariance by its own picks; (3, F, 6) how it moves with the stations of the
            block; and (3, G) with the rig, the stations held.
        """
        kept = [p for p in picks if p.image in pictures and p.image not in target.left_out]
        rows = [pictures.row(p.image) for p in kept]
        station = np.searchsorted(self.numbers, pictures.station[rows])
        names, own = list(self.state.rig.cameras), list(pictures.warps)
        seen = Pixels(
            starts=np.array([0, len(kept)]), station=station.astype(np.int64),
            camera=np.array([names.index(own[pictures.camera[row]]) for row in rows], np.int64),
            taken=np.array([[p.x_px, p.y_px] for p in kept]), point=np.zeros(len(kept), np.int64),
        )  # fmt: skip
        linear = exact_observations(
            replace(self.state, points=target.model[None]), seen, self.fields
        )
        jacobian = linear.by_point.reshape(-1, 3)
        sigma = np.repeat(own_sigmas(kept), 2)
        gain = gain_of(jacobian, sigma)
        chi = float(((linear.miss.ravel() / sigma) ** 2).sum()) / max(1, 2 * len(kept) - 3)
        by_poses, slopes = np.zeros((3, len(self.numbers), 6)), np.empty((2, 6))
        for n in range(len(kept)):
            by_pose(linear.by_point[n], linear.arm[n], slopes)
            by_poses[:, station[n]] -= gain[:, 2 * n : 2 * n + 2] @ slopes
        by_picks = gain @ covariance_of_picks(kept, jacobian, max(1.0, chi)) @ gain.T
        return by_picks, by_poses, -gain @ linear.rest[..., :-1].reshape(2 * len(kept), -1)

    def variances(self, by_poses: Array, by_rig: Array) -> tuple[Array, Array]:
        """Covariances (K, K) of K figures by the poses and by the rig.

        Args:
            by_poses: (K, F, 6) slopes of the figures by the stations; motions of the whole block
                are taken out.
            by_rig: (K, G) by the rig, the stations held.
        """
        if len(self.numbers) == 1:  # which moves as a whole
            return np.zeros((len(by_poses),) * 2), by_rig @ self.covariance @ by_rig.T
        shape = np.stack([self.gauge.shape_weights(one) for one in by_poses], axis=-1)
        poses = np.einsum("fik,fil->kl", shape, self.equations.undamped.solve(shape))
        along = np.einsum("fik,fig->kg", shape, self.equations.response) + by_rig
        return poses, along @ self.covariance @ along.T


class Lengths:
    """Spots and lengths of a reconstructed workspace."""

    def __init__(self, workspace: Path, pictures: RegisteredPictures) -> None:
        """Take a workspace with a finished `sparse/`."""
        self._workspace, self._pictures = workspace, pictures
        self._around = lru_cache(1)(lambda chosen: StationBlock.around(workspace, pictures, chosen))
        numbers, first = np.unique(pictures.station, return_index=True)
        self._numbers, self._places = numbers, pictures.centres[first]

    def between(self, first: Sequence[Pick], second: Sequence[Pick]) -> PickedFigure:
        """The distance between two spots, each by its picks.

        Raises:
            ReconstructionError: one is not found, or the distance is not determined.
        """
        return self.figures([first, second], [(polyline, 1)])[1][0]

    def figures(
        self, picks: Sequence[Sequence[Pick]], figures: Sequence[PolylineFigure]
    ) -> tuple[Array, list[PickedFigure]]:
        """Points, (N, 3) in the model, each by its picks, and figures of them.

        Raises:
            ReconstructionError: a point is not found, two that follow each other are one, or
                their distances are not determined.
        """
        targets = [self.target(some) for some in picks]
        points = np.stack([target.model for target in targets])
        if not (np.linalg.norm(np.diff(points, axis=0), axis=1) > 0).all():
            raise ReconstructionError("the two spots are one and the same")
        block = self._block([pick for some in picks for pick in some])
        errors = [block.errors(s, p, self._pictures) for s, p in zip(targets, picks, strict=True)]
        by_picks, by_poses, by_rig = (np.stack(one) for one in zip(*errors, strict=True))
        centred = points - points.mean(axis=0)
        slopes = np.stack([slopes_of(value, centred) for value, _ in figures])
        own = np.einsum("kni,nij,knj->k", slopes, by_picks, slopes)
        poses, rig = block.variances(
            np.einsum("kni,nifj->kfj", slopes, by_poses), np.einsum("kni,nig->kg", slopes, by_rig)
        )
        values = np.array([value(centred) for value, _ in figures])
        scale = np.array([power for _, power in figures]) * values * _scale_sigma(self._workspace)
        by_picks, by_poses, by_rig = (
            np.sqrt(np.maximum(one, 0.0)) for one in (own, np.diag(poses), np.diag(rig))
        )
        rows = np.column_stack([values, by_picks, by_poses, np.hypot(by_rig, scale)]).tolist()
        return points, [
            PickedFigure(value=value, sigma_picks=pixels, sigma_poses=moved, sigma_scale=grown)
            for value, pixels, moved, grown in rows
        ]

    def target(self, picks: Sequence[Pick]) -> TriangulatedPoint:
        """The spot that picks show.

        Raises:
            ReconstructionError: they show none.
        """
        cameras = {
            p.image: self._pictures.picture(p.image) for p in picks if p.image in self._pictures
        }
        alone = [replace(pick, point="spot") for pick in picks]
        found, lost = triangulate_picks(alone, cameras)
        if "spot" not in found:
            raise ReconstructionError(f"the spot is not found: {lost.get('spot', 'no picks')}")
        return found["spot"]

    def _block(self, picks: Sequence[Pick]) -> StationBlock:
        rows = [self._pictures.row(p.image) for p in picks if p.image in self._pictures]
        needed = np.unique(self._pictures.station[rows])
        places = self._pictures.centres[rows]
        ends = np.stack([places.min(axis=0), places.max(axis=0)])
        along = ends[0] + np.linspace(0.0, 1.0, 20)[:, None] * (ends[1] - ends[0])
        away = np.asarray(KDTree(along).query(self._places)[0])
        away[np.isin(self._numbers, needed)] = -1.0
        chosen = np.sort(self._numbers[np.argsort(away, kind="stable")[:MAX_STATIONS]])
        return self._around(tuple(chosen.tolist()))


def point_residuals(
    targets: Mapping[str, TriangulatedPoint], picks: Sequence[Pick], pictures: RegisteredPictures
) -> list[Array | None]:
    """(2,) pixels by which each pick misses its spot; None where that is not known."""
    found: list[Array | None] = []
    for pick in picks:
        known = pick.point in targets and pick.image in pictures
        cameras = {pick.image: pictures.picture(pick.image)} if known else {}
        found.append(residuals(targets[pick.point].model, [pick], cameras)[0] if known else None)
    return found


def _rig_of(workspace: Path, pictures: RegisteredPictures) -> Rig:
    """The cameras that took pictures, their poses relative to the first as the model has them."""
    path = workspace / "sparse" / "rig.json"
    names = [name for n, name in enumerate(pictures.warps) if (pictures.camera == n).any()]
    known = read_rig(path).covariance if path.is_file() else None
    poses = {names[0]: RigidTransform.identity()}
    for name in names[1:]:
        pair = _pair(pictures, names[0], name)
        poses[name] = RigidTransform.identity() if pair is None else pair
    return Rig(
        cameras={name: pictures.warps[name].camera for name in names},
        cam_from_rig=poses, body_from_rig=None, source="of the model", covariance=known,
    )  # fmt: skip


def _pair(pictures: RegisteredPictures, first: str, second: str) -> RigidTransform | None:
    """Pose of a camera relative to the first one by a station that both took; None without one."""
    order = list(pictures.warps)
    rows = [np.flatnonzero(pictures.camera == order.index(name)) for name in (first, second)]
    _, a, b = np.intersect1d(
        pictures.station[rows[0]], pictures.station[rows[1]], return_indices=True
    )
    if not len(a):
        return None
    one, two = (_pose(pictures, int(r[k[0]])) for r, k in zip(rows, (a, b), strict=True))
    return two.inv() * one


def _pose(pictures: RegisteredPictures, row: int) -> RigidTransform:
    return pictures.picture(pictures.names[row]).model_from_cam


def _has_baseline(pictures: RegisteredPictures, rows: Indices) -> bool:
    """Whether any station has pictures of two cameras, whose distance the rig knows."""
    _, count = np.unique(pictures.station[rows], return_counts=True)
    return bool((count > 1).any()) and pictures.frame.scaled


def _state_of(pictures: RegisteredPictures, rig: Rig, numbers: Indices) -> RigState:
    order, turns, centres = list(pictures.warps), [], []
    for number in numbers.tolist():
        rows = np.flatnonzero(pictures.station == number)
        row = int(min(rows, key=lambda r: list(rig.cameras).index(order[pictures.camera[r]])))
        pose = _pose(pictures, row) * rig.cam_from_rig[order[pictures.camera[row]]]
        turns.append(pose.rotation.as_matrix())
        centres.append(pose.translation)
    return RigState(
        rig=rig, turns=np.stack(turns), centres=np.stack(centres), points=np.zeros((0, 3))
    )


def _observations(
    file: ImagesFile,
    folder: Path,
    pictures: RegisteredPictures,
    rows: Indices,
    state: RigState,
    numbers: Indices,
) -> tuple[Pixels, RigState]:
    """What pictures (R,) of the block see of points that two of them see."""
    of_name = {picture.name: picture for picture in file.pictures}
    names, order = list(state.rig.cameras), list(pictures.warps)
    ids, station, camera = [], [], []
    for row in rows.tolist():
        seen = file.keypoints(of_name[pictures.names[row]])["point"]
        seen = np.unique(seen[seen >= 0]).astype(np.int64)
        ids.append(seen)
        station.append(np.full(len(seen), np.searchsorted(numbers, pictures.station[row])))
        camera.append(np.full(len(seen), names.index(order[pictures.camera[row]])))
    every = np.concatenate(ids)
    points, inverse, counts = np.unique(every, return_inverse=True, return_counts=True)
    chosen = counts > 1
    step = -(-int(counts[chosen].sum()) // _MAX_OBSERVATIONS)
    if step > 1:
        chosen &= np.arange(len(points)) % step == 0
    kept = np.flatnonzero(chosen[inverse])
    if not len(kept):
        raise ReconstructionError("no points join the pictures of the two spots")
    kept = kept[np.argsort(inverse[kept], kind="stable")]
    _, index, sizes = np.unique(inverse[kept], return_inverse=True, return_counts=True)
    state = replace(state, points=points_of(folder, points[chosen]))
    pixels = Pixels(
        starts=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        station=np.concatenate(station)[kept].astype(np.int64),
        camera=np.concatenate(camera)[kept].astype(np.int64),
        taken=np.zeros((len(kept), 2)), point=index.astype(np.int64),
    )  # fmt: skip
    # where they are seen, not where they were found: these are slopes, not an adjustment
    return replace(pixels, taken=exact_residuals(pixels, state)), state


def _scale_sigma(workspace: Path) -> float:
    """Relative sigma of a scale that no rig gives."""
    if MappingRecord.read(workspace / "mapping" / "mapping.json").scaled:
        return 0.0
    if ScaleRecord.read_existing(workspace / SCALE_FILE) is not None:
        return LENGTH_SCALE_SIGMA
    placed = RegistrationRecord.read(workspace / "sparse" / "registration.json").georeference
    found = None if placed is None else placed.scale_of_navigation_sigma
    return LENGTH_SCALE_SIGMA if found is None else found


def preview_control(
    control: Control,
    points: Mapping[str, TriangulatedPoint],
    lost: Mapping[str, str],
    frame: WorldFrame,
) -> dict[str, Any]:
    """Residuals of control points and bars, before the model is placed again.

    What navigation and soft modes take of a misfit shows in the next reconstruction only.

    Args:
        control: what is known.
        points: where the model has its points.
        lost: why it has not others.
        frame: of the model.

    Returns:
        JSON values: `now`, where the model lies, and `fitted`, where the control points put it (a
        shift, a rotation and a scale, fixed where a rig gave it), each as `sparse/control.json` or
        None where there is no such placement, and `not_found` by name.
    """
    datum = frame.datum if frame.datum is not None else control.datum()
    ties = tie_control(control, points, lost, datum)
    still = Similarity(scale=1.0, rotation=Rotation.identity(), translation=np.zeros(3))
    start, tied = ties.start(1.0 if frame.scaled else None), ties.ties or ties.bars
    return {
        "now": ties.score(still, located=frame.name == "ned").to_json() if tied else None,
        "fitted": None if start is None else ties.score(start, located=True).to_json(),
        "not_found": dict(ties.lost),
    }


_NUMBER = r"(-?\d+(?:\.\d+)?)"
_PIXEL = re.compile(rf"(?P<image>[^=]+?):{_NUMBER},{_NUMBER}")
_MAX_LOOKED_IN = 16
"""Pictures in which a pick is looked for again, the best ones."""
_KEPT = 32
"""Pictures that are kept in memory."""
_EXACT_PX = 1e-3
"""Sigma of a pixel that is taken as it is, and least one of what the surface says."""


def measure(
    workspace: Path, points: str, *, pick_sigma_px: float = 0.0
) -> tuple[str, dict[str, Any]]:
    """Measure between picked pixels.

    Args:
        workspace: reconstructed.
        points: two or more, with blanks between: `IMAGE:x,y`, which is found again in other
            pictures, or `IMAGE:x,y=IMAGE:x,y` where two pictures show the point. Pixels count from
            0 at the centre of the first, as viewers show them.
        pick_sigma_px: standard deviation with which pixels were picked; where two pictures were
            picked in by hand, 0 stands for the usual one.

    Returns:
        Text for the terminal, and figures: distances from point to point, their sum, and with
        three or more points the closed polygon's area.

    Raises:
        ReconstructionError: the points cannot be read, or one is not found.
        WorkspaceError: there is no model.
    """
    words = points.split()
    marks = parse_picks(points, pick_sigma_px)
    pictures = RegisteredPictures.read(workspace)
    if not pictures.frame.scaled:
        scale, give = workspace / SCALE_FILE, "control --points ... --length ..."
        after = offer("reconstruct" if scale.is_file() else give, "-w", workspace)
        raise ReconstructionError(f"the model has no scale: lengths are not metres; run {after!r}")
    finder = _PickFinder(workspace, pictures)
    picks = [finder.find(some) for some in marks]
    segments = [lambda p, n=n: polyline(p[n : n + 2]) for n in range(len(picks) - 1)]
    lines: list[PolylineFigure] = [(segment, 1) for segment in segments]
    if len(picks) > 2:
        lines += [(polyline, 1), (polygon_area, 2)]
    places, figures = Lengths(workspace, pictures).figures(picks, lines)
    return _describe(words, places, figures, _scale_sigma(workspace) > 0.0)


def scale_model(workspace: Path, points: str, length_m: float) -> str:
    """Note the true distance between two picked points of a model in `scale.json`.

    Args:
        workspace: folder with a finished `sparse/`.
        points: two of them, as `measure` takes points.
        length_m: their true distance.

    Returns:
        What was found, in one line.

    Raises:
        ReconstructionError: the points cannot be understood or found, or the scale is known from
            the rig already.
    """
    marks, words = parse_picks(points.replace("+", "=")), points.split()
    if len(words) != 2:
        raise ReconstructionError(f"--points needs two points, got {len(words)}: {points!r}")
    pictures = RegisteredPictures.read(workspace)
    finder, lengths = _PickFinder(workspace, pictures), Lengths(workspace, pictures)
    first, second = (lengths.target(finder.find(some)).model for some in marks)
    return note_scale(workspace, (words[0], words[1]), first, second, length_m)


def parse_picks(points: str, sigma_px: float = 0.0) -> list[tuple[Pick, ...]]:
    """Read points as `measure` takes them, each with its one or two picks.

    Raises:
        ReconstructionError: fewer than two, or one of another form.
    """
    found = []
    for word in points.split():
        parts = [_PIXEL.fullmatch(part) for part in word.split("=")]
        matches = [match for match in parts if match is not None]
        if len(matches) < len(parts) or len(parts) > 2:
            raise ReconstructionError(f"point {word!r}: give IMAGE:x,y or IMAGE:x,y=IMAGE:x,y")
        sigma = sigma_px or (PICK_SIGMA_PX if len(parts) == 2 else _EXACT_PX)
        found.append(
            tuple(
                Pick(
                    image=match["image"], point=word, x_px=float(match[2]) + 0.5,
                    y_px=float(match[3]) + 0.5, sigma_px=sigma,
                )
                for match in matches
            )
        )  # fmt: skip
    if len(found) < 2:
        raise ReconstructionError(f"{len(found)} of at least two points are given")
    return found


class _PickFinder:
    """Finds picks of one picture in the others of a workspace."""

    def __init__(self, workspace: Path, pictures: RegisteredPictures) -> None:
        self._pictures, self._images = pictures, workspace / "images"
        self._surface = ModelSurface(workspace)
        self._grey = lru_cache(_KEPT)(self._read)

    def _read(self, image: str) -> Any:
        return cv2.cvtColor(read_colour(self._images / image), cv2.COLOR_BGR2GRAY)

    def find(self, picks: Sequence[Pick]) -> Sequence[Pick]:
        """Two picks as they are; one with those that were found from it in other pictures.

        Where nothing there looks like it, its ray is cut with the elevation model.

        Raises:
            ReconstructionError: one is outside of its picture, meets no known surface, or no other
                picture shows it.
        """
        for pick in picks:
            width, height = self._pictures.warp(pick.image).size_px
            if not (0 <= pick.x_px <= width and 0 <= pick.y_px <= height):
                raise ReconstructionError(f"{_text(pick)} is outside of its {width} x {height}")
        if len(picks) > 1:
            return picks
        pick = picks[0]
        place = self._surface.met_by(
            *self._pictures.picture(pick.image).ray(np.array([pick.x_px, pick.y_px]))
        )
        seen = self._pictures.seeing(place.point, place.normal)[:_MAX_LOOKED_IN]
        images = [one.image for one in seen if one.image != pick.image]
        found = refine(pick, images, place, self._pictures.picture, self._grey)
        if found.meeting is not None:
            return found.picks
        if images and self._surface.is_dense:
            return pick, self._by_surface(pick, place, images[0])
        why = f": {found.refused[0].why}" if found.refused else ""
        raise ReconstructionError(
            f"{_text(pick)} is not found in another picture{why}; pick another pixel, or the "
            "point in two pictures as IMAGE:x,y=IMAGE:x,y"
        )

    def _by_surface(self, pick: Pick, place: SurfacePlace, image: str) -> Pick:
        """Where another picture sees what the ray of a pick meets, as well as that is known."""
        picture, near = self._pictures.picture(image), self._pictures.picture(pick.image)
        seen = picture.project(place.point)
        _, way = near.ray(np.array([pick.x_px, pick.y_px]))
        along = place.sigma * way / abs(way @ place.normal)
        sigma = float(np.linalg.norm(picture.project(place.point + along) - seen))
        x, y = seen.tolist()
        return replace(
            pick, image=image, x_px=x, y_px=y, sigma_px=max(sigma, _EXACT_PX),
            matched_to=pick.image,
        )  # fmt: skip


def _text(pick: Pick) -> str:
    return f"{pick.image}:{pick.x_px - 0.5:g},{pick.y_px - 0.5:g}"


def _describe(
    words: Sequence[str], places: Array, figures: Sequence[PickedFigure], known_scale: bool
) -> tuple[str, dict[str, Any]]:
    def entry(figure: PickedFigure, unit: str) -> dict[str, float]:
        return {
            f"value_{unit}": figure.value,
            f"sigma_{unit}": figure.sigma,
            f"sigma_of_pixels_{unit}": figure.sigma_picks,
            f"sigma_of_poses_{unit}": figure.sigma_poses,
            f"sigma_of_calibration_{unit}": figure.sigma_scale,
        }

    segments, lines = [], []
    for (one, other), figure in zip(pairwise(words), figures, strict=False):
        segments.append({"from": one, "to": other, **entry(figure, "m")})
        sigmas = (figure.sigma_picks, figure.sigma_poses, figure.sigma_scale)
        picks, poses, scale = (digits(1e3 * sigma, 2) for sigma in sigmas)
        lines.append(
            f"{one} to {other}: {_millimetres(figure)} ({picks} of pixels, {poses} of poses, "
            f"{scale} of {'scale' if known_scale else 'calibration'})"
        )
    data: dict[str, Any] = {
        "format": "alice-survey measure",
        "version": 2,
        "points": [
            {"pixel": word, "east_m": float(east), "north_m": float(north), "up_m": -float(down)}
            for word, (north, east, down) in zip(words, places, strict=True)
        ],
        "distances": segments,
    }
    if len(words) > 2:
        length, area = figures[-2:]
        data["length"], data["area"] = entry(length, "m"), entry(area, "m2")
        lines.append(f"length of the line: {_millimetres(length)}")
        lines.append(f"area of the polygon: {with_sigma(1e4 * area.value, 1e4 * area.sigma)} cm2")
    return "\n".join(lines), data


def _millimetres(length: PickedFigure) -> str:
    return f"{with_sigma(1e3 * length.value, 1e3 * length.sigma)} mm"
