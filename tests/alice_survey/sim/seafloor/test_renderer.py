from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import SeafloorConfig, SurveyConfig
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import rotation_from_attitude
from alice_survey.sim.seafloor.as_built import true_rig
from alice_survey.sim.seafloor.light import backscatter_at, backscatter_of_row, camera_light
from alice_survey.sim.seafloor.renderer import Scene, camera_rays, flat_floor_radiance, render
from alice_survey.sim.seafloor.terrain import Terrain, TerrainObject, build_terrain
from alice_survey.sim.seafloor.texture import Texture
from camera_calib.rig import design_rig
from camera_calib.water import water_optics
from tests.cameras import range_map
from tests.oracles_seafloor import fermat_pixels

CONFIG = SurveyConfig.model_validate({"imaging": {"scale": 16}})
RIG = true_rig(CONFIG.camera, CONFIG.water, scale=16, seed=CONFIG.seed)
CAMERA = RIG.cameras["left"]
FLOOR_M = 15.0


@dataclass(frozen=True, kw_only=True)
class Stripes(Texture):
    """Bright north (or east) of a straight line, dark beyond it."""

    at_m: float
    axis: int

    def albedo(self, points_ned: np.ndarray, *_: np.ndarray) -> np.ndarray:
        bright = points_ned[:, self.axis] > self.at_m
        return np.repeat(np.where(bright, 0.8, 0.1)[:, None], 3, axis=1).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Even(Texture):
    """The same colour everywhere."""

    def albedo(self, points_ned: np.ndarray, *_: np.ndarray) -> np.ndarray:
        return np.tile(np.array([0.4, 0.3, 0.2], dtype=np.float32), (len(points_ned), 1))


def flat(shift_m: float = 0.0, depth_m: float = FLOOR_M) -> Terrain:
    config = SeafloorConfig(relief_m=0.0, rocks_per_m2=0.0, amphora=False, grid_m=0.25)
    bounds = (shift_m - 3.0, shift_m + 3.0, shift_m - 3.0, shift_m + 3.0)
    return build_terrain(config, bounds, depth_m, np.random.default_rng(0))


LIGHT = camera_light(
    CAMERA, RIG.body_from_cam("left"), CONFIG.imaging, water_optics("II"), reach_m=5.0
)
FLAT = Scene(terrain=flat(), texture=Even(seed=0))


