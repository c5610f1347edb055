"""What a format of export is, and what its files are written from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from alice_survey.core.config import CameraConfig, PlanConfig, SeaConfig, VehicleConfig
from alice_survey.core.errors import PlanError
from alice_survey.sim.vehicle.pilot.settings import TURN_IN_PLACE_RAD_S, turn_in_place_rate_rad_s
from camera_calib.rig import Rig
from missions.exports.follower import Follower, end_tolerance_m, follower_of
from missions.exports.geometry import CameraMount, lat_lon, mount_of
from missions.exports.mavlink import Item, mission_items
from missions.exports.waypoints import Waypoint, gone_on, waypoints
from missions.values.footprint import common_swath
from missions.values.mission import Mission
from missions.values.plan_file import Plan

MIN_TOLERANCE_M = 0.12
"""The cross-track error that the paper's vehicle holds with its improved controller: a vehicle set
to pass a place more closely turns back for it."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a vehicle needs to know besides the plan."""

    altimeter_body_m: tuple[float, float, float] = CameraConfig().dvl_position_body_m
    """The sensor whose altitude the vehicle holds, from its reference point."""
    camera_on: str = "camera_trigger/enable"
    """COLA2: the service (without arguments) that starts pictures."""
    camera_off: str = "camera_trigger/disable"
    turn_rate_rad_s: float = TURN_IN_PLACE_RAD_S
    """Rate of turns on the spot, which way-points wait for."""
    follower: Follower | None = None
    """The vehicle and its sea; None where they are not known."""

    def __post_init__(self) -> None:
        if not self.camera_on or not self.camera_off:
            raise PlanError("name the services that switch pictures on and off")


def options_of(
    camera: CameraConfig,
    plan: PlanConfig,
    vehicle: VehicleConfig | None = None,
    sea: SeaConfig | None = None,
) -> Options:
    """The options that a survey's settings give; without vehicle and sea there is no follower."""
    follower = None if vehicle is None or sea is None else follower_of(vehicle, sea, plan.speed_mps)
    return Options(
        altimeter_body_m=camera.dvl_position_body_m,
        turn_rate_rad_s=turn_in_place_rate_rad_s(plan.turn_rate_limit_deg_s),
        follower=follower,
    )


def line_tolerance_m(plan: Plan, rig: Rig) -> float:
    """How far off a line's ends the vehicle may be with the survey still complete.

    Half a step along the line, so that its last picture is taken; across it, half of what
    neighbouring stereo swaths see more often than the plan needs, so that two lines off track leave
    no gap. Not less than what a vehicle can hold.
    """
    stereo = common_swath(rig, plan.altitude_m, plan.station_spacing_m)
    passes = max(1, int(2 * stereo.half_across_m / plan.line_spacing_m + 1e-9))
    spare_m = (2 * stereo.half_across_m - passes * plan.line_spacing_m) / 2
    return max(MIN_TOLERANCE_M, min(plan.station_spacing_m / 2, spare_m))


@dataclass(frozen=True, kw_only=True)
class Export:
    """A plan and what its files are written from."""

    plan: Plan
    rig: Rig
    options: Options

    @cached_property
    def mount(self) -> CameraMount:
        """Where glass and altimeter are on the vehicle."""
        return mount_of(self.rig, self.options.altimeter_body_m)

    @cached_property
    def dives(self) -> list[tuple[Waypoint, ...]]:
        """Way-points of each dive.

        Raises:
            PlanError: the plan's depths do not fit its lines.
        """
        rate_rad_s, by_depth = self.options.turn_rate_rad_s, self.plan.is_flown_by_depth
        return [
            waypoints(self.plan, dive, self.mount, rate_rad_s, by_depth=by_depth)
            for dive in self.plan.dives
        ]

    @cached_property
    def tolerance_m(self) -> float:
        """How far off a line's ends the vehicle may be."""
        return line_tolerance_m(self.plan, self.rig)

    @cached_property
    def cola2_tolerance_m(self) -> float:
        """The same for COLA2, which circles an end that it misses, in the expected current."""
        follower = self.options.follower
        return max(self.tolerance_m, 0.0 if follower is None else end_tolerance_m(follower))

    @cached_property
    def home_lat_lon_deg(self) -> tuple[float, float]:
        """Where the reference point is when the glass is at home, headed as the first dive is."""
        first = self.plan.dives[0].route.legs[0]
        heading = np.array([first.heading_rad + first.side_rad])
        home_ne = self.mount.vehicle_ne(np.array([self.plan.home_ne_m]), heading)
        ((lat, lon),) = lat_lon(self.plan.datum, home_ne, 0.0)
        return float(lat), float(lon)

    def items(self, dive: int) -> list[Item]:
        """A dive as MAVLink mission items."""
        points = [
            gone_on(self.plan, point, self.tolerance_m)
            if point.kind == "line" and point.camera == "off"
            else point
            for point in self.dives[dive]
        ]
        rate_rad_s = self.options.turn_rate_rad_s
        return list(mission_items(self.plan, points, self.tolerance_m, rate_rad_s))


class ExportFile(NamedTuple):
    """A file of a format."""

    name: str
    """File name, with `{}` for the number of the dive where there is one for each."""
    about: str
    """What it is, in words."""
    write: Callable[[Path, Export, int], None]
    """Writes it, of a dive counted from 0; of all dives where the name has none."""


@dataclass(frozen=True, kw_only=True)
class ExportFormat:
    """A format in which plans are written."""

    read_by: str
    """Programs that read it, in words."""
    files: tuple[ExportFile, ...]
    is_flown: bool = False
    """Whether vehicles fly it: by altitude above the sea floor, or by depth."""
    read: Callable[[str], Mission | None] | None = None
    """Reads a mission from the text of a file, as the vehicle does; None where the text is of
    another format. A `ValueError` says what is wrong with it."""

    def write(self, folder: Path, export: Export) -> dict[Path, str]:
        """Write all files.

        Returns:
            What each of them is, in words.
        """
        written = {}
        for file in self.files:
            for dive in range(len(export.plan.dives) if "{}" in file.name else 1):
                path = folder / file.name.format(dive + 1)
                file.write(path, export, dive)
                written[path] = file.about
        return written
