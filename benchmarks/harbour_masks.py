"""Masks of what moves in the harbour's pictures against where fish and weed truly are.

Fish are ellipsoids: each pixel's ray in water, exact through the port, is intersected with them in
closed form, and followed by sphere tracing to what hides them. Blades of weed are drawn as lines.
Shadows wander with the vehicle's lamps, and with the fish: what is masked there is not wrong.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.executor import Executor
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array
from benchmarks.harbour_scene import FISH, WEEDS
from benchmarks.harbour_sight import instants_that_see, trace
from benchmarks.harbour_survey import STROBES, Station, body_poses, harbour_rig, time_of
from benchmarks.harbour_truth import moving_distance, normals

Mask = NDArray[np.bool_]
_RIM_PX = 4
"""Around what moves, where a mask may end: its rim is blended, and masks have cells."""
_MAX_M = 6.0
_INSTANTS = 3
"""Stations that must see what is behind a fish, its own included."""
_FISH_STEP_PX, _SHADOW_STEP_PX = 4, 2
"""Steps between pixels of fish and of shadows that are looked at."""
_OFF_M = 0.002
_WEED_REACH_M, _WEED_STEPS = 0.6, 60
"""From a place in the shadow to the blade that casts it."""


@dataclass(frozen=True, kw_only=True)
class MaskTask:
    """One picture and its mask."""

    masks: Path
    planned: tuple[Station, ...]
    scale: int
    name: str
    station: int


def score_masks(
    masks: Path, planned: Sequence[Station], scale: int, executor: Executor
) -> dict[str, float]:
    """Compare the masks of a survey with the truth.

    Args:
        masks: folder with `left/0000.png` and so on where something is masked, 0 = left out.
        planned: stations.
        scale: of the pictures.
        executor: where pictures are looked at.

    Returns:
        Pixels of fish; shares of them that are masked, of all and of those behind which two other
        stations see the harbour; intersection over union of these (weed and shadows do not count);
        share of what is masked that is fish, weed or a shadow; share of weed that is masked, and of
        all that stays and is lit.
    """
    tasks = [
        MaskTask(masks=masks, planned=tuple(planned), scale=scale, name=name, station=station)
        for name in harbour_rig(scale).cameras
        for station in range(len(planned))
    ]
    t: Counter[str] = Counter()
    for found in executor.map(count_pixels, tasks, label="masks"):
        t.update(found)
    return shares(t)


def shares(t: Mapping[str, int]) -> dict[str, float]:
    """What `score_masks` returns, of sums of what `count_pixels` does."""
    return {
        "fish_pixels": t["fish"],
        "recall": t["hit"] / max(t["fish"], 1),
        "recall_seen_behind": t["hit behind"] / max(t["behind"], 1),
        "iou_seen_behind": t["hit behind"] / max(t["either"], 1),
        "precision": t["right"] / max(t["masked"], 1),
        "shadow_share": t["shadow"] / max(t["masked"], 1),
        "weed_recall": t["hit weed"] / max(t["weed"], 1),
        "still_masked": (t["masked"] - t["right"]) / max(t["still"], 1),
    }


def count_pixels(task: MaskTask) -> dict[str, int]:
    """Pixels of each kind in one picture."""
    rig, time_s = harbour_rig(task.scale), time_of(task.station)
    camera = rig.cameras[task.name]
    pose = body_poses(task.planned)[task.station] * rig.body_from_cam(task.name)
    fish = fish_in(task.name, task.scale, pose, time_s)
    weed = weed_in(task.name, task.scale, pose, time_s) & ~fish
    path = task.masks / task.name / f"{task.station:04d}.png"
    found = np.zeros_like(fish)
    if path.exists():
        found = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) == 0
    around = _grown(fish | weed)
    shadow = shadow_in(task, pose, found & ~around) & ~around
    behind = seen_behind(task, pose, fish)
    counted = ~(_grown(weed) | shadow | (fish & ~behind))
    return {
        "fish": int(fish.sum()),
        "hit": int((found & fish).sum()),
        "behind": int(behind.sum()),
        "hit behind": int((found & behind).sum()),
        "either": int(((found | fish) & (counted | behind)).sum()),
        "masked": int(found.sum()),
        "right": int((found & (around | shadow)).sum()),
        "shadow": int((found & shadow).sum()),
        "weed": int(weed.sum()),
        "hit weed": int((found & weed).sum()),
        "still": camera.width_px * camera.height_px - int((around | shadow).sum()),
    }


def shadow_in(task: MaskTask, pose: RigidTransform, looked: Mask) -> Mask:
    """Where a picture shows shadows, of those pixels (H, W) that are looked at; and their rims."""
    looked = looked & _lattice(looked.shape, _SHADOW_STEP_PX)
    lamps = (pose * harbour_rig(task.scale).cam_from_rig[task.name]).apply(_lamps_rig())
    origins, directions = _rays_of(task, pose, looked)
    shadow = np.zeros_like(looked)
    shadow[looked] = in_shadow(origins, directions, lamps, time_of(task.station))
    return _grown(shadow)


def seen_behind(task: MaskTask, pose: RigidTransform, fish: Mask) -> Mask:
    """The pixels of fish, (H, W), behind which other stations see the harbour."""
    rig, bodies = harbour_rig(task.scale), body_poses(task.planned)
    looked = fish & _lattice(fish.shape, _FISH_STEP_PX)
    at = np.nonzero(looked.ravel())[0]
    origins, directions = _rays_of(task, pose, looked)
    path = trace(origins, directions, np.full(len(at), _MAX_M))
    met = np.nonzero(~np.isnan(path))[0]
    points = origins[met] + path[met, None] * directions[met]
    cameras = [(one, bodies * rig.body_from_cam(name)) for name, one in rig.cameras.items()]
    seen = np.zeros_like(fish)
    known = instants_that_see(points, normals(points), cameras) >= _INSTANTS
    seen.ravel()[at[met[known]]] = True
    size = (2 * _FISH_STEP_PX - 1, 2 * _FISH_STEP_PX - 1)
    return np.asarray(cv2.dilate(seen.astype(np.uint8), np.ones(size, np.uint8)) > 0) & fish


def _rays_of(task: MaskTask, pose: RigidTransform, pixels: Mask) -> tuple[Array, Array]:
    origins, directions = (one[pixels.ravel()] for one in _rays(task.name, task.scale))
    return pose.apply(origins), pose.rotation.apply(directions)


def _lattice(shape: tuple[int, int], step: int) -> Mask:
    lattice = np.zeros(shape, bool)
    lattice[::step, ::step] = True
    return lattice


def _grown(mask: Mask) -> Mask:
    kernel = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def in_shadow(origins: Array, directions: Array, lamps: Array, time_s: float) -> Mask:
    """Whether what rays meet is hidden from any lamp by fish, by weed or by the harbour, (N,)."""
    path = trace(origins, directions, np.full(len(origins), _MAX_M))
    met = np.nonzero(~np.isnan(path))[0]
    points = origins[met] + path[met, None] * directions[met]
    points = points + _OFF_M * normals(points)
    found = np.zeros(len(origins), bool)
    for lamp in lamps:
        way = lamp - points
        length = np.linalg.norm(way, axis=1)
        way /= length[:, None]
        found[met] |= ~np.isnan(trace(points, way, length))
        found[met] |= fish_along(points, way, time_s) < length
        for share in np.linspace(0.0, 1.0, _WEED_STEPS):
            on_the_way = points + (share * _WEED_REACH_M) * way
            found[met] |= moving_distance(on_the_way, time_s)[1] < 0
    return found


@lru_cache(maxsize=1)
def _lamps_rig() -> Array:
    """(L, 3) in the rig's frame."""
    return BODY_FROM_NADIR_CAM.inv().apply(np.array(STROBES.strobes_body_m))


