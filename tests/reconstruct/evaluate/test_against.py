"""A known mound between two surveys is found where it is, as large as it is, and nothing else."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import write_json
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Datum
from reconstruct.elevation import Elevation
from reconstruct.evaluate.change import compare_elevations, enu_from_enu, evaluate_against
from reconstruct.evaluate.registration import register_heights, rough_shifts
from reconstruct.views.model import WorldFrame, write_frame
from tests.alice_survey.app.report.tiny import write_raster

CELL, SIDE, SIGMA_M = 0.02, 200, 0.001
MOUND_M, WIDTH_M, AT = 0.02, 0.15, (1.5, 2.2)
MOUND_M3 = MOUND_M * 2 * math.pi * WIDTH_M**2
AWAY = RigidTransform.from_components([0.12, -0.2, 0.05], Rotation.from_rotvec([2e-3, -3e-3, 0.01]))
"""Where the earlier survey's georeference is wrong."""
STILL = RigidTransform.identity()


def relief(east: np.ndarray, north: np.ndarray, mound_m: float) -> np.ndarray:
    wave = 0.05 * np.sin(2 * np.pi * east / 0.9 + 0.5 * np.sin(north))
    wave += 0.04 * np.cos(2 * np.pi * (north + 0.3 * east) / 1.3)
    hills = 0.1 * np.exp(-((east - 2) ** 2 + (north - 1) ** 2) / 0.3)
    hills -= 0.07 * np.exp(-((east - 1) ** 2 + (north - 3) ** 2) / 0.5)
    away2 = (east - AT[0]) ** 2 + (north - AT[1]) ** 2
    return wave + hills + mound_m * np.exp(-away2 / (2 * WIDTH_M**2))


def survey(seed: int, world_from_own: RigidTransform, mound_m: float) -> Elevation:
    """The relief as a survey sees it whose frame lies askew, with white noise."""
    east = (np.arange(SIDE) + 0.5) * CELL
    easts, norths = np.meshgrid(east, 4.0 - (np.arange(SIDE) + 0.5) * CELL)
    height = relief(easts, norths, mound_m)
    for _ in range(20):  # the height at which a vertical of the survey's frame meets the relief
        world = world_from_own.apply(np.stack([easts, norths, height], -1).reshape(-1, 3))
        gap = relief(world[:, 0], world[:, 1], mound_m) - world[:, 2]
        height = height + gap.reshape(height.shape)
    height = height + SIGMA_M * np.random.default_rng(seed).normal(size=height.shape)
    sigma = np.full(height.shape, SIGMA_M)
    return Elevation(height=height, sigma=sigma, west=0.0, north=4.0, cell=CELL)


@pytest.mark.slow
def test_a_mound_is_measured_within_its_sigma_and_nothing_else_changes() -> None:
    ratios = []
    for seed in range(5):
        now, before = survey(seed, STILL, MOUND_M), survey(100 + seed, AWAY, 0.0)
        change, fit = compare_elevations(now, before, STILL)
        (region,) = change.regions
        assert (region.east_m, region.north_m) == pytest.approx(AT, abs=0.03)
        assert region.volume_m3 == pytest.approx(MOUND_M3, rel=0.05)
        assert change.changed.sum() * CELL**2 == pytest.approx(region.area_m2, rel=1e-9)
        assert change.changed[int((4.0 - AT[1]) / CELL), int(AT[0] / CELL)]
        ratios.append((region.volume_m3 - MOUND_M3) / region.sigma_m3)
        figures = change.to_json()
        # Heights between cells are means of noisy cells: fewer than 5 % exceed what cells would.
        assert 0.01 < figures["unchanged"]["share_significant"] < 0.06
        left = AWAY.inv() * fit.fixed_from_moving
        assert np.rad2deg(left.rotation.magnitude()) < 0.02
        miss = left.apply(fit.centre) - fit.centre
        assert np.abs(miss).max() < 1e-3
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0
    assert MOUND_M3 / region.sigma_m3 > 50


def test_the_same_ground_shows_no_change_and_chance_share_of_significant_cells() -> None:
    still = survey(1, STILL, 0.0)
    change, _ = compare_elevations(still, survey(2, STILL, 0.0), STILL)
    assert change.regions == ()
    figures = change.to_json()
    assert 0.03 < figures["unchanged"]["share_significant"] < 0.06
    assert figures["unchanged"]["difference_over_sigma_rms"] == pytest.approx(1.0, abs=0.1)
    assert (figures["gained"]["volume_l"], figures["lost"]["volume_l"]) == (0, 0)
    # what was dug away is lost, not gained
    figures = compare_elevations(still, survey(4, STILL, MOUND_M), STILL)[0].to_json()
    assert figures["gained"]["regions"] == 0
    assert figures["lost"]["volume_l"] == pytest.approx(-1e3 * MOUND_M3, rel=0.05)


