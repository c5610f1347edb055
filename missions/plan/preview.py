"""A survey as somebody changes and draws it: the new settings, and its plan at a glance.

The plan is JSON values for a page. All totals are those of the plan itself. Only the certificate of
a large area is counted on a coarser grid (`MAX_CELLS`): the shares that it gives, and the holes,
are then estimates.
"""

import base64
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.config import (
    SurveyConfig,
    checked_settings,
    parse_settings,
    settings_files,
    settings_in,
)
from alice_survey.core.errors import AliceError, ConfigError, collected_by, file_faults
from alice_survey.core.frames import Array, Datum
from alice_survey.core.settings_text import Values, with_settings_changed, with_values
from camera_calib.rig import Rig, design_rig
from missions.areas.bathymetry import Bathymetry
from missions.areas.drawn import DrawnShapes, area_settings
from missions.coverage.certificate import Certificate
from missions.coverage.holes import find_holes
from missions.coverage.raster import north_up
from missions.exports.geometry import dive_of_line, footprint_outline, rings_ne, route_ne
from missions.exposure.conflict import ConflictError
from missions.plan.planner import Planned, plan_survey
from missions.values.plan_file import Dive, Plan

MAX_CELLS = 400_000
"""Cells of the certificate of a large area."""
_MAX_PICTURE_PX = 840
"""Most pixels on a side of the picture of counts."""
_MAX_COUNT = 254
"""Highest number of pictures in the picture of counts, where 255 is outside of the area."""
_MAX_HOLES = 60
_PROFILE_POINTS = 600
_DETAIL = 1 / 5000
"""Of the plan's width: what a way may lie off its drawing."""
_FINEST_M = 0.005


@dataclass(frozen=True, kw_only=True)
class Draft:
    """Settings that were changed, not yet written."""

    path: Path
    """Of the settings file."""
    text: str
    """What it will hold."""
    config: SurveyConfig
    """The same, checked; files that are still to be written are named as they will be."""
    files: Mapping[str, str]
    """Contents of files to write next to it, by name."""

    def config_with(self, scratch: Path) -> SurveyConfig:
        """The settings with their new files written into a folder that nobody else reads."""
        if not self.files:
            return self.config
        for name, text in self.files.items():
            (scratch / name).write_text(text, encoding="utf-8")
        area = self.config.area
        moved = {
            key: scratch / file.name
            for key in ("file", "no_go_file", "allowed_file")
            if (file := getattr(area, key)) is not None and file.name in self.files
        }
        return self.config.model_copy(update={"area": area.model_copy(update=moved)})

    def write(self) -> None:
        """Write the settings, and first the files that they name; each appears whole."""
        for name, text in self.files.items():
            _write(self.path.with_name(name), text)
        _write(self.path, self.text)


def draft_settings(
    text: str, path: Path, changes: Values, shapes: DrawnShapes | None = None
) -> Draft:
    """Change settings, and draw their area.

    Args:
        text: of the settings file so far.
        path: of that file.
        changes: settings by section and key; None takes one out.
        shapes: of the area; None: as the settings have them.

    Raises:
        ConfigError: a value is not allowed, or names a file that is not next to the settings.
        PlanError: the shapes cannot be kept.
    """
    origin = str(path)
    before = settings_in(text, origin)
    _check_files(changes, before, path.parent)
    area = dict(changes.get("area", {}))
    files: dict[str, str] = {}
    if shapes is not None:
        base = parse_settings(text, path).area
        datum = None
        if any(area.get(name) is not None for name in ("latitude_deg", "longitude_deg")):
            moved = checked_settings(with_values(before, {"area": area}), path).area
            datum = Datum(moved.latitude_deg, moved.longitude_deg)
        drawn, files = area_settings(shapes, base, datum)
        area = {**drawn, **area}
    values = {**changes, **({"area": area} if area else {})}
    config = checked_settings(with_values(before, values), path)
    typed = {
        section: {
            key: None
            if value is None
            else _as_typed(value, getattr(getattr(config, section), key, None))
            for key, value in part.items()
        }
        for section, part in values.items()
    }
    try:
        new = with_settings_changed(text, typed, origin)
        new.encode("utf-8")
    except UnicodeEncodeError:
        raise ConfigError(f"{origin}: a setting holds what is no text: write it again") from None
    return Draft(path=path, text=new, config=config, files=files)


