"""What lies in a workspace and a user may edit, or a disk may damage; and references."""

import json
from collections.abc import Callable
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.frames import Datum
from missions.values.plan_file import Plan
from tests.fuzz.target import Target

_DATUM = Datum(46.8426, -91.9946)


def small_plan() -> Plan:
    """Two lines by hand."""
    from tests.missions.exports.plans import line, plan_of

    return plan_of([line((0.0, 0.0), (5.0, 0.0)), line((5.0, 1.0), (0.0, 1.0))], [(0, 1)])


def _survey(folder: Path, name: str) -> None:
    text = (resources.files("alice_survey") / name).read_text(encoding="utf-8")
    (folder / "survey.toml").write_text(text, encoding="utf-8")


def read_survey(path: Path) -> object:
    from alice_survey.base.config import load_config

    return load_config(path)


def _plan(folder: Path) -> None:
    (folder / "plan.json").write_text(json.dumps(small_plan().to_json()))


def read_plan(path: Path) -> object:
    from missions.values.plan_file import read_plan

    return read_plan(path).to_json()


def _manifest(folder: Path) -> None:
    from alice_survey.base.manifest import ImageRecord, write_manifest

    records = [
        ImageRecord(
            image=f"{camera}/{i:06d}.png", camera=camera, station=i, time_s=2.0 * i,
            latitude_deg=32.8, longitude_deg=34.9, depth_m=13.0, roll_deg=0.1, pitch_deg=0.2,
            heading_deg=1.0, altitude_m=2.0,
        )
        for i in range(6)
        for camera in ("left", "right")
    ]  # fmt: skip
    write_manifest(folder / "manifest.csv", records)


def read_manifest(path: Path) -> object:
    from alice_survey.base.manifest import read_manifest

    return read_manifest(path)


def _track(folder: Path) -> None:
    from scipy.spatial.transform import Rotation

    from alice_survey.base.trajectory import Trajectory, write_track

    turns = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.1, 0.05, 3.0], 12))
    poses = RigidTransform.from_components(np.linspace([0, 0, 13], [10, 3, 13], 12), turns)
    write_track(folder / "track.csv", Trajectory(time_s=np.arange(12.0), ned_from_body=poses))


def read_track(path: Path) -> object:
    from alice_survey.base.trajectory import read_track

    return read_track(path)


@cache
def _scene() -> tuple[Any, Any]:
    """A survey of three stereo stations, and its lenses."""
    from tests.reconstruct.scenes import make_scene
    from tests.reconstruct.true_models import near_truth, warped_scene

    scene = make_scene(lines=1, stations=3, points=40)
    seen, lenses = warped_scene(scene)
    return scene, near_truth(scene, seen, lenses, np.random.default_rng(3))


def sparse(folder: Path) -> None:
    """A finished `sparse/`: model, cameras, frame, track."""
    from reconstruct.views.model import WorldFrame, write_frame

    scene, mapped = _scene()
    (folder / "model").mkdir(exist_ok=True)
    mapped.model.write(folder / "model")
    images = {
        r.image: {"camera": r.camera, "station": r.station, "mask": r.mask} for r in scene.records
    }
    cameras = {name: lens.to_json() for name, lens in mapped.lenses.items()}
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras, "images": images}))
    write_frame(
        folder / "frame.json",
        WorldFrame(
            name="ned", datum=_DATUM, scaled=True, vertical_datum="sea surface", notes=("a", "b")
        ),
    )
    names = "image,station,time_s,north_m,east_m,depth_m,qx,qy,qz,qw"
    rows = [f"{r.image},{r.station},{r.time_s},1,2,13,0,0,0,1" for r in scene.records]
    (folder / "track.csv").write_text("\n".join([names, *rows]) + "\n")


def read_sparse(path: Path) -> object:
    """As every stage after the mapping begins."""
    from reconstruct.views.model import read_model

    return read_model(path.parents[1] if path.parent.name == "model" else path.parent)


def read_lenses(path: Path) -> object:
    from reconstruct.pictures.undistorted import Pictures

    pictures = Pictures.from_json(path.parent, path)
    return pictures.lens("left/000000.png").size_px


def read_poses(path: Path) -> object:
    from reconstruct.placing.track import read_track_poses

    return read_track_poses(path)


def build_uncertainty(folder: Path) -> None:
    from reconstruct.mapping.uncertainty import Uncertainty, write_uncertainty

    found = Uncertainty(
        frames=np.arange(3), stations=np.arange(3), images=("a", "b", "c"),
        frame_cov=np.zeros((3, 6, 6)), point_ids=np.arange(5), point_cov=np.zeros((5, 3, 3)),
        point_noise=np.zeros((5, 3, 3)), sigma_px=0.3,
    )  # fmt: skip
    write_uncertainty(folder / "covariance.npz", found)


def read_uncertainty(path: Path) -> object:
    from reconstruct.mapping.uncertainty import read_uncertainty

    return read_uncertainty(path)


