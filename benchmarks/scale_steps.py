"""One step of `benchmarks.scale` in this process, on a survey of synthetic tracks.

python -m benchmarks.scale_steps STEP PICTURES FOLDER THREADS [--rig FILE] [--points N]
    [--unmatched N]
"""

import argparse
import json
import resource
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.block_solver import minimise
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.executor import Executor, local_executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import RegistrationRecord
from benchmarks.bend_survey import NOISE_PX, calibrated_rig
from benchmarks.scale_model import (
    ALTITUDE_M,
    DATUM,
    Block,
    block,
    near_start,
    pinhole_warps,
    records_of,
    write_mapped,
)
from camera_calib.freedom import Prior
from camera_calib.rig import Rig, read_rig
from reconstruct.adjustment.exact_observations import (
    PixelParts,
    Pixels,
    RigState,
    Workers,
    calibrated_parameters,
    linearise_parts,
)
from reconstruct.adjustment.survey_fit import SurveyProblem
from reconstruct.adjustment.uncertainty import shape_of_block
from reconstruct.dense.stereo_pairs import PointsInSight, choose_partners, neighbours
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import LIGHT, light_parts
from reconstruct.light.solve import GRID, LightSamples, as_rows, solve_light
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import map_calibrated
from reconstruct.mapping.refraction import refract
from reconstruct.matching.matches import PairMatches
from reconstruct.matching.pairs import choose_pairs, nearest_looks
from reconstruct.placing.alignment import level
from reconstruct.placing.fit import fit_navigation
from reconstruct.placing.run import run_sparse
from reconstruct.views.model import SparseModel, View, WorldFrame
from reconstruct.views.model_files import colmap_pinhole
from reconstruct.views.range_shift import range_shift

MAKE, MAPPED, PLACING = "make", "mapped", "placing"
_EXAMPLE, _QUICK_EXAMPLE, _QUICK_PICTURES = "caesarea", "demo", 500
_POINTS = 30
"""On the sea floor, of each station."""
_LATTICE, _WITNESSES = (28, 22), 8
"""Spots along a view's width and height, and views it is compared with."""
MAPPED_POINTS, UNMATCHED = 100, 1000
"""Of a station where matches are mapped, and keypoints of a picture that have no point."""
_MIN_MATCHES = 15
_WRONG, _WRONG_PX = 0.005, 20.0
"""Share of the keypoints that are wrong, and by how much."""
_LOOK = 8192
"""Numbers that describe a picture's looks."""


@dataclass(frozen=True, kw_only=True)
class StepWork:
    """A survey of so many pictures, and where the steps on it leave what they found."""

    folder: Path
    pictures: int
    executor: Executor
    rig_file: Path | None = None
    """Of a calibrated rig; an example's is calibrated where there is none."""
    points: int = MAPPED_POINTS
    """On the sea floor, of each station, where matches are mapped or their model is placed."""
    unmatched: int = UNMATCHED
    """Keypoints of a picture of such a model that have no point."""

    @property
    def own(self) -> Path:
        """Folder of this number of pictures."""
        return self.folder / f"{self.pictures}"

    @cached_property
    def rig(self) -> Rig:
        """The calibrated rig, its reference first."""
        if self.rig_file is not None:
            return read_rig(self.rig_file)
        example = _QUICK_EXAMPLE if self.pictures < _QUICK_PICTURES else _EXAMPLE
        return calibrated_rig(self.folder, example, 4, 8)

    def read(self, name: str) -> dict[str, Array]:
        """Arrays that a step left."""
        with np.load(self.own / f"{name}.npz") as data:
            return dict(data)

    def state(self, arrays: dict[str, Array]) -> RigState:
        """Stations and points of arrays."""
        names = list(self.rig.cameras)
        reference = self.rig.cam_from_rig[names[0]].inv()
        poses = {name: pose * reference for name, pose in self.rig.cam_from_rig.items()}
        return RigState(
            rig=replace(self.rig, cam_from_rig=poses), turns=arrays["turns"],
            centres=arrays["centres"], points=arrays["points"],
        )  # fmt: skip

    @cached_property
    def survey(self) -> Block:
        """The survey that was made."""
        data = self.read(MAKE)
        pixels = {
            name: data[name].astype(np.int64) for name in ("starts", "station", "camera", "point")
        }
        return Block(truth=self.state(data), pixels=Pixels(taken=data["taken"], **pixels))

    @cached_property
    def records(self) -> list[ImageRecord]:
        """Of all pictures, station by station."""
        return [
            replace(record, camera=name, image=f"{name}/{record.station:06d}.png")
            for record in records_of(self.rig, self.survey.truth)
            for name in self.rig.cameras
        ]

    def save_state(self, name: str, state: RigState, **arrays: Any) -> None:
        """Keep stations and points for later steps."""
        np.savez(
            self.own / f"{name}.npz", turns=state.turns, centres=state.centres,
            points=state.points, **arrays,
        )  # fmt: skip


