import pytest
from hypothesis import given
from hypothesis import strategies as st

from missions.exposure import strobe
from tests.missions.exposure.surveys import conflict_of, survey


def test_two_strobes_of_thirty_thousand_lumens() -> None:
    _, config = survey()
    load = strobe.strobe_load(config.imaging, config.plan, 1.8e-3, 2.35)
    assert load.pulse_s == pytest.approx(2.2e-3)
    assert load.duty == pytest.approx(2.2e-3 / 2.35)
    assert load.lit_w == pytest.approx(288.3, abs=0.1)  # 20 LEDs of 14.4 W
    assert load.frame_j == pytest.approx(2 * 288.3 * 2.2e-3 / 0.9, rel=1e-3)
    assert load.mean_w == pytest.approx(load.frame_j / 2.35)
    assert load.peak_a == pytest.approx(2 * 288.3 / 0.9 / 28.0, rel=1e-3)
    assert 30.0 < load.solder_c < 30.5
    assert load.junction_c == pytest.approx(load.solder_c + 1.8 * 14.41, abs=0.05)


@given(energy_j=st.floats(1e-3, 1e3), sag=st.floats(0.01, 0.9))
def test_the_capacitor_gives_the_energy_between_its_voltages(energy_j: float, sag: float) -> None:
    farad = strobe.capacitor_f(energy_j, strobe.BUS_V, sag)
    low = strobe.BUS_V * (1 - sag)
    assert 0.5 * farad * strobe.BUS_V**2 - 0.5 * farad * low**2 == pytest.approx(energy_j, rel=1e-9)


def test_at_the_duty_limit_the_solder_point_is_at_85_degrees() -> None:
    _, config = survey()
    limit = strobe.duty_limit(config.imaging)
    interval_s = 0.01
    exposure_s = limit * interval_s - 2 * config.plan.strobe_lead_s - 1e-9
    load = strobe.strobe_load(config.imaging, config.plan, exposure_s, interval_s)
    assert load.solder_c == pytest.approx(85.0, abs=0.01)
    # All that a strobe of 1000 lm draws may be lit without end.
    small = config.imaging.model_copy(update={"strobe_lumens": 1000.0})
    assert strobe.duty_limit(small) == 1.0
    assert small.strobe_lumens / strobe.EFFICACY_LM_W == pytest.approx(9.6, abs=0.1)


def test_a_duty_cycle_that_is_too_high_suggests_the_blur_that_just_fits() -> None:
    _, config = survey(imaging={"strobe_lumens": 1e6})
    exposure_s, interval_s = 2e-3, 0.12
    error = conflict_of(strobe.strobe_load, config.imaging, config.plan, exposure_s, interval_s)
    name, blur_px = error.suggestion
    assert name == "plan.allowed_blur_px"
    shorter_s = exposure_s * blur_px / config.plan.allowed_blur_px
    load = strobe.strobe_load(config.imaging, config.plan, shorter_s, interval_s)
    assert 0.97 * load.duty_limit < load.duty <= load.duty_limit


def test_storage_counts_every_pixel() -> None:
    camera = survey()[0].cameras["left"]
    assert strobe.raw_bytes(camera, 2, 603) == 3384 * 2710 * 2 * 603
    storage = strobe.storage_load(camera, 2, 0.5)
    assert storage.bytes_per_s == 3384 * 2710 * 2 * 2
    # One Gigabit cable takes 13.5 pictures a second of one camera, 6.8 of two.
    assert storage.own_link_hz == pytest.approx(13.5, abs=0.05)
    assert storage.shared_link_hz == pytest.approx(6.76, abs=0.01)
    assert storage.disk_hz == pytest.approx(13.6, abs=0.05)
