"""How bent, how far off and how honest a model of a long survey is: tracks of a known truth.

    python -m benchmarks.bend --work FOLDER [--seeds 3] [--flights 3] [--log flown drawn]
        [--only TEXT ...] [--pool-scale 4] [--far-port] [--adjust MODULE:FUNCTION]
        [--quick] [--json FILE]

Every seed draws the error of a calibration from its covariance, points on the sea floor, noise of
pixels and, with `--log drawn`, that of navigation; the flights are those of the example `caesarea`
with seeds of their own. The last adjustment and the placing are the pipeline's. A row is the root
mean square over the seeds, with what the model states of itself in brackets: the sag of a
paraboloid through the heights of the cameras' errors, along and across the block; the cameras after
rigid alignment; the scale; and errors over stated sigmas of the sag, the shape, and the place and
attitude of all stations. FOLDER keeps the flights and the calibration.
"""

import importlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import AliceError
from benchmarks.bend_pipeline import Adjust, Adjusted, adjusted
from benchmarks.bend_survey import (
    LOGS,
    Fault,
    FlownTrack,
    Logbook,
    calibrated_rig,
    fly,
    start,
    wrong_rig,
)
from benchmarks.figures import Figure, Findings, Parser, hand_over
from camera_calib.rig import Rig
from reconstruct.placing.alignment import align_rigid, align_similarity, sag_weights

_FIRST_SEED = 11
"""Of the flights: the example's own."""
_EXAMPLE, _QUICK_EXAMPLE = "caesarea", "demo"
_SCALE = 8
_SOUND = Fault()


@dataclass(frozen=True, kw_only=True)
class Case:
    """A row of the table."""

    name: str
    worse: float = 1.0
    """Error of the calibration over what it states."""
    fault: Fault = _SOUND


CASES = (
    Case(name="calibration as stated"),
    Case(name="calibration 3 times worse", worse=3.0),
    Case(name="clock off by 1 s", fault=Fault(clock_s=1.0)),
    Case(name="heading off by 3 deg", fault=Fault(heading_deg=3.0)),
    Case(name="depth drifts by 0.2 m", fault=Fault(depth_m=0.2)),
    Case(name="positions stretched by 0.5 %", fault=Fault(stretch=0.005)),
    Case(name="two dives, 1 m apart by their fixes", fault=Fault(jump_m=1.0)),
    Case(name="white noise 3 times larger", fault=Fault(white=3.0)),
    Case(name="correlation 3 times longer", fault=Fault(tau=3.0)),
    Case(name="sigmas stated 3 times too large", fault=Fault(sigmas=3.0)),
    Case(name="sigmas stated 3 times too small", fault=Fault(sigmas=1.0 / 3.0)),
)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Errors of one model and what it states of them; metres, and relative scale."""

    along: float
    along_sigma: float
    across: float
    across_sigma: float
    cameras: float
    cameras_sigma: float
    scale: float
    scale_sigma: float
    along_ratio: float
    across_ratio: float
    cameras_ratio: float
    """Errors over sigmas from here on; of all stations' shape."""
    north_ratio: float
    east_ratio: float
    depth_ratio: float
    tilt_ratio: float
    heading_ratio: float


def main() -> None:
    """Print the table."""
    parser = Parser(
        __doc__,
        quick="one survey of the demo, calibration as stated and 3 times worse",
        work="keeps flights and calibration",
    )
    parser.add_argument("--seeds", type=int, default=3, help="surveys of each row")
    parser.add_argument("--flights", type=int, default=3, help="flights that they share")
    parser.add_argument("--log", nargs="+", choices=sorted(LOGS), default=["flown"])
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="rows with this text")
    parser.add_argument(
        "--pool-scale", type=int, default=4, help="pixels of the sensor in one of the pool's"
    )
    parser.add_argument("--far-port", action="store_true", help="ports at 100 mm, 2 deg tilted")
    parser.add_argument("--adjust", metavar="MODULE:FUNCTION", help="instead of the pipeline's")
    options, about = parser.begin("numpy", "scipy", "pycolmap")
    options.cases = [
        case for case in CASES if not options.only or any(t in case.name for t in options.only)
    ]
    if options.quick:
        options.seeds, options.cases = 1, CASES[:2]
    if options.adjust is None:
        options.adjust = adjusted
    else:
        module, _, function = options.adjust.partition(":")
        options.adjust = getattr(importlib.import_module(module), function)
    pycolmap.logging.minloglevel = 2
    example = _QUICK_EXAMPLE if options.quick else _EXAMPLE
    rig = calibrated_rig(
        options.work, example, options.pool_scale, _SCALE, far_port=options.far_port
    )
    flights = [
        fly(options.work, example, _FIRST_SEED + k)
        for k in range(min(options.flights, options.seeds))
    ]
    print(f"{', '.join(str(len(flight.taken_s)) for flight in flights)} stations\n")
    figures: list[Figure] = []
    failed: list[str] = []
    rows = {(log, case): Outcome() for log in options.log for case in options.cases}
    for seed in range(options.seeds):  # all cases of a flight in turn: they share its sea floor
        for (log, case), outcome in rows.items():
            outcome.add(seed, case, flights, rig, LOGS[log], options.adjust)
    for (log, case), outcome in rows.items():
        name = f"{case.name}, log {log}"
        failed += [f"{name}: {why}" for why in outcome.refused]
        if outcome.scores:
            row = over_seeds(outcome.scores)
            seconds = outcome.seconds / options.seeds
            print(f"{name}: {seconds:.1f} s a seed, {len(outcome.refused)} refused", flush=True)
            figures += _figures(name, row)
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures), failed=tuple(failed))))


