import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.config import CameraConfig, WaterConfig
from alice_survey.errors import ConfigError
from camera_calib.flat_port import FlatPortCamera
from camera_calib.fov import (
    MATCH_SIGMA_PX,
    apparent_distance_m,
    format_checks,
    format_fov,
    fov_table,
    last_digit,
    validate_paper_table,
)
from camera_calib.rig import design_rig

NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)
PORT = CameraConfig()


def left(config: CameraConfig, n_water: float) -> FlatPortCamera:
    return design_rig(config, WaterConfig(n_water=n_water)).cameras["left"]


def test_all_six_values_of_the_papers_table_pass() -> None:
    checks = validate_paper_table()

    computed = {(c.lens_mm, c.quantity): c.computed for c in checks}
    assert computed == pytest.approx(
        {
            (12.5, "horizontal"): 1.4268,
            (12.5, "vertical"): 1.1632,
            (12.5, "pixel"): 0.4439,
            (25.0, "horizontal"): 0.7411,
            (25.0, "vertical"): 0.5963,
            (25.0, "pixel"): 0.2220,
        },
        abs=5e-5,
    )
    assert [c.paper for c in checks] == ["1.4", "1.16", "0.45", "0.75", "0.6", "0.22"]
    assert all(c.passed for c in checks)
    for check in checks:
        assert check.difference == pytest.approx(check.computed - float(check.paper))


def test_the_paper_s_roundings_are_told() -> None:
    notes = {(c.lens_mm, c.quantity): c.note for c in validate_paper_table()}

    assert "rounds to 0.44; the paper prints 0.45" in notes[(12.5, "pixel")]
    assert "rounds to 0.74; the paper prints 0.75" in notes[(25.0, "horizontal")]
    assert "prints" not in notes[(12.5, "vertical")]


def test_the_check_can_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "camera_calib.fov._PAPER_TABLE",
        ((12.5, "vertical", "m", "1.18"), (12.5, "vertical", "m", "1.2")),
    )

    assert [c.passed for c in validate_paper_table()] == [False, True]
    assert "FAIL" in format_checks(validate_paper_table())


@pytest.mark.parametrize(("printed", "unit"), [("1.4", 0.1), ("1.16", 0.01), ("3", 1.0)])
def test_the_last_digit_printed(printed: str, unit: float) -> None:
    assert last_digit(printed) == pytest.approx(unit)


@pytest.mark.parametrize(
    ("lens_mm", "n_water", "horizontal_m", "vertical_m"),
    [
        (12.5, 1.33, 1.427, 1.163),
        (12.5, 1.34, 1.415, 1.154),
        (25.0, 1.33, 0.741, 0.596),
        (25.0, 1.34, 0.735, 0.592),
    ],
)
def test_footprints_without_a_port_are_those_of_two_sines(
    lens_mm: float, n_water: float, horizontal_m: float, vertical_m: float
) -> None:
    row = fov_table([lens_mm], [2.0], n_water, NO_PORT)[0]

    for size, half_mm, table in (
        (row.horizontal_m, 3384 * 3.69e-3 / 2, horizontal_m),
        (row.vertical_m, 2710 * 3.69e-3 / 2, vertical_m),
    ):
        in_air = math.atan(half_mm / lens_mm)
        in_water = math.asin(math.sin(in_air) / n_water)
        assert size == pytest.approx(2 * 2.0 * math.tan(in_water), rel=1e-12)
        assert size == pytest.approx(table, abs=6e-4)


def test_in_air_it_is_a_pinhole() -> None:
    row = fov_table([12.5], [2.0], 1.0, NO_PORT)[0]

    assert row.horizontal_m == pytest.approx(2 * 3384 * 3.69e-3 / 12.5)
    assert row.pixel_centre_mm == pytest.approx(row.pixel_mean_mm)
    assert row.pixel_corner_mm == pytest.approx(row.pixel_centre_mm)
    assert row.diagonal_water_deg == pytest.approx(row.diagonal_air_deg)
    assert row.diagonal_air_deg == pytest.approx(65.2, abs=0.05)
    assert row.focus_air_m == pytest.approx(2.0)


@given(
    altitude_m=st.floats(0.3, 10.0),
    n_water=st.floats(1.0, 1.36),
    lens_mm=st.floats(8.0, 50.0),
)
def test_pixel_sizes_are_those_of_the_camera(
    altitude_m: float, n_water: float, lens_mm: float
) -> None:
    config = PORT.model_copy(update={"focal_mm": lens_mm})
    camera = left(config, n_water)
    row = fov_table([lens_mm], [altitude_m], n_water, PORT)[0]
    z = 0.03 + altitude_m

    centre = np.array([camera.cx_px, camera.cy_px])
    half = np.array([0.5, 0.0])
    step = camera.at_depth(centre + half, z) - camera.at_depth(centre - half, z)
    assert row.pixel_centre_mm == pytest.approx(step[0] * 1e3, rel=1e-6)
    assert row.horizontal_m == pytest.approx(row.pixel_mean_mm * 1e-3 * 3384)
    # Refraction narrows what a pixel sees towards the corner.
    assert row.pixel_corner_mm <= row.pixel_mean_mm * (1 + 1e-9)
    assert row.pixel_mean_mm <= row.pixel_centre_mm * (1 + 1e-9)


