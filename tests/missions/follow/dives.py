"""Logs of dives, as text that is cut anywhere."""

from pathlib import Path

import numpy as np
import shapely

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array
from camera_calib.rig import Rig, design_rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import read_dive_record
from missions.coverage.growing import GrowingCoverage
from missions.coverage.stations import Stations, plan_pattern
from missions.follow.pictures import PictureTrack
from missions.follow.rows import ROW, Piece
from missions.values.plan_file import Plan
from tests.oracles_coverage import DATUM, area_of, lawnmower, plan_of

RIG: Rig = design_rig(CameraConfig(), WaterConfig())
PLAN: Plan = plan_of(area_of(shapely.box(0, 0, 4, 2)), lawnmower(4.0, 2.0, 1.0, 0.46, over_m=0.5))
CELL_M = 0.06


def route_rows(
    plan: Plan, interval_s: float, rng: np.random.Generator, sigma_m: float = 0.0
) -> Array:
    """Rows, (N, 8), of a vehicle that flies the plan's route, some 2 m above the sea floor."""
    route = plan.dives[0].route
    time_s = np.arange(0.0, route.length_m / plan.speed_mps, interval_s)
    places = route.places(time_s * plan.speed_mps)
    ahead = route.places(time_s * plan.speed_mps + 0.05)
    return _rows(plan, time_s, places, ahead, rng, sigma_m)


def rows_along(places_ne: list[list[float]], plan: Plan, start_s: float) -> Array:
    """Rows of a vehicle that flies from place to place at the plan's speed."""
    places = np.array(places_ne)
    passed = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
    time_s = np.arange(0.0, passed[-1] / plan.speed_mps, 0.5)

    def at(along_m: Array) -> Array:
        return np.column_stack([np.interp(along_m, passed, axis) for axis in places.T])

    along_m = time_s * plan.speed_mps
    rows = _rows(plan, time_s, at(along_m), at(along_m + 0.05), np.random.default_rng(0), 0.0)
    rows[:, 0] += start_s - rows[0, 0]
    return rows


def _rows(
    plan: Plan, time_s: Array, places: Array, ahead: Array, rng: np.random.Generator,
    sigma_m: float,
) -> Array:  # fmt: skip
    course = np.arctan2(*(ahead - places).T[::-1])
    places = places + rng.normal(0, sigma_m, places.shape)
    depth = np.full(len(time_s), plan.seafloor_depth_m - plan.altitude_m)
    geodetic = DATUM.geodetic_from_ned(np.column_stack([places, depth]))
    tilt = rng.normal(0, 2.0, (2, len(time_s)))
    return np.column_stack(
        [100.0 + time_s, geodetic[:, :2], depth, *tilt, np.rad2deg(course) % 360.0,
         rng.uniform(1.9, 2.1, len(time_s))]
    )  # fmt: skip


def text_of(rows: Array) -> bytes:
    """Rows as a navigation CSV."""
    decimals = (3, 10, 10, 4, 4, 4, 4, 4)
    lines = [
        ",".join("" if np.isnan(v) else f"{v:.{d}f}" for v, d in zip(row, decimals, strict=True))
        for row in rows
    ]
    return ("\n".join([",".join(ROW), *lines]) + "\n").encode()


def at_once(path: Path, plan: Plan = PLAN, cell_m: float = CELL_M) -> Certificate:
    """The certificate of a whole log, as `plan check` has it."""
    record = read_dive_record(path, plan, RIG)
    return certificate(plan.area, RIG, record.stations, plan_pattern(plan, RIG), cell_m=cell_m)


class Followed:
    """Pictures and coverage of rows as they come."""

    def __init__(self, plan: Plan = PLAN, cell_m: float = CELL_M) -> None:
        self.track = PictureTrack(plan, RIG)
        self.coverage = GrowingCoverage(plan.area, RIG, plan_pattern(plan, RIG), cell_m)
        self.again = 0

    def take(self, pieces: list[Piece]) -> None:
        for piece in pieces:
            if piece.starts:
                self.coverage.add(self.track.begin_again())
            new, again = self.track.add(piece.rows)
            if again:
                self.again += 1
                self.coverage.restart()
            self.coverage.add(new)

    def certificate(self) -> Certificate:
        rest: Stations = self.track.rest()
        return self.coverage.certificate(rest)


def same(one: Certificate, other: Certificate) -> None:
    """Both are equal, to the cell."""
    for name in ("pictures", "least_pictures", "least_lines", "pairs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.to_json() == other.to_json()