@dataclass
class Outcome:
    """Scores of the seeds of a case, and why some of them gave no model."""

    scores: list[Score] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def add(
        self,
        seed: int,
        case: Case,
        flights: Sequence[FlownTrack],
        rig: Rig,
        log: Logbook,
        adjust: Adjust,
    ) -> None:
        """Survey with one more seed."""
        began = time.process_time()
        track = flights[seed % len(flights)]
        read = log(track, case.fault, seed).with_fault(case.fault)
        begun = start(track, rig, wrong_rig(rig, case.worse, seed), read, seed)
        with TemporaryDirectory() as folder:
            try:
                found = adjust(
                    begun.mapped, begun.seen, rig, begun.distances, begun.datum, Path(folder)
                )
            except AliceError as error:
                self.refused.append(f"seed {seed}: {error}")
                return
        pairs = zip(begun.scene.ned_from_cam, begun.scene.records, strict=True)
        true = [pose for pose, record in pairs if record.camera == rig.reference]
        self.scores.append(score(found, RigidTransform.concatenate(true)))
        self.seconds += time.process_time() - began


def score(found: Adjusted, true: RigidTransform) -> Score:
    """Compare a placed model with its truth, (S,) `ned_from_cam` of the reference camera."""
    at = found.ned_from_cam.translation
    aligned = align_rigid(at, true.translation).apply(at)
    off = aligned - true.translation
    sags = np.append(sag_weights(true.translation[:, :2]) @ -off[:, 2], np.nan)[:2]
    along_sigma, across_sigma = (*found.bend_sigmas_m, np.nan)[:2]
    own = np.diagonal(found.shape, axis1=1, axis2=2)[:, :3]
    sigmas = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
    turns = (found.ned_from_cam.rotation * true.rotation.inv()).as_rotvec()
    ratio = np.column_stack([at - true.translation, turns]) / sigmas
    ratios = np.sqrt(np.nanmean(ratio**2, axis=0))
    stated = np.sqrt(np.nanmean(own.sum(axis=1)))
    return Score(
        along=float(sags[0]),
        along_sigma=along_sigma,
        across=float(sags[1]),
        across_sigma=across_sigma,
        cameras=float(np.sqrt((off**2).sum(axis=1).mean())),
        cameras_sigma=float(stated),
        scale=1.0 / align_similarity(at, true.translation).scale - 1.0,
        scale_sigma=found.scale_sigma,
        along_ratio=float(sags[0]) / along_sigma,
        across_ratio=float(sags[1]) / across_sigma,
        cameras_ratio=float(np.sqrt(np.nanmean(off**2 / own))),
        north_ratio=float(ratios[0]),
        east_ratio=float(ratios[1]),
        depth_ratio=float(ratios[2]),
        tilt_ratio=float(np.sqrt((ratios[3:5] ** 2).mean())),
        heading_ratio=float(ratios[5]),
    )


def over_seeds(scores: Sequence[Score]) -> Score:
    """Root mean square of every value; what one of them does not state is left out."""
    values = {f.name: np.array([getattr(s, f.name) for s in scores]) for f in fields(Score)}
    known = {name: column[np.isfinite(column)] for name, column in values.items()}
    return Score(
        **{
            name: float(np.sqrt(np.mean(column**2))) if len(column) else float("nan")
            for name, column in known.items()
        }
    )


_MM, _PPM = 1e3, 1e6


def _figures(name: str, row: Score) -> list[Figure]:
    wanted = (
        ("bend along", "mm", _MM * row.along, _MM * row.along_sigma),
        ("bend across", "mm", _MM * row.across, _MM * row.across_sigma),
        ("rms of cameras", "mm", _MM * row.cameras, _MM * row.cameras_sigma),
        ("scale", "ppm", _PPM * row.scale, _PPM * row.scale_sigma),
    )
    figures = [
        Figure(name=f"{name}: {what}", value=value, unit=unit, peer="stated", peer_value=stated)
        if np.isfinite(stated)
        else Figure(name=f"{name}: {what}", value=value, unit=unit)
        for what, unit, value, stated in wanted
    ]
    ratios = [f.name for f in fields(Score) if f.name.endswith("_ratio")]
    return figures + [
        Figure(
            name=f"{name}: {ratio.removesuffix('_ratio')}, error over sigma",
            value=getattr(row, ratio),
            unit="",
        )
        for ratio in ratios
        if np.isfinite(getattr(row, ratio))
    ]


if __name__ == "__main__":
    main()
