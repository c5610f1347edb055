"""The stage `plan`: a survey planned, and written for the next stages, for people, for vehicles."""

from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import write_json
from alice_survey.core.config import SeaConfig, SurveyConfig
from alice_survey.core.executor import Executor
from alice_survey.core.run import progress
from camera_calib.rig import Rig, design_rig
from missions.exports.options import Options, options_of
from missions.exports.write import write_exports
from missions.exposure.settings_table import settings_table
from missions.exposure.timetable import trigger_table, write_timetable
from missions.plan.map import draw_plan
from missions.plan.planner import Planned, plan_survey
from missions.values.costs import Costs, leg_costs
from missions.values.plan_file import Dive, Plan

_SAME_S = 1e-3


def run_plan(workspace: Path, folder: Path, executor: Executor, *, survey: SurveyConfig) -> None:
    """Write plan.json, its certificate, settings, maps and missions for vehicles.

    Raises:
        PlanError: no plan meets the settings.
    """
    rig = design_rig(survey.camera, survey.water)
    planned = plan_survey(survey, rig)
    options = options_of(survey.camera, survey.plan, survey.vehicle, survey.sea)
    write_planned(folder, planned, rig, options, survey.sea)


@progress.step("write plan, maps and missions")
def write_planned(
    folder: Path,
    planned: Planned,
    rig: Rig,
    options: Options,
    sea: SeaConfig,
) -> None:
    """Write a plan.

    Args:
        folder: of the stage.
        planned: the plan and what led to it.
        rig: its cameras in water.
        options: what vehicles need besides the plan.
        sea: the current that maps show.
    """
    plan = planned.plan
    write_json(folder / "plan.json", plan.to_json())
    write_json(folder / "certificate.json", planned.certificate.to_json())
    table = "\n\n".join(filter(None, (settings_table(planned.rows), planned.terrain)))
    (folder / "settings.txt").write_text(table + "\n", encoding="utf-8")
    write_triggers(folder, plan, planned.costs, planned.imaging.shortest_interval_s)
    draw_plan(folder / "map.png", plan, rig, planned.certificate, planned.bathymetry, sea)
    write_exports(folder / "exports", plan, rig, options=options)


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
        write_timetable(folder / name, rows)


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
