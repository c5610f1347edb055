"""How cameras are mounted on a vehicle, found from its attitudes and the pictures (hand-eye).

A model placed by positions alone has attitudes of its own; what is between these and the measured
ones is the mount (the robot-world and hand-eye problem: Zhuang, Roth & Sudhakar 1994, with the
world's part solved first). The fit of the place then has the mount and the lever arm among its
unknowns, so that every sigma counts theirs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.frames import rotation_from_attitude
from alice_survey.base.manifest import ImageRecord
from reconstruct.placing.navigation_equations import Installation
from reconstruct.placing.placement_fit import FoundMount, PlacementFit

_AXES = ("mount_forward_deg", "mount_right_deg", "mount_down_deg")
_ARMS = ("lever_forward_m", "lever_right_m", "lever_down_m")
_UNKNOWN_RAD, _UNKNOWN_LEVER_M = 1.0, 1.0
"""Sigmas of a mount of which nothing is known, about a first value, and of its lever arm."""
_LEAST_PICTURES = 3
_STEPS = 8
_SETTLED_DEG = 1e-4
_TRIMS, _TRIMMED = 5, 3.0

Navigate = Callable[[Mapping[str, RigidTransform] | None, Installation], PlacementFit | None]
"""The fit of a model with such mounts of its cameras, known to these sigmas."""


def fit_with_mount(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    cam_from_rig: Mapping[str, RigidTransform],
    navigate: Navigate,
    usual: Installation,
) -> PlacementFit | None:
    """Place a model on a rig whose mount is unknown, and find the mount where attitudes show it.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model, in metres but for the scale.
        cam_from_rig: of the cameras.
        navigate: the fit.
        usual: sigmas of the clock and, where larger than a metre, of the lever arm.

    Returns:
        The fit, with the mount where there are attitudes; None where positions do not place the
        model.
    """
    fit = navigate(None, usual)
    if fit is None:
        return None
    turns = [
        rotation_from_attitude(*np.deg2rad([r.roll_deg, r.pitch_deg, r.heading_deg])).inv()
        * fit.ned_from_model.rotation
        * pose.rotation
        * cam_from_rig[r.camera].rotation
        for r, pose in zip(records, model_from_cam, strict=True)
        if r.has_attitude
    ]
    if len(turns) < _LEAST_PICTURES:
        return fit
    mount = RigidTransform.from_rotation(_usual(Rotation.concatenate(turns)))
    installed = replace(usual, mount_rad=_UNKNOWN_RAD, lever_m=max(usual.lever_m, _UNKNOWN_LEVER_M))
    for _ in range(_STEPS):
        mounts = {name: mount * pose.inv() for name, pose in cam_from_rig.items()}
        found = navigate(mounts, installed)
        if found is None:
            return fit
        fit = found
        turn_deg, turn_sigma_deg = np.array([found.nuisances[name] for name in _AXES]).T
        arm_m, arm_sigma_m = np.array([found.nuisances[name] for name in _ARMS]).T
        mount = RigidTransform.from_components(
            mount.translation - arm_m,
            Rotation.from_rotvec(-turn_deg, degrees=True) * mount.rotation,
        )
        if np.abs(turn_deg).max() < _SETTLED_DEG:
            break
    return replace(
        fit,
        mount=FoundMount(
            body_from_rig=mount, turn_sigma_deg=turn_sigma_deg, lever_sigma_m=arm_sigma_m
        ),
    )


def _usual(turns: Rotation) -> Rotation:
    """The mean of most of the rotations (N,)."""
    kept = turns
    for _ in range(_TRIMS):
        mean = kept.mean()
        off = (mean.inv() * turns).magnitude()
        kept = turns[np.flatnonzero(off <= _TRIMMED * np.median(off) + 1e-12)]
    return kept.mean()
