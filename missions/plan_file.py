"""The plan of a survey as a value, and `plan.json`.

Altitude and all places are of the left port's outer glass.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alice_survey.artefacts import read_json
from alice_survey.errors import PlanError
from alice_survey.frames import Datum
from missions.lines import Line

_FORMAT = {"format": "alice-survey plan", "version": 1}
_NUMBERS = (
    "seafloor_depth_m", "altitude_m", "speed_mps", "interval_s", "exposure_s", "line_spacing_m",
    "station_spacing_m", "forward_overlap", "side_overlap", "turn_radius_m", "run_in_m",
    "length_m", "duration_s", "coverage",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to fly and how to take pictures; `plan.json`."""

    name: str
    datum: Datum
    area_ne_m: tuple[tuple[float, float], ...]
    seafloor_depth_m: float
    altitude_m: float
    speed_mps: float
    interval_s: float
    exposure_s: float
    strobe_pulse_s: float
    strobe_lead_s: float
    footprint_m: tuple[float, float]
    """Across and along the track, on the middle row and column of a picture."""
    line_spacing_m: float
    station_spacing_m: float
    forward_overlap: float
    side_overlap: float
    """As reached, of one camera's pictures, on the middle row and column."""
    lines: tuple[Line, ...]
    turn_radius_m: float
    run_in_m: float
    length_m: float
    """Of the whole way, turns included."""
    duration_s: float
    coverage: float
    """Share of the area that every camera surely sees when the plan is flown exactly."""
    details: dict[str, Any]
    """What else a reader may want to know; nothing is computed from it."""

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
            "area_ne_m": [list(corner) for corner in self.area_ne_m],
            "seafloor_depth_m": self.seafloor_depth_m,
            "altitude_m": self.altitude_m,
            "speed_mps": self.speed_mps,
            "interval_s": self.interval_s,
            "exposure_s": self.exposure_s,
            "strobe": {"pulse_s": self.strobe_pulse_s, "lead_s": self.strobe_lead_s},
            "footprint_m": list(self.footprint_m),
            "line_spacing_m": self.line_spacing_m,
            "station_spacing_m": self.station_spacing_m,
            "forward_overlap": self.forward_overlap,
            "side_overlap": self.side_overlap,
            "lines": [line.to_json() for line in self.lines],
            "turn_radius_m": self.turn_radius_m,
            "run_in_m": self.run_in_m,
            "length_m": self.length_m,
            "duration_s": self.duration_s,
            "stations": self.stations,
            "coverage": self.coverage,
            "details": self.details,
        }


def read_plan(path: Path) -> Plan:
    """Read `plan.json`.

    Raises:
        PlanError: it is no plan, or lacks something.
        WorkspaceError: it is missing or no JSON.
    """
    data = read_json(path)
    try:
        if {key: data[key] for key in _FORMAT} != _FORMAT:
            raise PlanError(f"{path}: is no plan of version {_FORMAT['version']}")
        return Plan(
            name=str(data["name"]),
            datum=Datum(**data["datum"]),
            area_ne_m=tuple((float(n), float(e)) for n, e in data["area_ne_m"]),
            strobe_pulse_s=float(data["strobe"]["pulse_s"]),
            strobe_lead_s=float(data["strobe"]["lead_s"]),
            footprint_m=(float(data["footprint_m"][0]), float(data["footprint_m"][1])),
            lines=tuple(_line(line) for line in data["lines"]),
            details=dict(data["details"]),
            **{name: float(data[name]) for name in _NUMBERS},
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise PlanError(f"{path}: {what}") from None


def _line(data: dict[str, Any]) -> Line:
    if data["kind"] not in ("survey", "cross"):
        raise PlanError(f"a line is of kind {data['kind']!r}; known are survey and cross")
    return Line(
        kind=data["kind"],
        start_ne_m=(float(data["start_ne_m"][0]), float(data["start_ne_m"][1])),
        end_ne_m=(float(data["end_ne_m"][0]), float(data["end_ne_m"][1])),
        stations=int(data["stations"]),
    )
