"""Whether a mapping is credible: stations against navigation, lengths against the rig.

Both are reported, not repaired: a station far off navigation may be a jump of navigation as well
as a wrong pose, and a scale that the rig's own stereo contradicts a wrong rig as well as a bent
model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import warn
from alice_survey.base.frames import Array, Datum
from alice_survey.base.manifest import ImageRecord
from alice_survey.base.robust import CAUCHY_TUNING
from alice_survey.base.run import progress
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import first_pictures
from reconstruct.mapping.database import as_transform
from reconstruct.mapping.doming import Doming, ScaleTrend, measure_doming, navigation_rotations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.priors import pinhole_positions
from reconstruct.pictures.files import named

FAR_SIGMAS, FAR_M = 5.0, 0.5
"""A station is off navigation when it misses by more than both."""
SCALE_BOUND = 1e-3
"""Relative error of lengths that a known rig must not exceed."""
_LEAST_STATIONS = 5
_ROUNDS = 20
_MEDIAN_SIGMAS = 1.5382
"""Median length of a vector of three independent unit normal numbers."""


@dataclass(frozen=True, kw_only=True)
class FarStation:
    """A station that is not where navigation places it."""

    station: int
    image: str
    off_m: float
    sigmas: float
    """Its distance over the usual one."""


@dataclass(frozen=True, kw_only=True)
class Acceptance:
    """Signs that a mapping is wrong."""

    checked: int
    """Stations with a position."""
    usual_m: float
    """Usual distance from navigation, one standard deviation by axis, robustly; NaN without."""
    far: tuple[FarStation, ...]
    """Stations off navigation, the farthest first."""
    rig_error: float
    """Relative error of the rig in the finished model; NaN where there is no known rig."""
    scale: ScaleTrend | None
    """Scale of the model against its stations' own stereo."""

    def notes(self) -> list[str]:
        """A line for every fault."""
        notes = []
        if self.far:
            names = named([f"{f.image} ({f.off_m:.2f} m)" for f in self.far])
            notes.append(
                f"{len(self.far)} of {self.checked} stations lie more than {FAR_SIGMAS:.0f} sigmas "
                f"and {FAR_M} m from where navigation has them, which others miss by "
                f"{self.usual_m:.2f} m: {names}; look at "
                "these pictures and at navigation's log"
            )
        if abs(self.rig_error) > SCALE_BOUND:
            notes.append(
                f"the rig's baseline came out {100 * self.rig_error:+.2f} % off the calibrated "
                "one: lengths are not to be trusted"
            )
        scale = self.scale
        if scale is not None and scale.off_by_more_than(SCALE_BOUND):
            notes.append(
                f"lengths are {100 * (scale.mean - 1):+.2f} +/- {100 * scale.mean_sigma:.2f} % off "
                "what every station's own stereo says: check the rig's calibration"
            )
        return notes

    def to_json(self) -> dict[str, object]:
        """Figures for `mapping.json`."""
        return {
            "checked": self.checked,
            "usual_m": self.usual_m if np.isfinite(self.usual_m) else None,
            "far": [vars(f) for f in self.far],
            "rig_error": self.rig_error if np.isfinite(self.rig_error) else None,
            "notes": self.notes(),
        }


@progress.step("judge the model")
def judge_model(
    mapped: Mapped, records: Sequence[ImageRecord], rig: Rig, datum: Datum | None
) -> tuple[Doming, Acceptance]:
    """How bent a model on a known rig is, and whether it is credible, by all that is known of it.

    Args:
        mapped: scaled by its rig; picture i of `records` has the id i + 1.
        records: pictures.
        rig: on which it was mapped.
        datum: of navigation's positions; None without.
    """
    positions = sigmas = np.full((len(records), 3), np.nan)
    if datum is not None:
        positions, sigmas = pinhole_positions(records, rig, mapped.lenses, datum)
    rotations = navigation_rotations(records, rig, mapped.lenses)
    doming = measure_doming(mapped.model, positions, sigmas, rotations)
    # What adjustments made of the rig, before its size was put back.
    rig_error = model_baseline(mapped.model) / (mapped.baseline * mapped.rig_factor) - 1.0
    accepted = check_mapping(mapped.model, records, positions, sigmas, rig_error, doming.scale)
    return doming, accepted


