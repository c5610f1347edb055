"""A plan at a glance, as JSON values for a page that plans while somebody draws.

All totals are those of the plan itself. Only the certificate of a large area is counted on a
coarser grid (`MAX_CELLS`): the shares that it gives, and the holes, are then estimates, and
`certificate.estimated` says so.
"""

import base64
import io
import math
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import AliceError, collected_by
from alice_survey.core.frames import Array
from camera_calib.rig import Rig, design_rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate
from missions.coverage.holes import find_holes
from missions.exports.geometry import dive_of_line, footprint_outline, rings_ne, route_ne
from missions.exposure.settings_table import Setting
from missions.exposure.storage import raw_bytes
from missions.exposure.ways_out import ConflictError
from missions.plan.planner import Planned, plan_survey
from missions.plan.playback import depths_along
from missions.route.energy import craft_of, usable_wh
from missions.values.plan_file import Plan

MAX_CELLS = 400_000
"""Cells of the certificate of a large area."""
_MAX_PICTURE_CELLS = 420
"""Most cells on a side of the picture of counts."""
_MAX_COUNT = 254
"""Highest number of pictures in the picture of counts, where 255 is outside of the area."""
_MAX_HOLES = 60
_PROFILE_POINTS = 600
_DETAIL = 1 / 5000
"""Of the plan's width: what a way may lie off its drawing."""
_FINEST_M = 0.005
_BINDS = 0.01
"""A limit binds what is within this share of it."""


def preview(config: SurveyConfig) -> dict[str, Any]:
    """Plan a survey, and put what was found into JSON values; nothing is written.

    Args:
        config: of the survey.

    Returns:
        With `ok` true the plan, with `ok` false why there is none, and the ways out that work.
    """
    began = time.thread_time()
    try:
        with collected_by(lambda _, __: None):
            rig = design_rig(config.camera, config.water)
            planned = plan_survey(config, rig, max_cells=MAX_CELLS)
            found = planned_json(planned, rig, config)
    except AliceError as error:
        found = refusal_json(error)
    return {**found, "cpu_s": round(time.thread_time() - began, 3)}


def refusal_json(error: AliceError) -> dict[str, Any]:
    """Why there is no plan, and what would help: each way out with the settings that it changes."""
    if not isinstance(error, ConflictError):
        return {"ok": False, "error": " ".join(str(error).splitlines()), "what": str(error),
                "limits": [], "ways": []}  # fmt: skip
    one, other = error.limits
    return {
        "ok": False,
        "error": f"{error.what}: {one} conflicts with {other}",
        "what": error.what,
        "limits": [one, other],
        "ways": [
            {"change": way.change, "price": way.price, "changes": _by_section(way.settings)}
            for way in error.ways
        ],
    }


def planned_json(planned: Planned, rig: Rig, config: SurveyConfig) -> dict[str, Any]:
    """A plan as JSON values.

    Args:
        planned: the plan and what led to it.
        rig: its cameras in water.
        config: what it was planned from.
    """
    plan, seen = planned.plan, planned.certificate
    dives = dive_of_line(plan)
    ends = np.array([(*line.start_ne_m, *line.end_ne_m) for line in plan.lines])
    north_0, east_0, north_1, east_1 = plan.area.allowed.bounds
    detail_m = max(_FINEST_M, max(north_1 - north_0, east_1 - east_0) * _DETAIL)
    return {
        "ok": True,
        "totals": _totals(planned, rig, config),
        "lines": [
            {"kind": line.kind, "from": place[:2], "to": place[2:], "stations": line.stations,
             "dive": dives[index]}
            for index, (line, place) in enumerate(
                zip(plan.lines, _rounded(ends), strict=True))
        ],
        "routes": [_rounded(route_ne(dive.route, detail_m)) for dive in plan.dives],
        "homes": [list(home) for home in plan.homes_ne_m],
        "area": {
            name: [[_rounded(ring) for ring in rings_ne(part)] for part in shape.geoms]
            for name, shape in (
                ("survey", plan.area.survey), ("allowed", plan.area.allowed),
                ("no_go", plan.area.no_go),
            )
        },
        "outline": np.round(footprint_outline(plan, rig), 4).tolist(),
        "counts": counts_data(seen),
        "certificate": {
            "cell_m": seen.grid.cell_m,
            "estimated": seen.estimated,
        },
        "holes": _holes(seen),
        "profile": _profile(plan, planned.bathymetry),
        "limits": list(_limits(planned, config)),
        "rows": [[row.name, row.text, _reason(row)] for row in planned.rows],
        "warnings": list(planned.warnings),
    }  # fmt: skip


