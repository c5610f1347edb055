"""Known points and lengths place, scale and score a model whose truth is known."""

import csv
import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import write_json
from alice_survey.core.config import CameraConfig, SurveyConfig, WaterConfig
from alice_survey.core.errors import keep_warnings
from alice_survey.core.frames import Array
from alice_survey.core.manifest import write_manifest
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.camera import Camera
from camera_calib.rig import design_rig
from reconstruct.placing.alignment import Similarity, level
from reconstruct.placing.control import (
    ControlFit,
    real_sigma_factor,
    tie_control,
    widen,
    without_wrong_points,
)
from reconstruct.placing.control_command import survey_control
from reconstruct.placing.control_points import (
    Control,
    KnownPoint,
    Pick,
    RegisteredPicture,
    read_control,
    read_picks,
    triangulate_picks,
)
from reconstruct.placing.fit import PlacementFit, fit_control, fit_navigation
from reconstruct.placing.navigation import body_from_pinhole
from reconstruct.placing.place import picks_of_model
from reconstruct.stages import PLACING
from tests.oracles_place import is_unit
from tests.reconstruct.scenes import ALTITUDE_M, DATUM, Scene, make_scene

KNOWN = np.array(
    [[0.9, 0.4, 15.05], [2.6, 0.5, 14.9], [2.5, 1.6, 15.1], [0.8, 1.5, 14.95], [1.7, 1.0, 14.8]]
)
"""Five points of the sea floor in NED."""


@cache
def site() -> Scene:
    return make_scene(points=300, port_distance_m=0.1)


@cache
def warps() -> dict[str, PinholeWarp]:
    return {
        name: best_warp(camera, 0.8 * ALTITUDE_M, 1.2 * ALTITUDE_M)
        for name, camera in site().rig.cameras.items()
    }


@dataclass(frozen=True, kw_only=True)
class Gauge:
    """A model in a gauge of its own."""

    ned_from_model: Similarity
    cameras: dict[str, RegisteredPicture]

    def points(self, ned: np.ndarray) -> np.ndarray:
        place = self.ned_from_model
        return place.rotation.inv().apply(ned - place.translation) / place.scale


def registered(scene: Scene, ned_from_model: RigidTransform) -> dict[str, RegisteredPicture]:
    """The pictures of a scene in a model that lies somewhere."""
    cameras = {}
    for record, pose in zip(scene.records, scene.ned_from_cam, strict=True):
        warp = warps()[record.camera]
        pinhole = ned_from_model.inv() * pose * warp.pinhole_from_cam.inv()
        cameras[record.image] = RegisteredPicture(warp=warp, model_from_pinhole=pinhole)
    return cameras


def in_gauge(seed: int) -> Gauge:
    """True poses in a random gauge of metres."""
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng), rng.normal(0, 30, 3)
    cameras = registered(site(), RigidTransform.from_components(shift, turn))
    return Gauge(
        ned_from_model=Similarity(scale=1.0, rotation=turn, translation=shift), cameras=cameras
    )


def picks_of(points: np.ndarray, noise_px: float = 0.0, seed: int = 0) -> list[Pick]:
    """Every picture's exact view of points, through its port."""
    rng = np.random.default_rng(seed)
    picks = []
    for record, pose in zip(site().records, site().ned_from_cam, strict=True):
        camera = site().rig.cameras[record.camera]
        seen = camera.project(pose.inv().apply(points))
        for number, (x, y) in enumerate(seen + rng.normal(0, noise_px, seen.shape)):
            if 0 < x < camera.width_px and 0 < y < camera.height_px:
                pick = Pick(image=record.image, point=f"p{number}", x_px=x, y_px=y, sigma_px=0.3)
                picks.append(pick)
    return picks


def write(path: Path, rows: list[dict[str, object]]) -> Path:
    names = sorted({name for row in rows for name in row})
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path


