"""`plan precision`: what a plan is predicted to give, and what helps."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import atomic_path, need_stage, write_json
from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import PlanError, collected_by
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.kit.words import text_table
from camera_calib.rig import Rig, design_rig
from missions.coverage.stations import stations_of_plan
from missions.plan.planner import area_bathymetry, plan_survey
from missions.plan.run import station_times_s
from missions.plan.strength import survey_costs
from missions.values.costs import Costs
from missions.values.plan_file import Plan, read_plan
from reconstruct.precision.instruments import NavigationErrors, expected_rig
from reconstruct.precision.predict import Precision, predict
from reconstruct.precision.tracks import ExpectedBlock, TrackModel, expected_block, waves
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import WorldFrame

CONTROL_SIGMA_M = 0.01
"""Of each coordinate of a control point."""
BETWEEN_DIVES_S = 3600.0
"""By then slow errors of navigation are new ones."""
_MORE_CROSS_LINES = (1, 2, 4)
_MORE_OVERLAP = (0.1, 0.2)
_MAX_OVERLAP = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A survey as set, or with a change, its plan, and what that is predicted to give."""

    name: str = "as planned"
    """The change in words."""
    config: SurveyConfig
    rig: Rig
    made: Plan | None = None
    """The plan where there is one already."""
    with_control: bool = False
    """Whether four points at the corners of the area are surveyed."""

    @cached_property
    def plan(self) -> Plan:
        """The plan; PlanError where none meets the settings."""
        if self.made is not None:
            return self.made
        with collected_by(lambda *_: None):
            return plan_survey(self.config, design_rig(self.config.camera, self.config.water)).plan

    @property
    def minutes(self) -> float:
        """Of all dives."""
        return self.plan.duration_s / 60.0

    @cached_property
    def precision(self) -> Precision:
        """Predicted."""
        block = self.block()
        points = block.state.points
        return predict(
            block,
            NavigationErrors.of(self.config.navigation, self.config.reconstruct),
            control=points[_corners(points)] if self.with_control else None,
            control_sigma_m=CONTROL_SIGMA_M,
        )

    def block(
        self, tracks: TrackModel | None = None, *, drawn: float | None = None, seed: int = 0
    ) -> ExpectedBlock:
        """The pictures of the plan flown exactly by a level vehicle.

        Args:
            tracks: of points; None as rendered surveys have them.
            drawn: see `expected_block`.
            seed: of the draw.

        Raises:
            PlanError: pictures do not show the sea floor, or share none of it.
        """
        config, plan = self.config, self.plan
        bathymetry = area_bathymetry(config.area, plan.area, plan.altitude_m)
        ripple = waves(config.plan.relief_m, 2.0 * plan.altitude_m)

        def depth_at(places: Array) -> Array:
            mean: Array | float = plan.seafloor_depth_m
            if bathymetry is not None:
                found = bathymetry.depth_at(places)
                mean = np.where(np.isfinite(found), found, plan.seafloor_depth_m)
            return mean + ripple(places)

        return expected_block(
            self.rig, *stations_and_times(plan, self.rig, survey_costs(config)), depth_at,
            tracks or TrackModel.of(config.reconstruct), drawn=drawn, seed=seed,
        )  # fmt: skip


def _corners(points: Array) -> list[int]:
    """The points farthest towards the corners."""
    level = points[:, :2] - points[:, :2].mean(axis=0)
    u, v = (level @ np.linalg.svd(level, full_matrices=False)[2].T).T
    return [int(np.argmax(a * u / np.ptp(u) + b * v / np.ptp(v))) for a in (-1, 1) for b in (-1, 1)]


