"""pycolmap opens what is written for COLMAP; the fork's files are as its own code writes them."""

import json
import struct
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import RigidTransform, Rotation

from camera_calib.camera import Camera
from camera_calib.formats.camera_files import MODELS
from camera_calib.formats.colmap import read_colmap, write_colmap, write_refractive
from camera_calib.formats.convert import detect
from camera_calib.formats.rigs import ReadOptions
from camera_calib.ports.dome import DomePort
from camera_calib.ports.none import NO_PORT
from camera_calib.rig import Rig
from tests.cameras import changed, flat_port_camera, pair_of
from tests.oracles_dome import traced
from tests.strategies_formats import (
    BOTH_LENSES,
    RATIONAL,
    WIDE_RIG,
    assert_same_geometry,
    fault_of,
    points_for,
    rigs,
)

AIR = flat_port_camera(
    width_px=1920, height_px=1200, fx_px=705.5, fy_px=705.25, cx_px=963.5, cy_px=604.75,
    n_water=1.0,
)  # fmt: skip
WET = changed(
    AIR, port_distance_m=0.025, glass_thickness_m=0.01, n_glass=1.49, n_water=1.333,
    normal=(0.6, 0.0, 0.8),
)  # fmt: skip


fault = partial(fault_of, read_colmap)


def pair(camera: Camera) -> Rig:
    turn = Rotation.from_rotvec([0.01, -0.02, 0.03])
    pose = RigidTransform.from_components([-0.1, 0.001, 0.002], turn)
    return pair_of(camera, changed(camera, fx_px=710.5, k1=-0.125), pose)


@pytest.mark.parametrize("name", MODELS)
def test_every_model_projects_as_in_colmap(name: str, tmp_path: Path) -> None:
    number, parameters = MODELS[name]
    assert int(pycolmap.CameraModelId.__members__[name]) == number
    size = {"f": 700.5, "fx": 700.5, "fy": 702.25, "cx": 963.5, "cy": 604.75}
    params = [size.get(each, 0.01 / (i + 1)) for i, each in enumerate(parameters)]
    path = tmp_path / "cameras.txt"
    path.write_text(f"1 {name} 1920 1200 {' '.join(map(str, params))}\n")
    ours = read_colmap(path, ReadOptions()).cameras["1"].project(WIDE_RIG)
    theirs = pycolmap.Camera(model=name, width=1920, height=1200, params=params)
    # COLMAP calls the first coefficient of a radial model k or k1.
    stated = theirs.params_info.replace("k,", "k1,").split(", ")
    assert tuple("k1" if each == "k" else each for each in stated) == parameters
    known = np.isfinite(ours[:, 0])
    assert known.sum() >= 40
    seen = np.array([theirs.img_from_cam(point) for point in WIDE_RIG[known]])
    np.testing.assert_allclose(ours[known], seen, atol=1e-8, rtol=0)


@pytest.mark.parametrize("target", ["model", "model/cameras.bin"])
@settings(max_examples=25, deadline=None)
@given(rig=rigs(RATIONAL, lenses=BOTH_LENSES, maximum=3))
def test_colmap_projects_as_we_do_from_what_it_reads(target: str, rig: Rig) -> None:
    with tempfile.TemporaryDirectory() as folder:
        written = write_colmap(Path(folder) / target, rig)
        assert all(path.is_file() for path in written)
        model = pycolmap.Reconstruction(Path(folder) / "model")
        (config,) = pycolmap.read_rig_config(Path(folder) / "model" / "rig_config.json")

    (sensors,) = model.rigs.values()
    for i, ((name, camera), entry) in enumerate(
        zip(rig.cameras.items(), config.cameras, strict=True), start=1
    ):
        theirs = model.cameras[i]
        assert (theirs.width, theirs.height) == (camera.width_px, camera.height_px)
        assert entry.image_prefix == f"{name}/"
        assert entry.ref_sensor == (i == 1)
        assert entry.camera.model == theirs.model
        np.testing.assert_array_equal(entry.camera.params, theirs.params)
        points = points_for(camera)
        ours = camera.project(rig.cam_from_rig[name].apply(points))
        if i > 1:
            rigid = sensors.sensor_from_rig(theirs.sensor_id)
            np.testing.assert_allclose(entry.cam_from_rig.matrix(), rigid.matrix(), atol=1e-14)
            points = points @ rigid.matrix()[:, :3].T + rigid.matrix()[:, 3]
        known = np.isfinite(ours[:, 0]) & (points[:, 2] > 0.1)  # COLMAP sees nothing behind it
        assert known.any()
        seen = np.array([theirs.img_from_cam(point) for point in points[known]])
        np.testing.assert_allclose(seen, ours[known], atol=1e-8, rtol=0)