def control_rows(uses: str, sigma_m: float = 0.002) -> list[dict[str, object]]:
    """One row for every known point, each in another of the ways to say where it is."""
    from pyproj import Transformer

    utm = Transformer.from_crs(4326, 32636, always_xy=True)
    rows: list[dict[str, object]] = []
    for number, (use, ned) in enumerate(zip(uses, KNOWN, strict=True)):
        latitude, longitude, depth = DATUM.geodetic_from_ned(ned[None])[0]
        row: dict[str, object] = {
            "kind": "point",
            "name": f"p{number}",
            "use": {"+": "control", "?": "check"}[use],
            "sigma_m": sigma_m,
        }
        if number % 3 == 0:
            row |= {"latitude_deg": float(latitude), "longitude_deg": float(longitude)}
            row |= {"height_m": float(DATUM.height_m - depth)}
        elif number % 3 == 1:
            row |= {"north_m": ned[0], "east_m": ned[1], "depth_m": ned[2]}
        else:
            easting, northing = utm.transform(longitude, latitude)
            row |= {"easting_m": easting, "northing_m": northing, "epsg": 32636, "depth_m": depth}
        rows.append(row)
    return rows


def tied(path: Path, gauge: Gauge, picks: list[Pick]) -> ControlFit:
    spots, lost = triangulate_picks(picks, gauge.cameras)
    return tie_control(read_control(path), spots, lost, DATUM)


def test_points_are_found_exactly_through_the_ports() -> None:
    gauge = in_gauge(1)
    spots, lost = triangulate_picks(picks_of(KNOWN), gauge.cameras)
    assert not lost
    found = np.stack([spots[f"p{k}"].model for k in range(len(KNOWN))])
    np.testing.assert_allclose(found, gauge.points(KNOWN), atol=1e-8)
    assert min(spot.views for spot in spots.values()) >= 3
    assert max(spot.rms_px for spot in spots.values()) < 1e-5


def test_the_sigma_of_a_found_point_is_that_of_its_error() -> None:
    gauge, ratios = in_gauge(2), []
    for seed in range(8):
        spots, _ = triangulate_picks(picks_of(KNOWN, 0.3, seed), gauge.cameras)
        for k, true in enumerate(gauge.points(KNOWN)):
            spot = spots[f"p{k}"]
            white = np.linalg.solve(np.linalg.cholesky(spot.covariance), spot.model - true)
            ratios.append(white)
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.15


def test_a_wrong_pick_is_left_out_and_named() -> None:
    gauge, picks = in_gauge(3), picks_of(KNOWN, 0.2)
    at = next(i for i, p in enumerate(picks) if p.point == "p4")
    picks[at] = Pick(image=picks[at].image, point="p4", x_px=400, y_px=300, sigma_px=0.3)
    spots, _ = triangulate_picks(picks, gauge.cameras)
    assert spots["p4"].left_out == (picks[at].image,)
    assert np.linalg.norm(spots["p4"].model - gauge.points(KNOWN)[4]) < 0.003


def test_points_that_cannot_be_found_are_named() -> None:
    gauge, picks = in_gauge(4), picks_of(KNOWN)
    once = next(p for p in picks if p.point == "p0")
    spots, lost = triangulate_picks([once], gauge.cameras)
    assert not spots
    assert lost.keys() == {"p0"}
    two = [p for p in picks if p.point == "p1"][:2]
    two[1] = Pick(image=two[1].image, point="p1", x_px=20, y_px=20, sigma_px=0.3)
    spots, lost = triangulate_picks(two, gauge.cameras)
    assert not spots
    assert lost.keys() == {"p1"}
    assert " px" in lost["p1"]


