"""Pictures of a calibration: which files there are, and which were taken at the same moment."""

import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from alice_survey.core.errors import CalibrationError, warn
from camera_calib.picture_files import KINDS

SUFFIXES = tuple(suffix for kind in KINDS.values() for suffix in kind)
_MIN_PAIRED = 0.5
"""Share of each list whose numbers must be in another for names to pair."""
_NAMED = 3


@dataclass(frozen=True, kw_only=True)
class PictureSet:
    """Pictures of one moment."""

    name: str
    paths: Mapping[str, Path]
    """By camera."""


def find_pictures(place: str) -> list[Path]:
    """Pictures in a folder or of a pattern such as 'left*.jpg', in the order of their names.

    Raises:
        CalibrationError: there are none.
    """
    if Path(place).is_dir():
        found = [p for p in sorted(Path(place).iterdir()) if p.suffix.lower() in SUFFIXES]
    else:
        root = Path(Path(place).anchor)
        matches = sorted(root.glob(str(Path(place).relative_to(root))))
        found = [p for p in matches if p.is_file() and p.suffix.lower() in SUFFIXES]
    if not found:
        raise CalibrationError(
            f"no pictures at {place}: give a folder or a pattern in quotes, such as 'left*.png' "
            f"({', '.join(SUFFIXES)})"
        )
    return found


def pair_pictures(lists: Mapping[str, Sequence[Path]]) -> list[PictureSet]:
    """Which pictures of two or more cameras belong together.

    By the last number in their names where most pictures of each camera share theirs with another
    camera; else by their order, where all cameras have the same count. A picture without partners
    still shows its camera alone.

    Args:
        lists: by camera, in the order of their names.

    Raises:
        CalibrationError: the lists do not pair.
    """
    if len(lists) == 1:
        ((camera, paths),) = lists.items()
        return [PictureSet(name=path.stem, paths={camera: path}) for path in paths]
    numbered = {camera: _by_number(paths) for camera, paths in lists.items()}
    if all(numbered.values()):
        counts = Counter(number for found in numbered.values() for number in found)
        shared = {c: sum(counts[n] > 1 for n in found) for c, found in numbered.items()}
        if all(shared[c] >= _MIN_PAIRED * len(found) for c, found in numbered.items()):
            return _paired_by_number(numbered)
    if len({len(paths) for paths in lists.values()}) > 1:
        described = ", ".join(
            f"{len(paths)} of {camera} ({_some([p.name for p in paths])})"
            for camera, paths in lists.items()
        )
        raise CalibrationError(
            f"pictures do not pair: {described}: name those of one moment with one number, or "
            "give lists of the same length"
        )
    if all(numbered.values()):
        names = ", ".join(f"{paths[0].name} of {camera}" for camera, paths in lists.items())
        warn(f"numbers in the names differ: pictures are paired by their order, first {names}")
    sets = zip(*lists.values(), strict=True)
    return [
        PictureSet(name=paths[0].stem, paths=dict(zip(lists, paths, strict=True))) for paths in sets
    ]


def check_own(lists: Mapping[str, Sequence[Path]]) -> None:
    """Check that no two cameras have the same pictures, be it as copies.

    Raises:
        CalibrationError: they have.
    """
    owners: dict[bytes, tuple[str, Path]] = {}
    sizes = Counter(path.stat().st_size for paths in lists.values() for path in paths)
    for camera, paths in lists.items():
        for path in paths:
            if sizes[path.stat().st_size] == 1:
                continue
            content = hashlib.sha256(path.read_bytes()).digest()
            owner, other = owners.setdefault(content, (camera, path))
            if owner != camera:
                raise CalibrationError(
                    f"{owner} and {camera} have the same picture, {other} and {path}: give each "
                    "camera the pictures that it took"
                )


def _by_number(paths: Sequence[Path]) -> dict[int, Path]:
    """Pictures by the last number in their names; empty where not each has one of its own."""
    numbers = [re.findall(r"\d+", path.stem) for path in paths]
    if not all(numbers):
        return {}
    found = {int(digits[-1]): path for digits, path in zip(numbers, paths, strict=True)}
    return found if len(found) == len(paths) else {}


def _paired_by_number(numbered: Mapping[str, Mapping[int, Path]]) -> list[PictureSet]:
    everywhere = Counter(number for found in numbered.values() for number in found)
    alone = [number for number, count in everywhere.items() if count == 1]
    if alone:
        odd = [found[n].name for found in numbered.values() for n in sorted(alone) if n in found]
        warn(f"{len(odd)} pictures without a partner serve their camera alone: {_some(odd)}")
    width = len(str(max(everywhere)))
    return [
        PictureSet(
            name=f"{number:0{width}d}",
            paths={camera: found[number] for camera, found in numbered.items() if number in found},
        )
        for number in sorted(everywhere)
    ]


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
