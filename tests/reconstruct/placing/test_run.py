import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from pyproj import Transformer
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import read_json, renew_outputs
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.errors import AliceError, ReconstructionError
from alice_survey.core.executor import SERIAL, Executor, local_executor
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.core.records import GeoreferenceRecord, ScaleOfPairs
from reconstruct.mapping.arrays import ground_pixel, observations
from reconstruct.picking.lengths import scale_model
from reconstruct.pictures.importing import import_images
from reconstruct.pictures.undistorted import Pictures
from reconstruct.placing import run
from reconstruct.placing.alignment import bend_of
from reconstruct.placing.control_command import import_control
from reconstruct.placing.control_points import RegisteredPicture
from reconstruct.placing.navigation import body_from_pinhole
from reconstruct.placing.track import read_track_poses
from reconstruct.views.model import SparseModel, read_model, read_warps
from tests.reconstruct.mapping.test_mapper import block, block_mapped
from tests.reconstruct.scenes import ALTITUDE_M, DATUM


def reconstruct(workspace: Path, config: SurveyConfig, executor: Executor) -> bool:
    mapped = spec("mapping").make(workspace, config, executor)
    return spec("placing").make(workspace, config, executor) or mapped


QUICK = SurveyConfig(reconstruct=ReconstructConfig(max_features=2000))