@pytest.mark.parametrize("stretch", [1.0, 3.7])
def test_control_points_alone_place_a_model(tmp_path: Path, stretch: float) -> None:
    """Of known scale, or in a unit of which 3.7 make a metre: four points show it."""
    gauge = in_gauge(5)
    spots, _ = triangulate_picks(picks_of(KNOWN), gauge.cameras)
    spots = {
        name: replace(spot, model=spot.model * stretch, covariance=spot.covariance * stretch**2)
        for name, spot in spots.items()
    }
    poses = [
        RigidTransform.from_components(
            c.model_from_pinhole.translation * stretch, c.model_from_pinhole.rotation
        )
        for c in gauge.cameras.values()
    ]
    with keep_warnings() as said:
        control = read_control(write(tmp_path / "control.csv", control_rows("+++?+")))
    assert not said
    ties = tie_control(control, spots, {}, DATUM)
    known = 1.0 if stretch == 1.0 else None
    start = ties.start(known)
    assert start is not None
    fit = fit_control(
        site().records, poses, start, ties.equations, known_scale=known, scale_sigma=0.0
    )
    placed = fit.ned_from_model
    np.testing.assert_allclose(placed.apply(gauge.points(KNOWN) * stretch), KNOWN, atol=2e-6)
    assert placed.scale == pytest.approx(1.0 / stretch, rel=1e-6)
    assert np.all((fit.sigma_position_m > 5e-4) & (fit.sigma_position_m < 0.006))
    assert fit.record.to_json()["rms_north_m"] is None  # no navigation took part
    json.dumps(fit.record.to_json(), allow_nan=False)
    score = ties.score(placed, located=True).to_json()
    assert (score["rms"]["check"]["points"], score["rms"]["control"]["points"]) == (1, 4)
    assert score["rms"]["check"]["north_m"] < 1e-5


def test_control_and_navigation_place_together_within_their_sigmas(tmp_path: Path) -> None:
    """Navigation is 0.3 m off; control of 2 mm pulls the model to the truth, as checks show."""
    scene = make_scene(points=300, bias_m=(0.3, -0.2, 0.02))
    gauge = in_gauge(6)
    path = write(tmp_path / "control.csv", control_rows("+++?+"))
    ties = tied(path, gauge, picks_of(KNOWN, 0.2))
    poses = [c.model_from_pinhole for c in gauge.cameras.values()]
    centres = np.stack([p.translation for p in poses])
    levers = body_from_pinhole(site().rig, warps())
    levelled = level(gauge.points(site().points_ned), centres)
    alone, both = (
        fit_navigation(
            scene.records, poses, levers, DATUM, levelled,
            known_scale=1.0, scale_sigma=1e-3 if control else 0.0, control=control,
        )
        for control in (None, ties.equations)
    )  # fmt: skip
    assert alone is not None
    assert both is not None
    before = ties.score(alone.ned_from_model, located=True).to_json()["rms"]["check"]
    after = ties.score(both.ned_from_model, located=True).to_json()["rms"]["check"]
    assert 0.2 < before["north_m"] < 0.4
    assert max(after["north_m"], after["east_m"], after["down_m"]) < 0.004
    assert np.all(both.sigma_position_m < 0.1 * alone.sigma_position_m.max())
    assert 1e-5 < both.sigma_scale < 1e-3