def _totals(planned: Planned, rig: Rig, config: SurveyConfig) -> dict[str, Any]:
    plan, imaging, seen = planned.plan, planned.imaging, planned.certificate
    lines_m = sum(line.length_m for line in plan.lines)
    return {
        "area_m2": seen.area_m2,
        "lines": len(plan.lines),
        "heading_deg": math.degrees(plan.lines[0].heading_rad),
        "lines_m": lines_m,
        "stations": plan.stations,
        "pictures": plan.stations * len(rig.cameras),
        "length_m": plan.length_m,
        "duration_s": plan.duration_s,
        "energy_wh": plan.energy_wh,
        "usable_wh": usable_wh(config.vehicle),
        "longest_dive_wh": max(dive.energy_wh for dive in plan.dives),
        "dives": len(plan.dives),
        "data_gb": raw_bytes(rig.cameras[rig.reference], len(rig.cameras), plan.stations) / 1e9,
        "altitude_m": plan.altitude_m,
        "seafloor_depth_m": plan.seafloor_depth_m,
        "interval_s": plan.interval_s,
        "exposure_s": plan.exposure_s,
        "gain_db": imaging.light.gain_db,
        "aperture": config.camera.f_number,
        "focus_air_m": imaging.focus.focus_air_m,
        "sharp_from_m": imaging.focus.near_altitude_m,
        "sharp_to_m": imaging.focus.far_altitude_m,
        "gsd_mm": 1e3 * imaging.pixel_m,
        "blur_px": imaging.blur_px,
        "snr": imaging.light.snr_median,
        "line_spacing_m": plan.line_spacing_m,
        "station_spacing_m": plan.station_spacing_m,
        "forward_overlap": plan.reached_forward_overlap,
        "side_overlap": plan.reached_side_overlap,
        "covered": seen.covered_share,
        "stereo": seen.stereo_share,
        "at_overlap": seen.share_at_overlap,
        "speed_mps": plan.speed_mps,
    }


