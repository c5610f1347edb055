"""What exports say beforehand of the vehicles that will follow them."""

import math
from pathlib import Path
from typing import Any

import pytest

from alice_survey.core.config import CameraConfig, PlanConfig, SeaConfig, VehicleConfig
from alice_survey.core.errors import keep_warnings
from alice_survey.sim.vehicle.pilot.mission import steady_drift
from missions.exports.follower import line_offset_m
from missions.exports.format import Options, options_of
from missions.exports.write import write_exports
from tests.missions.exports.plans import RIG, small_plan


def options(vehicle: str = "alice", **sea: Any) -> Options:
    wanted = SeaConfig(**({"gust_n": (0.0, 0.0, 0.0)} | sea))
    return options_of(CameraConfig(), PlanConfig(), VehicleConfig(name=vehicle), wanted)


def about(folder: Path, given: Options, formats: list[str] | None) -> tuple[str, list[str]]:
    with keep_warnings() as warnings:
        write_exports(folder, small_plan(), RIG, formats=formats, options=given)
    return (folder / "about.txt").read_text(), list(warnings)


@pytest.mark.parametrize(
    ("vehicle", "formats", "towards_deg", "warns"),
    [
        ("alice", ["cola2"], 90.0, True),  # lines run north and south
        ("alice", ["cola2"], 0.0, False),
        ("alice", ["wpl"], 90.0, False),
        ("alice", None, 90.0, False),
        ("sparus2", None, 90.0, True),
    ],
)
def test_lines_that_cola2_cannot_hold_are_said_beforehand(
    vehicle: str, formats: list[str] | None, towards_deg: float, warns: bool, tmp_path: Path
) -> None:
    given = options(vehicle, current_mps=0.1, current_towards_deg=towards_deg)
    _, warnings = about(tmp_path, given, formats)
    assert any("COLA2 holds" in text for text in warnings) == warns
    assert all("\n" not in text for text in warnings)


def test_a_current_holds_the_glass_off_its_line() -> None:
    follower = options(current_mps=0.05, current_towards_deg=90.0).follower
    assert follower is not None
    # Of the glass 0.55 m ahead of a vehicle that heads upstream.
    wanted = (follower.delta_m - 0.55) * steady_drift(0.05, 0.2)
    north = line_offset_m(follower, 0.0, 0.2, 0.55)
    assert (
        north
        == pytest.approx(wanted)
        == pytest.approx(-line_offset_m(follower, math.pi, 0.2, 0.55))
    )
    assert line_offset_m(follower, math.pi / 2, 0.2, 0.55) == pytest.approx(0.0, abs=1e-12)
