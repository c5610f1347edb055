"""Picks through the studio against the rendered truth: their spots, and what is said of them."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import cv2
import numpy as np
import pytest

from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import read_csv, write_csv
from alice_survey.sim.seafloor.terrain import read_terrain
from camera_calib.rig import read_rig
from reconstruct.adjustment.uncertainty import read_uncertainty
from reconstruct.evaluate.truth import read_true_poses, surface_depth
from reconstruct.picking.lengths import StationBlock
from reconstruct.picking.registered import RegisteredPictures
from tests.alice_survey.app.studio.client import Reply, ask, call, serving

pytestmark = pytest.mark.slow
EDGE_PX = 14.0
STRANGE = "left/dive 2 – ünder & 100%#.png"
"""A name with a blank, a dash, an umlaut and characters that addresses use."""


class Truth:
    """Where the true cameras see true places."""

    def __init__(self, workspace: Path) -> None:
        truth = workspace / "images" / "truth"
        self.terrain = read_terrain(truth / "terrain.ply")
        self.rig = read_rig(truth / "rig.json")
        self.poses = read_true_poses(truth / "poses.csv")

    def places(self, rng: np.random.Generator, count: int) -> np.ndarray:
        north_east = rng.uniform([-0.2, -0.3], [1.5, 1.2], (count, 2))
        return np.column_stack([north_east, surface_depth(self.terrain, north_east)])

    def pixel(self, image: str, place: np.ndarray) -> np.ndarray:
        """(2,) from the outer corner of the first pixel."""
        camera = self.rig.cameras[image.split("/")[0]]
        return camera.project(self.poses[image].inv().apply(place[None]))[0]

    def nearest(self, place: np.ndarray) -> tuple[str, np.ndarray] | None:
        """The picture that shows a place closest to its middle, and where."""
        found = []
        for image in self.poses:
            camera = self.rig.cameras[image.split("/")[0]]
            size, pixel = np.array([camera.width_px, camera.height_px]), self.pixel(image, place)
            if np.isfinite(pixel).all() and (np.abs(pixel - size / 2) < size / 2 - EDGE_PX).all():
                found.append((float(np.linalg.norm(pixel - size / 2)), image, pixel))
        return min(found)[1:] if found else None


@dataclass
class Found:
    """A spot that was picked and refined."""

    place: np.ndarray
    picks: list[dict[str, Any]]


@pytest.fixture(scope="module")
def workspace(small_survey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures") / "survey"
    shutil.copytree(small_survey, folder)
    return folder


@pytest.fixture
def server(workspace: Path) -> Iterator[Server]:
    with serving(workspace) as running:
        yield running


def asked(server: Server, path: str, **query: object) -> Any:
    reply = ask(server, f"{path}?{urlencode(query)}" if query else path)
    assert reply.status == 200, reply.text
    return json.loads(reply.body)


def sent(server: Server, path: str, body: Any) -> Any:
    reply = call(server, path, body)
    assert reply.status == 200, reply.text
    return json.loads(reply.body)


def refused(reply: Reply, status: int = 400) -> str:
    assert reply.status == status, reply.text
    line = json.loads(reply.body)["error"]
    assert "\n" not in line
    return str(line)


def picked(
    server: Server, truth: Truth, rng: np.random.Generator, mark_px: float, count: int
) -> list[Found]:
    """Spots of the true surface, marked in one picture and refined in the others."""
    spots = []
    for place in truth.places(rng, count):
        seen = truth.nearest(place)
        if seen is None:
            continue
        x, y = seen[1] - 0.5 + rng.normal(0, mark_px, 2)
        pick = {"image": seen[0], "x": x, "y": y, "sigma_px": mark_px}
        reply = call(server, "/api/picks/refine", {"pick": pick})
        if reply.status == 400:  # beyond the edge of the DEM
            continue
        found = json.loads(reply.body)
        if len(found["picks"]) > 2:
            spots.append(Found(place, found["picks"]))
    assert len(spots) > 0.8 * count
    return spots


@pytest.mark.parametrize(("mark_px", "seed"), [(0.3, 5), (0.03, 6)])
def test_errors_of_lengths_are_as_stated(
    server: Server, workspace: Path, mark_px: float, seed: int
) -> None:
    rng, truth = np.random.default_rng(seed), Truth(workspace)
    spots = picked(server, truth, rng, mark_px, 30)
    ratios, errors = [], []
    for _ in range(200):
        one, two = (spots[n] for n in rng.choice(len(spots), 2, replace=False))
        found = sent(server, "/api/picks/length", {"first": one.picks, "second": two.picks})
        errors.append(found["value"] - np.linalg.norm(one.place - two.place))
        ratios.append(errors[-1] / found["sigma"])
        parts = [found[f"sigma_{part}"] for part in ("picks", "poses", "scale")]
        assert min(parts) > 0 and np.hypot(*parts[:2]) <= found["sigma"]
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    assert 1e-5 < np.sqrt(np.mean(np.square(errors))) < 1e-3 * (0.3 + 5 * mark_px)


def test_matches_err_as_they_state(server: Server, workspace: Path) -> None:
    truth = Truth(workspace)
    ratios, sizes = [], []
    for spot in picked(server, truth, np.random.default_rng(8), 1e-3, 20):
        for pick in spot.picks[1:]:
            off = np.array([pick["x"], pick["y"]]) + 0.5 - truth.pixel(pick["image"], spot.place)
            ratios.append(off / pick["sigma_px"])
            sizes.append(np.linalg.norm(off))
    assert len(ratios) > 120
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    assert np.median(sizes) < 0.1 and max(sizes) < 1.0


def test_stations_around_a_spot_are_known_as_the_model_states(workspace: Path) -> None:
    """A block of all stations has the covariance that the adjustment wrote."""
    pictures = RegisteredPictures.read(workspace)
    block = StationBlock.around(workspace, pictures, [*np.unique(pictures.station)])
    stated = read_uncertainty(workspace / "sparse" / "covariance.npz")
    for row, station in enumerate(stated.stations.tolist()):
        where = np.zeros((6, len(block.numbers), 6))
        where[:, np.searchsorted(block.numbers, station)] = np.eye(6)
        poses, rig = block.variances(where, np.zeros((6, len(block.covariance))))
        ratio = np.sqrt(np.diag(poses + rig) / np.diag(stated.frame_cov[row]))
        assert np.all((ratio > 0.85) & (ratio < 1.15))


def test_a_picture_without_the_spot_is_refused(server: Server, workspace: Path) -> None:
    truth = Truth(workspace)
    place = truth.places(np.random.default_rng(8), 1)[0]
    found = truth.nearest(place)
    assert found is not None
    image, pixel = found
    x, y = pixel - 0.5
    seen = asked(server, "/api/pictures/seeing", image=image, x=x, y=y)
    names = [one["name"] for one in seen["pictures"] if one["name"] != image]
    flat, other = names[:2]
    kept = {name: (workspace / "images" / name).read_bytes() for name in (flat, other)}
    grey = np.full_like(cv2.imread(str(workspace / "images" / flat)), 90)
    grey += np.random.default_rng(1).integers(0, 3, grey.shape, dtype=np.uint8)
    turned = cv2.imread(str(workspace / "images" / other))[::-1, ::-1]
    try:
        cv2.imwrite(str(workspace / "images" / flat), grey)
        cv2.imwrite(str(workspace / "images" / other), np.ascontiguousarray(turned))
        pick = {"image": image, "x": x, "y": y, "sigma_px": 0.3}
        found = sent(server, "/api/picks/refine", {"pick": pick, "images": names})
        refusals = {one["name"]: one["why"] for one in found["refused"]}
        assert refusals.keys() >= {flat, other} and all(refusals.values())
        assert len(found["picks"]) > 2
        # without texture in the first picture nothing is found anywhere
        x0, y0 = next((one["x"], one["y"]) for one in seen["pictures"] if one["name"] == flat)
        pick = {"image": flat, "x": x0, "y": y0, "sigma_px": 0.3}
        found = sent(server, "/api/picks/refine", {"pick": pick, "images": [image, *names[2:]]})
        assert len(found["picks"]) == 1 and len(found["refused"]) == len(names) - 1
    finally:
        for name, content in kept.items():
            (workspace / "images" / name).write_bytes(content)


def test_two_writers_and_wrong_files(server: Server, workspace: Path) -> None:
    image = asked(server, "/api/pictures", count=1)["pictures"][0]["name"]
    pick = {"image": image, "point": "a b", "x": 1.25, "y": 2.5, "sigma_px": 0.4}
    body = {"token": "", "points": ["a b"], "picks": [pick]}
    path = workspace / "picks.csv"
    try:
        token = sent(server, "/api/picks/save", body)["token"]
        before = path.read_bytes()
        assert f"{image},a b,1.2500,2.5000,0.4000," in before.decode()
        refused(call(server, "/api/picks/save", body), 409)
        assert call(server, "/api/picks/save", {**body, "token": token}, token=None).status == 403
        wrong = {**body, "token": token, "picks": [{**pick, "image": "../survey.toml"}]}
        refused(call(server, "/api/picks/save", wrong))
        assert path.read_bytes() == before

        path.write_text("image,point,x,y\nleft/1.png,p,1,2\nleft/2.png,p,one,2\n")
        assert "line 3" in refused(ask(server, "/api/picks"), 500)
        path.unlink()
        path.symlink_to(workspace / "survey.toml")
        refused(call(server, "/api/picks/save", body))
        assert (workspace / "survey.toml").read_text().lstrip().startswith("seed")
    finally:
        path.unlink(missing_ok=True)


def test_control_is_scored_at_once(server: Server, workspace: Path) -> None:
    """Points whose coordinates are where the model has them, but for one that is 50 mm too deep."""
    spots = picked(server, Truth(workspace), np.random.default_rng(9), 0.05, 5)
    files = [workspace / name for name in ("picks.csv", "control.csv")]
    try:
        picks = [{**p, "point": f"P{n}"} for n, spot in enumerate(spots) for p in spot.picks]
        names = sorted({p["point"] for p in picks})
        sent(server, "/api/picks/save", {"token": "", "points": names, "picks": picks})
        points = {one["name"]: one for one in asked(server, "/api/picks")["points"]}
        for point in points.values():
            assert all(abs(r) < 1.0 for p in point["picks"] for r in p["residual"])
            assert min(point["position"]["sigma"]) > 1e-5 and point["position"]["views"] > 2
        rows = [
            {
                "kind": "point", "name": name, "use": "control", "sigma_m": "0.002",
                "north_m": f"{points[name]['position']['n']:.4f}",
                "east_m": f"{points[name]['position']['e']:.4f}",
                "depth_m": f"{points[name]['position']['down'] + 0.05 * (name == 'P0'):.4f}",
            }
            for name in names
        ]  # fmt: skip
        sent(server, "/api/control/save", {"token": "", "rows": rows})
        now = {one["name"]: one for one in asked(server, "/api/picks")["control"]["now"]["points"]}
        for name, row in now.items():
            miss = [row["north_m"], row["east_m"], row["down_m"]]
            expected = [0.0, 0.0, -0.05 if name == "P0" else 0.0]
            np.testing.assert_allclose(miss, expected, atol=2e-4)
            assert (row["misfit_sigmas"] > 4.0) == (name == "P0")
        assert asked(server, "/api/picks")["control"]["fitted"] is not None
        held = asked(server, "/api/control")
        assert [row["name"] for row in held["rows"]] == names
    finally:
        for path in files:
            path.unlink(missing_ok=True)


def test_pictures_have_any_names_and_nothing_else_is_reached(
    server: Server, workspace: Path
) -> None:
    manifest = workspace / "images" / "manifest.csv"
    before = manifest.read_bytes()
    header, rows = read_csv(manifest, exact=True)
    first = rows[0][1]
    old, new = workspace / "images" / first["image"], workspace / "images" / STRANGE
    shutil.copy(old, new)
    link = workspace / "images" / "left" / "link.png"
    link.symlink_to("/etc/hostname")
    try:
        more = [{**first, "image": name, "station": "900"} for name in (STRANGE, "left/link.png")]
        write_csv(manifest, header, [[r[h] for h in header] for _, r in rows] +
                  [[r[h] for h in header] for r in more])  # fmt: skip
        listed = asked(server, "/api/pictures", find="ünder")
        assert [one["name"] for one in listed["pictures"]] == [STRANGE]
        address = f"/api/pictures/{quote(STRANGE)}"
        about = asked(server, f"{address}/about")
        assert (about["width"], about["height"]) == (564, 451)
        for level, (wide, high) in {1: (512, 451), 0: (282, 226)}.items():
            reply = ask(server, f"{address}/tile/{level}/0/0.webp")
            picture = cv2.imdecode(np.frombuffer(reply.body, np.uint8), cv2.IMREAD_COLOR)
            assert picture.shape == (high, wide, 3)
            taken = cv2.imread(str(old))
            if level == 1:
                off = picture.astype(float) - taken[:, :512]
                assert 0.0 < np.abs(off).mean() < 3.0
        for path in (
            "left/link.png/about", "../survey.toml/about", "left/../../survey.toml/about",
            "%2e%2e/survey.toml/about", "left%2f..%2f..%2fsurvey.toml/about", "nothing/about",
            "truth/poses.csv/about", f"{quote(STRANGE)}/tile/1/2/0.webp",
            f"{quote(STRANGE)}/tile/2/0/0.webp", f"{quote(STRANGE)}/tile/x/0/0.webp",
            f"{quote(STRANGE)}/tile/1/-1/0.webp",
        ):  # fmt: skip
            assert ask(server, f"/api/pictures/{path}").status in (400, 404), path
    finally:
        manifest.write_bytes(before)
        new.unlink()
        link.unlink()
