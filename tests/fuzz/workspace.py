"""Files of a workspace that a user writes, and references of other programs."""

import re
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.frames import Datum
from alice_survey.core.settings_form import settings_template
from missions.values.plan_file import Plan
from tests.fuzz.target import Target

_DATUM = Datum(46.8426, -91.9946)
_DEMO = (resources.files("alice_survey") / "demo.toml").read_text(encoding="utf-8")


def small_plan() -> Plan:
    """Two lines by hand."""
    from tests.missions.exports.plans import line, plan_of

    return plan_of([line((0.0, 0.0), (5.0, 0.0)), line((5.0, 1.0), (0.0, 1.0))], [(0, 1)])


def _survey(folder: Path, text: str) -> None:
    (folder / "survey.toml").write_text(text, encoding="utf-8")


def read_survey(path: Path) -> object:
    from alice_survey.core.config import load_config

    return load_config(path)


def read_and_check_survey(path: Path) -> object:
    """The settings, used up to where lines are laid; what planning refuses is one line here."""
    from alice_survey.core.config import load_config
    from alice_survey.core.errors import ConfigError, PlanError, VehicleError
    from missions.exposure.settings import ImagingSetup, imaging_settings
    from missions.plan.strength import check_turns, survey_costs

    config = load_config(path)
    setup = ImagingSetup(
        plan=config.plan, camera=config.camera, water=config.water, imaging=config.imaging
    )
    try:
        check_turns(config.plan)
        imaging = imaging_settings(setup.rig, setup)
        return survey_costs(config, imaging_w=imaging.imaging_w)
    except (PlanError, VehicleError) as error:
        said = str(error)
        if re.search(r"\d{20}|\b(nan|inf)\b", said):
            raise ValueError(f"no number to read: {said}") from None
        raise ConfigError(f"{path}: {said}") from None


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
    from reconstruct.placing.control_points import read_control

    control = read_control(path)
    datum = control.datum() or _DATUM
    return [point.place_ned(datum) for point in control.points]


def _picks(folder: Path) -> None:
    rows = [f"left/{i:06d}.png,A,{100 + i}.5,200,0.4" for i in range(6)]
    (folder / "picks.csv").write_text("\n".join(["image,point,x,y,sigma_px", *rows]) + "\n")


def _gcp_list(folder: Path) -> None:
    rows = [
        f"{576_600 + i} {5_188_200 - i} 1{i}.5 {100 + i} 20{i} DJI_{i}.JPG A{i}" for i in range(6)
    ]
    (folder / "gcp_list.txt").write_text("\n".join(["EPSG:32615", *rows]) + "\n")


def _markers(folder: Path) -> None:
    (folder / "markers.xml").write_text(
        '<document version="1.5.0"><chunk><cameras><camera id="0" label="DJI_0"/></cameras>'
        '<markers><marker id="1" label="A"><reference x="-91.9" y="46.8" z="12" sx="0.1" sy="0.1" '
        'sz="0.2" enabled="true"/></marker></markers><frames><frame><markers><marker marker_id="1">'
        '<location camera_id="0" pinned="true" x="10.5" y="20"/></marker></markers></frame>'
        '</frames><reference>EPSG:4326</reference><settings><property name="accuracy_markers" '
        'value="0.01"/></settings></chunk></document>'
    )


def read_foreign_control(path: Path) -> object:
    from reconstruct.placing.control_command import read_foreign

    return read_foreign(path)


def read_picks(path: Path) -> object:
    from reconstruct.placing.control_points import read_picks

    return read_picks(path)


def points() -> Any:
    """(N, 3) of a hilly ground."""
    xy = np.random.default_rng(4).uniform(-10, 10, (400, 2))
    return np.column_stack([xy, 0.8 * np.sin(xy[:, 0] / 2) + 160.0])


def _reference_ply(folder: Path) -> None:
    head = ["ply", "format ascii 1.0", "element vertex 400"]
    head += [*(f"property double {axis}" for axis in "xyz"), "end_header"]
    rows = [" ".join(f"{value:.4f}" for value in row) for row in points()]
    (folder / "a.ply").write_text("\n".join([*head, *rows]) + "\n")


def _binary_ply(folder: Path) -> None:
    head = ["ply", "format binary_little_endian 1.0", "element vertex 400"]
    head += [*(f"property double {axis}" for axis in "xyz"), "end_header", ""]
    (folder / "a.ply").write_bytes("\n".join(head).encode() + points().tobytes())


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
    from reconstruct.evaluate.reference import read_reference

    return read_reference(path, _DATUM)


TARGETS = (
    Target(
        "survey.toml", "toml", "survey.toml", partial(_survey, text=settings_template()),
        read_survey,
    ),
    Target("survey.toml, demo", "toml", "survey.toml", partial(_survey, text=_DEMO), read_survey),
    Target(
        "survey.toml, used", "toml", "survey.toml", partial(_survey, text=settings_template()),
        read_and_check_survey, examples=60,
    ),
    Target("control.csv", "csv", "control.csv", _control, read_control),
    Target("picks.csv", "csv", "picks.csv", _picks, read_picks),
    Target("gcp_list.txt", "text", "gcp_list.txt", _gcp_list, read_foreign_control),
    Target("markers of Metashape", "text", "markers.xml", _markers, read_foreign_control),
    Target("reference PLY", "text", "a.ply", _reference_ply, read_reference),
    Target("reference PLY, binary", "binary", "a.ply", _binary_ply, read_reference),
    Target("reference LAS", "binary", "a.las", partial(build_las, name="a.las"), read_reference),
    Target(
        "reference LAZ", "binary", "a.laz", partial(build_las, name="a.laz"), read_reference,
        examples=4,
    ),
    Target("reference DEM", "binary", "a.tif", _reference_dem, read_reference),
)  # fmt: skip
