import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import PlanError
from missions.exposure.settings import imaging_settings
from missions.plan.rows import WIDTH, imaging_rows, settings_table
from tests.missions.exposure.surveys import survey


def test_settings_of_the_papers_mission() -> None:
    planned = imaging_settings(*survey(plan={"line_spacing_m": 1.0}))

    assert planned.footprint_across_m == pytest.approx(1.398, abs=1e-3)
    assert planned.footprint_along_m == pytest.approx(1.119, abs=1e-3)
    assert planned.pixel_m == pytest.approx(0.448e-3, abs=1e-6)
    assert planned.line_spacing_m == 1.0
    assert planned.spacing.mean_overlap == pytest.approx(0.2845, abs=1e-3)
    assert 1 / planned.interval_s == pytest.approx(0.447, abs=0.003)
    assert planned.forward_overlap == pytest.approx(0.6, abs=1e-3)
    assert planned.strobe_pulse_s == pytest.approx(planned.exposure_s + 2 * 0.2e-3)
    assert planned.paper_rule.forward_overlap == pytest.approx(0.285, abs=1e-3)
    assert planned.focus.focus_mean_air_m == pytest.approx(1.52, abs=0.005)
    # Speed alone allows 2.24 ms at the centre; the corners and the attitude rates take their share.
    assert 1.5e-3 < planned.exposure_s < 2.24e-3
    still = survey(plan={"yaw_rate_deg_s": 0, "roll_pitch_rate_deg_s": 0})
    by_speed = imaging_settings(*still)
    assert planned.exposure_s < by_speed.exposure_s < 2.24e-3


@settings(max_examples=60, deadline=None)
@given(plan=st.fixed_dictionaries({
    "altitude_m": st.floats(1.0, 8), "speed_mps": st.floats(0.05, 1.0),
    "forward_overlap": st.floats(0, 0.9), "allowed_blur_px": st.floats(0.2, 5),
}))  # fmt: skip
def test_what_was_requested_is_reached(plan: dict[str, float]) -> None:
    rig, config = survey(camera={"shortest_interval_s": 0.01}, plan={"relief_m": 0.1, **plan})
    planned = imaging_settings(rig, config)
    speed_mps, blur_px = plan["speed_mps"], plan["allowed_blur_px"]

    # Rounding down to a millisecond of interval costs at most that much overlap.
    finest = speed_mps * 1e-3 / planned.footprint_along_m
    assert -1e-8 <= planned.forward_overlap - plan["forward_overlap"] <= finest + 1e-8
    assert planned.station_spacing_m == pytest.approx(planned.interval_s * speed_mps, abs=1e-8)
    assert planned.blur_px <= blur_px + 1e-6
    assert planned.blur_px >= blur_px - planned.blur.combined * 1e-5 - 1e-6
    assert 0 < planned.strobe_duty < 1
    assert planned.imaging_w == pytest.approx(planned.strobe.frame_j / planned.interval_s)


def test_rows_name_equation_source_and_limit_and_fit_a_hundred_columns() -> None:
    rig, setup = survey(plan={"side_overlap": 0.45, "track_error_m": 0.12, "relief_m": 0.0})
    planned = imaging_settings(rig, setup)
    rows = imaging_rows(planned, setup)
    assert len({row.name for row in rows}) == len(rows) > 30
    assert all(row.equation and row.bound_by for row in rows)
    assert max(map(len, settings_table(rows).splitlines())) <= WIDTH
    data = json.loads(json.dumps(planned.to_json(), allow_nan=False))
    assert data["spacing"]["spacing_m"] == planned.line_spacing_m


def test_an_exposure_too_short_is_refused() -> None:
    with pytest.raises(PlanError, match=r"allowed_blur_px 0\.001"):
        imaging_settings(*survey(plan={"allowed_blur_px": 0.001}))


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"plan": {"altitude_m": 1.2}}, "camera.f_number"),
        ({"plan": {"altitude_m": 1.2}}, "0.85 m"),
        ({"water": {"jerlov": "9C"}}, "allowed_blur_px"),
        ({"plan": {"line_spacing_m": 1.4}}, "0.24 m"),
        ({"plan": {"forward_overlap": 0.0}}, "0.19 m"),
        ({"plan": {"forward_overlap": 0.9, "speed_mps": 1.0}}, "cable"),
    ],
)
def test_what_will_be_poor_is_warned_of(
    sections: dict[str, Any], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    imaging_settings(*survey(**sections), quiet=True)
    imaging_settings(*survey(plan={"line_spacing_m": 1.0}))  # the paper's mission
    assert capsys.readouterr().err == ""
    imaging_settings(*survey(**sections))
    assert named in capsys.readouterr().err


def test_exposure_grows_with_altitude() -> None:
    low, high = (
        imaging_settings(*survey(plan={"altitude_m": a, "relief_m": 0.1})) for a in (1.0, 3.0)
    )
    assert high.exposure_s > 2 * low.exposure_s
    assert low.blur_px == pytest.approx(1.0, abs=0.02)