def read_frame(path: Path) -> object:
    from reconstruct.views.model import read_frame as read

    return read(path)


def _json(name: str, value: Callable[[], Any]) -> Callable[[Path], None]:
    return lambda folder: _dump(folder / name, value())


def _dump(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1))


def _survey_json() -> dict[str, Any]:
    datum = {"latitude_deg": 32.8, "longitude_deg": 34.9}
    return {"source": "imported", "datum": datum, "vertical_datum": "sea", "notes": ["x"]}


def read_inputs(path: Path) -> object:
    """As `reconstruct` begins: `images/` of a workspace."""
    from reconstruct.mapping.run import read_inputs

    return read_inputs(path.parents[1])


def _images(folder: Path) -> None:
    from tests.fuzz.cameras import picture

    images = folder / "images"
    images.mkdir(exist_ok=True)
    rows = ["image,camera,station,time_s,latitude_deg,longitude_deg,depth_m"]
    for i in range(2):
        picture(images / f"{i}.png")
        rows.append(f"{i}.png,camera,{i},{i}.0,32.8,34.9,13")
    (images / "manifest.csv").write_text("\n".join(rows) + "\n")
    _dump(images / "survey.json", _survey_json())
    _dump(images / "stage.json", _record("images"))


def _record(name: str) -> dict[str, Any]:
    return {
        "stage": name, "version": 1, "digest": "0", "settings": {"folders": 1},
        "inputs": {"a.png": [1, 2, "3"]}, "took_s": 1.5,
    }  # fmt: skip


def read_status(path: Path) -> object:
    """As `status` does, of a workspace of imported pictures."""
    from alice_survey.survey import workspace_status

    return workspace_status(path.parents[1], None)


def _mosaic_light() -> dict[str, Any]:
    return {
        "format": "alice-survey light", "version": 1, "channels": ["blue", "green", "red"],
        "white": [1.0, 1.0, 1.0], "patterns": {"left": [[[1.0, 1.0, 1.0]]]},
        "gains": {"left/0.png": [1.0, 1.0, 1.0]},
    }  # fmt: skip


def read_light(path: Path) -> object:
    from reconstruct.light.solve import read_light

    return read_light(path)


def _control(folder: Path) -> None:
    rows = [
        "kind,name,use,latitude_deg,longitude_deg,north_m,east_m,easting_m,northing_m,epsg,"
        "depth_m,height_m,sigma_m,sigma_vertical_m,from,to,length_m",
        "point,A,control,46.8426,-91.9946,,,,,,13,,0.01,,,,",
        "point,B,check,,,1,2,,,,13.5,,0.01,0.02,,,",
        "point,C,control,,,,,576000,5188000,32615,,100,0.01,,,,",
        "bar,AB,control,,,,,,,,,,0.001,,A,B,1.5",
        "marker,7,check,,,,,,,,,,0.001,,,,0.2",
    ]
    (folder / "control.csv").write_text("\n".join(rows) + "\n")


def read_control(path: Path) -> object:
    from reconstruct.placing.control_file import read_control

    control = read_control(path)
    datum = control.datum() or _DATUM
    return [point.ned(datum) for point in control.points]


def _picks(folder: Path) -> None:
    rows = [f"left/{i:06d}.png,A,{100 + i}.5,200,0.4" for i in range(6)]
    (folder / "picks.csv").write_text("\n".join(["image,point,x,y,sigma_px", *rows]) + "\n")


def read_picks(path: Path) -> object:
    from reconstruct.placing.control_file import read_picks

    return read_picks(path)


def points() -> Any:
    """(N, 3) of a hilly ground."""
    xy = np.random.default_rng(4).uniform(-10, 10, (400, 2))
    return np.column_stack([xy, 0.8 * np.sin(xy[:, 0] / 2) + 160.0])


def _own_cloud(folder: Path) -> None:
    from reconstruct.dense.cloud import VERTEX, write_cloud
    from reconstruct.views.model import WorldFrame

    rows = np.zeros(400, VERTEX)
    rows["x"], rows["y"], rows["z"] = points().T
    rows["nz"] = 1.0
    frame = WorldFrame(name="ned", datum=_DATUM, scaled=True, vertical_datum="sea")
    write_cloud(folder / "cloud.ply", [rows], (0.0, 0.0, 0.0), frame)


def read_own_cloud(path: Path) -> object:
    from reconstruct.ply import open_cloud

    cloud = open_cloud(path)
    return cloud.inside(-1.0, 1.0, -1.0, 1.0), cloud.sample(10)


def _reference_ply(folder: Path) -> None:
    head = ["ply", "format ascii 1.0", "element vertex 400"]
    head += [*(f"property double {axis}" for axis in "xyz"), "end_header"]
    rows = [" ".join(f"{value:.4f}" for value in row) for row in points()]
    (folder / "a.ply").write_text("\n".join([*head, *rows]) + "\n")


