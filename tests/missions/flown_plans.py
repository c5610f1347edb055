"""Small plans made by hand: legs one after the other, dives from home to home."""

import math
from collections.abc import Sequence

from shapely.geometry import MultiPolygon, box

from alice_survey.base.config import SurveyConfig
from alice_survey.base.frames import Datum
from alice_survey.seafloor.terrain import Terrain, survey_terrain
from missions.values.area import Area
from missions.values.legs import Leg, Route
from missions.values.line import Line
from missions.values.plan_file import Dive, Plan

Move = tuple[str, float] | tuple[str, float, int]
"""("go", metres), ("line", metres, index), ("spot", degrees), ("step", metres to starboard)."""


def walk(start_ne_m: tuple[float, float], heading_deg: float, moves: Sequence[Move]) -> Route:
    """The route of a vehicle that makes one move after the other."""
    place, heading = start_ne_m, math.radians(heading_deg)
    legs = []
    for kind, amount, *line in moves:
        turn = math.radians(amount) if kind == "spot" else 0.0
        side = -math.copysign(math.pi / 2, amount) if kind == "step" else 0.0
        leg = Leg(
            start_ne_m=place,
            heading_rad=heading - side,
            length_m=0.0 if kind == "spot" else abs(amount),
            curvature_per_m=0.0,
            line=line[0] if line else -1,
            turn_rad=turn,
            side_rad=side,
        )
        legs.append(leg)
        place, heading = leg.end_ne_m, heading + turn
    return Route(legs=tuple(legs))


def plan_of(routes: Sequence[Route], stations: int = 6, turn_radius_m: float = 0.5) -> Plan:
    """A plan whose dives fly these routes; lines are the legs that bear an index."""
    legs = sorted(
        (leg for route in routes for leg in route.legs if leg.line >= 0), key=lambda leg: leg.line
    )
    lines = tuple(
        Line(kind="survey", start_ne_m=leg.start_ne_m, end_ne_m=leg.end_ne_m, stations=stations)
        for leg in legs
    )
    area, allowed = (MultiPolygon([box(-m, -m, 7.0 + m, 4.0 + m)]) for m in (1.0, 5.0))
    dives = []
    for route in routes:
        indices = [leg.line for leg in route.legs if leg.line >= 0]
        turned = sum(abs(leg.turn_rad) for leg in route.legs)
        dives.append(
            Dive(
                first_line=min(indices),
                last_line=max(indices),
                route=route,
                duration_s=route.length_m / 0.2 + turned / math.radians(15.0),
                energy_wh=2.0,
            )
        )
    return Plan(
        name="by hand",
        area=Area(
            datum=Datum(latitude_deg=32.8, longitude_deg=34.9), survey=area, allowed=allowed,
            no_go=MultiPolygon(),
        ),
        home_ne_m=routes[0].legs[0].start_ne_m,
        seafloor_depth_m=6.0,
        altitude_m=2.0,
        speed_mps=0.2,
        interval_s=2.0,
        exposure_s=0.003,
        strobe_pulse_s=0.003,
        strobe_lead_s=0.0002,
        footprint_m=(1.4, 1.15),
        line_spacing_m=1.0,
        station_spacing_m=0.8,
        reached_forward_overlap=0.3,
        reached_side_overlap=0.29,
        lines=lines,
        dives=tuple(dives),
        turn_radius_m=turn_radius_m,
        run_in_m=0.5,
        length_m=sum(dive.route.length_m for dive in dives),
        duration_s=sum(dive.duration_s for dive in dives),
        energy_wh=2.0 * len(dives),
        coverage=1.0,
        details={},
    )  # fmt: skip


def terrain_of(config: SurveyConfig, plan: Plan) -> Terrain:
    """The sea floor of a survey under a plan."""
    return survey_terrain(
        config.seafloor,
        plan.area.allowed_corners_ne,
        margin_m=config.plan.altitude_m,
        depth_m=config.area.seafloor_depth_m,
        seed=config.seed,
    )
