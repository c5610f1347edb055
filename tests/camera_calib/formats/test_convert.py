"""Conversions: nothing is lost unasked, the price of a stand-in is stated, faults are one line."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.app.commands.camera import ConvertCommand
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError
from camera_calib.camera import Camera
from camera_calib.formats.convert import (
    FORMATS,
    Conversion,
    convert,
    detect,
    fit_in_water,
    in_water,
)
from camera_calib.formats.opencv_model import StandIn
from camera_calib.formats.rigs import ReadOptions, in_air, only, rename_cameras, with_port
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.ports.dome import DomePort
from camera_calib.rig import Rig, design_rig, read_rig, write_rig
from tests.cameras import changed
from tests.strategies_formats import assert_same_geometry, covariance_of

DESIGN = design_rig(CameraConfig(), WaterConfig(), scale=4)
BENT = replace(
    DESIGN,
    cameras={
        "left": changed(DESIGN.cameras["left"], k1=-0.1, p2=1e-3),
        "right": changed(DESIGN.cameras["right"], k1=-0.12),
    },
)
DOMED = Camera(
    width_px=846,
    height_px=677,
    lens=FisheyeLens(fx_px=500, fy_px=501, cx_px=423, cy_px=340, k1=0.02),
    port=DomePort(dome_z_m=0.004, outer_radius_m=0.06, glass_thickness_m=0.006),
)
DOMES = replace(DESIGN, cameras={"left": DOMED, "right": changed(DOMED, k1=0.03)})
FULL = replace(BENT, covariance=covariance_of(BENT, np.random.default_rng(4)))
IN_AIR = in_air(BENT)
PLACES = {name: RigidTransform.from_translation([0.1 * i, 0, 0]) for i, name in enumerate("abc")}
THREE = replace(IN_AIR, cameras=dict.fromkeys(PLACES, IN_AIR.cameras["left"]), cam_from_rig=PLACES)
CHANNELS = {"opencv": "o.xml", "colmap": "model", "refractive": "flat", "kalibr": "c.yaml"}


def convert_files(
    source: Path, target: Path, *, camera: str | None = None, **options: Any
) -> tuple[str, dict[str, Any]]:
    reading = ReadOptions(camera=camera)
    return convert(Conversion(source=source, target=target, reading=reading, **options))


@pytest.fixture
def own(tmp_path: Path) -> Path:
    write_rig(tmp_path / "rig.json", FULL)
    return tmp_path / "rig.json"


def refused(source: Path, target: Path, **options: Any) -> str:
    """A conversion that must fail in one line, and write nothing."""
    before = sorted(target.parent.iterdir()) if target.parent.is_dir() else []
    with pytest.raises(AliceError) as error:
        convert_files(source, target, **options)
    assert (sorted(target.parent.iterdir()) if target.parent.is_dir() else []) == before
    shown = str(error.value)
    assert "\n" not in shown
    return shown


def bent_by(term: str) -> Rig:
    """Cameras in air, the right one with one more distortion term."""
    right = changed(IN_AIR.cameras["right"], **{term: 1e-3})
    return replace(IN_AIR, cameras={**IN_AIR.cameras, "right": right})


WATER = {"water": (1.5, 3.0)}
DRY: dict[str, Any] = {"drop_port": True, "drop_covariance": True}
LOSSES: list[tuple[str, Rig, dict[str, Any], tuple[str, ...]]] = [
    *((n, FULL, {"drop_covariance": True}, ("--drop-port", "--water"))
      for n in ("opencv", "colmap", "kalibr")),
    *((n, DOMES, {}, ("dome of 60 mm", "--drop-port", "--water")) for n in ("colmap", "kalibr")),
    *((n, FULL, WATER, ("--drop-covariance",)) for n in ("opencv", "colmap", "kalibr")),
    ("refractive", FULL, {}, ("--drop-covariance",)),
    ("ros", only(FULL, "left"), {"drop_covariance": True}, ("--drop-port", "--water")),
    ("ros", only(FULL, "left"), WATER, ("--drop-covariance",)),
    ("ros", only(DOMES, "left"), {}, ("dome of 60 mm", "--drop-port", "--water")),
    *((n, bent_by(term), {}, (term, "right"))
      for n, term in (("kalibr", "k3"), ("kalibr", "k5"), ("metashape", "k4"), ("ros", "s1"),
                      ("colmap", "s4"), ("refractive", "s2"))),
    ("metashape", in_air(DOMES), {}, ("2 cameras", "--camera")),
    ("ros", in_air(DOMES), {}, ("2 cameras", "--camera")),
    ("opencv", THREE, {}, ("3 cameras", "--camera")),
    ("colmap", FULL, {**WATER, **DRY}, ("--drop-port",)),
    ("colmap", FULL, {"water": (3.0, 1.5), "drop_covariance": True}, ("3 to 1.5",)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "rig", "options", "words"), LOSSES)
def test_nothing_is_lost_unasked(
    name: str, rig: Rig, options: dict[str, Any], words: tuple[str, ...], tmp_path: Path
) -> None:
    """Ports, covariances, distortion, cameras; nor are contradictions taken."""
    write_rig(tmp_path / "rig.json", rig)
    shown = refused(
        tmp_path / "rig.json", tmp_path / CHANNELS.get(name, "a"), target_format=name, **options
    )
    assert all(word in shown for word in words)


def test_every_format_takes_a_rig_and_replaces_no_file_unasked(tmp_path: Path) -> None:
    """Fisheyes and pinholes in air; Refractive COLMAP's has a port, or it would be COLMAP's."""
    source = tmp_path / "rig.json"
    for kind, rig in (("a", in_air(DOMES)), ("b", IN_AIR)):
        write_rig(source, rig)
        (tmp_path / kind).mkdir()
        for name, file in CHANNELS.items():
            target, options = tmp_path / kind / file, {"target_format": name}
            convert_files(source, target, **options)
            assert_same_geometry(FORMATS[name].read(target, ReadOptions()), rig)
            refused(source, target, **options)
            convert_files(source, target, overwrite=True, **options)
    cameras = tmp_path / "b" / "model" / "cameras.bin"
    refused(source, cameras, target_format="colmap", overwrite=True)
    for name, file in CHANNELS.items():
        FORMATS[name].write(tmp_path / "b" / file, BENT if name == "refractive" else IN_AIR)
        assert detect(tmp_path / "b" / file).name == name
    assert detect(tmp_path / "b" / "model" / "rig_config.json").name == "colmap"


@pytest.mark.parametrize("name", ["colmap", "kalibr"])
def test_a_fisheye_behind_a_dome_has_a_stand_in_at_a_stated_price(
    tmp_path: Path, name: str
) -> None:
    write_rig(tmp_path / "rig.json", DOMES)
    target = tmp_path / CHANNELS[name]
    _, data = convert_files(tmp_path / "rig.json", target, target_format=name, water=(1.0, 3.0))
    after = FORMATS[name].read(target, ReadOptions()).cameras["left"]
    assert data["price"]["left"]["model"] == "OPENCV_FISHEYE"
    assert 1e-6 < data["price"]["left"]["rms_px"] < data["price"]["left"]["max_px"] < 0.02
    before = DOMES.cameras["left"]
    # Far away, where the centre matters least, the lens alone must agree with the exact camera.
    pixels = before.frame_grid(5, 5)
    missed = after.project(before.at_depth(pixels, 3.0)) - pixels
    assert np.abs(missed).max() < 1.5


def test_a_stand_in_that_folds_back_inside_the_frame_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def folding(*arguments: Any) -> StandIn:
        fit = fit_in_water(*arguments)
        return replace(fit, camera=changed(fit.camera, k1=-0.2))

    monkeypatch.setattr("camera_calib.formats.convert.fit_in_water", folding)
    with pytest.raises(AliceError, match="OPENCV_FISHEYE of left folds"):
        in_water(only(DOMES, "left"), 1.0, 3.0)


PORT = {"port_distance": 20.0, "glass": 10.0}
DOME = {"dome_radius": 60.0, "dome_centre": (0.0, 0.0, 4.0), "glass": 6.0, "n_glass": 1.49}


@pytest.mark.parametrize(("rig", "port"), [(BENT, PORT), (DOMES, DOME)])
def test_a_port_given_in_millimetres_with_cameras_in_air_makes_the_rig(
    rig: Rig, port: dict[str, Any], tmp_path: Path
) -> None:
    FORMATS["kalibr"].write(tmp_path / "c.yaml", in_air(rig))
    files: dict[str, Any] = {"source": tmp_path / "c.yaml", "target": tmp_path / "rig.json"}
    with pytest.raises(AliceError, match="--n-water"):
        ConvertCommand(**files, **port).run()
    ConvertCommand(**files, **port, n_water=1.34).run()
    assert_same_geometry(read_rig(tmp_path / "rig.json"), rig)
    assert read_rig(tmp_path / "rig.json").body_from_rig is None
    other = {"outer_radius_m": 0.05} if rig is BENT else {"port_distance_m": 0.005}
    shown = refused(tmp_path / "rig.json", tmp_path / "b.json", port=other)
    assert next(iter(other)) in shown and "--drop-port" in shown
    convert_files(tmp_path / "rig.json", tmp_path / "sea.json", port={"n_water": 1.342})
    assert read_rig(tmp_path / "sea.json").cameras["left"].n_water == 1.342


@pytest.mark.parametrize("name", ["colmap", "kalibr"])
def test_a_dropped_port_leaves_the_cameras_in_air_and_a_warning(
    own: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / CHANNELS[name]
    convert_files(own, target, target_format=name, **DRY)
    assert len(capsys.readouterr().err.splitlines()) == 3  # port, covariance, pose on the vehicle
    after = FORMATS[name].read(target, ReadOptions())
    assert_same_geometry(after, IN_AIR)


def test_the_price_in_water_is_what_colmap_misses_the_exact_camera_by(
    own: Path, tmp_path: Path
) -> None:
    _, data = convert_files(
        own, tmp_path / "model", target_format="colmap", water=(1.5, 3.0),
        drop_covariance=True,
    )  # fmt: skip
    opened = pycolmap.Reconstruction(tmp_path / "model")
    (sensors,) = opened.rigs.values()
    after = FORMATS["colmap"].read(tmp_path / "model", ReadOptions())
    mount, _ = in_water(FULL, 1.5, 3.0)
    for i, (name, camera) in enumerate(BENT.cameras.items(), start=1):
        colmap = opened.cameras[i]
        assert colmap.model.name == "OPENCV"
        # Points that the exact camera sees at the corners and all over, near and far.
        pixels = camera.pixel_centres(step=40).reshape(-1, 2)
        misses = []
        for depth in np.linspace(1.5, 3.0, 7):
            points_rig = BENT.cam_from_rig[name].inv().apply(camera.at_depth(pixels, depth))
            # the new rig's frame is its first camera's, whose centre has moved
            points_new = mount.cam_from_rig["left"].apply(points_rig)
            if i > 1:
                matrix = sensors.sensor_from_rig(colmap.sensor_id).matrix()
                points_new = points_new @ matrix[:, :3].T + matrix[:, 3]
            seen = np.array([colmap.img_from_cam(point) for point in points_new])
            misses.append(np.linalg.norm(seen - pixels, axis=1))
        price = data["price"][name]
        rms = float(np.sqrt(np.mean(np.square(misses))))
        assert 0.5 * price["rms_px"] < rms < 1.3 * price["rms_px"]
        assert np.max(misses) < 1.05 * price["max_px"]
        assert 0.001 < price["rms_px"] < 0.1  # a quarter of the resolution
    assert list(after.cameras) == ["left", "right"]


def test_centres_follow_the_fit_onto_the_vehicle() -> None:
    fitted, _ = in_water(FULL, 1.5, 3.0)
    for name in FULL.cameras:
        moved = (FULL.body_from_cam(name).inv() * fitted.body_from_cam(name)).translation
        # Through this port the best centre is some 7 mm behind the pupil.
        assert -0.009 < moved[2] < -0.005
        assert np.linalg.norm(moved[:2]) < 1e-3
    assert fitted.covariance is None


def test_a_lens_that_a_format_cannot_hold_is_fitted_at_a_stated_price(tmp_path: Path) -> None:
    """A rational lens in air in Kalibr: the best radtan."""
    rational = changed(IN_AIR.cameras["left"], k4=0.02)
    write_rig(tmp_path / "rig.json", replace(IN_AIR, cameras={**IN_AIR.cameras, "left": rational}))
    _, data = convert_files(
        tmp_path / "rig.json", tmp_path / "c.yaml", target_format="kalibr", water=(1.0, 4.0)
    )
    assert 0.0 < data["price"]["left"]["max_px"] < 0.05


def test_changed_numbers_take_their_covariance_with_them() -> None:
    wet = with_port(FULL, {"n_water": 1.36})
    assert not any("n_water" in name for name in wet.covariance.parameters)
    sigmas = FULL.covariance.sigmas
    assert wet.sigmas == {name: sigmas[name] for name in wet.covariance.parameters}
    assert len(wet.sigmas) == 6


def test_one_camera_of_a_rig_keeps_its_place_on_the_vehicle(own: Path, tmp_path: Path) -> None:
    convert_files(own, tmp_path / "right.json", camera="right")
    alone = read_rig(tmp_path / "right.json")
    assert list(alone.cameras) == ["right"]
    np.testing.assert_allclose(
        alone.body_from_cam("right").as_matrix(), FULL.body_from_cam("right").as_matrix(),
        atol=1e-14,
    )  # fmt: skip
    assert set(alone.sigmas) == {"right.fx_px", "right.k1", "right.n_water"}
    convert_files(own, tmp_path / "a.xml", target_format="metashape", camera="right", **DRY)
    (camera,) = FORMATS["metashape"].read(tmp_path / "a.xml", ReadOptions()).cameras.values()
    assert camera.parameter("k1") == -0.12
    shown = refused(own, tmp_path / "x.json", camera="middle")
    assert "left, right" in shown


def test_names_can_be_chosen(own: Path, tmp_path: Path) -> None:
    convert_files(own, tmp_path / "new.json", names=("port", "starboard"))
    rig = read_rig(tmp_path / "new.json")
    assert list(rig.cameras) == ["port", "starboard"]
    assert "starboard.x_m" in rig.covariance.parameters
    for names in ("a", "a,a", "a,../b", "a,b c"):
        assert "--names" in refused(own, tmp_path / "other.json", names=tuple(names.split(",")))
    assert rename_cameras(rig, ["left", "right"]).sigmas == FULL.sigmas


def test_a_name_of_a_camera_cannot_lead_out_of_the_folder(own: Path, tmp_path: Path) -> None:
    data = json.loads(own.read_text())
    data["cameras"] = {"left": data["cameras"]["left"], "../../outside": data["cameras"]["right"]}
    del data["covariance"]
    own.write_text(json.dumps(data))
    for name, target in CHANNELS.items():
        shown = refused(own, tmp_path / "deep" / target, target_format=name)
        assert "'../../outside'" in shown
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.json"]


def test_formats_are_found_from_files_and_names(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.json", IN_AIR)
    _, data = convert_files(tmp_path / "rig.json", tmp_path / "again.xml")
    assert data["to"] == "opencv"
    (tmp_path / "note.txt").write_text("hello\n")
    (tmp_path / "note.md").write_text("hello\n")
    (tmp_path / "a.yaml").write_text("a: 1\n")
    (tmp_path / "empty").mkdir()
    for source in ("none.yml", "note.txt", "note.md", "a.yaml", "empty"):
        assert source in refused(tmp_path / source, tmp_path / "x.json")
    refused(tmp_path / "rig.json", tmp_path / "x.yaml")
    refused(tmp_path / "rig.json", tmp_path / "x", target_format="photoscan")


def test_a_reference_of_its_own_pose_is_counted_out(tmp_path: Path) -> None:
    """A rig whose first camera is not at its origin means the same afterwards."""
    shift = RigidTransform.from_translation([0.3, 0.2, 0.1])
    moved = replace(
        IN_AIR, cam_from_rig={name: pose * shift for name, pose in IN_AIR.cam_from_rig.items()}
    )
    write_rig(tmp_path / "rig.json", moved)
    convert_files(tmp_path / "rig.json", tmp_path / "back.json")
    after = read_rig(tmp_path / "back.json")
    np.testing.assert_array_equal(after.cam_from_rig["left"].as_matrix(), np.eye(4))
    for name in moved.cameras:
        np.testing.assert_allclose(
            after.body_from_cam(name).as_matrix(), moved.body_from_cam(name).as_matrix(),
            atol=1e-14,
        )  # fmt: skip


def test_the_command_converts(own: Path, tmp_path: Path) -> None:
    options = ("--to", "kalibr", "--water", "1.5", "3", "--drop-covariance", "--json")
    target = tmp_path / "c.yaml"
    done = CliRunner().invoke(app, ["camera", "convert", str(own), str(target), *options])
    data = json.loads(done.stdout)
    assert data["written"] == [str(target)] and target.is_file()
    assert data["baseline_m"] == pytest.approx(0.1, abs=1e-3)