@given(altitude_m=st.floats(0.5, 10.0), n_water=st.floats(1.3, 1.36))
def test_depth_precision_is_what_the_pair_s_disparity_gives(
    altitude_m: float, n_water: float
) -> None:
    rig = design_rig(PORT, WaterConfig(n_water=n_water))
    camera = rig.cameras["left"]

    def disparity(altitude: float) -> float:
        # A point before the middle of the pair, so near the axis that Snell's law is linear.
        offset = 1e-6
        point = np.array([offset, 0.0, 0.03 + altitude])
        return float(camera.project(point)[0] - camera.cx_px) / offset * PORT.baseline_m

    slope = (disparity(altitude_m - 1e-3) - disparity(altitude_m + 1e-3)) / 2e-3
    row = fov_table([12.5], [altitude_m], n_water, PORT)[0]
    assert row.depth_sigma_mm == pytest.approx(MATCH_SIGMA_PX / slope * 1e3, rel=1e-3)


def test_depth_precision_and_focus_at_the_papers_range() -> None:
    row = fov_table([12.5], [2.0], 1.34, NO_PORT)[0]
    assert row.depth_sigma_mm == pytest.approx(2.64, abs=0.01)

    fresh = fov_table([12.5], [2.0], 1.33, NO_PORT)[0]
    assert fresh.focus_air_m == pytest.approx(1.5, abs=0.01)
    assert fresh.stereo_overlap == pytest.approx(1 - 0.1 / 1.4268, abs=1e-4)


def test_a_focused_point_is_sharp_where_its_rays_seem_to_come_from() -> None:
    """Rays that leave one point cross the axis, traced back in air, at the focus distance."""
    camera = left(PORT, 1.34)
    point = np.array([0.0, 1e-4, 2.03])
    pixel = camera.project(point)
    apparent = point[1] / ((pixel[1] - camera.cy_px) / camera.fy_px)

    assert apparent_distance_m(camera, 2.0) == pytest.approx(apparent, rel=1e-6)


def test_rows_come_lens_by_lens_and_scale_with_altitude() -> None:
    rows = fov_table([12.5, 25.0], [1.0, 2.0], 1.34, NO_PORT)

    assert [(r.lens_mm, r.altitude_m) for r in rows] == [
        (12.5, 1.0), (12.5, 2.0), (25.0, 1.0), (25.0, 2.0),
    ]  # fmt: skip
    assert rows[1].horizontal_m == pytest.approx(2 * rows[0].horizontal_m)
    assert rows[1].depth_sigma_mm == pytest.approx(4 * rows[0].depth_sigma_mm)


def test_wide_lenses_are_marked() -> None:
    narrow, wide = fov_table([12.5, 8.0], [2.0], 1.34, PORT)

    assert narrow.within_trusted_fov
    assert not wide.within_trusted_fov
    assert "(!)" in format_fov([wide])
    assert "(!)" not in format_fov([narrow])


def test_tables_hold_every_value() -> None:
    text = format_fov(fov_table([12.5, 25.0], [2.0], 1.33, NO_PORT))
    for value in ("1.427 x 1.163 m", "0.741 x 0.596 m", "0.444", "65.2"):
        assert value in text
    assert validate_paper_table()[0].to_json()["paper"] == "1.4"
    assert fov_table([12.5], [2.0], 1.33, NO_PORT)[0].to_json()["horizontal_m"] == pytest.approx(
        1.4268, abs=1e-4
    )


@pytest.mark.parametrize(
    ("lenses", "altitudes", "n_water", "words"),
    [
        ([0.0], [2.0], 1.34, "lens 0"),
        ([math.nan], [2.0], 1.34, "lens nan"),
        ([12.5], [-1.0], 1.34, "altitude -1"),
        ([12.5], [math.inf], 1.34, "altitude inf"),
        ([12.5], [2.0], 2.0, "n_water 2"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    lenses: list[float], altitudes: list[float], n_water: float, words: str
) -> None:
    with pytest.raises(ConfigError, match=words) as fault:
        fov_table(lenses, altitudes, n_water, PORT)
    assert "allowed" in str(fault.value)
    assert "\n" not in str(fault.value)
