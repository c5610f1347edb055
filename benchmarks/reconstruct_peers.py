"""Other programs on a folder of pictures, each in a process of its own so that it can be measured.

    PYTHON benchmarks/reconstruct_peers.py colmap PICTURES OUT
    PYTHON benchmarks/reconstruct_peers.py hierarchical PICTURES OUT MANIFEST
    PYTHON benchmarks/reconstruct_peers.py global PICTURES OUT MANIFEST
    PYTHON benchmarks/reconstruct_peers.py pyorthomosaic PICTURES OUT

Nothing of this project is imported: PYTHON may be that of another environment. Each writes
`cameras.json`: the centre of every registered picture, in the program's own frame.
"""

import csv
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

_PARTITIONS = 4
_REACH_M = 2.0
"""Between pictures that are matched by navigation: beyond, footprints of 2 m share nothing."""


def colmap(pictures: Path, out: Path) -> None:
    """Stock COLMAP: default SIFT, exhaustive matching, incremental mapping, OPENCV cameras.

    One camera a folder: with one a picture, its default, it would do worse.
    """
    import pycolmap

    database = _features(pictures, out)
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    _write_best(out, pycolmap.incremental_mapping(database, pictures, out), {})


def hierarchical(pictures: Path, out: Path, manifest: Path) -> None:
    """COLMAP's hierarchical mapper, in clusters of a quarter of the pictures and their overlap.

    Its default of 500 pictures a cluster would not part a survey of 400. As its manual advises,
    the merged model is triangulated and adjusted twice again.
    """
    import pycolmap

    def mapped(database: Path) -> dict[int, Any]:
        options = pycolmap.HierarchicalPipelineOptions()
        with pycolmap.Database.open(database) as opened:
            options.clustering_options.leaf_max_num_images = -(-opened.num_images() // _PARTITIONS)
        models: dict[int, Any] = pycolmap.hierarchical_mapping(database, pictures, out, options)
        for model in models.values():
            for _ in range(2):
                pycolmap.triangulate_points(model, database, pictures, out)
                pycolmap.bundle_adjustment(model)
        return models

    _by_navigation(pictures, out, manifest, mapped)


def global_mapper(pictures: Path, out: Path, manifest: Path) -> None:
    """COLMAP's global mapper, once GLOMAP, after the calibration that its manual advises."""
    import pycolmap

    def mapped(database: Path) -> dict[int, Any]:
        pycolmap.calibrate_view_graph(database)
        models: dict[int, Any] = pycolmap.global_mapping(database, pictures, out)
        return models

    _by_navigation(pictures, out, manifest, mapped)


def _by_navigation(
    pictures: Path, out: Path, manifest: Path, mapped: Callable[[Path], dict[int, Any]]
) -> None:
    """Features, matches of neighbours by navigation, and a mapper; computing of each is kept."""
    import pycolmap

    marks = [time.process_time()]
    database = _features(pictures, out)
    marks.append(time.process_time())
    with manifest.open(newline="") as file:
        places = {
            row["image"]: [
                float(row["latitude_deg"]), float(row["longitude_deg"]), -float(row["depth_m"])
            ]
            for row in csv.DictReader(file)
        }  # fmt: skip
    with pycolmap.Database.open(database) as opened:
        opened.clear_pose_priors()  # of EXIF
        for image in opened.read_all_images():
            prior = pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=places[image.name],
                coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
            )
            opened.write_pose_prior(prior)
    near = pycolmap.SpatialPairingOptions(max_distance=_REACH_M)
    pycolmap.match_spatial(database, pairing_options=near, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(database) as opened:
        pairs = opened.num_matched_image_pairs()
    marks.append(time.process_time())
    models = mapped(database)
    marks.append(time.process_time())
    names = ("features", "matching", "mapping")
    spent = {name: marks[i + 1] - marks[i] for i, name in enumerate(names)}
    _write_best(out, models, {"pairs": pairs, "cpu_s": spent})


def _features(pictures: Path, out: Path) -> Path:
    """Database of COLMAP's default SIFT, one OPENCV camera a folder."""
    import pycolmap

    out.mkdir(parents=True)
    database = out / "database.db"
    pycolmap.set_random_seed(1)
    pycolmap.extract_features(
        database,
        pictures,
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=pycolmap.ImageReaderOptions(camera_model="OPENCV"),
        device=pycolmap.Device.cpu,
    )
    return database


def _write_best(out: Path, models: dict[int, Any], facts: dict[str, Any]) -> None:
    """Write the largest of COLMAP's models."""
    if not models:
        raise SystemExit("no model")
    best = max(models.values(), key=lambda model: model.num_reg_images())
    centres = {
        image.name: image.projection_center().tolist()
        for image in best.images.values()
        if image.has_pose
    }
    points = [point.xyz.tolist() for point in best.points3D.values()]
    sizes = sorted((model.num_reg_images() for model in models.values()), reverse=True)
    facts |= {"models": sizes, "reprojection_px": best.compute_mean_reprojection_error()}
    _write(out, centres, points, facts)


def pyorthomosaic(pictures: Path, out: Path) -> None:
    """PyOrthomosaic's whole 3D pipeline with its defaults, on all pictures of all folders.

    It takes one flat folder of unlike names: links with the folder's name before.
    """
    import struct

    from orthomosaic import Options3D, build_3d

    flat = out / "pictures"
    flat.mkdir(parents=True)
    for picture in sorted(p for p in pictures.rglob("*") if p.is_file()):
        if picture.suffix.lower() in (".png", ".jpg", ".jpeg"):
            (flat / "__".join(picture.relative_to(pictures).parts)).symlink_to(picture.resolve())
    report = build_3d(str(flat), str(out), Options3D())
    centres = {name.replace("__", "/"): camera["C"] for name, camera in report["cameras"].items()}
    points = []
    sparse = out / "sparse.ply"
    if sparse.exists():
        data = sparse.read_bytes()
        header, body = data.split(b"end_header\n", 1)
        lines = header.decode().splitlines()
        count = next(int(s.split()[2]) for s in lines if s.startswith("element vertex"))
        kinds = {"float": "f", "double": "d", "uchar": "B", "uint8": "B", "float32": "f",
                 "float64": "d"}  # fmt: skip
        form = "<" + "".join(kinds[s.split()[1]] for s in lines if s.startswith("property"))
        if "format ascii 1.0" in lines:
            points = [[float(v) for v in s.split()[:3]] for s in body.decode().splitlines()]
        else:
            step = struct.calcsize(form)
            points = [list(struct.unpack_from(form, body, i * step)[:3]) for i in range(count)]
    facts = {"seconds": report["seconds"], "epsg": report["epsg"], "dsm": report["dsm"]}
    _write(out, centres, points, facts)


def _write(out: Path, centres: dict[str, Any], points: list[Any], facts: dict[str, Any]) -> None:
    data = {"centres": centres, "points": points, **facts}
    (out / "cameras.json").write_text(json.dumps(data))


_PROGRAMS: dict[str, Callable[..., None]] = {
    "colmap": colmap,
    "hierarchical": hierarchical,
    "global": global_mapper,
    "pyorthomosaic": pyorthomosaic,
}

if __name__ == "__main__":
    _PROGRAMS[sys.argv[1]](*map(Path, sys.argv[2:]))