Prepared = Callable[[], int]
"""The part of a step that is measured; what it works on is ready. Returns how many that is."""


def _make(work: StepWork) -> Prepared:
    rig = work.rig

    def run() -> int:
        made = block(rig, work.pictures // len(rig.cameras), _POINTS)
        work.save_state(MAKE, made.truth, **vars(made.pixels))
        return len(made.pixels.station)

    return run


def _pairs(work: StepWork) -> Prepared:
    records = work.records

    def run() -> int:
        sure, maybe = choose_pairs(records, work.rig, DATUM)
        return len(sure) + len(maybe)

    return run


def _adjust(work: StepWork) -> Prepared:
    pixels, start = work.survey.pixels, near_start(work.survey.truth)
    names = list(work.rig.cameras)

    def run() -> int:
        prior = Prior.of_rig(work.rig, calibrated_parameters(work.rig, names))
        near, order = pixels.by_place(start.centres)
        state = replace(start, points=start.points[order])
        with work.executor.start() as executor:
            workers = Workers(executor=executor, folder=work.own / "parts")
            problem = SurveyProblem(near, state, prior, workers)
            found = minimise(problem, problem.start, settled=0.05, max_steps=20)
        if not found.is_settled:
            raise RuntimeError("the adjustment did not settle")
        shutil.rmtree(work.own / "parts", ignore_errors=True)
        state = found.guess.state
        work.save_state("adjust", replace(state, points=state.points[np.argsort(order)]))
        return len(pixels.station)

    return run


def _shape(work: StepWork) -> Prepared:
    pixels, state = work.survey.pixels, work.state(work.read("adjust"))

    def run() -> int:
        near, order = pixels.by_place(state.centres)
        placed = replace(state, points=state.points[order])
        parts = PixelParts(near, len(state.centres))
        linear = linearise_parts(parts, placed, (), (NOISE_PX, NOISE_PX**2))
        shape = shape_of_block(linear, near, placed.centres, placed.points, None, scale_free=False)
        np.savez(work.own / "shape.npz", modes=shape.modes.stations)
        return len(pixels.station)

    return run


def _place(work: StepWork) -> Prepared:
    state, modes = work.state(work.read("adjust")), work.read("shape")["modes"]
    records, name = records_of(work.rig, work.survey.truth), next(iter(work.rig.cameras))
    poses = RigidTransform.from_components(state.centres, Rotation.from_matrix(state.turns))

    def run() -> int:
        fit_navigation(
            records, list(poses), {name: work.rig.body_from_cam(name)}, DATUM,
            level(state.points, state.centres), known_scale=1.0,
            modes=modes[:, [3, 4, 5, 0, 1, 2]],
        )  # fmt: skip
        return len(records)

    return run


def _mapped(work: StepWork) -> Prepared:
    """What the whole stage of the next step starts from."""
    rig, workspace = work.rig, work.own / "workspace"
    shutil.rmtree(workspace, ignore_errors=True)
    survey = block(rig, work.pictures // len(rig.cameras), work.points)

    def run() -> int:
        write_mapped(workspace, rig, survey, work.records, work.unmatched)
        return len(survey.pixels.station)

    return run


def _placing(work: StepWork) -> Prepared:
    """The whole stage: last adjustment, covariance, place and all files."""
    workspace = work.own / "workspace"
    folder = workspace / "sparse"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()

    def run() -> int:
        run_sparse(
            workspace, folder, work.executor, reconstruct=ReconstructConfig(), index_sigma=0.0
        )
        found = RegistrationRecord.read(folder / "registration.json")
        return round(found.points * found.mean_track_length)

    return run


def _light(work: StepWork) -> Prepared:
    """Samples as `check_view` leaves them: a lattice over each view, as its neighbours see it."""
    truth, names = work.survey.truth, list(work.rig.cameras)
    store = ViewStore(work.own / "store")
    store.folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(work.pictures)
    axes = [(np.arange(n) + 0.5) / n for n in _LATTICE]
    here = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    nearest = cKDTree(truth.centres).query(truth.centres, k=_WITNESSES + 1)[1]
    around = np.asarray(nearest)[:, 1:]
    lamp = -1.2 * ((here - [0.45, 0.6]) ** 2).sum(axis=1)
    counts = []
    for station, others in enumerate(around.tolist()):
        away = (truth.centres[others] - truth.centres[station]) @ truth.turns[station][:, :2]
        there = here - (away / (1.2 * ALTITUDE_M))[:, None]
        for camera in range(len(names)):
            seen, spot = np.nonzero(((there > 0) & (there < 1)).all(axis=2))
            at = there[seen, spot]
            ground = rng.normal(4.2, 0.4, (len(at), 3))
            light = np.stack([lamp[spot], -1.2 * ((at - [0.45, 0.6]) ** 2).sum(axis=1)], axis=1)
            view = len(names) * station + camera
            views = [np.full(len(at), view), len(names) * np.array(others)[seen] + camera]
            samples = LightSamples(
                views=np.stack(views, axis=1).astype(np.int32),
                places=np.stack([here[spot], at], axis=1).astype(np.float32),
                levels=(
                    ground[:, None] + light[..., None] + rng.normal(0, 0.02, (len(at), 2, 3))
                ).astype(np.float32),
            )
            store.save(view, LIGHT, as_rows(samples))
            counts.append(len(at))
    nodes = rng.normal(4.2, 0.1, (len(counts), *GRID, 3))
    images = [f"{n:06d}" for n in range(len(counts))]
    cameras = names * len(truth.centres)

    def run() -> int:
        with work.executor.start() as executor:
            solve_light(light_parts(store, counts, executor), nodes, images, cameras)
        shutil.rmtree(store.folder)
        return sum(counts)

    return run


def _looks(work: StepWork) -> Prepared:
    """Vectors as of `alike_pairs`, of pictures that navigation does not place."""
    file = work.own / "looks.npy"
    rng = np.random.default_rng(work.pictures)
    shape = (work.pictures, _LOOK)
    looks = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=shape)
    for number in range(work.pictures):
        looks[number] = rng.normal(size=_LOOK)
    looks.flush()
    blocks = [np.arange(n, min(n + 512, work.pictures)) for n in range(0, work.pictures, 512)]

    def run() -> int:
        find = partial(nearest_looks, file, np.zeros(_LOOK, np.float32), 12)
        for _ in work.executor.map(find, blocks, label="pictures that look alike"):
            pass
        file.unlink()
        return work.pictures**2

    return run


def _partners(work: StepWork) -> Prepared:
    model = _model(work)

    def run() -> int:
        chosen = choose_partners(model, 6)
        neighbours(model, 8)
        sight = PointsInSight(model)
        for number in range(len(model.views)):
            sight.of(number)
        return sum(map(len, chosen))

    return run


def _model(work: StepWork) -> SparseModel:
    """The truth as pinholes see it."""
    rig, truth, pixels = work.rig, work.survey.truth, work.survey.pixels
    warps = pinhole_warps(rig)
    shifts = {name: range_shift(warp) for name, warp in warps.items()}
    poses = RigidTransform.from_components(truth.centres, Rotation.from_matrix(truth.turns))
    in_rig = {
        name: pose.inv() * warps[name].pinhole_from_cam.inv()
        for name, pose in truth.rig.cam_from_rig.items()
    }
    views = tuple(
        View(
            image=f"{name}/{station:06d}.png", camera=name, station=station,
            pinhole=warps[name].pinhole, world_from_cam=pose * in_rig[name], shift=shifts[name],
        )
        for station, pose in enumerate(poses)
        for name in rig.cameras
    )  # fmt: skip
    return SparseModel(
        frame=WorldFrame(name="ned", datum=DATUM, scaled=True, vertical_datum=""),
        views=views,
        points_world=truth.points,
        observations=np.column_stack(
            [pixels.point, len(rig.cameras) * pixels.station + pixels.camera]
        ),
    )


def _map(work: StepWork) -> Prepared:
    """Mapping from matches as `match_pair` leaves them, a few of which are wrong."""
    rig, seen = work.rig, _matched(work)
    poses = dict(rig.cam_from_rig)

    def run() -> int:
        folder = work.own / "mapping"
        with work.executor.start() as executor:
            mapped = map_calibrated(seen, poses, folder, 1, executor=executor)
            mapped, _ = refract(mapped, seen, folder, poses, settle=False)
        mapped.model.write_binary(folder)
        shutil.rmtree(folder)
        if mapped.model.num_reg_images() < work.pictures:
            raise RuntimeError(f"{mapped.model.num_reg_images()} of {work.pictures} pictures")
        return int(mapped.model.compute_num_observations())

    return run


def _matched(work: StepWork) -> Observations:
    """Keypoints of dense tracks, and matches of the pairs that navigation chooses."""
    rig, records, rng = work.rig, work.records, np.random.default_rng(work.pictures)
    cameras = len(rig.cameras)
    pixels = block(rig, work.pictures // cameras, work.points).pixels
    wrong = np.flatnonzero(rng.uniform(size=len(pixels.taken)) < _WRONG)
    pixels.taken[wrong] += rng.normal(0, _WRONG_PX, (len(wrong), 2))
    picture = cameras * pixels.station + pixels.camera
    order = np.lexsort((pixels.point, picture))
    ends = np.cumsum(np.bincount(picture, minlength=work.pictures))[:-1]
    points = np.split(pixels.point[order], ends)
    taken: list[Array] = np.split(pixels.taken[order], ends)
    geometry = {"config": 2, **dict.fromkeys("EFH", np.eye(3))}  # COLMAP's number of a calibrated
    pairs = []
    for i, j in sorted(set().union(*choose_pairs(records, rig, DATUM))):
        _, *rows = np.intersect1d(points[i], points[j], assume_unique=True, return_indices=True)
        if len(rows[0]) >= _MIN_MATCHES:
            matches = np.stack(rows, axis=1).astype(np.uint32)
            pairs.append((i, j, PairMatches(matches=matches, geometry=geometry)))
    warps = pinhole_warps(rig)
    return Observations(
        images=records,
        cameras={name: colmap_pinhole(warp.pinhole) for name, warp in warps.items()},
        taken=taken, pairs=pairs, warps=warps,
    )  # fmt: skip


STEPS: dict[str, Callable[[StepWork], Prepared]] = {
    MAKE: _make,
    "pairs": _pairs,
    "map": _map,
    "adjust": _adjust,
    "shape": _shape,
    "place": _place,
    MAPPED: _mapped,
    PLACING: _placing,
    "partners": _partners,
    "light": _light,
    "looks": _looks,
}
"""What makes a step ready, in order."""


def _spent() -> tuple[float, float]:
    """Seconds of computing, and the peak of memory in GiB, of this process and its children."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return (
        sum(usage.ru_utime + usage.ru_stime for usage in both),
        max(usage.ru_maxrss for usage in both) / 2**20,
    )


def main() -> None:
    """Run a step and write what it took."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("step", choices=STEPS)
    parser.add_argument("pictures", type=int)
    parser.add_argument("work", type=Path)
    parser.add_argument("threads", type=int)
    parser.add_argument("--rig", type=Path)
    parser.add_argument("--points", type=int, default=MAPPED_POINTS)
    parser.add_argument("--unmatched", type=int, default=UNMATCHED)
    given = parser.parse_args()
    work = StepWork(
        folder=given.work, pictures=given.pictures, executor=local_executor(given.threads),
        rig_file=given.rig, points=given.points, unmatched=given.unmatched,
    )  # fmt: skip
    work.own.mkdir(parents=True, exist_ok=True)
    run = STEPS[given.step](work)
    before = _spent()[0]
    began = time.perf_counter()
    amount = run()
    after, peak = _spent()
    row = {"cpu_s": after - before, "peak_gib": peak, "amount": amount}
    print(given.step, row, f"wall {time.perf_counter() - began:.1f} s", flush=True)
    with atomic_path(work.own / f"{given.step}.json") as file:
        file.write_text(json.dumps(row))


if __name__ == "__main__":
    main()
