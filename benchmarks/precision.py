"""Whether surveys err as their plans predict, and whether one more cross line buys what is said.

    python -m benchmarks.precision --work FOLDER [--seeds 30] [--only TEXT ...] [--quick]
        [--json FILE]

Plans of three shapes are flown exactly but for a little sway, each with as many seeds of
calibration, points, pixels and navigation as requested (`benchmarks.bend_survey`), and end in the
pipeline's last adjustment and placing. A row compares the root mean square of their errors with
what was predicted from the plan alone: the sag along and across, the scale, and heights of the
surface after a rigid alignment. Then the square with four cross lines: whether these take
off the bend what was said. FOLDER keeps the
calibration.
"""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.core.trajectory import Trajectory
from benchmarks import bend_survey
from benchmarks.bend import score
from benchmarks.bend_pipeline import adjusted
from benchmarks.bend_survey import Fault, FlownTrack, calibrated_rig, drawn, start, wrong_rig
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from camera_calib.rig import Rig
from missions.plan.planner import plan_survey
from missions.plan.strength import survey_costs
from missions.values.plan_file import Plan
from reconstruct.placing.alignment import align_rigid
from reconstruct.precision.instruments import ChannelErrors, NavigationErrors
from reconstruct.precision.predict import Precision, by_cell, predict
from reconstruct.precision.run import Candidate, stations_and_times
from reconstruct.precision.tracks import TrackModel

