"""The stage `plan`: a survey planned, and written for the next stages, for people, for vehicles.

Also when the trigger controller opens cameras and lights strobes, in whole microseconds: a
trigger's time is the middle of its exposure, as everywhere in a survey. The strobe is lit before
the cameras open and goes out after they close, by its lead.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import EXPORTS, write_csv, write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.executor import Executor
from alice_survey.core.run import progress
from camera_calib.rig import design_rig
from missions.plan.planner import plan_survey
from missions.plan.rows import settings_table
from missions.values.costs import Costs, leg_costs
from missions.values.plan_file import Dive, Plan

_SAME_S = 1e-3
_US = 1_000_000
HEADER = (
    "trigger", "trigger_us", "strobe_on_us", "camera_open_us", "camera_close_us", "strobe_off_us",
    "strobe_on_rel_us", "camera_open_rel_us", "camera_close_rel_us", "strobe_off_rel_us",
)  # fmt: skip
"""Columns of the time table: times since the start, then the same relative to the trigger."""


def run_plan(
    workspace: Path, folder: Path, executor: Executor, *, survey: SurveyConfig
) -> Callable[[], None]:
    """Write plan.json, its certificate, settings and triggers.

    Returns:
        What writes maps and missions for vehicles.

    Raises:
        PlanError: no plan meets the settings.
    """
    rig = design_rig(survey.camera, survey.water)
    planned = plan_survey(survey, rig)
    plan = planned.plan
    write_json(folder / "plan.json", plan.to_json())
    write_json(folder / "certificate.json", planned.certificate.to_json())
    (folder / "settings.txt").write_text(settings_table(planned.rows) + "\n", encoding="utf-8")
    write_triggers(folder, plan, planned.costs, planned.imaging.shortest_interval_s)

    @progress.step("write maps and missions")
    def write_maps_and_missions() -> None:
        from alice_survey.kit.figure import save_figure
        from missions.exports.format import options_of
        from missions.exports.write import write_exports
        from missions.plan.map import plan_figure

        figure = plan_figure(plan, rig, planned.certificate, planned.bathymetry, survey.sea)
        save_figure(figure, folder / "map.png")
        options = options_of(survey.camera, survey.plan, survey.vehicle, survey.sea)
        write_exports(folder / EXPORTS, plan, rig, options=options)

    return write_maps_and_missions


def write_triggers(folder: Path, plan: Plan, costs: Costs, shortest_interval_s: float) -> None:
    """Write the time table of the trigger controller, of each dive flown as planned.

    A dive's clock starts when the vehicle has reached its altitude at home; it comes to rest first.
    """
    for number, dive in enumerate(plan.dives, start=1):
        name = "triggers.csv" if len(plan.dives) == 1 else f"triggers_dive{number}.csv"
        rows = trigger_table(
            station_times_s(plan, dive, costs),
            plan.exposure_s,
            plan.strobe_lead_s,
            shortest_interval_s,
        )
        write_csv(folder / name, HEADER, rows.tolist())


def station_times_s(plan: Plan, dive: Dive, costs: Costs) -> list[float]:
    """When pictures are taken on a dive that is flown exactly, seconds from its start.

    Where a line begins at the very place where the one before has ended, one picture serves both.
    """
    _, took_s = leg_costs(dive.route, costs)
    starts_s = costs.settle_s + np.concatenate([[0.0], np.cumsum(took_s)])
    times: list[float] = []
    for index, leg in enumerate(dive.route.legs):
        if leg.line >= 0:
            stations = plan.lines[leg.line].stations
            passed = np.linspace(starts_s[index], starts_s[index + 1], stations).tolist()
            again = bool(times) and passed[0] - times[-1] < _SAME_S
            times += passed[1:] if again else passed
    return times


def trigger_table(
    times_s: Sequence[float], exposure_s: float, lead_s: float, shortest_interval_s: float
) -> NDArray[np.int64]:
    """The time table of some triggers, (T, 10) with the columns `HEADER`.

    An exposure is a whole number of microseconds, the lead rounded up to one.

    Args:
        times_s: middles of the exposures since the start, rising.
        exposure_s: of the cameras.
        lead_s: of the strobes before the exposure and after it.
        shortest_interval_s: of the cameras and the controller.

    Raises:
        PlanError: a trigger follows another too soon, or while its strobe is lit.
    """
    exposure_us, lead_us = round(exposure_s * _US), math.ceil(lead_s * _US - 1e-6)
    opens_us = -(exposure_us // 2)
    closes_us = exposure_us + opens_us
    relative = np.array([opens_us - lead_us, opens_us, closes_us, closes_us + lead_us])
    trigger_us = np.round(np.asarray(times_s, dtype=np.float64) * _US).astype(np.int64)
    # Rounding moves each trigger by half a microsecond at most.
    min_us = max(round(shortest_interval_s * _US) - 1, exposure_us + 2 * lead_us + 1)
    soon = np.flatnonzero(np.diff(trigger_us) < min_us)
    if len(soon):
        i = int(soon[0]) + 1
        raise PlanError(
            f"trigger {i} at {trigger_us[i] / _US:.6f} s follows the one before by "
            f"{(trigger_us[i] - trigger_us[i - 1]) / _US:.6f} s; cameras and strobes take "
            f"{min_us / _US:.6f} s: lower speed_mps, forward_overlap or allowed_blur_px"
        )
    count = len(trigger_us)
    return np.column_stack([
        np.arange(count), trigger_us, trigger_us[:, None] + relative, np.tile(relative, (count, 1)),
    ])  # fmt: skip