@pytest.fixture(scope="module")
def drone(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six overlapping drone pictures, reduced, with their GPS."""
    folder = tmp_path_factory.mktemp("drone")
    (folder / "in").mkdir()
    sources = sorted((shared_data / "brighton_beach" / "images").glob("*.jpg"))[9:15]
    for source in sources:
        with Image.open(source) as image:
            small = image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX)
            small.save(folder / "in" / source.name, exif=image.getexif(), quality=92)
    import_images(folder, [folder / "in"])
    assert reconstruct(folder, QUICK, SERIAL)
    return folder


def test_a_drone_block_is_registered_scaled_and_placed_by_its_gps(drone: Path) -> None:
    found = read_json(drone / "sparse" / "registration.json")
    assert found["registered"] == found["total"] == 6
    assert 0.1 < found["mean_reprojection_px"] < 1.0
    assert found["scale_source"].startswith("scale from navigation, sigma 0.")
    assert max(found["georeference"][f"rms_{axis}_m"] for axis in ("north", "east", "depth")) < 3
    model = read_model(drone / "sparse")
    assert (model.frame.name, model.frame.scaled) == ("ned", True)
    assert model.frame.vertical_datum == "EXIF GPS altitude"
    assert len(model.views) == 6
    records = {r.image: r for r in read_manifest(drone / "images" / "manifest.csv")}
    assert model.frame.datum is not None
    for view in model.views:
        record = records[view.image]
        place = [[record.latitude_deg, record.longitude_deg, record.depth_m]]
        stated = model.frame.datum.ned_from_geodetic(np.array(place))[0]
        assert np.linalg.norm(view.world_from_cam.translation - stated) < 6
        assert view.world_from_cam.rotation.apply([0, 0, 1])[2] > 0.95  # looks down


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(drone: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    import_images(other, [drone / "in"])
    reconstruct(other, QUICK, local_executor(2))
    for file in sorted((drone / "sparse").rglob("*")):
        if file.is_file() and file.name != "stage.json":
            twin = other / "sparse" / file.relative_to(drone / "sparse")
            assert file.read_bytes() == twin.read_bytes(), file.name
    assert "/" + str(tmp_path).split("/")[1] not in (other / "sparse" / "cameras.json").read_text()


@pytest.fixture
def nowhere(drone: Path, tmp_path: Path) -> Path:
    """The same pictures without GPS: no scale, no CRS."""
    folder = tmp_path / "nowhere"
    source = tmp_path / "in"
    source.mkdir()
    for path in sorted((drone / "in").iterdir()):
        with Image.open(path) as image:
            image.save(source / path.name, quality="keep", exif=b"")
    import_images(folder, [source])
    reconstruct(folder, QUICK, SERIAL)
    return folder


ENDS = [3, 40]


def length_of(model: SparseModel) -> float:
    return float(np.linalg.norm(np.subtract(*model.points_world[ENDS])))


def marks(workspace: Path) -> list[str]:
    """Two points of the model, each as two pictures show it."""
    model, pictures, found = read_model(workspace / "sparse"), Pictures.open(workspace), []
    for point in model.points_world[ENDS]:
        seen = []
        for view in model.views:
            pixel = pictures.warp(view.image).from_pinhole(view.project(point[None]))[0]
            if np.all((pixel > 5) & (pixel < np.array(view.pinhole.size_px) - 20)):
                seen.append(f"{view.image}:{pixel[0] - 0.5:.4f},{pixel[1] - 0.5:.4f}")
        found.append("=".join(seen[:2]))
    assert all("=" in one for one in found)
    return found


def test_without_positions_the_model_is_level_unscaled_and_says_so(nowhere: Path) -> None:
    model = read_model(nowhere / "sparse")
    assert (model.frame.name, model.frame.datum, model.frame.scaled) == ("model", None, False)
    assert model.frame.notes
    assert abs(np.median(model.points_world[:, 2])) < 0.05 * np.ptp(model.points_world[:, 0])
    assert all(view.world_from_cam.translation[2] < 0 for view in model.views)

    # one known length scales it
    assert "12.5 m" in scale_model(nowhere, " ".join(marks(nowhere)), 12.5)
    before = (nowhere / "mapping" / "stage.json").stat().st_mtime_ns
    assert reconstruct(nowhere, QUICK, SERIAL)
    assert (nowhere / "mapping" / "stage.json").stat().st_mtime_ns == before  # not mapped again
    scaled = read_model(nowhere / "sparse")
    assert scaled.frame.scaled
    assert scaled.frame.notes != model.frame.notes
    assert length_of(scaled) == pytest.approx(12.5, rel=1e-3)
    header = (nowhere / "sparse" / "track.csv").read_text().splitlines()[0]
    assert "x_m,y_m,z_m" in header

    # scaling again starts from the metres now shown
    picks = marks(nowhere)
    scale_model(nowhere, " ".join(picks), 25.0)
    assert reconstruct(nowhere, QUICK, SERIAL)
    assert length_of(read_model(nowhere / "sparse")) == pytest.approx(25.0, rel=1e-3)
    one, image = picks[0], scaled.views[2].image
    for wrong in ("camera/x.jpg:5,5", f"{image}:9999,5", f"{image}:5;5", "1,2,3", one, ""):
        with pytest.raises(ReconstructionError):
            scale_model(nowhere, f"{wrong} {one}", 1.0)
    with pytest.raises(ReconstructionError, match="--length"):
        scale_model(nowhere, " ".join(picks), 0.0)

    # a scale measured on another model is refused
    scale = json.loads((nowhere / "scale.json").read_text())
    (nowhere / "scale.json").write_text(json.dumps(scale | {"gauge": "other"}))
    with pytest.raises(ReconstructionError, match=r"scale\.json"):
        reconstruct(nowhere, QUICK, SERIAL)


@pytest.mark.slow
def test_real_stereo_without_calibration_gets_one_rigid_rig(
    shared_data: Path, tmp_path: Path
) -> None:
    """Five dim underwater pairs, no calibration, no navigation."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for number in range(1, 6):
            picture = cv2.imread(str(shared_data / "haltbrekken" / side / f"{number:03d}.png"))
            small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(tmp_path / side / f"{number:03d}.png"), small)
    folder = tmp_path / "w"
    import_images(folder, [], cameras={"left": tmp_path / "left", "right": tmp_path / "right"})
    reconstruct(folder, QUICK, local_executor(2))
    found = read_json(folder / "sparse" / "registration.json")
    assert found["registered"] == 10
    assert 0.02 < found["mean_reprojection_px"] < 0.8
    assert found["baseline"] == pytest.approx(1.0, rel=1e-9)
    model = pycolmap.Reconstruction(folder / "sparse" / "model")
    assert len(model.rigs) == 1
    poses = read_track_poses(folder / "sparse" / "track.csv")
    relative = [poses[f"right/{n:03d}.png"].inv() * poses[f"left/{n:03d}.png"] for n in range(1, 6)]
    shifts = np.stack([r.translation for r in relative])
    np.testing.assert_allclose(np.linalg.norm(shifts, axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(shifts - shifts[0], 0, atol=1e-6)
    view = next(v for v in read_model(folder / "sparse").views if v.camera == "left")
    assert 600 < view.pinhole.fx_px < 1100  # of 680 pixels width


def test_a_rig_of_other_pictures_is_refused(drone: Path, tmp_path: Path) -> None:
    from alice_survey.core.config import CameraConfig, WaterConfig
    from camera_calib.rig import design_rig, write_rig

    folder = tmp_path / "w"
    import_images(folder, [drone / "in"])
    write_rig(folder / "calibration" / "rig.json", design_rig(CameraConfig(), WaterConfig()))
    with pytest.raises(AliceError, match="'camera'"):
        reconstruct(folder, QUICK, SERIAL)
    manifest = folder / "images" / "manifest.csv"
    records = [replace(r, camera="left") for r in read_manifest(manifest)]
    write_manifest(manifest, records)
    renew_outputs(manifest.parent, [manifest])
    with pytest.raises(AliceError, match=r"800 x 450.*3384 x 2710"):
        reconstruct(folder, QUICK, SERIAL)


@pytest.mark.slow
def test_ground_control_of_handheld_gps_is_fitted_robustly(
    drone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A gcp_list of nine points, 1.5 m off where 0.02 m is stated, one of them 80 m off."""
    work = tmp_path / "work"
    shutil.copytree(drone, work)
    model = pycolmap.Reconstruction(drone / "sparse" / "model")
    datum = read_model(drone / "sparse").frame.datum
    assert datum is not None
    rng = np.random.default_rng(3)
    points = [p for _, p in sorted(model.points3D.items()) if p.track.length() >= 4]
    to_utm = Transformer.from_crs(4326, datum.utm_epsg, always_xy=True)
    chosen = [points[0]]
    while len(chosen) < 9:  # the one that is farthest from all chosen ones
        away = [min(np.linalg.norm(p.xyz - q.xyz) for q in chosen) for p in points]
        chosen.append(points[int(np.argmax(away))])
    cameras = read_warps(work / "sparse" / "cameras.json")
    lines = [f"EPSG:{datum.utm_epsg}"]
    for number, point in enumerate(chosen):
        wrong = np.array([60.0, -50.0, 20.0]) if number == 4 else np.zeros(3)
        place = point.xyz + rng.normal(0, 1.5, 3) + wrong
        latitude, longitude, depth = datum.geodetic_from_ned(place[None])[0]
        east, north = to_utm.transform(longitude, latitude)
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.cam_from_world() * point.xyz
            record = image.name.split("/", maxsplit=1)[0]
            pose = RigidTransform.identity()
            x, y = RegisteredPicture(warp=cameras[record], model_from_pinhole=pose).project(
                seen
            ) + rng.normal(0, 2.0, 2)
            name = Path(image.name).name
            lines.append(f"{east:.4f} {north:.4f} {-depth:.4f} {x:.2f} {y:.2f} {name} g{number}")
    (work / "gcp_list.txt").write_text("\n".join(lines))
    import_control(work, work / "gcp_list.txt", sigma_m=0.02)
    capsys.readouterr()
    assert spec("placing").make(work, QUICK, SERIAL)
    said = capsys.readouterr().err
    assert "control point g4 is " in said and "count with a sigma of" in said
    score = read_json(work / "sparse" / "control.json")
    assert [row["name"] for row in score["points"] if row["use"] == "left out"] == ["g4"]
    assert 0.6 * 1.5 < 0.02 * score["sigma_factor"] < 2.0 * 1.5
    assert score["rms"]["control"]["points"] == 8
    found = read_json(work / "sparse" / "georeference.json")
    assert 0.3 < found["sigma_north_m"] < 1.5  # 1.5 m over the root of 8 points


NAN = float("nan")
SURE = ScaleOfPairs(mean=1.0, mean_sigma=1e-4)


def survey(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Places in a frame of their own, and where navigation has them within 0.1 m."""
    rng = np.random.default_rng(seed)
    stated = rng.uniform([0, 0, 12.9], [20, 8, 13.1], (count, 3))
    turn = Rotation.random(random_state=seed)
    centres = turn.apply(stated + rng.normal(0, 0.1, stated.shape))
    return centres + np.array([3.0, -50.0, 7.0]), stated


@pytest.mark.parametrize("seed", range(4))
def test_stations_that_jumped_stand_out_of_those_that_did_not(seed: int) -> None:
    centres, stated = survey(seed)
    stated[[7, 21, 22]] += [[0.0, 3.0, 0.0], [-9.0, 4.0, 0.0], [200.0, 0.0, 0.0]]
    off, sigma = run.navigation_residuals(centres, stated, np.full(stated.shape, 0.1))
    assert off[[7, 21, 22]] == pytest.approx([3.0, np.hypot(9, 4), 200.0], abs=0.5)
    rest = np.delete(off, [7, 21, 22])
    assert rest.max() < 0.5
    assert np.sqrt((rest**2).mean() / 3) == pytest.approx(0.1, rel=0.25)
    assert 0.1 <= sigma.max() < 0.13


def test_a_jump_is_reported_by_name_and_small_misses_are_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene, mapped = block(), block_mapped()
    capsys.readouterr()  # of a slow machine's progress
    mounts = body_from_pinhole(scene.rig, mapped.warps)
    positions, sigmas = run.pinhole_positions(scene.records, mounts, DATUM)
    good = run.check_mapping(mapped.model, scene.records, positions, sigmas, 0.0, SURE)
    assert good.notes == ()
    assert good.far == ()
    assert good.checked == len({r.station for r in scene.records})
    assert not capsys.readouterr().err
    fine = np.full_like(sigmas, 0.02)
    jumped = positions.copy()
    station = scene.records[4].station
    rows = [i for i, r in enumerate(scene.records) if r.station == station]
    jumped[rows] += [0.0, 0.4, 0.0]  # far by sigmas, but not by metres
    assert run.check_mapping(mapped.model, scene.records, jumped, fine, 0.0, SURE).far == ()
    jumped[rows] += [0.0, 2.0, 0.0]
    found = run.check_mapping(mapped.model, scene.records, jumped, fine, 0.0, SURE)
    assert [far.station for far in found.far] == [station]
    assert found.far[0].off_m == pytest.approx(2.4, abs=0.1)
    assert f"{scene.records[rows[0]].image} (2." in capsys.readouterr().err
    stated = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert stated["far"][0]["station"] == station


@pytest.mark.parametrize(
    ("misfit", "said"),
    [
        ({}, []),
        ({"rms_depth_m": 6.4, "rms_north_m": 4.0, "left_out": {"depth": 2}}, []),
        ({"rms_depth_m": 328.4, "rms_north_m": 4.0}, ["328.4", "6 m"]),
        ({"rms_east_m": 16.0}, ["16.0", "3 m"]),
        ({"left_out": {"horizontal": 4}}, ["4 of 12"]),
    ],
)
def test_a_model_many_sigmas_off_navigation_is_named(
    misfit: dict[str, Any], said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """GPS of EXIF: 3 m level, as where nothing is stated, and 6 m up and down."""
    records = [
        ImageRecord(image=f"{i}", camera="a", station=i, sigma_depth_m=6.0) for i in range(12)
    ]
    run.warn_of_navigation(GeoreferenceRecord(**misfit), records, controlled=False)
    warned = capsys.readouterr().err
    assert all(word in warned for word in said)
    assert warned.count("\n") == bool(said)


def test_a_rig_that_came_out_another_size_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    scene, mapped = block(), block_mapped()
    unknown = np.full((len(scene.records), 3), NAN)

    def notes(rig_error: float, scale: ScaleOfPairs) -> tuple[str, ...]:
        records = scene.records
        return run.check_mapping(mapped.model, records, unknown, unknown, rig_error, scale).notes

    assert notes(0.9e-3, SURE) == ()
    assert "-0.20 %" in notes(-2e-3, SURE)[0]
    assert "-0.20 %" in capsys.readouterr().err
    long = SURE.model_copy(update={"mean": 1.002})
    assert "+0.20 " in notes(NAN, long)[0]
    assert notes(NAN, long.model_copy(update={"mean_sigma": 1e-3})) == ()


def test_a_significant_bend_is_reported_and_a_small_one_is_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    mapped = block_mapped()
    capsys.readouterr()  # of a slow machine's progress
    large = bend_of(curvature_per_m=0.05, sigma_per_m=1e-3, length_m=4.0)
    small = bend_of(curvature_per_m=1e-4, sigma_per_m=1e-4, length_m=2.0)
    straight = run.measure_doming(mapped.model, (small, small))
    assert straight.notes == ()
    assert not capsys.readouterr().err
    focal = mapped.warps["left"].pinhole.focal_px
    assert straight.pixel_m == pytest.approx(ALTITUDE_M / focal, rel=0.1)
    found = run.measure_doming(mapped.model, (large, small))
    assert found.along == large and found.across == small
    assert "bent along the block: +100.0 +/- 2.0 mm over 4.0 m" in found.notes[0]
    assert len(capsys.readouterr().err.splitlines()) == len(found.notes) == 1


def test_the_scale_shows_a_model_whose_depths_are_stretched() -> None:
    """Points 1 % farther from the cameras than each station's own stereo has them."""
    mapped = block_mapped()
    model = pycolmap.Reconstruction(mapped.model)
    before = run.scale_of_pairs(model, observations(model))
    assert before is not None
    assert abs(before.mean - 1.0) < 4 * before.mean_sigma + 1e-4
    down = np.median([i.cam_from_world().matrix()[2, :3] for i in model.images.values()], axis=0)
    height = np.median([i.projection_center() @ down for i in model.images.values()])
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.01 * (point.xyz @ down - height) * down
    after = run.scale_of_pairs(model, observations(model))
    assert after is not None
    assert after.mean == pytest.approx(1.01 * before.mean, abs=4e-4)
    assert after.mean - 1.0 > 3 * after.mean_sigma
    assert ground_pixel(model, observations(model)) > 0