def test_colmap_applies_the_rig_to_a_database_of_pictures(tmp_path: Path) -> None:
    rig = pair(AIR)
    write_colmap(tmp_path / "model", rig)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for name in ("left", "right"):
            camera = pycolmap.Camera(
                model="SIMPLE_PINHOLE", width=1920, height=1200, params=[1000.0, 960.0, 600.0]
            )
            camera_id = database.write_camera(camera)
            for number in range(3):
                image = pycolmap.Image(name=f"{name}/{number}.png", camera_id=camera_id)
                database.write_image(image)
        config = pycolmap.read_rig_config(tmp_path / "model" / "rig_config.json")
        pycolmap.apply_rig_config(config, database)

        (sensors,) = database.read_all_rigs()
        assert len(database.read_all_frames()) == 3
        ((_, rigid),) = sensors.non_ref_sensors.items()
        np.testing.assert_allclose(
            rigid.matrix(), rig.cam_from_rig["right"].as_matrix()[:3], atol=1e-14
        )
        applied = {camera.model.name: camera for camera in database.read_all_cameras()}
    np.testing.assert_array_equal(applied["PINHOLE"].params, [705.5, 705.25, 963.5, 604.75])
    assert applied["OPENCV"].params[4] == -0.125


def test_cameras_without_a_rig_are_read_one_by_one(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(
        "# a comment\n3 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n7 PINHOLE 9 8 5 6 4 3\n"
    )
    assert "3, 7" in fault(path)
    rig = read_colmap(path, ReadOptions(camera="3"))
    (camera,) = rig.cameras.values()
    found = [camera.parameter(name) for name in ("fx_px", "fy_px", "cx_px", "k1")]
    assert found == [500, 500, 320, -0.1]
    assert camera.n_water == 1.0


def test_a_rig_configuration_without_cameras_takes_them_in_order_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = pair(AIR)
    write_colmap(tmp_path, rig)
    config = json.loads((tmp_path / "rig_config.json").read_text())
    for entry in config[0]["cameras"]:
        del entry["camera_model_name"], entry["camera_params"]
    (tmp_path / "rig_config.json").write_text(json.dumps(config))
    assert_same_geometry(read_colmap(tmp_path, ReadOptions()), rig)
    assert "CAMERA_ID" in capsys.readouterr().err


def test_the_forks_files_hold_lens_and_port_of_each_camera(tmp_path: Path) -> None:
    rig = pair(WET)
    write_refractive(tmp_path, rig)
    lines = (tmp_path / "cameras.txt").read_text().splitlines()
    assert lines[1].endswith("PARAMS[] OPTIONAL[REFRAC_MODEL REFRAC_PARAMS[]]")
    left, right = (line.split() for line in lines[3:])
    assert left[:8] == ["1", "PINHOLE", "1920", "1200", "705.5", "705.25", "963.5", "604.75"]
    assert left[8] == "FLATPORT"
    assert list(map(float, left[9:])) == [0.6, 0.0, 0.8, 0.025, 0.01, 1.0, 1.49, 1.333]
    assert right[1] == "OPENCV"
    assert len(right) == 4 + 8 + 1 + 8
    (config,) = json.loads((tmp_path / "rig_config.json").read_text())
    assert config["ref_camera_id"] == 1
    assert config["cameras"][1]["camera_id"] == 2
    x, y, z, w = rig.cam_from_rig["right"].rotation.as_quat()
    assert config["cameras"][1]["cam_from_rig_rotation"] == pytest.approx([w, x, y, z], abs=1e-15)
    # The binary file has the port after each lens.
    (binary, *_) = write_refractive(tmp_path / "binary" / "cameras.bin", rig)
    content = binary.read_bytes()
    assert struct.unpack_from("<QIiQQ", content) == (2, 1, 1, 1920, 1200)
    assert struct.unpack_from("<4di8d", content, 32) == (
        705.5, 705.25, 963.5, 604.75, 0, 0.6, 0.0, 0.8, 0.025, 0.01, 1.0, 1.49, 1.333,
    )  # fmt: skip
    assert len(content) == 8 + 2 * (24 + 4 + 64) + 8 * 4 + 8 * 8


def test_the_fork_may_leave_a_camera_without_port(tmp_path: Path) -> None:
    text = tmp_path / "cameras.txt"
    text.write_text(
        "1 PINHOLE 9 8 5 6 4 3 FLATPORT 0 0 1 0.02 0.01 1 1.5 1.33\n2 PINHOLE 9 8 5 6 4 3\n"
    )
    assert detect(text).name == "refractive"
    dry = read_colmap(text, ReadOptions(camera="2")).cameras["2"]
    assert dry.port == NO_PORT
    binary = tmp_path / "cameras.bin"
    lens = (1, 9, 8, 5.0, 6.0, 4.0, 3.0)
    port = (0, 0.0, 0.0, 1.0, 0.02, 0.01, 1.0, 1.5, 1.33)
    binary.write_bytes(
        struct.pack("<Q", 2)
        + struct.pack("<IiQQ4di8d", 1, *lens, *port)
        + struct.pack("<IiQQ4di", 2, *lens, -1)
    )
    assert detect(binary).name == "refractive"
    assert read_colmap(binary, ReadOptions(camera="1")).cameras["1"].n_water == 1.33
    assert read_colmap(binary, ReadOptions(camera="2")).cameras["2"] == dry
    # An index of air divides the others.
    text.write_text("1 PINHOLE 9 8 5 6 4 3 FLATPORT 0 0 1 0.02 0.01 1.25 1.5 1.5\n")
    camera = read_colmap(text, ReadOptions()).cameras["1"]
    assert (camera.parameter("n_glass"), camera.n_water) == (1.2, 1.2)


def test_a_domeport_bends_light_as_traced_rays_go(tmp_path: Path) -> None:
    """Its centre and the radius of its inner surface come first."""
    path = tmp_path / "cameras.txt"
    path.write_text(
        "1 OPENCV_FISHEYE 1920 1200 700 701 963 604 0.02 -0.01 0.002 0.001 DOMEPORT "
        "0.002 -0.001 0.006 0.05 0.007 1 1.52 1.334\n"
    )
    assert detect(path).name == "refractive"
    (camera,) = read_colmap(path, ReadOptions()).cameras.values()
    port = DomePort(
        dome_x_m=0.002, dome_y_m=-0.001, dome_z_m=0.006, outer_radius_m=0.057,
        glass_thickness_m=0.007, n_glass=1.52, n_water=1.334,
    )  # fmt: skip
    pixels = camera.frame_grid(7, 5).reshape(-1, 2)
    starts, directions = camera.unproject(pixels)
    for ray, *found in zip(camera.in_air().unproject(pixels)[1], starts, directions, strict=True):
        np.testing.assert_allclose(found, traced(port, ray)[1:], atol=1e-13)
    for target in ("text", "binary/cameras.bin"):
        write_refractive(tmp_path / target, read_colmap(path, ReadOptions()))
        (written,) = read_colmap(tmp_path / target, ReadOptions()).cameras.values()
        np.testing.assert_allclose(written.port.values, camera.port.values, rtol=1e-15)


def test_faults_name_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"

    lens = "1 PINHOLE 9 8 5 6 4 3"
    for line, named in (
        ("1 PINHOLE 9", "line 1"),
        ("1 FOV 9 8 1 1 1 1 0", "FOV"),
        ("1 PINHOLE 9 8 5 6 4", "4 PARAMS: 3"),
        (lens + " 1", "4 PARAMS: 5"),
        (lens + " CONEPORT 0 0 0 0.05 0.007 1 1.52 1.334", "CONEPORT"),
        (lens + " DOMEPORT 0 0 0.06 0.05 0.007 1 1.52 1.334", "outside its inner radius of 50"),
        (lens + " DOMEPORT 0 0 0 0.05 0.007 0 1.52 1.334", "indices"),
        (lens + " FLATPORT 0 0", "8 REFRAC_PARAMS: 2"),
        (lens + " FLATPORT 0 0 2 0.05 0.007 1 1.52 1.334", "normal"),
        (lens + " FLATPORT 0 0 1 0.05 0.007 1 1.52 0.9", "0.9"),
        (lens + " FLATPORT 0 0 1 -0.05 0.007 1 1.52 1.33", "port_distance_m"),
        ("1 PINHOLE 9 8 5 6 x 3", "line 1"),
        ("1 PINHOLE 9 8 5 6 nan 3", "PARAMS.2"),
        ("1 PINHOLE 9 8 0 6 4 3", "fx"),
        ("1 PINHOLE 0 8 5 6 4 3", "WIDTH"),
        ("# nothing", "camera"),
        (f"{lens}\n{lens}", "CAMERA_ID"),
        *((f"1 PINHOLE {n} 8 5 6 4 3", "") for n in ("9" * 400, "-5", "1e3", "20000000")),
    ):
        assert named in fault(path, line + "\n")
    binary = tmp_path / "cameras.bin"
    good = struct.pack("<QIiQQ4d", 1, 1, 1, 9, 8, 5, 6, 4, 3)
    for content in (b"", good[:-1], good + b"x", struct.pack("<Q", 1 << 60), b"\xff" * 90):
        binary.write_bytes(content)
        assert "cameras.bin" in fault(binary)
    binary.write_bytes(struct.pack("<QIiQQ5d", 1, 1, 7, 9, 8, *[1.0] * 5))
    assert "FOV" in fault(binary)


def test_faults_of_a_rig_configuration_name_the_key(tmp_path: Path) -> None:
    write_colmap(tmp_path, pair(AIR))
    path = tmp_path / "rig_config.json"
    good = json.loads(path.read_text())

    def config_fault(**change: object) -> str:
        (rig,) = json.loads(json.dumps(good))
        rig["cameras"][1] |= change
        path.write_text(json.dumps([rig]))
        return fault(path)

    assert "cam_from_rig_rotation" in config_fault(cam_from_rig_rotation=[1, 0, 0])
    assert "cam_from_rig_rotation" in config_fault(cam_from_rig_rotation=[1, 0, 0, 9])
    assert "cam_from_rig_translation" in config_fault(cam_from_rig_translation="x")
    config_fault(camera_params=[1.0] * 8)
    config_fault(ref_sensor=True)
    for text in ("[]", "{"):
        fault(path, text)
    (tmp_path / "cameras.txt").unlink()
    assert "cameras.txt" in fault(path, json.dumps(good))
