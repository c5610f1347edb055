"""What the stages after the sparse model cost by the number of pictures: one tile, repeated.

    python -m benchmarks.many_pictures --work FOLDER [--pictures 400 2000 10000] [--threads 2]
        [--quick] [--json FILE]

A survey of 15 stations is rendered and reconstructed. Then it is repeated on a lattice: its
pictures are linked under new names, and its placed model is moved. `alice-survey reconstruct` makes
surface, mosaic and mesh of that; a run that was interrupted continues. A row has seconds of
computing, the peak of memory of the command and of the largest of its workers, and the peak of what
an unfinished stage takes on disk. Heights of all copies are compared with those of the one tile.
What mapping costs is measured with synthetic tracks (`benchmarks.scale_steps`).
"""

import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pycolmap
import rasterio
from rasterio.windows import Window
from scipy.spatial.transform import RigidTransform

from alice_survey.app.api.survey import Survey
from alice_survey.app.stages import spec
from alice_survey.core.artefacts import (
    Stage,
    read_csv,
    read_json,
    read_stage,
    run_stage,
    write_csv,
    write_json,
)
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from benchmarks.measured import python
from benchmarks.reconstruct_surveys import demo_like, render
from benchmarks.scale import growth, measure
from benchmarks.scale_steps import MAKE
from reconstruct.views.model import read_frame
from reconstruct.views.model_files import as_transform, read_reconstruction, rigid3d

_STAGES = ("dense", "mosaic", "mesh")
_SETTINGS = "dense_scale = 0.3\nmosaic_pixel_m = 0.025\n"
"""What costs is the number of pictures; their pixels are few."""
_GAP_M = 0.4
"""Between copies, whose surfaces would not fit together."""
_MAX_GIB = 8.0
_MAX_EXPONENT = 1.25
_STATIONS, _MAX_RMS_MM = 3, 1.0
_EVERY_S = 0.5
_WALKING = 30.0
"""Time between looks at the disk over the time that one takes."""


@dataclass(frozen=True, kw_only=True)
class Peaks:
    """The largest that was seen of a stage."""

    parent_gib: float = 0.0
    worker_gib: float = 0.0
    """Of one worker."""
    open_files: int = 0
    """Of one process."""
    disk_gib: float = 0.0
    files: int = 0

    def joined(self, other: "Peaks") -> "Peaks":
        """The larger of each."""
        names = [field.name for field in fields(Peaks)]
        return Peaks(**{name: max(getattr(self, name), getattr(other, name)) for name in names})


@dataclass(frozen=True, kw_only=True)
class StageCost(Peaks):
    """What a stage took."""

    stage: str
    pictures: int
    cpu_s: float
    wall_s: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Copies of a tile."""

    tile: Path
    """Its workspace."""
    shifts: Array
    """(K, 3) north, east and down from the tile to the copies, metres."""

    def number(self, name: str, copy: int, stations: int) -> str:
        """The name of a copy's picture."""
        camera, station = name.removesuffix(".png").split("/")
        return f"{camera}/{int(station) + copy * stations:06d}.png"


def make_tile(work: Path) -> Path:
    """Render and reconstruct the tile, unless that is done."""
    tile = work / "tile"
    render(tile, demo_like(1.2, 1.5, 16) + _SETTINGS)
    subprocess.run(reconstruct(tile, 1), check=True, stdout=subprocess.DEVNULL)
    return tile


def reconstruct(workspace: Path, threads: int) -> list[str]:
    """The command that makes all stages of a workspace."""
    return python("-m", "alice_survey", "reconstruct", "-w", str(workspace), "--quiet",
                  "--threads", str(threads), "--device", "cpu",
                  "--log-file", str(workspace / "events.jsonl"))  # fmt: skip


def lattice_of(tile: Path, copies: int) -> Lattice:
    """A square of copies of a tile, apart by whole cells of its surface."""
    with rasterio.open(tile / "dense" / "dem.tif") as dem:
        cell, sides = dem.transform.a, np.array([dem.height, dem.width])
    steps = cell * (sides + math.ceil(_GAP_M / cell))
    across = math.ceil(math.sqrt(copies))
    at = np.column_stack(np.divmod(np.arange(copies), across))
    return Lattice(tile=tile, shifts=np.column_stack([at * steps, np.zeros(copies)]))


