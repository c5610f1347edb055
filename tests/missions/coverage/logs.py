"""Navigation logs and triggers of dives whose stations are known."""

from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.frames import rotation_from_attitude
from camera_calib.rig import Rig
from missions.coverage.stations import Stations
from missions.values.navigation import BelievedNavigation
from missions.values.plan_file import Plan


def log_of(flown: Stations, plan: Plan, rig: Rig) -> BelievedNavigation:
    """The navigation log of a body whose left port's glass is at the stations."""
    attitude, ones = flown.attitude_rad, np.ones(len(flown))
    lever = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    glass = np.column_stack([flown.glass_ne, plan.seafloor_depth_m - flown.altitude_m])
    assert flown.time_s is not None
    return BelievedNavigation(
        time_s=flown.time_s,
        position_ned=glass - rotation_from_attitude(*attitude.T).apply(lever),
        attitude_rad=attitude,
        altitude_m=flown.altitude_m,
        sigma_horizontal_m=0.1 * ones,
        sigma_depth_m=0.01 * ones,
        sigma_attitude_rad=0.001 * ones,
        sigma_heading_rad=0.01 * ones,
        sigma_altitude_m=0.02 * ones,
    )


def write_triggers(path: Path, flown: Stations, columns: int = 3) -> None:
    """Write `triggers.csv`, of two columns where lines are not known."""
    assert flown.time_s is not None
    rows = zip(range(len(flown)), flown.time_s, flown.line, strict=True)
    header = ("station", "time_s", "line")[:columns]
    write_csv(path, header, [list(row[:columns]) for row in rows])
