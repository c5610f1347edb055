from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from camera_calib.fov.table import fov_table
from missions.exposure.focus import Focus, aperture_warning, plan_focus
from missions.exposure.settings import ImagingSetup
from tests.missions.exposure.surveys import conflict_of, survey
from tests.oracles_imaging import blur_circle_px


def focused(**sections: Any) -> tuple[Focus, ImagingSetup]:
    rig, config = survey(**sections)
    return plan_focus(rig.cameras["left"], config.camera, config.plan), config


def test_the_papers_lens_focuses_at_one_and_a_half_metres_in_air() -> None:
    focus, _ = focused(ideal_port=True, water={"n_water": 1.33}, plan={"relief_m": 0.0})
    assert focus.focus_air_m == pytest.approx(2.0 / 1.33, rel=1e-12)
    assert round(focus.focus_air_m, 1) == 1.5
    # The paper's 2 m of depth of field at F/4 counts 3 px as sharp.
    assert focus.far_altitude_m - focus.near_altitude_m == pytest.approx(2.05, abs=0.06)


def test_the_depth_of_field_agrees_with_the_table_of_views() -> None:
    focus, config = focused(plan={"relief_m": 0.0})
    row = fov_table([12.5], [2.0], 1.34, config.camera, 3.0)[0]
    assert focus.near_altitude_m == pytest.approx(row.near_altitude_m, rel=1e-6)
    assert focus.far_altitude_m == pytest.approx(row.far_altitude_m, rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.floats(1.0, 8.0), st.floats(0.01, 0.4), st.floats(1.4, 8.0), st.floats(8.0, 35.0))
def test_blur_at_both_ends_of_the_relief_is_that_of_traced_images(
    altitude_m: float, relief: float, f_number: float, lens_mm: float
) -> None:
    focus, _ = focused(
        ideal_port=True,
        camera={"focal_mm": lens_mm, "f_number": f_number},
        plan={"altitude_m": altitude_m, "relief_m": relief * altitude_m, "sharp_px": 20.0},
    )
    assume(focus.f_number_needed < f_number)
    for sign in (-1, 1):
        apparent = altitude_m * (1 + sign * relief) / 1.34
        blur = blur_circle_px(lens_mm * 1e-3, f_number, 3.69e-6, focus.focus_air_m, apparent)
        assert focus.blur_px == pytest.approx(blur, rel=1e-9)
    assert focus.near_altitude_m <= altitude_m * (1 - relief) + 1e-9
    assert focus.far_altitude_m >= altitude_m * (1 + relief) - 1e-9


def test_the_f_number_needed_just_fills_the_circle_and_is_what_a_warning_names() -> None:
    rig, config = survey(plan={"altitude_m": 1.2})
    camera = rig.cameras["left"]
    focus = plan_focus(camera, config.camera, config.plan)
    named = f"camera.f_number to {focus.f_number_to_set:g}"
    assert named in aperture_warning(focus, config.camera, config.plan)
    closed = config.camera.model_copy(update={"f_number": focus.f_number_needed})
    filled = plan_focus(camera, closed, config.plan)
    assert filled.blur_px == pytest.approx(config.plan.sharp_px, rel=1e-9)
    assert filled.f_number_needed == pytest.approx(focus.f_number_needed, rel=1e-9)
    assert not aperture_warning(filled, closed, config.plan)


def test_diffraction_of_green_light_at_f4() -> None:
    focus, _ = focused()
    assert focus.airy_px == pytest.approx(2.44 * 0.53 * 4 / 3.69, rel=0.01)
    assert focus.f_number_diffraction == pytest.approx(3.0 / focus.airy_px * 4, rel=1e-9)


def test_a_lens_that_cannot_focus_suggests_the_circle_that_just_fits() -> None:
    name, sharp_px = conflict_of(focused, plan={"altitude_m": 0.8}).suggestion
    assert name == "plan.sharp_px"
    focus, _ = focused(plan={"altitude_m": 0.8, "sharp_px": sharp_px})
    assert 0.9 * focus.f_number_diffraction < focus.f_number_needed < focus.f_number_diffraction