def _as_typed(value: Any, checked: Any) -> Any:
    """A value as it is written: of the number's type that the setting has."""
    if isinstance(value, list) and isinstance(checked, list | tuple):
        return [_as_typed(one, other) for one, other in zip(value, checked, strict=True)]
    if isinstance(value, dict) and isinstance(checked, dict):
        return {key: _as_typed(one, checked.get(key)) for key, one in value.items()}
    if isinstance(checked, int | float) and not isinstance(value, bool):
        return checked
    return value


def _check_files(changes: Values, before: Mapping[str, Any], folder: Path) -> None:
    """Refuse files outside of the folder of the settings, unless the settings name them already.

    Raises:
        ConfigError: with the setting.
    """
    named = set(settings_files(before))
    for section, key, name in settings_files(changes):
        if (section, key, name) in named:
            continue
        try:
            within = (folder / name).resolve().is_relative_to(folder.resolve())
        except (OSError, ValueError):
            within = False
        if not within:
            raise ConfigError(
                f"{section}.{key} = {name!r}: put the file into {folder}, and give its name"
            )


def _write(path: Path, text: str) -> None:
    with file_faults(path, ConfigError, "written"), atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8"))


def preview(config: SurveyConfig) -> dict[str, Any]:
    """Plan a survey, and put what was found into JSON values; nothing is written.

    Args:
        config: of the survey.

    Returns:
        With `ok` true the plan, with `ok` false why there is none, and the setting that would help.
    """
    began = time.thread_time()
    try:
        with collected_by(lambda _, __: None):
            rig = design_rig(config.camera, config.water)
            planned = plan_survey(config, rig, max_cells=MAX_CELLS)
            found = _plan_json(planned, rig)
    except AliceError as error:
        found = refusal_json(error)
    return {**found, "cpu_s": round(time.thread_time() - began, 3)}


def refusal_json(error: AliceError) -> dict[str, Any]:
    """Why there is no plan, and the change of a setting that would help, or null."""
    changes = None
    if isinstance(error, ConflictError) and error.suggestion is not None:
        name, value = error.suggestion
        section, key = name.split(".")
        changes = {section: {key: value}}
    return {"ok": False, "error": " ".join(str(error).splitlines()), "suggestion": changes}


def _plan_json(planned: Planned, rig: Rig) -> dict[str, Any]:
    plan, seen = planned.plan, planned.certificate
    dives = dive_of_line(plan)
    ends = np.array([(*line.start_ne_m, *line.end_ne_m) for line in plan.lines])
    north_0, east_0, north_1, east_1 = plan.area.allowed.bounds
    detail_m = max(_FINEST_M, max(north_1 - north_0, east_1 - east_0) * _DETAIL)
    return {
        "ok": True,
        "totals": planned.totals,
        "lines": [
            {"kind": line.kind, "from": place[:2], "to": place[2:], "stations": line.stations,
             "dive": dives[index]}
            for index, (line, place) in enumerate(
                zip(plan.lines, _round_points(ends), strict=True))
        ],
        "routes": [_round_points(route_ne(dive.route, detail_m)) for dive in plan.dives],
        "homes": [list(home) for home in plan.homes_ne_m],
        "area": {
            name: [[_round_points(ring) for ring in rings_ne(part)] for part in shape.geoms]
            for name, shape in (
                ("survey", plan.area.survey), ("allowed", plan.area.allowed),
                ("no_go", plan.area.no_go),
            )
        },
        "outline": np.round(footprint_outline(plan, rig), 4).tolist(),
        "counts": _counts_json(seen),
        "holes": _holes(seen),
        "profile": _profile(plan, planned.bathymetry),
        "rows": [
            [row.name, row.text, "; ".join(filter(None, (row.bound_by, row.note)))]
            for row in planned.rows
        ],
        "warnings": list(planned.warnings),
    }  # fmt: skip


