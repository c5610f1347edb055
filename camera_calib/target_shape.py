"""Departure of a real target from its drawing, as modes with a prior.

Boards bend: paper on a plate, a plate on its stand. A quarter of a millimetre over 200 mm moves a
focal length by near 1 %, and no view that was held out shows it, for the board is bent in all.
Printers and paper stretch: a sheet longer by 0.1 % along one side moves fx against fy by as much.

Bends are polynomials over the target's plane; those of degree 2 are mrcal's (`calobject_warp`: each
parabola is 0 at its edges) and a twist, higher degrees take up what a real plate leaves of them. In
the plane there are a stretch of x over y and a shear; the size as such is the target's.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from alice_survey.core.frames import Array
from camera_calib.freedom import Prior

OWNER = "target"
"""Stands in the place of a camera in the names of a target's parameters."""
BOW_X, BOW_Y, TWIST = f"{OWNER}.bow_x_m", f"{OWNER}.bow_y_m", f"{OWNER}.twist_m"
STRETCH, SHEAR = f"{OWNER}.stretch", f"{OWNER}.shear"
_BEND_SHARE = 1.0 / 300.0
"""Prior sigma of a bow over the target's diagonal: 1 mm for 300 mm, as of boards on plates."""
_PER_DEGREE = 0.25
"""Prior sigma of a mode over that of one degree less: bends of real plates are smooth."""
_DEGREES = 4
_IN_PLANE = 1e-3
"""Prior sigma of stretch and shear, as of paper and office printers."""
_FLAT_SHARE = 0.02
"""Largest depth over diagonal of a target that can bend as one sheet."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetShape:
    """Modes in which a target may differ from its drawing, each normally distributed about 0."""

    parameters: tuple[str, ...]
    modes: Array
    """(K, N, 3) displacement of every point for each unit of a mode."""
    prior_sigmas: Array
    """(K,)."""
    values: Array
    """(K,) what was found; 0 at first."""
    covariance: Array | None = None
    """(K, K) of the values; None before a calibration."""

    @cached_property
    def prior(self) -> Prior:
        """The modes' distribution before any view is seen."""
        mean, covariance = np.zeros(len(self.parameters)), np.diag(self.prior_sigmas**2)
        return Prior(parameters=self.parameters, mean=mean, covariance=covariance)

    @property
    def offsets_m(self) -> Array:
        """(N, 3), or 0 without modes, points minus the drawing."""
        if not self.parameters:
            return np.zeros(3)
        return np.asarray(np.einsum("k,kni->ni", self.values, self.modes))

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations by name; the prior's before a calibration."""
        spread = self.prior_sigmas
        if self.covariance is not None:
            spread = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameters, spread.tolist(), strict=True))

    def value_and_sigma(self, name: str) -> tuple[float, float]:
        """Value and sigma of one mode."""
        at = self.parameters.index(name)
        return float(self.values[at]), self.sigmas[name]

    def with_values(self, values: Array, covariance: Array | None = None) -> "TargetShape":
        """The same modes with other values."""
        return replace(self, values=values, covariance=covariance)


AS_DRAWN = TargetShape(
    parameters=(), modes=np.zeros((0, 0, 3)), prior_sigmas=np.zeros(0), values=np.zeros(0)
)
"""A target that is exactly what its drawing says."""


def is_sheet(points: Array) -> bool:
    """Whether points (N, 3) lie near the plane of x and y, as of a board that may be bent."""
    size = np.ptp(points, axis=0)
    return bool(size[:2].min() > 0.0 and size[2] <= _FLAT_SHARE * np.hypot(size[0], size[1]))


def usual_shape(points: Array) -> TargetShape:
    """Bends of a flat target, its stretch and its shear; none of a target in space.

    Args:
        points: (N, 3) as drawn, metres, the plane being that of x and y.
    """
    if not is_sheet(points):
        return AS_DRAWN
    size = np.ptp(points, axis=0)
    diagonal_m = float(np.hypot(size[0], size[1]))
    x, y = (2.0 * (points[:, :2] - points[:, :2].min(axis=0)) / size[:2] - 1.0).T
    depths = {BOW_X: 1.0 - x**2, BOW_Y: 1.0 - y**2, TWIST: x * y}
    sigmas = [_BEND_SHARE * diagonal_m] * len(depths)
    distinct = [len(np.unique(np.round(line, 6))) for line in (x, y)]
    for degree in range(3, _DEGREES + 1):
        for along in range(degree + 1):
            powers = (along, degree - along)
            if all(power < count for power, count in zip(powers, distinct, strict=True)):
                wave = legendre.legval(x, np.eye(degree + 1)[powers[0]])
                wave = wave * legendre.legval(y, np.eye(degree + 1)[powers[1]])
                depths[f"{OWNER}.bend_{powers[0]}{powers[1]}_m"] = wave
                sigmas.append(_BEND_SHARE * diagonal_m * _PER_DEGREE ** (degree - 2))
    bend = np.zeros((len(depths), len(points), 3))
    bend[..., 2] = list(depths.values())
    half_x, half_y = (0.5 * (points - points.mean(axis=0))[:, :2]).T
    plane = np.zeros((2, len(points), 3))
    plane[:, :, :2] = [np.stack([half_x, -half_y], axis=1), np.stack([half_y, half_x], axis=1)]
    return TargetShape(
        parameters=(*depths, STRETCH, SHEAR),
        modes=np.concatenate([bend, plane]),
        prior_sigmas=np.array([*sigmas, _IN_PLANE, _IN_PLANE]),
        values=np.zeros(len(sigmas) + 2),
    )
