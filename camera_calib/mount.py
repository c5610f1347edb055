"""How a rig is mounted on its vehicle: in words, as `nadir-bow-up`, or by a file."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.artefacts import read_json
from alice_survey.base.contents import one_line
from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array, pose_from_json
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
WORDS = "nadir-bow-up, -right, -down, -left; forward, aft, port, starboard; forward+30: 30 deg down"
_TILTED = re.compile(rf"({'|'.join(_LOOKS)})(?:\+(\d+(?:\.\d*)?))?")


def mount_rotation(words: str) -> Rotation:
    """Rotation from the camera (right, down, forward) to the body (forward, right, down).

    Args:
        words: `nadir-bow-up`: looks down, the bow is at the picture's top; `forward+30`: looks
            forward and 30 degrees down, the picture's top is up; see `WORDS`.

    Raises:
        CalibrationError: the words name no mount.
    """
    look, _, bow = words.partition("-bow-")
    if look == "nadir" and (bow in _TOPS or words == "nadir"):
        return _rotation(_DOWN, _TOPS[bow or "up"])
    found = _TILTED.fullmatch(words)
    if not found or float(found[2] or 0.0) > 90.0:
        raise CalibrationError(f"{words!r} is no mount: {WORDS}, or a file")
    tilt = np.deg2rad(float(found[2] or 0.0))
    level = _LOOKS[found[1]]
    return _rotation(
        np.cos(tilt) * level + np.sin(tilt) * _DOWN, np.sin(tilt) * level - np.cos(tilt) * _DOWN
    )


def _rotation(looks: Array, top: Array) -> Rotation:
    return Rotation.from_matrix(np.column_stack([np.cross(looks, top), -top, looks]))


def mount_words(body_from_cam: Rotation) -> str:
    """The nearest mount in words, and how far a rotation is from it."""
    names = [f"nadir-bow-{bow}" for bow in _TOPS]
    names += [f"{look}+{tilt}" if tilt else look for look in _LOOKS for tilt in (0, 30, 45, 60)]
    off = [(mount_rotation(name).inv() * body_from_cam).magnitude() for name in names]
    nearest = int(np.argmin(off))
    return f"{np.rad2deg(off[nearest]):.1f} deg from {names[nearest]}"


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
    path = Path(mount)
    if path.suffix == ".json" or path.is_file():
        pose = _mount_of_file(path)
    else:
        pose = RigidTransform.from_rotation(mount_rotation(mount))
        lever_m = lever_m or (0.0, 0.0, 0.0)
    if lever_m is not None:
        glass = pose.rotation.apply(rig.cameras[rig.reference].front_cam)
        pose = RigidTransform.from_components(np.array(lever_m) - glass, pose.rotation)
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