def pose(
    north_m: float = 0.0,
    east_m: float = 0.0,
    altitude_m: float = 2.0,
    attitude_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> RigidTransform:
    """Of the left camera's pupil."""
    turn = rotation_from_attitude(*np.deg2rad(attitude_deg))
    place = np.array([north_m, east_m, FLOOR_M - altitude_m])
    return RigidTransform.from_components(place, turn * RIG.body_from_cam("left").rotation)


def still(one: RigidTransform) -> RigidTransform:
    return RigidTransform.from_matrix(one.as_matrix()[None])


def moving(one: RigidTransform, step_m: np.ndarray, moments: int = 64) -> RigidTransform:
    along = (np.arange(moments) + 0.5) / moments - 0.5
    places = one.translation + along[:, None] * step_m
    return RigidTransform.from_components(places, Rotation.concatenate([one.rotation] * moments))


def edge_profile(picture: np.ndarray, axis: int) -> np.ndarray:
    """Share of bright along one picture axis, mean over the middle, lighting divided out."""
    green = picture[..., 1].astype(np.float64)
    middle = green.shape[1 - axis] // 2
    lines = np.take(green, range(middle - 4, middle + 5), axis=1 - axis)
    return lines.mean(axis=1 - axis)


@pytest.mark.parametrize("attitude", [(0.0, 0.0, 0.0), (3.0, -2.0, 0.0), (-2.0, 4.0, 0.0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_an_edge_on_the_floor_is_where_fermat_puts_it(
    axis: int, attitude: tuple[float, float, float]
) -> None:
    """The whole way from picture over ray casting to the world, half a pixel included."""
    at_m = 0.137 if axis == 0 else -0.218
    view = pose(0.03, -0.02, 2.0, attitude)
    dark, bright, half = (
        render(
            Scene(terrain=flat(), texture=Stripes(seed=0, at_m=at, axis=axis)), CAMERA, LIGHT,
            still(view), 4,
        )
        for at in (9.0, -9.0, at_m)
    )  # fmt: skip
    share = (half - dark)[..., 1] / (bright - dark)[..., 1]

    points = np.zeros((41, 3))
    points[:, axis], points[:, 1 - axis] = at_m, np.linspace(-0.5, 0.5, 41)
    points[:, 2] = FLOOR_M
    edge = fermat_pixels(CAMERA.to_json(), view.inv().apply(points))
    # North is up in the picture (bright above), east is right (bright on the right).
    for x, y in edge[5:-5]:
        if axis == 0:
            column = int(x)
            got = share[:, column].sum()
            there = np.interp(column + 0.5, edge[:, 0], edge[:, 1])
        else:
            row = int(y)
            got = CAMERA.width_px - share[row].sum()
            order = np.argsort(edge[:, 1])
            there = np.interp(row + 0.5, edge[order, 1], edge[order, 0])
        assert got == pytest.approx(there, abs=0.05)


def test_a_flat_floor_has_the_light_of_the_closed_form() -> None:
    """Rendering with rays, against the same physics without them."""
    step = 13
    picture = render(FLAT, CAMERA, LIGHT, still(pose()), 1)
    expected = flat_floor_radiance(CAMERA, LIGHT, 2.0, np.array([0.4, 0.3, 0.2]), step)
    np.testing.assert_allclose(picture[::step, ::step], expected, rtol=2e-4)
    middle = picture[CAMERA.height_px // 2, CAMERA.width_px // 2]
    assert np.all(picture[0, 0] < 0.7 * middle)  # cos^4 and the strobes' fall-off


@pytest.mark.parametrize("blur_px", [2.0, 5.0])
def test_motion_blurs_by_speed_times_exposure_times_focal_length_over_range(blur_px: float) -> None:
    """An edge across the way is smeared over speed * exposure * f n / range pixels."""
    camera = design_rig(CONFIG.camera, CONFIG.water, 16).cameras["left"]
    range_m = 2.0
    # The port shifts the pinhole that comes nearest by about 7 mm, hence the 1.5 %.
    step_m = blur_px * range_m / (camera.fx_px * camera.n_water)
    scene = [
        Scene(terrain=flat(), texture=Stripes(seed=0, at_m=at, axis=0)) for at in (0.005, 9.0, -9.0)
    ]

    def spread(poses: RigidTransform) -> float:
        """Variance of the edge, pixels^2."""
        half, dark, bright = (edge_profile(render(s, camera, LIGHT, poses, 4), 0) for s in scene)
        rise = -np.diff((half - dark) / (bright - dark))
        at = np.arange(len(rise))
        mean = (rise * at).sum()
        assert rise.sum() == pytest.approx(1.0, abs=1e-3)
        return float((rise * (at - mean) ** 2).sum())

    # A box of L pixels has a variance of L^2 / 12; a pixel's area and its place add 1 / 12 each.
    moved = spread(moving(pose(), np.array([step_m, 0.0, 0.0])))
    assert np.sqrt(12.0 * moved - 2.0) == pytest.approx(blur_px, rel=0.015)
    assert spread(still(pose())) < 0.26


def test_ranges_to_a_flat_floor_are_exact() -> None:
    view = pose(0.1, -0.2, 1.8, (5.0, -3.0, 40.0))
    ranges = range_map(FLAT, CAMERA, view)
    assert ranges.shape == (CAMERA.height_px, CAMERA.width_px)
    pixels = CAMERA.pixel_centres()
    # The point at that range on the pixel's ray is on the floor, and Fermat agrees on the pixel.
    points = CAMERA.at_depth(pixels, ranges.astype(np.float64)).reshape(-1, 3)
    np.testing.assert_allclose(view.apply(points)[:, 2], FLOOR_M, atol=3e-6)
    some = slice(None, None, 997)
    np.testing.assert_allclose(
        fermat_pixels(CAMERA.to_json(), points[some]), pixels.reshape(-1, 2)[some], atol=1e-5
    )


def test_rays_that_meet_nothing_see_only_water() -> None:
    far = pose(2.9, 2.9)
    ranges = range_map(FLAT, CAMERA, far)
    picture = render(FLAT, CAMERA, LIGHT, still(far), 1)
    assert 0.1 < np.isnan(ranges).mean() < 0.9
    water, floor = picture[np.isnan(ranges)], picture[np.isfinite(ranges)]
    assert np.all(np.isfinite(picture))
    assert 0.0 < water.max() < floor.min()


def test_an_amphora_hides_strobes_from_the_sand_next_to_it() -> None:
    config = SeafloorConfig(relief_m=0.0, rocks_per_m2=0.0, grid_m=0.02)
    laid = build_terrain(config, (-1.5, 1.5, -1.5, 1.5), FLOOR_M, np.random.default_rng(4))
    bare = replace(laid, objects=())
    middle = laid.objects[0].vertices.mean(axis=0)
    view = pose(float(middle[0]), float(middle[1]), 1.5)
    with_it, without = (
        render(Scene(terrain=t, texture=Even(seed=0)), CAMERA, LIGHT, still(view), 1)[..., 1]
        for t in (laid, bare)
    )
    ranges = range_map(Scene(terrain=laid, texture=Even(seed=0)), CAMERA, view)
    sand = np.abs(ranges - 1.5) < 1e-4
    shaded = with_it[sand] / without[sand]
    assert shaded.max() < 1.0 + 1e-4
    assert 0.003 < (shaded < 0.9).mean() < 0.3
    assert np.median(shaded) == pytest.approx(1.0, abs=1e-4)


def test_places_taken_as_lit_at_once_are_lit() -> None:
    """Pictures are the same where a ray is cast to each strobe from everywhere."""
    config = SeafloorConfig(relief_m=0.4, rocks_per_m2=3.0, grid_m=0.02)
    laid = build_terrain(config, (-2.0, 2.0, -2.0, 2.0), FLOOR_M, np.random.default_rng(4))
    sure, cell_m = laid.patch().steepest
    assert 0.001 < np.isinf(sure).mean() < 0.2
    assert np.sort(sure, axis=None)[-30] > 1.0 > np.median(sure) > 0.05
    whole = laid.patch()
    laid.__dict__["patch"] = lambda _: whole
    views = [
        pose(n, 0.1 * n, altitude, (4.0, 3.0, 0.0)) for n in (-0.4, 0.4) for altitude in (0.8, 2.0)
    ]
    scene = Scene(terrain=laid, texture=Even(seed=0))
    quick = [render(scene, CAMERA, LIGHT, still(view), 1) for view in views]
    whole.__dict__["steepest"] = np.full_like(sure, np.inf), cell_m
    for view, picture in zip(views, quick, strict=True):
        np.testing.assert_array_equal(render(scene, CAMERA, LIGHT, still(view), 1), picture)


def test_vignetting_is_cosine_to_the_fourth_in_air() -> None:
    camera = design_rig(CONFIG.camera, CONFIG.water, 16).cameras["left"]
    rays = camera_rays(camera, 1, 0, camera.height_px)
    offset = camera.pixel_centres().reshape(-1, 2) - [camera.cx_px, camera.cy_px]
    tangent2 = (offset**2).sum(axis=1) / camera.fx_px**2
    np.testing.assert_allclose(rays.vignetting, (1.0 + tangent2) ** -2, rtol=1e-5)


def test_every_ray_of_a_pixel_has_its_share_of_the_exposure() -> None:
    """A picture over a motion is the mean of the pictures along it."""
    scene = Scene(terrain=flat(), texture=Stripes(seed=0, at_m=0.1, axis=1))
    poses = moving(pose(), np.array([0.0, 0.05, 0.0]), 16)
    blurred = render(scene, CAMERA, LIGHT, poses, 4)
    mean = np.mean([render(scene, CAMERA, LIGHT, still(p), 4) for p in poses], axis=0)
    difference = (blurred - mean)[..., 1] / mean[..., 1].max()
    assert np.abs(difference.mean()) < 2e-4
    assert difference.std() < 0.01


def test_pictures_do_not_depend_on_where_the_survey_is() -> None:
    """Far from the datum, in deep water, nothing is lost to single precision."""
    view = RigidTransform.from_translation([40_000.0, 40_000.0, 4985.0]) * pose()
    deep = replace(FLAT, terrain=flat(40_000.0, 5000.0))
    far, near = range_map(deep, CAMERA, view), range_map(FLAT, CAMERA, pose())
    np.testing.assert_allclose(far, near, atol=2e-6)


def test_a_level_camera_sees_the_floor_below_the_horizon_and_backscatter_above() -> None:
    level = pose(altitude_m=0.5, attitude_deg=(0.0, 90.0, 0.0))
    rotation = level.rotation.as_matrix()
    found = range_map(FLAT, CAMERA, level, reach_m=2.5)
    origins, directions = CAMERA.unproject(CAMERA.pixel_centres())
    down = directions @ rotation[2]
    start = level.translation[2] + origins @ rotation[2]
    path = np.where(down > 0, (FLOOR_M - start) / np.where(down > 0, down, 1.0), np.inf)
    expected = origins[..., 2] + path * directions[..., 2]
    near = path < 2.5
    assert near.sum() > 100
    np.testing.assert_allclose(found[near], expected[near], rtol=3e-6)
    assert np.isnan(found[down <= 0]).all()

    lit = render(FLAT, CAMERA, LIGHT, still(level), 1)
    row, column = 3, CAMERA.width_px // 2
    place = np.array([column + 0.5, row + 0.5]) / (CAMERA.width_px, CAMERA.height_px)
    veil, of_row = np.empty(3), np.empty(LIGHT.backscatter.shape[1:])
    at = place * (np.array(LIGHT.backscatter.shape[1::-1]) - 1)
    backscatter_of_row(LIGHT.backscatter, at[1], of_row)
    backscatter_at(of_row, LIGHT.reach_m, at[0], LIGHT.reach_m, veil)
    cosine = CAMERA.in_air().unproject(np.array([column + 0.5, row + 0.5]))[1][2]
    np.testing.assert_allclose(lit[row, column], veil * cosine**4, rtol=1e-5)


def test_a_texture_moves_with_its_object() -> None:
    box_m = np.array([[-0.4, -0.4, 3.9], [0.4, -0.4, 3.9], [0.4, 0.4, 3.9], [-0.4, 0.4, 3.9]])
    sheet = np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)
    shift = np.array([0.0, 0.23, 0.0])
    below = np.array([0.0, 0.0, FLOOR_M])
    views = []
    for moved in (np.zeros(3), shift):
        item = TerrainObject(
            name="fish", vertices=(box_m - below + moved).astype(np.float32), triangles=sheet,
            material=2.0, at_rest=(box_m - below).astype(np.float32),
        )  # fmt: skip
        terrain = replace(flat(), objects=(item,))
        scene = Scene(terrain=terrain, texture=Texture(seed=4))
        follow = pose(east_m=float(moved[1]), altitude_m=FLOOR_M - 3.0)
        views.append(render(scene, CAMERA, LIGHT, still(follow), 1))
    inside = np.s_[60:110, 80:130]
    assert views[0][inside].std() > 0.05 * views[0][inside].mean()
    np.testing.assert_allclose(views[1][inside], views[0][inside], rtol=2e-2)
    with pytest.raises(WorkspaceError, match="moves"):
        terrain.write(Path("never.ply"))


def test_pixels_are_sampled_evenly_over_their_area() -> None:
    """The mean of a pixel's rays is the ray of its centre, and no two share a row or column."""
    for samples in (1, 2, 3, 4):
        rays = camera_rays(CAMERA, samples, 60, 61)
        mean = rays.directions.reshape(CAMERA.width_px, samples**2, 3).mean(axis=1)
        pixels = np.column_stack([np.arange(CAMERA.width_px) + 0.5, np.full(CAMERA.width_px, 60.5)])
        np.testing.assert_allclose(mean, CAMERA.unproject(pixels)[1], atol=2e-6)
        first = rays.directions[: samples**2]
        assert len(np.unique(np.round(first[:, 0], 6))) == samples**2
        assert len(np.unique(np.round(first[:, 1], 6))) == samples**2