def test_bars_scale_a_model_and_check_bars_score_it(tmp_path: Path) -> None:
    gauge = in_gauge(7)
    length = np.linalg.norm(KNOWN[1] - KNOWN[0])
    rows = [
        {"kind": "bar", "name": "a", "use": "control", "from": "p0", "to": "p1",
         "length_m": 1.02 * length, "sigma_m": 0.001},
        {"kind": "bar", "name": "b", "use": "check", "from": "p2", "to": "p3",
         "length_m": np.linalg.norm(KNOWN[3] - KNOWN[2]), "sigma_m": 0.001},
        {"kind": "bar", "name": "c", "use": "check", "from": "p2", "to": "q", "length_m": 1,
         "sigma_m": 0.001},
    ]  # fmt: skip
    ties = tied(write(tmp_path / "c.csv", rows), gauge, picks_of(KNOWN))
    found = ties.bar_scale(None, 0.0)
    assert found is not None
    assert found[0] == pytest.approx(1.02, rel=1e-6)
    assert 0.001 / (1.02 * length) < found[1] < 0.003  # the bar's own, and that of the picks
    held = ties.bar_scale(1.0, 1e-6)
    assert held is not None
    assert held[0] == pytest.approx(1.0, abs=1e-4)
    place = Similarity(scale=1.02, rotation=Rotation.identity(), translation=np.zeros(3))
    score = ties.score(place, located=False).to_json()
    assert score["rms"]["check"]["length_relative"] == pytest.approx(0.02, rel=1e-4)
    assert score["rms"]["control"]["length_m"] < 1e-6
    assert score["points"] == []
    assert "q" in score["not_found"]["c"]


def test_control_points_straighten_a_bent_model(tmp_path: Path) -> None:
    """A mode of 5 mm bends it by 20 mm; points held out agree once others have found that."""
    gauge = in_gauge(4)
    spots, lost = triangulate_picks(picks_of(KNOWN, 0.3, 1), gauge.cameras)
    control = read_control(write(tmp_path / "control.csv", control_rows("+++?+")))
    turn = gauge.ned_from_model.rotation.inv()

    def motion_at(places: np.ndarray) -> np.ndarray:
        ned = gauge.ned_from_model.apply(places)
        down = 5e-3 * ((ned[:, 0] - 1.7) ** 2 + (ned[:, 1] - 1.0) ** 2)
        return turn.apply(np.outer(down, [0.0, 0.0, 1.0]))[:, :, None]

    bent = {
        name: replace(spot, model=spot.model + 4.0 * motion_at(spot.model[None])[0, :, 0])
        for name, spot in spots.items()
    }
    ties = replace(tie_control(control, bent, lost, DATUM), motion_at=motion_at)
    start = ties.start(1.0)
    assert start is not None
    poses = [camera.model_from_pinhole for camera in gauge.cameras.values()]
    held = np.zeros((len(poses), 6, 0))
    off = []
    for modes in (held, np.zeros((len(poses), 6, 1))):
        stiff = replace(ties, motion_at=None) if modes.shape[2] == 0 else ties
        fit = fit_control(
            site().records, poses, start, stiff.equations, known_scale=1.0, scale_sigma=0.0,
            modes=modes,
        )  # fmt: skip
        score = stiff.deform(fit.modes).score(fit.ned_from_model, located=True).to_json()
        off.append(abs(next(p for p in score["points"] if p["use"] == "check")["down_m"]))
    assert fit.modes[0] == pytest.approx(-4.0, abs=1.5)  # the prior of unit size pulls
    assert off[1] < 0.4 * off[0] and off[0] > 0.004, off


_MORE = [[1.2, 0.55, 14.92], [2.3, 0.7, 15.02], [2.0, 1.5, 14.97], [1.0, 1.2, 15.08]]
POINTS = np.vstack([KNOWN, _MORE])
"""Nine points of the sea floor in NED."""
STATED_M, REAL_M = 0.002, 0.1
WRONG_M = (1.5, -1.0, 0.5)


def known_at(places: np.ndarray, sigma_m: float = STATED_M) -> Control:
    points = (
        KnownPoint(
            name=f"p{k}", north_m=north, east_m=east, depth_m=down, sigma_m=sigma_m,
            sigma_vertical_m=sigma_m,
        )
        for k, (north, east, down) in enumerate(places.tolist())
    )  # fmt: skip
    return Control(points=tuple(points))


def tied_to(gauge: Gauge, places: np.ndarray, noise_px: float = 0.3) -> ControlFit:
    spots, lost = triangulate_picks(picks_of(POINTS[: len(places)], noise_px), gauge.cameras)
    return tie_control(known_at(places), spots, lost, DATUM)


