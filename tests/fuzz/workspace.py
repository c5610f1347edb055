"""Files of a workspace that a user writes, and references of other programs."""

import re
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import rasterio
from pyproj import CRS
from rasterio.transform import from_origin

from alice_survey.core.config import load_config
from alice_survey.core.errors import ConfigError, PlanError, VehicleError
from alice_survey.core.frames import Datum
from alice_survey.core.settings_form import settings_template
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.plan.strength import check_turns, survey_costs
from reconstruct.evaluate import reference
from reconstruct.placing import control_points
from reconstruct.placing.control_command import read_foreign
from tests.fuzz.target import Target

_DATUM = Datum(46.8426, -91.9946)
_DEMO = (resources.files("alice_survey") / "demo.toml").read_text(encoding="utf-8")


def read_and_check_survey(path: Path) -> object:
    """The settings, used up to where lines are laid; what planning refuses is one line here."""
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


def read_control(path: Path) -> object:
    control = control_points.read_control(path)
    datum = control.datum() or _DATUM
    return [point.place_ned(datum) for point in control.points]


_CONTROL = """\
kind,name,use,latitude_deg,longitude_deg,north_m,east_m,easting_m,northing_m,epsg,depth_m,height_m,\
sigma_m,sigma_vertical_m,from,to,length_m
point,A,control,46.8426,-91.9946,,,,,,13,,0.01,,,,
point,B,check,,,1,2,,,,13.5,,0.01,0.02,,,
point,C,control,,,,,576000,5188000,32615,,100,0.01,,,,
bar,AB,control,,,,,,,,,,0.001,,A,B,1.5
marker,7,check,,,,,,,,,,0.001,,,,0.2
"""
_PICKS = "image,point,x,y,sigma_px\n" + "".join(
    f"left/{i:06d}.png,A,{100 + i}.5,200,0.4\n" for i in range(6)
)
_GCP_LIST = "EPSG:32615\n" + "".join(
    f"{576_600 + i} {5_188_200 - i} 1{i}.5 {100 + i} 20{i} DJI_{i}.JPG A{i}\n" for i in range(6)
)
_MARKERS = (
    '<document version="1.5.0"><chunk><cameras><camera id="0" label="DJI_0"/></cameras>'
    '<markers><marker id="1" label="A"><reference x="-91.9" y="46.8" z="12" sx="0.1" sy="0.1" '
    'sz="0.2" enabled="true"/></marker></markers><frames><frame><markers><marker marker_id="1">'
    '<location camera_id="0" pinned="true" x="10.5" y="20"/></marker></markers></frame>'
    '</frames><reference>EPSG:4326</reference><settings><property name="accuracy_markers" '
    'value="0.01"/></settings></chunk></document>'
)


def points() -> Any:
    """(N, 3) of a hilly ground."""
    xy = np.random.default_rng(4).uniform(-10, 10, (400, 2))
    return np.column_stack([xy, 0.8 * np.sin(xy[:, 0] / 2) + 160.0])


def _ply(kind: str) -> str:
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    return f"ply\nformat {kind} 1.0\nelement vertex 400\n{axes}end_header\n"


def _ascii_ply() -> str:
    return _ply("ascii") + "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in points())


def _binary_ply(path: Path) -> None:
    path.write_bytes(_ply("binary_little_endian").encode() + points().tobytes())


def build_las(path: Path) -> None:
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = [5.76e5, 5.188e6, 0.0], [1e-3] * 3
    header.add_crs(CRS.from_epsg(32615))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (points() + np.array([576_600.0, 5_188_200.0, 0.0])).T
    cloud.write(str(path))


def _dem(path: Path) -> None:
    height = (160 + np.arange(900).reshape(30, 30) / 100).astype(np.float32)
    with rasterio.open(
        path, "w", driver="GTiff", width=30, height=30, count=1, dtype="float32",
        crs="EPSG:32615", transform=from_origin(576_600, 5_188_200, 0.5, 0.5), tiled=True,
        blockxsize=16, blockysize=16, compress="lzw",
    ) as file:  # fmt: skip
        file.write(height, 1)


read_reference = partial(reference.read_reference, datum=_DATUM)
_SURVEY = "survey.toml"
TARGETS = (
    Target(_SURVEY, "toml", _SURVEY, settings_template(), load_config),
    Target("survey.toml, demo", "toml", _SURVEY, _DEMO, load_config),
    Target("survey.toml, used", "toml", _SURVEY, settings_template(), read_and_check_survey, 60),
    Target("control.csv", "csv", "control.csv", _CONTROL, read_control),
    Target("picks.csv", "csv", "picks.csv", _PICKS, control_points.read_picks),
    Target("gcp_list.txt", "text", "gcp_list.txt", _GCP_LIST, read_foreign),
    Target("markers of Metashape", "text", "markers.xml", _MARKERS, read_foreign),
    Target("reference PLY", "text", "a.ply", _ascii_ply(), read_reference),
    Target("reference PLY, binary", "binary", "a.ply", _binary_ply, read_reference),
    Target("reference LAS", "binary", "a.las", build_las, read_reference),
    Target("reference LAZ", "binary", "a.laz", build_las, read_reference, 4),
    Target("reference DEM", "binary", "a.tif", _dem, read_reference),
)
