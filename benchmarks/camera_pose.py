"""Absolute pose through a flat port, next to a published table and the Cramer-Rao bound.

The set-up is that of Refractive COLMAP's own evaluation (She et al. 2024): a new camera, port and
pose in each trial, 200 points at 0.5 to 10 m from the pupil, 30 % of them wrong by a normal error
of 200 px. What they published for it is RANSAC on three points without a refinement; errors are
means over 1000 trials of the rotation's angle and of the distance between camera centres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL, Executor
from benchmarks.absolute_pose import Sighting, absolute_pose, pose_information
from benchmarks.figures import Figure, Goal
from tests.cameras import flat_port_camera

PUBLISHED = {
    0.0: (0.0008, 0.020),
    0.2: (0.0119, 0.498),
    0.5: (0.0255, 1.000),
    1.2: (0.0610, 2.147),
    2.0: (0.0977, 3.362),
}
"""Noise (px): mean errors of rotation (degrees) and position (mm) with refraction."""

GOAL_OF_BOUND = 1.2
_SIZE = np.array([1920.0, 1080.0])
_FOCAL_PX = 1297.3655
_POINTS, _RIGHT = 200, 140
_WRONG_PX = 200.0


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Errors of one pose, and what they should be."""

    rotation_deg: float
    position_mm: float
    bound_rotation_deg: float
    """Root of the bound's trace, over the true inliers at the true pose."""
    bound_position_mm: float
    by_bound: float
    """e' B^-1 e / 6 with the bound B: 1 on average for an estimate that reaches it; NaN without
    noise."""
    by_sigma: float
    """The same by the estimate's own covariance: 1 on average when its sigmas are true."""
    missed: int
    """Right observations that were thrown away."""
    wrong: int
    """Wrong observations among the inliers."""
    sigma_px: float


@dataclass(frozen=True, kw_only=True)
class Level:
    """All trials at one level of noise."""

    noise_px: float
    trials: int
    mean_deg: float
    mean_mm: float
    rms_deg: float
    rms_mm: float
    bound_deg: float
    """Root mean square of the trials' bounds."""
    bound_mm: float
    by_bound: float
    """Root mean square of errors in units of the bound."""
    by_sigma: float
    """Root mean square of errors in units of their own sigmas."""
    missed: float
    wrong: float
    sigma_px: float

    def figures(self) -> list[Figure]:
        """Means next to the published ones, root mean squares next to the bound."""
        at, found = f"at {self.noise_px:g} px", []
        published = PUBLISHED.get(self.noise_px)
        if published is not None:
            means = (("rotation", self.mean_deg, "deg"), ("position", self.mean_mm, "mm"))
            found += [
                Figure(
                    name=f"{what} {at}, mean error", value=mean, unit=unit,
                    peer="She et al. 2024, published", peer_value=theirs,
                    goal=Goal(maximum=1.0, of="ratio"),
                )
                for (what, mean, unit), theirs in zip(means, published, strict=True)
            ]  # fmt: skip
        if self.noise_px > 0:
            found += [
                Figure(
                    name=f"{what} {at}, rms error", value=rms, unit=unit,
                    peer="Cramer-Rao bound", peer_value=bound,
                    goal=Goal(maximum=GOAL_OF_BOUND, of="ratio"),
                )
                for what, rms, unit, bound in (
                    ("rotation", self.rms_deg, "deg", self.bound_deg),
                    ("position", self.rms_mm, "mm", self.bound_mm),
                )
            ]  # fmt: skip
            found.append(
                Figure(name=f"error over sigma {at}, rms", value=self.by_sigma, unit="sigmas")
            )
        return [
            *found,
            Figure(name=f"right ones thrown away {at}", value=self.missed, unit="of 140"),
            Figure(name=f"wrong ones kept {at}", value=self.wrong, unit="of 60"),
        ]

    def misses(self) -> list[str]:
        """What falls short of the published table or of the goal, in words."""
        return [figure.miss() for figure in self.figures() if figure.met is False]


