"""Logs of dives along a plan."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import Stage, run_stage, write_json
from alice_survey.core.frames import Array
from missions.logs.navigation_csv import READINGS
from missions.values.plan_file import Plan
from tests.oracles_coverage import DATUM

ROW = ("time_s", *READINGS)


def workspace_of(folder: Path, plan: Plan) -> Path:
    """A workspace with a plan over an area of 6 x 4 m."""
    stage = Stage(name="plan", version=1, settings={})
    run_stage(folder, stage, lambda part: write_json(part / "plan.json", plan.to_json()))
    (folder / "survey.toml").write_text(
        "[area]\nlength_m = 6.0\nwidth_m = 4.0\nseafloor_depth_m = 15.0\n"
    )
    return folder


def route_rows(plan: Plan, rng: np.random.Generator) -> Array:
    """Rows, (N, 8), of a vehicle that flies the plan's route, some 2 m above the sea floor."""
    route = plan.dives[0].route
    return _rows(plan, route.length_m, route.places, rng)


def rows_along(places_ne: list[list[float]], plan: Plan, start_s: float) -> Array:
    """Rows of a vehicle that flies from place to place at the plan's speed."""
    places = np.array(places_ne)
    passed = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])

    def at(along_m: Array) -> Array:
        return np.column_stack([np.interp(along_m, passed, axis) for axis in places.T])

    rows = _rows(plan, passed[-1], at, np.random.default_rng(0))
    rows[:, 0] += start_s - rows[0, 0]
    return rows


def _rows(
    plan: Plan, length_m: float, at: Callable[[Array], Array], rng: np.random.Generator
) -> Array:
    time_s = np.arange(0.0, length_m / plan.speed_mps, 0.5)
    places, ahead = (at(time_s * plan.speed_mps + on_m) for on_m in (0.0, 0.05))
    course = np.arctan2(*(ahead - places).T[::-1])
    depth = np.full(len(time_s), plan.seafloor_depth_m - plan.altitude_m)
    geodetic = DATUM.geodetic_from_ned(np.column_stack([places, depth]))
    tilt = rng.normal(0, 2.0, (2, len(time_s)))
    altitude_m = rng.uniform(1.9, 2.1, len(time_s))
    attitude = [*tilt, np.rad2deg(course) % 360.0]
    return np.column_stack([100.0 + time_s, geodetic[:, :2], depth, *attitude, altitude_m])


def text_of(rows: Array) -> bytes:
    """Rows as a navigation CSV."""
    decimals = (3, 10, 10, 4, 4, 4, 4, 4)
    lines = [
        ",".join("" if np.isnan(v) else f"{v:.{d}f}" for v, d in zip(row, decimals, strict=True))
        for row in rows
    ]
    return ("\n".join([",".join(ROW), *lines]) + "\n").encode()