def build_las(folder: Path, name: str) -> None:
    import laspy
    from pyproj import CRS

    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = [5.76e5, 5.188e6, 0.0], [1e-3] * 3
    header.add_crs(CRS.from_epsg(32615))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (points() + np.array([576_600.0, 5_188_200.0, 0.0])).T
    cloud.write(str(folder / name))


def _reference_dem(folder: Path) -> None:
    import rasterio
    from rasterio.transform import from_origin

    height = (160 + np.arange(900).reshape(30, 30) / 100).astype(np.float32)
    with rasterio.open(
        folder / "a.tif", "w", driver="GTiff", width=30, height=30, count=1, dtype="float32",
        crs="EPSG:32615", transform=from_origin(576_600, 5_188_200, 0.5, 0.5), tiled=True,
        blockxsize=16, blockysize=16, compress="lzw",
    ) as file:  # fmt: skip
        file.write(height, 1)


def read_reference(path: Path) -> object:
    from reconstruct.evaluate.cloud_files import read_reference

    return read_reference(path, _DATUM)


def _other_survey(folder: Path) -> None:
    """What `evaluate --against` reads of a workspace."""
    (folder / "sparse").mkdir(exist_ok=True)
    (folder / "dense").mkdir(exist_ok=True)
    sparse(folder / "sparse")
    for name in ("sparse", "dense"):
        _dump(folder / name / "stage.json", _record(name))
    _reference_dem(folder / "dense")
    (folder / "dense" / "a.tif").rename(folder / "dense" / "dem.tif")
    (folder / "dense" / "sigma.tif").write_bytes((folder / "dense" / "dem.tif").read_bytes())
    _own_cloud(folder / "dense")


def read_other(path: Path) -> object:
    from reconstruct.evaluate.elevation import read_elevation

    return read_elevation(path.parents[1])


def read_other_cloud(path: Path) -> object:
    from reconstruct.evaluate.cloud_files import read_own_cloud

    return read_own_cloud(path.parents[1])


def _target(
    name: str, syntax: str, file: str, build: Callable[[Path], None],
    read: Callable[[Path], object], **more: Any,
) -> Target:  # fmt: skip
    return Target(name=name, syntax=syntax, file=file, build=build, read=read, **more)  # type: ignore[arg-type]


TARGETS = (
    _target(
        "survey.toml", "toml", "survey.toml", partial(_survey, name="survey.toml"), read_survey
    ),
    _target(
        "survey.toml, demo", "toml", "survey.toml", partial(_survey, name="demo.toml"), read_survey
    ),
    _target("plan.json", "json", "plan.json", _plan, read_plan),
    _target("manifest", "csv", "manifest.csv", _manifest, read_manifest),
    _target("track.csv of a flight", "csv", "track.csv", _track, read_track),
    *(
        _target(
            f"COLMAP model, {name}", "binary", f"model/{name}", sparse, read_sparse, native=True
        )
        for name in ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")
    ),
    _target("cameras.json", "json", "cameras.json", sparse, read_sparse),
    _target("cameras.json, lenses", "json", "cameras.json", sparse, read_lenses),
    _target("frame.json", "json", "frame.json", sparse, read_sparse),
    _target("track.csv of a model", "csv", "track.csv", sparse, read_poses),
    _target("covariance.npz", "binary", "covariance.npz", build_uncertainty, read_uncertainty),
    _target("survey.json", "json", "images/survey.json", _images, read_inputs),
    _target("stage.json", "json", "images/stage.json", _images, read_status),
    _target("manifest of pictures", "csv", "images/manifest.csv", _images, read_inputs),
    _target("light.json", "json", "light.json", _json("light.json", _mosaic_light), read_light),
    _target("control.csv", "csv", "control.csv", _control, read_control),
    _target("picks.csv", "csv", "picks.csv", _picks, read_picks),
    _target("cloud.ply to mesh", "binary", "cloud.ply", _own_cloud, read_own_cloud),
    _target("reference PLY", "text", "a.ply", _reference_ply, read_reference),
    _target("reference PLY, binary", "binary", "cloud.ply", _own_cloud, read_reference),
    _target(
        "reference LAS", "binary", "a.las", partial(build_las, name="a.las"), read_reference,
        native=True,
    ),
    _target(
        "reference LAZ", "binary", "a.laz", partial(build_las, name="a.laz"), read_reference,
        native=True, examples=4,
    ),
    _target("reference DEM", "binary", "a.tif", _reference_dem, read_reference, native=True),
    _target("other survey, dem.tif", "binary", "dense/dem.tif", _other_survey, read_other,
            native=True),
    _target("other survey, frame.json", "json", "sparse/frame.json", _other_survey, read_other),
    _target("other survey, cloud.ply", "binary", "dense/cloud.ply", _other_survey,
            read_other_cloud, native=True),
)  # fmt: skip