def _holes(seen: Certificate) -> list[dict[str, Any]]:
    holes = find_holes(seen)[:_MAX_HOLES]
    outers = [max(hole.outline.geoms, key=lambda part: float(part.area)) for hole in holes]
    return [
        {"outer": _round_points(next(rings_ne(outer))), "area_m2": hole.area_m2,
         "unseen_m2": hole.unseen_m2}
        for hole, outer in zip(holes, outers, strict=True)
    ]  # fmt: skip


def _profile(plan: Plan, bathymetry: Bathymetry | None) -> dict[str, Any]:
    """Depth of the floor and of the glass along the ways of all dives."""
    parts = []
    length_m = max(plan.length_m, 1e-9)
    before_m = 0.0
    for index, dive in enumerate(plan.dives, start=1):
        share = math.ceil(_PROFILE_POINTS * dive.route.length_m / length_m)
        s = np.linspace(0.0, dive.route.length_m, max(2, share if bathymetry else 2))
        glass_m, floor_m = depths_along(plan, dive, s, bathymetry)
        parts.append(np.stack([before_m + s, floor_m, glass_m, np.full(len(s), index)]))
        before_m += dive.route.length_m
    along, floor, glass, number = np.concatenate(parts, axis=1)
    return {
        "s_m": np.round(along, 2).tolist(),
        "floor_depth_m": np.round(floor, 3).tolist(),
        "vehicle_depth_m": np.round(glass, 3).tolist(),
        "dive": number.astype(int).tolist(),
    }


def _round_points(points: Array) -> list[list[float]]:
    rows: list[list[float]] = (np.round(points, 3) + 0.0).tolist()
    return rows


def counts_picture(seen: Certificate) -> tuple[NDArray[np.uint8], tuple[float, float], float]:
    """Counts with north up: red pictures, green lines, blue 1 at the requested overlap.

    Pixels that are larger than cells show the worst of these.

    Returns:
        The (H, W, 3) picture, red 255 outside of the area; north and east of its upper left
        corner; and the side of a pixel, metres.
    """
    grid = seen.grid
    places, (south, west, north, _) = north_up(seen.area, grid.cell_m / 2, _MAX_PICTURE_PX)
    pixel_m = (north - south) / len(places)
    within = grid.sample(seen.inside, places, False)
    rgb = np.zeros((*within.shape, 3), dtype=np.uint8)
    for channel, counts in enumerate((seen.pictures, seen.least_lines, seen.at_overlap)):
        known = np.where(seen.inside, counts, _MAX_COUNT)
        worst = minimum_filter(known, math.ceil(pixel_m / grid.cell_m - 1e-6))
        rgb[..., channel] = np.minimum(grid.sample(worst, places, 0), _MAX_COUNT) * within
    rgb[..., 0][~within] = 255
    return rgb, (north, west), pixel_m


def _counts_json(seen: Certificate) -> dict[str, Any]:
    """The counts for the page's script, which reads those under the pointer."""
    rgb, (north, west), pixel_m = counts_picture(seen)
    _, png = cv2.imencode(".png", rgb[..., ::-1])
    data = base64.b64encode(png.tobytes()).decode("ascii")
    return {"png": f"data:image/png;base64,{data}", "north": north, "west": west, "pixel": pixel_m}


def depths_along(
    plan: Plan, dive: Dive, along_m: Array, bathymetry: Bathymetry | None
) -> tuple[Array, Array]:
    """Depths of the glass and of the floor, (N,) both, at distances (N,) along a dive's way.

    Between lines the vehicle goes evenly from the depth of one to that of the next.
    """
    floor = np.full(len(along_m), plan.seafloor_depth_m)
    if bathymetry is not None:
        floor = bathymetry.depth_at(dive.route.places(along_m))
    if not plan.line_depths_m:
        return np.full(len(along_m), plan.seafloor_depth_m - plan.altitude_m), floor
    at, depths = [], []
    for start_m, leg in zip(dive.route.starts_m, dive.route.legs, strict=False):
        if leg.line >= 0:
            row = plan.line_depths_m[leg.line]
            at.append(start_m + np.linspace(0.0, leg.length_m, len(row)))
            depths.append(np.array(row))
    return np.interp(along_m, np.concatenate(at), np.concatenate(depths)), floor
