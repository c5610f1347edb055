"""What a format of export is, and what its files are written from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from camera_calib.rig import Rig
from missions.exports.follower import end_tolerance_m
from missions.exports.geometry import CameraMount, lat_lon, mount_of
from missions.exports.mavlink import Item, mission_items
from missions.exports.options import Options, line_tolerance_m
from missions.exports.waypoints import Waypoint, gone_on, waypoints
from missions.values.mission import Mission
from missions.values.plan_file import Plan


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
        rate_rad_s = self.options.turn_rate_rad_s
        return [waypoints(self.plan, dive, self.mount, rate_rad_s) for dive in self.plan.dives]

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
        return mission_items(self.plan, points, self.tolerance_m, rate_rad_s)


@dataclass(frozen=True, kw_only=True)
class ExportFile:
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
    keeps_altitude: bool = False
    """Whether the vehicle keeps one altitude above the sea floor, as its altimeter measures it."""
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
