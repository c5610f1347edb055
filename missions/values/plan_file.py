"""The plan of a survey as a value, and `plan.json`.

Altitude and all places are of the left port's outer glass.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from pydantic import TypeAdapter
from shapely.errors import ShapelyError

from alice_survey.core.artefacts import read_json
from alice_survey.core.contents import Location, as_line, in_workspace, one_line
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Datum
from alice_survey.kit.words import count, duration, share
from missions.values.area import Area
from missions.values.legs import Leg, Route
from missions.values.line import Line

_LEGS, _LINES = TypeAdapter(tuple[Leg, ...]), TypeAdapter(tuple[Line, ...])
_FORMAT = {"format": "alice-survey plan", "version": 2}
_NUMBERS = (
    "seafloor_depth_m", "altitude_m", "speed_mps", "interval_s", "exposure_s", "line_spacing_m",
    "station_spacing_m", "turn_radius_m", "run_in_m",
    "length_m", "duration_s", "energy_wh", "coverage",
)  # fmt: skip
_OVER_TERRAIN = ("line_depths_m", "line_floors_m", "way_depths_m")


_SAME_HOME_M = 0.01
MAX_DIFFERENCE_M = 0.3
"""Between a plan's altitude and that of a mission which keeps one over a bathymetry."""


@dataclass(frozen=True, kw_only=True)
class Dive:
    """What is flown on one charge: from home along some lines and home again."""

    first_line: int
    """Index of its first line in the plan."""
    last_line: int
    """Index of the last line that belongs to it."""
    route: Route
    """Route from home to home; lines count as in the plan."""
    duration_s: float
    energy_wh: float

    @property
    def home_ne_m(self) -> tuple[float, float]:
        """Place where the vehicle is launched and recovered."""
        return self.route.legs[0].start_ne_m

    def shift_lines(self, count: int) -> "Dive":
        """The same with the numbers of its lines raised by `count`."""
        legs = tuple(
            replace(leg, line=leg.line + count) if leg.line >= 0 else leg for leg in self.route.legs
        )
        first, last = self.first_line + count, self.last_line + count
        return replace(self, first_line=first, last_line=last, route=Route(legs=legs))

    def to_json(self) -> dict[str, Any]:
        """The dive as `plan.json` holds it."""
        return {
            "first_line": self.first_line,
            "last_line": self.last_line,
            "duration_s": self.duration_s,
            "energy_wh": self.energy_wh,
            "length_m": self.route.length_m,
            "legs": _LEGS.dump_python(self.route.legs, mode="json", exclude_defaults=True),
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "Dive":
        """The inverse of `to_json`."""
        return cls(
            first_line=int(data["first_line"]),
            last_line=int(data["last_line"]),
            route=Route(legs=_LEGS.validate_python(data["legs"])),
            duration_s=float(data["duration_s"]),
            energy_wh=float(data["energy_wh"]),
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class Plan:
    """What to fly and how to take pictures; `plan.json`.

    Example:
        >>> import alice_survey as alice
        >>> plan = alice.Survey.new("shoal", example="demo").plan()
        >>> f"{plan.reached_forward_overlap:.0%} along lines of {plan.altitude_m} m altitude"
        '62% along lines of 2.0 m altitude'
    """

    name: str
    area: Area
    home_ne_m: tuple[float, float]
    """Place where the vehicle is launched and recovered; the first, where parts of the area that it
    cannot pass between have dives with homes of their own (`homes_ne_m`)."""
    seafloor_depth_m: float
    altitude_m: float
    speed_mps: float
    interval_s: float
    exposure_s: float
    strobe_pulse_s: float
    strobe_lead_s: float
    footprint_m: tuple[float, float]
    """Across and along the track, of the rectangle that a picture surely shows."""
    line_spacing_m: float
    station_spacing_m: float
    reached_forward_overlap: float
    reached_side_overlap: float
    """Side overlap of one camera's pictures, of these rectangles."""
    lines: tuple[Line, ...]
    """Lines in the order of flight."""
    dives: tuple[Dive, ...]
    """Dives in the order of flight; together they fly all lines."""
    turn_radius_m: float
    run_in_m: float
    length_m: float
    """Length of the ways of all dives, turns included."""
    duration_s: float
    energy_wh: float
    coverage: float
    """Share of the area that every camera sees as often as requested, flown exactly."""
    line_depths_m: tuple[tuple[float, ...], ...] = ()
    """Depth of the glass at each station of each line, where they follow a bathymetry; empty where
    the glass keeps its altitude above a level sea floor."""
    line_floors_m: tuple[tuple[float, ...], ...] = ()
    """Depth of the sea floor below each of these stations."""
    way_depths_m: tuple[tuple[float, ...], ...] = ()
    """Deepest depth of the glass on each leg of each dive, over a bathymetry; NaN: not known."""
    details: dict[str, Any]
    """Further facts for a reader; nothing is computed from it."""

    def __repr__(self) -> str:
        return (
            f"plan: {count(len(self.lines), 'line')}, {count(self.stations, 'station')}, "
            f"{duration(self.duration_s)}, {share(self.coverage)} at the requested overlap"
        )

    @property
    def allowed_offset_m(self) -> float:
        """How far off its line a picture may be: two neighbours so far apart just meet."""
        return 0.5 * (self.footprint_m[0] - self.line_spacing_m)

    @property
    def is_flown_by_depth(self) -> bool:
        """Whether vehicles fly it by depth: one altitude would be too far from what is planned."""
        difference_m = self._terrain("at_constant_altitude", "max_difference_m")
        return bool(self.line_depths_m) and not difference_m <= MAX_DIFFERENCE_M

    @property
    def clearance_by_depth_m(self) -> tuple[float, float]:
        """Least clearance of way-points flown by depth, and the least allowed; NaN: not known."""
        found = (self._terrain("by_depth", name) for name in ("min_clearance_m", "allowed_m"))
        min_m, allowed_m = found
        return min_m, allowed_m

    @property
    def cola2_clearance_m(self) -> float:
        """The least clearance where COLA2's law holds a vehicle off its lines; NaN: not known."""
        return self._terrain("by_depth", "cola2_min_clearance_m")

    def _terrain(self, part: str, name: str) -> float:
        known = (self.details.get("terrain") or {}).get(part) or {}
        value = known.get(name)
        return math.nan if value is None else float(value)

    @property
    def blur_px(self) -> float:
        """Motion blur over one exposure; NaN where it is not noted."""
        return float(self.details.get("imaging", {}).get("blur_px", math.nan))

    @property
    def pixel_m(self) -> float:
        """Side of a pixel on the sea floor; NaN where it is not noted."""
        return float(self.details.get("imaging", {}).get("pixel_m", math.nan))

    @property
    def datum(self) -> Datum:
        """Origin of the local frame."""
        return self.area.datum

    @property
    def homes_ne_m(self) -> list[tuple[float, float]]:
        """Home, and the homes of dives in other parts of the area."""
        own = (dive.home_ne_m for dive in self.dives if dive.route.legs)
        places = [self.home_ne_m]
        for place in own:
            if all(math.dist(place, other) > _SAME_HOME_M for other in places):
                places.append(place)
        return places

    @property
    def stations(self) -> int:
        """How many times all cameras take a picture."""
        return sum(line.stations for line in self.lines)

    def to_json(self) -> dict[str, Any]:
        """The plan as `plan.json` holds it."""
        return {
            **_FORMAT,
            "name": self.name,
            "datum": {
                "latitude_deg": self.datum.latitude_deg,
                "longitude_deg": self.datum.longitude_deg,
            },
            "area": self.area.to_json(),
            "home_ne_m": list(self.home_ne_m),
            "strobe": {"pulse_s": self.strobe_pulse_s, "lead_s": self.strobe_lead_s},
            "footprint_m": list(self.footprint_m),
            **{name: getattr(self, name) for name in _NUMBERS},
            "forward_overlap": self.reached_forward_overlap,
            "side_overlap": self.reached_side_overlap,
            "stations": self.stations,
            "lines": [line.to_json() for line in self.lines],
            "dives": [dive.to_json() for dive in self.dives],
            **{
                name: [[None if math.isnan(depth) else depth for depth in row] for row in rows]
                for name in _OVER_TERRAIN
                if (rows := getattr(self, name))
            },
            "details": self.details,
        }


def read_plan(path: Location) -> Plan:
    """Read `plan.json`, or that of a workspace.

    Raises:
        PlanError: it is not a plan, or lacks something.
        WorkspaceError: it is missing or not JSON.

    Example:
        >>> import alice_survey as alice
        >>> plan = alice.read_plan("small/plan/plan.json")
        >>> len(plan.dives)
        1
    """
    path = in_workspace(path, "plan/plan.json")
    data = read_json(path)
    try:
        if {key: data[key] for key in _FORMAT} != _FORMAT:
            raise PlanError(f"{path}: not a plan of version {_FORMAT['version']}; plan again")
        values: dict[str, Any] = {name: float(data[name]) for name in _NUMBERS}
        values |= {
            name: tuple(
                tuple(math.nan if depth is None else float(depth) for depth in row)
                for row in data.get(name, ())
            )
            for name in _OVER_TERRAIN
        }
        return Plan(
            name=str(data["name"]),
            area=Area.from_json(data["area"], Datum(**data["datum"])),
            home_ne_m=(float(data["home_ne_m"][0]), float(data["home_ne_m"][1])),
            strobe_pulse_s=float(data["strobe"]["pulse_s"]),
            strobe_lead_s=float(data["strobe"]["lead_s"]),
            footprint_m=(float(data["footprint_m"][0]), float(data["footprint_m"][1])),
            lines=_LINES.validate_python(data["lines"]),
            dives=tuple(Dive.from_json(dive) for dive in data["dives"]),
            details=dict(data["details"]),
            reached_forward_overlap=float(data["forward_overlap"]),
            reached_side_overlap=float(data["side_overlap"]),
            **values,
        )
    except PlanError as error:
        named = str(error).startswith(str(path))
        raise PlanError(str(error) if named else f"{path}: {as_line(str(error))}") from None
    except (
        KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError,
        RecursionError, ShapelyError,
    ) as error:  # fmt: skip
        what = f"lacks {one_line(error)}" if isinstance(error, KeyError) else one_line(error)
        raise PlanError(f"{path}: {what}") from None