def check_mapping(
    model: pycolmap.Reconstruction,
    records: Sequence[ImageRecord],
    positions: Array,
    sigmas: Array,
    rig_error: float,
    scale: ScaleTrend | None,
) -> Acceptance:
    """Check a finished model on a known rig, and warn of what is wrong.

    Args:
        model: in metres; picture i of `records` has the id i + 1.
        records: pictures.
        positions: (N, 3) of the pinholes' centres in NED, as navigation has them; NaN where
            unknown.
        sigmas: (N, 3); the same for these.
        rig_error: relative error of the rig's baseline in the model; NaN without one.
        scale: of the model against its stations' own stereo.
    """
    checked, usual, far = _far_stations(model, records, positions, sigmas)
    found = Acceptance(checked=checked, usual_m=usual, far=far, rig_error=rig_error, scale=scale)
    for note in found.notes():
        warn(note)
    return found


def _far_stations(
    model: pycolmap.Reconstruction, records: Sequence[ImageRecord], positions: Array, sigmas: Array
) -> tuple[int, float, tuple[FarStation, ...]]:
    numbers = sorted(first_pictures(model, np.isfinite(positions + sigmas).all(axis=1)).values())
    if len(numbers) < _LEAST_STATIONS:
        return len(numbers), float("nan"), ()
    rows = np.array(numbers) - 1
    centres = np.array(
        [as_transform(model.images[n].cam_from_world()).inv().translation for n in numbers]
    )
    off, sigma = misses(centres, positions[rows], sigmas[rows])
    over = off / sigma
    found = [
        FarStation(
            station=records[row].station,
            image=records[row].image,
            off_m=float(off[k]),
            sigmas=float(over[k]),
        )
        for k, row in enumerate(rows.tolist())
        if off[k] > FAR_M and over[k] > FAR_SIGMAS
    ]
    ordered = tuple(sorted(found, key=lambda f: (-f.off_m, f.station)))
    return len(numbers), float(np.median(off) / _MEDIAN_SIGMAS), ordered


def misses(centres: Array, given: Array, sigmas: Array) -> tuple[Array, Array]:
    """Distances between places and where navigation has them, after a robust rigid alignment.

    Args:
        centres: (N, 3) in any frame, metres.
        given: (N, 3) in NED.
        sigmas: (N, 3) of those.

    Returns:
        (N,) distances, and (N,) their usual size by axis: the stated sigma or, where distances are
        usually larger than it says (drift), as large as they are.
    """
    stated = np.sqrt((sigmas**2).mean(axis=1))
    weight = np.ones(len(centres))
    off = np.zeros(len(centres))
    spread = 1.0
    for _ in range(_ROUNDS):
        off = np.linalg.norm(_aligned(centres, given, weight / stated**2) - given, axis=1)
        spread = max(float(np.median(off / stated)) / _MEDIAN_SIGMAS, 1e-9)
        weight = 1.0 / (1.0 + (off / (CAUCHY_TUNING * spread * stated)) ** 2)
    return off, stated * max(spread, 1.0)


def _aligned(source: Array, target: Array, weight: Array) -> Array:
    """The source where a rigid motion brings it nearest to the target (Kabsch 1976)."""
    share = weight / weight.sum()
    from_middle, to_middle = share @ source, share @ target
    u, _, vt = np.linalg.svd((target - to_middle).T @ (share[:, None] * (source - from_middle)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = Rotation.from_matrix(u @ flip @ vt)
    move = RigidTransform.from_components(to_middle - turn.apply(from_middle), turn)
    return np.asarray(move.apply(source), np.float64)