def _limits(planned: Planned, config: SurveyConfig) -> Iterator[dict[str, Any]]:
    """The limits of the plan: which keep it from being better, and how far off the others are."""
    plan, imaging, wanted = planned.plan, planned.imaging, config.plan
    maximum, minimum = _at_most, _at_least
    longest = max(plan.dives, key=lambda dive: dive.energy_wh)
    yield maximum(
        "battery", longest.energy_wh, usable_wh(config.vehicle), "Wh",
        "energy of the longest dive, of what the battery has above its reserve",
        binds=len(plan.dives) > len(plan.homes_ne_m),
    )  # fmt: skip
    if wanted.dive_s is not None:
        time_s = max(dive.duration_s for dive in plan.dives)
        yield maximum("plan.dive_s", time_s, wanted.dive_s, "s", "time of the longest dive")
    yield minimum(
        "camera.shortest_interval_s", imaging.interval_s, imaging.shortest_interval_s, "s",
        "time between pictures, of the least that cameras and trigger take",
    )  # fmt: skip
    yield maximum(
        "plan.allowed_blur_px", imaging.blur_px, wanted.allowed_blur_px, "px",
        "motion blur: it sets how long pictures are exposed",
    )  # fmt: skip
    yield maximum(
        "plan.sharp_px", imaging.focus.blur_px, wanted.sharp_px, "px",
        "blur out of focus at the ends of the relief",
    )  # fmt: skip
    yield maximum(
        "light", imaging.light.needed_light, 1.0, "",
        "light that is needed, as a share of what strobes and water give",
    )  # fmt: skip
    yield minimum(
        "plan.least_clearance_m", wanted.altitude_m - wanted.relief_m, wanted.least_clearance_m,
        "m", "height above the top of the relief",
    )  # fmt: skip
    if planned.plan.details["stereo_swath_m"]:
        yield maximum(
            "stereo swath", plan.line_spacing_m, plan.details["stereo_swath_m"], "m",
            "distance between lines, of the width that all cameras see",
        )  # fmt: skip
    yield maximum(
        "plan.turn_rate_limit_deg_s", plan.details["turn_rate_deg_s"],
        wanted.turn_rate_limit_deg_s, "deg/s", "rate of turn in arcs",
    )  # fmt: skip
    yield maximum(
        "strobe duty", imaging.strobe.duty, imaging.strobe.duty_limit, "",
        "share of the time that LEDs are lit, of what they bear in warm water",
    )  # fmt: skip
    yield maximum(
        "one cable", 1.0 / imaging.interval_s, imaging.storage.shared_link_hz, "Hz",
        "triggers a second, of what one cable carries of all cameras",
    )  # fmt: skip
    rating_m = craft_of(config.vehicle).depth_rating_m
    if rating_m is not None:
        deepest = max((max(row) for row in plan.line_depths_m), default=math.nan)
        depth_m = deepest if plan.line_depths_m else plan.seafloor_depth_m - plan.altitude_m
        yield maximum(
            "depth rating", depth_m, rating_m, "m", "depth, of what the hull is built for"
        )


def _at_most(
    name: str, value: float, limit: float, unit: str, about: str, *, binds: bool | None = None
) -> dict[str, Any]:
    return _limit(name, value, limit, unit, about, value >= limit * (1 - _BINDS), binds)


def _at_least(name: str, value: float, limit: float, unit: str, about: str) -> dict[str, Any]:
    return _limit(name, value, limit, unit, about, value <= limit * (1 + _BINDS), None)


def _limit(
    name: str, value: float, limit: float, unit: str, about: str, near: bool, binds: bool | None
) -> dict[str, Any]:
    return {
        "name": name, "value": float(value), "limit": float(limit), "unit": unit,
        "binds": bool(near if binds is None else binds),
        "text": f"{about}: {value:.4g} of {limit:.4g} {unit}".rstrip(),
    }  # fmt: skip


def _reason(row: Setting) -> str:
    return "; ".join(filter(None, (row.bound_by, row.note)))


def _holes(seen: Certificate) -> list[dict[str, Any]]:
    found = []
    for hole in find_holes(seen)[:_MAX_HOLES]:
        outer = max(hole.outline.geoms, key=lambda part: float(part.area)).exterior
        found.append(
            {
                "outer": _rounded(np.asarray(outer.coords)[:-1]),
                "area_m2": hole.area_m2,
                "unseen_m2": hole.unseen_m2,
            }
        )
    return found


def _profile(plan: Plan, bathymetry: Bathymetry | None) -> dict[str, Any]:
    """Depth of the floor and of the glass along the ways of all dives."""
    along, floor, depth, number = [], [], [], []
    length_m = max(plan.length_m, 1e-9)
    before_m = 0.0
    for index, dive in enumerate(plan.dives, start=1):
        share = math.ceil(_PROFILE_POINTS * dive.route.length_m / length_m)
        s = np.linspace(0.0, dive.route.length_m, max(2, share if bathymetry else 2))
        glass_m, floor_m = depths_along(plan, dive, s, bathymetry)
        along.append(before_m + s)
        floor.append(floor_m)
        depth.append(glass_m)
        number.append(np.full(len(s), index))
        before_m += dive.route.length_m
    return {
        "s_m": np.round(np.concatenate(along), 2).tolist(),
        "floor_depth_m": np.round(np.concatenate(floor), 3).tolist(),
        "vehicle_depth_m": np.round(np.concatenate(depth), 3).tolist(),
        "dive": np.concatenate(number).tolist(),
    }


