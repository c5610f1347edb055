"""Weak places of surveys whose tracks are drawn on a flat sea floor, and the dive over them."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
import shapely
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.core.records import RegistrationRecord
from camera_calib.rig import design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import Stations, join, stations_of_plan
from missions.fly.refly import dive_means
from missions.plan.strength import survey_costs
from missions.values.plan_file import Plan
from reconstruct.elevation import Elevation
from reconstruct.precision.instruments import NavigationErrors, usual_rig
from reconstruct.precision.predict import Precision
from reconstruct.precision.predict import predict as predict_precision
from reconstruct.precision.run import BETWEEN_DIVES_S, stations_and_times
from reconstruct.precision.tracks import TrackModel, expected_block, waves
from reconstruct.revisit.links import cut_around, footprints, links, pieces
from reconstruct.revisit.run import plan_revisit, predict
from reconstruct.revisit.weak import Found, Pictured, measure_survey, pair_sigma_m, weak_places
from tests.oracles_coverage import area_of, lawnmower, plan_of

CONFIG = SurveyConfig()
RIG = design_rig(CONFIG.camera, CONFIG.water)
GOAL_M = 0.003
RECORD = RegistrationRecord(
    registered=0, total=0, points=0, mean_reprojection_px=0, mean_track_length=0, scale_source=None
)
PLAN = replace(
    plan_of(area_of(shapely.box(0, 0, 8, 6)), lawnmower(8.0, 6.0, 0.7, 0.46)), line_spacing_m=0.7
)
FLOWN = stations_of_plan(PLAN)
NORTH, EAST = FLOWN.glass_ne.T
HOLE = (abs(NORTH - 3.0) < 1.3) & (abs(EAST - 3.0) < 1.3)
BLURRED = (NORTH > 1.0) & (NORTH < 5.0) & (EAST > 5.0)
CORNER = (NORTH > 6.6) & (EAST < 1.0)
AROUND = (NORTH > 5.3) & (EAST < 2.6) & ~CORNER


def tracks(stations: Stations, seed: int = 0, matched: float = 0.5) -> sp.csr_array:
    """Tracks of points of the floor, each of which half of the stations that show it find."""
    rng = np.random.default_rng(seed)
    shapes = footprints(RIG, stations)
    south, west, north, east = shapely.total_bounds(shapes)
    points = rng.uniform([south, west], [north, east], (6000, 2))
    seen = np.array([shapely.contains_xy(shape, *points.T) for shape in shapes])
    return sp.csr_array((seen & (rng.random(seen.shape) < matched)).astype(np.float64))


def surveyed(
    good: NDArray[np.bool_],
    spoilt: NDArray[np.bool_],
    rough: tuple[slice, slice] = np.s_[:0, :0],
    sigmas: Any = math.nan,
) -> Found:
    pictured = Pictured(
        good=FLOWN.some(good),
        numbers=np.flatnonzero(good),
        spoilt=FLOWN.some(spoilt),
        faults=("not in the model (blurred)",) * int(spoilt.sum()),
    )
    found = measure_survey(PLAN, RIG, pictured, tracks(pictured.good), GOAL_M, RECORD)
    sigma = np.full((100, 100), 0.5 * GOAL_M)
    sigma[rough] = 4 * GOAL_M
    surface = Elevation(height=0 * sigma, sigma=sigma, west=-1.0, north=9.0, cell=0.1)
    known = np.broadcast_to(np.asarray(sigmas, np.float64), int(good.sum()))
    return replace(found, places=weak_places(found, surface, np.zeros(2), known))


def dive_over(found: Found) -> Plan:
    return plan_revisit(found, dive_means(CONFIG.plan, CONFIG.vehicle, survey_costs(CONFIG)))


def precision_of(ned_from_body: RigidTransform, time_s: Array) -> Precision:
    """Expected of stations over a rippled floor, with a usual calibration and navigation."""
    ripple = waves(CONFIG.plan.relief_m, 2.0 * PLAN.altitude_m)
    block = expected_block(
        usual_rig(CONFIG.camera, CONFIG.water, CONFIG.imaging), ned_from_body, time_s,
        lambda places: PLAN.seafloor_depth_m + ripple(places), TrackModel.of(CONFIG.reconstruct),
    )  # fmt: skip
    errors = NavigationErrors.of(CONFIG.navigation, CONFIG.reconstruct)
    return predict_precision(block, errors)


def test_one_station_is_cut_off_at_the_price_of_its_tracks() -> None:
    views = sp.csr_array(np.array([[1, 1, 0, 1.0], [1, 0, 1, 1], [1, 1, 0, 0], [0, 0, 0, 1]]))
    linked = links(views)

    assert abs(linked - linked.T).max() == 0
    shared = views[:, views.sum(axis=0) > 1]
    for station in range(4):
        alone = np.arange(4) == station
        assert cut_around(linked, alone) == pytest.approx(shared[[station]].sum())


@pytest.mark.parametrize("seed", range(8))
def test_pieces_are_parted_by_lesser_cuts_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = np.triu(rng.integers(0, 9, (8, 8)) * (rng.random((8, 8)) < 0.45), 1).astype(float)
    linked = sp.csr_array(weights + weights.T)
    minimum = 9.0
    sides = [np.array(side) for side in itertools.product([False, True], repeat=8)]
    cuts = [(side, cut_around(linked, side)) for side in sides if 0 < side.sum() < 8]

    piece = pieces(linked, minimum)

    for i, j in itertools.combinations(range(8), 2):
        smallest = min(cut for side, cut in cuts if side[i] != side[j])
        assert (piece[i] == piece[j]) == (smallest >= minimum)
    sizes = np.bincount(piece)
    assert (np.diff(sizes) <= 0).all()


def test_a_survey_as_planned_has_no_weak_place() -> None:
    found = surveyed(np.ones(len(FLOWN), bool), np.zeros(len(FLOWN), bool))

    assert found.places == ()
    assert found.seen.share_at_overlap >= 0.999


@pytest.mark.slow
def test_a_hole_a_strip_of_blur_and_a_loose_corner_are_cured_by_the_dive() -> None:
    good = ~(HOLE | BLURRED | AROUND)
    found = surveyed(good, BLURRED)
    causes = {name: [p for p in found.places if p.cause == name] for name in ("overlap", "loose")}
    severities = [place.severity_m2 for place in found.places]
    assert severities == sorted(severities, reverse=True)
    hole, strip = (
        next(p for p in causes["overlap"] if p.outline.covers(shapely.Point(at)))
        for at in ((3.0, 3.0), (3.0, 5.9))
    )
    assert "no picture was taken" in hole.reason or "blurred" not in hole.reason.split(";")[0]
    assert "not in the model (blurred)" in strip.reason
    (corner,) = causes["loose"]
    np.testing.assert_array_equal(
        np.flatnonzero(good)[list(corner.stations)], np.flatnonzero(CORNER)
    )

    again = dive_over(found)

    assert 0.1 * PLAN.stations < again.stations < 0.6 * PLAN.stations
    cures, in_model = predict(found, again)
    assert in_model[len(found.pictured.good) :].all()
    assert max(cure.left for cure in cures) <= 0.01
    # What is predicted happens: to coverage, and to tracks that are drawn again.
    both = join(found.pictured.good, stations_of_plan(again))
    after = certificate(PLAN.area, RIG, both, found.pattern)
    assert found.seen.share_at_overlap < 0.85
    assert after.share_at_overlap >= 0.999
    assert pieces(links(tracks(both, seed=1)), found.least_tracks).max() == 0
    # The improved survey is as good as one that lacked nothing.
    (flown, flown_s), (new, new_s) = (
        stations_and_times(plan, RIG, survey_costs(CONFIG)) for plan in (PLAN, again)
    )
    now = np.flatnonzero(good)[found.piece == 0]
    before, improved, whole = (
        precision_of(RigidTransform.concatenate(poses), np.concatenate(times))
        for poses, times in (
            ([flown[now]], [flown_s[now]]),
            ([flown[good], new], [flown_s[good], flown_s[-1] + BETWEEN_DIVES_S + new_s]),
            ([flown], [flown_s]),
        )
    )
    np.testing.assert_array_less(1.4 * improved.bend_m, before.bend_m)
    ratios = [*improved.bend_m / whole.bend_m, improved.heights_rms_m / whole.heights_rms_m]
    assert 0.9 < min(ratios) <= max(ratios) < 1.3


def test_a_rough_patch_of_the_surface_is_flown_again() -> None:
    everything = np.ones(len(FLOWN), bool)
    found = surveyed(everything, ~everything, rough=np.s_[40:50, 30:45])

    (place,) = found.places

    assert place.cause == "surface"
    assert place.area_m2 == pytest.approx(1.5, rel=0.15)
    assert place.severity_m2 == pytest.approx(0.75 * place.area_m2, rel=0.1)
    assert shapely.box(3.9, 1.9, 5.1, 3.6).covers(place.outline)
    again = dive_over(found)
    assert again.stations < 0.25 * PLAN.stations
    assert predict(found, again)[0][0].left <= 0.01


def test_a_strip_whose_place_is_less_sure_than_the_rest_gets_a_line() -> None:
    everything = np.ones(len(FLOWN), bool)
    strip = FLOWN.line == 0
    sigmas = np.where(strip, 3.0, 0.5) * GOAL_M

    found = surveyed(everything, ~everything, sigmas=sigmas)

    (place,) = found.places
    assert place.cause == "loose"
    np.testing.assert_array_equal(place.stations, np.flatnonzero(strip))
    assert 0 < place.severity_m2 < place.area_m2
    ((cure,), _) = predict(found, dive_over(found))
    assert 0.2 < cure.left < 0.95
    assert surveyed(everything, ~everything, sigmas=0.9 * sigmas[strip][0]).places == ()


def test_the_goal_for_heights_is_a_pixel_of_one_pair() -> None:
    depth_m, camera = 2.0, CONFIG.camera
    focal_px = 1e3 * camera.focal_mm / camera.pixel_um * CONFIG.water.n_water
    by_hand_m = depth_m**2 / (focal_px * camera.baseline_m)
    assert pair_sigma_m(PLAN, RIG) == pytest.approx(by_hand_m, rel=0.1)
