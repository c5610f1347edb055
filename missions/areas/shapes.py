"""The shapes that settings hold, as they were given: rectangle, polygon, corridor, text or file."""

import math

import numpy as np

from alice_survey.base.config import AreaConfig
from alice_survey.base.frames import Array
from missions.areas.raw import RawLine, RawShapes, from_rings, no_points


def survey_shapes(settings: AreaConfig) -> RawShapes:
    """The shape to survey, as it was given; a rectangle at the datum unless there is another.

    Raises:
        PlanError: a file or text cannot be read.
    """
    if settings.file is not None:
        from missions.areas.files import read_area_file

        return read_area_file(settings.file, settings.layer, settings.crs)
    if settings.wkt is not None:
        from missions.areas.files import read_wkt

        return read_wkt("wkt", settings.wkt, settings.crs)
    for name in ("corridor_ne_m", "corridor_latlon_deg"):
        points = getattr(settings, name)
        if points is not None:
            line = RawLine(points=np.asarray(points, dtype=np.float64))
            return RawShapes(
                origin=name, geographic="latlon" in name, lines=(line,), points=no_points()
            )
    for name in ("polygon_ne_m", "polygon_latlon_deg"):
        corners = getattr(settings, name)
        if corners is not None:
            return from_rings(name, [corners], geographic="latlon" in name)
    return from_rings("rectangle", [_rectangle(settings)], geographic=False)


def no_go_shapes(settings: AreaConfig) -> list[RawShapes]:
    """The zones to keep out of, by source.

    Raises:
        PlanError: a file cannot be read.
    """
    zones = []
    for name in ("no_go_ne_m", "no_go_latlon_deg"):
        rings = getattr(settings, name)
        if rings:
            zones.append(from_rings(name, rings, geographic="latlon" in name))
    if settings.no_go_file is not None:
        from missions.areas.files import read_area_file

        zones.append(
            read_area_file(settings.no_go_file, settings.no_go_layer, settings.crs, role="no_go")
        )
    return zones


def allowed_shapes(settings: AreaConfig) -> RawShapes | None:
    """Where the vehicle may be, or None where the settings do not say it.

    Raises:
        PlanError: a file cannot be read.
    """
    for name in ("allowed_ne_m", "allowed_latlon_deg"):
        corners = getattr(settings, name)
        if corners is not None:
            return from_rings(name, [corners], geographic="latlon" in name)
    if settings.allowed_file is None:
        return None
    from missions.areas.files import read_area_file

    return read_area_file(
        settings.allowed_file, settings.allowed_layer, settings.crs, role="allowed"
    )


def _rectangle(settings: AreaConfig) -> Array:
    """Corners (4, 2): the length along the heading, the width to the right of it."""
    heading = math.radians(settings.heading_deg)
    along = settings.length_m * np.array([math.cos(heading), math.sin(heading)])
    right = settings.width_m * np.array([-math.sin(heading), math.cos(heading)])
    corners: Array = np.array([0 * along, along, along + right, right])
    return corners if settings.datum_at == "corner" else corners - (along + right) / 2