def repeat(lattice: Lattice, workspace: Path) -> int:
    """Make the stages before the surface, unless they are there; return how many pictures."""
    tile = lattice.tile
    workspace.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(tile / "survey.toml", workspace / "survey.toml")
    for name in ("pool", "calibration"):
        if not (workspace / name).exists():
            (workspace / name).symlink_to((tile / name).resolve())
    records = read_manifest(tile / "images" / "manifest.csv")
    count = len(records) * len(lattice.shifts)
    images = Stage(name="images", version=1, settings={"shifts": lattice.shifts.tolist()})
    run_stage(workspace, images, partial(_link_pictures, lattice, records))
    config = Survey(workspace).config
    counts = {"registered": count, "total": count}
    for name, write in (("mapping", _say), ("placing", _move_model)):
        stage = spec(name).stage(workspace, config)
        run_stage(workspace, stage, partial(write, lattice, counts))
    return count


def _link_pictures(lattice: Lattice, records: Sequence[ImageRecord], folder: Path) -> None:
    source, datum = lattice.tile / "images", read_frame(lattice.tile / "sparse/frame.json").datum
    assert datum is not None
    stations = 1 + max(record.station for record in records)
    places = np.array([[r.latitude_deg, r.longitude_deg, r.depth_m] for r in records])
    span = 60.0 + float(np.ptp([record.time_s for record in records]))
    made = []
    for copy, shift in enumerate(lattice.shifts):
        moved = datum.geodetic_from_ned(datum.ned_from_geodetic(places) + shift)
        for record, place in zip(records, moved.tolist(), strict=True):
            name = lattice.number(record.image, copy, stations)
            (folder / name).parent.mkdir(exist_ok=True)
            os.link((source / record.image).resolve(), folder / name)
            made.append(
                replace(
                    record, image=name, station=record.station + copy * stations,
                    time_s=record.time_s + copy * span, latitude_deg=place[0],
                    longitude_deg=place[1], depth_m=place[2],
                )
            )  # fmt: skip
    write_manifest(folder / "manifest.csv", made)
    shutil.copyfile(source / "survey.json", folder / "survey.json")


def _say(lattice: Lattice, counts: dict[str, int], folder: Path) -> None:
    about = read_json(lattice.tile / "mapping" / "mapping.json")
    write_json(folder / "mapping.json", {**about, **counts})


def _move_model(lattice: Lattice, counts: dict[str, int], folder: Path) -> None:
    sparse = lattice.tile / "sparse"
    shutil.copyfile(sparse / "frame.json", folder / "frame.json")
    about = read_json(sparse / "registration.json")
    write_json(folder / "registration.json", {**about, **counts})
    cameras = read_json(sparse / "cameras.json")
    stations = 1 + max(image["station"] for image in cameras["images"].values())
    images = {
        lattice.number(name, copy, stations): {**it, "station": it["station"] + copy * stations}
        for copy in range(len(lattice.shifts))
        for name, it in cameras["images"].items()
    }
    write_json(folder / "cameras.json", {**cameras, "images": images})
    names, rows = read_csv(sparse / "track.csv")
    moved = [
        {
            **row,
            "image": lattice.number(row["image"], copy, stations),
            "station": int(row["station"]) + copy * stations,
            "north_m": float(row["north_m"]) + north,
            "east_m": float(row["east_m"]) + east,
        }
        for copy, (north, east, _) in enumerate(lattice.shifts.tolist())
        for _, row in rows
    ]
    write_csv(folder / "track.csv", names, ([row[name] for name in names] for row in moved))
    with np.load(sparse / "covariance.npz") as data:
        known: dict[str, Any] = dict(data)
    copies = len(lattice.shifts)
    for name, array in known.items():
        if array.ndim:
            known[name] = np.concatenate([array] * copies)
    known["point_ids"] = np.arange(1, 1 + len(known["point_ids"]))
    np.savez(folder / "covariance.npz", **known)
    (folder / "model").mkdir()
    model = _repeated(read_reconstruction(sparse / "model"), lattice, stations)
    model.write_binary(folder / "model")