def fish_along(origins: Array, directions: Array, time_s: float) -> Array:
    """Paths along rays to the first fish, (N,); infinite where there is none.

    The root of the quadratic equation of a line and a unit sphere, in units of the semi-axes.
    """
    nearest = np.full(len(origins), np.inf)
    for fish in FISH:
        turn, axes = fish.turn(time_s).inv(), np.array(fish.semi_axes)
        p = turn.apply(origins - fish.place(time_s)) / axes
        d = turn.apply(directions) / axes
        a, b, c = (d * d).sum(axis=1), (p * d).sum(axis=1), (p * p).sum(axis=1) - 1.0
        inside = b * b - a * c
        path = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
        hit = (inside > 0) & (path > 0) & (path < nearest)
        nearest[hit] = path[hit]
    return nearest


@lru_cache(maxsize=4)
def _rays(name: str, scale: int) -> tuple[Array, Array]:
    camera = harbour_rig(scale).cameras[name]
    return camera.unproject(camera.pixel_centres().reshape(-1, 2))


def fish_in(name: str, scale: int, pose: RigidTransform, time_s: float) -> Mask:
    """Where a picture shows fish, (H, W)."""
    origins, directions = _rays(name, scale)
    origins, directions = pose.apply(origins), pose.rotation.apply(directions)
    nearest = fish_along(origins, directions, time_s)
    at = np.nonzero(nearest < _MAX_M)[0]
    hidden = ~np.isnan(trace(origins[at], directions[at], nearest[at]))
    shown = np.zeros(len(origins), bool)
    shown[at[~hidden]] = True
    camera = harbour_rig(scale).cameras[name]
    return shown.reshape(camera.height_px, camera.width_px)


def weed_in(name: str, scale: int, pose: RigidTransform, time_s: float) -> Mask:
    """Where a picture shows blades of weed, or would if nothing hid them, (H, W)."""
    camera = harbour_rig(scale).cameras[name]
    drawn = np.zeros((camera.height_px, camera.width_px), np.uint8)
    for blade in WEEDS:
        points = pose.inv().apply(blade.line(np.linspace(0.0, 1.0, 33), time_s))
        if points[:, 2].min() < 0.2 or points[:, 2].max() > _MAX_M:
            continue
        at = camera.project(points)
        if not (np.abs(at) < 1e4).all():
            continue
        width = 2 * blade.half_width_m * camera.focal_in_water_px / points[:, 2].mean()
        cv2.polylines(
            drawn, [np.rint(at).astype(np.int32)], False, 255, max(1, round(float(width)))
        )
    return drawn > 0
