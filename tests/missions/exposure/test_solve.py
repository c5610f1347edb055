import re

import pytest

from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from missions.exposure.settings import imaging_settings
from missions.exposure.solve import lenses_for_resolution, speeds_for_rate
from missions.values.footprint import footprint_size_m
from tests.missions.exposure.surveys import number_in, survey

DEPTH_M = SurveyConfig().area.seafloor_depth_m


def test_a_resolution_gives_the_altitude_whose_pixel_it_is() -> None:
    _, config = survey(plan={"side_overlap": 0.45})
    best, other = lenses_for_resolution(config, DEPTH_M, 0.448, (25.0, 12.5))
    assert best.lens_mm == 12.5
    assert best.fits
    assert best.altitude_m == pytest.approx(2.0, abs=0.005)
    rig, planned = survey(plan={"side_overlap": 0.45, "altitude_m": best.altitude_m})
    settings = imaging_settings(rig, planned)
    assert settings.pixel_m * 1e3 <= 0.448
    assert best.spacing_m == pytest.approx(settings.line_spacing_m)
    assert best.exposure_ms == pytest.approx(settings.exposure_s * 1e3)
    # The longer lens flies twice as high and is in the dark.
    assert other.altitude_m == pytest.approx(4.03, abs=0.05)
    assert not other.fits


def test_ways_out_of_a_resolution_that_is_too_fine_work() -> None:
    _, config = survey()
    with pytest.raises(PlanError) as fault:
        lenses_for_resolution(config, DEPTH_M, 0.22, (12.5, 25.0))
    text = str(fault.value)
    assert 2 <= len(text.splitlines()) <= 4
    finer = number_in(text, r"resolution ([\d.]+) mm with the 12.5")
    assert lenses_for_resolution(config, DEPTH_M, finer + 5e-4, (12.5,))[0].fits
    blur = number_in(text, r"allowed_blur_px ([\d.]+)")
    _, blurred = survey(plan={"allowed_blur_px": blur})
    assert lenses_for_resolution(blurred, DEPTH_M, 0.22, (25.0,))[0].snr == pytest.approx(
        5.0, abs=0.05
    )


@pytest.mark.parametrize(
    ("resolution_mm", "lens_mm"),
    [(0.001, None), (0.05, None), (0.25, 15.4), (2.0, None), (5.0, None)],
)
def test_resolutions_beyond_all_lenses_are_refused(
    resolution_mm: float, lens_mm: float | None
) -> None:
    """Another lens is offered where it would do: not behind the glass, in the dark or unsharp."""
    _, config = survey()
    lenses = (12.5,) if resolution_mm == 0.25 else (12.5, 25.0)
    with pytest.raises(PlanError) as fault:
        lenses_for_resolution(config, DEPTH_M, resolution_mm, lenses)
    text = str(fault.value)
    assert len(text.splitlines()) <= 4
    assert "allowed_blur_px" not in text
    offered = re.search(r"- a lens of about ([\d.]+) mm", text)
    assert (offered is None) == (lens_mm is None)
    if offered is not None:
        assert float(offered[1]) == pytest.approx(lens_mm, rel=0.05)
        assert lenses_for_resolution(config, DEPTH_M, resolution_mm, (float(offered[1]),))[0].fits


def test_a_fixed_rate_gives_the_speed_that_overlaps_as_requested() -> None:
    rig, config = survey()
    option = speeds_for_rate(config, 0.25, (12.5,))[0]
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    assert option.speed_mps == pytest.approx(0.25 * along_m * 0.4, abs=1e-4)
    # At the paper's 0.2 m/s its 0.25 Hz overlap by 31 to 32 %.
    assert option.forward_overlap == pytest.approx(1 - 0.8 / along_m)
    moved = survey(plan={"speed_mps": option.speed_mps})
    assert imaging_settings(*moved).interval_s == pytest.approx(4.0, abs=0.005)


def test_a_rate_beyond_the_trigger_is_refused() -> None:
    with pytest.raises(PlanError, match=r"camera\.shortest_interval_s"):
        speeds_for_rate(survey()[1], 14.0, (12.5,))