def placed_by(gauge: Gauge, ties: ControlFit, known_scale: float | None) -> PlacementFit:
    start = ties.start(known_scale)
    assert start is not None
    poses: list[RigidTransform] = [c.model_from_pinhole for c in gauge.cameras.values()]
    return fit_control(
        site().records, poses, start, ties.equations, known_scale=known_scale, scale_sigma=0.0
    )


@pytest.mark.slow
@pytest.mark.parametrize("known_scale", [None, 1.0])
def test_a_wrong_point_is_left_out_and_the_rest_has_its_real_sigma(
    known_scale: float | None,
) -> None:
    misses, factors = [], []
    for seed in range(10):
        rng, gauge = np.random.default_rng(seed), in_gauge(seed)
        places = POINTS + rng.normal(0, REAL_M, POINTS.shape)
        wrong = int(rng.integers(len(places)))
        places[wrong] += WRONG_M
        with keep_warnings() as said:
            ties = without_wrong_points(tied_to(gauge, places), known_scale)
        assert [t.name for t in ties.ties if t.use == "left out"] == [f"p{wrong}"]
        assert len(said) == 1 and f"p{wrong} is " in said[0]
        fit = placed_by(gauge, ties, known_scale)
        parameters = 6 if known_scale else 7
        factor = real_sigma_factor(ties, fit.ned_from_model, parameters)
        ties = widen(ties, factor)
        fit = placed_by(gauge, ties, known_scale)
        middle = fit.ned_from_model.apply(gauge.points(fit.middle_ned[None]))[0]
        misses.append((middle - fit.middle_ned) / fit.sigma_position_m)
        factors.append(factor)
        score = ties.score(fit.ned_from_model, located=True)
        assert score.sigma_factor == factor
        assert score.rms["control"].points == len(places) - 1
        assert [row.use for row in score.points].count("left out") == 1
    assert REAL_M / STATED_M * 0.85 < np.sqrt(np.mean(np.square(factors))) < REAL_M / STATED_M * 1.1
    assert is_unit(misses, 30, 3 * (len(POINTS) - 1) - parameters)


def test_hasty_picks_count_with_what_they_are_worth() -> None:
    noise_px, misses = 6.0, []
    for seed in range(6):
        gauge = in_gauge(seed)
        picks = picks_of(POINTS, noise_px, seed)
        picks[seed] = replace(picks[seed], x_px=picks[seed].x_px + 150.0)
        with keep_warnings() as said:
            spots, lost = triangulate_picks(picks, gauge.cameras)
        assert not lost and len(said) == 1 and "count with a sigma of" in said[0]
        stated = float(said[0].rsplit("sigma of ", 1)[1].split()[0])
        assert 0.7 * noise_px < stated < 1.4 * noise_px
        assert [p for s in spots.values() for p in s.left_out] == [picks[seed].image]
        true = gauge.points(POINTS)
        for k, point in enumerate(true):
            off = spots[f"p{k}"].model - point
            misses.append(off @ np.linalg.solve(spots[f"p{k}"].covariance, off) / 3.0)
    assert 0.6 < np.mean(misses) < 1.5


NADIR = Rotation.from_euler("z", 90, degrees=True)


def cameras(count: int) -> dict[str, RegisteredPicture]:
    """Pictures in a line, 2 m above the origin, 0.25 m apart."""
    camera = design_rig(CameraConfig(), WaterConfig(), scale=6).cameras["left"]
    warp = best_warp(camera, 1.5, 2.5)
    return {
        f"{n}.png": RegisteredPicture(
            warp=warp,
            model_from_pinhole=RigidTransform.from_components(
                [0.25 * (n - (count - 1) / 2), 0.1 * (n % 2), -2.0], NADIR
            ),
        )
        for n in range(count)
    }


