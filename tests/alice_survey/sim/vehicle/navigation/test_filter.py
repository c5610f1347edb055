"""The filter against its dense twin and against closed forms."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import rotations
from alice_survey.sim.vehicle.navigation import filter as nf
from alice_survey.sim.vehicle.navigation import sensors as part
from alice_survey.sim.vehicle.navigation import tick
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from tests import oracles_navigation as oracle
from tests.alice_survey.sim.vehicle.navigation.navigation_runs import TICK_S, fly, straight, track

TINY = 1e-9
PERFECT_IMU = part.ImuSpec(
    gyro_bias_sigma_radps=TINY, gyro_bias_walk_radps_per_sqrt_s=0.0,
    accelerometer_bias_sigma_mps2=TINY, accelerometer_bias_walk_mps2_per_sqrt_s=0.0,
    tilt_sigma_rad=TINY,
)  # fmt: skip
PERFECT_COMPASS = part.CompassSpec(noise_rad=1e-6, bias_sigma_rad=TINY)
PERFECT_DVL = part.DvlSpec(
    scale_sigma=TINY, bias_sigma_mps=TINY, misalignment_sigma_rad=TINY, ping_loss=0.0,
    beam_loss=0.0, outlier_probability=0.0, beam_noise_per_speed=0.0,
)  # fmt: skip
PERFECT_GPS = part.GpsSpec(noise_m=1e-6, bias_sigma_m=TINY)

FLOOR = level_floor(15.0)


def column(name: str) -> int:
    return tick.LOG_COLUMNS.index(name)


def shaken(sensors: part.Sensors, truth: Array) -> nf.NavigationState:
    """A filter that has seen a few seconds, with biases believed and a full covariance."""
    run = fly(sensors, truth[:101], FLOOR, 7)
    nav, rng = run.nav, default_rng(11)
    nav.nominal[nf.QUATERNION + 4 :] += 1e-3 * rng.standard_normal(16)
    nav.nominal[nf.DVL_SCALE + 1] = 0.0
    rotations.matrix_of(nav.nominal[nf.QUATERNION : nf.QUATERNION + 4], nav.turns[nf.BELIEVED])
    mixed = rng.standard_normal((25, 40))
    sigma = np.sqrt(np.diag(nav.covariance))
    nav.covariance[:] = sigma[:, None] * (mixed @ mixed.T / 40.0) * sigma
    return nav


def navigate(
    k: int,
    truth: Array,
    water: Array,
    sensors: part.Sensors,
    nav: nf.NavigationState,
    rng: np.random.Generator,
) -> Array:
    """The estimate, (14,), of one tick."""
    estimate = np.zeros(14)
    before = truth[max(k - 1, 0)]
    tick.navigation_tick(
        k * TICK_S, k, TICK_S, before, truth[k], water, FLOOR, sensors, nav, rng, estimate
    )
    return estimate


ALL_AT_ONCE = part.SensorSuite(
    usbl=part.UsblSpec(rate_hz=1.0, outlier_probability=0.0),
    dvl=part.DvlSpec(outlier_probability=0.0, ping_loss=0.0, beam_loss=0.0, water_every=1),
    gate_sigmas=1e3,
)


@pytest.mark.slow
def test_a_run_equals_the_dense_twin() -> None:
    # Just under the surface, over deep water, every instrument has a say.
    sensors = ALL_AT_ONCE.pack()
    truth = track(8.0, speed_mps=0.4, line_m=1.0, turn_s=4.0, depth_m=0.28)
    truth[:, 2], truth[:, 9] = 0.28, 0.0
    rng = default_rng(5)
    nav = nf.new_navigation(sensors, truth[0], rng)
    water = np.array([0.1, -0.05, 0.0])
    belief, covariance = oracle.from_nominal(nav.nominal), nav.covariance.copy()
    for k in range(len(truth)):
        navigate(k, truth, water, sensors, nav, rng)
        readings = nav.readings
        if k > 0:
            belief, covariance, _ = oracle.predict(
                belief, covariance, readings[nf.TURN : nf.TURN + 3],
                readings[nf.PUSH : nf.PUSH + 3], sensors, TICK_S,
            )  # fmt: skip
        belief, covariance = twin_update(k, belief, covariance, readings, sensors)
        sigma = np.sqrt(np.diag(covariance))
        error = belief.error_of(oracle.from_nominal(nav.nominal))
        # The kernel's Jacobians of a turn keep the first order: at 0.8 rad/s, 0.04 rad a tick,
        # what they leave out is 3e-4 of them.
        np.testing.assert_allclose(error / sigma, 0.0, atol=1e-3)
        scaled = (nav.covariance - covariance) / np.outer(sigma, sigma)
        np.testing.assert_allclose(scaled, 0.0, atol=1e-3)
    assert nav.counts[:, nf.USED].tolist() == [81, 81, 164, 164, 9, 9]
    np.testing.assert_array_equal(nav.covariance, nav.covariance.T)


def twin_update(
    k: int, belief: oracle.Belief, covariance: Array, readings: Array, sensors: part.Sensors
) -> tuple[oracle.Belief, Array]:
    """All that is due in a tick, at once."""
    dvl, usbl = sensors.dvl, sensors.usbl
    due: list[tuple[Callable[[oracle.Belief], Array], Array, Array | float]] = []

    def heading_of(state: oracle.Belief) -> Array:
        before = oracle.heading(belief)
        return np.array([before + rotations.wrap_angle(oracle.heading(state) - before)])

    if k % 2 == 0:
        off = rotations.wrap_angle(readings[nf.HEADING] - oracle.heading(belief))
        due += [
            (heading_of, oracle.heading(belief) + np.array([off]), sensors.compass.noise_rad**2),
            (
                lambda b: np.array([oracle.depth(b, sensors)]),
                readings[nf.DEPTH : nf.DEPTH + 1],
                sensors.pressure.noise_m**2,
            ),
        ]
    if k % 20 == 0:
        fix, answer = readings[nf.GPS_FIX : nf.GPS_FIX + 2], readings[nf.USBL_FIX : nf.USBL_FIX + 2]
        away = oracle.place(belief, sensors, part.USBL) - np.array(usbl.boat_ned_m)
        spread = usbl.noise_m**2 + usbl.noise_fraction**2 * away @ away
        due += [
            (lambda b: oracle.gps(b, sensors), fix, sensors.gps.noise_m**2),
            (lambda b: oracle.usbl(b, sensors), answer, spread),
        ]
    if k % 4 == 0:
        rates = readings[nf.RATES : nf.RATES + 3].copy()
        along = oracle.beams(belief, sensors, rates, False)
        bias = np.array([*belief.rest[10:12], 0.0])
        speed = np.linalg.norm(np.linalg.lstsq(sensors.beams, along, rcond=None)[0] - bias)
        bottom = dvl.beam_noise_mps + dvl.beam_noise_per_speed * speed
        for first, w, sigma in (
            (nf.BEAM, False, bottom),
            (nf.WATER_BEAM, True, dvl.water_noise_mps),
        ):
            lever = oracle.jacobian(lambda e, w=w: oracle.beams(belief, sensors, rates + e, w), 3)
            turning = sensors.imu.gyro_noise_rad_per_sqrt_s**2 / TICK_S * np.sum(lever**2, axis=1)
            heard = partial(oracle.beams, sensors=sensors, rates=rates, water=w)
            due.append((heard, readings[first : first + 4], sigma**2 + turning))
    if not due:
        return belief, covariance
    asked, measured, variance = zip(*due, strict=True)
    return oracle.update(
        belief,
        covariance,
        np.concatenate(measured),
        lambda b: np.concatenate([reading(b) for reading in asked]),
        np.concatenate([np.full(len(m), v) for m, v in zip(measured, variance, strict=True)]),
    )


def test_the_transition_equals_finite_differences() -> None:
    sensors, truth = ALL_AT_ONCE.pack(), track(10.0, line_m=1.0, speed_mps=0.3)
    nav = shaken(sensors, truth)
    rotations.matrix_of(truth[102, 3:7], nav.turns[nf.TRUTH_NOW])
    tick.measure_imu(TICK_S, truth[101], truth[102], sensors, nav, default_rng(0))
    belief, covariance = oracle.from_nominal(nav.nominal), nav.covariance.copy()
    turn, push = nav.readings[nf.TURN : nf.TURN + 3], nav.readings[nf.PUSH : nf.PUSH + 3]
    after, expected, _ = oracle.predict(belief, covariance, turn, push, sensors, TICK_S)
    nf.predict(TICK_S, sensors, nav)
    assert np.abs(after.error_of(oracle.from_nominal(nav.nominal))).max() < 1e-12
    sigma = np.sqrt(np.diag(expected))
    scaled = (nav.covariance - expected) / np.outer(sigma, sigma)
    np.testing.assert_allclose(scaled, 0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["heading", "depth", "gps", "beams", "water"])
def test_rows_equal_finite_differences(name: str) -> None:
    sensors, truth = ALL_AT_ONCE.pack(), track(10.0, line_m=1.0, speed_mps=0.3)
    nav = shaken(sensors, truth)
    nav.readings[nf.BEAM : nf.BEAM + 4] = nav.readings[nf.WATER_BEAM : nf.WATER_BEAM + 4] = 0.1
    nav.nominal[24:26] = [0.2, -0.3]
    belief, rates = oracle.from_nominal(nav.nominal), nav.readings[nf.RATES : nf.RATES + 3].copy()
    # The last row that was weighed stays in scratch: of the beams the fourth.
    cases: dict[str, tuple[Callable[[oracle.Belief], float], Callable[[], object]]] = {
        "heading": (oracle.heading, lambda: nf.use_heading(nav, sensors)),
        "depth": (lambda b: oracle.depth(b, sensors), lambda: nf.use_depth(nav, sensors)),
        "gps": (
            lambda b: float(oracle.place(b, sensors, part.GPS)[1]),
            lambda: nf.lever_row(nav, sensors, part.GPS, 1),
        ),
        "beams": (
            lambda b: float(oracle.beams(b, sensors, rates, name == "water")[3]),
            lambda: nf.use_beams(nav, sensors, name == "water"),
        ),
    }
    reading, weigh = cases["beams" if name == "water" else name]
    weigh()
    expected = oracle.jacobian(lambda e: np.array([reading(belief.moved(e))]), 25)[0]
    np.testing.assert_allclose(nav.scratch[nf.ROW], expected, atol=1e-8)


def test_a_usbl_bounds_the_drift() -> None:
    truth = straight(600.0)
    compass = part.CompassSpec(bias_sigma_rad=np.deg2rad(2.0))
    gps = part.GpsSpec(bias_sigma_m=0.05, noise_m=0.05)
    boat = part.UsblSpec(rate_hz=0.2, boat_ned_m=(150.0, 20.0, 1.0), outlier_probability=0.1)
    drift, held, sigma = [], [], []
    for seed in range(8):
        drift.append(
            fly(part.SensorSuite(compass=compass, gps=gps).pack(), truth, FLOOR, seed)
            .horizontal_error()[-1]
        )  # fmt: skip
        run = fly(part.SensorSuite(compass=compass, gps=gps, usbl=boat).pack(), truth, FLOOR, seed)
        held.append(run.horizontal_error()[-1])
        sigma.append(np.hypot(*run.log[-1, 13:15]))
        assert run.nav.counts[nf.USBL_USE, nf.REJECTED] > 0
    rms = [np.sqrt(np.mean(np.square(values))) for values in (drift, held)]
    assert rms[0] > 4.0
    assert rms[1] < 1.0
    assert 0.4 < rms[1] / np.mean(sigma) < 1.7


def test_outliers_are_refused_and_leave_no_trace() -> None:
    truth = track(120.0)
    clean = part.DvlSpec(outlier_probability=0.0)
    dirty = clean._replace(outlier_probability=0.1)
    ends = []
    for dvl in (clean, dirty):
        run = fly(part.SensorSuite(dvl=dvl).pack(), truth, FLOOR, 3)
        attitude = Rotation.from_quat(truth[:, 3:7])
        speed = run.estimate[:, 6:9] - attitude.inv().apply(truth[:, 7:10])
        ends.append(np.abs(speed[200:]).max())
        counts = run.nav.counts[nf.DVL_USE]
        share = counts[nf.REJECTED] / counts[nf.USED]
        assert (share > 0.05) if dvl is dirty else (share < 1e-3)
    assert ends[1] < 2.0 * ends[0] < 0.05


def test_a_filter_that_is_sure_and_wrong_comes_back() -> None:
    usbl = part.UsblSpec(rate_hz=1.0, outlier_probability=0.0)
    sensors, truth = part.SensorSuite(usbl=usbl).pack(), straight(60.0, 0.2)
    nav = nf.new_navigation(sensors, truth[0], default_rng(2))
    nav.nominal[:2] += 40.0
    run = fly(sensors, truth, FLOOR, 2, start=nav)
    assert run.horizontal_error()[20] > 30.0
    assert run.nav.counts[nf.USBL_USE, nf.WIDENED] == 1
    assert run.nav.counts[nf.USBL_USE, nf.REJECTED] == 6
    assert run.horizontal_error()[-1] < 3.0 * np.hypot(*run.log[-1, 13:15])


def test_nothing_that_is_no_number_enters() -> None:
    nothing = FloorGrid(0.0, 0.0, 1.0, np.full((2, 2), np.nan))
    run = fly(part.SensorSuite().pack(), track(60.0), nothing, 0)
    assert np.all(np.isnan(run.estimate[:, 12]))
    assert np.all(np.isfinite(run.estimate[:, :12]))
    assert np.all(np.isfinite(run.covariance))
    assert run.nav.counts[nf.DVL_USE, nf.USED] == 0
    sensors = part.SensorSuite().pack()
    nav = shaken(sensors, track(10.0))
    before, nominal = nav.covariance.copy(), nav.nominal.copy()
    nav.readings[nf.DEPTH] = nav.readings[nf.HEADING] = np.nan
    nav.readings[nf.BEAM : nf.BEAM + 4] = np.inf
    assert not nf.use_depth(nav, sensors)
    assert not nf.use_heading(nav, sensors)
    assert nf.use_beams(nav, sensors, False) == 0
    nf.correct(nav)
    np.testing.assert_array_equal(nav.covariance, before)
    np.testing.assert_allclose(nav.nominal, nominal, rtol=1e-15)


def test_noise_of_the_dvl_walks_with_the_root_of_time() -> None:
    # Whatever the IMU does, a filter that follows white noise of velocity gathers all of it:
    # sigma^2 = (noise of a ping)^2 (time between pings) (time).
    suite = part.SensorSuite(
        imu=PERFECT_IMU, compass=PERFECT_COMPASS, dvl=PERFECT_DVL, gps=PERFECT_GPS,
        pressure=part.PressureSpec(bias_sigma_m=TINY),
    )  # fmt: skip
    sensors = suite.pack()
    of_a_ping = PERFECT_DVL.beam_noise_mps / np.sqrt(np.sum(sensors.beams[:, 0] ** 2))
    ends, truth = [], straight(300.0, 0.2)
    for seed in range(60):
        run = fly(sensors, truth, FLOOR, seed)
        ends.append(run.log[[1500, 6000], :2] - truth[[1500, 6000], :2])
    for i, time_s in enumerate((75.0, 300.0)):
        walk = of_a_ping * np.sqrt(0.2 * time_s)
        rms = np.sqrt(np.mean(np.array(ends)[:, i] ** 2))
        # 120 draws: 6.5 % each way, and three of those.
        assert rms == pytest.approx(walk, rel=0.2)
        assert run.log[[1500, 6000][i], column("sigma_north_m")] == pytest.approx(walk, rel=0.03)


def test_a_heading_bias_leads_astray_by_distance_times_bias() -> None:
    suite = part.SensorSuite(
        imu=PERFECT_IMU, dvl=PERFECT_DVL, gps=PERFECT_GPS,
        compass=part.CompassSpec(bias_sigma_rad=np.deg2rad(1.0), bias_correlation_s=1e9),
    )  # fmt: skip
    sensors, truth = suite.pack(), straight(300.0)
    run = fly(sensors, truth, FLOOR, 4)
    bias = run.hidden[-1, nf.HEADING_BIAS - 9]
    distance_m = truth[-1, 0]
    assert abs(bias) > np.deg2rad(0.3)
    # Walked noise of the DVL, 0.04 m, and the compass's, which averages out.
    assert run.log[-1, 1] == pytest.approx(distance_m * bias, abs=0.25)
    sigma = run.log[-1, column("sigma_east_m")]
    assert sigma == pytest.approx(distance_m * np.deg2rad(1.0), rel=0.03)


def test_without_the_dvl_a_level_imu_falls_off_as_integrated_noise() -> None:
    # Angle noise tilts gravity: variance g^2 n^2 t^5 / 20; velocity noise adds m^2 t^3 / 3.
    imu = PERFECT_IMU._replace(gyro_noise_rad_per_sqrt_s=2e-4)
    suite = part.SensorSuite(
        imu=imu, compass=PERFECT_COMPASS, gps=PERFECT_GPS, dvl=PERFECT_DVL._replace(rate_hz=0.0)
    )
    sensors, time_s = suite.pack(), 40.0
    nav = nf.new_navigation(sensors, straight(time_s)[0], default_rng(0))
    nav.covariance[3:6] = nav.covariance[:, 3:6] = 0.0
    nav.covariance[3:6, 3:6] = 1e-12 * np.eye(3)
    run = fly(sensors, straight(time_s), FLOOR, 0, start=nav)
    m = imu.accelerometer_noise_mps_per_sqrt_s
    expected = np.sqrt((9.80665 * 2e-4) ** 2 * time_s**5 / 20 + m**2 * time_s**3 / 3)
    # The compass takes away nothing that leads north or east.
    assert run.log[-1, column("sigma_north_m")] == pytest.approx(expected, rel=0.01)
    assert run.log[-1, column("sigma_east_m")] == pytest.approx(expected, rel=0.01)


def test_a_disturbed_compass_is_rejected_first_and_then_widens_its_bias() -> None:
    sensors, truth = part.SensorSuite().pack(), straight(60.0, 0.2)
    rng = default_rng(2)
    nav = nf.new_navigation(sensors, truth[0], rng)
    heading, sigma = [], []
    for k in range(len(truth)):
        if k == 400:
            nav.hidden[nf.HEADING_BIAS - 9] += np.deg2rad(30.0)
        heading.append(navigate(k, truth, np.zeros(3), sensors, nav, rng)[5])
        sigma.append(np.sqrt(nav.covariance[8, 8]))
    counts = nav.counts[nf.COMPASS_USE]
    assert counts[nf.WIDENED] == 1
    assert counts[nf.REJECTED] == 50
    assert counts[nf.RUN] == 0
    # The gyroscopes hold the heading; the bias takes up the disturbance.
    assert np.ptp(heading[390:]) < np.deg2rad(0.5)
    assert np.rad2deg(nav.nominal[nf.HEADING_BIAS + 1]) == pytest.approx(30.0, abs=3.0)
    assert sigma[-1] >= 0.99 * sigma[399]
