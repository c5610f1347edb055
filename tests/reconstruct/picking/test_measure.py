"""The paper's single station: one stereo pair is a workspace, and lengths in it have sigmas."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.app.pipeline import run
from alice_survey.core.errors import ImageError, ReconstructionError
from alice_survey.core.frames import Array
from camera_calib.freedom import POSE
from camera_calib.rig import Covariance, Rig, write_rig
from reconstruct.measure.figures import polygon_area, polyline
from reconstruct.picking.lengths import measure, parse_picks
from reconstruct.picking.registered import RegisteredPictures
from reconstruct.pictures.importing import import_images
from tests.oracles_mesh import SIZE, port_rig, station_pictures, surface_points

BASELINE_SIGMA_M = 2e-4


def known_rig() -> Rig:
    sigmas = {f"right.{axis}": 1e-5 for axis in POSE} | {"right.x_m": BASELINE_SIGMA_M}
    matrix = np.diag(np.square(list(sigmas.values())))
    return replace(port_rig(), covariance=Covariance(parameters=tuple(sigmas), matrix=matrix))


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reconstructed workspace of two pictures."""
    folder = tmp_path_factory.mktemp("station")
    rig = known_rig()
    for name, picture in zip(rig.cameras, station_pictures(rig, 2.0, 1), strict=True):
        (folder / name).mkdir()
        cv2.imwrite(str(folder / name / "a.png"), picture)
    write_rig(folder / "rig.json", rig)
    with pytest.raises(ImageError, match="rig"):
        import_images(folder / "alone", [folder / "left"])
    cameras = {name: folder / name for name in rig.cameras}
    import_images(folder / "work", [], cameras=cameras, rig=folder / "rig.json")
    run(["mapping", "placing", "dense"], folder / "work", None, None, None)
    return folder / "work"


def has_surface(station: Path, pixel: Array) -> bool:
    x, y = pixel - 0.5
    try:
        measure(station, f"left/a.png:{x:.1f},{y:.1f} left/a.png:200,150")
    except ReconstructionError:
        return False
    return True


@pytest.mark.slow
def test_lengths_of_one_station_are_as_far_off_as_their_sigmas_say(station: Path) -> None:
    rng, rig = np.random.default_rng(2), port_rig()
    drawn = np.round(rng.uniform([100, 60], [SIZE[0] - 60, SIZE[1] - 60], (40, 2)), 1)
    pixels = np.array([pixel for pixel in drawn if has_surface(station, pixel)])
    assert len(pixels) >= 36  # two pictures leave gaps
    words = " ".join(f"left/a.png:{x:.1f},{y:.1f}" for x, y in pixels - 0.5)  # as viewers count
    _, data = measure(station, words)
    each = [word for point in words.split() for word in ("--points", point)]
    said, by_eye = (
        CliRunner().invoke(app, ["measure", str(station), *each, *exact, "--json"])
        for exact in (("--pick-sigma", "0"), ())
    )
    assert json.loads(said.stdout) == json.loads(json.dumps(data)), said.output
    usual = [one["sigma_of_pixels_m"] for one in json.loads(by_eye.stdout)["distances"]]
    true = surface_points(rig.cameras["left"], rig.cam_from_rig["left"].inv(), pixels)
    lengths = np.linalg.norm(np.diff(true, axis=0), axis=1)
    found, own, shared = (
        np.array([one[key] for one in data["distances"]])
        for key in ("value_m", "sigma_of_pixels_m", "sigma_of_calibration_m")
    )
    assert np.all(usual > own) and np.median(usual / own) > 1.2
    assert 0.6 < np.sqrt(np.mean(((found - lengths) / own) ** 2)) < 1.6
    assert np.sqrt(np.mean((found - lengths) ** 2)) < 2e-3
    # a baseline that is known to 0.2 % scales all lengths together
    assert np.median(shared / found) == pytest.approx(BASELINE_SIGMA_M / 0.1, rel=0.2)
    assert data["length"]["value_m"] == pytest.approx(polyline(true), rel=5e-3)
    assert max(one["sigma_of_poses_m"] for one in data["distances"]) == 0.0
    with pytest.raises(ReconstructionError, match="outside"):
        measure(station, "left/a.png:900,4 left/a.png:150,120")


def test_without_scale_the_next_command_is_offered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unscaled = SimpleNamespace(frame=SimpleNamespace(scaled=False))
    monkeypatch.setattr(RegisteredPictures, "read", lambda _: unscaled)
    for command in ("control --points", "reconstruct"):
        with pytest.raises(ReconstructionError, match=f"alice-survey {command}"):
            measure(tmp_path, "a.png:1,2 a.png:3,4")
        (tmp_path / "scale.json").write_text("{}")


def test_points_of_another_form_are_refused() -> None:
    for points in ("a.png:1,2", "a.png:1,2 a.png:a,b", "1,2 3,4", "a:1,2=b:1,2=c:1,2 a:3,4"):
        with pytest.raises(ReconstructionError):
            parse_picks(points)


def test_figures_of_polygons() -> None:
    square = np.array([[0.0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]])
    assert polygon_area(square) == pytest.approx(6.0)
    assert polyline(square) == pytest.approx(7.0)