def _rounded(points: Array) -> list[list[float]]:
    rows: list[list[float]] = (np.round(points, 3) + 0.0).tolist()
    return rows


def _by_section(settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {}
    for name, value in settings.items():
        section, key = name.split(".")
        result.setdefault(section, {})[key] = json_values(value)
    return result


def counts_picture(seen: Certificate) -> tuple[NDArray[np.uint8], tuple[float, float], float]:
    """Counts with north up: red pictures, green lines, blue 1 at the requested overlap.

    Cells become larger ones that show the worst of them.

    Returns:
        The (H, W, 3) picture, red 255 outside of the area; north and east of its upper left
        corner; and the side of a pixel, metres.
    """
    grid = seen.grid
    block = max(1, math.ceil(max(grid.rows, grid.columns) / _MAX_PICTURE_CELLS))
    inside = _blocks(seen.inside, block, fill=False)
    pictures = np.where(inside, _blocks(seen.pictures, block, fill=0), 65535).min(axis=(1, 3))
    lines = np.where(inside, _blocks(seen.least_lines, block, fill=0), 65535).min(axis=(1, 3))
    met = (_blocks(seen.at_overlap, block, fill=True) | ~inside).all(axis=(1, 3))
    within = inside.any(axis=(1, 3))
    cells = np.zeros((*within.shape, 3), dtype=np.uint8)
    cells[..., 0] = np.where(within, np.minimum(pictures, _MAX_COUNT), 255)
    cells[..., 1] = np.where(within, np.minimum(lines, _MAX_COUNT), 0)
    cells[..., 2] = np.where(within, met, 0)
    corners = grid.places_of(block * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) * within.shape)
    low, high = corners.min(axis=0), corners.max(axis=0)
    # Half the side of a cell that lies diagonally: no cell falls between pixels.
    aslant = abs(math.sin(2.0 * grid.heading_rad)) > 1e-9
    pixel_m = grid.cell_m * block / (2.0 if aslant else 1.0)
    rows, columns = np.maximum(np.ceil((high - low) / pixel_m - 1e-6).astype(int), 1)
    norths = high[0] - pixel_m * (np.arange(rows) + 0.5)
    easts = low[1] + pixel_m * (np.arange(columns) + 0.5)
    places = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1)
    row, column = np.moveaxis(np.floor(grid.cells_of(places) / block).astype(int), -1, 0)
    on = (row >= 0) & (column >= 0) & (row < within.shape[0]) & (column < within.shape[1])
    rgb = np.zeros((rows, columns, 3), dtype=np.uint8)
    rgb[..., 0] = 255
    rgb[on] = cells[row[on], column[on]]
    return rgb, (float(high[0]), float(low[1])), pixel_m


def counts_data(seen: Certificate) -> dict[str, Any]:
    """The counts for the page's script, which reads those under the pointer."""
    rgb, (north, west), pixel_m = counts_picture(seen)
    png = base64.b64encode(_png(rgb)).decode("ascii")
    return {"png": f"data:image/png;base64,{png}", "north": north, "west": west, "pixel": pixel_m}


def _blocks(cells: NDArray[Any], block: int, *, fill: int | bool) -> NDArray[Any]:
    """Cells in blocks, (rows, block, columns, block); beyond the last cell stands `fill`."""
    rows, columns = (-(-size // block) for size in cells.shape)
    padded = np.full((rows * block, columns * block), fill, dtype=cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return padded.reshape(rows, block, columns, block)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()
