import re

import pytest

from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from missions.plan.solve import solve_lenses, solve_report
from tests.missions.exposure.surveys import survey

DEPTH_M = SurveyConfig().area.seafloor_depth_m


def test_a_resolution_gives_the_altitude_whose_pixel_it_is() -> None:
    own = survey(plan={"side_overlap": 0.45})[1]
    best, other = solve_lenses(own, DEPTH_M, 0.448, (25.0, 12.5))
    assert best.values["lens_mm"] == 12.5
    assert best.against == ""
    assert best.values["altitude_m"] == pytest.approx(2.0, abs=0.005)
    assert best.values["pixel_mm"] <= 0.448
    # The longer lens flies twice as high and is in the dark.
    assert other.values["altitude_m"] == pytest.approx(4.03, abs=0.05)
    assert other.against
    data = solve_report(own, DEPTH_M, 0.448, (25.0, 12.5))[1]["lenses"]
    assert [row["fits"] for row in data] == [True, False]


@pytest.mark.parametrize(
    "resolution_mm",
    [0.22, *(pytest.param(r, marks=pytest.mark.slow) for r in (0.001, 0.05, 2.0, 5.0))],
)
def test_a_resolution_beyond_all_lenses_is_refused_with_the_nearest_that_fits(
    resolution_mm: float,
) -> None:
    _, setup = survey()
    with pytest.raises(PlanError) as fault:
        solve_lenses(setup, DEPTH_M, resolution_mm, (12.5, 25.0))
    (text,) = str(fault.value).splitlines()
    fits_mm, lens_mm = map(
        float, re.search(r"; ([\d.]+) mm fits, with the ([\d.]+) mm", text).groups()
    )
    assert not solve_lenses(setup, DEPTH_M, fits_mm, (lens_mm,))[0].against
