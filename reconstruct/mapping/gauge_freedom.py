"""Motions of a whole block that its pictures do not see."""

import numpy as np

from alice_survey.base.frames import Array
from reconstruct.mapping.normal_equations import POSE


class Gauge:
    """Motions of a whole block that pictures do not see."""

    def __init__(self, centres: Array, depth: float, scale_free: bool) -> None:
        """Of stations at (F, 3); `depth`, a usual one, weighs turns against positions."""
        self.middle = centres.mean(axis=0)
        arms = centres - self.middle
        count = len(arms)
        self.motions = np.zeros((count, POSE, 7 if scale_free else 6))
        for axis in range(3):
            unit = np.eye(3)[axis]
            self.motions[:, :3, axis] = unit
            self.motions[:, 3:, axis] = np.cross(unit, arms)
            self.motions[:, 3:, 3 + axis] = unit
        if scale_free:
            self.motions[:, 3:, 6] = arms
        self.weights = np.tile([depth**2] * 3 + [1.0] * 3, count)
        flat = self.flat
        self.spread = np.linalg.inv(flat.T @ (self.weights[:, None] * flat))
        far = int(np.argmax(np.linalg.norm(arms - arms[0], axis=1)))
        self.held = list(range(POSE))
        if scale_free:
            along = int(np.argmax(np.abs(arms[far] - arms[0])))
            self.held.append(POSE * far + 3 + along)

    @property
    def flat(self) -> Array:
        """(6 F, 6 or 7)."""
        return self.motions.reshape(-1, self.motions.shape[2])

    def of_points(self, points: Array) -> Array:
        """What the same motions do to (N, 3) points, (N, 3, 6 or 7)."""
        arms = points - self.middle
        found = np.zeros((len(arms), 3, self.motions.shape[2]))
        for axis in range(3):
            found[:, :, axis] = np.cross(np.eye(3)[axis], arms)
            found[:, axis, 3 + axis] = 1.0
        if found.shape[2] > POSE:
            found[:, :, POSE] = arms
        return found