def drawn(
    views: dict[str, RegisteredPicture], mark: float, match: float, rng: np.random.Generator
) -> list[Pick]:
    """A mark by eye in the first picture, and matches to it in the others.

    The match of a patch errs by the noise of the patch, which all share, and by that of the other
    picture; what is matched lies on a level floor.
    """
    first, *others = views
    place = np.zeros(3)
    marked = views[first].project(place) + rng.normal(0, mark, 2)
    patch = marked + rng.normal(0, match / np.sqrt(2), 2)
    start, way = views[first].ray(patch)
    meant = start - way * start[2] / way[2]

    def at(image: str, pixel: Array, sigma: float, to: str) -> Pick:
        return Pick(image=image, point="p", x_px=float(pixel[0]), y_px=float(pixel[1]),
                    sigma_px=sigma, matched_to=to)  # fmt: skip

    return [
        at(first, marked, mark, ""),
        *(
            at(o, views[o].project(meant) + rng.normal(0, match / np.sqrt(2), 2), match, first)
            for o in others
        ),
    ]


@pytest.mark.parametrize(("mark", "match"), [(0.5, 0.05), (0.05, 0.05), (0.02, 0.1)])
def test_errors_of_matched_spots_are_as_stated(mark: float, match: float) -> None:
    rng, views = np.random.default_rng(3), cameras(6)
    chi = []
    for _ in range(60):
        spot = triangulate_picks(drawn(views, mark, match, rng), views)[0]["p"]
        chi.append(spot.model @ np.linalg.solve(spot.covariance, spot.model))
    # three degrees of freedom; chi above 1 only widens
    assert 0.7**2 < np.mean(chi) / 3 < 1.3**2


SIDE_M, DEPTH_M = 0.15, 15.0


@cache
def marked() -> Scene:
    return make_scene(lines=1, stations=3, points=50, port_distance_m=0.1)


def middle_ne() -> Array:
    """Where marker 7 lies flat, its upper edge to the north."""
    return np.mean([pose.translation[:2] for pose in marked().ned_from_cam[:4]], axis=0)


def corners_ned() -> Array:
    """(4, 3) clockwise as a camera above sees them, from the marker's own upper left."""
    half = SIDE_M / 2
    plan = np.array([[half, -half], [half, half], [-half, half], [-half, -half]]) + middle_ne()
    return np.column_stack([plan, np.full(4, DEPTH_M)])


def marker_picture(camera: Camera, ned_from_cam: RigidTransform, dictionary: int) -> np.ndarray:
    """A grey sea floor with the marker, every pixel's ray traced through the port."""
    paper = np.full((800, 800), 120.0, np.float32)  # twice the marker's side, 400 texels
    paper[120:680, 120:680] = 220.0
    known = cv2.aruco.getPredefinedDictionary(dictionary)
    paper[200:600, 200:600] = 20.0 + 0.78 * cv2.aruco.generateImageMarker(known, 7, 400)
    paper = cv2.GaussianBlur(paper, (0, 0), 1.5)  # about half a pixel: no stairs
    start, way = camera.unproject(camera.pixel_centres().reshape(-1, 2))
    start, way = ned_from_cam.apply(start), ned_from_cam.rotation.apply(way)
    spot = start + (DEPTH_M - start[:, 2:]) / way[:, 2:] * way
    upper_left = corners_ned()[0, :2]
    row = (upper_left[0] - spot[:, 0]) / SIDE_M * 400 + 200 - 0.5
    column = (spot[:, 1] - upper_left[1]) / SIDE_M * 400 + 200 - 0.5
    shape = (camera.height_px, camera.width_px)
    x, y = (v.reshape(shape).astype(np.float32) for v in (column, row))
    seen = cv2.remap(paper, x, y, cv2.INTER_LINEAR, borderValue=120.0)
    return cv2.GaussianBlur(seen, (0, 0), 0.7).astype(np.uint8)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("markers")
    images = folder / "images"
    for record, pose in zip(marked().records, marked().ned_from_cam, strict=True):
        path = images / record.image
        path.parent.mkdir(parents=True, exist_ok=True)
        taken = marker_picture(marked().rig.cameras[record.camera], pose, cv2.aruco.DICT_5X5_100)
        cv2.imwrite(str(path), taken)
    write_manifest(images / "manifest.csv", marked().records)
    write_json(images / "stage.json", {"stage": "images", "digest": ""})
    return folder