def _repeated(
    model: pycolmap.Reconstruction, lattice: Lattice, stations: int
) -> pycolmap.Reconstruction:
    """A model with all copies; points by copy, and in the order of their ids."""
    whole = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        whole.add_camera(camera)
    for rig in model.rigs.values():
        whole.add_rig(rig)
    images, frames = max(model.images), max(model.frames)
    rows = {n: pycolmap.Point2DList([pycolmap.Point2D(p.xy) for p in image.points2D])
            for n, image in model.images.items()}  # fmt: skip
    points = [
        (p.xyz, [(e.image_id, e.point2D_idx) for e in p.track.elements], p.color)
        for _, p in sorted(model.points3D.items())
    ]
    for copy, shift in enumerate(lattice.shifts):
        tile_from_world = RigidTransform.from_translation(-shift)
        for number in sorted(model.reg_frame_ids()):
            theirs, own = model.frames[number], number + copy * frames
            frame = pycolmap.Frame(frame_id=own, rig_id=theirs.rig_id)
            for data in theirs.image_ids:
                frame.add_data_id(pycolmap.data_t(data.sensor_id, data.id + copy * images))
            whole.add_frame(frame)
            pose = as_transform(theirs.rig_from_world) * tile_from_world
            whole.frames[own].rig_from_world = rigid3d(pose)
            for data in theirs.image_ids:
                image = model.images[data.id]
                whole.add_image(
                    pycolmap.Image(
                        name=lattice.number(image.name, copy, stations),
                        image_id=data.id + copy * images, camera_id=image.camera_id,
                        frame_id=own, points2D=rows[data.id],
                    )
                )  # fmt: skip
            whole.register_frame(own)
        for xyz, track, colour in points:
            elements = [pycolmap.TrackElement(n + copy * images, row) for n, row in track]
            whole.add_point3D(xyz + shift, pycolmap.Track(elements), colour)
    return whole


def run_watched(workspace: Path, threads: int) -> bool:
    """Run all stages and keep the peaks of each in a file; return whether it went well."""
    file = workspace / "peaks.json"
    seen = {name: Peaks(**one) for name, one in (read_json(file) if file.exists() else {}).items()}
    process = subprocess.Popen(reconstruct(workspace, threads), stdout=subprocess.DEVNULL)
    walk_at = 0.0
    while process.poll() is None:
        for stage in _STAGES:
            partial_folder = workspace / f"{stage}.partial"
            if not partial_folder.exists():
                continue
            now = _look(process.pid)
            if time.monotonic() > walk_at:
                began = time.monotonic()
                now = now.joined(_walk(partial_folder))
                walk_at = time.monotonic() + _WALKING * (time.monotonic() - began)
            seen[stage] = seen.get(stage, Peaks()).joined(now)
            write_json(file, {name: asdict(one) for name, one in seen.items()})
        time.sleep(_EVERY_S)
    return process.returncode == 0


def _look(pid: int) -> Peaks:
    try:
        parent = psutil.Process(pid)
        workers = parent.children(recursive=True)
        sizes = [one.memory_info().rss / 2**30 for one in (parent, *workers)]
        handles = [one.num_fds() for one in (parent, *workers)]
    except psutil.Error:
        return Peaks()
    return Peaks(parent_gib=sizes[0], worker_gib=max(sizes[1:], default=0.0),
                 open_files=max(handles))  # fmt: skip


def _walk(folder: Path) -> Peaks:
    size = count = 0
    for path, _, names in os.walk(folder):
        for name in names:
            try:
                size += 512 * Path(path, name).stat().st_blocks
                count += 1
            except FileNotFoundError:
                continue
    return Peaks(disk_gib=size / 2**30, files=count)


def costs_of(workspace: Path, pictures: int) -> list[StageCost]:
    """What the finished stages of a workspace took."""
    peaks, found = read_json(workspace / "peaks.json"), []
    for stage in _STAGES:
        record = read_stage(workspace / stage)
        if record is not None:
            found.append(
                StageCost(
                    **peaks[stage], stage=stage, pictures=pictures,
                    cpu_s=record.cpu_s or math.nan, wall_s=record.took_s,
                )
            )  # fmt: skip
    return found


def heights_apart(lattice: Lattice, workspace: Path) -> tuple[float, float]:
    """How far heights of copies and of the tile differ, rms in mm, and the share of cells kept.

    Of cells that three stations see: what one alone sees moves with the stated noise of matches,
    which is measured on a few views.
    """
    squares, common, wanted = 0.0, 0, 0
    with (
        rasterio.open(lattice.tile / "dense" / "dem.tif") as one,
        rasterio.open(lattice.tile / "dense" / "stations.tif") as stations,
        rasterio.open(workspace / "dense" / "dem.tif") as every,
    ):
        cell, tile = one.transform.a, one.read(1)
        tile[stations.read(1) < _STATIONS] = np.nan
        for north, east, _ in lattice.shifts.tolist():
            column = round((one.transform.c + east - every.transform.c) / cell)
            row = round((every.transform.f - one.transform.f - north) / cell)
            window = Window(column, row, one.width, one.height)
            apart = every.read(1, window=window, boundless=True, fill_value=np.nan) - tile
            apart = apart[np.isfinite(apart)]
            squares += float((apart.astype(np.float64) ** 2).sum())
            common, wanted = common + len(apart), wanted + int(np.isfinite(tile).sum())
    return 1e3 * math.sqrt(squares / max(common, 1)), common / max(wanted, 1)