def stations_and_times(plan: Plan, rig: Rig, costs: Costs) -> tuple[RigidTransform, Array]:
    """Poses `ned_from_body` (S,) of a plan's stations in the order of flight, and their times."""
    times, start_s = list[float](), 0.0
    for dive in plan.dives:
        times += [start_s + time_s for time_s in station_times_s(plan, dive, costs)]
        start_s = times[-1] + BETWEEN_DIVES_S
    stations = stations_of_plan(plan, np.full(len(times), plan.seafloor_depth_m))
    rotation = rotation_from_attitude(*stations.attitude_rad.T)
    front = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    depth_m = plan.seafloor_depth_m - stations.altitude_m
    glass = np.column_stack([stations.glass_ne, depth_m])
    poses = RigidTransform.from_components(glass - rotation.apply(front), rotation)
    return poses, np.array(times)


def single_measures(base: Candidate) -> list[Candidate]:
    """Every measure that can be planned, what brings most a minute first.

    Args:
        base: the survey as set.
    """
    found = []
    for name, update in _measures(base.config.plan):
        plan = base.config.plan.model_copy(update=update)
        one = Candidate(
            name=name, config=base.config.model_copy(update={"plan": plan}), rig=base.rig
        )
        with suppress(PlanError):
            found.append(replace(one, made=one.plan))
    return sorted(found, key=lambda one: -gain_per_minute(base, one))


def _measures(plan: PlanConfig) -> Iterator[tuple[str, dict[str, Any]]]:
    """Changes of a plan, in words and as settings."""
    for count in _MORE_CROSS_LINES:
        added = {"cross_lines": plan.cross_lines + count}
        yield f"{count} more cross line{'s' * (count > 1)}", added
    if not plan.closing_line:
        yield "a closing line", {"closing_line": True}
    for word in ("forward", "side") if plan.line_spacing_m is None else ("forward",):
        for more in _MORE_OVERLAP:
            share = round(getattr(plan, f"{word}_overlap") + more, 3)
            if share <= _MAX_OVERLAP:
                yield f"{word} overlap {share:.0%}", {f"{word}_overlap": share}


def with_control(base: Candidate) -> Candidate:
    """The same with control points, which cost no time of dive that a plan knows of."""
    name = f"4 control points of {1e3 * CONTROL_SIGMA_M:g} mm at the corners"
    return replace(base, name=name, made=base.plan, with_control=True)


def gain_per_minute(base: Candidate, one: Candidate) -> float:
    """Metres of the bend that a measure takes away for a minute of dive; 0 of what takes none."""
    minutes = one.minutes - base.minutes
    gain = worst_bend(base.precision) - worst_bend(one.precision)
    return gain / minutes if minutes > 0 else 0.0


def worst_bend(found: Precision) -> float:
    """The larger sigma of the sag, metres."""
    return float(np.nanmax(found.bend_m))


_EXACT = 1e-3
_LEVEL = "sea surface at the datum"
_MM, _PPM = 1e3, 1e6
_HEADER = ("bend along, mm", "across, mm", "scale, ppm", "heights, mm", "stations, mm")


