"""How a rig is mounted on its vehicle: in words, as `nadir-bow-up`, or by a file."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import read_json
from alice_survey.core.contents import one_line
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array, pose_from_json
from camera_calib.rig import Rig, read_rig

_DOWN = np.array([0.0, 0.0, 1.0])
_TOPS = {
    "up": np.array([1.0, 0.0, 0.0]),
    "right": np.array([0.0, -1.0, 0.0]),
    "down": np.array([-1.0, 0.0, 0.0]),
    "left": np.array([0.0, 1.0, 0.0]),
}
"""Way that the top of a nadir picture points, forward, right, down, by where the bow is in it."""
_LOOKS = {
    "forward": np.array([1.0, 0.0, 0.0]),
    "starboard": np.array([0.0, 1.0, 0.0]),
    "aft": np.array([-1.0, 0.0, 0.0]),
    "port": np.array([0.0, -1.0, 0.0]),
}
MOUNTS = (
    "nadir-bow-up, -right, -down, -left; forward, aft, port, starboard; forward+30: 30 deg down"
)
_TILTED = re.compile(rf"({'|'.join(_LOOKS)})(?:\+(\d+(?:\.\d*)?))?")


def mount_rotation(words: str) -> Rotation:
    """Rotation from the camera (right, down, forward) to the body (forward, right, down).

    Args:
        words: `nadir-bow-up`: looks down, the bow is at the picture's top; `forward+30`: looks
            forward and 30 degrees down, the picture's top is up; see `MOUNTS`.

    Raises:
        CalibrationError: the words name no mount.
    """
    look, _, bow = words.partition("-bow-")
    if look == "nadir" and (bow in _TOPS or words == "nadir"):
        return _rotation(_DOWN, _TOPS[bow or "up"])
    found = _TILTED.fullmatch(words)
    if not found or float(found[2] or 0.0) > 90.0:
        raise CalibrationError(f"{words!r} is no mount: {MOUNTS}, or a file")
    tilt = np.deg2rad(float(found[2] or 0.0))
    level = _LOOKS[found[1]]
    return _rotation(
        np.cos(tilt) * level + np.sin(tilt) * _DOWN, np.sin(tilt) * level - np.cos(tilt) * _DOWN
    )


def _rotation(looks: Array, top: Array) -> Rotation:
    return Rotation.from_matrix(np.column_stack([np.cross(looks, top), -top, looks]))


def nearest_mount(body_from_cam: Rotation) -> str:
    """The nearest mount that has a name, and how far a rotation is from it, in words."""
    names = [f"nadir-bow-{bow}" for bow in _TOPS]
    names += [f"{look}+{tilt}" if tilt else look for look in _LOOKS for tilt in (0, 30, 45, 60)]
    off_deg = [
        float(np.rad2deg((mount_rotation(name).inv() * body_from_cam).magnitude()))
        for name in names
    ]
    return f"{min(off_deg):.1f} deg from {names[int(np.argmin(off_deg))]}"


def mount_line(rig: Rig) -> str:
    """The mount of a rig in words: how it looks, and where its front glass is."""
    if rig.body_from_rig is None:
        return "mount on the vehicle: unknown"
    forward, right, down = rig.body_from_rig.apply(rig.cameras[rig.reference].front_cam)
    return (
        f"mount on the vehicle: {nearest_mount(rig.body_from_rig.rotation)}; front glass of "
        f"{rig.reference} {forward:+.3f} m forward, {right:+.3f} m right, {down:+.3f} m down of "
        "the point whose position navigation states"
    )


def mount_pose(mount: str) -> tuple[RigidTransform, bool]:
    """The pose of the reference camera that words or a file state, and whether it has a place.

    Raises:
        CalibrationError: they state no mount.
    """
    if Path(mount).suffix == ".json" or Path(mount).is_file():
        return _mount_of_file(Path(mount)), True
    return RigidTransform.from_rotation(mount_rotation(mount)), False


def with_mount(rig: Rig, mount: str, lever_m: tuple[float, float, float] | None) -> Rig:
    """A rig mounted on its vehicle.

    Args:
        rig: whose mount is replaced.
        mount: in words, else a file: another `rig.json`, or one pose (`translation_m`,
            `quaternion_xyzw`) of the reference camera's pupil.
        lever_m: place of the middle of the reference camera's front glass, forward, right and
            down of the point whose position navigation states; that of the file, or zero, when
            None.

    Raises:
        CalibrationError: the words or the file state no mount.
    """
    pose, is_placed = mount_pose(mount)
    if lever_m is not None or not is_placed:
        glass = pose.rotation.apply(rig.cameras[rig.reference].front_cam)
        place = np.array(lever_m or (0.0, 0.0, 0.0))
        pose = RigidTransform.from_components(place - glass, pose.rotation)
    return replace(rig, body_from_rig=pose)


def _mount_of_file(path: Path) -> RigidTransform:
    data = read_json(path)
    if isinstance(data, dict) and "cameras" in data:
        pose = read_rig(path).body_from_rig
        if pose is None:
            raise CalibrationError(f"{path}: states no mount either")
        return pose
    try:
        return pose_from_json(data)
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path}: is neither a rig.json nor a pose of translation_m and quaternion_xyzw: "
            f"{one_line(error)}"
        ) from None
