"""A model placed by navigation or control, and how well: `georeference.json`."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.frames import Array, pose_to_json
from camera_calib.mount import nearest_mount
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.bend import Bend
from reconstruct.placing.navigation_equations import PLACE, SCALE, Installation
from reconstruct.placing.placement_problem import Correlation

_METHOD = (
    "generalised least squares; errors of navigation as first-order Gauss-Markov processes of the "
    "stated sigmas, correlation times and white shares by restricted maximum likelihood"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMount:
    """How the rig is mounted on the vehicle, found with the place."""

    body_from_rig: RigidTransform
    turn_sigma_deg: Array
    """(3,) about the vehicle's axes forward, right, down."""
    lever_sigma_m: Array
    """(3,) forward, right, down."""

    @property
    def words(self) -> str:
        """What was found, with its sigmas."""
        arm = zip(self.body_from_rig.translation, self.lever_sigma_m, strict=True)
        forward, right, down = (f"{value:+.2f} (sigma {sigma:.2g})" for value, sigma in arm)
        return (
            f"mount found: {nearest_mount(self.body_from_rig.rotation)}, sigma "
            f"{self.turn_sigma_deg.max():.2g} deg; pupil {forward} m forward, {right} m right, "
            f"{down} m down"
        )

    def to_json(self) -> dict[str, Any]:
        """What `georeference.json` says."""
        return {
            "words": self.words,
            "body_from_rig": pose_to_json(self.body_from_rig),
            "turn_sigma_deg": self.turn_sigma_deg.tolist(),
            "lever_sigma_m": self.lever_sigma_m.tolist(),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementFit:
    """A model placed by navigation, and how well."""

    ned_from_model: Similarity
    used: int
    """Stations with a position (without any, with a depth) that took part."""
    left_out: Mapping[str, int]
    """For each group of channels, how many readings the rest contradicts."""
    rms_m: Array
    """(3,) north, east, down misses of the positions that took part, root mean square; NaN where
    none did."""
    free_scale: float
    """Scale that a similarity would choose: 1 where navigation agrees with the known scale."""
    free_scale_sigma: float
    middle_ned: Array
    """(3,) middle of the camera track, about which the covariance's rotation and scale act."""
    correlation: Mapping[str, Correlation]
    """For each group, how navigation's errors are correlated."""
    time_unit: str
    installed: Installation
    modes: Array
    """(K,) sizes of the model's soft modes, in their sigmas."""
    mode_factor: float
    """How many times larger such modes are than the pictures' sigmas say, 1 or more."""
    joint: Array
    """(7 + K, 7 + K) covariance of the placement (as `covariance`) and the modes."""
    bends: tuple[Bend, ...]
    """How bent the model is still, along the block and, where it is wide, across; none where
    stations are too few."""
    nuisances: Mapping[str, tuple[float, float]]
    """What was found of the errors of the lever arm (m), the clock (s), the mount (degrees) and
    navigation's own frame (turn in degrees, stretch), and their sigmas."""
    mount: FoundMount | None = None
    """The mount, where it was not known."""

    @property
    def covariance(self) -> Array:
        """(7, 7) of the placement.

        Rotation about north, east, down (rad), shift north, east, down of the middle (m), and the
        logarithm of the scale.
        """
        return self.joint[:PLACE, :PLACE]

    @property
    def sigma_position_m(self) -> Array:
        """(3,) sigma of the middle of the track, north, east and down."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:6]))

    @property
    def sigma_tilt_deg(self) -> Array:
        """(2,) sigma of rotation about north and about east."""
        return np.asarray(np.rad2deg(np.sqrt(np.diag(self.covariance)[:2])))

    @property
    def sigma_heading_deg(self) -> float:
        """Sigma of rotation about down."""
        return float(np.rad2deg(np.sqrt(self.covariance[2, 2])))

    @property
    def sigma_scale(self) -> float:
        """Sigma of the logarithm of the scale, 0 where it is held."""
        return float(np.sqrt(self.covariance[SCALE, SCALE]))

    def to_json(self) -> dict[str, Any]:
        """What `georeference.json` says."""
        tilts, axes = np.linalg.eigh(self.covariance[:2, :2])
        axis = np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])) % 180.0
        # What is the model's own by choice has no sigma.
        north, east, down = (sigma or None for sigma in self.sigma_position_m.tolist())
        return {
            "format": "alice-survey georeference",
            "version": 1,
            "method": _METHOD,
            "stations": self.used,
            "left_out": dict(self.left_out),
            **{
                f"rms_{axis}_m": None if np.isnan(rms_m) else float(rms_m)
                for axis, rms_m in zip(("north", "east", "depth"), self.rms_m, strict=True)
            },
            "sigma_north_m": north,
            "sigma_east_m": east,
            "sigma_depth_m": down,
            "sigma_heading_deg": self.sigma_heading_deg or None,
            "sigma_tilt_deg": float(np.rad2deg(np.sqrt(tilts.mean()))) or None,
            "sigma_tilt_north_deg": float(self.sigma_tilt_deg[0]),
            "sigma_tilt_east_deg": float(self.sigma_tilt_deg[1]),
            "largest_tilt_deg": float(np.rad2deg(np.sqrt(tilts[1]))),
            "largest_tilt_axis_deg": float(axis),
            "sigma_scale": self.sigma_scale,
            "scale_of_navigation": self.free_scale,
            "scale_of_navigation_sigma": self.free_scale_sigma,
            "mount_sigma_deg": math.degrees(self.installed.mount_rad),
            "lever_sigma_m": self.installed.lever_m,
            "clock_sigma_s": self.installed.clock_s,
            "nuisances": {
                name: {"value": found, "sigma": sigma}
                for name, (found, sigma) in self.nuisances.items()
            },
            "mount": None if self.mount is None else self.mount.to_json(),
            "soft_modes": self.modes.tolist(),
            "soft_modes_factor": self.mode_factor,
            "middle_ned_m": self.middle_ned.tolist(),
            "covariance": self.covariance.tolist(),
            "covariance_order": [
                "rotation_north_rad", "rotation_east_rad", "rotation_down_rad",
                "north_m", "east_m", "down_m", "log_scale",
            ],
            "errors": {
                group: {
                    f"correlation_{'s' if self.time_unit == 's' else 'stations'}": how.tau,
                    "white_share": how.white,
                    "constant_share": how.constant,
                    "sigma_factor": how.factor,
                    "dive_constants": how.restart,
                }
                for group, how in self.correlation.items()
            },
        }  # fmt: skip