def precision_report(
    workspace: Path, config: SurveyConfig, *, measures: bool = True
) -> tuple[str, dict[str, Any]]:
    """What a workspace's plan is predicted to give, as text and as JSON values.

    Writes `precision.json` and `precision.tif`, the sigmas of heights, next to the plan.

    Args:
        workspace: with the plan, and the calibration where there is one.
        config: the survey.
        measures: also say what cross lines and other measures buy.

    Raises:
        WorkspaceError: there is no plan.
        PlanError: the plan does not tie its pictures together.
    """
    folder = need_stage(workspace, "plan", "plan")
    plan = read_plan(folder / "plan.json")
    rig = expected_rig(workspace, config.camera, config.water, config.imaging)
    base = Candidate(config=config, made=plan, rig=rig)
    block, found = base.block(), base.precision
    errors = NavigationErrors.of(config.navigation, config.reconstruct)
    without = {
        "calibration": predict(block, errors, calibration=False),
        "navigation": predict(block, errors.times(_EXACT)),
        "pixels": predict(block, errors, pixels=False),
    }
    rows = {"all": found, **{f"without errors of {name}": p for name, p in without.items()}}
    in_world = ", ".join(f"{_MM * s:.0f}" for s in np.sqrt((found.place_m**2).mean(axis=0)))
    text = [
        f"Expected sigmas of {plan.stations} stations in {plan.duration_s / 60.0:.0f} min; rig: "
        f"{rig.source}",
        text_table(("", *_HEADER), [[name, *_cells(p)] for name, p in rows.items()]),
        f"worst station {_MM * np.linalg.norm(found.shape_m, axis=1).max():.2g} mm of shape; the "
        f"track lies within north, east, depth {in_world} mm",
    ]
    data: dict[str, Any] = {
        "stations": plan.stations, "minutes": plan.duration_s / 60.0, "rig": rig.source,
        **to_json(found), "without": {name: to_json(p) for name, p in without.items()},
    }  # fmt: skip
    if measures:
        options = [*single_measures(base), with_control(base)]
        data["measures"] = [
            {
                "measure": one.name,
                "minutes": one.minutes - base.minutes,
                "bend_gain_m_per_minute": None if one.with_control else gain_per_minute(base, one),
                **to_json(one.precision),
            }
            for one in options
        ]
        gains = [row["bend_gain_m_per_minute"] for row in data["measures"]]
        table = [
            [one.name, f"{one.minutes - base.minutes:+.1f}", *_cells(one.precision),
             "-" if gain is None else f"{_MM * gain:.2g}"]
            for one, gain in zip(options, gains, strict=True)
        ]  # fmt: skip
        text.append(text_table(("measure", "min", *_HEADER, "off the bend, mm a min"), table))
    _write(folder, base, data)
    text.append(f"{folder}: precision.json, precision.tif with the sigmas of heights")
    return "\n\n".join(text), data


def to_json(found: Precision) -> dict[str, Any]:
    """The figures of a prediction."""
    along, across = (float(b) if np.isfinite(b) else None for b in found.bend_m)
    return {
        "bend_along_m": along,
        "bend_across_m": across,
        "scale": found.scale,
        "heights_rms_m": found.heights_rms_m,
        "stations_shape_rms_m": _rms(found.shape_m),
        "stations_shape_worst_m": float(np.linalg.norm(found.shape_m, axis=1).max()),
    }


def _cells(found: Precision) -> list[str]:
    """Its figures under `_HEADER`."""
    along, across = (f"{_MM * b:.2g}" if np.isfinite(b) else "-" for b in found.bend_m)
    return [
        along, across, f"{_PPM * found.scale:.0f}", f"{_MM * found.heights_rms_m:.2g}",
        f"{_MM * _rms(found.shape_m):.2g}",
    ]  # fmt: skip


def _rms(sigmas: Array) -> float:
    return float(np.sqrt((sigmas**2).sum(axis=1).mean()))


def heights_raster(found: Precision) -> tuple[Array, DemGrid]:
    """Sigmas of heights with north up, (rows, columns), metres, NaN outside; and their grid."""
    cell, low, high = found.cell_m, found.cells_ne.min(axis=0), found.cells_ne.max(axis=0)
    rows, columns = (np.rint((high - low) / cell).astype(int) + 1).tolist()
    north, west = float(high[0] + cell / 2), float(low[1] - cell / 2)
    heights = np.full((rows, columns), np.nan)
    row, column = np.rint((found.cells_ne - low) / cell).astype(int).T
    heights[rows - 1 - row, column] = found.heights_m
    return heights, DemGrid(west=west, north=north, cell=cell, rows=rows, columns=columns)


def _write(folder: Path, base: Candidate, data: Mapping[str, Any]) -> None:
    """Write a prediction into the folder of its plan: values, raster of heights."""
    plan = base.plan
    write_json(folder / "precision.json", data)
    heights, grid = heights_raster(base.precision)
    frame = WorldFrame(name="ned", datum=plan.datum, scaled=True, vertical_datum=_LEVEL)
    text = "expected standard deviation of the height (m)"
    with (
        atomic_path(folder / "precision.tif") as path,
        tiled_raster(path, grid, frame, "float32", float("nan"), text) as raster,
    ):
        raster.write(heights.astype(np.float32), 1)
