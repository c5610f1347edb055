"""Slow, obvious twins of what pictures see of an area, and surveys with known coverage."""

from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform
from shapely.geometry import Polygon

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig, design_rig
from missions.coverage.certificate import Certificate
from missions.coverage.stations import Stations
from missions.values.area import Area
from missions.values.footprint import footprint_ne
from missions.values.legs import Route
from missions.values.line import Line
from missions.values.plan_file import Plan
from tests.missions.exports.plans import plan_of as plan_by_hand
from tests.missions.exports.plans import straight
from tests.oracles_lines import DATUM, area_of

__all__ = ["DATUM", "area_of"]
_FLOOR_M = 50.0


def pinhole_rig(across_m: float, along_m: float, baseline_m: float | None = None) -> Rig:
    """One or two pinholes in air whose pictures are so large from 1 m: rectangles, no bulge."""
    both = design_rig(
        CameraConfig(
            width_px=1000, height_px=round(1000 * along_m / across_m), pixel_um=1.0,
            focal_mm=1.0 / across_m, port_distance_m=0.0, glass_thickness_m=0.0,
            n_glass=1.0, baseline_m=baseline_m or 0.1, position_body_m=(0.0, 0.0, 0.0),
        ),
        WaterConfig(n_water=1.0),
    )  # fmt: skip
    return left_alone(both) if baseline_m is None else both


def left_alone(rig: Rig) -> Rig:
    """The left camera of a rig without the other."""
    cameras = {"left": rig.cameras["left"]}
    return replace(rig, cameras=cameras, cam_from_rig={"left": rig.cam_from_rig["left"]})


def shifted(stations: Stations, north_m: float, east_m: float) -> Stations:
    """The same stations elsewhere."""
    return replace(stations, glass_ne=stations.glass_ne + np.array([north_m, east_m]))


def stations_at(places_ne: Any, altitude_m: ArrayLike = 1.0, **others: Any) -> Stations:
    """Level stations headed north, each on a line of its own if no lines are given."""
    places = np.asarray(places_ne, dtype=np.float64).reshape(-1, 2)
    given = {
        "attitude_rad": np.zeros((len(places), 3)),
        "line": np.arange(len(places)),
        "altitude_m": np.full(len(places), altitude_m),
    }
    return Stations(glass_ne=places, **(given | others))


def footprint_polygons(rig: Rig, stations: Stations) -> dict[str, list[Polygon]]:
    """Each camera's footprint at each station, by poses and rays, one after the other."""
    reference = rig.cameras[rig.reference]
    glass_body = rig.body_from_cam(rig.reference).apply(reference.front_cam)
    polygons: dict[str, list[Polygon]] = {name: [] for name in rig.cameras}
    for place, altitude_m, attitude in zip(
        stations.glass_ne, stations.altitude_m, stations.attitude_rad, strict=True
    ):
        glass_ned = np.array([*place, _FLOOR_M - altitude_m])
        ned_from_body = rotation_from_attitude(*attitude)
        body_ned = glass_ned - ned_from_body.apply(glass_body)
        pose = RigidTransform.from_components(body_ned, ned_from_body)
        for name, camera in rig.cameras.items():
            border = footprint_ne(camera, pose * rig.body_from_cam(name), _FLOOR_M)
            polygons[name].append(Polygon(border) if np.isfinite(border).all() else Polygon())
    return polygons


def counts_at(points_ne: Array, rig: Rig, stations: Stations) -> dict[str, Any]:
    """How many pictures and lines of each camera see points (N, 2), and how many pairs."""
    polygons = footprint_polygons(rig, stations)
    seen = {
        name: np.array([shapely.contains_xy(shape, points_ne) for shape in shapes])
        for name, shapes in polygons.items()
    }
    numbers = np.unique(stations.line[stations.line >= 0])
    return {
        "pictures": {name: by_station.sum(axis=0) for name, by_station in seen.items()},
        "lines": {
            name: sum(by_station[stations.line == n].any(axis=0).astype(int) for n in numbers)
            for name, by_station in seen.items()
        },
        "pairs": np.all(list(seen.values()), axis=0).sum(axis=0),
    }


def middles_ne(certificate: Certificate) -> Array:
    """Middles of all cells, (rows, columns, 2), from the corner and the axes."""
    grid = certificate.grid
    ahead = np.array([np.cos(grid.heading_rad), np.sin(grid.heading_rad)])
    right = np.array([-ahead[1], ahead[0]])
    row, column = (np.indices(grid.shape)[..., None] + 0.5) * grid.cell_m
    return np.array(grid.origin_ne) + row * ahead + column * right


def lawnmower(
    north_m: float, east_m: float, spacing_m: float, step_m: float, over_m: float = 0.0
) -> list[Line]:
    """Lines to and fro along north over a box at the origin, and `over_m` beyond it all round."""
    steps = int(np.ceil((north_m + 2 * over_m) / step_m))
    count = int(np.ceil((east_m + 2 * over_m) / spacing_m)) + 1
    south = (north_m - steps * step_m) / 2
    west = (east_m - (count - 1) * spacing_m) / 2
    lines = []
    for i in range(count):
        east = west + i * spacing_m
        line = Line(
            kind="survey",
            start_ne_m=(south, east),
            end_ne_m=(south + steps * step_m, east),
            stations=steps + 1,
        )
        lines.append(line.reverse() if i % 2 else line)
    return lines


def plan_of(area: Area, lines: list[Line], **others: Any) -> Plan:
    """A plan of lines, straight from each to the next."""
    legs = []
    for index, line in enumerate(lines):
        legs.append(straight(line.start_ne_m, line.end_ne_m, index))
        if index + 1 < len(lines):
            legs.append(straight(line.end_ne_m, lines[index + 1].start_ne_m))
    given: dict[str, Any] = {"name": "known", "exposure_s": 0.001, "strobe_pulse_s": 0.002}
    route, home, dives = Route(legs=tuple(legs)), lines[0].start_ne_m, [(0, len(lines) - 1)]
    return plan_by_hand(lines, dives, home=home, routes=[route], area=area, **(given | others))