NAMES = ("bend along, mm", "bend across, mm", "scale, ppm", "heights, mm")
_UNITS = np.array([1e3, 1e3, 1e6, 1e3])
_WITHIN, _GAIN_WITHIN = 0.3, 0.5
_SWAY_M, _SWAY_DEG = 0.03, 0.5
_CELLS = 3.0
"""Sides of cells over those of a prediction: in the median of a cell's points their own noise is
lost."""
_KEYPOINT_BIAS_PX = 0.006
"""Of rendered surveys; the reconstruction and the prediction allow for 0.01."""
_SWAY = 99
"""Stream of random numbers."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """An area of a survey like that of Caesarea."""

    name: str
    length_m: float
    width_m: float
    first_seed: int
    cross_lines: int = 1
    closing_line: bool = True

    def config(self, settings: SurveyConfig) -> SurveyConfig:
        """The settings of its survey."""
        size = {"length_m": self.length_m, "width_m": self.width_m}
        lines = {"cross_lines": self.cross_lines, "closing_line": self.closing_line}
        return settings.model_copy(
            update={
                "area": settings.area.model_copy(update=size),
                "plan": settings.plan.model_copy(update=lines),
            }
        )


SHAPES = (
    Shape(name="strip", first_seed=0, length_m=18.0, width_m=4.0),
    Shape(name="corridor", first_seed=1000, length_m=24.0, width_m=1.5, cross_lines=0),
    Shape(
        name="square", first_seed=2000, length_m=9.0, width_m=9.0, cross_lines=0, closing_line=False
    ),
)
CROSSED = replace(SHAPES[-1], name="square with four cross lines", cross_lines=4)
"""Set against the one before."""


def errors_of_drawn_logs(span_s: float) -> NavigationErrors:
    """What the logs of `bend_survey.drawn` are drawn from, of a flight of some length."""
    b = bend_survey
    return NavigationErrors(
        channels={
            "horizontal": ChannelErrors(
                constant=b.FIX_M, slow=b.WALK_M * np.sqrt(span_s / 2.0), slow_s=span_s,
                white=b.LEVEL_WHITE_M,
            ),
            "depth": ChannelErrors(
                constant=b.DEPTH_CONSTANT_M, slow=b.DEPTH_SLOW_M, slow_s=b.DEPTH_SLOW_S,
                white=b.DEPTH_WHITE_M,
            ),
            "tilt": ChannelErrors(
                constant=np.deg2rad(b.TILT_DEG), slow=0.0, slow_s=1.0,
                white=np.deg2rad(b.ATTITUDE_WHITE_DEG),
            ),
            "heading": ChannelErrors(
                constant=np.deg2rad(b.HEADING_DEG), slow=0.0, slow_s=1.0,
                white=np.deg2rad(b.ATTITUDE_WHITE_DEG),
            ),
        },
        turn_rad=float(np.deg2rad(b.HEADING_DEG)),
        stretch=b.STRETCH,
    )  # fmt: skip


def predicted(plan: Plan, rig: Rig, config: SurveyConfig) -> Precision:
    """What the plan alone says of such surveys."""
    poses, time_s = stations_and_times(plan, rig, survey_costs(config))
    pictures = len(poses) * len(rig.cameras)
    tracks = TrackModel(
        per_picture=bend_survey.OBSERVATIONS / pictures, matched=bend_survey.MATCHED,
        noise_px=bend_survey.NOISE_PX,
    )  # fmt: skip
    block = Candidate(config=config, made=plan, rig=rig).block(tracks)
    return predict(block, errors_of_drawn_logs(float(np.ptp(time_s))))


def swayed(plan: Plan, rig: Rig, config: SurveyConfig, seed: int) -> FlownTrack:
    """A flight of the plan with a little sway."""
    rng = np.random.default_rng([seed, _SWAY])
    poses, time_s = stations_and_times(plan, rig, survey_costs(config))
    turns = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(_SWAY_DEG), (len(poses), 3)))
    places = poses.translation + rng.normal(0.0, _SWAY_M, (len(poses), 3))
    flown = RigidTransform.from_components(places, turns * poses.rotation)
    corners = np.array(plan.area.allowed_corners_ne, dtype=np.float64).reshape(-1, 2)
    return FlownTrack(
        config=config, datum=plan.datum, corners_ne=corners, taken_s=time_s,
        truth=Trajectory(time_s=time_s, ned_from_body=flown), log=None,
    )  # fmt: skip


def errors(track: FlownTrack, rig: Rig, cell_m: float, seed: int) -> Array:
    """Sag along and across, scale, and rms of heights, of one reconstructed survey; metres."""
    read, true_rig = (
        drawn(track, Fault(), seed),
        wrong_rig(rig, 1.0, seed, bias_px=_KEYPOINT_BIAS_PX),
    )
    begun = start(track, rig, true_rig, read, seed)
    with TemporaryDirectory() as folder:
        found = adjusted(begun.mapped, begun.seen, rig, begun.distances, begun.datum, Path(folder))
    pairs = zip(begun.scene.ned_from_cam, begun.scene.records, strict=True)
    true = RigidTransform.concatenate(
        [pose for pose, record in pairs if record.camera == rig.reference]
    )
    row = score(found, true)
    aligned = align_rigid(found.ned_from_cam.translation, true.translation)
    ids = sorted(found.points_ned)
    at = aligned.apply(np.array([found.points_ned[i] for i in ids]))
    spots = begun.scene.points_ned[np.array(ids) - 1]
    off = by_cell(spots[:, :2], at[:, 2] - spots[:, 2], _CELLS * cell_m)[1]
    return np.array([row.along, row.across, row.scale, np.sqrt((off**2).mean())])


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """Surveys of one plan against what was predicted."""

    stations: int
    said: Array
    """(4,) predicted sigmas of `NAMES`, in their units."""
    rms: Array
    """(4,) errors, root mean square over the surveys."""
    seconds: float
    """Of a survey."""


def compare(config: SurveyConfig, rig: Rig, seeds: range) -> Compared:
    """Plan, predict, and make that many surveys."""
    plan = plan_survey(config, rig).plan
    expected = predicted(plan, rig, config)
    said = np.array([*expected.bend_m, expected.scale, expected.heights_rms_m])
    began = time.process_time()
    found = [errors(swayed(plan, rig, config, seed), rig, expected.cell_m, seed) for seed in seeds]
    rms = np.sqrt((np.array(found) ** 2).mean(axis=0))
    return Compared(
        stations=plan.stations, said=_UNITS * said, rms=_UNITS * rms,
        seconds=(time.process_time() - began) / len(seeds),
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = Parser(
        __doc__,
        quick="four surveys of the square without cross lines",
        work="keeps the calibration",
    )
    parser.add_argument("--seeds", type=int, default=30, help="surveys of each plan")
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="shapes")
    options, about = parser.begin("numpy", "scipy", "pycolmap")
    shapes = [s for s in SHAPES if not options.only or any(t in s.name for t in options.only)]
    if options.quick:
        options.seeds, shapes = 4, [SHAPES[-1]]
    pycolmap.logging.minloglevel = 2
    settings, rig = (
        bend_survey.example_config(options.work, "caesarea"),
        calibrated_rig(options.work, "caesarea", 4, 8),
    )
    figures: list[Figure] = []
    done = {}
    for shape in shapes if options.quick else [*shapes, CROSSED]:
        seeds = range(shape.first_seed, shape.first_seed + options.seeds)
        done[shape.name] = compare(shape.config(settings), rig, seeds)
        figures += _figures(shape.name, done[shape.name], judged=not options.quick)
    if {SHAPES[-1].name, CROSSED.name} <= set(done):
        figures.append(_gain(done[SHAPES[-1].name], done[CROSSED.name]))
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures))))


def _gain(plain: Compared, crossed: Compared) -> Figure:
    """What cross lines take off the bend along and across together, against what was said."""
    real, said = (
        1.0 - float(np.linalg.norm(after[:2]) / np.linalg.norm(before[:2]))
        for before, after in ((plain.rms, crossed.rms), (plain.said, crossed.said))
    )
    goal = Goal(minimum=1.0 - _GAIN_WITHIN, maximum=1.0 + _GAIN_WITHIN, of="ratio")
    return Figure(
        name="gain of cross lines", value=real, unit="", peer="predicted", peer_value=said,
        goal=goal,
    )  # fmt: skip


def _figures(name: str, found: Compared, *, judged: bool) -> list[Figure]:
    """Figures of a row; few surveys are not judged."""
    print(f"{name}: {found.stations} stations, {found.seconds:.1f} s a survey", flush=True)
    goal = Goal(minimum=1.0 / (1.0 + _WITHIN), maximum=1.0 / (1.0 - _WITHIN), of="ratio")
    return [
        Figure(
            name=f"{name}: {what.split(',')[0]}", value=float(rms), unit=what.split()[-1],
            peer="predicted", peer_value=float(said), goal=goal if judged else None,
        )
        for what, rms, said in zip(NAMES, found.rms, found.said, strict=True)
        if np.isfinite(said)
    ]  # fmt: skip


if __name__ == "__main__":
    main()
