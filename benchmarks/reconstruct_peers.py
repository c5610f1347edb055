"""Other programs on a folder of pictures, each in a process of its own so that it can be measured.

    PYTHON benchmarks/reconstruct_peers.py colmap PICTURES OUT
    PYTHON benchmarks/reconstruct_peers.py pyorthomosaic PICTURES OUT

Nothing of this project is imported: PYTHON may be that of another environment. Each writes
`cameras.json`: the centre of every registered picture, in the program's own frame.
"""

import json
import sys
from pathlib import Path
from typing import Any


def colmap(pictures: Path, out: Path) -> None:
    """Stock COLMAP: default SIFT, exhaustive matching, incremental mapping, OPENCV cameras.

    One camera a folder: with one a picture, its default, it would do worse.
    """
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
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    models = pycolmap.incremental_mapping(database, pictures, out)
    if not models:
        raise SystemExit("no model")
    best = max(models.values(), key=lambda model: model.num_reg_images())
    centres = {
        image.name: image.projection_center().tolist()
        for image in best.images.values()
        if image.has_pose
    }
    points = [point.xyz.tolist() for point in best.points3D.values()]
    facts = {"models": len(models), "reprojection_px": best.compute_mean_reprojection_error()}
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


if __name__ == "__main__":
    {"colmap": colmap, "pyorthomosaic": pyorthomosaic}[sys.argv[1]](
        Path(sys.argv[2]), Path(sys.argv[3])
    )