def simulated(
    rng: np.random.Generator, noise_px: float
) -> tuple[Sighting, RigidTransform, NDArray[np.bool_]]:
    """One trial's sighting, its true pose (`cam_from_world`) and which rows are right."""
    normal = rng.uniform([-0.2, -0.2, 0.8], [0.2, 0.2, 1.2])
    x, y, z = (normal / np.linalg.norm(normal)).tolist()
    camera = flat_port_camera(
        width_px=int(_SIZE[0]),
        height_px=int(_SIZE[1]),
        fx_px=_FOCAL_PX,
        fy_px=_FOCAL_PX,
        cx_px=_SIZE[0] / 2,
        cy_px=_SIZE[1] / 2,
        port_distance_m=rng.uniform(0.001, 0.050),
        glass_thickness_m=rng.uniform(0.002, 0.200),
        n_glass=1.52,
        n_water=1.334,
        normal=(x, y, z),
    )
    cam_from_world = RigidTransform.from_components(
        [rng.uniform(), 0.0, 0.0], Rotation.from_quat([rng.uniform(), 0.0, 0.0, 1.0])
    )
    pixels = rng.uniform([0.5, 0.5], _SIZE - 0.5, (_POINTS, 2))
    start, directions = camera.unproject(pixels)
    distance_m = rng.uniform(0.5, 10.0, _POINTS)
    along = (start * directions).sum(axis=1)
    reach = np.sqrt(along**2 - (start**2).sum(axis=1) + distance_m**2) - along
    points_world = cam_from_world.inv().apply(start + reach[:, None] * directions)
    right = np.arange(_POINTS) < _RIGHT
    sigma_px = np.where(right, noise_px, _WRONG_PX)
    seen = pixels + rng.normal(size=pixels.shape) * sigma_px[:, None]
    return Sighting(camera=camera, pixels=seen, points_world=points_world), cam_from_world, right


def run_trial(seed: int, noise_px: float) -> Trial:
    """Simulate, estimate and compare."""
    rng = np.random.default_rng([seed, round(noise_px * 1000)])
    sighting, cam_from_world, right = simulated(rng, noise_px)
    found = absolute_pose([sighting], rng)
    motion = cam_from_world * found.rig_from_world.inv()
    error = np.concatenate([motion.rotation.as_rotvec(), motion.translation])
    centres = [pose.inv().translation for pose in (cam_from_world, found.rig_from_world)]
    seen_right = Sighting(
        camera=sighting.camera,
        pixels=sighting.pixels[right],
        points_world=sighting.points_world[right],
    )
    information = pose_information(cam_from_world, [seen_right])
    bound = noise_px**2 * np.linalg.inv(information)
    return Trial(
        rotation_deg=float(np.rad2deg(motion.rotation.magnitude())),
        position_mm=1e3 * float(np.linalg.norm(centres[0] - centres[1])),
        bound_rotation_deg=float(np.rad2deg(np.sqrt(np.trace(bound[:3, :3])))),
        bound_position_mm=1e3 * float(np.sqrt(np.trace(bound[3:, 3:]))),
        by_bound=float(error @ information @ error) / (6 * noise_px**2) if noise_px else np.nan,
        by_sigma=float(error @ np.linalg.solve(found.covariance, error)) / 6
        if noise_px
        else np.nan,
        missed=int((right & ~found.inliers[0]).sum()),
        wrong=int((found.inliers[0] & ~right).sum()),
        sigma_px=found.sigma_px,
    )


def run_level(noise_px: float, seeds: Sequence[int], executor: Executor = SERIAL) -> Level:
    """All trials at one level of noise, of which each has its seed."""
    label = f"poses at {noise_px} px"
    trials = list(executor.map(partial(run_trial, noise_px=noise_px), seeds, label=label))

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    return Level(
        noise_px=noise_px,
        trials=len(trials),
        mean_deg=float(np.mean([t.rotation_deg for t in trials])),
        mean_mm=float(np.mean([t.position_mm for t in trials])),
        rms_deg=rms([t.rotation_deg for t in trials]),
        rms_mm=rms([t.position_mm for t in trials]),
        bound_deg=rms([t.bound_rotation_deg for t in trials]),
        bound_mm=rms([t.bound_position_mm for t in trials]),
        by_bound=float(np.sqrt(np.mean([t.by_bound for t in trials]))),
        by_sigma=float(np.sqrt(np.mean([t.by_sigma for t in trials]))),
        missed=float(np.mean([t.missed for t in trials])),
        wrong=float(np.mean([t.wrong for t in trials])),
        sigma_px=rms([t.sigma_px for t in trials]),
    )


def table(levels: Sequence[Level]) -> str:
    """The levels in Markdown, next to the published ones."""
    rows = [
        "| noise px | published deg / mm | mean deg / mm | rms deg / mm | bound deg / mm "
        "| rms / bound | error / sigma | right lost, wrong kept of 200 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for level in levels:
        published = PUBLISHED.get(level.noise_px)
        ratios = scores = "-"
        if level.noise_px > 0:
            scores = f"{level.by_sigma:.3f}"
            ratios = f"{level.rms_deg / level.bound_deg:.3f} / {level.rms_mm / level.bound_mm:.3f}"
        rows.append(
            f"| {level.noise_px} "
            f"| {'-' if published is None else f'{published[0]} / {published[1]}'} "
            f"| {level.mean_deg:.3g} / {level.mean_mm:.3g} "
            f"| {level.rms_deg:.3g} / {level.rms_mm:.3g} "
            f"| {level.bound_deg:.3g} / {level.bound_mm:.3g} | {ratios} "
            f"| {scores} | {level.missed:.2f}, {level.wrong:.2f} |"
        )
    return "\n".join(rows)