def test_markers_are_found_to_a_part_of_a_pixel_and_their_side_measured(workspace: Path) -> None:
    _, found = survey_control(workspace)
    assert found["dictionary"] == "DICT_5X5_100"
    assert list(found["markers"]) == ["7"]
    assert found["markers"]["7"] >= 4
    assert found["detections"] == found["markers"]["7"]
    picks = read_picks(workspace / "markers.csv")
    of_name = {
        r.image: (r, p) for r, p in zip(marked().records, marked().ned_from_cam, strict=True)
    }
    misses = []
    for pick in picks:
        record, pose = of_name[pick.image]
        corner = corners_ned()[int(pick.point.split(".")[1])]
        seen = marked().rig.cameras[record.camera].project(pose.inv().apply(corner[None]))[0]
        misses.append(np.linalg.norm(seen - [pick.x_px, pick.y_px]))
    assert 0.0 < np.sqrt(np.mean(np.square(misses))) < 0.35

    spots, lost = triangulate_picks(picks, registered(marked(), RigidTransform.identity()))
    assert not lost
    place = np.stack([spots[f"7.{k}"].model for k in range(4)])
    np.testing.assert_allclose(place, corners_ned(), atol=0.012)
    np.testing.assert_allclose(spots["7"].model[:2], middle_ne(), atol=0.003)
    sides = np.linalg.norm(place - np.roll(place, -1, axis=0), axis=1)
    assert sides.mean() == pytest.approx(SIDE_M, rel=0.01)


def test_markers_of_another_dictionary_are_not_seen(workspace: Path) -> None:
    _, found = survey_control(workspace, dictionary="DICT_7X7_100")
    assert found["detections"] == 0
    assert read_picks(workspace / "markers.csv") == []


def test_what_controls_nothing_is_no_input(tmp_path: Path) -> None:
    """A pick without control, or of a point that it does not name, makes no placing stale."""

    def depends() -> tuple[dict[str, object], list[Path]]:
        stage = PLACING.stage(tmp_path, config)
        return dict(stage.settings), [p for p in stage.inputs if p.suffix == ".csv"]

    config = SurveyConfig()
    header = "image,point,x,y,sigma_px,remark"
    rows = [f"{n}.png,{p},{n}5,7,1," for p in ("a", "b", "7.0", "8.0") for n in range(2)]
    before = depends()
    assert not any("picks" in name for name in before[0])
    picks = tmp_path / "picks.csv"
    picks.write_text("\n".join([header, *rows]))
    assert depends() == before and picks_of_model(tmp_path, ["0.png"], ()) == []
    (tmp_path / "control.csv").write_text(
        "kind,name,use,length_m,sigma_m\nmarker,7,check,0.1,0.001\n# point,8,control,,"
    )
    known = depends()
    assert {p.name for p in {*known[1]} - {*before[1]}} == {"control.csv"}
    assert [p.point for p in picks_of_model(tmp_path, ["0.png"], {"7"})] == ["7.0"]
    assert [p.image for p in picks_of_model(tmp_path, ["0.PNG"], {"7"})] == ["0.PNG"]
    rows = [f"{rows[0]}mine", *rows[1:6], "1.png,c,1,1,1,", "0.png,7.1,,,,"]
    picks.write_text("\n".join([header, *rows]))
    assert depends() == known
    picks.write_text("\n".join([header, *rows, "0.png,7.1,4,4,1,"]))
    assert depends() != known