def test_what_no_survey_sees_within_a_place_counts_as_the_cells_around_it() -> None:
    still, mound = survey(1, STILL, 0.0), survey(2, STILL, MOUND_M)
    row, column = int((4.0 - AT[1]) / CELL), int(AT[0] / CELL)
    away = np.hypot(*np.ogrid[-row : SIDE - row, -column : SIDE - column]) * CELL
    mound.height[away < 0.07] = np.nan  # a tenth of the volume
    (region,) = compare_elevations(mound, still, STILL)[0].regions
    error = region.volume_m3 - MOUND_M3
    assert abs(error) < min(2.0 * region.sigma_m3, 0.05 * MOUND_M3)
    assert region.sigma_m3 < 0.1 * MOUND_M3


def test_a_far_shift_is_found_among_ripples() -> None:
    far = RigidTransform.from_translation([0.8, -0.6, 1.0])
    now, before = survey(5, STILL, 0.0), survey(6, far, 0.0)
    shifts = np.array(rough_shifts(now, before, STILL))
    assert np.linalg.norm(shifts - [0.8, -0.6], axis=1).min() < 0.05
    fit = register_heights(now, before, STILL)
    np.testing.assert_allclose(fit.fixed_from_moving.translation, [0.8, -0.6, 1.0], atol=5e-3)


def test_frames_of_two_datums_agree_on_the_place_of_a_point() -> None:
    one, other = Datum(32.8236, 34.9553), Datum(32.8240, 34.9549, 1.5)
    point = np.array([[12.0, -7.0, -15.0]])
    lat_lon = other.geodetic_from_ned(np.column_stack([point[:, 1], point[:, 0], -point[:, 2]]))
    ned = one.ned_from_geodetic(lat_lon)
    moved = enu_from_enu(one, other).apply(point)
    # Latitudes and longitudes come back to 0.01 mm, a fiftieth of a pixel on the sea floor.
    np.testing.assert_allclose(moved, ned[:, [1, 0, 2]] * [1, 1, -1], rtol=0, atol=5e-5)


def write_survey(folder: Path, elevation: Elevation, datum: Datum | None) -> Path:
    """The files of a workspace that a comparison reads."""
    for name in ("dense", "sparse"):
        (folder / name).mkdir(parents=True)
        write_json(folder / name / "stage.json", {"digest": "-"})
    frame = WorldFrame(
        name="ned" if datum else "model", datum=datum, scaled=datum is not None,
        vertical_datum="test",
    )  # fmt: skip
    write_frame(folder / "sparse" / "frame.json", frame)
    for name, values in (("dem", elevation.height), ("sigma", elevation.sigma)):
        path = folder / "dense" / f"{name}.tif"
        write_raster(path, values.astype(np.float32)[None], CELL, (0, 4), nodata=np.nan)
    return folder


def test_the_command_writes_maps_of_the_figures(tmp_path: Path) -> None:
    datum = Datum(32.8236, 34.9553)
    now = write_survey(tmp_path / "now", survey(10, STILL, MOUND_M), datum)
    before = write_survey(tmp_path / "before", survey(11, AWAY, 0.0), datum)
    text, figures = evaluate_against(now, before)
    assert "-0.00" not in text and "lost" not in text
    assert figures["gained"]["volume_l"] == pytest.approx(1e3 * MOUND_M3, rel=0.05)
    np.testing.assert_allclose(
        figures["registration"]["turn_deg"], np.rad2deg(AWAY.rotation.as_rotvec()), atol=0.02
    )
    folder = now / "against" / "before"
    with rasterio.open(folder / "difference.tif") as source:
        row, column = source.index(*AT)
        near = source.read(1)[row - 2 : row + 3, column - 2 : column + 3]
        assert near.mean() == pytest.approx(MOUND_M, rel=0.1)
    with rasterio.open(folder / "significance.tif") as source:
        assert source.read(1)[row, column] > 8
    assert cv2.imread(str(folder / "change.png")).shape[1] > 1000
    bare = write_survey(tmp_path / "bare", survey(12, STILL, 0.0), None)
    with pytest.raises(WorkspaceError):
        evaluate_against(now, bare)


def test_heights_between_cells_are_exact_on_a_plane() -> None:
    rows, columns = np.mgrid[:20, :30]
    plane = Elevation(
        height=0.1 * columns - 0.2 * rows, sigma=np.ones((20, 30)), west=5.0, north=7.0, cell=0.5
    )
    rng = np.random.default_rng(9)
    places = np.column_stack([rng.uniform(5.25, 19.7, 50), rng.uniform(-2.7, 6.75, 50)])
    expected = 0.1 * ((places[:, 0] - 5) / 0.5 - 0.5) - 0.2 * ((7 - places[:, 1]) / 0.5 - 0.5)
    np.testing.assert_allclose(plane.at(plane.height, places), expected, atol=1e-12)
    assert np.isnan(plane.at(plane.height, np.array([[4.9, 5.0], [6.0, 7.4]]))).all()
