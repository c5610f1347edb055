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

from alice_survey.core.errors import Level, collected_by, note, warn
from alice_survey.core.frames import rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from reconstruct.placing.navigation_equations import Installation
from reconstruct.placing.placement_fit import FoundMount, PlacementFit

_AXES = ("mount_forward_deg", "mount_right_deg", "mount_down_deg")
_ARMS = ("lever_forward_m", "lever_right_m", "lever_down_m")
_UNKNOWN_RAD, _UNKNOWN_LEVER_M = 1.0, 1.0
"""Sigmas of a mount of which nothing is known, about a first value, and of its lever arm."""
_MIN_PICTURES = 3
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
        model. Of all fits on the way only this one's notes and warnings are reported.
    """
    fit, messages = _collected(navigate, None, usual)
    first = None if fit is None else _first_mount(records, model_from_cam, cam_from_rig, fit)
    if first is not None:
        known = replace(usual, mount_rad=_UNKNOWN_RAD, lever_m=max(usual.lever_m, _UNKNOWN_LEVER_M))
        mount = RigidTransform.from_rotation(first)
        for _ in range(_STEPS):
            mounts = {name: mount * pose.inv() for name, pose in cam_from_rig.items()}
            found, said = _collected(navigate, mounts, known)
            if found is None:
                break
            turn_deg, turn_sigma_deg = np.array([found.nuisances[name] for name in _AXES]).T
            arm_m, arm_sigma_m = np.array([found.nuisances[name] for name in _ARMS]).T
            mount = RigidTransform.from_components(
                mount.translation - arm_m,
                Rotation.from_rotvec(-turn_deg, degrees=True) * mount.rotation,
            )
            corrected = FoundMount(
                body_from_rig=mount, turn_sigma_deg=turn_sigma_deg, lever_sigma_m=arm_sigma_m
            )
            fit, messages = replace(found, mount=corrected), said
            if np.abs(turn_deg).max() < _SETTLED_DEG:
                break
    for level, text in messages:
        (warn if level == "warning" else note)(text)
    return fit


def _first_mount(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    cam_from_rig: Mapping[str, RigidTransform],
    fit: PlacementFit,
) -> Rotation | None:
    """Rotation from rig to body by attitudes at a place; None where there are too few."""
    turns = [
        rotation_from_attitude(*np.deg2rad([r.roll_deg, r.pitch_deg, r.heading_deg])).inv()
        * fit.ned_from_model.rotation
        * pose.rotation
        * cam_from_rig[r.camera].rotation
        for r, pose in zip(records, model_from_cam, strict=True)
        if r.has_attitude
    ]
    return _usual(Rotation.concatenate(turns)) if len(turns) >= _MIN_PICTURES else None


def _collected(
    navigate: Navigate, mounts: Mapping[str, RigidTransform] | None, installed: Installation
) -> tuple[PlacementFit | None, list[tuple[Level, str]]]:
    """A fit, and its notes and warnings, which are not reported yet."""
    messages: list[tuple[Level, str]] = []
    with collected_by(lambda *message: messages.append(message)):
        return navigate(mounts, installed), messages


def _usual(turns: Rotation) -> Rotation:
    """The mean of most of the rotations (N,)."""
    kept = turns
    for _ in range(_TRIMS):
        mean = kept.mean()
        off = (mean.inv() * turns).magnitude()
        kept = turns[np.flatnonzero(off <= _TRIMMED * np.median(off) + 1e-12)]
    return kept.mean()