def mapping_of(tile: Path, pictures: int, work: Path, threads: int) -> StageCost | None:
    """What mapping synthetic tracks on the tile's rig takes; None where it failed."""
    folder, rig = work / "tracks", tile / "calibration" / "rig.json"
    folder.mkdir(exist_ok=True)
    for step in (MAKE, "map"):
        row = measure(step, pictures, folder, threads, "--rig", str(rig))
    if row is None:
        return None
    return StageCost(stage="mapping", pictures=pictures, cpu_s=row.cpu_s, wall_s=math.nan,
                     parent_gib=row.peak_gib)  # fmt: skip


def heights_of(lattice: Lattice, workspace: Path, pictures: int) -> list[Figure]:
    """Figures of the surface."""
    rms, share = heights_apart(lattice, workspace)
    print(f"{'':8}{pictures:>9}  heights {rms:.3f} mm from the tile's, {share:.2%} of cells")
    return [
        Figure(name=f"{pictures} pictures: heights against one tile's", value=rms, unit="mm",
               goal=Goal(maximum=_MAX_RMS_MM)),
        Figure(name=f"{pictures} pictures: cells of the tile", value=share, unit="",
               goal=Goal(minimum=0.99, maximum=1.0)),
    ]  # fmt: skip


def figures_of(rows: Sequence[StageCost], *, judged: bool) -> list[Figure]:
    """Figures of one stage, by rising number of pictures; small surveys are not judged."""
    name, found = rows[0].stage, []
    for row in rows:
        own = f"{name}: {row.pictures} pictures"
        found += [
            Figure(name=f"{own}, time", value=row.cpu_s, unit="s"),
            Figure(name=f"{own}, parent", value=row.parent_gib, unit="GiB",
                   goal=Goal(maximum=_MAX_GIB) if judged else None),
            Figure(name=f"{own}, disk", value=row.disk_gib, unit="GiB"),
        ]  # fmt: skip
    if len(rows) > 1:
        first, last = rows[-2:]
        power = growth(first.cpu_s, last.cpu_s, last.pictures / first.pictures)
        found.append(Figure(name=f"{name}: exponent", value=power, unit="",
                            goal=Goal(maximum=_MAX_EXPONENT) if judged else None))  # fmt: skip
    return found


def main() -> None:
    """Print the table."""
    parser = Parser(__doc__, quick="90 pictures", work="keeps surveys and results")
    parser.add_argument("--pictures", type=int, nargs="+", default=[400, 2000, 10000], metavar="N")
    parser.add_argument("--threads", type=int, default=2, help="workers")
    options, about = parser.begin("numpy", "scipy", "opencv-contrib-python-headless", "rasterio")
    if options.quick:
        options.pictures = [80]
    tile = make_tile(options.work)
    own = len(read_manifest(tile / "images" / "manifest.csv"))
    rows: dict[str, list[StageCost]] = {}
    figures, failed = [], []
    for wanted in sorted(options.pictures):
        lattice = lattice_of(tile, -(-wanted // own))
        workspace = options.work / f"{wanted}"
        pictures = repeat(lattice, workspace)
        made = run_watched(workspace, options.threads)
        if not made:
            failed.append(f"{pictures} pictures")
        mapped = mapping_of(tile, wanted, options.work, options.threads)
        if mapped is None:
            failed.append(f"mapping of {wanted} pictures")
        for row in (*((mapped,) if mapped else ()), *costs_of(workspace, pictures)):
            rows.setdefault(row.stage, []).append(row)
        if made:
            figures += heights_of(lattice, workspace, pictures)
    for of_stage in rows.values():
        figures += figures_of(of_stage, judged=not options.quick)
    kept = {stage: [asdict(row) for row in of_stage] for stage, of_stage in rows.items()}
    findings = Findings(figures=tuple(figures), failed=tuple(failed))
    sys.exit(hand_over(options, about, findings, {"stages": kept}))


if __name__ == "__main__":
    main()
